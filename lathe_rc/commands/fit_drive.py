# SPDX-License-Identifier: Apache-2.0
"""Command ``lathe fit drive``: delay, second order and modes of a drive from a measurement."""

import csv
import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np
import yaml

from lathe_rc import files
from lathe_rc.analysis import drive_measurement, frequency_response, modal_fit
from lathe_rc.analysis.frequency_response import Hold
from lathe_rc.analysis.modal_drive import ModalDrive
from lathe_rc.analysis.modal_fit import ModalFit, ResponseData, StepData
from lathe_rc.arrays import Array
from lathe_rc.cell.stages.electrodynamic_actuator import ElectrodynamicActuator
from lathe_rc.commands import measured as measured_options
from lathe_rc.commands import options, picture, tables
from lathe_rc.errors import InputError

if TYPE_CHECKING:
    from matplotlib.figure import Figure


_TURN = 2.0 * np.pi
_NOTHING = 1e-6  # relative error of a model
_OCTAVES = 8  # of the table of residuals; the last one has all that is below
_GREY, _RED, _BLUE = "#7f7f7f", "#c0392b", "#1f6f8b"
_NODE = ElectrodynamicActuator.kind


def _band(_ctx: click.Context, _option: click.Parameter, text: str | None) -> tuple[float, float] | None:
    """Parse a range of frequencies, ``LOW:HIGH`` in Hz; return it in rad/s."""
    if text is None:
        return None
    low, _, high = text.partition(":")
    try:
        band = (float(low) * _TURN, float(high) * _TURN)
    except ValueError:
        band = (0.0, 0.0)
    if not 0.0 <= band[0] < band[1]:
        raise InputError(f"--band {text!r}; allowed: LOW:HIGH in Hz, LOW below HIGH")
    return band


@click.command("drive")
@measured_options.argument
@measured_options.columns
@click.option("--rate", type=options.POSITIVE, help="sampling frequency of a record without time [Hz]")
@click.option(
    "--hold",
    type=click.Choice(["linear", "zero", "none"]),
    default="linear",
    show_default=True,
    help="command of a record between samples: linear as in the cell, held by a converter, or an analogue signal",
)
@click.option("--resolution", type=options.POSITIVE, help="distance of the bins of a record [Hz]")
@click.option("--averages", type=options.POSITIVE, help="behind the coherence of a response in a file; default: 16")
@click.option(
    "--band",
    callback=_band,
    metavar="LOW:HIGH",
    help="frequencies that count [Hz]; default: all, of a record up to 0.2 of its rate",
)
@click.option("--modes", type=click.IntRange(0, 24), help="number of modes; default: that of the least BIC")
@click.option(
    "--drives", type=click.IntRange(1, 4096), default=32, show_default=True, help="of the set, beside the fit"
)
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="of the set")
@click.option("-o", "--output", type=options.PATH, default=Path("drive.yaml"), show_default=True, help="parameter file")
@click.option("--figure", type=options.PATH, default=Path("fit-drive.png"), show_default=True)
@options.as_json
def drive(
    measured: Path,
    columns: tuple[str, ...],
    rate: float | None,
    hold: Hold,
    resolution: float | None,
    averages: float | None,
    band: tuple[float, float] | None,
    modes: int | None,
    drives: int,
    seed: int,
    output: Path,
    figure: Path,
    *,
    as_json: bool,
) -> None:
    """Delay, second order and modes of an electrodynamic drive (docs/drives.md).

    MEASURED is a bag, or a file (CSV, Parquet, .mat, TDMS, MDF) with time,response of a step of 1; with
    time,command,response of a record; or with frequency and magnitude,phase or real,imaginary. A unit may follow:
    time_ms, command_um.
    """
    picture.check_place(figure)
    files.check_place("--output", output)
    data = drive_measurement.data(
        measured_options.opened(measured, columns),
        rate=rate, hold=hold, resolution=resolution, averages=averages, band=band,
    )  # fmt: skip
    try:
        if isinstance(data, ResponseData):
            modal_fit.refuse_other_gain(data)
        fit = modal_fit.fit(data, modes=modes)
    except InputError as error:
        raise InputError(f"{measured}: {error}") from None
    places = {"parameters": output, "drives": output.with_suffix(".drives.csv")}
    if isinstance(data, ResponseData):
        places["points"] = output.with_suffix(".points.csv")
    comment = f"{measured}: {_count(fit)}"
    files.write(places["parameters"], _parameter_file(fit, comment))
    files.write(places["drives"], _drives_file(fit.drives(drives, seed)))
    if isinstance(data, ResponseData):
        frequency_response.write_points(places["points"], _unsmoothed(data, fit), _uncertainty(data, fit), comment)
    _draw(figure, data, fit)
    places["figure"] = figure
    if as_json:
        click.echo(json.dumps(_summary(data, fit, places)))
    else:
        _show(data, fit, places, chosen=modes is None)


