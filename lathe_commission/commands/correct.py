# SPDX-License-Identifier: Apache-2.0
"""Command ``lathe correct``: programmed form of the next part, from records of finished parts."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import click
import numpy as np
from rich.console import RenderableType

from lathe_commission import form_correction, part_record
from lathe_commission.form_correction import Alignment, Correction, MeasuredRevolution
from lathe_machine.signals.profile import Profile
from lathe_machine.stages.tool.form import FormParameters
from lathe_rc import messages
from lathe_rc.analysis import profile_csv
from lathe_rc.arrays import Complex
from lathe_rc.bag import reader
from lathe_rc.cell.parameters import judged
from lathe_rc.cell.scenario import Scenario
from lathe_rc.cell.soundness import FORM, fields_of, refuse_faults
from lathe_rc.commands import completers, lossy, measured, options, tables
from lathe_rc.commands import scenario as scenarios
from lathe_rc.errors import InputError, LatheError
from lathe_rc.files import check_place
from lathe_rc.judge import part
from lathe_rc.signals.quantities import parse_columns

_TURN = 2.0 * np.pi
_ANGLES = _TURN * np.arange(1024) / 1024  # of the file
_ROWS, _LEFT = 8, 2  # corrected and other harmonics in the table
_BAG_REVOLUTIONS = 10  # of a bag, the last ones
_LATE = 1e-3  # [rev] after the begin of a complete revolution at most comes the first reading of all
_LEAST_CORRELATION = 0.5  # of a record with the form
_LARGEST_SCALE = 3.0  # of the form in a record, and its inverse: others are in another unit
_LARGEST_MEAN = 1e-3  # [m] of a record: larger ones are radii
_ROUNDNESS = 2  # lowest harmonic of a record without size and centre


class _Forms(NamedTuple):
    """Forms of a scenario.

    Attributes:
        node: node whose programmed form is corrected.
        desired: form of the drawing.
        programmed: form that its controllers have followed so far.
    """

    node: str
    desired: Profile
    programmed: Profile


def _forms(scenario: Scenario, node: str | None) -> _Forms:
    """Return the forms of a scenario; ``node``: whose programmed form is corrected, None: the owner of the form."""
    tables = {name: table for name, table in scenario.nodes.items() if isinstance(table, FormParameters)}
    owner = next((name for name, table in tables.items() if table.known()), None)
    if owner is None:
        raise InputError(f"{scenario.name} has no form to correct; allowed: a scenario with a tool")
    corrected = node or owner
    if corrected not in tables:
        raise InputError(f"--node {corrected}: no form of its own; allowed: {', '.join(tables)}")
    desired = tables[owner].form(owner)
    programmed = tables[corrected].programmed_form(corrected)
    return _Forms(corrected, desired, programmed or tables[corrected].form(corrected))


def _of_bag(path: Path, last: int, topic: str | None) -> list[MeasuredRevolution]:
    """Return the newest complete revolutions that a gauge of a recorded cell has read: form errors [m]."""
    recording = reader.read_bag(path)
    states = [name for name in recording.dense if recording.types[name] == messages.STATE]
    topics = [name for name in states if (name == topic if topic else name.endswith("gauge/reading"))]
    if topic and not topics:
        raise InputError(f"--topic {topic}: not in {path}; allowed: readings of a gauge, of {', '.join(states)}")
    if not topics or messages.ENCODER not in recording.types.values():
        raise InputError(f"{path}: no readings of a gauge; allowed: a bag of a cell with a gauge, or CSV, or X3P")
    if len(topics) > 1:
        raise InputError(f"{path}: readings of {len(topics)} gauges; allowed: --topic with one of {', '.join(topics)}")
    encoder = next(name for name in recording.dense if recording.types[name] == messages.ENCODER)
    read = {f"{topics[0]}.measured_position", f"{topics[0]}.effort", f"{encoder}.angle"}
    refuse_faults(read | fields_of(recording.types, FORM), recording.events, path)
    reading, angle = recording.dense[topics[0]], recording.of_type(messages.ENCODER)["angle"]
    there, turn = reading["effort"] > 0.0, np.floor(angle / _TURN).astype(int)
    begun, end = angle[there].min(initial=np.inf) / _TURN - _LATE, angle[-1] / _TURN - 1.0
    whole = [k for k in np.unique(turn[there]).tolist() if begun <= k < end]
    found = []
    for k in whole[-last:]:
        rows = there & (turn == k)
        # A positive error is missing material.
        found.append(MeasuredRevolution(np.mod(angle[rows], _TURN), -reading["measured_position"][rows]))
    if not found:
        raise InputError(f"{path}: the gauge has read no complete revolution; let it run longer")
    return found


class _Outlier(NamedTuple):
    """Reading that is left out: file, revolution from 1, angle of the record, and value."""

    record: str
    revolution: int
    angle_deg: float
    value_um: float


class _Read(NamedTuple):
    """Records, aligned.

    Attributes:
        deviations: desired less actual of each revolution of each record.
        alignments: by record.
        points: mean number of points of a revolution.
        left_out: readings that stand out, with their places.
    """

    deviations: list[list[Complex]]
    alignments: list[Alignment]
    points: float
    left_out: list[_Outlier]


def _clean(
    path: Path, revolutions: list[MeasuredRevolution], highest: int, left_out: list[_Outlier]
) -> list[MeasuredRevolution]:
    """Leave out readings that stand out (see `lathe_commission.form_correction.outliers`), and append them."""
    found = []
    for k, each in enumerate(revolutions, 1):
        places = form_correction.outliers(each.angle, each.radius, highest, f"{path}, revolution {k}")
        for place in places.tolist():
            angle, value = float(np.degrees(each.angle[place])), float(each.radius[place])
            left_out.append(_Outlier(str(path), k, angle, value * 1e6))
        found.append(replace(each, angle=np.delete(each.angle, places), radius=np.delete(each.radius, places)))
    return found


def _read(
    records: Sequence[Path],
    desired: Profile,
    *,
    columns: Sequence[str],
    highest: int,
    lowest: int,
    deviation: bool,
    reverse: bool,
    offset: float | None,
    search: float | None,
    height: float | None,
    last: int,
    topic: str | None,
) -> _Read:
    """Read the records and turn them to the part's angle; angles in degrees."""
    mapping = parse_columns(columns)
    if search is None:
        search = 180.0 if offset is None else 0.0
    around, within, sense = np.radians(offset or 0.0), np.radians(search), -1.0 if reverse else 1.0
    found, points = _Read([], [], 0.0, []), []
    for path in records:
        bag = measured.is_bag(path)
        if bag:
            measured.tell_origin(path)
        revolutions = _of_bag(path, last, topic) if bag else part_record.read(path, mapping)
        revolutions = _clean(path, revolutions, highest, found.left_out)
        points += [each.angle.size for each in revolutions]
        waves = [
            form_correction.harmonics(sense * each.angle, each.radius, highest, f"{path}, revolution {k}")
            for k, each in enumerate(revolutions, 1)
        ]
        mean = float(np.mean([each[0].real for each in waves]))
        if not lowest and abs(mean) > _LARGEST_MEAN:
            raise InputError(
                f"{path}: the mean radius is {mean * 1e3:.4g} mm; allowed: deviations from the radius of the "
                f"drawing up to {_LARGEST_MEAN * 1e3:g} mm, or --roundness, which leaves the size"
            )
        if bag or deviation:
            found.alignments.append(Alignment(around))
            found.deviations.append([-form_correction.turn(each, around, sense) for each in waves])
            continue
        heights = [_height(path, desired, each, height) for each in revolutions]
        forms = [form_correction.harmonics(_ANGLES, desired.deviation(_ANGLES, each), highest) for each in heights]
        for amplitudes in (*forms, *waves):
            amplitudes[:lowest] = 0.0
        try:
            aligned = form_correction.align(forms, waves, around, within, sense)
        except InputError as error:
            raise InputError(f"{path}: {error}") from None
        _check_likeness(path, aligned)
        found.alignments.append(aligned)
        found.deviations.append(
            [form - form_correction.turn(each, aligned.offset, sense) for form, each in zip(forms, waves, strict=True)]
        )
    return found._replace(points=float(np.mean(points)))


