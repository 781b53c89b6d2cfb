# SPDX-License-Identifier: Apache-2.0
"""Figure of a run: profile, form error over angle, and form error by revolution."""

import io
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.projections.polar import PolarAxes
from matplotlib.ticker import MaxNLocator

from lathe_rc.signals.form_errors import FormErrors

_FIRST, _LAST, _PEER = "#c0392b", "#1f6f8b", "#e08e0b"
_IN_NOTEBOOK = 72.0  # [dots per inch]


@dataclass(frozen=True)
class TurnedForm:
    """Form turned in a run.

    Attributes:
        angle: spindle angle [rad], shape (samples,).
        reference: desired radius deviation [m], shape (samples,).
        error: form error [m], shape (samples,).
        errors: form error by revolution; at least one.
        before: number of revolutions before the first one in ``errors``.
    """

    angle: np.ndarray
    reference: np.ndarray
    error: np.ndarray
    errors: FormErrors
    before: int

    def revolution(self, number: int) -> tuple[np.ndarray, slice]:
        """Return the angles within a revolution [°], and the slice of its samples."""
        starts = self.errors.starts[number : number + 2] if number >= 0 else self.errors.starts[-2:]
        span = slice(int(starts[0]), int(starts[1]))
        return np.rad2deg(np.mod(self.angle[span], 2 * np.pi)), span


class RunFigure(Figure):
    """Figure that a notebook can display without importing pyplot."""

    def _repr_png_(self) -> bytes:
        """Return a small PNG image for a notebook."""
        image = io.BytesIO()
        self.savefig(image, format="png", dpi=_IN_NOTEBOOK, metadata={"Software": None})
        return image.getvalue()


def draw(run: TurnedForm, title: str = "", beside: tuple[str, TurnedForm] | None = None) -> RunFigure:
    """Draw the desired form, and the form error over angle (first and last revolution) and by revolution.

    Args:
        run: form turned in the run.
        title: title of the figure.
        beside: name and form of another run of the same part, whose errors are drawn as well.

    Returns:
        A figure outside pyplot: ``savefig`` writes it, and notebooks display it.
    """
    errors = run.errors
    figure = RunFigure(figsize=(13, 4.4), layout="constrained")
    grid = figure.add_gridspec(1, 3, width_ratios=[1, 1.35, 1.35])
    figure.suptitle(title, fontsize=11)

    last = errors.rms.size - 1
    form = figure.add_subplot(grid[0], projection="polar")
    assert isinstance(form, PolarAxes)
    for number, colour, label in ((0, _FIRST, "first"), (last, _LAST, "last")):
        degrees, span = run.revolution(number)
        form.plot(
            np.deg2rad(degrees),
            run.reference[span] * 1e6,
            color=colour,
            lw=1.2,
            label=f"{label} revolution",
        )
    low, high = run.reference.min() * 1e6, run.reference.max() * 1e6
    size = high - low or 1.0  # a round part
    form.set_rlim(low - 1.2 * size, high + 0.1 * size)
    form.set_rlabel_position(75)
    form.set_yticks(np.linspace(low, high, 3).round())
    form.set_title("desired radius deviation [µm]", fontsize=10)
    form.tick_params(labelsize=8)
    form.legend(fontsize=7, loc="lower left", bbox_to_anchor=(-0.15, -0.15))

    over_angle = figure.add_subplot(grid[1])
    for number, colour in ((0, _FIRST), (last, _LAST)):
        degrees, span = run.revolution(number)
        label = f"revolution {run.before + number + 1}: {errors.rms[number] * 1e6:.3g} µm RMS"
        over_angle.plot(degrees, np.abs(run.error[span]) * 1e6, color=colour, lw=1.1, label=label)
    over_angle.set(
        xlabel="spindle angle [°]",
        ylabel="|form error| [µm]",
        xlim=(0, 360),
        xticks=range(0, 361, 60),
        yscale=_scale(errors),
    )
    over_angle.set_ylim(bottom=max(errors.largest[last] * 1e6 / 300, 1e-4))
    over_angle.set_title("form error over angle", fontsize=10)
    over_angle.grid(visible=True, which="major", alpha=0.3)
    over_angle.legend(fontsize=8, loc="center", bbox_to_anchor=(0.5, 0.6))

    curve = figure.add_subplot(grid[2])
    _by_revolution(curve, errors, run.before)
    curve.set_title("learning, revolution by revolution", fontsize=10)
    if beside is not None:
        _beside(over_angle, curve, *beside)
    return figure


def _beside(over_angle: Axes, curve: Axes, name: str, peer: TurnedForm) -> None:
    """Add the errors of another run: over the angle in its last revolution, and by revolution."""
    errors = peer.errors
    degrees, span = peer.revolution(-1)
    error = np.abs(peer.error[span]) * 1e6
    over_angle.plot(degrees, error, color=_PEER, lw=1.1, label=f"{name}: {errors.rms[-1] * 1e6:.3g} µm RMS")
    over_angle.set_ylim(top=over_angle.get_ylim()[1] * 30.0)  # room for the legend
    over_angle.legend(fontsize=8, loc="upper center")
    turns = np.arange(1, errors.rms.size + 1)
    curve.plot(turns, errors.rms * 1e6, ".-", color=_PEER, lw=1.0, ms=4, label=f"{name}, RMS")
    curve.legend(fontsize=8)


def learning(errors: FormErrors, before: int = 0) -> RunFigure:
    """Draw a small plot of the form error by revolution; ``before`` is the number of revolutions before the first."""
    figure = RunFigure(figsize=(5.0, 2.4), layout="constrained")
    _by_revolution(figure.subplots(), errors, before)
    return figure


def _scale(errors: FormErrors) -> str:
    """Choose the scale of an error axis: linear if an error is zero, which a logarithmic axis cannot show."""
    return "log" if errors.rms.all() else "linear"


def _by_revolution(axes: Axes, errors: FormErrors, before: int) -> None:
    revolutions = np.arange(before + 1, before + errors.rms.size + 1)
    axes.plot(revolutions, errors.largest * 1e6, ".-", color="#999999", lw=0.8, ms=4, label="largest")
    axes.plot(revolutions, errors.rms * 1e6, ".-", color=_LAST, lw=1.2, ms=5, label="RMS")
    axes.set(xlabel="revolution", ylabel="form error [µm]", yscale=_scale(errors))
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.grid(visible=True, which="both", alpha=0.25)
    axes.legend(fontsize=8)
