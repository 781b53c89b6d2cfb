# SPDX-License-Identifier: Apache-2.0
"""The scenario of a command: how its argument and options are read."""

from collections.abc import Sequence

from lathe_rc.cell import scenario as scenarios
from lathe_rc.cell.scenario import Scenario


def load(
    name: str, overrides: Sequence[str], *, revolutions: float | None = None, speed_factor: float | None = None
) -> Scenario:
    """The scenario of a file, or of a name without ``.yaml`` that is looked up in ``config`` as well.

    Args:
        name: of the scenario.
        overrides: as of ``--set``.
        revolutions: length of the run; None: as the scenario says.
        speed_factor: pace of the run; None: as the scenario says.

    Raises:
        InputError: there is none, or it cannot be.
    """
    loaded = scenarios.load(name, overrides)
    asked = {"revolutions": revolutions, "speed_factor": speed_factor}
    given = {name: value for name, value in asked.items() if value is not None}
    changes = [f"{node}.{n}={v!r}" for node in loaded.masters for n, v in given.items()]
    return scenarios.load(name, [*overrides, *changes]) if changes else loaded


def split(scenario: Scenario, groups: Sequence[str]) -> list[list[str]] | None:
    """The nodes of each ``--group``; None if none is given: as the scenario says.

    Raises:
        InputError: a node that there is not, or twice.
    """
    named = [group.split("+") for group in groups if group != "none"]
    scenario.processes(named, "--group")
    return named if groups else None