def _height(path: Path, desired: Profile, revolution: MeasuredRevolution, given: float | None) -> float:
    """Return the height of a revolution along the part [m]; ``given``: of a record without heights [mm]."""
    if revolution.height is not None:
        return revolution.height
    if given is None and desired.heights.size > 1:
        raise InputError(
            f"{path}: no heights, and the form changes along the part; allowed: --height, or a height column"
        )
    return (given or 0.0) * 1e-3


def _check_likeness(path: Path, aligned: Alignment) -> None:
    """Check that a record looks like the form, in shape and size."""
    if aligned.correlation < _LEAST_CORRELATION:
        raise InputError(
            f"{path}: the correlation with the form is {aligned.correlation:.3g}; allowed: {_LEAST_CORRELATION:g} or "
            "more (another --offset, --reverse, or --deviation for a record without the form)"
        )
    if not 1.0 / _LARGEST_SCALE < aligned.scale < _LARGEST_SCALE and not np.isnan(aligned.scale):
        raise InputError(
            f"{path}: the record is {aligned.scale:.3g} times the form; allowed: the right unit of the radius "
            "(--column radius=COLUMN:UNIT)"
        )


def _hidden(made: Correction, lowest: int, guard: float, scenario: Scenario) -> str:
    """Return a warning if noise may hide deviations above the tolerance; empty otherwise.

    Raises:
        LatheError: in addition, nothing is corrected.
    """
    most = guard * float(made.noise[lowest:].max())
    allowed = part.strictest(judged(scenario.nodes))
    if most <= allowed:
        return ""
    told = f"tolerance: ±{allowed * 1e6:.4g} µm" if allowed else "no tolerance"
    hides = f"the noise hides deviations up to {most * 1e6:.4g} µm in a harmonic, --guard times its noise ({told})"
    if not made.corrected.any():
        raise LatheError(
            f"nothing is corrected, and {hides}; no file written; allowed: a record with less noise, or of more "
            "revolutions or parts"
        )
    return hides


