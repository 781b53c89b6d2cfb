# SPDX-License-Identifier: Apache-2.0
"""Self-learning controller of one channel."""

from bisect import bisect_left
from collections.abc import Collection, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from lathe_rc import messages
from lathe_rc.analysis.learning import LearningLoop, Response
from lathe_rc.cell.parameters import about
from lathe_rc.cell.stage import DONE, Fields, Input, Output, Reached, Sparse
from lathe_rc.cell.stages.learner import Learner
from lathe_rc.cell.stages.learning_parameters import LearningControllerParameters
from lathe_rc.cell.stages.obedience import (
    NOBODY,
    OBEY,
    OUT_OF_REACH,
    ObedienceTable,
    apply,
    listens,
    may_learn,
    obeyed,
    piece,
)
from lathe_rc.control import angle_memory, memory_file
from lathe_rc.control.angle_memory import AngleMemory
from lathe_rc.control.correction import Correction, CorrectionLaw
from lathe_rc.control.identification import DriveIdentifier, Identified, IdentifierTable, accumulate, command_sent
from lathe_rc.control.lead import PreviewTable, look_ahead
from lathe_rc.control.repetitive import Cycle, RepetitiveController, largest_feedback_delay
from lathe_rc.errors import InputError
from lathe_rc.jit import inlined, kernel
from lathe_rc.messages import MAX_BLOCK, Samples, Signals
from lathe_rc.plants.linear import discretise, second_order
from lathe_rc.safety.state_machine import Reaction

_SETTLED = 4.0  # lead times until a drive has followed
_MOST = 1024  # entries of a table of margins
_FILE_ACTIONS = ("save", "load")
_STATUS = "coarse/learning"  # topic


# Places in the state of a step: whether it is inside a piece of a block, where that begins and ends, and whether the
# angle is lost, and since which sample, if that has not been told yet.
_INSIDE, _BEGIN, _END, _LOST, _LOST_AT = range(5)


class Memory(NamedTuple):
    """What the step works on.

    Attributes:
        control: the memory of the channel.
        preview: its lead law.
        identifier: of its drive, if it ``identifies``.
        obedience: to the supervisor, if it ``listens``.
        nominal: speed of the spindle [rad/s].
        period: sampling step [s].
        by_time: whether time stands for the angle.
        falls_back: whether the lead angle is that of the nominal speed where the supervisor asks to fall back.
        rates: whether the correction needs the rates of the lead.
        finer: how many finer drives the error has in it.
        margin: of the newest cycle, shape (1,).
        state: see above.
    """

    control: AngleMemory
    preview: PreviewTable
    identifier: IdentifierTable
    obedience: ObedienceTable
    nominal: float
    period: float
    by_time: bool
    falls_back: bool
    rates: bool
    finer: int
    identifies: bool
    listens: bool
    margin: Samples
    state: npt.NDArray[np.int64]


@inlined
def _angle(memory: Memory, first: int, late: int, measured: Samples) -> Samples:
    """The angle that the memory goes by [rad], ``late`` samples before the samples ``first`` on."""
    if not memory.by_time:
        return measured
    angle = np.empty(measured.size)
    for k in range(angle.size):
        angle[k] = memory.nominal * (memory.period * (first + k))
    if late:
        angle -= memory.nominal * (memory.period * late)
    return angle


@inlined
def _begin(memory: Memory, first: int, start: int, stop: int, inputs: Fields) -> None:
    """Look ahead along a piece of a block, and take its errors."""
    control, samples = memory.control, stop - start
    speed, error = inputs[1][start:stop], inputs[3][start:stop]
    if memory.by_time or (memory.falls_back and obeyed(memory.obedience) >= Reaction.FALL_BACK.value):
        speed = np.full(samples, memory.nominal)
    if memory.finer:
        error = error.copy()
        for finer in range(memory.finer):
            error += inputs[4 + finer][start:stop]
    ahead = control.ahead
    look_ahead(
        memory.preview, first + start, memory.rates, speed, ahead[0, :samples], ahead[1, :samples], ahead[2, :samples]
    )
    angle = _angle(memory, first + start, 0, inputs[0][start:stop])
    past_angle = _angle(memory, first + start, control.delay, inputs[2][start:stop])
    angle_memory.begin(control, first + start, angle, past_angle, error)


