# SPDX-License-Identifier: Apache-2.0
"""Self-learning controller of one channel."""

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from lathe_rc.analysis.learning import LearningLoop, Response
from lathe_rc.cell import messages
from lathe_rc.cell.messages import MAX_BLOCK, Samples, Signals
from lathe_rc.cell.stage import Input, Output, Sparse, Stage, cut
from lathe_rc.cell.stages.learning_parameters import LearningControllerParameters
from lathe_rc.cell.stages.obedience import OUT_OF_REACH, Obedience, listens
from lathe_rc.control import bounded, memory_file
from lathe_rc.control.bounded import Takeover
from lathe_rc.control.correction import Correction
from lathe_rc.control.identification import DriveIdentifier, Identified
from lathe_rc.control.repetitive import AngleLostError, Cycle, RepetitiveController, largest_feedback_delay
from lathe_rc.errors import InputError
from lathe_rc.plants.linear import discretise, second_order
from lathe_rc.safety.state_machine import Reaction

_SETTLED = 4.0  # lead times until a drive has followed
_MOST = 1024  # entries of a table of margins
_FILE_ACTIONS = ("save", "load")


class LearningController(Stage):
    """See `lathe_rc.control.repetitive`.

    Attributes:
        parameters: its table.
    """

    kind = "learning_controller"
    Parameters = LearningControllerParameters
    actions = ("freeze", "learn", "clear", *_FILE_ACTIONS)
    announces = ("joined", "lost", OUT_OF_REACH)

    def __init__(self, name: str, parameters: LearningControllerParameters) -> None:
        self.parameters = parameters
        super().__init__(name, parameters)
        self._q = parameters.make_q()
        self._controller = RepetitiveController(
            grid=parameters.points_per_revolution,
            revolutions=parameters.cycle_revolutions,
            q=self._q,
            gain=parameters.learning_gain,
            soft_start=parameters.soft_start,
            preview=parameters.make_preview(),
            correction=parameters.make_correction(),
            nominal=parameters.nominal_speed,
            delay=parameters.feedback_delay,
            join_below=parameters.join_below or np.inf,
            step=parameters.step,
        )
        self._joined = self._controller.joined
        self._check_identification()
        self._model = Identified(parameters.model_natural_frequency, parameters.model_damping, np.nan)
        self._margins = _Margins(self)
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
        self._lost = False  # there is no angle that it could read its memory at
        self._obedience = self._obeys() if parameters.reaction_delay else None
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
            self._margin = self._margins.untabulated(parameters.nominal_speed, self._model)
        self.declare(inputs=inputs, outputs=outputs)
        self.sparse_topics["coarse/learning"] = messages.LEARNING
        if self._scheduled_actions("load") and not self._scheduled_actions("save"):
            self._read_memory()

    def _obeys(self) -> Obedience:
        parameters = self.parameters
        settled = round(_SETTLED * parameters.lead_time / parameters.step) + parameters.feedback_delay
        bounded.prepare()
        bounds = parameters.bounds()
        reach = bounds.reach(parameters.retract_time)
        takeover = Takeover(bounds, parameters.retract_position, parameters.step, reach=reach)
        return Obedience(self.name, self, takeover, settled=settled)

    def may_learn(self, *, on: bool) -> None:
        """See `lathe_rc.cell.stages.obedience.Learner`."""
        self._controller.learning = on

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

    def largest_delay(self, speed: float, acceleration: float, count: float, speed_window: float) -> int:
        """Longest feedback delay [sample] that the cycle leaves.

        Args:
            speed: largest of the spindle [rad/s].
            acceleration: largest of the spindle [rad/s²].
            count: angle of one encoder count [rad]: the measured angle is late by up to that; 0 if ideal.
            speed_window: time over which the encoder measures its speed [s]: one count more in it is a larger lead.
        """
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

    def process(self, first: int, inputs: Sequence[Signals], outputs: Sequence[Signals]) -> list[Sparse]:
        """See `Stage`."""
        command, *margin = outputs
        sparse: list[Sparse] = []
        if self._obedience is None:
            self._control(first, inputs, command["position"], sparse)
        else:
            self._obey(first, inputs, command["position"], sparse)
        for published in margin:
            self._fill_margin(first, published["stability_margin"], sparse)
        return sparse

    def _obey(self, first: int, inputs: Sequence[Signals], command: Samples, sparse: list[Sparse]) -> None:
        """The same under the supervisor, whose reactions are the last of the inputs."""
        assert self._obedience is not None, "that is what listens"
        *inputs, safety = inputs
        if self._obedience.idle(safety["reaction"]):
            self._control_until_lost(first, inputs, command, sparse)
            self._obedience.apply(command)
            return
        for start, stop in self._obedience.pieces(safety["reaction"]):
            sparse += self._obedience.told(first + start)
            self._control_until_lost(first + start, cut(inputs, start, stop), command[start:stop], sparse)
            self._obedience.apply(command[start:stop])

    def _fill_margin(self, first: int, margin: Samples, sparse: Sequence[Sparse]) -> None:
        """Each sample has the margin of the newest cycle; ``sparse`` has the cycles that end in the block."""
        margin.fill(self._margin)
        for message in sparse:
            if message.type == messages.LEARNING:
                self._margin = message.values["stability_margin"]
                margin[message.index - first :] = self._margin

    def _control_until_lost(
        self, first: int, inputs: Sequence[Signals], command: Samples, sparse: list[Sparse]
    ) -> None:
        """The same, but without an angle that it can use the controller gives up, and the command stays."""
        assert self._obedience is not None, "without one there is nobody to take over"
        if self._lost:
            command[:] = self._obedience.newest
            return
        try:
            self._control(first, inputs, command, sparse)
        except AngleLostError as error:
            self._lost = True
            command[error.reached :] = command[error.reached - 1] if error.reached else self._obedience.newest
            sparse.append(Sparse(f"{self.name}/events", messages.EVENT, first + error.reached, {"action": "lost"}))

    def _falls_back(self) -> bool:
        """Whether the lead angle shall be that of the nominal speed."""
        asked = self._obedience is not None and self._obedience.reaction >= Reaction.FALL_BACK
        return asked and self.parameters.fall_back == "constant_lead"

    def _control(self, first: int, inputs: Sequence[Signals], command: Samples, sparse: list[Sparse]) -> None:
        """Fill the command; what is said of cycles goes to ``sparse``, also where the angle is lost after them."""
        encoder, past, tool, *others = inputs
        parameters = self.parameters
        angle, speed, past_angle, error = encoder["angle"], encoder["speed"], past["angle"], tool["measured_error"]
        if parameters.law == "time_periodic":
            angle = parameters.nominal_speed * (parameters.step * np.arange(first, first + angle.size))
            past_angle = angle - parameters.nominal_speed * (parameters.step * parameters.feedback_delay)
        if parameters.law == "time_periodic" or self._falls_back():
            speed = np.full(angle.size, parameters.nominal_speed)
        for finer in others[: len(parameters.finer)]:
            error = error + finer["measured_position"]
        position = others[-1]["measured_position"] if parameters.identify else None
        identified = 0
        for cycle in self._controller.block(
            first, angle=angle, speed=speed, past_angle=past_angle, error=error, command=command
        ):
            if position is not None:
                reached = cycle.sample_index + 1 - first
                self._identifier.block(first, identified, reached, position)
                identified = reached
            sparse += self._end_cycle(cycle)
        if position is not None:
            self._identifier.block(first, identified, position.size, position)
            self._identifier.commanded(first, command)

    def _end_cycle(self, cycle: Cycle) -> list[Sparse]:
        parameters = self.parameters
        found = self._identifier.fit() if parameters.identify else None
        if found is not None:
            self._model = found
            if parameters.correction_model == "identified" and cycle.learning:
                self._controller.correction = replace(
                    self.correction, natural_frequency=found.natural_frequency, damping=found.damping
                )
        start, self._cycle_start = self._cycle_start, cycle.sample_index
        seconds = (cycle.sample_index - start) * self.shared.step
        status = {
            "cycle": cycle.number,
            "rms_error": cycle.rms,
            "max_error": cycle.largest,
            "contraction": cycle.contraction,
            "stability_margin": self._margins.at(2 * np.pi * parameters.cycle_revolutions / seconds, self._model),
            "learning": cycle.learning,
            "joined": self._controller.joined,
            "model_natural_frequency": self._model.natural_frequency,
            "model_damping": self._model.damping,
            "model_residual": self._model.residual,
        }
        sparse = [Sparse("coarse/learning", messages.LEARNING, cycle.sample_index, status)]
        if self._controller.joined and not self._joined:
            self._joined = True
            sparse.append(Sparse(f"{self.name}/events", messages.EVENT, cycle.sample_index, {"action": "joined"}))
        return sparse


