# SPDX-License-Identifier: Apache-2.0
"""Disturbance-learning law for varying speed, force and drive.

The law feeds the form forward through the inverse of the drive in time, learns the drive's input disturbance over the
angle and reads it ahead, and compensates the rest with a disturbance observer. See
`lathe_machine.stages.learning.form_law` and `lathe_machine.control.disturbance`.
"""

from collections.abc import Callable, Iterable, Mapping
from functools import lru_cache
from itertools import product
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import numpy as np
from annotated_types import Ge, Gt, Le, Lt

from lathe_machine.control.angle_filter import AngleFilterTable, at, follow
from lathe_machine.control.disturbance import (
    DisturbanceTable,
    FormAhead,
    commanded,
    disturbance,
    fed_forward,
    forget,
    observed,
)
from lathe_machine.control.disturbance_memory import expected, loop_response, smoothing_response, with_gain
from lathe_machine.control.rational_fit import (
    ADOPTED,
    LEAST_DAMPING,
    LEAST_MARGIN,
    MOST_DAMPING,
    RATIONAL_BAND,
    SMOOTH,
    UNSAFE,
    UNSTABLE,
    damped,
    inverse_response,
    judge_of,
)
from lathe_machine.control.rational_inverse import RationalTable, rational_inverse, verdicts
from lathe_machine.stages.common.tables import made_of
from lathe_machine.stages.learning.form_law import FormLaw, FormLawParameters
from lathe_machine.stages.learning.law import Now
from lathe_rc import messages
from lathe_rc.analysis.cycle_factors import Response
from lathe_rc.arrays import Array, Complex
from lathe_rc.blocks.ports import Sparse
from lathe_rc.cell.parameters import NonNegative, Positive, Value, about, parameter
from lathe_rc.errors import InputError
from lathe_rc.jit import kernel

MODEL_ADOPTED, MODEL_REFUSED = "model adopted", "model refused"  #: events of the identification of fourth order
_WHY = {
    UNSTABLE: "it is not stable",
    SMOOTH: f"it has no resonance (damping of the zeros above {MOST_DAMPING:g})",
    UNSAFE: f"drive margin below {LEAST_MARGIN:g}",
}


