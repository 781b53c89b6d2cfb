# SPDX-License-Identifier: Apache-2.0
"""Coupled force and position loops of paper 004, with and without the compensators K1 and K2 (Figs 4 and 6-17).

Poles are computed from the linear system, and all time series from the simulation with limits at the paper's step of
50 µs. Printed values are shown beside the values computed from the paper's parameters; no parameter is fitted to them.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import control
import numpy as np
from rich.console import Group

from lathe_commission.reduced_order import ChannelStep, Fit, fit, fit_inverse, step_of
from lathe_machine.analysis.pid_tuning import TunedLoop, closed_loop, evaluate
from lathe_machine.control.decoupler import FULL_W1, gain
from lathe_machine.control.pid import FORCE, POSITION, PidGains
from lathe_papers.decoupling_runs import (
    CROSS,
    Behaviour,
    Course,
    DecouplingParameters,
    behaviour,
    course,
    disturbance,
    rms,
    times,
)
from lathe_papers.formulas.coupled_loops import CONNECTIONS, loops, with_errors
from lathe_rc.study import Study, Track, comparison, untracked

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from rich.console import RenderableType

# Paper 004, Figs 11 and 12; the phase margin of the force loop reads 462 in the scan.
_PRINTED: Mapping[str, Mapping[str, float | None]] = {
    "force": {"rise_s": 0.0743, "settling_s": 0.211, "overshoot_pct": 5.9, "gain_margin_db": 16.2,
              "gain_margin_rad_s": 59.6, "phase_margin_deg": None, "crossover_rad_s": 16.4},
    "position": {"rise_s": 0.0335, "settling_s": 0.183, "overshoot_pct": 17.5, "gain_margin_db": 3.5,
                 "gain_margin_rad_s": 94.8, "phase_margin_deg": 49.1, "crossover_rad_s": 36.3},
}  # fmt: skip
_PRINTED_NOISE: Mapping[str, float] = {
    "force_disturbance_rms_n": 4.83, "force_error_rms_n": 2.57, "force_efficiency": 1.88,
    "position_disturbance_rms_mm": 0.0577, "position_error_rms_mm": 0.0082, "position_efficiency": 7.0,
    "position_error_coupled_mm": 0.0018, "position_error_alone_mm": 0.0032,
}  # fmt: skip
_ENTRY = 4.0  # simulated duration of an entry [s]
_FIT_STEP, _FIT_SPAN = 0.25e-3, 2.0  # step and span of the response for model fits [s]
_EXPECTED = {
    "paper": {"none": "+0.1 to +0.24", "k1": "stable", "k2": "diverges", "both": "stable"},
    "realistic": dict.fromkeys(CONNECTIONS, "stable"),
}
_CONNECTION_NAMES = {"none": "none", "k1": "K1", "k2": "K2", "both": "K1 and K2"}
_QUANTITIES = {
    "rise_s": "rise [s]",
    "settling_s": "settling [s]",
    "overshoot_pct": "overshoot [%]",
    "gain_margin_db": "gain margin [dB]",
    "gain_margin_rad_s": "  at [rad/s]",
    "phase_margin_deg": "phase margin [°]",
    "crossover_rad_s": "  at [rad/s]",
}
_NOISE_LABELS = {
    "force_disturbance_rms_n": "force: disturbance [N RMS]",
    "force_error_rms_n": "force: error [N RMS]",
    "force_efficiency": "force: efficiency",
    "position_disturbance_rms_mm": "position: deflection [mm RMS]",
    "position_static_deflection_mm": "  of which it is the mean [mm]",
    "position_error_rms_mm": "position: error [mm RMS]",
    "position_efficiency": "position: efficiency",
    "position_error_coupled_mm": "position: error after 2 s [mm RMS]",
    "position_error_alone_mm": "  position loop alone [mm RMS]",
}
_RED, _BLUE, _AMBER, _GREY = "#c0392b", "#1f6f8b", "#e08e0b", "#7f8c8d"


def numbers(loop: TunedLoop) -> dict[str, float | None]:
    """Return the key figures of a loop in the paper's units; None for missing values."""
    values = {
        "rise_s": loop.rise,
        "settling_s": loop.settling,
        "overshoot_pct": loop.overshoot * 100.0,
        "gain_margin_db": 20.0 * np.log10(loop.gain_margin),
        "gain_margin_rad_s": loop.gain_frequency,
        "phase_margin_deg": np.degrees(loop.phase_margin),
        "crossover_rad_s": loop.phase_frequency,
    }
    return {name: float(value) if np.isfinite(value) else None for name, value in values.items()}


