# SPDX-License-Identifier: Apache-2.0
"""Command ``lathe fit drive``: gain, delay, second order, modes and lags of a drive from measurements."""

import csv
import glob
import io
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click
import numpy as np
import yaml
from rich.console import RenderableType
from rich.table import Table

from lathe_commission import drive_measurement, modal_fit
from lathe_commission.modal_fit import ModalFit, NoFitError, ResponseData, StepData, Structure
from lathe_machine.analysis.modal_drive import ModalDrive
from lathe_machine.stages.drive.electrodynamic_actuator import ElectrodynamicActuator
from lathe_rc import files
from lathe_rc.analysis import frequency_response
from lathe_rc.analysis.frequency_response import Hold
from lathe_rc.arrays import Array
from lathe_rc.commands import measured as measured_options
from lathe_rc.commands import options, picture, tables
from lathe_rc.errors import InputError, LatheError
from lathe_rc.signals.measurement_file import MeasuredQuantities

if TYPE_CHECKING:
    from matplotlib.figure import Figure


_TURN = 2.0 * np.pi
_NOTHING = 1e-6  # relative error of a model
_FAR_BETTER = 0.3  # error of a fit over that of the response as it is given
_ALIKE = 3  # structures whose BIC is printed
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
@click.argument("measured", type=options.PATH, nargs=-1, required=True)
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
    "--drives", type=click.IntRange(1, 4096), default=32, show_default=True, help="of the set, beside each fit"
)
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="of the set")
@click.option("-o", "--output", type=options.PATH, default=Path("drive.yaml"), show_default=True, help="parameter file")
@click.option("--figure", type=options.PATH, default=Path("fit-drive.png"), show_default=True)
@options.as_json
def drive(
    measured: tuple[Path, ...],
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
    """Gain, delay, second order, modes and lags of an electrodynamic drive (docs/drives.md).

    MEASURED is a bag, or a file (CSV, Parquet, .mat, TDMS, MDF) with time,response of a step of 1; with
    time,command,response of a record; or with frequency and magnitude,phase or real,imaginary. A unit may follow:
    time_ms, command_um. The parameters are those of the first one; the set of drives covers several, which may be
    measured in different states.
    """
    picture.check_place(figure)
    files.check_place("--output", output)
    found: list[_Measured] = []
    for path in measured:
        measurement = measured_options.opened(path, columns)
        data = drive_measurement.data(
            measurement, rate=rate, hold=hold, resolution=resolution, averages=averages, band=band
        )
        try:
            if isinstance(data, ResponseData):
                modal_fit.refuse_other_gain(data)
            fit = modal_fit.fit(data, modes=modes)
        except LatheError as error:
            if cure := _cure(measurement, data, modes, error):
                raise InputError(f"{path}: {cure}") from None
            if not isinstance(error, NoFitError):
                raise type(error)(f"{path}: {error}") from None
            _tell([*found, _Measured(path, measurement, data, error.fit)], {}, chosen=modes is None, as_json=as_json)
            raise LatheError(f"{path}: {error}; nothing is written") from None
        found.append(_Measured(path, measurement, data, fit))
    places = {"parameters": output, "drives": output.with_suffix(".drives.csv")}
    files.write(places["parameters"], _parameter_file(found[0].fit, found[0].comment))
    files.write(places["drives"], _drives_file([each for one in found for each in one.fit.drives(drives, seed)]))
    places |= _write_points(found, output)
    for number, one in enumerate(found, 1):
        place = figure if number == 1 else figure.with_stem(f"{figure.stem}-{number}")
        _draw(place, one.data, one.fit)
        places["figure" if number == 1 else f"figure-{number}"] = place
    _tell(found, places, chosen=modes is None, as_json=as_json)


class _Measured(NamedTuple):
    """Measurement of a drive with its fit."""

    path: Path
    measurement: MeasuredQuantities
    data: ResponseData | StepData
    fit: ModalFit

    @property
    def comment(self) -> str:
        """First line of the files."""
        return f"{self.path}: {_count(self.fit)}"


def _cure(measurement: MeasuredQuantities, data: ResponseData | StepData, modes: int | None, error: LatheError) -> str:
    """Return why the response is another one than that of position to command, and the cure; empty: it is not known."""
    if not isinstance(data, ResponseData):
        return ""
    record = "frequency" not in measurement
    limit = _FAR_BETTER * error.fit.model_error if isinstance(error, NoFitError) else np.inf
    if modal_fit.swapped(data, modes, limit):
        cure = measurement.swapped("command", "response") if record else "the position over the command"
        return f"the response is the inverse of that of a drive: command and position are swapped; allowed: {cure}"
    if not record and modal_fit.reversed_phase(data, modes, limit):
        turned = next((name for name in ("phase", "imaginary") if name in measurement), "")
        cure = measurement.negative(turned) if turned else "its conjugate"
        return f"the phase rises with frequency, in the convention exp(-jωt); allowed: exp(jωt) ({cure})"
    return ""


def _write_points(found: Sequence[_Measured], output: Path) -> dict[str, Path]:
    """Write the points of each response beside the parameters, in place of those of earlier fits; return the files."""
    for old in output.parent.glob(f"{glob.escape(output.stem)}.points*.csv"):
        if re.fullmatch(r"\.points(-\d+)?\.csv", old.name.removeprefix(output.stem)):
            old.unlink()
    places: dict[str, Path] = {}
    for one in found:
        if isinstance(one.data, ResponseData):
            name = f"points-{len(places) + 1}" if places else "points"
            places[name] = output.with_suffix(f".{name}.csv")
            uncertainty = _uncertainty(one.data, one.fit)
            frequency_response.write_points(places[name], _unsmoothed(one.data, one.fit), uncertainty, one.comment)
    return places


def _tell(found: Sequence[_Measured], places: dict[str, Path], *, chosen: bool, as_json: bool) -> None:
    """Print the results."""
    first, *further = (_summary(one.data, one.fit) for one in found)
    summary = {**first, "further": further, "files": {name: str(path) for name, path in places.items()}}
    text: list[RenderableType] = []
    for one in found:
        text += [f"{one.path}:"] if len(found) > 1 else []
        text += _told(one, chosen=chosen)
    text += (f"{name + ':':12}{path}" for name, path in places.items())
    tables.show(summary, text, as_json=as_json)


def _count(fit: ModalFit) -> str:
    return str(Structure.of(fit.drive))


def _parameter_file(fit: ModalFit, comment: str) -> str:
    tree = {f"/{_NODE}": {"ros__parameters": fit.drive.parameters()}}
    return f"# {comment}\n{yaml.safe_dump(tree, sort_keys=False, default_flow_style=None, width=1000)}"


def _drives_file(drives: Sequence[ModalDrive]) -> str:
    """Return the set of drives as cells of a sweep, see `lathe_explore.sweep.space.given`."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    rows = [drive.parameters() for drive in drives]
    names = dict.fromkeys(name for row in rows for name in row)
    writer.writerow(f"{_NODE}.{name}" for name in names)
    writer.writerows([row.get(name, []) for name in names] for row in rows)
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


def _summary(data: ResponseData | StepData, fit: ModalFit) -> dict[str, Any]:
    """Return the results as JSON, in SI units."""
    return {
        "parameters": fit.drive.parameters(),
        "standard_error": fit.errors.parameters(),
        "modes": len(fit.drive.mode_frequency),
        "bic": {str(structure): value for structure, value in fit.bic.items()},
        "model_error": fit.model_error,
        "averages": data.measured.averages if isinstance(data, ResponseData) else None,
        "left_out": list(data.measured.left_out) if isinstance(data, ResponseData) else None,
        "missed": _missed(data, fit) if isinstance(data, ResponseData) else None,
        "between_points": list(fit.unresolved),
    }


def _value(value: float, error: float, digits: int = 5) -> str:
    return f"{value:#.{digits}g} ± {error:.1g}"


def _sections(fit: ModalFit) -> Table:
    """Return a table of the second order, the modes and the lags of a drive."""
    drive, errors = fit.drive, fit.errors
    velocities = ["velocity"] if drive.mode_velocity else []
    table = tables.table("", "frequency [Hz]", "damping", "participation", *velocities, "delay [µs]", left=1)
    _, _, own, own_velocity = drive.sections[0]
    table.add_row(
        "drive",
        _value(drive.natural_frequency / _TURN, errors.natural_frequency / _TURN),
        _value(drive.damping, errors.damping, 4),
        f"{own:.4g}",
        *(f"{own_velocity:.4g}" for _ in velocities),
        _value(drive.delay * 1e6, errors.delay * 1e6),
    )
    for number, (mode, error) in enumerate(zip(drive.modes, errors.modes, strict=True), 1):
        shares = zip(mode[1 : 3 + len(velocities)], error[1:], strict=False)
        frequency = _value(mode[0] / _TURN, error[0] / _TURN)
        table.add_row(f"mode {number}", frequency, *(_value(value, off, 4) for value, off in shares))
    for number, ((time, share), (time_error, share_error)) in enumerate(zip(drive.lags, errors.lags, strict=True), 1):
        corner = 1.0 / (_TURN * time)
        table.add_row(f"lag {number}", _value(corner, corner * time_error / time), "", _value(share, share_error, 4))
    return table


_MISSED: Mapping[str, Callable[[Mapping[str, float]], str]] = {
    "octave [Hz]": lambda row: f"{row['from_hz']:.4g} to {row['to_hz']:.4g}",
    "largest residual [%]": lambda row: f"{100.0 * row['residual']:.3g}",
    "at [Hz]": lambda row: f"{row['frequency_hz']:.5g}",
    "noise [%]": lambda row: f"{100.0 * row['noise']:.2g}" if row["noise"] else "unknown",
    "RMS [%]": lambda row: f"{100.0 * row['rms']:.3g}",
}


def _told(one: _Measured, *, chosen: bool) -> Iterator[RenderableType]:
    """Yield the results of a measurement."""
    data, fit = one.data, one.fit
    if isinstance(data, ResponseData):
        measured = data.measured
        band = f"{measured.frequency[0] / _TURN:.4g} to {measured.frequency[-1] / _TURN:.4g} Hz"
        averages = f", {measured.averages:.3g} averages" if measured.averages else ""
        yield f"frequency response: {measured.frequency.size} points from {band}{averages}"
        yield from measured.left_out
    else:
        yield f"step response: {data.time.size} samples"
    yield _sections(fit)
    yield f"gain: {_value(fit.drive.gain, fit.errors.gain)}{_sign(one.measurement, fit.drive.gain)}"
    if chosen:
        near = sorted(fit.bic.items(), key=lambda pair: pair[1])[:_ALIKE]
        values = ", ".join(f"{structure}: {value - near[0][1]:.4g}" for structure, value in near)
        yield f"{_count(fit)}, chosen by BIC (above the least: {values})"
    yield from (f"{text}; its height there rests on the model alone" for text in fit.unresolved)
    if isinstance(data, ResponseData):
        yield tables.of_rows(_missed(data, fit), _MISSED, left=1)
        beyond = f"{100.0 * fit.model_error:.2g} % of the magnitude" if fit.model_error > _NOTHING else "none"
        yield f"error of the model beyond the noise: {beyond}"
    else:
        yield f"residual: {100.0 * fit.model_error:.3g} % of the step, RMS"


def _sign(measurement: MeasuredQuantities, gain: float) -> str:
    """Return a hint for a negative gain."""
    if gain > 0.0:
        return ""
    given = [name for name in ("response", "real", "imaginary", "magnitude") if name in measurement]
    cure = " ".join(measurement.negative(name) for name in given)
    return f" (negative: if the sensor is mounted the other way round, {cure})"


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
