# SPDX-License-Identifier: Apache-2.0
"""Table of paper 001: steady error of four structures for a unit harmonic (printed, analytic and simulated).

The simulation runs the cells of ``config/``, one harmonic per run, with a whole number of waves per revolution.
"""

from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from annotated_types import Ge, Gt, Le
from rich.console import Group

from lathe_papers import cells, marks
from lathe_papers.formulas.structures import contraction, direct_compensation, iterative, supremum
from lathe_papers.formulas.tuning import FREQUENCIES, HIGHEST, LEAD_LAG, PLAIN, PRINTED, ROWS, TuningParameters
from lathe_rc import messages
from lathe_rc.arrays import Array, Complex
from lathe_rc.cell.parameters import parameter
from lathe_rc.study import Study, StudyParameters, Track, comparison, untracked

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from rich.console import RenderableType


SCENARIOS = ("one_channel", "direct_compensation", "two_coarse", "two_channel")  # in the order of the table
_TUNINGS = {"none": PLAIN, "lead_lag": LEAD_LAG}
_SLOWEST = 500.0  # [rad/s] approximate spindle speed: the frequencies of the table are its first four harmonics
_AMPLITUDE = 10e-6  # [m], within the stroke of the piezo


class MultichannelParameters(StudyParameters):
    """Parameters of the multichannel study: frequencies and resolution of the simulation."""

    omega: list[Annotated[float, Gt(0), Le(20_000)]] = parameter(FREQUENCIES.tolist(), "frequencies", "rad/s")
    samples_per_revolution: Annotated[int, Ge(64), Le(16_384)] = parameter(
        1024, "points of the memory per revolution; the sample rate is the nearest that gives as many samples"
    )
    correction: Literal["none", "lead_lag"] = parameter("none", "lead_lag: (1 + pT1)/(1 + pT2) in both channels")
    cycles: Annotated[int, Ge(20), Le(5000)] = parameter(400, "revolutions that are simulated", "rev")


@dataclass(frozen=True)
class MultichannelResult:
    """Results of the multichannel study: amplitudes of the steady error, shape (4, n) each.

    Attributes:
        parameters: parameters of the study.
        printed: values printed in the paper; NaN for columns that the paper lacks.
        analytic: values of the formulas with continuous responses.
        simulated: values in the last simulated revolution.
        rates: sample rate of each column [Hz].
    """

    parameters: MultichannelParameters
    printed: Array
    analytic: Array
    simulated: Array
    rates: list[int]

    def to_json(self) -> dict[str, Any]:
        """Return the results for JSON: the table, and the convergence of both channels."""
        tuning = _TUNINGS[self.parameters.correction]
        omega = np.array(self.parameters.omega)
        peaks = [
            supremum(channel.factor, highest)
            for channel, highest in zip((tuning.coarse, tuning.fine), HIGHEST, strict=True)
        ]
        return {
            "omega": self.parameters.omega,
            "structures": list(ROWS),
            "printed": [[None if np.isnan(value) else value for value in row] for row in self.printed.tolist()],
            "analytic": self.analytic.tolist(),
            "simulated": self.simulated.tolist(),
            "cycles": self.parameters.cycles,
            "sample_rate": self.rates,
            "sup_q_minus_z": {"coarse": float(peaks[0].magnitude), "fine": float(peaks[1].magnitude)},
            "contraction": {
                name: contraction(channel.q(omega), channel.z(omega)).tolist()
                for name, channel in (("coarse", tuning.coarse), ("fine", tuning.fine))
            },
        }

    def table(self) -> Group:
        """Return a table of printed, analytic and simulated values, and their differences."""
        columns = ("", *(f"{omega:g} rad/s" for omega in self.parameters.omega))
        tables: list[RenderableType] = []
        for row, name in enumerate(ROWS):
            printed, analytic, simulated = self.printed[row], self.analytic[row], self.simulated[row]
            lines = [
                ("printed", *("" if np.isnan(value) else f"{value:.1e}" for value in printed)),
                ("analytic", *(f"{value:.3e}" for value in analytic)),
                (
                    "  against printed",
                    *("" if np.isnan(p) else f"{a / p - 1:+.1%}" for a, p in zip(analytic, printed, strict=True)),
                ),
                ("simulated", *(f"{value:.3e}" for value in simulated)),
                ("  against analytic", *(f"{s / a - 1:+.2%}" for s, a in zip(simulated, analytic, strict=True))),
            ]
            tables += [comparison(f"{row + 1}. {name}", columns, lines), ""]
        return Group(*tables[:-1])

    def draw(self, figure: "Figure") -> None:
        """Draw the error against frequency: formula as a line, simulation as dots, printed values as crosses."""
        axes = figure.subplots()
        frequency = np.geomspace(min(self.parameters.omega) / 2, max(self.parameters.omega) * 2, 400)
        smooth = np.abs(analytic(_TUNINGS[self.parameters.correction], frequency))
        for row, name in enumerate(ROWS):
            mark = marks.point(row)
            axes.loglog(frequency, smooth[row], color=mark["color"], lw=1.2, label=f"{name}: formula")
            axes.loglog(self.parameters.omega, self.simulated[row], ls="", ms=6, label="  simulated", **mark)
            axes.loglog(self.parameters.omega, self.printed[row], "x", color="black", ms=9)
        axes.plot([], [], "x", color="black", label="printed in paper 001")
        axes.set(xlabel="frequency of the profile [rad/s]", ylabel="steady error of a unit harmonic")
        axes.grid(visible=True, which="both", alpha=0.25)
        axes.legend(fontsize=7)


