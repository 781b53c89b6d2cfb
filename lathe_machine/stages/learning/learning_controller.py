# SPDX-License-Identifier: Apache-2.0
"""Self-learning controller of one channel, and its stability margin."""

from bisect import bisect_left
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from lathe_machine.analysis.learning import LearningLoop
from lathe_machine.control import angle_memory, memory_file
from lathe_machine.control.correction import Correction, CorrectionLaw
from lathe_machine.control.identification import DriveIdentifier, Identified
from lathe_machine.control.repetitive import Cycle, RepetitiveController, largest_feedback_delay
from lathe_machine.plants.linear import discretise, second_order
from lathe_machine.stages.common.obedience import OBEY, listens
from lathe_machine.stages.common.tables import made_of
from lathe_machine.stages.learning.learner import Learner
from lathe_machine.stages.learning.learning_parameters import LearningControllerParameters
from lathe_machine.stages.learning.learning_step import LOST_AT, Memory, step
from lathe_rc import messages
from lathe_rc.analysis.cycle_factors import Response, highest_waves
from lathe_rc.analysis.measured_drive import MeasuredDrive
from lathe_rc.arrays import Array, Complex
from lathe_rc.blocks.ports import Input, Output, Sparse
from lathe_rc.cell.events import OUT_OF_REACH
from lathe_rc.cell.parameters import Value, Values, about
from lathe_rc.cell.stage import WiredCell
from lathe_rc.errors import InputError
from lathe_rc.messages import MAX_BLOCK, Samples, Signals

_SETTLED = 4.0  # settling time of a drive, in lead times
_FILE_ACTIONS = ("save", "load")
_OF_Q = {"fir": ("q_pass", "q_stop")}  # parameters that act, by Q filter; of all others the width
_STATUS = "coarse/learning"  # topic
_MOST = 1024  # largest number of entries in a table of margins
_LEAST_Q = 1e-6  # [s] smallest Q width from which a wider Q is searched
_FLAT = 0.9  # largest factor per cycle for a flat Q, unless the scenario's own Q has a larger one
_CONVERGES = 0.98  # upper limit of this factor: the scenario may run with allow_unstable
_QS = 30  # number of candidates, each 25 % wider than the previous one
# Candidate leads, in lags: more for a drive that rings.
_LEADS = (1.0, 0.9, 1.1, 0.8, 1.2, 0.7, 1.3, 1.5, 1.75, 2.0, 2.25, 2.5)


