# SPDX-License-Identifier: Apache-2.0
"""Command ``lathe design``: learning law for a measured drive, by its margin and the form error of its runs."""

import json
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from lathe_rc.commands import options
from lathe_rc.errors import InputError, LatheError

if TYPE_CHECKING:
    from lathe_rc.cell.design import Candidate
    from lathe_rc.cell.parameters import Values


@click.command()
@options.scenario
@click.option(
    "--drive",
    "measured",
    type=options.PATH,
    help="parameters of the drive as lathe fit drive writes them, with the set and the measured points "
    "beside it (FILE.drives.csv, FILE.points.csv)",
)
@click.option("--margin", type=click.FloatRange(0, 1), default=0.3, show_default=True, help="least drive margin [1]")
@options.overrides
@options.length
@click.option("-o", "--output", type=options.PATH, help="scenario with the best law; default: SCENARIO-designed.yaml")
@options.allow_code
@options.as_json
def design(
    scenario: str,
    measured: Path | None,
    margin: float,
    overrides: tuple[str, ...],
    revolutions: float | None,
    output: Path | None,
    *,
    as_json: bool,
) -> None:
    """Find the learning law of a SCENARIO for a measured drive (docs/learning.md).

    Each law runs offline with settings that keep the margin with every drive of the set, in place of the scenario's
    learning controller.
    """
    from lathe_rc import files
    from lathe_rc.analysis import frequency_response
    from lathe_rc.cell.design import Design
    from lathe_rc.commands import scenario as scenarios
    from lathe_rc.signals.measurement_file import read

    loaded = scenarios.load(scenario, overrides, revolutions=revolutions)
    place = output or Path(f"{loaded.name}-designed.yaml")
    files.check_place("--output", place)
    drives = _drives(measured) if measured else [{}]
    points = measured.with_suffix(".points.csv") if measured else None
    response = frequency_response.of_measurement(read(points, {})) if points and points.exists() else None
    made = Design(loaded, drives, margin, response)
    found = made.candidates(lambda law: click.echo(law, err=True) if sys.stderr.isatty() else None)
    best = found[0]
    reason = f"; the first reason: {made.refused}" if made.refused else ""
    if best.scenario is None:
        cure = "allowed: a smaller --margin, or another drive"
        raise LatheError(f"no law keeps a drive margin of {margin:g}; {cure}{reason}")
    if not math.isfinite(best.worst.largest):
        raise LatheError(f"no law runs with every drive{reason}")
    files.write(place, best.scenario.to_yaml(given=True))
    if as_json:
        rows = [_summary(each) for each in found]
        click.echo(json.dumps({"drives": len(drives), "laws": rows, "scenario": str(place)}))
    else:
        _show(found, len(drives), place, made.node)


def _drives(path: Path) -> list["Values"]:
    """Return the parameters of the nominal drive and of each drive of the set.

    Raises:
        InputError: a file cannot be read, or describes no electrodynamic drive.
    """
    from lathe_rc.cell import ros_yaml
    from lathe_rc.cell.stages.electrodynamic_actuator import ElectrodynamicActuatorParameters
    from lathe_rc.sweep import space

    nominal: list[Any] = [values for values in ros_yaml.read(path).values() if values]
    if len(nominal) != 1:
        raise InputError(f"{path}: {len(nominal)} nodes; allowed: the one that lathe fit drive writes")
    beside = path.with_suffix(".drives.csv")
    found: list[Any] = list(nominal)
    if beside.exists():
        of_set = [{target.rpartition(".")[2]: each[target] for target in each} for each in space.given(beside)]
        found += [each for each in of_set if each != nominal[0]]
    for values in found:
        if unknown := sorted(values.keys() - ElectrodynamicActuatorParameters.model_fields.keys()):
            raise InputError(f"{path}: {unknown[0]}; allowed: parameters of electrodynamic_actuator")
    return found


def _summary(candidate: "Candidate") -> dict[str, Any]:
    def finite(value: float) -> float | None:
        return value if math.isfinite(value) else None

    nominal, worst = candidate.nominal, candidate.worst
    return {
        "law": candidate.law,
        "parameters": dict(candidate.values),
        "drive_margin": candidate.margin._asdict() if candidate.margin else None,
        "largest_um": {"nominal": finite(nominal.largest * 1e6), "worst": finite(worst.largest * 1e6)},
        "in_tolerance_from": {"nominal": finite(nominal.settled), "worst": finite(worst.settled)},
        "effort": {"nominal": finite(nominal.effort), "worst": finite(worst.effort)},
    }


def _show(found: list["Candidate"], drives: int, place: Path, node: str) -> None:
    from lathe_rc.commands.tables import console, table

    out = console()
    rows = table("law", "margin", "error [µm]", "worst [µm]", "good from", "effort", left=1)
    for each in found:
        if each.margin is None:
            rows.add_row(each.law, *("-",) * 5)
            continue
        rows.add_row(
            each.law,
            f"{each.margin.error:.3g}",
            f"{each.nominal.largest * 1e6:.3g}",
            f"{each.worst.largest * 1e6:.3g}",
            f"{each.worst.settled:.0f}" if math.isfinite(each.worst.settled) else "-",
            f"{each.worst.effort:.3g}",
        )
    out.print(rows)
    out.print(
        f"error: largest of the last 10 revolutions; margin, worst, good from and effort: worst of {drives} drives"
    )
    for name, value in found[0].values.items():
        told = f"{value:.4g}" if isinstance(value, float) else value
        out.print(f"{node}.{name}: {f'{len(value)} values' if isinstance(value, list) else told}")
    out.print(f"scenario: {place}; lathe run {place}", soft_wrap=True)
