# SPDX-License-Identifier: Apache-2.0
"""The two-channel cell in plain C (benchmarks/c/cell.c), filled from a scenario."""

import ctypes
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from lathe_rc.cell.stages.electrodynamic_actuator import ElectrodynamicActuator
from lathe_rc.cell.stages.learning_controller import LearningController
from lathe_rc.cell.stages.piezo_actuator import PiezoActuator
from lathe_rc.cell.stages.tool import Tool
from lathe_rc.cell.wiring import Cell
from lathe_rc.control.repetitive import memory_size
from lathe_rc.errors import LatheError

FLAGS = ("-O3", "-march=native", "-std=c11")
_FOLDER = Path(__file__).parent / "c"
_PLAYS = 16
_POINTER = ctypes.POINTER(ctypes.c_double)

Array = npt.NDArray[np.float64]


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


def _fields(integers: str = "", reals: str = "", pointers: str = "") -> list[tuple[str, Any]]:
    found: list[tuple[str, Any]] = [(name, ctypes.c_int64) for name in integers.split()]
    found += [(name, ctypes.c_double) for name in reals.split()]
    return found + [(name, _POINTER) for name in pointers.split()]


class _Channel(ctypes.Structure):
    _fields_ = [
        *_fields("grid cycle mask reach chunk looks_ahead", "lead_time constant gain ratio join_below"),
        *_fields("", "", "memory scratch forward smoothed"),
        *_fields("point base learn_from joined seen ahead"),
        ("angle", ctypes.c_double * 4),
        ("error", ctypes.c_double * 4),
        *_fields("", "squares largest"),
    ]


class _Coarse(ctypes.Structure):
    _fields_ = [
        ("transition", ctypes.c_double * 4),
        ("weights", ctypes.c_double * 6),
        *_fields("", "part spring damper force_per_current stroke x v"),
        *_fields("stopped"),
    ]


class _Fine(ctypes.Structure):
    _fields_ = [
        *_fields("plays inverse_plays"),
        *[
            (name, ctypes.c_double * (_PLAYS + 1))
            for name in ("weight", "threshold", "inverse_weight", "inverse_threshold")
        ],
        ("transition", ctypes.c_double * 4),
        ("weights", ctypes.c_double * 4),
        *_fields("", "stroke full_voltage decay now before"),
        ("play", ctypes.c_double * _PLAYS),
        ("inverse_play", ctypes.c_double * _PLAYS),
        *_fields("", "amplified applied extension x v"),
        *_fields("saturated"),
    ]


class _Form(ctypes.Structure):
    _fields_ = [*_fields("rows points", "feed start_height", "heights table"), *_fields("row")]


_TOPICS = {
    "encoder": ("angle", "speed", "angle_true", "speed_true", "index_pulse"),
    "coarse/command": ("position",),
    "coarse/state": ("position", "velocity", "effort", "measured_position"),
    "fine/command": ("position",),
    "fine/state": ("position", "velocity", "effort", "measured_position"),
    "tool": ("reference", "displacement", "error", "measured_error", "height"),
}
_NAMES = [(topic, name) for topic, names in _TOPICS.items() for name in names]


class _Signals(ctypes.Structure):
    _fields_ = [(f"{topic}.{name}", ctypes.c_void_p) for topic, name in _NAMES]


class _Cell(ctypes.Structure):
    _fields_ = [
        *_fields("", "step nominal"),
        *_fields("delay coarse_delay"),
        *_fields("", "revolution"),
        ("coarse", _Channel),
        ("fine", _Channel),
        ("drive", _Coarse),
        ("piezo", _Fine),
        ("form", _Form),
        ("signals", _Signals),
    ]


