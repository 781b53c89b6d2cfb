# SPDX-License-Identifier: Apache-2.0
"""Errors due to a delay in the loop of drive and cut, and the effect of a delay in the loop of cut and spindle.

An electrodynamic drive follows an oval and cuts a part with two keyways. In one stage, drive and cut are computed
sample by sample; in two stages, the force would reach the drive some samples late. The stability limit is that of
`lathe_machine.analysis.regeneration` at an overlap of 1, including the delay: K = -1/(2·min Re G·e^{-jωD}). The loop of
cut and loaded spindle contains such a delay; longer delays are compared with a delay of one sample.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from annotated_types import Ge, Gt, Le
from rich.console import Group

from lathe_machine.plants.cutting import CuttingProcess
from lathe_machine.plants.cutting_force import RIGID, SpecificForce
from lathe_machine.plants.spindle import LoadedSpindle, SpeedLoop
from lathe_machine.plants.tool_drive import ToolDrive
from lathe_machine.plants.workpiece import Workpiece
from lathe_papers.formulas.loaded import compliance
from lathe_rc.arrays import Array
from lathe_rc.cell.parameters import parameter
from lathe_rc.study import Study, StudyParameters, Track, comparison, untracked

if TYPE_CHECKING:
    from matplotlib.figure import Figure


_STEP = 1 / 64000  # [s]
_SPEED = 1000.0 * np.pi / 30.0  # [rad/s]
_FREQUENCY, _DAMPING, _MASS = 1038.0, 0.804, 1.2  # drive parameters [rad/s, 1, kg]
_COMPLIANCE = compliance(natural_frequency=_FREQUENCY, damping=_DAMPING, moving_mass=_MASS)
_DELAY = 0.36e-3  # delay of the command [s]
_TURNS, _SPINDLE_TURNS = 3, 12  # simulated revolutions, of which the last is compared; a spindle takes longer to settle
_LEAD = 1.425e-3  # lead T0 of a controller of this drive (spec/learning.md) [s]
_FEED = 1e-3  # [m/rev]; at this feed, K is kc1 times 1 mm
_GAPS = ((1.0, 0.35), (1.0 + np.pi, 0.35))
_LINES = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)))
_COLOURS = ("#1f6f8b", "#2e8b57", "#e08e0b", "#c0392b", "#7d3c98", "#555555")


class CouplingParameters(StudyParameters):
    """Parameters of the coupling study: cut, delays and spindle."""

    stiffness: Annotated[float, Gt(0), Le(1e8)] = parameter(300e3, "K, force over depth of cut", "N/m")
    depth: Annotated[float, Gt(0), Le(1e-2)] = parameter(0.3e-3, "depth of cut", "m")
    lag: Annotated[float, Ge(0.1e-3), Le(1)] = parameter(0.5e-3, "time constant of the force", "s")
    radial_ratio: Annotated[float, Gt(0), Le(2)] = parameter(0.4, "radial part of the force over the main one")
    amplitude: Annotated[float, Gt(0), Le(1e-3)] = parameter(112.5e-6, "of the oval", "m")
    delays: list[Annotated[int, Ge(1), Le(1024)]] = parameter([1, 4, 16, 64, 256], "of the force", "sample")
    inertia: Annotated[float, Gt(0), Le(1e3)] = parameter(0.04, "of spindle and motor", "kg*m^2")
    part_radius: Annotated[float, Gt(0), Le(1)] = parameter(0.05, "at which the main force slows the spindle", "m")


@dataclass(frozen=True)
class CouplingResult:
    """Results of the coupling study: effects of the delays.

    Attributes:
        parameters: parameters of the study.
        angle: spindle angle over the last revolution [rad], shape (m,).
        position, force: position and force with drive and cut as one stage [m, N], shape (m,).
        moved: position with each delay minus ``position`` [m], shape (delays, m).
        invented: spurious energy that the delay adds to the drive, relative to the energy that force and drive
            exchange, shape (delays,).
        limits: largest stable K without a delay, then with each delay [N/m], shape (delays + 1,).
        speed: speed of the loaded spindle at a delay of one sample [rad/s], shape (m,).
        slowed: speed with each delay minus the speed with a delay of one sample [rad/s], shape (delays, m).
    """

    parameters: CouplingParameters
    angle: Array
    position: Array
    force: Array
    moved: Array
    invented: Array
    limits: Array
    speed: Array
    slowed: Array

    def to_json(self) -> dict[str, Any]:
        """Return the results for JSON: the numbers of the tables, and the curves."""
        return {
            "delays": self.parameters.delays,
            "position_difference": np.abs(self.moved).max(axis=1).tolist(),
            "invented_energy": self.invented.tolist(),
            "limits": self.limits.tolist(),
            "speed_deviation": float(np.ptp(self.speed)),
            "speed_difference": np.abs(self.slowed).max(axis=1).tolist(),
            "edge_difference": self._edge().tolist(),
            "angle": self.angle.tolist(),
            "force": self.force.tolist(),
            "moved": self.moved.tolist(),
            "speed": self.speed.tolist(),
            "slowed": self.slowed.tolist(),
        }

    def _edge(self) -> Array:
        """Return the edge error that the speed difference of each delay causes at the lead T0 [m], shape (delays,)."""
        return np.asarray(2.0 * self.parameters.amplitude * _LEAD * np.abs(self.slowed).max(axis=1))

    def table(self) -> Group:
        """Return two tables: drive and cut, then cut and spindle."""
        given = self.parameters
        rows = [("one stage", "0", "0%", f"{self.limits[0] / 1e3:.4g}", "100%")]
        for k, delay in enumerate(given.delays):
            limit = self.limits[k + 1]
            moved, share = 1e6 * np.abs(self.moved[k]).max(), limit / self.limits[0]
            numbers = (f"{moved:.3g}", f"{self.invented[k]:+.2%}", f"{limit / 1e3:.4g}", f"{share:.1%}")
            rows.append((_samples(delay), *numbers))
        drive = comparison(
            f"Drive and cut: {self.force.max():.0f} N, {given.radial_ratio:g} of it radial, reach the drive late",
            ("delay", "edge [µm]", "energy", "stable K [N/mm]", "of the true K"),
            rows,
        )
        swing = float(np.ptp(self.speed))
        spindle = comparison(
            f"Cut and spindle: the speed swings by {swing:.3g} rad/s",
            ("delay", "speed elsewhere [rad/s]", "of the swing", "by T0 [nm]"),
            [
                (_samples(delay), f"{wrong:.3g}", f"{wrong / swing:.1%}", f"{1e9 * edge:.3g}")
                for delay, wrong, edge in zip(given.delays, np.abs(self.slowed).max(axis=1), self._edge(), strict=True)
            ],
        )
        return Group(drive, "", spindle)

    def draw(self, figure: "Figure") -> None:
        """Draw the effect of the delays on the edge, the stable K, and the spindle angle."""
        given = self.parameters
        edge, stable, spindle = figure.subplots(1, 3)
        degrees = np.degrees(self.angle - self.angle[0])
        for k, delay in enumerate(given.delays):
            style = {"color": _COLOURS[k % len(_COLOURS)], "ls": _LINES[k % len(_LINES)], "lw": 0.9}
            edge.plot(degrees, 1e6 * self.moved[k], label=_samples(delay), **style)
            spindle.plot(degrees, self.slowed[k], label=_samples(delay), **style)
        edge.set(xlabel="spindle angle [°]", ylabel="edge less that of one stage [µm]", title="drive and cut")
        stable.semilogx(given.delays, self.limits[1:] / 1e3, "o-", color=_COLOURS[0], label="with a delay")
        stable.axhline(self.limits[0] / 1e3, color=_COLOURS[3], lw=0.9, label="one stage")
        stable.set(xlabel="delay [sample]", ylabel="stable K at µ = 1 [N/mm]", title="limit of chatter", ylim=(0, None))
        spindle.set(xlabel="spindle angle [°]", ylabel="speed less that with 1 sample [rad/s]", title="cut and spindle")
        speed = spindle.twinx()
        speed.plot(degrees, self.speed, color="0.75", lw=0.9)
        speed.set_ylabel("speed [rad/s]", color="0.5")
        for axes in (edge, stable, spindle):
            axes.grid(visible=True, alpha=0.3)
            axes.legend(fontsize=7)


def _samples(delay: int) -> str:
    return f"{delay} sample{'s' if delay > 1 else ''}"


def _cut(given: CouplingParameters) -> CuttingProcess:
    return CuttingProcess(
        material=SpecificForce(kc1=given.stiffness / _FEED),
        depth=given.depth,
        lag=given.lag,
        elasticity=RIGID,
        part=Workpiece(gaps=_GAPS),
        step=_STEP,
    )


def _uniform(samples: int) -> tuple[Array, Array]:
    """Return angle and speed of a spindle without load."""
    time: Array = _STEP * np.arange(samples, dtype=np.float64)
    return _SPEED * time, np.full(samples, _SPEED, dtype=np.float64)


def _turning(angle: Array, speed: Array) -> dict[str, Array]:
    return {"angle": angle, "speed": speed, "feed_velocity": _FEED * speed / (2.0 * np.pi)}


def _chips(cut: CuttingProcess, turning: dict[str, Array], displacement: Array) -> Array:
    """Return the cutting force of a block [N]."""
    none = np.zeros_like(displacement)
    made = {name: np.zeros_like(none) for name in ("force", "deflection", "depth_of_cut", "feed", "wear")}
    cut.block(**turning, displacement=displacement, height=none, cross_position=none, allowance=none, **made)
    return made["force"]


def _drive(given: CouplingParameters) -> ToolDrive:
    return ToolDrive(
        natural_frequency=_FREQUENCY,
        damping=_DAMPING,
        delay=_DELAY,
        stroke=1e-2,
        moving_mass=_MASS,
        force_constant=30.0,
        radial=given.radial_ratio,
        step=_STEP,
        method="foh",
    )


def _apart(given: CouplingParameters, command: Array, turning: dict[str, Array], delay: int) -> tuple[Array, Array]:
    """Simulate drive and cut as two stages; return position and velocity, shape (n, 2), and the delayed force.

    The force is that of the chip ``delay`` samples earlier.
    """
    table, cut, samples = _drive(given).table, _cut(given), command.size
    weights = table.weights
    sent = np.concatenate((np.zeros(table.delay + 2), command))
    moved, force = np.zeros((samples + 1, 2)), np.zeros(samples + delay + 1)
    driven = np.stack([sent[2 - k : samples + 2 - k] for k in range(3)], axis=1) @ weights.coarse.T
    # The force is ``delay`` samples late, so blocks of ``delay`` samples can be computed before the next chip.
    for begin in range(0, samples, delay):
        block = slice(begin, min(begin + delay, samples))
        for n in range(block.start, block.stop):
            late = weights.load[:, 0] * force[n + 1] + weights.load[:, 1] * force[n]
            moved[n + 1] = weights.transition @ moved[n] + driven[n] + given.radial_ratio * late
        here = {name: values[block] for name, values in turning.items()}
        edge = moved[block.start + 1 : block.stop + 1, 0] - command[block]
        force[begin + delay + 1 : block.stop + delay + 1] = _chips(cut, here, edge)
    return moved[1:], force[1:]


def _energy(given: CouplingParameters, velocity: Array, acts: Array, made: Array) -> float:
    """Return the energy added by the delayed force, relative to that exchanged by drive and undelayed force."""
    power = given.radial_ratio * velocity
    return float(((acts - made) * power).sum() / np.abs(made * power).sum())


def _limit(given: CouplingParameters, delay: int) -> float:
    """Return the largest K [N/m] that is stable at every speed, with an overlap of 1 and no lag of the force."""
    frequency = np.geomspace(1.0, np.pi / _STEP, 200_000)
    response = given.radial_ratio * _COMPLIANCE.response(frequency) * np.exp(-1j * frequency * delay * _STEP)
    return float(-0.5 / response.real.min())


def _spun(given: CouplingParameters, samples: int, delay: int) -> Array:
    """Return the speed of a spindle on which the cutting force acts ``delay`` samples late."""
    spindle = LoadedSpindle(
        inertia=0.75 * given.inertia,
        motor_inertia=0.25 * given.inertia,
        loop=SpeedLoop(bandwidth=30.0, integral_time=0.1),
        radius=given.part_radius,
        step=_STEP,
    )
    cut, force = _cut(given), np.zeros(samples + delay)
    angle, speed = _uniform(samples)
    for begin in range(0, samples, delay):
        block = slice(begin, min(begin + delay, samples))
        spindle.block(begin, force[block], angle[block], speed[block])
        made = _chips(cut, _turning(angle[block], speed[block]), np.zeros(block.stop - begin))
        force[begin + delay : block.stop + delay] = made
    return speed


def run(parameters: CouplingParameters, track: Track = untracked) -> CouplingResult:
    """Simulate both loops with each delay and compute the stability limits."""
    turn = round(2.0 * np.pi / _SPEED / _STEP)
    samples, last = _TURNS * turn, slice((_TURNS - 1) * turn, _TURNS * turn)
    angle, speed = _uniform(samples)
    command = parameters.amplitude * np.sin(2.0 * angle) * np.minimum(angle, 1.0)
    turning = _turning(angle, speed)
    true = _drive(parameters).block(_cut(parameters), 0, {**turning, "command": command, "met": command})
    swinging = _spun(parameters, _SPINDLE_TURNS * turn, 1)[-turn:]
    moved, invented, slowed = [], [], []
    for delay in track(parameters.delays):
        state, acts = _apart(parameters, command, turning, delay)
        moved.append(state[last, 0] - true["position"][last])
        made = acts[delay : delay + samples]
        invented.append(_energy(parameters, state[last, 1], acts[:samples][last], made[last]))
        # A delay of one sample is the reference itself, and the slowest run, because every sample is a block.
        late = swinging if delay == 1 else _spun(parameters, _SPINDLE_TURNS * turn, delay)[-turn:]
        slowed.append(late - swinging)
    return CouplingResult(
        parameters,
        angle[last],
        true["position"][last],
        true["force"][last],
        np.array(moved),
        np.array(invented),
        np.array([_limit(parameters, delay) for delay in (0, *parameters.delays)]),
        swinging,
        np.array(slowed),
    )


STUDY = Study(
    "coupling",
    "what a delay between drive and cut would falsify, and what it does between cut and spindle",
    CouplingParameters,
    run,
    size=(13.0, 3.8),
)
