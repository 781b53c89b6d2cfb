# SPDX-License-Identifier: Apache-2.0
"""The scenario of a command: how its argument and options are read."""

from collections.abc import Sequence
from pathlib import Path

from lathe_rc import resources
from lathe_rc.cell import scenario as scenarios
from lathe_rc.cell.scenario import Scenario


def load(name: str, overrides: Sequence[str]) -> Scenario:
    """The scenario of a file, or of a name without ``.yaml`` that is looked up in ``config`` as well.

    Raises:
        InputError: there is none, or it cannot be.
    """
    return scenarios.load(resources.scenario(Path(name)), overrides)


def split(scenario: Scenario, groups: Sequence[str]) -> list[list[str]] | None:
    """The nodes of each ``--group``; None if none is given: as the scenario says.

    Raises:
        InputError: a node that there is not, or twice.
    """
    named = [group.split("+") for group in groups if group != "none"]
    scenario.processes(named, "--group")
    return named if groups else None
