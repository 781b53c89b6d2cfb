# SPDX-License-Identifier: Apache-2.0
"""Control laws as plug-ins: a class with a formula per sample, independent of ports, blocks and events."""

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np

from lathe_machine.stages.common.obedience import OBEY, Listener, apply, listens, may_learn, piece
from lathe_machine.stages.common.sampled import Sampled, checked
from lathe_machine.stages.learning.learner import LawParameters, Learner
from lathe_rc import messages
from lathe_rc.analysis.cycle_factors import Response
from lathe_rc.arrays import Array, Complex, Integers
from lathe_rc.blocks.ports import Input, Output, Sparse
from lathe_rc.cell.events import OUT_OF_REACH
from lathe_rc.cell.stage import DONE, Fields, Reached
from lathe_rc.extensions import code_of_others
from lathe_rc.jit import inlined
from lathe_rc.messages import Samples, Signals

_TURN = 2.0 * np.pi
_DIVERGED, _ASKS = 1, 2  # stop reasons of the step
_NEVER = np.zeros(1, np.int64)  # of a law that never asks


class Now(NamedTuple):
    """Inputs of a law at a sample.

    Attributes:
        sample: index of the sample.
        time: time since sample 0 [s].
        angle: measured spindle angle [rad], unwrapped.
        speed: measured spindle speed [rad/s].
        error: measured form error [m] of ``feedback_delay`` samples ago; 0 before there is one.
        error_angle: measured spindle angle of that sample [rad].
        learning: False where the supervisor or an event forbids learning.
        position: measured position of the drive [m] of that sample, for a law that ``senses`` it; otherwise 0.
    """

    sample: int
    time: float
    angle: float
    speed: float
    error: float
    error_angle: float
    learning: bool
    position: float


class GuardTable(NamedTuple):
    """Divergence guard that compares a revolution's error with the form (see `LawParameters`).

    Attributes:
        limit: square of the permitted ratio; 0: guard off.
        sums: squares of error and form in the current revolution, of the error in the last complete revolution and the
            first one, and the reference of the latter two [m²].
        whole: number of samples in the current revolution, and its number.
    """

    limit: float
    sums: Samples
    whole: Integers


_ERROR, _FORM, _ENDED, _FIRST, _ALLOWED = range(5)


@inlined
def _grows(guard: GuardTable, angle: float, error: float, form: float) -> bool:
    """Return whether this sample ends a revolution with too large an error."""
    turn = int(np.floor(angle / _TURN))
    found = False
    if turn > guard.whole[1] and guard.whole[0] > 0:
        samples, number = guard.whole[0], guard.whole[1]
        guard.sums[_ENDED] = guard.sums[_ERROR] / samples
        if number == 0:
            guard.sums[_FIRST] = guard.sums[_ENDED]
        guard.sums[_ALLOWED] = guard.sums[_FORM] / samples
        # A round part has no form: then the first revolution is the reference.
        if guard.sums[_ALLOWED] == 0.0:
            guard.sums[_ALLOWED] = guard.sums[_FIRST]
        found = guard.limit > 0.0 and guard.sums[_ENDED] > guard.limit * guard.sums[_ALLOWED]
        guard.sums[_ERROR] = guard.sums[_FORM] = 0.0
        guard.whole[0] = 0
        guard.whole[1] = turn
    guard.sums[_ERROR] += error * error
    guard.sums[_FORM] += form * form
    guard.whole[0] += 1
    return found


class LawMemory(NamedTuple):
    """Memory of the step of a law.

    Attributes:
        law: memory of the law itself.
        guard: guard against a diverging loop.
        who: obedience to the supervisor, if any.
        delay: delay of the error [sample].
        period: sampling step [s].
        senses: whether the law reads the drive's measured position.
        learns: whether events permit learning, shape (1,).
        asks: whether the law asks for `Law.asked` after this sample, shape (1,).
    """

    law: Any
    guard: GuardTable
    who: Listener
    delay: int
    period: float
    senses: bool
    learns: Integers
    asks: Integers