@inlined
def _lose(memory: Memory, start: int, stop: int, command: Samples) -> None:
    """Without an angle the command stays, from sample ``start`` of a block on."""
    command[start:stop] = command[start - 1] if start > memory.state[_BEGIN] else memory.obedience.takeover.given[1]


@kernel
def step(memory: Memory, first: int, start: int, inputs: Fields, flags: Fields, outputs: Fields) -> Reached:
    """See `lathe_rc.cell.stage`."""
    control, state, command = memory.control, memory.state, outputs[0]
    n = command.size
    while start < n or state[_INSIDE]:
        if not state[_INSIDE]:
            stop = n
            if memory.listens:
                stop = piece(memory.obedience, start, flags[0])
                if stop == start:
                    return start, OBEY
                control.whole[angle_memory.LEARNS] = may_learn(memory.obedience)
            state[_INSIDE], state[_BEGIN], state[_END] = 1, start, stop
            if not state[_LOST]:
                _begin(memory, first, start, stop, inputs)
        begin, stop = state[_BEGIN], state[_END]
        reached, reason = stop, DONE
        if state[_LOST]:
            _lose(memory, start, stop, command)
        else:
            angle = _angle(memory, first + begin, 0, inputs[0][begin:stop])
            reached, reason = angle_memory.advance(control, first + begin, start - begin, angle, command[begin:stop])
            reached += begin
            if reason in (angle_memory.AHEAD, angle_memory.BEHIND, angle_memory.JUMPED) and memory.listens:
                state[_LOST], state[_LOST_AT] = 1, first + reached
                _lose(memory, reached, stop, command)
                reached, reason = stop, DONE
            elif memory.identifies:
                accumulate(memory.identifier, first, start, reached, inputs[4 + memory.finer])
                command_sent(memory.identifier, first, start, reached, command)
        for published in range(1, len(outputs)):
            outputs[published][start:reached] = memory.margin[0]
        if reason != DONE:
            return reached, reason
        if memory.listens:
            apply(memory.obedience, command[begin:stop])
        state[_INSIDE] = 0
        start = stop
    return n, DONE


