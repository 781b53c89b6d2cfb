# SPDX-License-Identifier: Apache-2.0
"""Scenario of a command, read from its argument and options."""

import json
from collections.abc import Sequence
from pathlib import Path

from lathe_rc.cell import scenario as scenarios
from lathe_rc.cell.scenario import Scenario


def load(
    name: str,
    overrides: Sequence[str],
    *,
    revolutions: float | None = None,
    speed_factor: float | None = None,
    strict: bool = False,
    start_from: Path | None = None,
) -> Scenario:
    """Load a scenario from a file, or by a name without ``.yaml``, which is also looked up in ``config``.

    Args:
        name: file or name of the scenario.
        overrides: values of ``--set``.
        revolutions: length of the run; None: as in the scenario.
        speed_factor: pace of the run; None: as in the scenario.
        strict: whether the run ends when it does not hold its pace, also if the scenario does not say so.
        start_from: checkpoint from which the run goes on; None: as in the scenario.

    Raises:
        InputError: there is no such scenario, or the scenario is invalid.
    """
    loaded = scenarios.load(name, overrides)
    place = str(start_from.absolute()) if start_from else None
    asked: dict[str, object] = {"revolutions": revolutions, "speed_factor": speed_factor, "strict_pace": strict or None}
    asked["start_from"] = place
    given = {name: value for name, value in asked.items() if value is not None}
    changes = [f"{node}.{n}={json.dumps(v)}" for node in loaded.masters for n, v in given.items()]
    return scenarios.load(name, [*overrides, *changes]) if changes else loaded


def split(scenario: Scenario, groups: Sequence[str]) -> list[list[str]] | None:
    """Return the nodes of each ``--group``; None if the option is not given, so that the scenario's groups apply.

    Raises:
        InputError: a node is unknown, or named twice.
    """
    named = [group.split("+") for group in groups if group != "none"]
    scenario.processes(named, "--group")
    return named if groups else None
