# SPDX-License-Identifier: Apache-2.0
"""Command group ``lathe fit``: models from measurements, with the parameters to set."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import click
import numpy as np

from lathe_commission import hysteresis_fit, reduced_order
from lathe_commission.commands.fit_drive import drive
from lathe_machine.control.decoupler import LAG
from lathe_machine.transfer import TransferFunction
from lathe_rc.analysis import frequency_response
from lathe_rc.commands import lossy, options, picture, tables
from lathe_rc.commands import measured as measured_options
from lathe_rc.errors import InputError, LatheError


@click.group()
def fit() -> None:
    """Fit models to measurements: a drive with its modes, a hysteresis loop, a channel."""


fit.add_command(drive)


@fit.command()
@measured_options.argument
@measured_options.columns
@click.option("--stroke", type=options.POSITIVE, default=15e-6, show_default=True, help="half-stroke of the drive [m]")
@click.option("--command", "command_topic", default="/fine/command", show_default=True, help="of a bag: topic")
@click.option("--state", "state_topic", default="/fine/state", show_default=True, help="of a bag: topic")
@options.as_json
def hysteresis(
    measured: Path, columns: tuple[str, ...], stroke: float, command_topic: str, state_topic: str, *, as_json: bool
) -> None:
    """Plays of Prandtl and Ishlinskii by least squares (docs/drives.md).

    MEASURED is a file with command,displacement, or a bag of a drive that ran with linearisation: none.
    """
    if measured.is_dir() and not columns:
        from lathe_rc.bag import reader
        from lathe_rc.cell.soundness import refuse_faults

        lossy.tell([measured])
        recording = reader.read_bag(measured)
        signals = [f"{command_topic}.position", f"{state_topic}.measured_position"]
        refuse_faults(signals, recording.events, measured)
        loop = hysteresis_fit.from_signals(recording.dense, command_topic, state_topic)
    else:
        loop = hysteresis_fit.of_measurement(measured_options.opened(measured, columns))
    found = hysteresis_fit.identify(loop, stroke)
    summary = {
        "identified_proportional": found.model.proportional,
        "identified_thresholds": found.model.thresholds.tolist(),
        "identified_weights": found.model.weights.tolist(),
        "offset_m": found.offset,
        "residual": found.residual,
    }
    text = [f"left by the fit: {100 * found.residual:.3g} % RMS; parameters of piezo_actuator:"]
    for name in ("identified_proportional", "identified_thresholds", "identified_weights"):
        values = ", ".join(f"{value:.6g}" for value in np.atleast_1d(summary[name]))
        text += [f"{name}: {values if np.ndim(summary[name]) == 0 else f'[{values}]'}"]
    tables.show(summary, text, as_json=as_json)


Model = reduced_order.Fit | reduced_order.ResponseFit


def _coefficients(transfer: TransferFunction) -> dict[str, list[float]]:
    return {"numerator": list(map(float, transfer.numerator)), "denominator": list(map(float, transfer.denominator))}


def _draw(path: Path, model: Model, inverse: reduced_order.Fit | None) -> None:
    """Draw both stages of paper 004: the model over the measurement, and model and inverse in series over the step."""
    from matplotlib.figure import Figure

    stages: list[tuple[Model, str, str]] = [(model, "model", "measured")]
    if inverse:
        stages.append((inverse, "channel and inverse in series", "step"))
    figure = Figure(figsize=(5.5 * len(stages), 3.6), layout="constrained")
    for axes, (found, title, wanted) in zip(figure.subplots(1, len(stages), squeeze=False)[0], stages, strict=True):
        for values, label, style in (
            (found.wanted, wanted, {"color": "#7f7f7f", "lw": 3.0}),
            (found.found, title, {"color": "#c0392b", "lw": 1.2}),
        ):
            if isinstance(found, reduced_order.ResponseFit):
                axes.loglog(found.frequency / (2.0 * np.pi), np.abs(values), label=label, **style)
            else:
                axes.plot(found.time, values, label=label, **style)
        response = isinstance(found, reduced_order.ResponseFit)
        axes.set(xlabel="frequency [Hz]" if response else "time [s]", title=f"{title}: RMS {found.rms:.3g}")
        axes.grid(visible=True, alpha=0.3)
        axes.legend(fontsize=8)
    picture.save(figure, path)


@fit.command()
@measured_options.argument
@measured_options.columns
@click.option("--zeros", type=click.IntRange(0, 8), default=0, show_default=True, help="degree of the numerator")
@click.option("--poles", type=click.IntRange(1, 8), default=2, show_default=True, help="beside an integrator")
@click.option("--integrator", is_flag=True, help="the channel integrates")
@click.option("--lags", is_flag=True, help="no complex poles, as in paper 004")
@click.option("--phase-margin", type=click.FloatRange(1, 89), default=60.0, show_default=True, help="of the PID [°]")
@click.option("--gain-margin", type=click.FloatRange(min=1), default=3.0, show_default=True, help="of the PID [1]")
@click.option("--delay", type=click.FloatRange(min=0), default=1e-3, show_default=True, help="in the loop [s]")
@click.option("--dead-time", is_flag=True, help="the model has a delay too, which the PID meets beside --delay")
@click.option("--averages", type=options.POSITIVE, help="behind the coherence of a frequency response; default: 16")
@click.option("--lag", type=options.POSITIVE, help=f"least lag of the inverse [s]; default: {LAG:g}, or a step")
@click.option("--figure", type=options.PATH, default=Path("fit-channel.png"), show_default=True)
@options.as_json
def channel(
    measured: Path,
    columns: tuple[str, ...],
    zeros: int,
    poles: int,
    phase_margin: float,
    gain_margin: float,
    delay: float,
    averages: float | None,
    lag: float | None,
    figure: Path,
    *,
    integrator: bool,
    lags: bool,
    dead_time: bool,
    as_json: bool,
) -> None:
    """Reduced-order model, realisable inverse, and the fastest PID with the margins asked for (docs/force_position.md).

    MEASURED is a file with time,response: the response to a step of 1 at time 0, in even steps; or with
    frequency,magnitude,phase (or real,imaginary). A unit may follow: time_ms. A model without an inverse or a PID is
    printed all the same, with the reason, and exit code 1.
    """
    measurement = measured_options.opened(measured, columns)
    orders: dict[str, Any] = {"zeros": zeros, "poles": poles, "integrator": integrator, "oscillating": not lags}
    model: Model
    if "frequency" in measurement:
        model = reduced_order.fit_response(
            frequency_response.of_measurement(measurement, averages), **orders, delayed=dead_time
        )
        given = model.step()
    else:
        given = reduced_order.of_measurement(measurement)
        model = reduced_order.fit(given, **orders, delayed=dead_time)
        given = reduced_order.without_delay(given, model.delay)  # a delay has no inverse
    summary: dict[str, Any] = {"model": _coefficients(model.transfer) | {"rms": model.rms, "delay": model.delay}}
    inverse: reduced_order.Fit | None = None
    missing = []
    try:
        inverse = reduced_order.fit_inverse(model.transfer, given, least_lag=lag or max(LAG, given.step))
        summary["inverse"] = _coefficients(inverse.transfer) | {"rms": inverse.rms}
    except InputError as error:
        missing.append(str(error))
    try:
        summary |= _tuned(model.transfer, np.radians(phase_margin), gain_margin, delay + model.delay)
    except InputError as error:
        missing.append(str(error))
    _draw(figure, model, inverse)
    summary["figure"] = str(figure)
    summary = {"inverse": None, "pid": None, "loop": None, **summary, "missing": missing}
    tables.show(summary, _told(summary, delay + model.delay), as_json=as_json)
    if missing:
        raise LatheError(f"{measured}: {'; '.join(missing)}")


def _tuned(model: TransferFunction, phase_margin: float, gain_margin: float, delay: float) -> dict[str, Any]:
    """Return the fastest PID with margins [rad] and [1] at a delay [s], and its loop.

    Raises:
        InputError: there is no such PID.
    """
    from lathe_machine.analysis import pid_tuning  # SciPy's optimisers take a second

    corners = np.abs(model.poles)
    corners = corners[corners > 0.0]
    band = (float(corners.min()) / 10.0, float(corners.max()) * 10.0)
    gains = pid_tuning.fastest(model, band=band, phase_margin=phase_margin, gain_margin=gain_margin, wait=delay)
    loop = pid_tuning.evaluate(model, gains, delay)
    return {
        "pid": {
            "proportional": gains.proportional,
            "integral": gains.integral,
            "derivative": gains.derivative,
            "derivative_filter": gains.filter,
        },
        "loop": {
            "rise_s": loop.rise,
            "settling_s": loop.settling,
            "overshoot_pct": 100.0 * loop.overshoot,
            "gain_margin": loop.gain_margin if np.isfinite(loop.gain_margin) else None,
            "phase_margin_deg": float(np.degrees(loop.phase_margin)),
            "crossover_rad_s": loop.phase_frequency,
        },
    }


def _told(summary: Mapping[str, Any], delay: float) -> Iterator[str]:
    for name in ("model", "inverse"):
        if found := summary[name]:
            top, bottom = (", ".join(f"{value:.5g}" for value in found[part]) for part in ("numerator", "denominator"))
            delayed = f", delay {found['delay']:.4g} s" if found.get("delay") else ""
            yield f"{name:8} [{top}] / [{bottom}]{delayed}, RMS {found['rms']:.3g}"
    if loop := summary["loop"]:
        yield "pid      " + ", ".join(f"{name} {value:.5g}" for name, value in summary["pid"].items())
        margin = "any" if loop["gain_margin"] is None else f"{loop['gain_margin']:.3g}"
        yield (
            f"loop     rise {loop['rise_s']:.3g} s, settling {loop['settling_s']:.3g} s, "
            f"overshoot {loop['overshoot_pct']:.3g} %, margins {margin} and {loop['phase_margin_deg']:.3g}° "
            f"with a delay of {delay * 1e3:g} ms"
        )
    yield f"figure:  {summary['figure']}"