def _loop(sample: Callable[[Any, Now], float]) -> Callable[..., Reached]:
    """Build the step of a law from its formula for one sample."""

    def step(memory: LawMemory, first: int, start: int, inputs: Fields, flags: Fields, outputs: Fields) -> Reached:
        """Compute the command of one block, segment by segment between reactions."""
        angle, speed, error_angle, error, form = inputs[0], inputs[1], inputs[2], inputs[3], inputs[4]
        position, command, who = inputs[-1], outputs[0], memory.who
        while start < command.size:
            stop = piece(who, start, command.size, flags[0])
            if stop == start:
                return start, OBEY
            learning = memory.learns[0] != 0 and (not who.listens or may_learn(who))
            for k in range(start, stop):
                n = first + k
                # Before that the error is 0, which would reduce the error of the first revolution.
                if n >= memory.delay and _grows(memory.guard, error_angle[k], error[k], form[k]):
                    return k, _DIVERGED
                sensed = position[k] if memory.senses else 0.0
                now = Now(n, n * memory.period, angle[k], speed[k], error[k], error_angle[k], learning, sensed)
                command[k] = sample(memory.law, now)
                if memory.asks[0]:
                    memory.asks[0] = 0
                    apply(who, command[start : k + 1])
                    return k + 1, _ASKS
            apply(who, command[start:stop])
            start = stop
        return command.size, DONE

    return step


