# SPDX-License-Identifier: Apache-2.0
"""Command ``lathe design``: learning law for a measured drive, by its margin and the form error of its runs."""

import math
import sys
from collections.abc import Callable, Iterator
from itertools import count, takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from lathe_rc.commands import options
from lathe_rc.errors import InputError, LatheError

if TYPE_CHECKING:
    from rich.console import RenderableType

    from lathe_commission.design import Candidate, Covered, Design, WorstResult
    from lathe_rc.cell.parameters import Values
    from lathe_rc.cell.scenario import Scenario

_SWING, _DRIFT = 0.03, 0.01  # of the other speed, if that of the scenario is constant
_TURN = 2.0 * math.pi


@click.command()
@options.scenario
@click.option(
    "--drive",
    "measured",
    type=options.PATH,
    help="parameters of the drive as lathe fit drive writes them, with the set and the measured points "
    "beside it (FILE.drives.csv, FILE.points.csv, FILE.points-2.csv, ...)",
)
@click.option("--margin", type=click.FloatRange(0, 1), default=0.3, show_default=True, help="least drive margin [1]")
@click.option(
    "--swing",
    type=click.FloatRange(0, 0.5),
    help="amplitude of a swing of the speed, over the nominal one, at which each law runs as well; default: 0.03, or 0 "
    "if the speed of the scenario varies",
)
@click.option(
    "--drift",
    type=click.FloatRange(0, 0.5),
    help="change of this speed from the start to the end of the run; default: 0.01, or 0",
)
@options.overrides
@options.length
@click.option("-o", "--output", type=options.PATH, help="scenario with the best law; default: SCENARIO-designed.yaml")
@options.allow_code
@options.as_json
def design(
    scenario: str,
    measured: Path | None,
    margin: float,
    swing: float | None,
    drift: float | None,
    overrides: tuple[str, ...],
    revolutions: float | None,
    output: Path | None,
    *,
    as_json: bool,
) -> None:
    """Find the learning law of a SCENARIO for a measured drive (docs/learning.md).

    Each law runs offline in place of the scenario's learning controller, at the speed of the scenario and at another
    one, with settings that keep the margin with every drive of the set and at every measured point.
    """
    from lathe_commission.design import Design
    from lathe_rc import files
    from lathe_rc.analysis import frequency_response
    from lathe_rc.commands import scenario as scenarios
    from lathe_rc.commands import tables
    from lathe_rc.signals.measurement_file import read

    loaded = scenarios.load(scenario, overrides, revolutions=revolutions)
    place = output or Path(f"{loaded.name}-designed.yaml")
    files.check_place("--output", place)
    drives = _drives(measured) if measured else [{}]
    points = _points(measured) if measured else []
    responses = [response for path in points for response in frequency_response.of_states(read(path, {}))]
    other, speeds = _other_speed(loaded, swing, drift)
    made = Design(loaded, drives, margin, responses, other)
    found = made.candidates(lambda law: click.echo(law, err=True) if sys.stderr.isatty() else None)
    best = found[0]
    if best.scenario is None:
        reasons = "; ".join(f"{each.law}: {each.reason}" for each in found)
        raise LatheError(
            f"no law is offered for a drive margin of {margin:g}; allowed: a smaller --margin, or another drive "
            f"({reasons})"
        )
    chosen = best.scenario
    if responses:
        file = points[0]
        if len(points) > 1:
            file = place.with_suffix(".states.csv")
            frequency_response.write_states(file, responses, ", ".join(map(str, points)))
        chosen = chosen.varied({f"{made.drive}response_file": str(file.resolve())})
    if revolutions is not None:  # the length of the runs that compare the laws, not of the cell
        given = scenarios.load(scenario, overrides)
        chosen = chosen.varied({f"{name}.revolutions": given.value(f"{name}.revolutions") for name in given.masters})
    files.write(place, _comment(best, made) + chosen.to_yaml(given=True))
    laws = [_summary(each) for each in found]
    summary = {"drives": len(drives), "speeds": speeds, "laws": laws, "scenario": str(place)}
    tables.show(summary, _told(found, made, speeds, place), as_json=as_json)


def _points(measured: Path) -> list[Path]:
    """Return the files with measured points beside the parameters of a drive, in the order of the states."""
    first = measured.with_suffix(".points.csv")
    further = (measured.with_suffix(f".points-{number}.csv") for number in count(2))
    return [first, *takewhile(Path.exists, further)] if first.exists() else []


def _other_speed(scenario: "Scenario", swing: float | None, drift: float | None) -> tuple["Scenario | None", list[str]]:
    """Return the scenario with the other speed at which laws run, and both speeds in words."""
    from lathe_commission.design import SWING_FREQUENCY, with_swing
    from lathe_machine.stages.spindle.speed_law import SpeedLawParameters
    from lathe_rc.cell.wiring import Cell

    low, high = Cell(scenario.nodes).speed_range
    asked = swing is not None or drift is not None
    speeds = ["constant" if low == high else f"{low:.4g} to {high:.4g} rad/s, as in the scenario"]
    most, change = (swing or 0.0, drift or 0.0) if asked or low < high else (_SWING, _DRIFT)
    if not asked and not isinstance(scenario.nodes[scenario.masters[0]], SpeedLawParameters):
        return None, speeds
    if low == high and not (most or change):
        return None, speeds
    told = f"swing of ±{most:.3g} at {SWING_FREQUENCY:g} rad/s, drift of {change:.3g}" if most or change else "constant"
    return with_swing(scenario, most, change), [*speeds, told]


