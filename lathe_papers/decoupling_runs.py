# SPDX-License-Identifier: Apache-2.0
"""Runs of the decoupling study at one delay: poles, single loops, steps and disturbance."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from annotated_types import Ge, Gt, Le

from lathe_machine.analysis.pid_tuning import TunedLoop, evaluate
from lathe_machine.control.decoupler import PRESETS
from lathe_machine.control.pid import FORCE, POSITION
from lathe_machine.signals.allowance import Allowance, mean_reverting
from lathe_machine.transfer import LinearSystem
from lathe_papers.formulas.coupled_loops import CONNECTIONS, CoupledLoops, loops
from lathe_papers.formulas.coupled_simulation import STEP, CoupledSimulation
from lathe_rc.arrays import Array
from lathe_rc.cell.parameters import parameter
from lathe_rc.study import StudyParameters

SETTLED = 2.0  #: time from which the paper computes the RMS of the force [s]
CROSS = 3.0  #: simulated duration of a step [s]
_SHOWN = 4000  # points per curve in the figure


class DecouplingParameters(StudyParameters):
    """Parameters of the decoupling study: plant, disturbance and converters."""

    preset: Literal["paper", "realistic"] = parameter("paper", "W3 as printed (2.9 Hz), or of a lathe (53 Hz)")
    plant: Literal["approximate", "full"] = parameter(
        "approximate", "W1 as printed, or the one that Fig. 12 belongs to"
    )
    force: Annotated[float, Gt(0), Le(1000)] = parameter(150.0, "set point of the force", "N")
    force_step: Annotated[float, Gt(0), Le(1000)] = parameter(10.0, "step whose effect on the position is shown", "N")
    position_step_um: Annotated[float, Gt(0), Le(1000)] = parameter(
        10.0, "step whose effect on the force is shown", "µm"
    )
    walk_um: Annotated[float, Ge(0), Le(1000)] = parameter(20.0, "RMS of the allowance's random walk", "µm")
    correlation_s: Annotated[float, Gt(0), Le(100)] = parameter(1.0, "correlation time of the walk", "s")
    run_out_um: Annotated[float, Ge(0), Le(1000)] = parameter(7.5, "amplitude of the allowance's run-out", "µm")
    spindle_rpm: Annotated[float, Gt(0), Le(60_000)] = parameter(600.0, "spindle speed", "1/min")
    seconds: Annotated[float, Ge(4), Le(200)] = parameter(20.0, "length of the run with disturbance", "s")
    engagement_s: Annotated[float, Gt(0), Le(10)] = parameter(0.5, "in which a smooth entry would raise the force", "s")
    smoothing_s: Annotated[float, Ge(0), Le(10)] = parameter(0.3, "time constant of its end, 0 for a ramp alone", "s")
    delay_ms: Annotated[float, Gt(0), Le(20)] = parameter(1.0, "delay whose cost is told, a multiple of 0.05", "ms")
    adc_force: Annotated[float, Ge(0), Le(10)] = parameter(0.0, "step of the force's ADC, 0 for none", "N")
    adc_position_um: Annotated[float, Ge(0), Le(100)] = parameter(0.0, "step of the position's ADC, 0 for none", "µm")
    dac_pct: Annotated[float, Ge(0), Le(10)] = parameter(0.0, "step of the DACs, 0 for none", "%")
    seed: Annotated[int, Ge(0), Le(2**31 - 1)] = parameter(0, "of the allowance")


@dataclass(frozen=True)
class Course:
    """Time series of one run of both loops.

    Attributes:
        time: times [s], shape (n,).
        force: force F [N], shape (n,).
        position: position y [m], shape (n,).
        disturbance: disturbance force n [N], shape (n,).
        deflection: deflection W3·F [m], shape (n,).
        cut: number of commands limited by controllers and drives.
    """

    time: Array
    force: Array
    position: Array
    disturbance: Array
    deflection: Array
    cut: int

    def settled(self, values: Array) -> Array:
        """Return the samples of an array after the entry has settled."""
        return np.asarray(values[self.time >= SETTLED])

    def curve(self, values: Array, unit: float = 1.0) -> tuple[Array, Array]:
        """Return time [s] and an array divided by ``unit``, downsampled for a figure."""
        every = max(1, values.size // _SHOWN)
        return self.time[::every], values[::every] / unit


def times(samples: int, step: float) -> Array:
    """Return sample times starting at 0 [s], shape (samples,)."""
    return np.arange(samples, dtype=np.float64) * step


def course(
    system: CoupledLoops,
    given: DecouplingParameters,
    seconds: float,
    *,
    force: float = 0.0,
    position: float = 0.0,
    noise: Array | None = None,
    smooth: bool = False,
) -> Course:
    """Simulate both loops from rest.

    Args:
        system: the coupled loops.
        given: parameters of the study, for the converters and the smooth entry.
        seconds: simulated time [s].
        force: set point of the force from the start [N].
        position: set point of the position from the start [m].
        noise: disturbance force n [N], shape (samples,); None for no disturbance.
        smooth: whether the force set point rises smoothly.
    """
    samples = round(seconds / STEP)
    simulation = CoupledSimulation(
        system,
        adc=(given.adc_force, given.adc_position_um * 1e-6),
        dac=given.dac_pct / 100.0,
        ramp=force / given.engagement_s if smooth else 0.0,
        smoothing=given.smoothing_s if smooth else 0.0,
    )
    noise = np.zeros(samples) if noise is None else noise
    out = np.empty((4, samples))
    simulation.block(0, np.full(samples, force), np.full(samples, position), noise, *out)
    deflection = np.empty(samples)
    LinearSystem(system.channels.w3, STEP).block(out[0], deflection)
    cut = simulation.cut + simulation.force_pid.saturated + simulation.position_pid.saturated
    return Course(times(samples, STEP), out[0], out[1], noise, deflection, cut)


def disturbance(given: DecouplingParameters) -> Array:
    """Return the force n [N] that the allowance causes through W4, at the step of the simulation."""
    samples = round(given.seconds / STEP)
    allowance = Allowance(
        mean_reverting(given.walk_um * 1e-6, given.correlation_s, STEP),
        order=np.ones(1),
        amplitude=np.array([given.run_out_um * 1e-6]),
        phase=np.zeros(1),
        seed=given.seed,
    )
    depth, force = np.empty((2, samples))
    allowance.block(times(samples, STEP * given.spindle_rpm * np.pi / 30.0), depth)
    LinearSystem(PRESETS[given.preset].w4, STEP).block(depth, force)
    return force


def rms(values: Array) -> float:
    """Return the root mean square of an array."""
    return float(np.sqrt(np.mean(values**2)))


@dataclass(frozen=True)
class Behaviour:
    """Behaviour of both loops at one delay.

    Attributes:
        stability: largest real part of the poles by connection [1/s].
        force, position: key figures of each loop alone.
        position_step, force_step: responses to a set-point step, without and with K1 and K2.
        noise: entry and disturbance with K1 and K2.
    """

    stability: Mapping[str, float]
    force: TunedLoop
    position: TunedLoop
    position_step: tuple[Course, Course]
    force_step: tuple[Course, Course]
    noise: Course

    def peaks(self) -> dict[str, dict[str, float]]:
        """Return the largest deviation of force [N] and of position [m] during a step in the other loop."""
        names = ("uncompensated", "compensated")
        forces = [float(np.abs(run.force).max()) for run in self.position_step]
        positions = [float(np.abs(run.position).max()) for run in self.force_step]
        return {
            "position_step_to_force": dict(zip(names, forces, strict=True)),
            "force_step_to_position": dict(zip(names, positions, strict=True)),
        }

    def noise_numbers(self, force: float) -> dict[str, float]:
        """Return RMS and efficiency as the paper defines them: force after 2 s, position from the start.

        Args:
            force: set point of the force [N].
        """
        run = self.noise
        force_disturbance, force_error = rms(run.settled(run.disturbance)), rms(run.settled(run.force) - force)
        deflection, position_error = rms(run.deflection), rms(run.position)
        return {
            "force_disturbance_rms_n": force_disturbance,
            "force_error_rms_n": force_error,
            "force_efficiency": force_disturbance / force_error,
            "position_disturbance_rms_mm": deflection * 1e3,
            "position_error_rms_mm": position_error * 1e3,
            "position_efficiency": deflection / position_error,
            "position_static_deflection_mm": abs(float(np.mean(run.settled(run.deflection)))) * 1e3,
            "position_error_coupled_mm": rms(run.settled(run.position)) * 1e3,
        }


def behaviour(given: DecouplingParameters, wait: float, noise: Array) -> Behaviour:
    """Compute the behaviour of both loops with a delay ``wait`` [s] under a disturbance [N]."""
    by_name = {name: loops(given.preset, given.plant, name, wait) for name in CONNECTIONS}
    none, both = by_name["none"], by_name["both"]
    position = given.position_step_um * 1e-6
    return Behaviour(
        stability={name: system.growth() for name, system in by_name.items()},
        force=evaluate(none.channels.w1, FORCE, wait),
        position=evaluate(none.channels.w2, POSITION, wait),
        position_step=(course(none, given, CROSS, position=position), course(both, given, CROSS, position=position)),
        force_step=(
            course(none, given, CROSS, force=given.force_step), course(both, given, CROSS, force=given.force_step)
        ),
        noise=course(both, given, given.seconds, force=given.force, noise=noise),
    )  # fmt: skip
