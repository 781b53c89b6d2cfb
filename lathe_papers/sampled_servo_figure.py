# SPDX-License-Identifier: Apache-2.0
"""Figs 2-4 of paper 003, with the motion of the drive between samples and with backlash."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from lathe_machine.control.sampled_link import ripple_free
from lathe_papers import marks
from lathe_papers.formulas import sampled_loop
from lathe_papers.formulas.sampled_loop import Measures
from lathe_papers.sampled_servo_numbers import DESIRED, numbers, stable
from lathe_rc.arrays import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from lathe_papers.sampled_servo_numbers import SampledServoNumbers


_SHOWN = 1.2  # time span of the step responses [s]


def _line(found: Sequence[Measures | None]) -> Array:
    """Return overshoot [%] and settling time [s] of several responses, NaN for None, shape (2, n)."""
    return np.asarray(np.array([numbers(one) for one in found], dtype=np.float64).T)


def draw(result: "SampledServoNumbers", figure: "Figure") -> None:
    """Draw Figs 2-4 with the simulated motion between samples, and the backlash."""
    (steps, gain, phase), (overshoot, settling, gap) = figure.subplots(2, 3)
    _draw_steps(result, steps)
    _draw_bode(result, gain, phase)
    _draw_table(result, overshoot, settling)
    _draw_gap(result, gap)
    for axes in (steps, gain, phase, overshoot, settling, gap):
        axes.grid(visible=True, alpha=0.3)
        axes.legend(fontsize=7, ncols=2 if axes in (overshoot, settling) else 1)


def _middle(result: "SampledServoNumbers") -> int:
    """Return the index of the period for figures with a single period: 0.16 s, or the nearest one."""
    return int(np.argmin(np.abs(np.array(result.parameters.t) - 0.16)))


def _draw_steps(result: "SampledServoNumbers", axes: "Axes") -> None:
    axes.plot(*result.analog, ":", color="black", label="analog")
    for k, (name, rows) in enumerate(result.all_links(), start=1):
        step = rows[_middle(result)].step
        if step is not None:
            axes.plot(step.time, step.motor, color=marks.COLOURS[k])
            axes.plot(*step.at_samples, ls="", ms=4, label=f"link: {name}", **marks.point(k))
    axes.set(xlim=(0.0, _SHOWN), xlabel="time [s]", ylabel="position / step")
    period = result.parameters.t[_middle(result)]
    axes.set_title(f"Fig. 2: step responses, T = {period:g} s; marks at the samples", fontsize=10)


def _draw_bode(result: "SampledServoNumbers", gain: "Axes", phase: "Axes") -> None:
    design = result.uncorrected[_middle(result)].design
    frequency = design.frequency
    drive = design.drive
    curves = [("Lp, no link", sampled_loop.pseudo_frequency(drive).response(frequency))]
    for number, function in enumerate(DESIRED, start=1):
        note = "" if stable(function) else " (unstable)"
        curves.append((f"Lж{number}, T = 0.16 s{note}", function.response(frequency)))
    ripple_free_loop = sampled_loop.open_loop(drive, ripple_free(drive))
    curves.append(("ripple-free link", np.asarray(ripple_free_loop(1j * frequency))))
    for k, (label, response) in enumerate(curves):
        # Each phase starts at -90° because of the integrator.
        angle = np.degrees(np.unwrap(np.angle(1j * response))) - 90.0
        gain.semilogx(frequency, 20.0 * np.log10(np.abs(response)), label=label, **marks.curve(k))
        phase.semilogx(frequency, angle, label=label, **marks.curve(k))
    gain.axhline(0.0, color="black", lw=0.6)
    phase.axhline(-180.0, color="black", lw=0.6)
    gain.set(xlabel="pseudo-frequency λ [rad/s]", ylabel="open loop [dB]")
    gain.set_title(f"Fig. 3: open loop, T = {drive.period:g} s", fontsize=10)
    phase.set(xlabel="pseudo-frequency λ [rad/s]", ylabel="phase [°]")
    phase.set_title("its phase", fontsize=10)


def _draw_table(result: "SampledServoNumbers", overshoot: "Axes", settling: "Axes") -> None:
    for half, colour in zip(sorted({row.half_period for row in result.rows}), marks.COLOURS * 10, strict=False):
        rows = [row for row in result.rows if row.half_period == half]
        ratios = [row.ratio for row in rows]
        for place, axes in ((0, overshoot), (1, settling)):
            axes.plot(
                ratios, _line([row.continuous for row in rows])[place], "-", color=colour, label=f"T/2 = {half:g} s"
            )
            axes.plot(ratios, _line([row.true for row in rows])[place], "--", color=colour)
            axes.plot(ratios, [row.printed[place] if row.printed else np.nan for row in rows], "o", ms=4, color=colour)
    for axes, name in ((overshoot, "overshoot [%]"), (settling, "settling [s]")):
        axes.plot([], [], "o", ms=4, color="gray", label="printed")
        axes.plot([], [], "-", color="gray", label="jλ read as p")
        axes.plot([], [], "--", color="gray", label="drive with its link")
        axes.set(xlabel="ρ = Te/(T/2)", ylabel=name)
        axes.set_title(f"Fig. 4: {name.split(' ')[0]} of the desired function", fontsize=10)
    # Room for the legend.
    overshoot.set_ylim(-5.0, 130.0)
    settling.set(yscale="log", ylim=(0.1, 60.0))


def _draw_gap(result: "SampledServoNumbers", axes: "Axes") -> None:
    links = (("paper", "paper's"), ("ripple_free", "ripple-free"))
    for (name, label), colour in zip(links, marks.COLOURS[2:], strict=False):
        row = result.links[name][_middle(result)]
        for step, style, place in ((row.load, "-", "load"), (row.motor, "--", "motor")):
            if step is not None:
                axes.plot(step.time, step.load, style, color=colour, label=f"{label}, measured at the {place}")
    axes.set(xlim=(0.0, _SHOWN), xlabel="time [s]", ylabel="load / step")
    axes.axhline(1.0, color="black", lw=0.6)
    axes.set_title(f"load behind a gap of {result.parameters.backlash:g}", fontsize=10)