def _drives(path: Path) -> list["Values"]:
    """Return the parameters of the nominal drive and of each drive of the set.

    Raises:
        InputError: a file cannot be read, or describes no electrodynamic drive.
    """
    from lathe_machine.stages.drive.electrodynamic_actuator import ElectrodynamicActuatorParameters
    from lathe_rc.cell import cells_file, ros_yaml

    nominal: list[Any] = [values for values in ros_yaml.read(path).values() if values]
    if len(nominal) != 1:
        raise InputError(f"{path}: {len(nominal)} nodes; allowed: the one that lathe fit drive writes")
    beside = path.with_suffix(".drives.csv")
    found: list[Any] = list(nominal)
    if beside.exists():
        of_set = [{target.rpartition(".")[2]: each[target] for target in each} for each in cells_file.read(beside)]
        found += [each for each in of_set if each != nominal[0]]
    for values in found:
        if unknown := sorted(values.keys() - ElectrodynamicActuatorParameters.model_fields.keys()):
            raise InputError(f"{path}: {unknown[0]}; allowed: parameters of electrodynamic_actuator")
    return found


def _summary(candidate: "Candidate") -> dict[str, Any]:
    if candidate.reason:
        return {"law": candidate.law, "offered": False, "reason": candidate.reason}
    covered = candidate.covered
    runs = {"nominal": candidate.nominal, "worst": candidate.worst, "other_speed": candidate.other}

    def by_run(of: Callable[["WorstResult"], float]) -> dict[str, float | None]:
        return {name: value if math.isfinite(value := of(run)) else None for name, run in runs.items()}

    return {
        "law": candidate.law,
        "offered": True,
        "parameters": dict(candidate.values),
        "drive_margin": candidate.margin and {**candidate.margin._asdict(), "with": candidate.where},
        "checked": covered
        and {
            "points": covered.points,
            "points_hz": [value / _TURN for value in covered.measured],
            "model_hz": [0.0, covered.highest / _TURN],
        },
        "feedback_delay": candidate.shortened,
        "largest_um": by_run(lambda run: run.largest * 1e6),
        "in_tolerance_from": by_run(lambda run: run.settled),
        "effort": by_run(lambda run: run.effort),
    }


def _checked(covered: "Covered | None") -> str:
    """Return the frequencies at which a margin was evaluated, in words."""
    assert covered is not None, "the law is offered"
    model = f"model up to {covered.highest / _TURN:.4g} Hz"
    if not covered.points:
        return f"{model} alone; no measured points"
    low, high = (value / _TURN for value in covered.measured)
    return f"{covered.points} measured points from {low:.4g} to {high:.4g} Hz, {model}"


def _comment(best: "Candidate", made: "Design") -> str:
    """Return the ground of the scenario as its first lines."""
    margin = best.margin
    lines = [f"{best.law}: drive margin {margin} with {best.where}, of {len(made.drives)} drives"]
    lines += [f"checked with {_checked(best.covered)}"]
    if best.shortened is not None:
        lines += [f"feedback_delay {best.shortened} in place of {made.feedback_delay}, which is too long for this law"]
    return "".join(f"# {line}\n" for line in lines)


def _told(found: list["Candidate"], made: "Design", speeds: list[str], place: Path) -> Iterator["RenderableType"]:
    from lathe_rc.commands import tables

    offered = [each for each in found if each.margin is not None and not each.reason]
    columns: dict[str, Callable[[Candidate], str]] = {
        "law": lambda each: each.law,
        "margin": lambda each: f"{each.margin.error:.3g}" if each.margin else "",
        "error [µm]": lambda each: f"{each.nominal.largest * 1e6:.3g}",
        "worst [µm]": lambda each: f"{each.worst.largest * 1e6:.3g}",
        "other speed [µm]": lambda each: f"{each.other.largest * 1e6:.3g}" if len(speeds) > 1 else "-",
        "good from": lambda each: f"{each.settled:.0f}" if math.isfinite(each.settled) else "-",
        "effort": lambda each: f"{max(each.worst.effort, each.other.effort):.3g}",
    }
    yield tables.of_rows(offered, columns, left=1)
    yield from (f"not offered: {each.law}: {each.reason}" for each in found if each.reason)
    for each in offered:
        if each.shortened is not None:
            yield f"{each.law}: with feedback_delay = {each.shortened}; {made.feedback_delay} is too long for it"
    best = found[0]
    yield f"error: largest of the last 10 revolutions; worst: with the worst of {len(made.drives)} drives"
    yield f"speed: {'; other speed: '.join(speeds)}"
    yield f"margin: smallest of {len(made.drives)} drives and all measured points; with {best.where}"
    yield f"checked: {_checked(best.covered)}"
    if not math.isfinite(best.settled):
        yield "no law is in tolerance with every drive at both speeds: the first has the smallest error"
    for name, value in best.values.items():
        told = f"{value:.4g}" if isinstance(value, float) else value
        yield f"{made.node}.{name}: {f'{len(value)} values' if isinstance(value, list) else told}"
    yield f"scenario: {place}; lathe run {place}"