class DisturbanceControllerParameters(FormLawParameters):
    """Inverse feed-forward of the form, a repetitive memory of the disturbance, a disturbance observer."""

    observer_bandwidth: NonNegative = parameter(4000.0, "bandwidth ωo of the disturbance observer; 0: none", "rad/s")
    learning_gain: Annotated[float, Ge(0), Lt(1)] = parameter(
        0.5, "part of what a revolution brings that the memory takes up in the long run; 0: there is no memory"
    )
    learned_waves: Annotated[float, Gt(0), Le(1000)] = parameter(
        60.0, "waves per revolution at which the filter S of what is learned has fallen to a half"
    )
    learning_bandwidth: Positive = parameter(8000.0, "bandwidth of what is learned", "rad/s")
    follows_speed: bool = parameter(default=True, doc="learn how the disturbance changes with the speed as well")
    points_per_revolution: Annotated[int, Ge(64), Le(65536)] = parameter(
        512, "points of the memory per revolution, a power of 2"
    )
    identify: bool = parameter(default=True, doc="identify damping and natural frequency of the drive")
    identification_bandwidth: Positive = parameter(
        1500.0, "bandwidth of its filters: above the profile's harmonics, below the noise", "rad/s"
    )
    identification_forgetting: Annotated[float, Ge(0), Lt(1)] = parameter(
        0.7, "weight that a revolution's measurements keep after the next"
    )

    inverse: Literal["second_order", "fourth_order"] = parameter(
        "second_order", "of the drive; fourth_order: with one resonance, which is identified unless identify is false"
    )
    inverse_bandwidth: Positive = parameter(
        RATIONAL_BAND, "bandwidth of its identification: about twice the highest frequency of the form", "rad/s"
    )
    model_denominator: list[float] = parameter(
        [],
        "drive model of fourth order: a1 to a4 of 1 + a1·p + ... + a4·p⁴; empty: that of second order at first",
        "s^k",
        drive="inverse.denominator",
    )
    model_numerator: list[float] = parameter([], "its b1 and b2 of 1 + b1·p + b2·p²", "s^k", drive="inverse.numerator")

    @property
    def late(self) -> float:
        """Delay of the drive and of the measured position [s]."""
        return self.model_delay + self.feedback_delay * self.step

    def make(self, node: str) -> DisturbanceTable:
        """Return the state before the first sample.

        Raises:
            InputError: the memory parameters are invalid.
        """
        points = self.points_per_revolution
        if points & (points - 1):
            raise InputError(f"{node}.points_per_revolution = {points}; allowed: a power of 2, 64 up to 65536")
        with about(node, "learned_waves"):
            model = (self.model_natural_frequency, self.model_damping, self.model_delay)
            return made_of(disturbance, self, model=model, rational=self._rational(node))

    def coefficients(self, node: str) -> Array:
        """Return a1 to a4, b1 and b2 of the model in use at first [s, s², s³, s⁴, s, s²], shape (6,).

        Raises:
            InputError: there are not as many, or B has roots that are not damped.
        """
        given = len(self.model_denominator), len(self.model_numerator)
        if self.inverse == "second_order" or given == (0, 0):
            return np.array([*self.second_order, 0.0, 0.0, 0.0, 0.0])
        if given != (4, 2):
            raise InputError(
                f"{node}.model_denominator and model_numerator have {given[0]} and {given[1]} coefficients; allowed: "
                "4 and 2, or none"
            )
        if not damped(found := np.array([*self.model_denominator, *self.model_numerator])):
            raise InputError(
                f"{node}.model_numerator = {self.model_numerator}: zeros that are not damped, or a4 = 0; allowed: "
                f"a4 not 0, and zeros with a damping of {LEAST_DAMPING:g} or more"
            )
        return found

    def _rational(self, node: str) -> RationalTable:
        model, judge = self.coefficients(node), None
        if self.inverse == "fourth_order" and self.identify:
            judge = made_of(judge_of, self, model=model, late=self.late)
        return rational_inverse(
            model if model[-1] else None,
            step=self.step,
            points=self.points_per_revolution,
            bandwidth=self.inverse_bandwidth,
            judge=judge,
        )


class Memory(NamedTuple):
    """Memory of the disturbance law.

    Attributes:
        spindle: filter of the spindle angle.
        form: form of the part.
        known: estimates of drive and disturbance.
        ahead: delay of the drive [s].
        late: delay of the measured position [s].
    """

    spindle: AngleFilterTable
    form: FormAhead
    known: DisturbanceTable
    ahead: float
    late: float


@kernel
def sample(memory: Memory, now: Now) -> float:
    """Return the command of the law at one sample [m]."""
    spindle, known = memory.spindle, memory.known
    follow(spindle, now.angle)
    found = 0.0
    if now.sample >= known.late:
        angle, speed, _ = at(spindle, -memory.late)
        found = observed(known, memory.form, now.sample, angle, speed, now.position, now.learning)
    angle, speed, acceleration = at(spindle, memory.ahead)
    command = fed_forward(known, memory.form, angle, speed, acceleration)
    command -= expected(known.memory, angle, speed) + found
    commanded(known, now.sample, command)
    return command


@lru_cache(maxsize=64)
def _passed(learned_waves: float, points: int, waves: bytes) -> Array:
    """Return the response of the filter S at waves per revolution given as bytes, cached: each margin asks again."""
    return smoothing_response(learned_waves, points, np.frombuffer(waves))


