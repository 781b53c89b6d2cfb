# SPDX-License-Identifier: Apache-2.0
"""Tool drives under the cutting force: drives and cut as one mechanical system.

The radial part ρ·F of the cutting force F pushes the tool out of the part. Alone, the electrodynamic drive carries the
tool (mass m at x); in series a piezo of mass ratio r = mt/M with the tool at x2 rides on its carriage at x1
(`lathe_rc.plants.series`):

    m·x''   = k·i + ρ·F
    mt·x2'' = mt·q + ρ·F,    q = ω2²·(e - (x2 - x1)) - 2ζ2ω2·(x2 - x1)'
    M·x1''  = k·i - mt·q

The stack's stiffness is mt·ω2². The coil's current i comes from the drive's position loop

    i* = (m/k)·(ω1²·(u(t - τ) - x1) - 2ζ1ω1·x1')

either at once (``coil=None``: the second-order drive of papers 000 and 001, to the bit where there is no force), or by
a current loop. That is a sampled one with the step of the cell (`lathe_rc.plants.coil`): from the state of a sample it
gives the voltage U that stands until the next one,

    L·di/dt = U - R·i - k·x1'

What drives and cut do to each other within a sample is solved with the chip, see `lathe_rc.plants.cutting`: the force
of sample n moves the tool that makes the chip of sample n. The force acts on the drives as linear between samples.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lathe_rc.errors import InputError
from lathe_rc.plants.chip import DONE
from lathe_rc.plants.coil import Coil, coil_table
from lathe_rc.plants.cutting import CuttingProcess
from lathe_rc.plants.linear import Discretisation, discretise, second_order
from lathe_rc.plants.loaded_motion import SATURATED, STOPPED, LoadedTable, advance_loaded, failure
from lathe_rc.plants.piezo import Stack
from lathe_rc.plants.series import SeriesDrive, seen_at

Array = npt.NDArray[np.float64]
Complex = npt.NDArray[np.complex128]

# What a block takes and makes, in the order of the kernel.
_GIVEN = (
    "command", "set_point", "noise", "met", "angle", "speed", "height", "cross_position", "feed_velocity", "allowance",
)  # fmt: skip
_MADE = (
    "position", "velocity", "current", "measured", "extension", "extension_velocity", "voltage",
    "force", "deflection", "depth_of_cut", "feed", "wear",
)  # fmt: skip


@dataclass(frozen=True)
class Piezo:
    """The piezo drive on the carriage.

    Attributes:
        stack: amplifier and ceramics; the drive takes over its state.
        tool_frequency, tool_damping: ω2 [rad/s], ζ2 [1] of the tool on a blocked carriage.
        mass_ratio: r.
        full_voltage: voltage at the full stroke [V].
        feedback: direct compensation, see `lathe_rc.plants.series.SeriesDrive`.
        preload: of the stack [N]; inf: it holds any tension.
    """

    stack: Stack
    tool_frequency: float
    tool_damping: float
    mass_ratio: float
    full_voltage: float
    feedback: bool = False
    preload: float = np.inf


class LoadedDrive:
    """Tool drives that feel the cutting force.

    Args:
        carriage_frequency, carriage_damping: ω1 [rad/s], ζ1 [1] of the position loop.
        delay: τ of the command [s].
        carriage_stroke: end stops at ± this displacement [m].
        moving_mass: m or M [kg].
        force_constant: k of the coil [N/A].
        radial: ρ, the part of the main cutting force that acts along the drives.
        coil: current loop; None: the position loop's force is there at once.
        piezo: what rides on the carriage; None: the tool alone.
        resolution: of the carriage's position sensor [m]; 0 for none.
        step: sampling step [s].
        method: discretisation, see `lathe_rc.plants.linear.discretise`.
        kept: samples of which it is kept whether the current loop was limited, a power of two.

    Attributes:
        table: for `advance_loaded`.

    Raises:
        InputError: the current loop is too fast for the step, or it oscillates.
    """

    def __init__(
        self,
        *,
        carriage_frequency: float,
        carriage_damping: float,
        delay: float,
        carriage_stroke: float,
        moving_mass: float,
        force_constant: float,
        radial: float,
        coil: Coil | None = None,
        piezo: Piezo | None = None,
        resolution: float = 0.0,
        step: float,
        method: Discretisation,
        kept: int = 1,
    ) -> None:
        servo, _ = second_order(carriage_frequency, carriage_damping)
        spring, damper = float(-servo[1, 0]), float(-servo[1, 1])
        masses = 2 if piezo else 1
        order = 2 * masses + (coil is not None)
        a, drives, extends, loads = np.zeros((order, order)), np.zeros(order), np.zeros(order), np.zeros(order)
        for mass in range(masses):
            a[2 * mass, 2 * mass + 1] = 1.0
        stiff = loss = 0.0
        tool, mass_of_tool = 0, moving_mass
        if piezo:
            tool, mass_of_tool = 2, piezo.mass_ratio * moving_mass
            stiff, loss = piezo.tool_frequency**2, 2.0 * piezo.tool_damping * piezo.tool_frequency
            q = np.array([stiff, loss, -stiff, -loss])
            a[1, :4], a[3, :4] = -piezo.mass_ratio * q, q
            extends[1], extends[3] = -piezo.mass_ratio * stiff, stiff
        loads[tool + 1] = 1.0 / mass_of_tool
        if coil:
            a[1, -1] = force_constant / moving_mass
            a[-1, -1] = -coil.resistance / coil.inductance
            a[-1, 1] = -force_constant / coil.inductance if coil.back_emf else 0.0
            drives[-1] = 1.0 / coil.inductance
        else:
            a[1, 0] -= spring
            a[1, 1] -= damper
            drives[1] = spring
        self._coarse = discretise(a, drives, delay, step, method)
        self._fine = discretise(a, extends, 0.0, step, method)
        load = discretise(a, loads, 0.0, step, method)
        weights = self._coarse.weights
        if coil:  # the voltage stands through a step
            weights = np.zeros((order, 3))
            weights[:, 0] = discretise(a, drives, 0.0, step, method).weights.sum(axis=1)
        self.step, self._piezo = step, piezo
        stack = piezo.stack if piezo else _no_stack(step)
        self.table = LoadedTable(
            series=piezo is not None,
            transition=self._coarse.transition,
            coarse=weights,
            fine=self._fine.weights,
            load=load.weights,
            tool=tool,
            delay=self._coarse.delay,
            part=self._coarse.fraction,
            spring=spring,
            damper=damper,
            force_per_current=moving_mass / force_constant,
            carriage_stroke=carriage_stroke,
            stack=stack.table,
            memory=stack.state,
            full_voltage=piezo.full_voltage if piezo else 0.0,
            feedback=piezo is not None and piezo.feedback,
            resolution=resolution,
            stiff=stiff,
            loss=loss,
            tension=piezo.preload / mass_of_tool if piezo else np.inf,
            radial=radial,
            coil=coil_table(coil, step, kept),
            state=np.zeros(order),
            before=np.zeros(2),
            reading=np.zeros(1),
            line=np.zeros(self._coarse.delay + 3),
            counts=np.zeros(2, np.int64),
        )
        if coil:
            self._check(coil)
        if piezo and piezo.feedback:  # which may oscillate, and is refused then
            SeriesDrive(
                piezo.stack, carriage_frequency=carriage_frequency, carriage_damping=carriage_damping, delay=delay,
                carriage_stroke=carriage_stroke, moving_mass=moving_mass, force_constant=force_constant,
                tool_frequency=piezo.tool_frequency, tool_damping=piezo.tool_damping, full_voltage=piezo.full_voltage,
                mass_ratio=piezo.mass_ratio, feedback=True, resolution=resolution, step=step, method=method,
            )  # fmt: skip

    def block(self, cut: CuttingProcess, first: int, given: Mapping[str, Array]) -> dict[str, Array]:
        """Step drives and cut from sample ``first`` on; at rest at 0 before sample 0.

        Args:
            cut: what the tool cuts; its state goes on.
            first: index of the first sample.
            given: by name, of shape (n,): ``command`` [m], ``angle`` [rad], ``speed`` [rad/s] and ``feed_velocity``
                [m/s]; 0 unless given: ``set_point`` of the piezo [m], ``noise`` of the carriage's sensor [m], ``met``,
                the form that the blank has already [m], and ``height``, ``cross_position`` and ``allowance`` as in
                `lathe_rc.plants.cutting.CuttingProcess.block`.

        Returns:
            By name: ``position``, ``velocity``, ``current`` and ``measured`` of the carriage, ``extension``,
            ``extension_velocity`` and ``voltage`` of the piezo [m, m/s, A, m, m, m/s, V], and ``force``,
            ``deflection``, ``depth_of_cut``, ``feed`` and ``wear`` of the cut.

        Raises:
            LatheError: drives and cut cannot go on, see `failure`.
        """
        none = np.zeros_like(given["command"])
        taken = [given.get(name, none) for name in _GIVEN]
        made = {name: np.zeros_like(none) for name in _MADE}
        reached, reason = advance_loaded(self.table, cut.table, first, *taken, *made.values())
        if reason != DONE:
            raise failure(reason, given["angle"][reached], given["speed"][reached], made["feed"][reached])
        return made

    def _check(self, coil: Coil) -> None:
        radius = float(np.abs(np.linalg.eigvals(self._closed()[0])).max())
        if radius >= 1.0:
            raise InputError(
                f"current loop of {coil.bandwidth:g} rad/s at a step of {self.step:.4g} s: largest pole {radius:.4g}; "
                "allowed: below 1 (less bandwidth or a higher sample rate; above the drive's own frequency)"
            )

    @property
    def stopped(self) -> int:
        """Samples so far that the carriage spent at an end stop."""
        return int(self.table.counts[STOPPED])

    @property
    def saturated(self) -> int:
        """Samples so far in which the piezo's set point or voltage was cut off."""
        return int(self.table.counts[SATURATED])

    def _closed(self) -> tuple[Array, Array]:
        """Transition of state and current loop's integral without limits, and the weight of the wanted position."""
        table, coil = self.table, self.table.coil
        order = table.state.size
        # U of the state before: (kp + ki·h)·(i* - i) + ki·integral
        gain = coil.proportional + coil.integral * coil.step
        row = np.zeros(order + 1)
        row[0], row[1] = -table.spring * table.force_per_current, -table.damper * table.force_per_current
        row[order - 1] = -1.0
        wanted = table.spring * table.force_per_current
        closed, weight = np.zeros((order + 1, order + 1)), np.zeros(order + 1)
        closed[:order, :order] = table.transition
        closed[:order] += np.outer(table.coarse[:, 0], gain * row + coil.integral * np.eye(order + 1)[order])
        closed[order] = coil.step * row
        closed[order, order] = 1.0
        weight[:order], weight[order] = table.coarse[:, 0] * gain * wanted, coil.step * wanted
        return closed, weight

    def _of(self, place: int, frequency: npt.ArrayLike, *, command: bool) -> Complex:
        """Response of a state to the command, or to the extension e, without feedback and force."""
        table = self.table
        if not table.coil.on:
            return seen_at(self._coarse if command else self._fine, place).response(frequency)
        wanted = np.asarray(frequency, dtype=np.float64)
        z = np.exp(1j * wanted.reshape(-1, 1) * self.step)
        transition, weight = self._closed()
        if command:
            late = (1.0 - table.part) * z ** -(table.delay + 1.0) + table.part * z ** -(table.delay + 2.0)
            right = weight * late
        else:
            extends = np.append(table.fine[:, :2], [[0.0, 0.0]], axis=0)
            right = extends[:, 0] + extends[:, 1] / z
        left = np.eye(weight.size) - transition / z[:, :, None]
        return np.asarray(np.linalg.solve(left, right[:, :, None])[:, place, 0].reshape(wanted.shape))

    def _with_feedback(self, alone: Complex, frequency: npt.ArrayLike) -> Complex:
        if self._piezo is None or not self._piezo.feedback:
            return alone
        reaction = self._piezo.stack.response(frequency) * self._of(0, frequency, command=False)
        return np.asarray(alone / (1.0 + reaction))

    def coarse_response(self, frequency: npt.ArrayLike) -> Complex:
        """Carriage over its command at ``frequency`` [rad/s], without limits and force."""
        return self._with_feedback(self._of(0, frequency, command=True), frequency)

    def fine_response(self, frequency: npt.ArrayLike) -> Complex:
        """Tool over the piezo's set point at ``frequency`` [rad/s], without limits and force."""
        assert self._piezo is not None, "there is one"
        alone = self._piezo.stack.response(frequency) * self._of(2, frequency, command=False)
        return self._with_feedback(alone, frequency)


def _no_stack(step: float) -> Stack:
    return Stack(
        stroke=1.0, amplifier_lag=0.0, hysteresis=None, inverse=None, creep_per_decade=0.0, creep_times=np.empty(0),
        step=step, method="foh",
    )  # fmt: skip