def analytic(tuning: TuningParameters, frequency: Array) -> Complex:
    """Return the ratio of steady error to profile for the four structures at ``frequency`` [rad/s], shape (4, n)."""
    coarse, fine = tuning.coarse.steady_error(frequency), tuning.fine.steady_error(frequency)
    direct = direct_compensation(coarse, tuning.fine.drive(frequency))
    return np.stack((coarse, direct, iterative(coarse, coarse), iterative(coarse, fine)))


def _nodes(structure: str, tuning: TuningParameters, correction: str) -> dict[str, dict[str, object]]:
    """Return the parameters of drives and controllers of a structure."""
    fine = tuning.coarse if structure == "two_coarse" else tuning.fine

    def controller(channel: Any) -> dict[str, object]:
        lead, lag = channel.lead_lag
        return {
            "lead_time": channel.lead_time,
            "q_time": channel.q_time,
            "correction": correction,
            "lead_lag_lead": lead,
            "lead_lag_lag": lag,
        }

    def drive(channel: Any) -> dict[str, object]:
        return {"natural_frequency": channel.natural_frequency, "damping": channel.damping}

    # The study assumes the linear structure, without the limits of the coarse drive.
    nodes = {
        "learning_controller": controller(tuning.coarse),
        "electrodynamic_actuator": {**drive(tuning.coarse), "max_velocity": 1e3, "max_acceleration": 1e6},
    }
    if structure in ("two_coarse", "two_channel"):
        nodes["fine_controller"] = controller(fine)
    if structure != "one_channel":
        nodes["fine_actuator" if structure == "two_coarse" else "piezo_actuator"] = drive(fine)
    return nodes


def sample_rate(samples_per_revolution: int, speed: float) -> int:
    """Return the sample rate [Hz] nearest to ``samples_per_revolution`` at ``speed`` [rad/s].

    The sampling step is a whole number of nanoseconds.
    """
    wanted = samples_per_revolution * speed / (2 * np.pi)
    rates = [rate for rate in range(1000, 1_000_001) if 1_000_000_000 % rate == 0]
    return min(rates, key=lambda rate: abs(np.log(rate / wanted)))


def _simulate(structure: str, omega: float, parameters: MultichannelParameters) -> float:
    waves = max(round(omega / _SLOWEST), 1)
    speed = omega / waves
    rate = sample_rate(parameters.samples_per_revolution, speed)
    samples = 2 * np.pi / speed * rate
    delay = int(samples / 2)
    nodes = _nodes(structure, _TUNINGS[parameters.correction], parameters.correction)
    for name in nodes:
        if name.endswith("controller"):
            nodes[name] |= {"points_per_revolution": parameters.samples_per_revolution, "feedback_delay": delay}
    form = "profile" if structure == "direct_compensation" else "tool"
    nodes[form] = {
        "profile": "harmonics",
        "harmonic_order": [waves],
        "harmonic_amplitude": [_AMPLITUDE],
        "feed": 0.0,
    }
    nodes["spindle_encoder"] = {"revolutions": float(parameters.cycles)}
    shared = {"sample_rate": rate, "block_size": min(64, delay), "nominal_rpm": speed * 30 / np.pi}
    result = cells.run(structure, shared, **nodes)
    last = slice(*result.errors.starts[-2:])
    angle = result.recording.of_type(messages.ENCODER)["angle_true"][last]
    error = result.recording.of_type(messages.TOOL)["error"][last]
    basis = np.stack((np.cos(waves * angle), np.sin(waves * angle), np.ones(angle.size)), axis=1)
    found = np.linalg.lstsq(basis, error)[0]
    return float(np.hypot(found[0], found[1]) / _AMPLITUDE)


def run(parameters: MultichannelParameters, track: Track = untracked) -> MultichannelResult:
    """Compute the steady errors by formula and by simulation."""
    omega = np.array(parameters.omega)
    printed = np.full((len(ROWS), omega.size), np.nan)
    for column, frequency in enumerate(omega):
        found = np.flatnonzero(np.isclose(FREQUENCIES, frequency))
        if found.size:
            printed[:, column] = PRINTED[:, found[0]]
    simulated = np.empty_like(printed)
    for row, column in track(list(product(range(len(ROWS)), range(omega.size)))):
        simulated[row, column] = _simulate(SCENARIOS[row], float(omega[column]), parameters)
    speeds = omega / np.maximum(np.rint(omega / _SLOWEST), 1)
    rates = [sample_rate(parameters.samples_per_revolution, float(speed)) for speed in speeds]
    formula = np.abs(analytic(_TUNINGS[parameters.correction], omega))
    return MultichannelResult(parameters, printed, formula, simulated, rates)


STUDY = Study(
    "multichannel",
    "steady errors of one- and two-channel structures, printed, analytic and simulated (001, table)",
    MultichannelParameters,
    run,
    size=(8.0, 5.5),
)