class DisturbanceController(FormLaw):
    """Law that feeds the form forward, learns the disturbance and observes the rest."""

    kind = "disturbance_controller"
    announces: ClassVar[tuple[str, ...]] = (*FormLaw.announces, MODEL_ADOPTED, MODEL_REFUSED)
    Parameters = DisturbanceControllerParameters
    parameters: DisturbanceControllerParameters
    tunable = ("learning_gain",)
    adjustable = ("learning_gain", "learned_waves", "learning_bandwidth", "observer_bandwidth")
    law: Memory
    sample: ClassVar[Callable[[Any, Now], float]] = staticmethod(sample)
    factor = "sup|factor of a revolution|"
    remedy = "a model nearer to the drive"

    def __init__(self, name: str, parameters: DisturbanceControllerParameters) -> None:
        parameters.make(name)  # rejects invalid parameters
        super().__init__(name, parameters)

    def start(self) -> Memory:
        """Return the memory of the law before the first sample."""
        parameters = self.parameters
        late = parameters.feedback_delay * parameters.step
        return Memory(self.make_filter(), self.form, parameters.make(self.name), parameters.model_delay, late)

    def perform(self, action: str) -> None:
        """Carry out an event; ``clear`` erases the memory, but keeps the estimates of angle and drive."""
        if action == "clear":
            forget(self.law.known)
        else:
            super().perform(action)

    def tune(self, parameters: DisturbanceControllerParameters) -> None:
        """Continue with another learning gain from the next sample on; memory and estimates are kept."""
        known = self.law.known
        self.law = self.law._replace(known=known._replace(memory=with_gain(known.memory, parameters.learning_gain)))

    def settings(self) -> str:
        """Return the drive model that decides whether learning converges, in words."""
        parameters = self.parameters
        model = f"{parameters.model_natural_frequency:.4g} rad/s, {parameters.model_damping:.3g}"
        return f"a model of {model}, {parameters.model_delay * 1e3:.3g} ms"

    def tell(self, first: int, end: int) -> list[Sparse]:
        """Return the events that a model has been adopted, or refused."""
        told = super().tell(first, end)
        for index, verdict in verdicts(self.law.known.rational, first, end):
            action = MODEL_ADOPTED if verdict == ADOPTED else f"{MODEL_REFUSED}: {_WHY[verdict]}"
            told.append(Sparse(f"{self.name}/events", messages.EVENT, index, {"action": action}))
        return told

    def cures(self, lag: float) -> Iterable[Iterable[Mapping[str, Value]]]:
        """Return candidate remedies: fewer learned waves, a slower observer, or both where neither suffices alone."""
        parameters = self.parameters
        waves = [float(f"{parameters.learned_waves * 0.75**k:.2g}") for k in range(12)]
        observers = [float(f"{parameters.observer_bandwidth * 0.6**k:.2g}") for k in range(9)]
        yield ({"learned_waves": each} for each in waves[1:])
        if parameters.observer_bandwidth:
            yield ({"observer_bandwidth": each} for each in observers[1:])
            both = sorted(product(range(1, 9, 2), repeat=2), key=sum)
            yield ({"learned_waves": waves[i], "observer_bandwidth": observers[j]} for i, j in both)

    def _model_error(self, drive: Response, frequency: Array) -> Complex:
        """Return the model error E = Wi/Ŵi - 1, the delays included."""
        p = 1j * frequency
        inverse = inverse_response(self.parameters.coefficients(self.name), frequency)
        return np.asarray(drive(frequency) * inverse * np.exp(p * self.parameters.model_delay) - 1)

    def factors(self, drive: Response, waves: Array, speed: float) -> Complex:
        """Return the factor E·L of the observer and that of the memory, with the given model, shape (2, n)."""
        parameters, error = self.parameters, self._model_error(drive, waves * speed)
        smooth = _passed(parameters.learned_waves, parameters.points_per_revolution, waves.tobytes())
        kept, learned, low = made_of(
            loop_response, parameters, smooth=smooth, waves=waves, speed=speed, late=parameters.late
        )
        inside = error * low
        if not parameters.learning_gain:
            return inside[None]
        return np.asarray(np.stack((inside, kept - learned * (1.0 + error) / (1.0 + inside))))

    def highest_waves(self, speed: float) -> float:
        """Return the Nyquist limit of the memory [waves per revolution]."""
        return 0.5 * self.parameters.points_per_revolution