class Law(Sampled, Learner):
    """Base class of control laws, which command a drive from the measured form error.

    A user-defined law has a table ``Parameters``, an initial memory (`start`), and a formula
    ``sample(memory, now)`` for the command [m]: a `kernel`, for which the memory is a NamedTuple of arrays of
    float64, int64 or uint8, numbers, and nested NamedTuples; or a function in plain Python, for any memory. It may
    change arrays of the memory and nothing else, and depends on the memory and on `Now` alone.

    Attributes:
        law: memory of the law.
        senses: whether it reads the measured position of the commanded drive.

    Example:
        >>> import numpy as np
        >>> from lathe_machine import Law, LawParameters, Now
        >>> from lathe_rc import kernel, parameter
        >>> from typing import NamedTuple
        >>> class IntegralParameters(LawParameters):
        ...     gain: float = parameter(0.01, "of a sample")
        >>> class Memory(NamedTuple):
        ...     gain: float
        ...     sum: np.ndarray
        >>> @kernel  # or nothing: then it is plain Python, slower, with the same bits
        ... def sample(memory: Memory, now: Now) -> float:
        ...     if now.learning:
        ...         memory.sum[0] += memory.gain * now.error
        ...     return memory.sum[0]
        >>> class Integral(Law):
        ...     Parameters = IntegralParameters
        ...     sample = staticmethod(sample)
        ...
        ...     def start(self) -> Memory:
        ...         return Memory(self.parameters.gain, np.zeros(1))
    """

    Parameters = LawParameters
    parameters: LawParameters
    senses: ClassVar[bool] = False
    actions = ("freeze", "learn", "clear")
    announces: ClassVar[tuple[str, ...]] = (OUT_OF_REACH,)
    stops: ClassVar[Mapping[int, str]] = {**Learner.stops, _DIVERGED: "diverged: the error has grown beyond stop_ratio"}
    sample: ClassVar[Callable[[Any, Now], float]]
    loop = staticmethod(_loop)

    def __init__(self, name: str, parameters: LawParameters) -> None:
        super().__init__(name, parameters)
        self.law = self.started()
        delay = parameters.feedback_delay
        self._guard = GuardTable(parameters.stop_ratio**2, np.zeros(5), np.zeros(2, np.int64))
        self._learns = np.ones(1, np.int64)
        self._obedience = self._make_obedience(delay)
        self.declare(
            inputs=[
                Input("encoder", messages.ENCODER, ("angle", "speed")),
                Input("encoder", messages.ENCODER, ("angle",), delay),
                Input("tool", messages.TOOL, ("measured_error", "reference"), delay),
                *([Input("coarse/state", messages.STATE, ("measured_position",), delay)] if self.senses else []),
                *listens(parameters),
            ],
            outputs=[Output("coarse/command", messages.COMMAND)],
        )

    @abstractmethod
    def start(self) -> Any:
        """Return the memory before sample 0, and after the event ``clear``."""

    def contraction(self, drive: Response, waves: Array, speed: float) -> Complex | None:
        """Return the factor by which a revolution changes the error at ``waves`` per revolution, shape (n,).

        The check before a start requires a magnitude below 1. A law without this method is reported
        as unchecked.

        Args:
            drive: response of the drive's position to its command at frequencies [rad/s].
            waves: waves per revolution, shape (n,).
            speed: speed of the spindle [rad/s].
        """
        return None

    def characteristic(self, drive: Response, frequency: Array, speed: float) -> tuple[Complex, Complex] | None:
        """Return D and F of the loop's characteristic function D + F, for a law that acts without a cycle.

        The open-loop response is L = F/D; F is proportional to ``drive``, and neither has unstable poles or a pole at
        one of the frequencies: an integral k/p of the error gives D = p/(p + k) and F = drive·k/(p + k). The check
        before a start requires a stable loop, and the drive margin is min |D + F|/|F|.

        Args:
            drive: response of the drive's position to its command at frequencies [rad/s].
            frequency: frequencies above 0 up to the Nyquist frequency [rad/s], shape (n,).
            speed: speed of the spindle [rad/s].
        """
        return None

    def highest_waves(self, speed: float) -> float:
        """Return the highest waves per revolution checked by `contraction`, at ``speed`` [rad/s]: the Nyquist limit."""
        return float(np.pi / (self.parameters.step * speed))

    def factors(self, drive: Response, waves: Array, speed: float) -> Complex | None:
        """Return the `contraction`, shape (1, n)."""
        with code_of_others(f"{self.name}: contraction"):
            told = self.contraction(drive, waves, speed)
        return None if told is None else checked(f"{self.name}: contraction", told, waves)[None]

    def perform(self, action: str) -> None:
        """Clear the memory, or enable or disable learning."""
        if action == "clear":
            self.law = self.start()
        else:
            self._learns[0] = action == "learn"

    @property
    def memory(self) -> LawMemory:
        """Current memory of the step of the control law."""
        delay, period = self.parameters.feedback_delay, self.parameters.step
        asks = getattr(self.law, "asks", _NEVER)
        return LawMemory(self.law, self._guard, self.listener, delay, period, self.senses, self._learns, asks)

    def asked(self) -> None:
        """Change the memory between two samples, after a sample that set ``asks`` of the memory, shape (1,), to 1."""

    @property
    def needs_python(self) -> str:
        """Return why the step needs Python: a law that asks changes its memory there."""
        asks = f"{self.kind} computes its memory in Python; allowed: a law without `asked`"
        return asks if hasattr(self.law, "asks") else super().needs_python

    @property
    def handles(self) -> Mapping[str, tuple[np.ndarray, int]]:
        """Return whether events permit learning."""
        return {"learning": (self._learns, 0)}

    def serve(
        self, reason: int, first: int, reached: int, inputs: Sequence[Signals], outputs: Sequence[Signals]
    ) -> list[Sparse]:
        """Obey the supervisor, or end a diverging run.

        Raises:
            LatheError: the loop diverges.
        """
        if reason == OBEY:
            return super().serve(reason, first, reached, inputs, outputs)
        if reason == _ASKS:
            self.asked()
            return []
        ended, allowed = np.sqrt(self._guard.sums[[_ENDED, _ALLOWED]]).tolist()
        raise self._diverged(first + reached, ended, allowed)
