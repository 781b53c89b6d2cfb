# SPDX-License-Identifier: Apache-2.0
"""Drive models identified from a step response, and learning with each model's inverse (paper 000, Fig. 4).

The correction is the inverse of the model, 1/W0 = 1/W; for a delay, the inverse is a lead of T0, obtained by reading
the memory ahead. With the actual drive Wi this gives Z = Wi/W, and each learning cycle multiplies the error by Q - Z,
where Q = 1/(1 + (ω·q_time)²).
"""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from annotated_types import Ge, Gt, Le
from rich.console import Group

from lathe_machine.plants.electrodynamic import ElectrodynamicDrive
from lathe_papers import marks
from lathe_papers.formulas.responses import smoothing
from lathe_papers.formulas.step_fit import (
    Delay,
    FirstOrder,
    Model,
    SecondOrder,
    StepResponse,
    fit_delay,
    fit_first_order,
    fit_second_order,
    read_csv,
)
from lathe_rc.arrays import Array
from lathe_rc.cell.parameters import parameter
from lathe_rc.study import Study, StudyParameters, Track, comparison, untracked

if TYPE_CHECKING:
    from matplotlib.figure import Figure


_PRINTED = 2e-3  # T0 of eqs 18 and 19 in paper 000 [s]
_SAMPLES = 1000  # number of samples of the simulated response
_DECAY = 10.0  # duration of the simulated response in time constants
_FREQUENCIES = 20_001  # number of frequencies of Q - Z


class DriveModelsParameters(StudyParameters):
    """Parameters of the drive-model study: source of the step response, and settings of the controller."""

    file: str = parameter("", "measurement with time and response; empty: simulate the drive", path=True)
    natural_frequency: Annotated[float, Ge(50), Le(10_000)] = parameter(1038.0, "ωn of the simulated drive", "rad/s")
    damping: Annotated[float, Ge(0.05), Le(10)] = parameter(0.804, "damping ratio ζ of the simulated drive")
    delay: Annotated[float, Ge(0), Le(0.1)] = parameter(0.36e-3, "delay τ of the simulated drive", "s")
    nominal_rpm: Annotated[float, Ge(10), Le(60_000)] = parameter(1000.0, "spindle speed", "1/min")
    waves: Annotated[int, Ge(1), Le(100)] = parameter(2, "harmonic of the profile, per revolution")
    points_per_revolution: Annotated[int, Ge(256), Le(65536)] = parameter(
        1024, "memory points; Q - Z is looked at up to half as many waves"
    )
    q_time: Annotated[float, Gt(0), Le(0.01)] = parameter(130e-6, "time constant of Q", "s")


@dataclass(frozen=True)
class Candidate:
    """Drive model with the learning behaviour of its inverse.

    Attributes:
        name: name of the model in words.
        model: model with its parameters.
        fitted: False for the parameters printed in the paper.
        rms: RMS residual against the measured response [1].
        factor: magnitude of Q - Z at the frequencies of the result, shape (m,).
        contraction: magnitude of Q - Z at the harmonic of the profile.
    """

    name: str
    model: FirstOrder | Delay | SecondOrder
    fitted: bool
    rms: float
    factor: Array
    contraction: float

    @property
    def supremum(self) -> float:
        """Supremum of the magnitude of Q - Z; learning converges if it is below 1."""
        return float(self.factor.max())

    def values(self) -> dict[str, float]:
        """Parameters of the model by name."""
        return asdict(self.model)

    def words(self) -> str:
        """Parameters of the model as a short text."""
        model = self.model
        if not isinstance(model, SecondOrder):
            return f"T0 {next(iter(self.values().values())) * 1e3:.4g} ms"
        delay = f", τ {model.delay * 1e3:.3g} ms" if model.delay else ""
        return f"ωn {model.natural_frequency:.4g} rad/s, ζ {model.damping:.3g}{delay}"

    def correction(self) -> str:
        """Inverse of the model as a formula in the model's parameters."""
        if isinstance(self.model, FirstOrder):
            return "1 + p·time_constant"
        lead = "e^(p·delay)"
        if isinstance(self.model, Delay):
            return lead
        inverse = "1 + 2·damping·p/natural_frequency + p²/natural_frequency²"
        return f"({inverse})·{lead}" if self.model.delay else inverse


