# SPDX-License-Identifier: Apache-2.0
"""Many runs of a scenario: sweeps, searches and the budget of its form error."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lathe_rc.analysis.budget import Budget
from lathe_rc.cell.scenario import Scenario

if TYPE_CHECKING:
    from lathe_rc.sweep.space import Space
    from lathe_rc.sweep.sweep import Sweep
    from lathe_rc.sweep.tuned import Tuning


def sweep(scenario: Scenario, space: "Space", folder: Path, **options: Any) -> "Sweep":
    """Compute variations of a cell into a table; the arguments are those of `lathe_rc.sweep.sweep.run`."""
    from lathe_rc.sweep import sweep

    return sweep.run(scenario, space, folder, **options)


def tune(scenario: Scenario, free: Mapping[str, Any], goals: Sequence[str], folder: Path, **options: Any) -> "Tuning":
    """Search parameters of a cell; the arguments are those of `lathe_rc.sweep.tune.run`."""
    from lathe_rc.sweep import tune

    return tune.run(scenario, free, goals, folder, **options)


def budget(
    scenario: Scenario, *, threads: int | None = None, watch: Callable[[int, int], None] | None = None
) -> Budget:
    """The parts of a scenario's form error, in its last ten revolutions; see `lathe_rc.analysis.budget`.

    It runs offline, as a batch, with one cause after the other switched off: some ten runs, or some thirty if causes
    act together.

    Args:
        scenario: of the whole; its spindle must have a number of revolutions.
        threads: that compute; None: one for each core.
        watch: called after each run with how many there have been and how many there will be, as far as is known.

    Raises:
        InputError: the scenario cannot work, has no tool, or turns no complete revolution.
        LatheError: a run failed.

    Example:
        >>> from pathlib import Path
        >>> from lathe_rc import harness, resources
        >>> from lathe_rc.cell import scenario
        >>> piston = scenario.load(resources.find(Path("piston.yaml")), ["spindle_encoder.revolutions=60"])
        >>> for found in harness.budget(piston).causes:
        ...     print(f"{found.name}: {found.percent()} %")
        Q floor: -0.3 %
        speed: 83.5 %
        lead: 0.0 %
        feed: 16.9 %
    """
    from lathe_rc.cell import budget  # imports many stages

    return budget.budget(scenario, threads=threads, watch=watch)
