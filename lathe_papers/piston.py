# SPDX-License-Identifier: Apache-2.0
"""Oval-barrel piston turned with the four structures of paper 001: remaining form error, analytic and simulated.

At a fixed height the profile is periodic, and each harmonic of the error is the profile's harmonic times the steady
error of the structure. With feed, the form changes from revolution to revolution, which a memory of one revolution
cannot anticipate, so this case is only simulated.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from annotated_types import Ge, Gt, Le
from rich.table import Table as RichTable

from lathe_machine.stages.tool.form import FormParameters
from lathe_papers import cells
from lathe_papers.formulas.tuning import PLAIN, ROWS
from lathe_papers.multichannel import SCENARIOS, analytic
from lathe_rc import messages
from lathe_rc.arrays import Array
from lathe_rc.cell.parameters import parameter
from lathe_rc.study import Study, StudyParameters, Track, comparison, untracked

if TYPE_CHECKING:
    from matplotlib.figure import Figure


_SETTLED = 50  # revolutions after which learning has settled
_POINTS = 1024  # points of the profile per revolution
_COLOURS = ("#c0392b", "#e08e0b", "#7d3c98", "#1f6f8b")
_UNITS = ((1.0, "µm"), (1e3, "nm"), (1e6, "pm"))  # of a figure, from µm


class PistonParameters(StudyParameters):
    """Parameters of the piston study: piston and turning conditions."""

    height_mm: Annotated[float, Ge(0), Le(60)] = parameter(0.0, "height along the skirt, from its end", "mm")
    feed_mm: Annotated[float, Gt(0), Le(1)] = parameter(0.1, "feed of the runs with feed", "mm/rev")
    rpm: Annotated[float, Ge(300), Le(1500)] = parameter(1000.0, "spindle speed", "1/min")
    cycles: Annotated[int, Ge(100), Le(400)] = parameter(200, "revolutions that are simulated", "rev")


@dataclass(frozen=True)
class PistonResult:
    """Results of the piston study: form errors of the last revolution by structure [µm].

    Attributes:
        parameters: parameters of the study.
        expected: error against the angle according to the formulas, shape (4, n).
        simulated: simulated error against the angle, shape (4, n).
        with_feed: largest and RMS error of the worst revolution after the first fifty, shape (4, 2).
    """

    parameters: PistonParameters
    expected: Array
    simulated: Array
    with_feed: Array

    def to_json(self) -> dict[str, Any]:
        """Return the largest and RMS errors for JSON."""
        found: dict[str, Any] = {"structures": list(ROWS)}
        for name, error in (("analytic", self.expected), ("simulated", self.simulated)):
            found[name] = {"max_um": np.abs(error).max(axis=1).tolist(), "rms_um": _rms(error).tolist()}
        found["with_feed"] = {"max_um": self.with_feed[:, 0].tolist(), "rms_um": self.with_feed[:, 1].tolist()}
        return found

    def table(self) -> RichTable:
        """Return a table with one row per structure; the paper expects a piezo to reduce the error tenfold or more."""
        rows = []
        for row, name in enumerate(ROWS):
            expected, simulated, feed = self.expected[row], self.simulated[row], self.with_feed[row]
            numbers = (np.abs(expected).max(), _rms(expected), np.abs(simulated).max(), _rms(simulated), *feed)
            texts = [f"{value:.2g}" for value in numbers]
            rows.append((name, *(" / ".join(texts[k : k + 2]) for k in (0, 2, 4))))
        columns = ("largest / RMS [µm]", "formula", "run", "run with feed")
        return comparison("Form error of the oval-barrel piston after learning", columns, rows)

    def draw(self, figure: "Figure") -> None:
        """Draw the error against the angle, by formula and by simulation."""
        degrees = np.arange(_POINTS) * 360 / _POINTS
        for row, (axes, name) in enumerate(zip(figure.subplots(2, 2, sharex=True).flat, ROWS, strict=True)):
            factor, unit = next((each for each in _UNITS if np.ptp(self.simulated[row]) * each[0] > 1.0), _UNITS[-1])
            axes.plot(degrees, factor * self.simulated[row], color=_COLOURS[row], lw=2.5, alpha=0.5, label="run")
            axes.plot(degrees, factor * self.expected[row], color="black", lw=0.8, ls="--", label="formula")
            axes.set_title(name, fontsize=10)
            axes.set(ylabel=f"form error [{unit}]", xlim=(0, 360), xticks=range(0, 361, 60))
            axes.grid(visible=True, alpha=0.3)
            axes.legend(fontsize=7)
        figure.supxlabel("spindle angle [°]", fontsize=10)


def _rms(error: Array) -> Array:
    return np.asarray(np.sqrt(np.mean(error**2, axis=-1)))


def _form(parameters: PistonParameters) -> dict[str, object]:
    return {"profile": "piston", "feed": 0.0, "start_height": parameters.height_mm * 1e-3}


def _expected(parameters: PistonParameters) -> Array:
    form = FormParameters.read("piston", _form(parameters)).form("piston")
    angle = np.arange(_POINTS) * 2 * np.pi / _POINTS
    spectrum = np.fft.rfft(form.deviation(angle, parameters.height_mm * 1e-3))
    responses = analytic(PLAIN, np.arange(spectrum.size) * parameters.rpm * np.pi / 30)
    return np.asarray(np.fft.irfft(spectrum * responses, _POINTS)) * 1e6


def _simulate(structure: str, parameters: PistonParameters, feed: float) -> tuple[Array, float, float]:
    place = "profile" if structure == "direct_compensation" else "tool"
    nodes: dict[str, cells.Values] = {
        place: {**_form(parameters), "feed": feed},
        "spindle_encoder": {"revolutions": float(parameters.cycles)},
        "learning_controller": {"feedback_delay": 2000},
    }
    if structure in ("two_coarse", "two_channel"):
        nodes["fine_controller"] = {"feedback_delay": 2000}
    result = cells.run(structure, {"nominal_rpm": parameters.rpm}, **nodes)
    last = slice(*result.errors.starts[-2:])
    angle = np.mod(result.recording.of_type(messages.ENCODER)["angle_true"][last], 2 * np.pi)
    error = result.recording.of_type(messages.TOOL)["error"][last] * 1e6
    grid = np.arange(_POINTS) * 2 * np.pi / _POINTS
    settled = slice(_SETTLED, None)
    worst = result.errors.largest[settled].max() * 1e6, result.errors.rms[settled].max() * 1e6
    return np.interp(grid, angle, error, period=2 * np.pi), *worst


def run(parameters: PistonParameters, track: Track = untracked) -> PistonResult:
    """Compute the form errors of the piston by formula and by simulation."""
    expected, simulated, with_feed = _expected(parameters), np.empty((len(ROWS), _POINTS)), np.empty((len(ROWS), 2))
    for row, structure in enumerate(track(SCENARIOS)):
        simulated[row], _, _ = _simulate(structure, parameters, 0.0)
        _, *with_feed[row] = _simulate(structure, parameters, parameters.feed_mm * 1e-3)
    return PistonResult(parameters, expected, simulated, with_feed)


STUDY = Study(
    "piston",
    "form error of the oval-barrel piston in the four structures, analytic and simulated (001)",
    PistonParameters,
    run,
    size=(11.0, 6.0),
)
