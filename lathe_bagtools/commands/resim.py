# SPDX-License-Identifier: Apache-2.0
"""Command ``lathe resim``: re-simulation of a run from its recorded spindle, unchanged or with another controller."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import click
from rich.console import RenderableType
from rich.table import Table

from lathe_bagtools.resimulation import identify
from lathe_bagtools.resimulation.bag_spindle import asked_for
from lathe_bagtools.resimulation.identify import IdentifiedDrive
from lathe_bagtools.resimulation.resim import Resimulation, resimulate
from lathe_machine.analysis import drive_fit
from lathe_rc.bag import provenance
from lathe_rc.bag.reading.recorded import Recorded
from lathe_rc.bag.reading.source import BagSource
from lathe_rc.commands import lossy, options, tables
from lathe_rc.errors import InputError
from lathe_rc.names import pairs

_DIFFERENT = 1  # exit code if the results of an unchanged run differ from the recording
_UNITS = {"natural_frequency": ("rad/s", 1.0), "damping": ("1", 1.0), "delay": ("ms", 1e3)}  # unit and factor


def _table(found: Resimulation) -> Table:
    """Return a table of the recorded and the re-simulated form error."""
    rms, recorded = (of[: min(found.rms.size, found.recorded_rms.size)] * 1e6 for of in (found.rms, found.recorded_rms))
    columns = {
        "revolution": lambda k: str(found.turns_before + k + 1),
        "recorded": lambda k: f"{recorded[k]:#.4g}",
        "re-simulated": lambda k: f"{rms[k]:#.4g}",
        "ratio": lambda k: f"{rms[k] / recorded[k]:.3g}" if recorded[k] else "",
    }
    if found.between_rms.size:
        columns["positions differ by"] = lambda k: f"{found.between_rms[k] * 1e6:#.4g}"
    return tables.of_rows(tables.spread(rms.size), columns, title="form error, RMS [µm]")


def _drive_told(drive: IdentifiedDrive) -> Iterator[RenderableType]:
    """Yield the identified parameters beside those of the scenario, and the quality of the fit."""
    fit, before = drive.fit, drive.before
    columns: dict[str, Callable[[str], str]] = {
        "parameter": str,
        "unit": lambda name: _UNITS[name][0],
        "identified": lambda name: f"{fit.values[name] * _UNITS[name][1]:.6g}",
        "standard error": lambda name: f"{fit.errors[name] * _UNITS[name][1]:.2g}",
    }
    if before:
        columns["scenario"] = lambda name: f"{before[name] * _UNITS[name][1]:.6g}"
    title = f"{drive.node} from {drive.command} and {drive.position[0]}"
    yield tables.of_rows(drive_fit.PARAMETERS, columns, left=2, title=title)
    good = f"R² = {fit.r_squared:.8g}, NRMSE = {100.0 * fit.nrmse:.3g} %, residual {fit.residual_rms * 1e6:.3g} µm RMS"
    yield f"{good}; {fit.samples} samples, condition number {fit.condition:.3g}"
    if fit.vague:
        yield f"warning: the command hardly tells {' and '.join(fit.vague)} apart; record one that moves more"


def _drive_summary(drive: IdentifiedDrive) -> dict[str, Any]:
    """Return the JSON summary of a drive, in SI units."""
    fit = drive.fit
    return {
        "node": drive.node,
        "command": drive.command,
        "position": list(drive.position),
        "identified": dict(fit.values),
        "standard_error": dict(fit.errors),
        "linear_start": dict(fit.linear),
        "scenario": dict(drive.before) if drive.before else None,
        "r_squared": fit.r_squared,
        "nrmse": fit.nrmse,
        "residual_rms_m": fit.residual_rms,
        "condition": fit.condition,
        "vague": list(fit.vague),
        "samples": fit.samples,
    }


def _topics(given: Sequence[str]) -> dict[str, str]:
    allowed = "NAME=/TOPIC, like encoder=/spindle/encoder"
    found = pairs("--topic", [text.lstrip("/") for text in given], allowed)
    for name, topic in found.items():
        if not topic.startswith("/"):
            raise InputError(f"--topic {name}={topic}; allowed: {allowed}")
    return found


def _identified_alone(
    bag: Path, topics: Mapping[str, str], parameters: Path | None
) -> tuple[list[IdentifiedDrive], str]:
    """Identify the drives of a bag without a scenario; return them with the reason why the bag is not re-simulated."""
    with BagSource(bag) as source:
        recorded = Recorded(source, topics)
        recorded.check_names(["encoder", "tool", "coarse/command", "coarse/state"])
        found = identify.drives(recorded, None)
        if parameters:
            identify.write_parameters(parameters, None, found)
        return found, f"not re-simulated: {asked_for(recorded, identified=True)}"


def _has_scenario(bag: Path) -> bool:
    with BagSource(bag) as source:
        return provenance.SCENARIO in source.about


@click.command()
@options.bag
@options.of_targets("--set", "overrides", metavar="NODE.PARAM=VALUE", help="repeatable; not of the spindle")
@click.option("--controller", type=options.PATH, help="parameter file whose nodes replace the bag's")
@click.option("--scenario", type=options.PATH, help="parameter file in place of the bag's scenario")
@click.option(
    "--topic", multiple=True, metavar="NAME=/TOPIC", help="what the bag calls a topic of the cell; repeatable"
)
@click.option("--identify", "identified", is_flag=True, help="electrodynamic drives as the bag shows them")
@click.option("--write-parameters", type=options.PATH, help="file for the scenario, or the drive, found")
@click.option("--write-form", type=options.PATH, help="CSV file for the tool's position by angle")
@click.option("-o", "--output", type=options.PATH, help="folder of a bag for the result; must not exist")
@options.start_from
@options.allow_code
@options.as_json
@click.pass_context
def resim(
    ctx: click.Context,
    bag: Path,
    overrides: tuple[str, ...],
    controller: Path | None,
    scenario: Path | None,
    topic: tuple[str, ...],
    write_parameters: Path | None,
    write_form: Path | None,
    output: Path | None,
    start_from: Path | None,
    *,
    identified: bool,
    as_json: bool,
) -> None:
    """Run the cell of a BAG again with its recorded spindle; an unchanged cell must reproduce every recorded bit.

    A BAG without a scenario needs --scenario; its drive can be identified without one (docs/bags.md).
    """
    topics = _topics(topic)
    if write_form:
        _write_form(bag, topics, write_form, quiet=as_json)
    if identified and scenario is None and not _has_scenario(bag):
        if overrides or controller or output or start_from:
            raise InputError(
                "--set, --controller, --from and -o need a cell, and the bag holds no scenario; give --scenario FILE"
            )
        drives, rest = _identified_alone(bag, topics, write_parameters)
        summary = {"bag": str(bag), "drives": [_drive_summary(drive) for drive in drives], "asked_for": rest}
        tables.show(summary, [*_drives_told(drives, write_parameters), rest], as_json=as_json)
        lossy.end(bag)
        return
    found = resimulate(
        bag,
        overrides,
        scenario=scenario,
        controller=controller,
        topics=topics,
        identified=identified,
        parameters=write_parameters,
        output=output,
        start_from=start_from,
    )
    for warning in found.warnings:
        click.echo(f"lathe: warning: {warning}", err=True)
    wrong = bool(found.different) and not found.changed
    text = [*_drives_told(found.drives, write_parameters), *_told(found, output)]
    tables.show(_summary(found, bag, output), text, as_json=as_json)
    ctx.exit(_DIFFERENT if wrong else 0)


def _summary(found: Resimulation, bag: Path, output: Path | None) -> dict[str, Any]:
    return {
        "bag": str(bag),
        "changed": found.changed,
        "equal": bool(found.recorded) and not found.different,
        "different": found.different,
        "not_recorded": found.missing,
        "drives": [_drive_summary(drive) for drive in found.drives],
        "first_sample": found.first,
        "simulated_s": found.simulated_s,
        "wall_s": found.wall_s,
        "real_time_factor": found.simulated_s / found.wall_s,
        "rms_um": (found.rms * 1e6).tolist(),
        "recorded_rms_um": (found.recorded_rms * 1e6).tolist(),
        "positions": [list(position) for position in found.positions],
        "positions_differ_rms_um": (found.between_rms * 1e6).tolist(),
        "output": str(output) if output else None,
        "digest": dict(found.digest),
    }


def _drives_told(drives: Sequence[IdentifiedDrive], parameters: Path | None) -> Iterator[RenderableType]:
    for drive in drives:
        yield from _drive_told(drive)
    if parameters:
        yield f"parameters: {parameters}"


def _told(found: Resimulation, output: Path | None) -> Iterator[RenderableType]:
    if found.changed and min(found.rms.size, found.recorded_rms.size):
        yield _table(found)
    if found.positions:
        recorded = " + ".join(f"{topic} {name}" for topic, name in found.positions)
        yield f"recorded: {recorded}, against the scenario's form"
    elif not found.recorded:
        yield "the recording is not complete: nothing to compare the whole with"
    if found.recorded and not found.different:
        yield f"equal to the recording to the bit: {len(found.recorded)} topics, {found.samples} samples"
    elif found.recorded:
        yield f"different from the recording: {', '.join(found.different)}"
    factor = found.simulated_s / found.wall_s
    yield f"{found.simulated_s:.2f} s simulated in {found.wall_s:.2f} s: {factor:.1f}x real time"
    if output:
        yield f"bag: {output}"


def _write_form(bag: Path, topics: Mapping[str, str], path: Path, *, quiet: bool) -> None:
    """Write the recorded tool position as a function of the angle."""
    with BagSource(bag) as source:
        found = identify.form(Recorded(source, topics))
    identify.write_form(path, found)
    first, last = found.revolutions
    if not quiet:
        click.echo(
            f"form: {path}, the tool's position in revolutions {first} to {last}, which differ from it by "
            f"{found.scatter * 1e6:.4g} µm RMS"
        )