class LearningController(Learner):
    """See `lathe_rc.control.repetitive`.

    Attributes:
        parameters: its table.
    """

    kind = "learning_controller"
    Parameters = LearningControllerParameters
    actions = ("freeze", "learn", "clear", *_FILE_ACTIONS)
    announces = ("joined", "lost", OUT_OF_REACH)
    parameters: LearningControllerParameters
    factor = "sup|Q - Z|"
    remedy = "widen Q, change the lead"
    step = staticmethod(step)

    def __init__(self, name: str, parameters: LearningControllerParameters) -> None:
        self.parameters = parameters
        super().__init__(name, parameters)
        self._q = parameters.make_q(name)
        self._controller = RepetitiveController(
            grid=parameters.points_per_revolution,
            revolutions=parameters.cycle_revolutions,
            q=self._q,
            gain=parameters.learning_gain,
            soft_start=parameters.soft_start,
            preview=parameters.make_preview(name),
            correction=parameters.make_correction(name),
            nominal=parameters.nominal_speed,
            delay=parameters.feedback_delay,
            join_below=parameters.join_below or np.inf,
            step=parameters.step,
        )
        self._joined = self._controller.joined
        self._asks = parameters.identify or parameters.publish_margin or parameters.stop_ratio > 0.0
        self._first_rms = np.nan
        self._controller.table.whole[angle_memory.ASKS] = self._asks
        self._state, self._margin = np.array([0, 0, 0, 0, -1]), np.zeros(1)
        self._check_identification()
        self._model = Identified(parameters.model_natural_frequency, parameters.model_damping, np.nan)
        self._margins = _Margins(parameters)
        delay = parameters.feedback_delay
        self._cycle_start = delay  # where the first error becomes visible
        inputs = [
            Input("encoder", messages.ENCODER, ("angle", "speed")),
            Input("encoder", messages.ENCODER, ("angle",), delay),
            Input("tool", messages.TOOL, ("measured_error",), delay),
        ]
        inputs += [Input(f"{drive}/state", messages.STATE, ("measured_position",), delay) for drive in parameters.finer]
        if parameters.identify:
            inputs.append(Input("coarse/state", messages.STATE, ("measured_position",), delay))
        settled = round(_SETTLED * parameters.lead_time / parameters.step) + delay
        self._obedience = self._make_obedience(settled)
        inputs += listens(parameters)
        self._identifier = DriveIdentifier(
            model_delay=parameters.model_delay,
            feedback_delay=delay,
            bandwidth=parameters.identification_bandwidth,
            forgetting=parameters.identification_forgetting,
            step=parameters.step,
            block=MAX_BLOCK,
        )
        outputs = [Output("coarse/command", messages.COMMAND)]
        if parameters.publish_margin:
            outputs.append(Output("coarse/margin", messages.MARGIN))
            self._margin[0] = self._margins.untabulated(self, parameters.nominal_speed, self._model)
        self.declare(inputs=inputs, outputs=outputs)
        self.sparse_topics[_STATUS] = messages.LEARNING
        if self._scheduled_actions("load") and not self._scheduled_actions("save"):
            self._read_memory()

    def _check_identification(self) -> None:
        parameters = self.parameters
        if parameters.correction_model == "identified" and not parameters.identify:
            raise InputError(f"{self.name}.correction_model = identified without identification; set identify as well")

    # ---- the loop, for checks and margins -----------------------------------------------------------

    @property
    def correction(self) -> Correction:
        """1/W0 as it is at the moment."""
        return self._controller.correction

    def loop(self, drive: Response) -> LearningLoop:
        """The learning loop around a drive with the given response."""
        parameters = self.parameters
        return LearningLoop(
            drive=drive,
            q=self._q,
            grid=parameters.points_per_revolution,
            gain=parameters.learning_gain,
            lead_time=parameters.preview_time,
            constant_lead=parameters.constant_lead,
            correction=self.correction,
            nominal=parameters.nominal_speed,
            variable_lead=parameters.lead_law != "constant_angle",
            step=parameters.step,
        )

    def worst(self, drive: Response, speed: float) -> tuple[float, float]:
        """See `Learner`: sup|Q - γZ|."""
        return self.loop(drive).worst(speed)

    def checked_speeds(self, low: float, high: float) -> Collection[float]:
        """See `Learner`."""
        if self.parameters.law == "time_periodic":
            return {self.parameters.nominal_speed}
        return super().checked_speeds(low, high)

    def settings(self) -> str:
        """See `Learner`."""
        return f"lead_time = {self.parameters.lead_time * 1e3:.4g} ms, q_time = {self.parameters.q_time * 1e6:.4g} µs"

    def largest_delay(self, speed: float, acceleration: float, count: float, speed_window: float) -> int:
        """See `Learner`."""
        parameters = self.parameters
        if parameters.law == "time_periodic":
            speed, acceleration, count = parameters.nominal_speed, 0.0, 0.0
        jitter = count / speed_window
        window = parameters.acceleration_window * parameters.step
        return largest_feedback_delay(
            grid=parameters.points_per_revolution,
            revolutions=parameters.cycle_revolutions,
            lead=parameters.largest_lead(speed + jitter, acceleration + 2.0 * jitter / window),
            speed=speed,
            late=count,
            looks_ahead=self.correction.looks_ahead,
            step=parameters.step,
        )

    # ---- events -------------------------------------------------------------------------------------

    def check_action(self, action: str) -> None:
        """See `Stage`."""
        super().check_action(action)
        if action in _FILE_ACTIONS and not self.parameters.memory_file:
            raise InputError(f"{self.name}.memory_file is empty; name the file for the event {action!r}")

    def schedule(self, action: str, index: int) -> None:
        """See `Stage`; a memory that cannot be loaded is refused now."""
        self.check_action(action)
        if action == "load":
            self._read_memory()
        super().schedule(action, index)

    def _read_memory(self) -> np.ndarray:
        parameters = self.parameters
        path = Path(parameters.memory_file)
        with about(self.name, "memory_file"):
            return memory_file.load(path, parameters.cycle_points, parameters.points_per_revolution)

    def perform(self, action: str) -> None:
        """See `Stage`."""
        controller = self._controller
        if action == "clear":
            controller.clear()
        elif action == "save":
            grid = self.parameters.points_per_revolution
            memory_file.save(Path(self.parameters.memory_file), controller.memory(), grid)
        elif action == "load":
            controller.remember(self._read_memory())
        elif self._obedience:
            self._obedience.learn(wanted=action == "learn")
        else:
            controller.learning = action == "learn"

    # ---- samples ------------------------------------------------------------------------------------

    @property
    def memory(self) -> Memory:
        """See `Stage`."""
        parameters = self.parameters
        return Memory(
            control=self._controller.table,
            preview=self._controller.preview.table,
            identifier=self._identifier.table,
            obedience=self._obedience.table if self._obedience else NOBODY,
            nominal=parameters.nominal_speed,
            period=parameters.step,
            by_time=parameters.law == "time_periodic",
            falls_back=parameters.fall_back == "constant_lead",
            rates=self.correction.law is not CorrectionLaw.NONE,
            finer=len(parameters.finer),
            identifies=parameters.identify,
            listens=self._obedience is not None,
            margin=self._margin,
            state=self._state,
        )

    def serve(
        self, reason: int, first: int, reached: int, inputs: Sequence[Signals], outputs: Sequence[Signals]
    ) -> list[Sparse]:
        """See `Stage`.

        Raises:
            AngleLostError: the memory cannot be read at the angle that was measured.
        """
        if reason == OBEY:
            assert self._obedience is not None, "nobody else listens"
            return self._obedience.obey(Reaction(inputs[self.own_inputs - 1]["reaction"][reached]), first + reached)
        if reason == angle_memory.SMOOTH:
            self._controller.smooth()
            return []
        if reason == angle_memory.CYCLE_ENDED:
            return self._newest_cycle(reached, outputs) if self._asks else []
        angle, speed, past_angle = inputs[0]["angle"], inputs[0]["speed"], inputs[1]["angle"]
        raise self._controller.lost(reason, first, reached, angle, speed, past_angle)

    def _newest_cycle(self, reached: int, outputs: Sequence[Signals]) -> list[Sparse]:
        """End the cycle that has ended with the sample before; what it gives holds from that one on."""
        sparse = [message for cycle in self._controller.ended() for message in self._end_cycle(cycle)]
        self._margin[0] = sparse[0].values["stability_margin"]
        for published in outputs[1:]:
            published["stability_margin"][reached - 1] = self._margin[0]
        return sparse

    def tell(self, first: int, end: int) -> list[Sparse]:
        """See `Stage`."""
        sparse: list[Sparse] = []
        if not self._asks:
            sparse += [message for cycle in self._controller.ended() for message in self._end_cycle(cycle)]
        if self._state[_LOST_AT] >= 0:
            index, self._state[_LOST_AT] = int(self._state[_LOST_AT]), -1
            sparse.append(Sparse(f"{self.name}/events", messages.EVENT, index, {"action": "lost"}))
        return sparse

    def _end_cycle(self, cycle: Cycle) -> list[Sparse]:
        parameters = self.parameters
        if cycle.number == 1:
            self._first_rms = cycle.rms
        if 0.0 < parameters.stop_ratio < cycle.rms / self._first_rms:
            raise self._diverged(cycle.sample_index, cycle.rms, self._first_rms)
        found = self._identifier.fit() if parameters.identify else None
        if found is not None:
            self._model = found
            if parameters.correction_model == "identified" and cycle.learning:
                self._controller.correction = replace(
                    self.correction, natural_frequency=found.natural_frequency, damping=found.damping
                )
        start, self._cycle_start = self._cycle_start, cycle.sample_index
        seconds = (cycle.sample_index - start) * self.shared.step
        unheard = not self._asks and _STATUS in self.unheard  # a margin costs as much as a cycle of samples
        status = {
            "cycle": cycle.number,
            "rms_error": cycle.rms,
            "max_error": cycle.largest,
            "contraction": cycle.contraction,
            "stability_margin": np.nan
            if unheard
            else self._margins.at(self, 2 * np.pi * parameters.cycle_revolutions / seconds, self._model),
            "learning": cycle.learning,
            "joined": cycle.joined,
            "model_natural_frequency": self._model.natural_frequency,
            "model_damping": self._model.damping,
            "model_residual": self._model.residual,
        }
        sparse = [Sparse(_STATUS, messages.LEARNING, cycle.sample_index, status)]
        if cycle.joined and not self._joined:
            self._joined = True
            sparse.append(Sparse(f"{self.name}/events", messages.EVENT, cycle.sample_index, {"action": "joined"}))
        return sparse


