# SPDX-License-Identifier: Apache-2.0
"""Cells in plain C (benchmarks/c), filled from the stages of a scenario."""

import ctypes
import math
import subprocess
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from lathe_machine.control.lead import LeadLaw
from lathe_machine.signals.encoder import EncoderTable
from lathe_machine.stages.cut.cutting_process import CuttingProcessStage
from lathe_machine.stages.drive.electrodynamic_actuator import ElectrodynamicActuator
from lathe_machine.stages.drive.piezo_actuator import PiezoActuator
from lathe_machine.stages.feed.decoupler import DecouplerStage
from lathe_machine.stages.feed.feed_drive import FeedDriveStage
from lathe_machine.stages.feed.force_controller import ForceController
from lathe_machine.stages.feed.position_controller import PositionController
from lathe_machine.stages.learning.learning_controller import LearningController
from lathe_machine.stages.spindle.spindle_encoder import SpindleEncoder
from lathe_machine.stages.tool.tool import Tool
from lathe_machine.transfer import System
from lathe_rc import messages
from lathe_rc.cell.stage import Stage
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import LatheError
from lathe_rc.signals.noise import DRAWN

FLAGS = ("-O3", "-march=native", "-std=c11")
_FOLDER = Path(__file__).parent / "c"
_LINES, _PLAYS, _ORDER = 4, 16, 6  # as in laws.h
_POINTER = ctypes.POINTER(ctypes.c_double)
_NO_CHUNK = -(1 << 62)
_CACHE_LINE = 64  # [B]

Array = npt.NDArray[np.float64]
S = TypeVar("S", bound=Stage)