def _count(fit: ModalFit) -> str:
    count = len(fit.drive.mode_frequency)
    return f"{count} {'mode' if count == 1 else 'modes'}"


def _parameter_file(fit: ModalFit, comment: str) -> str:
    tree = {f"/{_NODE}": {"ros__parameters": fit.drive.parameters()}}
    return f"# {comment}\n{yaml.safe_dump(tree, sort_keys=False, default_flow_style=None, width=1000)}"


def _drives_file(drives: Sequence[ModalDrive]) -> str:
    """Return the set of drives as cells of a sweep, see `lathe_rc.sweep.space.given`."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    rows = [drive.parameters() for drive in drives]
    writer.writerow(f"{_NODE}.{name}" for name in rows[0])
    writer.writerows(row.values() for row in rows)
    return text.getvalue()


def _uncertainty(data: ResponseData, fit: ModalFit) -> Array:
    """Return the relative uncertainty of the points: noise and error of the model, shape (n,)."""
    deviation = data.deviation(fit.drive, fit.model_error)[: data.measured.frequency.size]
    return np.asarray(deviation / np.abs(data.measured.value))


def _unsmoothed(data: ResponseData, fit: ModalFit) -> frequency_response.FrequencyResponse:
    """Return the measured points without the smoothing of their estimate, by the ratio of the model's responses."""
    measured = data.measured
    ratio = fit.drive.response(measured.frequency) / measured.smoothed(fit.drive.response)
    return frequency_response.FrequencyResponse(measured.frequency, measured.value * ratio, None, measured.coherence)


def _missed(data: ResponseData, fit: ModalFit) -> list[dict[str, float]]:
    """Return the largest relative residual of each octave, with the noise of the measurement there."""
    measured = data.measured
    model = measured.smoothed(fit.drive.response)
    residual = np.abs(measured.value - model) / np.abs(model)
    noise = np.zeros(residual.size) if measured.deviation is None else measured.deviation
    octave = np.maximum(np.floor(np.log2(measured.frequency / measured.frequency[-1]) - 1e-9), -_OCTAVES)
    rows = []
    for each in np.unique(octave):
        within = np.flatnonzero(octave == each)
        at = int(within[np.argmax(residual[within])])
        rows.append(
            {
                "from_hz": float(measured.frequency[within[0]] / _TURN),
                "to_hz": float(measured.frequency[within[-1]] / _TURN),
                "frequency_hz": float(measured.frequency[at] / _TURN),
                "residual": float(residual[at]),
                "noise": float(noise[at] * np.sqrt(2.0)),
                "rms": float(np.sqrt(np.mean(residual[within] ** 2))),
            }
        )
    return rows


def _summary(data: ResponseData | StepData, fit: ModalFit, places: dict[str, Path]) -> dict[str, Any]:
    """Return the results as JSON, in SI units."""
    return {
        "parameters": fit.drive.parameters(),
        "standard_error": fit.errors.parameters(),
        "modes": len(fit.drive.mode_frequency),
        "bic": list(fit.bic),
        "model_error": fit.model_error,
        "averages": data.measured.averages if isinstance(data, ResponseData) else None,
        "missed": _missed(data, fit) if isinstance(data, ResponseData) else None,
        "files": {name: str(path) for name, path in places.items()},
    }


