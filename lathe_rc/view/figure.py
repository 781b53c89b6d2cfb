# SPDX-License-Identifier: Apache-2.0
"""The figure of a run: profile, form error over angle, form error against revolution."""

from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.projections.polar import PolarAxes

from lathe_rc.analysis.metrology import FormErrors
from lathe_rc.cell import messages
from lathe_rc.cell.recording import Recording

_FIRST, _LAST = "#c0392b", "#1f6f8b"


def save(path: Path, recording: Recording, errors: FormErrors, title: str) -> None:
    """Draw the figure of a run into a PNG file."""
    encoder, tool = recording.of_type(messages.ENCODER), recording.of_type(messages.TOOL)
    figure = Figure(figsize=(13, 4.4), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(1, 3, width_ratios=[1, 1.35, 1.35])
    figure.suptitle(title, fontsize=11)

    def revolution(number: int) -> tuple[np.ndarray, slice]:
        span = slice(int(errors.starts[number]), int(errors.starts[number + 1]))
        return np.rad2deg(np.mod(encoder["angle_true"][span], 2 * np.pi)), span

    last = errors.rms.size - 1
    form = figure.add_subplot(grid[0], projection="polar")
    assert isinstance(form, PolarAxes)
    for number, colour, label in ((0, _FIRST, "first"), (last, _LAST, "last")):
        degrees, span = revolution(number)
        form.plot(
            np.deg2rad(degrees),
            tool["reference"][span] * 1e6,
            color=colour,
            lw=1.2,
            label=f"{label} revolution",
        )
    low, high = tool["reference"].min() * 1e6, tool["reference"].max() * 1e6
    form.set_rlim(low - 1.2 * (high - low), high + 0.1 * (high - low))
    form.set_rlabel_position(75)
    form.set_yticks(np.linspace(low, high, 3).round())
    form.set_title("desired radius deviation [µm]", fontsize=10)
    form.tick_params(labelsize=8)
    form.legend(fontsize=7, loc="lower left", bbox_to_anchor=(-0.15, -0.15))

    over_angle = figure.add_subplot(grid[1])
    for number, colour in ((0, _FIRST), (last, _LAST)):
        degrees, span = revolution(number)
        label = f"revolution {number + 1}: {errors.rms[number] * 1e6:.3g} µm RMS"
        over_angle.plot(degrees, np.abs(tool["error"][span]) * 1e6, color=colour, lw=1.1, label=label)
    over_angle.set(
        xlabel="spindle angle [°]",
        ylabel="|form error| [µm]",
        xlim=(0, 360),
        xticks=range(0, 361, 60),
        yscale="log",
    )
    over_angle.set_ylim(bottom=max(errors.largest[last] * 1e6 / 300, 1e-4))
    over_angle.set_title("form error over angle", fontsize=10)
    over_angle.grid(visible=True, which="major", alpha=0.3)
    over_angle.legend(fontsize=8, loc="center", bbox_to_anchor=(0.5, 0.6))

    curve = figure.add_subplot(grid[2])
    revolutions = np.arange(1, errors.rms.size + 1)
    curve.semilogy(revolutions, errors.largest * 1e6, ".-", color="#999999", lw=0.8, ms=4, label="largest")
    curve.semilogy(revolutions, errors.rms * 1e6, ".-", color=_LAST, lw=1.2, ms=5, label="RMS")
    curve.set(xlabel="revolution", ylabel="form error [µm]")
    curve.set_title("learning, revolution by revolution", fontsize=10)
    curve.grid(visible=True, which="both", alpha=0.25)
    curve.legend(fontsize=8)
    figure.savefig(path, dpi=130)