class PlainC:
    """One run of the C cell.

    Args:
        library: benchmarks/c/cell.c, see `compiled`.
        cell: wired from a scenario like config/two_channel.yaml without identification, with an ideal encoder at
            constant speed and an exponential Q.
        chunk: samples at a time.
    """

    def __init__(self, library: ctypes.CDLL, cell: Cell, chunk: int) -> None:
        self._library, self._chunk = library, chunk
        self._arrays: list[npt.NDArray[Any]] = []  # keeps alive what the structures point to
        stages = cell.stages
        coarse, fine = stages["learning_controller"], stages["fine_controller"]
        drive, piezo, tool = stages["electrodynamic_actuator"], stages["piezo_actuator"], stages["tool"]
        assert isinstance(coarse, LearningController)
        assert isinstance(fine, LearningController)
        assert isinstance(drive, ElectrodynamicActuator)
        assert isinstance(piezo, PiezoActuator)
        assert isinstance(tool, Tool)
        law, delay = cell.master.law, coarse.parameters.feedback_delay
        self._cell = _Cell(
            step=cell.master.shared.step,
            nominal=law.nominal,
            delay=delay,
            coarse_delay=drive.drive.plant.delay,
            revolution=-1.0,
            coarse=self._channel(coarse),
            fine=self._channel(fine),
            drive=self._drive(drive),
            piezo=self._piezo(piezo),
            form=self._form(tool),
        )
        self.signals: dict[tuple[str, str], npt.NDArray[Any]] = {}
        for key in _NAMES:
            whole: npt.NDArray[Any] = np.zeros(delay + chunk, np.uint8 if key[1] == "index_pulse" else np.float64)
            self._arrays.append(whole)
            self.signals[key] = whole[delay:]
            setattr(self._cell.signals, ".".join(key), whole.ctypes.data + delay * whole.itemsize)

    def _pointer(self, array: Array) -> Any:
        self._arrays.append(np.ascontiguousarray(array))
        return self._arrays[-1].ctypes.data_as(_POINTER)

    def _channel(self, stage: LearningController) -> _Channel:
        table, q = stage.parameters, stage.parameters.make_q()
        memory = np.zeros(memory_size(table.cycle_points, q))
        return _Channel(
            grid=table.points_per_revolution,
            cycle=table.cycle_points,
            mask=memory.size - 1,
            reach=q.reach,
            chunk=q.chunk,
            looks_ahead=stage.correction.looks_ahead,
            lead_time=table.preview_time,
            constant=table.constant_lead,
            gain=table.learning_gain,
            ratio=q.ratio,
            join_below=table.join_below or np.inf,
            memory=self._pointer(memory),
            scratch=self._pointer(np.zeros(q.chunk + 2 * q.reach)),
            forward=self._pointer(np.zeros(q.chunk + 2 * q.reach)),
            smoothed=self._pointer(np.zeros(q.chunk)),
            base=-(1 << 62),
            joined=not table.join_below,
        )

    @staticmethod
    def _drive(stage: ElectrodynamicActuator) -> _Coarse:
        table, plant = stage.parameters, stage.drive.plant
        return _Coarse(
            transition=(ctypes.c_double * 4)(*plant.transition.ravel()),
            weights=(ctypes.c_double * 6)(*plant.weights.ravel()),
            part=plant.fraction,
            spring=table.natural_frequency**2,
            damper=2.0 * table.damping * table.natural_frequency,
            force_per_current=table.moving_mass / table.force_constant,
            stroke=table.stroke,
        )

    @staticmethod
    def _piezo(stage: PiezoActuator) -> _Fine:
        plant, law = stage.drive.plant, stage.parameters.stack(stage.name).table
        row = ctypes.c_double * (_PLAYS + 1)
        return _Fine(
            plays=law.forward.table.shape[1] - 1,
            inverse_plays=law.inverse.table.shape[1] - 1,
            threshold=row(*law.forward.table[0]),
            weight=row(*law.forward.table[1]),
            inverse_threshold=row(*law.inverse.table[0]),
            inverse_weight=row(*law.inverse.table[1]),
            transition=(ctypes.c_double * 4)(*plant.transition.ravel()),
            weights=(ctypes.c_double * 4)(*plant.weights[:, :2].ravel()),
            stroke=law.stroke,
            full_voltage=stage.parameters.full_voltage,
            decay=law.decay,
            now=law.now,
            before=law.before,
        )

    def _form(self, stage: Tool) -> _Form:
        assert stage.form is not None
        table, profile = stage.parameters, stage.form.profile
        return _Form(
            rows=profile.heights.size,
            points=profile.table.shape[1],
            feed=table.feed,
            start_height=table.start_height,
            heights=self._pointer(profile.heights),
            table=self._pointer(profile.table),
        )

    def run(self, samples: int) -> None:
        """Step through a whole run in C."""
        self._library.cell_run(ctypes.byref(self._cell), ctypes.c_int64(samples), ctypes.c_int64(self._chunk))

    def step(self, first: int, samples: int) -> None:
        """Step through one chunk; `signals` holds its samples then."""
        self._library.cell_chunk(ctypes.byref(self._cell), ctypes.c_int64(first), ctypes.c_int64(samples))