class _Margins:
    """1 - sup|Q - γZ| of a drive model, tabulated as it is asked for: one costs as much as a cycle of samples."""

    def __init__(self, stage: LearningController) -> None:
        self._stage = stage
        self._speeds: list[float] = (stage.parameters.nominal_speed / 40 * np.arange(20, 61)).tolist()
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
        parameters = self._stage.parameters
        a, b = second_order(model.natural_frequency, model.damping)
        return discretise(a, b, parameters.model_delay, parameters.step, "foh").response

    def untabulated(self, speed: float, model: Identified) -> float:
        """The margin at ``speed`` [rad/s] of this very model; what was tabulated before and after does not matter."""
        return 1.0 - self._stage.loop(self._computed(model)).supremum(speed)

    def _supremum(self, speed: float, model: Identified) -> float:
        inverted = self._stage.correction
        models = (model.natural_frequency, model.damping, inverted.natural_frequency, inverted.damping)
        key = (speed, _three_digits(*models))
        if key not in self._suprema:
            _make_room(self._suprema)
            self._suprema[key] = self._stage.loop(self._response(model)).supremum(speed)
        return self._suprema[key]

    def at(self, speed: float, model: Identified) -> float:
        """The margin at ``speed`` [rad/s], between tabulated speeds by interpolation."""
        after = bisect_left(self._speeds, speed)
        if not 0 < after < len(self._speeds):
            return 1.0 - self._stage.loop(self._response(model)).supremum(speed)
        below, above = self._speeds[after - 1], self._speeds[after]
        lower, upper = self._supremum(below, model), self._supremum(above, model)
        return 1.0 - ((upper - lower) / (above - below) * (speed - below) + lower)


def _make_room(table: dict[Any, Any]) -> None:
    """Let the oldest entry go from a full table: a model that wanders would fill it for ever."""
    if len(table) >= _MOST:
        del table[next(iter(table))]


@lru_cache
def _three_digits(*numbers: float) -> tuple[str, ...]:
    return tuple(f"{number:.3g}" for number in numbers)