def compiled(name: str, *flags: str) -> ctypes.CDLL:
    """A C file as a library.

    Raises:
        LatheError: the compiler refuses it.
    """
    folder = Path(tempfile.mkdtemp(prefix="lathe-c-"))
    library = folder / f"{name}.so"
    command = ["cc", *FLAGS, *flags, "-shared", "-fPIC", "-o", str(library), str(_FOLDER / f"{name}.c"), "-lm"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise LatheError(f"{' '.join(command)}: {done.stderr}")
    return ctypes.CDLL(str(library))


# ---- structures of laws.h --------------------------------------------------------------------------------------------


def _whole(names: str) -> list[tuple[str, Any]]:
    return [(name, ctypes.c_int64) for name in names.split()]


def _real(names: str) -> list[tuple[str, Any]]:
    return [(name, ctypes.c_double) for name in names.split()]


def _reals(size: int, names: str) -> list[tuple[str, Any]]:
    return [(name, ctypes.c_double * size) for name in names.split()]


def _pointers(names: str) -> list[tuple[str, Any]]:
    return [(name, _POINTER) for name in names.split()]


class _Structure(ctypes.Structure):
    """A structure that is filled by the names of its members."""

    @classmethod
    def of(cls, *tables: object, **values: Any) -> "_Structure":
        """Filled from what is given by name, and otherwise from the first table that has the name; else 0.

        Arrays are copied where the C has them itself. What it has a pointer to must live as long as it does.
        """
        made = cls()
        for name, kind, *_ in cls._fields_:
            table = next((table for table in tables if hasattr(table, name)), None)
            if name in values:
                setattr(made, name, _as(kind, values[name]))
            elif table is not None:
                setattr(made, name, _as(kind, getattr(table, name)))
        assert values.keys() <= {name for name, *_ in cls._fields_}, f"{cls.__name__} has no {list(values)}"
        return made


def _as(kind: Any, value: Any) -> Any:
    """A value as a member of some type."""
    if kind is _POINTER:
        assert value.flags.c_contiguous, "the C takes it for contiguous"
        return value.ctypes.data_as(_POINTER)
    if hasattr(kind, "_length_"):
        numbers = np.ravel(value).tolist()
        assert len(numbers) <= kind._length_, f"{len(numbers)} numbers, room for {kind._length_}"
        return kind(*numbers)
    return value if isinstance(value, ctypes.Structure) else kind(value).value


class _Spindle(_Structure):
    _fields_ = [
        *_whole("count"),
        *_real("step nominal"),
        *_reals(_LINES, "amplitude frequency phase start cosine"),
        *_real("revolution"),
    ]


class _Channel(_Structure):
    _fields_ = [
        *_whole("grid cycle mask reach size looks_ahead"),
        *_real("lead_time constant gain ratio join_below"),
        *_pointers("memory scratch forward smoothed"),
        *_whole("point base learn_from joined seen ahead"),
        *_reals(4, "angle error"),
        *_real("squares largest"),
    ]


class _Coarse(_Structure):
    _fields_ = [
        *_reals(4, "transition"),
        *_reals(6, "weights"),
        *_real("part spring damper force_per_current stroke x v"),
        *_whole("stopped"),
    ]


class _Plays(_Structure):
    _fields_ = [*_whole("count"), *_real("proportional"), *_reals(_PLAYS, "threshold weight position")]


class _Fine(_Structure):
    _fields_ = [
        *_reals(4, "transition"),
        *_reals(6, "weights"),
        *_real("stroke full_voltage decay now before"),
        ("inverse", _Plays),
        ("forward", _Plays),
        *_real("amplified applied extension x v"),
        *_whole("saturated"),
    ]


class _Form(_Structure):
    _fields_ = [*_whole("rows points"), *_real("feed start"), *_pointers("heights table"), *_whole("row")]


class _System(_Structure):
    _fields_ = [
        *_whole("order"),
        *_reals(_ORDER**2, "transition"),
        *_reals(_ORDER, "before now output"),
        *_real("through"),
        *_reals(_ORDER, "state"),
        *_real("last"),
    ]


class _Allowance(_Structure):
    _fields_ = [
        *_whole("waves"),
        *_real("keep kick start"),
        *_reals(_LINES, "order amplitude phase"),
        *_real("walk"),
        *_whole("begun"),
    ]


class _Cut(_Structure):
    _fields_ = [
        *_real("step depth sign kc1 mc wear_factor per_metre per_second radius compliance lag_now mode_now"),
        ("lag", _System),
        ("mode", _System),
        ("blank", _Allowance),
        *_real("wear"),
        *_whole("apart backwards"),
    ]


class _Pid(_Structure):
    _fields_ = [
        *_whole("divisor"),
        *_real("proportional integral derivative decay low high adc dac ramp approach set_point"),
        *_real("sum slope error wanted command"),
        *_whole("saturated clamped slowed"),
    ]


class _Feed(_Structure):
    _fields_ = [
        *_whole("order divisor"),
        *_reals(9, "transition"),
        *_reals(3, "weights"),
        *_real("command_limit"),
        *_reals(3, "state"),
        *_real("effort"),
        *_whole("saturated"),
    ]


# ---- the laws of the stages ------------------------------------------------------------------------------------------


def _stage(cell: Cell, name: str, kind: type[S]) -> S:
    stage = cell.stages[name]
    assert isinstance(stage, kind), f"{name} is a {stage.kind}"
    return stage


def _spindle(cell: Cell) -> _Structure:
    table = _stage(cell, "spindle_encoder", SpindleEncoder).memory
    assert isinstance(table, EncoderTable), "an encoder"
    assert (table.counts, table.errors.real) == (0, False), "an ideal encoder"
    assert not table.tachogram.size, "no tachogram"
    amplitude, frequency, phase, start = table.lines
    return _Spindle.of(
        table,
        count=phase.size,
        amplitude=amplitude,
        frequency=frequency,
        phase=phase,
        start=start,
        cosine=[math.cos(angle) for angle in phase],  # NumPy's differs in the last bit
        revolution=table.revolution[0],
    )


def _channel(cell: Cell, name: str) -> _Structure:
    memory = _stage(cell, name, LearningController).memory
    table, lead = memory.control, memory.preview
    extras = memory.identifies, memory.who.listens, memory.by_time, memory.rates, table.ramp
    assert not any(extras), "no identification, supervisor, correction or soft start, and the angle for the memory"
    assert table.ratio >= 0.0, "an exponential Q"
    assert lead.law == LeadLaw.VARIABLE, "a lead that varies with the speed"
    return _Channel.of(
        table,
        lead,
        mask=table.memory.size - 1,
        size=table.chunk.size,
        scratch=table.scratch[0],
        forward=table.scratch[1],
        smoothed=table.chunk,
        base=_NO_CHUNK,
        joined=table.join_below == np.inf,
        ahead=0,
    )


def _coarse(cell: Cell) -> _Structure:
    return _Coarse.of(_stage(cell, "electrodynamic_actuator", ElectrodynamicActuator).memory.plant.drive, stopped=0)


def _plays(table: Array) -> _Structure:
    threshold, weight = table
    return _Plays.of(count=weight.size - 1, proportional=weight[0], threshold=threshold[1:], weight=weight[1:])


def _fine(cell: Cell) -> _Structure:
    table = _stage(cell, "piezo_actuator", PiezoActuator).memory.drive
    assert not table.stack.creep.size, "no creep"
    inverse, forward = _plays(table.stack.inverse.table), _plays(table.stack.forward.table)
    return _Fine.of(table, table.stack, inverse=inverse, forward=forward, saturated=0)


def _form(cell: Cell) -> _Structure:
    table = _stage(cell, "tool", Tool).memory.form
    assert not table.part, "one part without end"
    assert table.alike, "controllers that are told where the tool has to be"
    return _Form.of(table, rows=table.heights.size, points=table.table.shape[1])


def _system(table: System) -> _Structure:
    return _System.of(table, order=table.now.size)


def _cut(cell: Cell) -> _Structure:
    memory = _stage(cell, "cutting_process", CuttingProcessStage).memory
    process, made = memory.cut.process, memory.allowance
    extras = process.spots.size, process.gaps.size, process.overlap, memory.sensor.rms, memory.sensor.resolution
    assert extras == (0, 0, 0.0, 0.0, 0.0), "an even part without regeneration, and an ideal sensor"
    assert process.flank.pressure == 0.0, "no process damping"
    assert process.compliances.size == 1, "the same compliance everywhere"
    order, amplitude, phase = made.run_out
    blank = _Allowance.of(made.walk, waves=order.size, order=order, amplitude=amplitude, phase=phase)
    return _Cut.of(
        process,
        process.material,
        process.wear,
        compliance=process.compliances[0],
        lag=_system(process.lag),
        mode=_system(process.mode),
        blank=blank,
        wear=memory.cut.state[0],
    )


def _pid(cell: Cell, name: str, kind: type[ForceController] | type[PositionController]) -> _Structure:
    stage = cell.stages[name]
    assert isinstance(stage, kind), f"{name} is a {stage.kind}"
    table, parameters = getattr(stage.memory, "pid"), stage.parameters  # noqa: B009 - only of the PID among its laws
    assert (parameters.trajectory, parameters.set_point_time) == ("steps", []), "one set point for the whole run"
    return _Pid.of(table, set_point=(parameters.set_point or [0.0])[0])


def _feed(cell: Cell, name: str) -> _Structure:
    memory = _stage(cell, name, FeedDriveStage).memory
    table, drive = memory.drive, memory.drive.drive
    extras = drive.half, table.resolution, table.kept, memory.listens, memory.disturbance, drive.speed_limit < np.inf
    assert not any(extras), "no backlash, limits of motion, disturbance, supervisor or resolution"
    assert not any((drive.friction.law, drive.screw.real)), "no friction and a perfect screw"
    return _Feed.of(drive, divisor=table.divisor, order=drive.weights.size)


# ---- the cells -------------------------------------------------------------------------------------------------------


class _TwoChannel(_Structure):
    _fields_ = [
        *_whole("delay coarse_delay"),
        *[("spindle", _Spindle), ("coarse", _Channel), ("fine", _Channel), ("drive", _Coarse), ("piezo", _Fine)],
        ("form", _Form),
        ("signals", ctypes.c_void_p * 20),
    ]


class _FullCell(_Structure):
    _fields_ = [
        *_whole("delay coarse_delay force_delay edge_delay deflection_delay"),
        *_pointers("normal"),
        *[("spindle", _Spindle), ("coarse", _Channel), ("fine", _Channel), ("drive", _Coarse), ("piezo", _Fine)],
        *[("force", _Pid), ("edge", _Pid), ("k1", _System), ("k2", _System), ("longitudinal", _Feed), ("cross", _Feed)],
        *[("form", _Form), ("cut", _Cut)],
        ("signals", ctypes.c_void_p * 47),
    ]


_CHANNELS = ("encoder", "coarse/command", "coarse/state", "fine/command", "fine/state")
_SERVOS = tuple(f"{axis}/{what}" for what in ("demand", "command", "state") for axis in ("longitudinal", "cross"))


def _both_channels(cell: Cell) -> dict[str, Any]:
    """What both cells have."""
    coarse = _stage(cell, "learning_controller", LearningController).parameters
    fine = _stage(cell, "fine_controller", LearningController).parameters
    assert coarse.feedback_delay == fine.feedback_delay, "one delay for both channels"
    return {
        "delay": coarse.feedback_delay,
        "coarse_delay": _stage(cell, "electrodynamic_actuator", ElectrodynamicActuator).drive.plant.delay,
        "spindle": _spindle(cell),
        "coarse": _channel(cell, "learning_controller"),
        "fine": _channel(cell, "fine_controller"),
        "drive": _coarse(cell),
        "piezo": _fine(cell),
        "form": _form(cell),
    }


def _two_channel(cell: Cell) -> _Structure:
    return _TwoChannel.of(**_both_channels(cell))


def _full_cell(cell: Cell) -> _Structure:
    decoupler = _stage(cell, "decoupler", DecouplerStage).memory
    return _FullCell.of(
        **_both_channels(cell),
        force_delay=_stage(cell, "force_controller", ForceController).parameters.feedback_delay,
        edge_delay=_stage(cell, "position_controller", PositionController).parameters.feedback_delay,
        deflection_delay=_stage(cell, "tool", Tool).parameters.deflection_delay,
        force=_pid(cell, "force_controller", ForceController),
        edge=_pid(cell, "position_controller", PositionController),
        k1=_system(decoupler.k1),
        k2=_system(decoupler.k2),
        longitudinal=_feed(cell, "longitudinal"),
        cross=_feed(cell, "cross"),
        cut=_cut(cell),
    )


#: By scenario what fills the structure, and the topics in the order in which their fields stand in it.
CELLS: Mapping[str, tuple[Callable[[Cell], _Structure], tuple[str, ...]]] = {
    "two_channel": (_two_channel, (*_CHANNELS, "tool")),
    "full_cell": (_full_cell, (*_CHANNELS, *_SERVOS, "tool", "cut")),
}


class PlainC:
    """One run of a cell in C.

    Args:
        name: of the scenario, see `CELLS`.
        library: its C, see `compiled`.
        cell: wired from the scenario without identification. It lends its memories; nobody else may run it.
        chunk: samples at a time.

    Attributes:
        signals: arrays of the chunk at hand by relative topic and field, shape (chunk,).
    """

    def __init__(self, name: str, library: ctypes.CDLL, cell: Cell, chunk: int) -> None:
        self._library, self._cell, self._chunk = library, cell, chunk
        make, topics = CELLS[name]
        assert set(topics) == set(cell.dense), f"all topics of {name}"
        self._structure: Any = make(cell)
        kinds = {
            (topic, field): dtype
            for topic in topics
            for field, dtype in messages.sample_fields(cell.dense[topic].type).items()
        }
        # Signals that lie a multiple of 4096 bytes apart would push each other out of the first cache.
        older = self._structure.delay
        pitch = -(-8 * (older + chunk) // 4096) * 4096 + 3 * _CACHE_LINE
        self._room = np.zeros(len(kinds) * pitch, np.uint8)
        self.signals: dict[tuple[str, str], npt.NDArray[Any]] = {}
        for number, (key, dtype) in enumerate(kinds.items()):
            whole = self._room[number * pitch :][: (older + chunk) * dtype.itemsize].view(dtype)
            self.signals[key] = whole[older:]
            self._structure.signals[number] = self.signals[key].ctypes.data
        self._cut = cell.stages.get("cutting_process")

    def _draw(self, first: int, samples: int) -> None:
        """Draw the random numbers of the next samples, up to 8192, as the engine does."""
        if isinstance(self._cut, CuttingProcessStage):
            self._cut.prepare(first, samples)
            drawn = self._cut.memory.allowance.normal
            self._structure.normal = _as(_POINTER, drawn.values[drawn.used[0] :])
            drawn.used[0] += samples

    def run(self, samples: int) -> None:
        """Step through a whole run."""
        for first in range(0, samples, DRAWN):
            self.step(first, min(DRAWN, samples - first))

    def step(self, first: int, samples: int) -> None:
        """Step through the samples ``first`` on, up to 8192; of at most a chunk `signals` holds all of them then."""
        self._draw(first, samples)
        whole = ctypes.c_int64
        self._library.cell_run(ctypes.byref(self._structure), whole(first), whole(samples), whole(self._chunk))