class LearningController(Learner):
    """Repetitive controller of one drive (see `lathe_machine.control.repetitive`)."""

    kind = "learning_controller"
    Parameters = LearningControllerParameters
    actions = ("freeze", "learn", "clear", *_FILE_ACTIONS)
    announces = ("joined", "lost", OUT_OF_REACH)
    parameters: LearningControllerParameters
    factor = "sup|Q - Z|"
    remedy = "another lead, correction or Q"
    step = staticmethod(step)
    goes_on = (angle_memory.CYCLE_ENDED,)
    stops: ClassVar[Mapping[int, str]] = {
        **Learner.stops,
        angle_memory.AHEAD: "ahead: the memory would be read before it is learned (speed, lead and delay)",
        angle_memory.BEHIND: "behind: the spindle has turned back to where no memory is kept",
        angle_memory.JUMPED: "jumped: the spindle angle",
    }

    def __init__(self, name: str, parameters: LearningControllerParameters) -> None:
        super().__init__(name, parameters)
        lead = () if parameters.correction == "fir" else ("lead_time",)
        self.tunable = ("learning_gain", *lead, *_OF_Q.get(parameters.q_filter, ("q_time",)))
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
            weights=parameters.weights(name),
        )
        self._joined = self._controller.joined
        # The step stops at the end of a cycle only if that affects later samples; otherwise it is reported later.
        self._asks = parameters.identify or parameters.publish_margin or parameters.stop_ratio > 0.0
        self._first_rms = np.nan
        self._controller.table.whole[angle_memory.ASKS] = self._asks
        self._state, self._margin = np.array([0, 0, 0, 0, -1]), np.zeros(1)
        if parameters.correction_model == "identified" and not parameters.identify:
            raise InputError(f"{name}.correction_model = identified without identification; set identify as well")
        self._model = Identified(parameters.model_natural_frequency, parameters.model_damping, np.nan)
        self._margins = Margins(parameters)
        delay = parameters.feedback_delay
        self._cycle_start = delay  # sample of the first visible error
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
        block = MAX_BLOCK if parameters.identify else 0
        self._identifier = made_of(DriveIdentifier, parameters, "identification_", block=block)
        outputs = [Output("coarse/command", messages.COMMAND)]
        if parameters.publish_margin:
            outputs.append(Output("coarse/margin", messages.MARGIN))
            self._margin[0] = self._margins.untabulated(self, parameters.nominal_speed, self._model)
        self.declare(inputs=inputs, outputs=outputs)
        self.sparse_topics[_STATUS] = messages.LEARNING
        if self._scheduled_actions("load") and not self._scheduled_actions("save"):
            self._read_memory()

    # ---- the loop, for checks and margins -----------------------------------------------------------

    @property
    def adjustable(self) -> Sequence[str]:
        """Return gain, lead and Q."""
        return self.tunable

    def causes_off(self, cell: WiredCell) -> dict[str, Values | str]:
        """Return the cause ``Q floor``: Q is below 1. Off: it is 1 as far as the channel then converges."""
        loop = self.checked_loop(cell)
        flat = loop.flat(min(max(loop.factor({}), _FLAT), _CONVERGES))
        return {"Q floor": f"{self.name} converges with no flat Q" if flat is None else flat}

    @property
    def correction(self) -> Correction:
        """Current correction 1/W0."""
        return self._controller.correction

    def loop(self, drive: Response) -> LearningLoop:
        """Return the learning loop around a drive with the given response."""
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

    def factors(self, drive: Response, waves: Array, speed: float) -> Complex:
        """Return Q - γZ, shape (1, n)."""
        return self.loop(drive).operator(waves, speed)[None]

    def scaled_factors(self, drive: Response, speed: float, waves: Array, scales: Sequence[float]) -> Sequence[Complex]:
        """Return Q - γZ for the drive scaled by each of some numbers; Q and Z are computed once."""
        return [operator[None] for operator in self.loop(drive).operators(waves, speed, scales)]

    def highest_waves(self, speed: float) -> float:
        """Return the Nyquist limit of grid and sampling [waves per revolution]."""
        return highest_waves(self.parameters.points_per_revolution, self.parameters.step, speed)

    def worst(self, drive: Response, speed: float) -> tuple[float, float] | None:
        """Return sup|Q - γZ|, and the waves per revolution where it occurs."""
        if isinstance(drive, MeasuredDrive):
            return super().worst(drive, speed)
        return self.loop(drive).worst(speed)  # cached for equal loops

    def checked_speeds(self, low: float, high: float) -> Collection[float]:
        """Return the speeds at which convergence is checked [rad/s]; only one for a memory over time."""
        if self.parameters.law == "time_periodic":
            return {self.parameters.nominal_speed}
        return super().checked_speeds(low, high)

    def settings(self) -> str:
        """Return lead and Q, which decide whether learning converges, in words."""
        parameters = self.parameters
        q = f"q_time = {parameters.q_time * 1e6:.4g} µs"
        if parameters.q_filter == "fir":
            q = f"q_pass = {parameters.q_pass:.4g} rad/s, q_stop = {parameters.q_stop:.4g} rad/s"
        return f"lead_time = {parameters.lead_time * 1e3:.4g} ms, {q}"

    def cures(self, lag: float) -> Iterable[Iterable[Mapping[str, Value]]]:
        """Return candidate remedies: a lead near the lag left by the correction, or a Q that forgets more."""
        parameters = self.parameters
        if parameters.correction.startswith("second_order_inverse"):
            lag -= self.correction.inverse[0]
        elif parameters.correction == "lead_lag":
            lag -= self.correction.lead - self.correction.lag
        if parameters.correction != "fir":
            yield ({"lead_time": float(f"{part * lag:.3g}")} for part in _LEADS)
        q = [("q_time", max(parameters.q_time, _LEAST_Q), 1.25)]
        if parameters.q_filter == "fir":
            q = [("q_pass", parameters.q_pass, 0.8), ("q_stop", parameters.q_stop, 0.8)]
        yield ({name: float(f"{value * by**k:.2g}") for name, value, by in q} for k in range(1, _QS))

    def largest_delay(self, speed: float, acceleration: float, count: float, speed_window: float) -> int:
        """Return the longest feedback delay [sample] allowed by cycle and lead."""
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

    def check_cell(self, cell: WiredCell, *, cures: bool = True) -> None:
        """Check that an exact preview has the spindle's speed law, in addition to the checks of `Learner`."""
        master = cell.master
        if self.parameters.lead_law == "exact_preview":
            own, true = self.parameters.speed_law(self.name), master.law
            if true is None:
                raise InputError(
                    f"{self.name}.lead_law = exact_preview, but nobody knows the speed of {master.name} in advance; "
                    "allowed: another lead law"
                )
            if not (np.array_equal(own.lines, true.lines) and np.array_equal(own.tachogram, true.tachogram)):
                raise InputError(
                    f"{self.name}.lead_law = exact_preview, but it does not know the speed of {master.name}; give "
                    f"it the same deviation, tachogram and random parameters"
                )
        super().check_cell(cell, cures=cures)

    # ---- events -------------------------------------------------------------------------------------

    def check_action(self, action: str) -> None:
        """Check that an event is known to the controller and that its file exists."""
        super().check_action(action)
        if action in _FILE_ACTIONS and not self.parameters.memory_file:
            raise InputError(f"{self.name}.memory_file is empty; name the file for the event {action!r}")

    def schedule(self, action: str, at: float, kind: str = "sample") -> None:
        """Schedule an event; a memory that cannot be loaded is rejected now, instead of in mid-run."""
        self.check_action(action)
        if action == "load":
            self._read_memory()
        super().schedule(action, at, kind)

    def _read_memory(self) -> np.ndarray:
        parameters = self.parameters
        path = Path(parameters.memory_file)
        with about(self.name, "memory_file"):
            return memory_file.load(path, parameters.cycle_points, parameters.points_per_revolution)

    def perform(self, action: str) -> None:
        """Carry out an event, effective from the next sample."""
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

    def tune(self, parameters: LearningControllerParameters) -> None:
        """Continue with another gain, lead or Q from the next sample on; the memory is kept."""
        self._q = parameters.make_q(self.name)
        self._margins.forget_suprema()
        self._controller.retune(self._q, parameters.learning_gain, parameters.make_preview(self.name))

    def forget(self) -> None:
        """Forget the tabulated margins, which depend on gain, lead and Q."""
        self._margins.forget_suprema()

    # ---- samples ------------------------------------------------------------------------------------

    @property
    def memory(self) -> Memory:
        """Current memory of the step of the learning controller."""
        parameters = self.parameters
        return Memory(
            control=self._controller.table,
            preview=self._controller.preview.table,
            identifier=self._identifier.table,
            who=self.listener,
            nominal=parameters.nominal_speed,
            period=parameters.step,
            by_time=parameters.law == "time_periodic",
            falls_back=parameters.fall_back == "constant_lead",
            rates=self.correction.law not in (CorrectionLaw.NONE, CorrectionLaw.FIR),
            finer=len(parameters.finer),
            identifies=parameters.identify,
            margin=self._margin,
            state=self._state,
        )

    @property
    def needs_python(self) -> str:
        """Return why the step needs Python: other filters than the exponential one, and what a cycle's end changes."""
        parameters = self.parameters
        if self._q.ratio < 0.0:
            return f"q_filter = {parameters.q_filter} is computed in Python; allowed: exponential"
        if parameters.correction_model == "identified":
            return "correction_model = identified is computed in Python; allowed: given"
        if parameters.publish_margin:
            return "publish_margin = true: the margin is computed in Python; allowed: false, and no monitor of it"
        if parameters.stop_ratio:
            return f"stop_ratio = {parameters.stop_ratio:g} is watched in Python; allowed: 0"
        return super().needs_python

    @property
    def of_block(self) -> list[Samples]:
        """Return the scratch arrays of the memory too."""
        table = self._controller.table
        return [*super().of_block, table.windows, table.ahead]

    @property
    def handles(self) -> Mapping[str, tuple[np.ndarray, int]]:
        """Return whether it learns."""
        own = self._controller.table.whole, angle_memory.LEARNS
        return {"learning": self._obedience.wanted if self._obedience else own}

    def serve(
        self, reason: int, first: int, reached: int, inputs: Sequence[Signals], outputs: Sequence[Signals]
    ) -> list[Sparse]:
        """Smooth the memory, end a cycle, or react to the supervisor.

        Raises:
            AngleLostError: the memory cannot be read at the angle that was measured.
        """
        if reason == OBEY:
            return super().serve(reason, first, reached, inputs, outputs)
        if reason == angle_memory.SMOOTH:
            self._controller.smooth()
            return []
        if reason == angle_memory.CYCLE_ENDED:
            return self._newest_cycle() if self._asks else []
        angle, speed, past_angle = inputs[0]["angle"], inputs[0]["speed"], inputs[1]["angle"]
        raise self._controller.lost(reason, first, reached, angle, speed, past_angle)

    def _newest_cycle(self) -> list[Sparse]:
        """Complete the cycle that ended with the previous sample; its results apply from that sample on."""
        sparse = [message for cycle in self._controller.ended() for message in self._end_cycle(cycle)]
        self._margin[0] = sparse[0].values["stability_margin"]
        return sparse

    def tell(self, first: int, end: int) -> list[Sparse]:
        """Return messages about completed cycles and the loss of the angle."""
        sparse: list[Sparse] = []
        if not self._asks:
            sparse += [message for cycle in self._controller.ended() for message in self._end_cycle(cycle)]
        if self._state[LOST_AT] >= 0:
            index, self._state[LOST_AT] = int(self._state[LOST_AT]), -1
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
        sparse: list[Sparse] = []
        if self._asks or _STATUS not in self.unheard:  # a margin costs as much as a cycle of samples
            seconds = (cycle.sample_index - start) * self.shared.step
            speed = 2 * np.pi * parameters.cycle_revolutions / seconds
            status = {
                "cycle": cycle.number,
                "rms_error": cycle.rms,
                "max_error": cycle.largest,
                "contraction": cycle.contraction,
                "stability_margin": self._margins.at(self, speed, self._model),
                "learning": cycle.learning,
                "joined": cycle.joined,
                "model_natural_frequency": self._model.natural_frequency,
                "model_damping": self._model.damping,
                "model_residual": self._model.residual,
            }
            sparse.append(Sparse(_STATUS, messages.LEARNING, cycle.sample_index, status))
        joins, self._joined = cycle.joined and not self._joined, cycle.joined
        if joins:
            sparse.append(Sparse(f"{self.name}/events", messages.EVENT, cycle.sample_index, {"action": "joined"}))
        return sparse


