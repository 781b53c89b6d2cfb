# SPDX-License-Identifier: Apache-2.0
"""Other programs do the same work.

**drive**: the electrodynamic drive follows a given command, in ns per sample, against ``scipy.signal`` (lfilter, dlsim,
lsim) and python-control (forced_response, input_output_response). ``lathe_rc`` computes in chunks like the offline
engine, ``lathe_rc_blocks`` in blocks of 64 samples. Both include end stops, velocity and current, the others the
position only. The table gives the largest difference of the outputs. lsim uses the continuous drive, for which the
fraction of a step in the delay has to be interpolated.

**loop**: encoder, profile, repetitive controller, drive and error run at constant speed, in samples per second.
``lathe_rc`` is the offline engine with the error kept, ``drake`` the diagram in others/drake_loop.py with the error
logged. It needs pydrake (requirements/bench.in); ``reason`` states why it did not run. The RMS errors of the last
revolution show that both are the same loop; Drake's loop filters its memory once per revolution, as a circle.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import control
import numpy as np
import numpy.typing as npt
from scipy import signal

from benchmarks import sides
from benchmarks.others.peer import Peer, missing
from lathe_machine.plants.electrodynamic import ElectrodynamicDrive
from lathe_machine.plants.linear import second_order
from lathe_rc import messages, resources
from lathe_rc.blocks.ports import Sparse
from lathe_rc.cell import scenario
from lathe_rc.cell.engine import Engine
from lathe_rc.cell.wiring import Cell
from lathe_rc.messages import Signals
from lathe_rc.signals.form_errors import form_errors

Array = npt.NDArray[np.float64]

_STEP = 1.0 / 64000.0
_NATURAL_FREQUENCY, _DAMPING, _DELAY = 1038.0, 0.804, 0.36e-3
_CHUNK, _BLOCK = 3200, 64  # samples
_LONG_ENOUGH = 5e-3  # [s]
_LOOP = ["tool.profile=harmonics", "tool.harmonic_order=[2]", "tool.harmonic_amplitude=[225.0e-6]"]


def machine() -> ElectrodynamicDrive:
    """The drive of config/one_channel.yaml, at rest."""
    return ElectrodynamicDrive(
        natural_frequency=_NATURAL_FREQUENCY,
        damping=_DAMPING,
        delay=_DELAY,
        stroke=1e-3,
        moving_mass=1.0,
        force_constant=20.0,
        step=_STEP,
        method="foh",
    )


class _Drive:
    """The same drive in the hands of each; every method follows the command and returns the position [m].

    What can be made once is made here, so that only following is timed.
    """

    def __init__(self, samples: int) -> None:
        random = np.random.default_rng(6)
        smooth = np.asarray(signal.lfilter([0.01], [1.0, -0.99], random.standard_normal(samples)))
        self.command: Array = 225e-6 * smooth / np.abs(smooth).max()
        self._machine = machine()
        plant = self._machine.plant
        delayed = np.concatenate((np.zeros(plant.delay), self.command))[:samples]
        taps = np.stack([np.concatenate((np.zeros(k), delayed[: samples - k])) for k in range(3)], axis=1)
        self._delayed, self._taps, self._times = delayed, taps, np.arange(samples) * _STEP
        # x[n] = Φ·x[n-1] + w·u[n] with x[n-1] as the state and the position as the output
        self._system = plant.transition, plant.weights, plant.transition[:1], plant.weights[:1]
        self._control = control.ss(*self._system, _STEP)
        tops = [signal.ss2tf(*self._system, input=k) for k in range(3)]
        self._top, self._bottom = np.zeros(5), tops[0][1]
        for lag, (top, _) in enumerate(tops):
            self._top[lag : lag + 3] += top[0]
        a, b = second_order(_NATURAL_FREQUENCY, _DAMPING)
        self._continuous = a, b[:, None], np.eye(1, 2), np.zeros((1, 1))

    def ours(self, length: int) -> Array:
        """`ElectrodynamicDrive`, some samples at a time."""
        outputs = np.empty((3, self.command.size))
        for first in range(0, self.command.size, length):
            self._machine.block(self.command[first : first + length], *outputs[:, first : first + length])
        return np.asarray(outputs[0])

    def lfilter(self) -> Array:
        """The rational function of z."""
        return np.asarray(signal.lfilter(self._top, self._bottom, self._delayed), np.float64)

    def dlsim(self) -> Array:
        """The difference equation."""
        return np.asarray(signal.dlsim((*self._system, _STEP), self._taps)[1][:, 0])

    def lsim(self) -> Array:
        """The differential equation, with the delayed command interpolated."""
        delayed = np.interp(self._times - _DELAY, self._times, self.command, left=0.0)
        return np.asarray(signal.lsim(self._continuous, delayed, self._times)[1])

    def forced_response(self) -> Array:
        """The difference equation, in python-control."""
        return np.asarray(control.forced_response(self._control, self._times, self._taps.T).outputs).ravel()

    def input_output_response(self) -> Array:
        """The same as an input/output system."""
        return np.asarray(control.input_output_response(self._control, self._times, self._taps.T).outputs).ravel()


def _repeated(action: Callable[[], object]) -> float:
    """Wall time of an action [s], the mean of as many as take long enough to be read."""
    count = total = 0.0
    while total < _LONG_ENOUGH:
        total += sides.seconds(action)
        count += 1
    return total / count


def _drive(samples: int, rounds: int) -> dict[str, Any]:
    drive = _Drive(samples)
    actions: dict[str, Callable[[], Array]] = {
        "lathe_rc": lambda: drive.ours(_CHUNK),
        "lathe_rc_blocks": lambda: drive.ours(_BLOCK),
        "scipy_lfilter": drive.lfilter,
        "scipy_dlsim": drive.dlsim,
        "scipy_lsim": drive.lsim,
        "control_forced_response": drive.forced_response,
        "control_input_output_response": drive.input_output_response,
    }
    position = drive.ours(_CHUNK)  # also compiles
    peers = [name for name in actions if not name.startswith("lathe_rc")]
    difference = {name: float(np.abs(actions[name]() - position).max()) for name in peers}
    timed: dict[str, Callable[[], float]] = {
        name: lambda action=action: _repeated(action) / samples * 1e9  # type: ignore[misc]
        for name, action in actions.items()
    }
    found = sides.alternate(timed, rounds)
    return {
        "samples": samples,
        "largest_position_um": float(np.abs(position).max() * 1e6),
        **{
            name: {
                "ns_per_sample": sides.spread(figures),
                "ratio": sides.ratio(figures, found["lathe_rc"]),
                "same_difference_equation": name != "scipy_lsim",
                "largest_difference_um": difference.get(name, 0.0) * 1e6,
            }
            for name, figures in found.items()
        },
    }


class _Keep:
    """A sink that keeps angle and error."""

    def __init__(self) -> None:
        self.angle: list[Array] = []
        self.error: list[Array] = []

    def chunk(self, first: int, samples: int, dense: Mapping[str, Signals], sparse: Mapping[str, list[Sparse]]) -> None:
        """See `lathe_rc.cell.engine.Sink`."""
        self.angle.append(dense["encoder"]["angle_true"].copy())
        self.error.append(dense["tool"]["error"].copy())

    def rms(self) -> Array:
        """Of each whole revolution [m]."""
        return np.asarray(form_errors(np.concatenate(self.angle), np.concatenate(self.error)).rms)


def _settings(table: scenario.Scenario, samples: int) -> dict[str, Any]:
    """What the peer has to know of the scenario."""
    nodes: dict[str, Any] = dict(table.nodes)
    spindle, learning = nodes["spindle_encoder"], nodes["learning_controller"]
    plant = machine().plant
    return {
        "samples": samples,
        "step": spindle.step,
        "speed": spindle.nominal_speed,
        "grid": learning.points_per_revolution,
        "lead_time": learning.lead_time,
        "q_time": learning.q_time,
        "order": 2,
        "amplitude": 225e-6,
        "transition": plant.transition.tolist(),
        "weights": plant.weights.tolist(),
        "delay": plant.delay,
    }


def _ours(table: scenario.Scenario) -> tuple[float, int, Array]:
    """Seconds, samples and RMS error by revolution [m] of an offline run."""
    cell = Cell(table.nodes)
    cell.check()
    engine, keep = Engine(cell), _Keep()
    return sides.seconds(lambda: engine.run([keep])), engine.samples, keep.rms()


def _loop(revolutions: float, rounds: int) -> dict[str, Any]:
    path = resources.find(Path("one_channel.yaml"))
    short = scenario.load(path, [*_LOOP, f"spindle_encoder.revolutions={revolutions}"])
    long = scenario.load(path, [*_LOOP, f"spindle_encoder.revolutions={20.0 * revolutions}"])
    _, samples, rms = _ours(short)
    result: dict[str, Any] = {"drake_samples": samples, "lathe_rc_last_rms_um": float(rms[-1] * 1e6)}

    def ours() -> float:
        seconds, samples, _ = _ours(long)
        return samples / seconds

    if reason := missing("pydrake"):
        found = sides.alternate({"lathe_rc": ours}, rounds)
        rates = sides.spread(found["lathe_rc"])
        return {**result, "lathe_rc_samples_per_s": rates, "drake_samples_per_s": None, "reason": reason}
    last = 0.0
    with Peer("drake_loop.py", _settings(short, samples)) as peer:

        def drake() -> float:
            nonlocal last
            told = peer.ask()
            last = told["rms_m"][rms.size - 1]
            return float(told["samples"] / told["seconds"])

        found = sides.alternate({"lathe_rc": ours, "drake": drake}, rounds)
    return {
        **result,
        "drake_last_rms_um": last * 1e6,
        "lathe_rc_samples_per_s": sides.spread(found["lathe_rc"]),
        "drake_samples_per_s": sides.spread(found["drake"]),
        "ratio": sides.ratio(found["lathe_rc"], found["drake"]),
    }


def measure(*, quick: bool, say: Callable[[str], None]) -> dict[str, Any]:
    """Drive and loop against those of others."""
    messages.store()
    say("  drive: scipy.signal, python-control")
    drive = _drive(3200 if quick else 32000, 3 if quick else 7)
    say("  loop: Drake")
    return {"drive": drive, "loop": _loop(4.0 if quick else 20.0, 3 if quick else 5)}