@dataclass(frozen=True)
class DecouplingResult:
    """Results of the decoupling study: both loops, their robustness, and the fitted models.

    Attributes:
        parameters: parameters of the study.
        prompt, delayed: behaviour of both loops without and with the delay.
        robustness: largest real part of the poles with both compensators and one plant parameter off by 50 %.
        full: force loop alone with the full plant.
        uncompensated: entry and disturbance without K1 and K2.
        alone: position under the disturbance, with neither the force loop nor W4.
        entries: entry with a step and smooth entry, without disturbance.
        model, inverse: fitted model of the full W1 and its inverse, as in the two stages of the paper.
    """

    parameters: DecouplingParameters
    prompt: Behaviour
    delayed: Behaviour
    robustness: Mapping[str, float]
    full: TunedLoop
    uncompensated: Course
    alone: Course
    entries: tuple[Course, Course]
    model: Fit
    inverse: Fit

    def entry_numbers(self) -> dict[str, dict[str, float]]:
        """Return force overshoot [%] and largest position error [mm] of an entry with a step and of a smooth entry."""
        return {
            name: {
                "force_overshoot_pct": max(float(run.force.max()) / self.parameters.force - 1.0, 0.0) * 100.0,
                "position_error_mm": float(np.abs(run.position).max()) * 1e3,
            }
            for name, run in zip(("step", "smooth"), self.entries, strict=True)
        }

    def noise_numbers(self) -> dict[str, float]:
        """Return the noise results with both compensators, and those of the position loop alone."""
        alone = rms(self.alone.settled(self.alone.position)) * 1e3
        return {**self.prompt.noise_numbers(self.parameters.force), "position_error_alone_mm": alone}

    def to_json(self) -> dict[str, Any]:
        """Return all numbers for JSON, with the printed values beside them; deviations in N and m."""
        given = self.parameters
        uncompensated = self.uncompensated
        return {
            "preset": given.preset,
            "plant": given.plant,
            "stability": dict(self.prompt.stability),
            "robustness": dict(self.robustness),
            "single_loop": {
                "force": numbers(self.prompt.force),
                "position": numbers(self.prompt.position),
                "force_full_plant": numbers(self.full),
                "printed": _PRINTED,
            },
            "cross": {
                **self.prompt.peaks(),
                "position_step_m": given.position_step_um * 1e-6,
                "force_step_n": given.force_step,
            },
            "noise": {
                **self.noise_numbers(),
                "uncompensated_force_error_rms_n": rms(uncompensated.settled(uncompensated.force) - given.force),
                "uncompensated_position_error_rms_mm": rms(uncompensated.settled(uncompensated.position)) * 1e3,
                "printed": _PRINTED_NOISE,
            },
            "delay": {
                "delay_s": given.delay_ms * 1e-3,
                "stability": dict(self.delayed.stability),
                "single_loop": {"force": numbers(self.delayed.force), "position": numbers(self.delayed.position)},
                "cross": self.delayed.peaks(),
                "noise": self.delayed.noise_numbers(given.force),
            },
            "engagement": self.entry_numbers(),
            "reduced_order": {
                name: {
                    "numerator": list(map(float, found.transfer.numerator)),
                    "denominator": list(map(float, found.transfer.denominator)),
                    "rms": found.rms,
                }
                for name, found in (("model", self.model), ("inverse", self.inverse))
            },
        }

    def table(self) -> Group:
        """Return tables of computed values beside printed values."""
        return Group(
            self._stability_table(), "", self._loop_table(), "", self._cross_table(), "", self._noise_table(), "",
            self._model_table(),
        )  # fmt: skip

    def _stability_table(self) -> "RenderableType":
        worst = max(self.robustness, key=lambda name: self.robustness[name])
        rows = [
            (
                _CONNECTION_NAMES[name],
                _growth(value),
                _growth(self.delayed.stability[name]),
                _EXPECTED[self.parameters.preset][name],
            )
            for name, value in self.prompt.stability.items()
        ]
        rows.append((f"both, worst of ±50 %: {worst}", _growth(self.robustness[worst]), "", "stable"))
        return comparison(
            f"Largest real part of the poles [1/s], {self.parameters.preset} W3, {self.parameters.plant} W1",
            ("compensators", "no delay", f"{self.parameters.delay_ms:g} ms", "expected"),
            rows,
        )

    def _loop_table(self) -> "RenderableType":
        rows = []
        for title, loop, delayed, printed in (
            ("force", self.prompt.force, self.delayed.force, "force"),
            ("force, full plant", self.full, None, "force"),
            ("position", self.prompt.position, self.delayed.position, "position"),
        ):
            late = numbers(delayed) if delayed else {}
            for name, value in numbers(loop).items():
                there = _number(late[name]) if delayed else ""
                rows.append((f"{title}: {_QUANTITIES[name]}", _number(value), there, _number(_PRINTED[printed][name])))
        return comparison("Each loop alone", ("", "no delay", f"{self.parameters.delay_ms:g} ms", "paper 004"), rows)

    def _cross_table(self) -> "RenderableType":
        given = self.parameters
        labels = {
            "position_step_to_force": (f"{given.position_step_um:g} µm step → force [N]", 1.0),
            "force_step_to_position": (f"{given.force_step:g} N step → position [µm]", 1e-6),
        }
        rows = []
        for what, behaviour_ in (("", self.prompt), (f", {given.delay_ms:g} ms", self.delayed)):
            for name, (label, unit) in labels.items():
                before, after = behaviour_.peaks()[name].values()
                rows.append((label + what, f"{before / unit:.3g}", f"{after / unit:.3g}", f"{before / after:.1f} x"))
        return comparison(
            f"Largest deviation of the other loop within {CROSS:g} s", ("", "without", "with K1, K2", "less"), rows
        )

    def _noise_table(self) -> "RenderableType":
        given = self.parameters
        found, late = self.noise_numbers(), self.delayed.noise_numbers(given.force)
        rows = [
            (
                label,
                f"{found[name]:.3g}",
                f"{late[name]:.3g}" if name in late else "",
                _number(_PRINTED_NOISE.get(name)),
            )
            for name, label in _NOISE_LABELS.items()
        ]
        for name, entry in self.entry_numbers().items():
            rows.append((f"{name} entry: overshoot of the force [%]", f"{entry['force_overshoot_pct']:.2g}", "", ""))
            rows.append((f"{name} entry: largest position error [mm]", f"{entry['position_error_mm']:.2g}", "", ""))
        return comparison(
            f"Disturbance of the force at {given.force:g} N, and entry, with K1 and K2",
            ("", "no delay", f"{given.delay_ms:g} ms", "paper 004"),
            rows,
        )

    def _model_table(self) -> "RenderableType":
        times, zeros = (
            ", ".join(f"{-1.0 / root.real:.3f}" for root in np.roots(part))
            for part in (self.model.transfer.denominator, self.inverse.transfer.numerator)
        )
        lags = ", ".join(f"{-1e3 / pole.real:.2f}" for pole in self.inverse.transfer.poles)
        gain_ = self.model.transfer.numerator[-1] / self.model.transfer.denominator[-1] / 100.0
        return comparison(
            "Reduced order of the full W1 from its step response",
            ("", "fitted", "paper 004"),
            [
                ("gain [N/%]", f"{gain_:.2f}", "11.79"),
                ("time constants [s]", times, "0.170, 0.220"),
                ("RMS of the model [N/%]", f"{self.model.rms / 100.0:.3f}", ""),
                ("zeros of the inverse as time constants [s]", zeros, "0.170, 0.220"),
                ("lags of the inverse [ms]", lags, "1, 1"),
                ("RMS of model and inverse from the step", f"{self.inverse.rms:.3f}", ""),
            ],
        )

    def draw(self, figure: "Figure") -> None:
        """Draw Figs 11, 12, 4 and 14 of the paper, then steps, entry, disturbance and the reduced-order model."""
        panels = figure.subplots(3, 3)
        self._draw_single(panels[0, 0], panels[0, 1])
        self._draw_together(panels[0, 2])
        self._draw_cross(panels[1, 0], panels[1, 1])
        self._draw_entry(panels[1, 2])
        self._draw_noise(panels[2, 0], panels[2, 1])
        self._draw_model(panels[2, 2])
        for axes in panels.flat:
            axes.grid(visible=True, alpha=0.3)
            axes.legend(fontsize=7)
            axes.set_xlabel("time [s]")

    def _draw_single(self, force: "Axes", position: "Axes") -> None:
        time = np.linspace(0.0, 0.6, 1201)
        wait = self.parameters.delay_ms * 1e-3
        channels = loops(self.parameters.preset).channels
        for axes, plant, gains, late, colour, label in (
            (force, channels.w1, FORCE, 0.0, _GREY, "approximate plant"),
            (force, FULL_W1, FORCE, 0.0, _BLUE, "full plant"),
            (force, FULL_W1, FORCE, wait, _AMBER, f"full plant, {self.parameters.delay_ms:g} ms"),
            (position, channels.w2, POSITION, 0.0, _BLUE, "no delay"),
            (position, channels.w2, POSITION, wait, _AMBER, f"{self.parameters.delay_ms:g} ms"),
        ):
            style = "--" if late else "-"
            axes.plot(*control.step_response(closed_loop(plant, gains, late), time), style, color=colour, label=label)
        for axes, name in ((force, "force"), (position, "position")):
            overshoot = _PRINTED[name]["overshoot_pct"] or 0.0
            axes.axhline(1.0 + overshoot / 100.0, color="k", lw=0.8, ls=":", label=f"paper: peak {overshoot:g} %")
            axes.set_title(f"{name} loop alone, unit step (Fig. {12 if name == 'force' else 11})", fontsize=10)

    def _draw_together(self, axes: "Axes") -> None:
        for run, colour, label in ((self.uncompensated, _RED, "without"), (self.prompt.noise, _BLUE, "with K1, K2")):
            axes.plot(*run.curve(run.force), color=colour, lw=0.8, label=label)
        axes.set(ylabel="force [N]")
        axes.set_title("entry and disturbance, both loops (Figs 4, 14)", fontsize=10)

    def _draw_cross(self, force: "Axes", position: "Axes") -> None:
        given = self.parameters
        for number, (colour, label) in enumerate(((_RED, "without"), (_BLUE, "with K1, K2"))):
            run = self.prompt.position_step[number]
            force.plot(*run.curve(run.force), color=colour, lw=1.0, label=label)
            run = self.prompt.force_step[number]
            position.plot(*run.curve(run.position, 1e-6), color=colour, lw=1.0, label=label)
        force.set(ylabel="force [N]", xlim=(0.0, 1.5))
        force.set_title(f"position steps by {given.position_step_um:g} µm", fontsize=10)
        position.set(ylabel="position [µm]", xlim=(0.0, 1.5))
        position.set_title(f"force steps by {given.force_step:g} N", fontsize=10)

    def _draw_entry(self, axes: "Axes") -> None:
        for run, colour, label in zip(self.entries, (_AMBER, _BLUE), ("step entry", "smooth entry"), strict=True):
            axes.plot(*run.curve(run.force), color=colour, label=label)
        axes.axhline(self.parameters.force, color="k", lw=0.8, ls=":")
        axes.set(ylabel="force [N]", xlim=(0.0, 2.5))
        axes.set_title("entry with K1 and K2, no disturbance", fontsize=10)

    def _draw_noise(self, force: "Axes", position: "Axes") -> None:
        run, given = self.prompt.noise, self.parameters
        force.plot(*run.curve(run.disturbance), color=_GREY, lw=0.8, label="disturbance")
        force.plot(*run.curve(run.force - given.force), color=_BLUE, lw=0.8, label="control error")
        swing = float(np.abs(run.disturbance).max())
        force.set(ylabel="force [N]", ylim=(-1.3 * swing, 1.3 * swing))
        force.set_title("force (Figs 15, 16; k = 1.88 there)", fontsize=10)
        position.plot(*run.curve(run.deflection, 1e-6), color=_GREY, lw=0.8, label="deflection W3·F")
        position.plot(*run.curve(run.position, 1e-6), color=_BLUE, lw=0.8, label="control error")
        position.set(ylabel="position [µm]")
        position.set_title("position (Fig. 17; k = 7 there)", fontsize=10)

    def _draw_model(self, axes: "Axes") -> None:
        model, inverse = self.model, self.inverse
        scale = model.wanted[-1]
        axes.plot(model.time, model.wanted / scale, color=_GREY, lw=2.5, label="step response of the full W1")
        axes.plot(model.time, model.found / scale, color=_BLUE, lw=1.0, label="model of second order")
        axes.plot(inverse.time, inverse.found, color=_RED, lw=1.0, label="with the inverse after it")
        axes.set(xlim=(0.0, 1.5), ylabel="over the step")
        axes.set_title("reduced order (Figs 6-9)", fontsize=10)