def _write(path: Path, programmed: Profile, change: Complex, comment: str) -> None:
    """Write the programmed form with its change as a profile file."""
    heights = programmed.heights
    radius = np.array([programmed.deviation(_ANGLES, float(height)) for height in heights])
    radius += form_correction.evaluate(change, _ANGLES)
    if heights.size > 1:
        profile_csv.write(path, radius, heights=heights, comment=comment)
    else:
        profile_csv.write(path, radius[0], comment=comment)


def _summary(found: _Read, made: Correction, records: Sequence[Path], forms: _Forms, output: Path) -> dict[str, Any]:
    """Return the result; lengths in µm, angles in degrees."""
    aligned = [
        {
            "record": str(path),
            "offset_deg": float(np.degrees(each.offset)) % 360.0,
            "correlation": None if np.isnan(each.correlation) else each.correlation,
            "revolutions": len(deviations),
        }
        for path, each, deviations in zip(records, found.alignments, found.deviations, strict=True)
    ]
    waves = [
        {
            "upr": n,
            "amplitude": float(abs(made.deviation[n])) * 1e6,
            "noise": float(made.noise[n]) * 1e6,
            "corrected": bool(made.corrected[n]),
            "change": float(abs(made.change[n])) * 1e6,
        }
        for n in range(made.noise.size)
    ]
    return {
        "records": aligned,
        "left_out": [each._asdict() for each in found.left_out],
        "node": forms.node,
        "unit": "um",
        "deviation": float(np.abs(form_correction.evaluate(made.deviation, _ANGLES)).max()) * 1e6,
        "change": float(np.abs(form_correction.evaluate(made.change, _ANGLES)).max()) * 1e6,
        "harmonics": waves,
        "file": str(output),
    }


_COLUMNS: Mapping[str, Callable[[Mapping[str, Any]], str]] = {
    "UPR": lambda wave: str(wave["upr"]),
    "deviation [µm]": lambda wave: f"{wave['amplitude']:.4g}",
    "noise [µm]": lambda wave: f"{wave['noise']:.3g}",
    "correction [µm]": lambda wave: (
        f"{wave['change']:.4g}" if wave["corrected"] else "in the noise" if wave["noise"] else "none"
    ),
}


def _told(summary: Mapping[str, Any]) -> Iterator[RenderableType]:
    for each in summary["records"]:
        how = "as given" if each["correlation"] is None else f"correlation {each['correlation']:.6f}"
        count = each["revolutions"]
        yield (
            f"{each['record']}: {count} revolution{'s' if count > 1 else ''}, angle 0 of the part at "
            f"{each['offset_deg']:.4g}° ({how})"
        )
    left_out = summary["left_out"]
    for each in left_out[:_ROWS]:
        yield (
            f"left out, since it stands out: {each['value_um']:.6g} µm at {each['angle_deg']:.6g}° in revolution "
            f"{each['revolution']} of {each['record']}"
        )
    if len(left_out) > _ROWS:
        yield f"and {len(left_out) - _ROWS} more: see --json"
    largest = sorted(summary["harmonics"], key=lambda wave: -wave["amplitude"])
    corrected = [wave for wave in largest if wave["corrected"]]
    shown = corrected[:_ROWS] + [wave for wave in largest if not wave["corrected"]][:_LEFT]
    yield tables.of_rows(sorted(shown, key=lambda wave: int(wave["upr"])), _COLUMNS)
    yield (
        f"{len(corrected)} of {len(largest)} harmonics corrected: up to {summary['change']:.4g} of "
        f"{summary['deviation']:.4g} µm"
    )
    yield f"next part: --set {summary['node']}.programmed_file={summary['file']}"


