# SPDX-License-Identifier: Apache-2.0
"""Stages for many cells at once: what a lane has alone is the last axis of every array.

Stages that are equal in all lanes run once (`Shared`). Those that cost most have kernels of their own; all others,
and those with options that the kernels leave out, run lane by lane (`Separate`). Bits are those of single cells.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, Generic, TypeVar, cast

import numpy as np
import numpy.typing as npt

from lathe_rc.cell import messages
from lathe_rc.cell.messages import Signals
from lathe_rc.cell.parameters import NodeParameters
from lathe_rc.cell.stage import Stage
from lathe_rc.cell.stages.electrodynamic_actuator import ElectrodynamicActuator
from lathe_rc.cell.stages.learning_controller import LearningController
from lathe_rc.cell.stages.piezo_actuator import PiezoActuator
from lathe_rc.cell.stages.tool import Tool
from lathe_rc.control import angle_memory, angle_memory_lanes
from lathe_rc.control.correction import CorrectionLaw
from lathe_rc.control.repetitive import memory_size
from lathe_rc.errors import LatheError
from lathe_rc.plants import lanes as plants
from lathe_rc.plants.hysteresis import PLAYS
from lathe_rc.signals.noise import Sensor

Array = npt.NDArray[np.float64]
S = TypeVar("S", bound=Stage)


class LaneStage(ABC, Generic[S]):
    """A stage in all lanes.

    Args:
        stages: one for each lane.

    Attributes:
        stages: see above.
        shared: fields of the outputs that are equal in all lanes and have no axis for them.
        curve: for controllers: RMS and largest error of each cycle [m], shape (lanes,) each.
    """

    shared: tuple[str, ...] = ()

    def __init__(self, stages: Sequence[S]) -> None:
        self.stages = stages
        self.curve: list[tuple[Array, Array]] = []

    @abstractmethod
    def process(self, first: int, inputs: Sequence[Signals], outputs: Sequence[Signals]) -> None:
        """See `Stage.process`; arrays have the shape (n, lanes), or (n,) where they are shared."""


class Shared(LaneStage[Stage]):
    """A stage that is equal in all lanes."""

    def __init__(self, stages: Sequence[Stage]) -> None:
        super().__init__(stages)
        self.shared = tuple(name for port in stages[0].outputs for name in messages.sample_fields(port.type))

    def process(self, first: int, inputs: Sequence[Signals], outputs: Sequence[Signals]) -> None:
        """See `LaneStage`."""
        self.stages[0].advance(first, inputs, outputs)


class Separate(LaneStage[Stage]):
    """Lane by lane."""

    def process(self, first: int, inputs: Sequence[Signals], outputs: Sequence[Signals]) -> None:
        """See `LaneStage`."""
        samples = next(iter(outputs[0].values())).shape[0]
        own = [{name: np.empty(samples, array.dtype) for name, array in port.items()} for port in outputs]
        found = []
        for lane, stage in enumerate(self.stages):
            seen = [
                {name: a if a.ndim == 1 else np.ascontiguousarray(a[:, lane]) for name, a in port.items()}
                for port in inputs
            ]
            sparse = stage.advance(first, seen, own)
            found.append([message.values for message in sparse if message.type == messages.LEARNING])
            for port, mine in zip(outputs, own, strict=True):
                for name, array in mine.items():
                    port[name][:, lane] = array
        for cycles in zip(*found, strict=True):
            self.curve.append((np.array([c["rms_error"] for c in cycles]), np.array([c["max_error"] for c in cycles])))


def _measure(sensors: Sequence[Sensor], true: Array, measured: Array) -> None:
    measured[:] = true
    for lane, sensor in enumerate(sensors):
        if sensor.disturbs:
            column = np.empty(true.shape[0])
            sensor.measure(np.ascontiguousarray(true[:, lane]), column)
            measured[:, lane] = column


class LearningLanes(LaneStage[LearningController]):
    """Self-learning controllers without correction, events, identification, margin or supervisor; an exponential Q."""

    def __init__(self, stages: Sequence[LearningController]) -> None:
        super().__init__(stages)
        tables = [stage.parameters for stage in stages]
        qs = [table.make_q() for table in tables]
        self._table, self._delay = tables[0], tables[0].feedback_delay
        self._gain = np.array([table.learning_gain for table in tables])
        self._ramp = np.array([table.soft_start * table.points_per_revolution for table in tables])
        self._lead_time = np.array([table.preview_time for table in tables])
        self._constant = np.array([table.constant_lead for table in tables])
        self._join_below = np.array([table.join_below or np.inf for table in tables])
        self._ratio, reach = np.array([q.ratio for q in qs]), np.array([q.reach for q in qs])
        self._skipped = reach.max() - reach
        lanes, chunk = len(stages), qs[0].chunk
        self._memory = np.zeros((max(memory_size(self._table.cycle_points, q) for q in qs), lanes))
        self._chunk = np.zeros((chunk, lanes))
        self._backward = np.empty((chunk + 2 * reach.max(), lanes))
        self._scratch = np.empty((3, lanes))
        self._sample = np.empty(angle_memory.PIECE, dtype=np.int64)
        self._place = np.empty(angle_memory.PIECE + 1)
        self._whole = np.zeros(angle_memory.INTEGERS, dtype=np.int64)
        self._whole[angle_memory.CHUNK] = angle_memory.NO_CHUNK
        self._since = np.zeros(lanes, dtype=np.int64)
        self._joined = np.isinf(self._join_below)
        self._real = np.zeros((4, lanes))
        self._angles, self._errors = np.zeros(3), np.zeros((3, lanes))

    @staticmethod
    def fits(stages: Sequence[LearningController]) -> bool:
        """Whether the kernels can run them."""
        tables = [stage.parameters for stage in stages]
        first = tables[0]
        return all(
            table.law == "angle_domain"
            and table.lead_law in ("variable", "constant_angle")
            and table.lead_law == first.lead_law
            and stage.correction.law is CorrectionLaw.NONE
            and table.q_filter == "exponential"
            and table.make_q().chunk == first.make_q().chunk
            and not table.identify
            and not table.reaction_delay
            and not table.publish_margin
            and table.cycle_points == first.cycle_points
            and table.points_per_revolution == first.points_per_revolution
            for table, stage in zip(tables, stages, strict=True)
        )

    def process(self, first: int, inputs: Sequence[Signals], outputs: Sequence[Signals]) -> None:
        """See `LaneStage`."""
        (encoder, past, tool, *others), (command,) = inputs, outputs
        angle, speed = encoder["angle"], encoder["speed"]
        if self._table.lead_law == "constant_angle":
            speed = np.full(angle.size, self._table.nominal_speed)
        lead = angle_memory_lanes.largest_lead(self._lead_time, self._constant, speed)
        errors = np.concatenate((self._errors, tool["measured_error"]))
        for finer in others:
            errors[3:] += _spread(finer["measured_position"], len(self.stages))
        angles = np.concatenate((self._angles, past["angle"]))
        arrives = min(max(self._delay - first, 0), angle.size)
        self._arrive(arrives, angles, errors)
        told, reached, reason = 0, 0, angle_memory.CYCLE_ENDED
        while reason == angle_memory.CYCLE_ENDED:
            reached, reason = angle_memory_lanes.learn(
                reached, arrives, self._table.points_per_revolution, self._table.cycle_points,
                self.stages[0].correction.looks_ahead, self._joined, self._gain, self._ramp, self._ratio,
                self._skipped, self._since, angle, lead, angles, errors, self._sample, self._place, self._chunk,
                self._backward, self._scratch, self._memory, self._whole, self._real,
            )  # fmt: skip
            angle_memory_lanes.send(
                told, reached, self._table.points_per_revolution, self._table.cycle_points, self._lead_time,
                self._constant, self._memory, angle, speed, command["position"],
            )  # fmt: skip
            told = reached
            if reason == angle_memory.CYCLE_ENDED:
                self._end_cycle()
        if reason != angle_memory.DONE:
            raise LatheError(
                f"sample {first + reached}: the memory of {self.stages[0].name} is read where nothing is learned "
                "or kept, or the spindle angle jumps; run the cells one by one to see which"
            )

    def _arrive(self, arrives: int, angles: Array, errors: Array) -> None:
        """Take care of the first errors of the run, and keep the newest three; see `angle_memory.step`."""
        if arrives < angles.size - 3 and self._whole[angle_memory.SEEN] == 0:
            self._whole[angle_memory.SEEN] = 1
            angles[: arrives + 3], errors[: arrives + 3] = angles[arrives + 3], errors[arrives + 3]
            per_radian = self._table.points_per_revolution / (2.0 * np.pi)
            self._whole[angle_memory.NEXT] = int(np.ceil(angles[arrives + 3] * per_radian))
            self._since[:] = np.maximum(self._since, self._whole[angle_memory.NEXT])
        self._angles, self._errors = angles[-3:].copy(), errors[-3:].copy()

    def _end_cycle(self) -> None:
        rms = np.sqrt(self._real[angle_memory_lanes.CYCLE_SQUARES] / self._table.cycle_points)
        largest = self._real[angle_memory_lanes.CYCLE_LARGEST].copy()
        self.curve.append((rms, largest))
        joins = ~self._joined & (largest <= self._join_below)
        self._since[joins] = self._whole[angle_memory.NEXT]
        self._joined |= joins


class ElectrodynamicLanes(LaneStage[ElectrodynamicActuator]):
    """Coarse drives."""

    def __init__(self, stages: Sequence[ElectrodynamicActuator]) -> None:
        super().__init__(stages)
        tables, drives = [stage.parameters for stage in stages], [stage.drive.plant for stage in stages]
        self._transition = np.stack([plant.transition for plant in drives], axis=-1)
        self._weights = np.stack([plant.weights for plant in drives], axis=-1)
        self._part = np.array([plant.fraction for plant in drives])
        self._spring = np.array([table.natural_frequency**2 for table in tables])
        self._damper = np.array([2.0 * table.damping * table.natural_frequency for table in tables])
        self._force = np.array([table.moving_mass / table.force_constant for table in tables])
        self._stroke = np.array([table.stroke for table in tables])
        delay = np.array([plant.delay for plant in drives])
        self._early = delay.max() - delay
        self._line = np.zeros((delay.max() + 2, len(stages)))
        self._state, self._stopped = np.zeros((2, len(stages))), np.zeros(len(stages), dtype=np.int64)
        self._sensors = [Sensor(t.noise_rms, t.resolution, t.seed, s.name) for t, s in zip(tables, stages, strict=True)]

    def process(self, first: int, inputs: Sequence[Signals], outputs: Sequence[Signals]) -> None:
        """See `LaneStage`."""
        (command,), (state,) = inputs, outputs
        plants.electrodynamic(
            self._transition, self._weights, self._part, self._spring, self._damper, self._force, self._stroke,
            self._early, self._state, self._line, self._stopped, command["position"], state["position"],
            state["velocity"], state["effort"],
        )  # fmt: skip
        _measure(self._sensors, state["position"], state["measured_position"])


class PiezoLanes(LaneStage[PiezoActuator]):
    """Fine drives whose hysteresis and inverse are plays, without creep."""

    def __init__(self, stages: Sequence[PiezoActuator]) -> None:
        super().__init__(stages)
        tables, plants_ = [stage.parameters for stage in stages], [stage.drive.plant for stage in stages]
        stacks = [stage.parameters.stack(stage.name) for stage in stages]
        laws = [stack.table for stack in stacks]
        self._stroke = np.array([law.stroke for law in laws])
        self._lag = np.array([[law.decay, law.now, law.before] for law in laws]).T.copy()
        self._inverse = np.stack([law.inverse.table for law in laws], axis=-1)
        self._forward = np.stack([law.forward.table for law in laws], axis=-1)
        self._transition = np.stack([plant.transition for plant in plants_], axis=-1)
        self._weights = np.stack([plant.weights for plant in plants_], axis=-1)
        self._voltage = np.array([table.full_voltage for table in tables])
        lanes = len(stages)
        self._inverse_state = np.zeros((self._inverse.shape[1] - 1, lanes))
        self._forward_state = np.zeros((self._forward.shape[1] - 1, lanes))
        self._state, self._saturated = np.zeros((5, lanes)), np.zeros(lanes, dtype=np.int64)
        self._sensors = [Sensor(t.noise_rms, t.resolution, t.seed, s.name) for t, s in zip(tables, stages, strict=True)]

    @staticmethod
    def fits(stages: Sequence[PiezoActuator]) -> bool:
        """Whether the kernel can run them."""
        laws = [stage.parameters.stack(stage.name).table for stage in stages]
        tables, first = [stage.parameters for stage in stages], stages[0].parameters
        return all(
            (table.use_command, table.use_reference, table.compensates)
            == (first.use_command, first.use_reference, first.compensates)
            for table in tables
        ) and all(
            law.inverse.kind == PLAYS
            and law.forward.kind == PLAYS
            and not law.creep.size
            and law.inverse.table.shape == laws[0].inverse.table.shape
            and law.forward.table.shape == laws[0].forward.table.shape
            for law in laws
        )

    def process(self, first: int, inputs: Sequence[Signals], outputs: Sequence[Signals]) -> None:
        """See `LaneStage`."""
        (state,) = outputs
        set_point = np.empty_like(state["position"])
        self.stages[0].set_point.fill([_columns(port) for port in inputs], set_point)
        plants.piezo(
            self._stroke, self._lag, self._inverse, self._forward, self._transition, self._weights, self._voltage,
            self._inverse_state, self._forward_state, self._state, self._saturated, set_point, state["position"],
            state["velocity"], state["effort"],
        )  # fmt: skip
        _measure(self._sensors, state["position"], state["measured_position"])


def _spread(array: Array, lanes: int) -> Array:
    """An array (n, lanes), also of a signal that is equal in all lanes."""
    return array if array.ndim == 2 else np.repeat(array[:, None], lanes, axis=1)


def _columns(signals: Signals) -> Signals:
    return {name: array[:, None] if array.ndim == 1 else array for name, array in signals.items()}


class ToolLanes(LaneStage[Tool]):
    """The tool on a form of its own that is the same in all lanes, with nothing but its drives."""

    shared = ("reference", "height")

    @staticmethod
    def fits(stages: Sequence[Tool]) -> bool:
        """Whether the kernel can run them."""
        first = stages[0].parameters
        plain = first.reference == "own" and first.height_from == "feed" and not (first.cross_slide or first.deflects)
        return plain and all(same(first, stage.parameters) for stage in stages)

    def process(self, first: int, inputs: Sequence[Signals], outputs: Sequence[Signals]) -> None:
        """See `LaneStage`."""
        (tool,), form, lanes = outputs, self.stages[0].form, len(self.stages)
        assert form is not None
        expected = np.empty_like(tool["reference"])
        form.block(inputs, tool["reference"], expected, tool["height"])
        for place, state in enumerate(inputs[len(form.inputs) :]):
            position, measured = (_spread(state[name], lanes) for name in ("position", "measured_position"))
            plants.add_drive(
                place == 0, tool["reference"], expected, position, measured, tool["displacement"],
                tool["measured_error"], tool["error"],
            )  # fmt: skip


def same(one: NodeParameters, other: NodeParameters) -> bool:
    """Whether two tables say the same but for the name of the run."""
    return one == other.model_copy(update={"run_id": one.run_id})


_LANES: list[tuple[type[Stage], Any, Callable[[Any], bool]]] = [
    (LearningController, LearningLanes, LearningLanes.fits),
    (ElectrodynamicActuator, ElectrodynamicLanes, lambda _: True),
    (PiezoActuator, PiezoLanes, PiezoLanes.fits),
    (Tool, ToolLanes, ToolLanes.fits),
]


def lane_stage(stages: Sequence[Stage], *, shared: bool) -> LaneStage[Any]:
    """What steps some stages of one kind at once; ``shared`` if all that they read is the same in all lanes."""
    if shared and all(same(stages[0].shared, stage.shared) for stage in stages):
        return Shared(stages)
    eventful = any(stage.shared.events or stage.shared.faults or stage.tells for stage in stages)
    for kind, lanes, fits in _LANES:
        if isinstance(stages[0], kind) and not eventful and fits(stages):
            return cast("LaneStage[Any]", lanes(stages))
    return Separate(stages)