def _growth(value: float) -> str:
    return f"{value:+.3f}" + (" diverges" if value >= 0.0 else "")


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.3g}"


def run(parameters: DecouplingParameters, track: Track = untracked) -> DecouplingResult:
    """Simulate both loops, with and without the delay, and fit the models of the full W1.

    Raises:
        InputError: the delay is not a whole number of samples.
    """
    noise = disturbance(parameters)
    prompt, delayed = (behaviour(parameters, wait, noise) for wait in track([0.0, parameters.delay_ms * 1e-3]))
    none, both = (loops(parameters.preset, parameters.plant, name) for name in ("none", "both"))
    # Without W4 and the force controller, the position loop acts alone and is deflected by the disturbance.
    off = PidGains(0.0, 0.0, 0.0, 1.0)
    uncoupled = replace(none, force=off, channels=replace(none.channels, w4=gain(0.0)))
    time = times(round(_FIT_SPAN / _FIT_STEP) + 1, _FIT_STEP)
    channel = ChannelStep(time, step_of(FULL_W1, time))
    model = fit(channel, zeros=0, poles=2, oscillating=False)
    return DecouplingResult(
        parameters=parameters,
        prompt=prompt,
        delayed=delayed,
        robustness={name: system.growth() for name, system in with_errors(both)},
        full=evaluate(FULL_W1, FORCE),
        uncompensated=course(none, parameters, parameters.seconds, force=parameters.force, noise=noise),
        alone=course(uncoupled, parameters, parameters.seconds, noise=noise),
        entries=(
            course(both, parameters, _ENTRY, force=parameters.force),
            course(both, parameters, _ENTRY, force=parameters.force, smooth=True),
        ),
        model=model,
        inverse=fit_inverse(model.transfer, channel),
    )


STUDY = Study(
    "decoupling",
    "force and position loop together, with and without the compensators K1 and K2 (004, Figs 4-17)",
    DecouplingParameters,
    run,
    size=(14.0, 10.0),
)