@dataclass(frozen=True)
class DriveModelsResult:
    """Results of the drive-model study: response, models and learning behaviour.

    Attributes:
        parameters: parameters of the study.
        measured: step response.
        candidates: models with their learning behaviour.
        frequency: frequencies of Q - Z [rad/s], shape (m,).
    """

    parameters: DriveModelsParameters
    measured: StepResponse
    candidates: list[Candidate]
    frequency: Array

    @property
    def harmonic(self) -> float:
        """Frequency of the harmonic of the profile [rad/s]."""
        return _harmonic(self.parameters)

    def to_json(self) -> dict[str, Any]:
        """Return the results for JSON: the response, and for each model its step response and learning behaviour."""
        return {
            "file": self.parameters.file or None,
            "time_s": self.measured.time.tolist(),
            "measured": self.measured.response.tolist(),
            "harmonic_rad_s": self.harmonic,
            "models": [
                {
                    "name": candidate.name,
                    "fitted": candidate.fitted,
                    "parameters": candidate.values(),
                    "correction": candidate.correction(),
                    "rms": candidate.rms,
                    "step": candidate.model.step(self.measured.time).tolist(),
                    "contraction": candidate.contraction,
                    "supremum": candidate.supremum,
                    "supremum_rad_s": float(self.frequency[candidate.factor.argmax()]),
                    "converges": candidate.supremum < 1.0,
                }
                for candidate in self.candidates
            ],
        }

    def table(self) -> Group:
        """Return a table of the models beside the values printed in the paper."""
        rows = [
            (
                candidate.name + ("" if candidate.fitted else ", paper 000"),
                candidate.words(),
                f"{candidate.rms:.4f}",
                f"{candidate.contraction:.3f}",
                f"{candidate.supremum:.3f}" + ("" if candidate.supremum < 1.0 else " diverges"),
            )
            for candidate in self.candidates
        ]
        source = self.parameters.file or "the simulated drive"
        table = comparison(
            f"Step response of {source}, models, and learning with their inverses at {self.harmonic:.0f} rad/s",
            ("model", "parameters", "RMS", "|Q − Z|", "sup |Q − Z|"),
            rows,
        )
        return Group(table, "The inverse of a delay is a lead: the memory is read ahead by T0.")

    def draw(self, figure: "Figure") -> None:
        """Draw Fig. 4 of the paper with the fits, and Q - Z of each model."""
        steps, learning = figure.subplots(1, 2)
        steps.plot(self.measured.time * 1e3, self.measured.response, color="0.7", lw=3.5, label="measured")
        for k, candidate in enumerate(candidate for candidate in self.candidates if candidate.fitted):
            label = f"{candidate.name}: {candidate.words()}"
            response = candidate.model.step(self.measured.time)
            steps.plot(self.measured.time * 1e3, response, lw=1.2, label=label, **marks.curve(k))
            worst = f"{candidate.name}: sup {candidate.supremum:.3g}"
            learning.semilogx(self.frequency, candidate.factor, label=worst, **marks.curve(k))
        steps.set(xlabel="time since the step [ms]", ylabel="step response")
        learning.axhline(1.0, color="k", lw=0.8)
        learning.axvline(self.harmonic, color="k", lw=0.8, ls=":")
        learning.set(xlabel="ω [rad/s]", ylabel="|Q − Z|", ylim=(0.0, 2.5))
        learning.set_title("learning with the inverse (below 1: converges; dotted: the profile)", fontsize=10)
        steps.set_title("step response and fitted models", fontsize=10)
        for axes in (steps, learning):
            axes.grid(visible=True, alpha=0.3)
            axes.legend(fontsize=7)


def _harmonic(parameters: DriveModelsParameters) -> float:
    return parameters.waves * parameters.nominal_rpm * np.pi / 30.0


def _simulated(drive: SecondOrder) -> StepResponse:
    """Simulate a step test of the drive."""
    slowest = drive.natural_frequency * (drive.damping - np.sqrt(max(drive.damping**2 - 1.0, 0.0)))
    step = (drive.delay + _DECAY / slowest) / _SAMPLES
    machine = ElectrodynamicDrive(
        natural_frequency=drive.natural_frequency,
        damping=drive.damping,
        delay=drive.delay,
        stroke=np.inf,
        moving_mass=1.0,
        force_constant=1.0,
        step=step,
        method="foh",
    )
    position, velocity, current = np.empty((3, _SAMPLES))
    machine.block(np.ones(_SAMPLES), position, velocity, current)
    # The command rises linearly from sample -1 to sample 0, which on average is half a sampling step before sample 0.
    return StepResponse((np.arange(_SAMPLES) + 0.5) * step, position)


def run(parameters: DriveModelsParameters, track: Track = untracked) -> DriveModelsResult:
    """Fit the models to the step response and evaluate learning with their inverses.

    Raises:
        InputError: the file does not contain a step response.
    """
    drive = SecondOrder(parameters.natural_frequency, parameters.damping, parameters.delay)
    measured = read_csv(Path(parameters.file)) if parameters.file else _simulated(drive)
    delayed = fit_second_order(measured, delayed=True)
    models: list[tuple[str, FirstOrder | Delay | SecondOrder, bool]] = [
        ("first order", fit_first_order(measured), True),
        ("delay", fit_delay(measured), True),
        ("second order", fit_second_order(measured, delayed=False), True),
        ("second order with delay", delayed, True),
        ("first order", FirstOrder(_PRINTED), False),
        ("delay", Delay(_PRINTED), False),
    ]
    # The best fit is the best available model of a measured drive.
    true: Model = delayed if parameters.file else drive
    harmonic = _harmonic(parameters)
    highest = harmonic / parameters.waves * parameters.points_per_revolution / 2
    frequency = np.linspace(0.0, highest, _FREQUENCIES)
    candidates = []
    for name, model, fitted in track(models):
        at = np.append(frequency, harmonic)
        factor = np.abs(smoothing(at, parameters.q_time) - true.response(at) / model.response(at))
        candidates.append(Candidate(name, model, fitted, measured.rms(model), factor[:-1], float(factor[-1])))
    return DriveModelsResult(parameters, measured, candidates, frequency)


STUDY = Study(
    "drive-models",
    "models fitted to the drive's step response, and learning with each (000, Fig. 4, eqs 18-19)",
    DriveModelsParameters,
    run,
    size=(12.0, 4.2),
)
