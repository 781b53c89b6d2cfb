# SPDX-License-Identifier: Apache-2.0
"""Tool drives as one mechanical system, in air or under the cutting force.

The radial part ρ·F of the cutting force F pushes the tool out of the part. Alone, the electrodynamic drive carries the
tool (mass m at x). In series (paper 001, Fig. 1b) a piezo with the tool (mass mt at x2) rides on its carriage (mass M
at x1, without the tool), r = mt/M, and e is the extension that the piezo would have without mass:

    m·x''   = k·i + ρ·F
    mt·x2'' = mt·q + ρ·F,    q = ω2²·(e - (x2 - x1)) - 2ζ2ω2·(x2 - x1)'
    M·x1''  = k·i - mt·q

The stack's stiffness is mt·ω2²; ω2, ζ2 are those of the tool on a blocked carriage. The full force of the piezo acts on
the carriage. With the further resonances of `lathe_machine.plants.modes`, x1 is the carriage's edge, where the piezo
sits; the position loop acts on its sensor. The coil's current i is set by the drive's position loop

    i* = (m/k)·(ω1²·(g·u(t - τ) - x1) - 2ζ1ω1·x1')

with M alone, where only the command is delayed; the gain g is 1 in the papers. The current follows either at once
(``coil=None``: the second-order drive of papers 000 and 001, bit-identical without force), or by a current loop. That
loop is sampled with the step of the cell (`lathe_machine.plants.coil`): from the state of a sample it computes the
voltage U that is held until the next one,

    L·di/dt = U - R·i - k·x1'

The interaction of drives and cut within a sample is solved together with the chip, see `lathe_machine.plants.cutting`:
the force of sample n moves the tool that makes the chip of sample n. The force is assumed linear between samples.

In air this definition gives |1 - Wpk| = .0396 .1016 .1348 .1515 at 500 ... 2000 rad/s for r = 0.1, where Wpk is x2
over e. The .039 .101 .133 .150 of spec/learning.md are reproduced to all digits with ζ2 = 0.292, for which a blocked
carriage gives the .020 .040 .061 .083 printed beside them; with ζ2 = 0.299 both rows are 1-3 % higher. With ω1 referred
to M + mt two entries are 5 % too low, with the servo's delay inside its loop one is 60 % too high.

For r -> 0 the carriage is the coarse drive and x2/e is that of the fine drive. The remaining coupling does not depend
on the mass ratio: the tool's inertia bends the piezo by -x1''/ω2² while the carriage accelerates.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from lathe_machine.plants.chip import DONE
from lathe_machine.plants.coil import Coil, coil_table
from lathe_machine.plants.cutting import MADE, CuttingProcess
from lathe_machine.plants.drift import NONE as NO_DRIFT
from lathe_machine.plants.drift import Drift
from lathe_machine.plants.linear import DiscretePlant, Discretisation, continuous_poles, discretise
from lathe_machine.plants.modes import NONE, Carriage, Modes, carriage
from lathe_machine.plants.piezo import Stack, StackTable
from lathe_machine.plants.tool_motion import GIVEN, MotionTable, Weights, advance_loaded, failure
from lathe_rc.arrays import Array, Complex, Integers
from lathe_rc.errors import InputError

_CARRIAGE, _TOOL = 0, 2  # indices of the positions in the state: x1, x1', x2, x2'

# Motion signals of a block, in the order of the kernel.
_MOTION = ("position", "velocity", "current", "measured", "extension", "extension_velocity", "voltage")


@dataclass(frozen=True)
class Piezo:
    """Piezo drive on the carriage of an electrodynamic drive.

    Attributes:
        stack: amplifier and ceramics; its state becomes part of the drive.
        natural_frequency, damping: ω2 [rad/s], ζ2 [1] of the tool on a blocked carriage.
        mass_ratio: r.
        full_voltage: voltage at the full stroke [V].
        feedback: direct compensation: the measured position of the carriage is subtracted from the piezo's set point in
            the same sample.
        preload: of the stack [N]; inf for a stack that withstands any tension.
    """

    stack: Stack
    natural_frequency: float
    damping: float
    mass_ratio: float
    full_voltage: float
    feedback: bool = False
    preload: float = np.inf


def _seen_at(plant: DiscretePlant, place: int) -> DiscretePlant:
    """Return a plant with the state at index ``place`` moved to the front, for `DiscretePlant.response`."""
    order = np.roll(np.arange(plant.transition.shape[0]), -place)
    return DiscretePlant(
        plant.transition[np.ix_(order, order)], plant.weights[order], plant.delay, plant.fraction, plant.step
    )


def _joined(carriage: Array, force: Array, place: Integers, piezo: Piezo | None, base: int) -> Array:
    """Return the equations x' = a·x of a carriage, with the tool on its piezo if there is one.

    Args:
        carriage: equations of the carriage alone, shape (n, n).
        force: its acceleration by a force at the edge over its mass, shape (n,).
        place: place of its states, shape (n,).
        piezo: piezo that reacts on the carriage.
        base: place of the position of the piezo's base.
    """
    if piezo is None:
        return carriage
    a = np.zeros((place.size + 2, place.size + 2))
    a[np.ix_(place, place)] = carriage
    stiff, loss = piezo.natural_frequency**2, 2.0 * piezo.damping * piezo.natural_frequency
    q = np.zeros(place.size + 2)
    q[base : base + 2], q[_TOOL : _TOOL + 2] = (stiff, loss), (-stiff, -loss)
    a[place] += np.outer(force, -piezo.mass_ratio * q)
    a[_TOOL, _TOOL + 1] = 1.0
    a[_TOOL + 1] = q
    return a


def _check_feedback(fine: DiscretePlant, piezo: Piezo) -> None:
    """Check that direct compensation is stable, with both masses as the extension moves them."""
    within = abs(fine.weights[_CARRIAGE, 0]) * piezo.stack.steepest
    if within >= 0.5:
        raise InputError(
            f"series drive: at a step of {fine.step:g} s direct compensation moves the carriage by {within:.3g} of "
            "itself within a sample; allowed: below 0.5 (raise the sample rate)"
        )
    radius = _feedback_radius(fine, piezo.stack.table)
    if radius >= 1.0:
        raise InputError(
            f"series drive: direct compensation oscillates over the carriage with m/M = {piezo.mass_ratio:g}: largest "
            f"pole {radius:.6g}; allowed: below 1 (more damping of the piezo or less mass on it)"
        )


def _feedback_radius(fine: DiscretePlant, stack: StackTable) -> float:
    """Return the largest magnitude of the poles under direct compensation, linearised, without creep."""
    # The state is that of the masses, e and the amplifier's input -x1; left·state[n] = right·state[n-1].
    masses = fine.transition.shape[0]
    left, right = np.eye(masses + 2), np.zeros((masses + 2, masses + 2))
    left[:masses, -2] = -fine.weights[:, 0]
    left[-2, -1], left[-1, _CARRIAGE] = -stack.now, 1.0
    right[:masses, :masses], right[:masses, -2] = fine.transition, fine.weights[:, 1]
    right[-2, -2:] = stack.decay, stack.before
    return float(np.abs(np.linalg.eigvals(np.linalg.solve(left, right))).max())


class ToolDrive:
    """Simulated drives of the tool: an electrodynamic carriage, alone or in series with a piezo.

    Args:
        natural_frequency, damping: ω1 [rad/s], ζ1 [1] of the position loop.
        delay: τ of the command [s].
        stroke: end stops at ± this displacement [m].
        moving_mass: m or M [kg].
        force_constant: k of the coil [N/A].
        radial: ρ, fraction of the main cutting force that acts along the drives; 0 for none.
        coil: current loop; None: the force of the position loop acts at once.
        piezo: piezo drive on the carriage; None: the carriage alone carries the tool.
        resolution: of the carriage's position sensor [m]; 0 for none.
        gain: static gain of the position loop, of either sign.
        modes: further resonances of the carriage, at whose edge the tool or the piezo sits.
        drift: drift of gain and modes.
        step: sampling step [s].
        method: discretisation, see `lathe_machine.plants.linear.discretise`.
        kept: length of the history of limited samples of the current loop, a power of two.

    Attributes:
        table: constants and state for `advance` and `advance_loaded` of `lathe_machine.plants.tool_motion`.

    Raises:
        InputError: the current loop is too fast for the step, it oscillates, or there are modes beside it; the modes
            are not normal, so that their motion under a force is unknown; direct compensation would oscillate, or the
            step is too coarse for it.
    """

    def __init__(
        self,
        *,
        natural_frequency: float,
        damping: float,
        delay: float,
        stroke: float,
        moving_mass: float,
        force_constant: float,
        radial: float = 0.0,
        coil: Coil | None = None,
        piezo: Piezo | None = None,
        resolution: float = 0.0,
        gain: float = 1.0,
        modes: Modes = NONE,
        drift: Drift = NO_DRIFT,
        step: float,
        method: Discretisation,
        kept: int = 1,
    ) -> None:
        if coil and modes.frequency:
            raise InputError("modes belong to a closed position loop; allowed: without a current loop")
        if not modes.normal:
            raise InputError(
                "mode_velocity and lag_time say how the drive follows its command, not how it gives way to a force; "
                "allowed: in an electrodynamic_actuator"
            )
        mass = carriage(natural_frequency, damping, modes)
        spring, damper = natural_frequency**2, 2.0 * damping * natural_frequency
        base, tool, mass_of_tool = mass.edge, mass.edge, moving_mass
        count = mass.command.size
        place = np.arange(
            count, dtype=np.int64
        )  # of the carriage in the state; the tool on a piezo comes behind its sensor
        stiff = loss = 0.0
        if piezo:
            place[2:] += 2
            base, tool, mass_of_tool = int(place[mass.edge]), _TOOL, piezo.mass_ratio * moving_mass
            stiff, loss = piezo.natural_frequency**2, 2.0 * piezo.damping * piezo.natural_frequency
            count += 2
        order = count + (coil is not None)

        def plants(mass: Carriage) -> tuple[Array, Array, DiscretePlant, DiscretePlant, Weights]:
            servo = _joined(mass.a, mass.force, place, piezo, base)
            a, drives, extends, loads = servo, *np.zeros((3, order))
            drives[place] = gain * mass.command
            if piezo:
                extends[place] = -piezo.mass_ratio * stiff * mass.force
                extends[_TOOL + 1] = stiff
            if radial and piezo:
                loads[_TOOL + 1] = 1.0 / mass_of_tool
            elif radial:
                loads[place] = mass.force / moving_mass
            if coil:  # the coil moves the carriage, in place of the servo
                a = np.zeros((order, order))
                a[:-1, :-1] = _joined(np.array([[0.0, 1.0], [0.0, 0.0]]), mass.force, place, piezo, base)
                a[1, -1] = force_constant / moving_mass
                a[-1, -1] = -coil.resistance / coil.inductance
                a[-1, 1] = -force_constant / coil.inductance if coil.back_emf else 0.0
                drives[1], drives[-1] = 0.0, 1.0 / coil.inductance
            coarse = discretise(a, drives, delay, step, method)
            fine = discretise(a, extends, 0.0, step, method)
            weights = coarse.weights.copy()
            if coil:  # the voltage is held through a step
                weights = np.zeros((order, 3))
                weights[:, 0] = discretise(a, drives, 0.0, step, method).weights.sum(axis=1)
            # Copies, which a drift changes: cells share the plants.
            load = discretise(a, loads, 0.0, step, method).weights.copy()
            return servo, extends, coarse, fine, Weights(coarse.transition.copy(), weights, fine.weights.copy(), load)

        servo, extends, self._coarse, self._fine, weights = plants(mass)
        along = [plants(carriage(natural_frequency, damping, modes.moved(state.modes)))[-1] for state in drift.states()]
        self.step, self._piezo = step, piezo
        stack = piezo.stack if piezo else Stack(stroke=1.0, step=step, method="foh")  # not stepped without one
        self.table = MotionTable(
            series=piezo is not None,
            weights=weights,
            tool=tool,
            base=base,
            delay=self._coarse.delay,
            part=self._coarse.fraction,
            gain=gain,
            spring=spring,
            damper=damper,
            force_per_current=moving_mass / force_constant,
            carriage_stroke=stroke,
            stack=stack.table,
            memory=stack.state,
            full_voltage=piezo.full_voltage if piezo else 0.0,
            feedback=piezo is not None and piezo.feedback,
            resolution=resolution,
            stiff=stiff,
            loss=loss,
            tension=piezo.preload / mass_of_tool if piezo and piezo.preload < np.inf else np.inf,
            radial=radial,
            coil=coil_table(coil, step, kept),
            state=np.zeros(order),
            before=np.zeros(2),
            reading=np.zeros(1),
            line=np.zeros(self._coarse.delay + 3),
            drift=drift.table([np.hstack(each) for each in along], step),
        )
        if coil:
            self._check(coil)
        if piezo and piezo.feedback:  # checked without the current loop
            _check_feedback(discretise(servo, extends[:count], 0.0, step, method), piezo)

    def block(self, cut: CuttingProcess, first: int, given: Mapping[str, Array]) -> dict[str, Array]:
        """Step tool drives and cut through a block, starting at sample ``first``; at rest at 0 before sample 0.

        Args:
            cut: cutting process; its state is updated.
            first: index of the first sample.
            given: arrays by name, of shape (n,): ``command`` [m], ``angle`` [rad], ``speed`` [rad/s] and
                ``feed_velocity`` [m/s]; optional, with a default of 0: ``set_point`` of the piezo [m], ``noise`` of the
                carriage's sensor [m] and its ``jitter`` [s], ``met``, the present form of the blank [m], and
                ``height``, ``cross_position`` and ``allowance`` as in
                `lathe_machine.plants.cutting.CuttingProcess.block`.

        Returns:
            Arrays by name: ``position``, ``velocity``, ``current`` and ``measured`` of the carriage, ``extension``,
            ``extension_velocity`` and ``voltage`` of the piezo [m, m/s, A, m, m, m/s, V], and ``force``,
            ``deflection``, ``depth_of_cut``, ``feed`` and ``wear`` of the cut.

        Raises:
            LatheError: the motion or the cut has failed, see `failure`.
        """
        none = np.zeros_like(given["command"])
        taken = tuple(given.get(name, none) for name in GIVEN)
        motion, of_cut = ({name: np.zeros_like(none) for name in names} for names in (_MOTION, MADE))
        reached, reason = advance_loaded(
            self.table, cut.table, first, taken, tuple(motion.values()), tuple(of_cut.values())
        )
        if reason != DONE:
            raise failure(reason, given["angle"][reached], given["speed"][reached], of_cut["feed"][reached])
        return motion | of_cut

    def _check(self, coil: Coil) -> None:
        """Check that the current loop does not oscillate."""
        radius = float(np.abs(np.linalg.eigvals(self._closed()[0])).max())
        if radius >= 1.0:
            raise InputError(
                f"current loop of {coil.bandwidth:g} rad/s at a step of {self.step:.4g} s: largest pole {radius:.4g}; "
                "allowed: below 1 (less bandwidth or a higher sample rate; above the drive's own frequency)"
            )

    def _closed(self) -> tuple[Array, Array]:
        """Return transition and set-point weight of the closed current loop (state and integral), without limits."""
        table, coil = self.table, self.table.coil
        order = table.state.size
        # U of the state before: (kp + ki·h)·(i* - i) + ki·integral
        gain = coil.proportional + coil.integral * coil.step
        row = np.zeros(order + 1)
        row[0], row[1] = -table.spring * table.force_per_current, -table.damper * table.force_per_current
        row[order - 1] = -1.0
        wanted = table.gain * table.spring * table.force_per_current
        closed, weight = np.zeros((order + 1, order + 1)), np.zeros(order + 1)
        closed[:order, :order] = table.weights.transition
        closed[:order] += np.outer(table.weights.coarse[:, 0], gain * row + coil.integral * np.eye(order + 1)[order])
        closed[order] = coil.step * row
        closed[order, order] = 1.0
        weight[:order], weight[order] = table.weights.coarse[:, 0] * gain * wanted, coil.step * wanted
        return closed, weight

    def _of(self, place: int, frequency: npt.ArrayLike, *, command: bool) -> Complex:
        """Return the response of a state to the command, or to the extension e, without feedback and force."""
        table = self.table
        if not table.coil.on:
            return _seen_at(self._coarse if command else self._fine, place).response(frequency)
        wanted = np.asarray(frequency, dtype=np.float64)
        z = np.exp(1j * wanted.reshape(-1, 1) * self.step)
        transition, weight = self._closed()
        if command:
            late = (1.0 - table.part) * z ** -(table.delay + 1.0) + table.part * z ** -(table.delay + 2.0)
            right = weight * late
        else:
            extends = np.append(table.weights.fine[:, :2], [[0.0, 0.0]], axis=0)
            right = extends[:, 0] + extends[:, 1] / z
        left = np.eye(weight.size) - transition / z[:, :, None]
        return np.asarray(np.linalg.solve(left, right[:, :, None])[:, place, 0].reshape(wanted.shape))

    def _with_feedback(self, alone: Complex, frequency: npt.ArrayLike) -> Complex:
        """Convert a response without direct compensation to the response under direct compensation."""
        if self._piezo is None or not self._piezo.feedback:
            return alone
        reaction = self._piezo.stack.linear.response(frequency) * self._of(_CARRIAGE, frequency, command=False)
        return np.asarray(alone / (1.0 + reaction))

    @cached_property
    def poles(self) -> Complex:
        """Poles of carriage and tool, without direct compensation [rad/s], shape (m,)."""
        return continuous_poles(self._closed()[0], self.step) if self.table.coil.on else self._coarse.poles

    def coarse_response(self, frequency: npt.ArrayLike) -> Complex:
        """Return the response, carriage over command, at ``frequency`` [rad/s], without limits or force."""
        return self._with_feedback(self._of(_CARRIAGE, frequency, command=True), frequency)

    def fine_response(self, frequency: npt.ArrayLike) -> Complex:
        """Return the response, tool over piezo set point, at ``frequency`` [rad/s], without limits or force."""
        assert self._piezo is not None, "there is one"
        alone = self._piezo.stack.linear.response(frequency) * self._of(_TOOL, frequency, command=False)
        return self._with_feedback(alone, frequency)