class Margins:
    """Stability margins 1 - sup|Q - γZ| of a drive model, tabulated on demand: one costs as much as a cycle of samples.

    Args:
        parameters: parameters of the stage.
    """

    def __init__(self, parameters: LearningControllerParameters) -> None:
        self._parameters = parameters
        self._speeds: list[float] = (parameters.nominal_speed / 40 * np.arange(20, 61)).tolist()  # of the table [rad/s]
        self._models: dict[tuple[str, ...], Identified] = {}
        self._responses: dict[tuple[str, ...], Response] = {}
        self._suprema: dict[tuple[object, ...], float] = {}

    def __getstate__(self) -> dict[str, Any]:
        """Return the attributes that are state, without the responses, which are computed on demand."""
        return {**self.__dict__, "_responses": {}}

    def forget_suprema(self) -> None:
        """Forget what depends on gain, lead and Q."""
        self._suprema.clear()

    def _response(self, model: Identified) -> Response:
        # Three digits of a model exceed the accuracy of its margin, and a steady model is computed once.
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

    def untabulated(self, stage: "LearningController", speed: float, model: Identified) -> float:
        """Return the margin of a model at ``speed`` [rad/s], independent of the table."""
        return 1.0 - stage.loop(self._computed(model)).supremum(speed)

    def _supremum(self, stage: "LearningController", speed: float, model: Identified) -> float:
        inverted = stage.correction
        models = (model.natural_frequency, model.damping, inverted.natural_frequency, inverted.damping)
        key = (speed, _three_digits(*models))
        if key not in self._suprema:
            _make_room(self._suprema)
            self._suprema[key] = stage.loop(self._response(model)).supremum(speed)
        return self._suprema[key]

    def at(self, stage: "LearningController", speed: float, model: Identified) -> float:
        """Return the margin at ``speed`` [rad/s], interpolated between tabulated speeds."""
        speeds, after = self._speeds, bisect_left(self._speeds, speed)
        # Outside the table each speed would need a new entry.
        if not 0 < after < len(speeds):
            return 1.0 - stage.loop(self._response(model)).supremum(speed)
        below, above = speeds[after - 1], speeds[after]
        lower, upper = self._supremum(stage, below, model), self._supremum(stage, above, model)
        return 1.0 - ((upper - lower) / (above - below) * (speed - below) + lower)


def _make_room(table: dict[Any, Any]) -> None:
    """Remove the oldest entry of a full table, which a drifting model would otherwise fill without limit."""
    if len(table) >= _MOST:
        del table[next(iter(table))]


@lru_cache
def _three_digits(*numbers: float) -> tuple[str, ...]:
    return tuple(f"{number:.3g}" for number in numbers)