class _Margins:
    """1 - sup|Q - γZ| of a drive model, tabulated as it is asked for: one costs as much as a cycle of samples."""

    def __init__(self, parameters: LearningControllerParameters) -> None:
        self._parameters = parameters
        self._speeds: list[float] = (parameters.nominal_speed / 40 * np.arange(20, 61)).tolist()
        self._models: dict[tuple[str, ...], Identified] = {}
        self._responses: dict[tuple[str, ...], Response] = {}
        self._suprema: dict[tuple[object, ...], float] = {}

    def __getstate__(self) -> dict[str, Any]:
        """What cannot be had again: a response is computed when it is asked for."""
        return {**self.__dict__, "_responses": {}}

    def _response(self, model: Identified) -> Response:
        # Three digits of a model are more than its margin is good for, and a steady one is computed once.
        key = _three_digits(model.natural_frequency, model.damping)
        if key not in self._models:
            _make_room(self._models)
            self._models[key] = model
        model = self._models[key]
        if key not in self._responses:
            _make_room(self._responses)
            self._responses[key] = self._computed(model)
        return self._responses[key]

    def _computed(self, model: Identified) -> Response:
        parameters = self._parameters
        a, b = second_order(model.natural_frequency, model.damping)
        return discretise(a, b, parameters.model_delay, parameters.step, "foh").response

    def untabulated(self, stage: LearningController, speed: float, model: Identified) -> float:
        """The margin at ``speed`` [rad/s] of this very model; what was tabulated before and after does not matter."""
        return 1.0 - stage.loop(self._computed(model)).supremum(speed)

    def _supremum(self, stage: LearningController, speed: float, model: Identified) -> float:
        inverted = stage.correction
        models = (model.natural_frequency, model.damping, inverted.natural_frequency, inverted.damping)
        key = (speed, _three_digits(*models))
        if key not in self._suprema:
            _make_room(self._suprema)
            self._suprema[key] = stage.loop(self._response(model)).supremum(speed)
        return self._suprema[key]

    def at(self, stage: LearningController, speed: float, model: Identified) -> float:
        """The margin at ``speed`` [rad/s], between tabulated speeds by interpolation."""
        after = bisect_left(self._speeds, speed)
        if not 0 < after < len(self._speeds):
            return 1.0 - stage.loop(self._response(model)).supremum(speed)
        below, above = self._speeds[after - 1], self._speeds[after]
        lower, upper = self._supremum(stage, below, model), self._supremum(stage, above, model)
        return 1.0 - ((upper - lower) / (above - below) * (speed - below) + lower)


def _make_room(table: dict[Any, Any]) -> None:
    """Let the oldest entry go from a full table: a model that wanders would fill it for ever."""
    if len(table) >= _MOST:
        del table[next(iter(table))]


@lru_cache
def _three_digits(*numbers: float) -> tuple[str, ...]:
    return tuple(f"{number:.3g}" for number in numbers)