def _show(data: ResponseData | StepData, fit: ModalFit, places: dict[str, Path], *, chosen: bool) -> None:
    """Print the results."""
    out = tables.console()
    if isinstance(data, ResponseData):
        measured = data.measured
        band = f"{measured.frequency[0] / _TURN:.4g} to {measured.frequency[-1] / _TURN:.4g} Hz"
        averages = f", {measured.averages:.3g} averages" if measured.averages else ""
        out.print(f"frequency response: {measured.frequency.size} points from {band}{averages}")
    else:
        out.print(f"step response: {data.time.size} samples")
    table = tables.table("", "frequency [Hz]", "damping", "participation", "delay [µs]", left=1)
    drive, errors = fit.drive, fit.errors

    def told(value: float, error: float, digits: int = 5) -> str:
        return f"{value:#.{digits}g} ± {error:.1g}"

    table.add_row(
        "drive",
        told(drive.natural_frequency / _TURN, errors.natural_frequency / _TURN),
        told(drive.damping, errors.damping, 4),
        f"{1.0 - sum(drive.mode_participation):.4g}",
        told(drive.delay * 1e6, errors.delay * 1e6),
    )
    for number, (mode, error) in enumerate(zip(drive.modes, errors.modes, strict=True), 1):
        table.add_row(
            f"mode {number}",
            told(mode[0] / _TURN, error[0] / _TURN),
            told(mode[1], error[1], 4),
            told(mode[2], error[2], 4),
            "",
        )
    out.print(table)
    if chosen:
        values = ", ".join(f"{count}: {value - min(fit.bic):.4g}" for count, value in enumerate(fit.bic))
        out.print(f"{_count(fit)}, chosen by BIC (above the least, by number of modes: {values})")
    if isinstance(data, ResponseData):
        missed = tables.table("octave [Hz]", "largest residual [%]", "at [Hz]", "noise [%]", "RMS [%]", left=1)
        for row in _missed(data, fit):
            missed.add_row(
                f"{row['from_hz']:.4g} to {row['to_hz']:.4g}",
                f"{100.0 * row['residual']:.3g}",
                f"{row['frequency_hz']:.5g}",
                f"{100.0 * row['noise']:.2g}" if row["noise"] else "unknown",
                f"{100.0 * row['rms']:.3g}",
            )
        out.print(missed)
        beyond = f"{100.0 * fit.model_error:.2g} % of the magnitude" if fit.model_error > _NOTHING else "none"
        out.print(f"error of the model beyond the noise: {beyond}")
    else:
        out.print(f"residual: {100.0 * fit.model_error:.3g} % of the step, RMS")
    for name, path in places.items():
        out.print(f"{name + ':':12}{path}")


def _draw(path: Path, data: ResponseData | StepData, fit: ModalFit) -> None:
    """Draw measurement, model and residual."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 7.0) if isinstance(data, ResponseData) else (7.0, 5.0), layout="constrained")
    if isinstance(data, ResponseData):
        _draw_response(figure, data, fit)
    else:
        _draw_step(figure, data, fit)
    for axes in figure.axes:
        axes.grid(visible=True, alpha=0.3)
        axes.legend(fontsize=8)
    picture.save(figure, path)


def _draw_response(figure: "Figure", data: ResponseData, fit: ModalFit) -> None:
    measured = data.measured
    frequency = measured.frequency / _TURN
    model = measured.smoothed(fit.drive.response)
    top, middle, bottom = figure.subplots(3, 1, sharex=True)
    delayed = np.exp(1j * measured.frequency * fit.drive.delay)
    for values, label, colour, width in (
        (measured.value, "measured", _GREY, 3.0),
        (model, f"model, {_count(fit)}", _RED, 1.2),
    ):
        top.loglog(frequency, np.abs(values), label=label, color=colour, lw=width)
        phase = np.degrees(np.unwrap(np.angle(values * delayed)))
        middle.semilogx(frequency, phase, label=label, color=colour, lw=width)
    residual = np.abs(measured.value - model) / np.abs(model)
    bottom.loglog(frequency, residual, color=_BLUE, lw=1.0, label="residual")
    if measured.deviation is not None:
        bottom.loglog(frequency, np.sqrt(2.0) * measured.deviation, color=_GREY, lw=1.0, label="noise")
    top.set(ylabel="magnitude")
    middle.set(ylabel="phase without the delay [°]")
    bottom.set(ylabel="relative to the model", xlabel="frequency [Hz]")


def _draw_step(figure: "Figure", data: StepData, fit: ModalFit) -> None:
    top, bottom = figure.subplots(2, 1, sharex=True)
    time = data.time * 1e3
    top.plot(time, data.response, color=_GREY, lw=3.0, label="measured")
    top.plot(time, fit.drive.step(data.time), color=_RED, lw=1.2, label=f"model, {_count(fit)}")
    bottom.plot(time, -data.residual(fit.drive), color=_BLUE, lw=1.0, label="residual")
    top.set(ylabel="step response")
    bottom.set(ylabel="residual", xlabel="time [ms]")