@click.command()
@click.argument("records", metavar="RECORD...", nargs=-1, required=True, type=options.PATH)
@click.option("--scenario", required=True, shell_complete=completers.scenarios, help="with the form of the part")
@click.option("-o", "--output", required=True, type=options.PATH, help="CSV file for the form of the next part")
@click.option("--node", help="node whose programmed form is corrected; default: that with the form")
@click.option(
    "--column",
    "columns",
    multiple=True,
    metavar="QUANTITY=COLUMN[:UNIT]",
    help="of a file of columns: angle, radius, height or revolution; repeatable; default: names with units, as "
    "angle_deg, radius_um, height_mm, revolution",
)
@click.option("--deviation", is_flag=True, help="the record is the deviation from the form, as lathe measure writes it")
@click.option("--reverse", is_flag=True, help="the record's angle runs against that of the spindle")
@click.option("--roundness", is_flag=True, help="the record knows neither size nor centre: from 2 UPR on")
@click.option("--offset", type=float, metavar="DEG", help="angle of the record at angle 0 of the part [°]")
@click.option(
    "--search",
    type=click.FloatRange(0, 180),
    metavar="DEG",
    help="search the offset by cross-correlation, so far to each side [°]; default: 0 with --offset, otherwise 180",
)
@click.option("--height", type=float, metavar="MM", help="along the part, of records without heights [mm]")
@click.option("--harmonics", "highest", type=click.IntRange(1, 500), default=50, show_default=True, help="highest UPR")
@click.option(
    "--cutoff", type=options.POSITIVE, metavar="UPR", help="of a Gaussian filter (ISO 16610-21) of the change"
)
@click.option(
    "--gain", type=click.FloatRange(0, 2, min_open=True), default=1.0, show_default=True, help="part corrected"
)
@click.option(
    "--guard", type=click.FloatRange(0), default=4.0, show_default=True, help="least amplitude over its noise"
)
@click.option(
    "--noise", type=options.POSITIVE, metavar="UM", help="RMS of white noise of a point [µm]; default: the scatter"
)
@click.option(
    "--last", type=click.IntRange(1), default=_BAG_REVOLUTIONS, show_default=True, help="revolutions of a bag"
)
@click.option("--topic", metavar="TOPIC", help="readings of the gauge in a bag; default: the only gauge/reading")
@options.overrides
@options.allow_code
@options.as_json
def correct(
    records: tuple[Path, ...],
    scenario: str,
    output: Path,
    node: str | None,
    highest: int,
    cutoff: float | None,
    gain: float,
    guard: float,
    noise: float | None,
    overrides: tuple[str, ...],
    *,
    roundness: bool,
    as_json: bool,
    **how: Any,
) -> None:
    """Correct the programmed form of the next part, from RECORDs of finished parts.

    A RECORD is a file of columns (CSV, Parquet, MATLAB, TDMS, MDF), an X3P file, or a bag of a cell with a gauge.
    Harmonics are corrected that stand out of the noise, which is the scatter between the revolutions and the records
    (docs/metrology.md).
    """
    check_place("--output", output)
    loaded = scenarios.load(scenario, overrides)
    forms = _forms(loaded, node)
    lowest = _ROUNDNESS if roundness else 0
    found = _read(records, forms.desired, highest=highest, lowest=lowest, **how)
    revolutions = sum(map(len, found.deviations))
    given = None
    if noise is not None:
        given = form_correction.white_noise(noise * 1e-6, round(found.points), revolutions, highest)
    made = form_correction.correction(
        found.deviations, lowest=lowest, gain=gain, guard=guard, cutoff=cutoff, noise=given
    )
    hidden = _hidden(made, lowest, guard, loaded)
    _write(
        output, forms.programmed, made.change, f"programmed form of the next part, from {', '.join(map(str, records))}"
    )
    summary = _summary(found, made, records, forms, output)
    if hidden:
        click.echo(f"warning: {hidden}", err=True)
    tables.show(summary, _told(summary), as_json=as_json)
    lossy.end(*filter(measured.is_bag, records))
