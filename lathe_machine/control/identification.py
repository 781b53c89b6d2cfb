# SPDX-License-Identifier: Apache-2.0
"""Online identification of a drive from its command u and its measured position x.

    u(t - τ) = x + a1·dx/dt + a2·d²x/dt²        a1 = 2ζ/ωn, a2 = 1/ωn², τ known

Both sides pass through the same low-pass (ω/(p + ω))³, whose stages give the filtered derivatives without numerical
differentiation.

**Learning controller**: least squares over the completed cycles, with a forgetting factor. One harmonic is enough for
both coefficients; the speed of the spindle may vary.

**Unknown disturbance** f that repeats with the angle: the difference from the previous revolution at the same angle
cancels f. This requires a varying speed. In addition, the equation itself is used with a small weight, and the given
model serves as a prior whose weight increases with f.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from lathe_rc.arrays import Array, put_scaled
from lathe_rc.jit import inlined, kernel

STAGES = 3  #: number of first-order stages of each low-pass
_LEAST_EXCITED = 1e-6  # smallest determinant of the normal equations, relative to that of orthogonal regressors


class LowPass(NamedTuple):
    """Low-pass 1/(1 + p/ω)³, discretised by the bilinear rule, for the two signals of a drive.

    Attributes:
        bandwidth: ω [rad/s].
        keep, take: feedback and input coefficients of a stage.
        position, command: values before and after each stage, shape (4,) [m].
    """

    bandwidth: float
    keep: float
    take: float
    position: Array
    command: Array


def low_pass(bandwidth: float, step: float, stages: int = STAGES) -> LowPass:
    """Create a low-pass with a given ``bandwidth`` [rad/s], at rest at 0; ``step`` is in s."""
    half = 0.5 * bandwidth * step
    return LowPass(
        bandwidth, (1.0 - half) / (1.0 + half), half / (1.0 + half), np.zeros(stages + 1), np.zeros(stages + 1)
    )


@inlined
def pass_through(stages: Array, value: float, keep: float, take: float) -> None:
    """Advance the low-pass of one signal by one sample."""
    new, last = value, stages.size - 1
    for stage in range(last):
        old = stages[stage]
        stages[stage] = new
        new = keep * stages[stage + 1] + take * (new + old)
    stages[last] = new


@inlined
def derivatives(stages: Array, bandwidth: float) -> tuple[float, float]:
    """Compute the first and second time derivatives of a low-pass output."""
    first = bandwidth * (stages[STAGES - 1] - stages[STAGES])
    return first, bandwidth**2 * (stages[STAGES - 2] - 2.0 * stages[STAGES - 1] + stages[STAGES])


@inlined
def add_products(sums: Array, place: int, velocity: float, acceleration: float, rest: float) -> None:
    """Add the products vv, va, aa, vr and ar of dx/dt, d²x/dt² and u - x to five ``sums`` starting at ``place``."""
    sums[place] += velocity * velocity
    sums[place + 1] += velocity * acceleration
    sums[place + 2] += acceleration * acceleration
    sums[place + 3] += velocity * rest
    sums[place + 4] += acceleration * rest


@inlined
def excited(vv: float, va: float, aa: float) -> bool:
    """Return whether dx/dt and d²x/dt² are linearly independent, from the sums of their squares and of their product.

    The determinant is compared with that of orthogonal regressors, since dx/dt and d²x/dt² differ by orders of
    magnitude.
    """
    return bool(vv * aa - va * va > _LEAST_EXCITED * vv * aa > 0.0)


@inlined
def coefficients(vv: float, va: float, aa: float, vr: float, ar: float) -> tuple[float, float]:
    """Solve the normal equations for a1 [s] and a2 [s²], given the sums of `add_products`."""
    determinant = vv * aa - va * va
    return (vr * aa - ar * va) / determinant, (ar * vv - vr * va) / determinant


_LOOK_BACK = 2  # earlier samples of the command needed for a fractional delay


class IdentifierTable(NamedTuple):
    """State of a `DriveIdentifier` for kernels.

    Attributes:
        delay, part: delay from the command to the available position, as whole samples and a fraction of a sample.
        commands: past commands; sample n is at index n modulo the length, a power of two [m].
        low: low-pass for both sides of the equation.
        sums: sums of the normal equations.
    """

    delay: int
    part: float
    commands: Array
    low: LowPass
    sums: Array


@kernel
def command_sent(identifier: IdentifierTable, first: int, start: int, stop: int, command: Array) -> None:
    """Store the set points ``start`` to ``stop`` of a block that begins at sample ``first`` [m]."""
    mask = identifier.commands.size - 1
    for k in range(start, stop):
        identifier.commands[(first + k) & mask] = command[k]


@kernel
def accumulate(identifier: IdentifierTable, first: int, start: int, stop: int, position: Array) -> None:
    """Add positions ``start`` to ``stop`` [m] of a block that begins at sample ``first`` to the normal equations."""
    delay, part, low = identifier.delay, identifier.part, identifier.low
    commands, sums = identifier.commands, identifier.sums
    mask = commands.size - 1
    for k in range(start, stop):
        n = first + k - delay
        if n < _LOOK_BACK:
            continue
        pass_through(
            low.command, (1.0 - part) * commands[n & mask] + part * commands[(n - 1) & mask], low.keep, low.take
        )
        pass_through(low.position, position[k], low.keep, low.take)
        first_derivative, second_derivative = derivatives(low.position, low.bandwidth)
        u = low.command[STAGES]
        rest = u - low.position[STAGES]
        add_products(sums, 0, first_derivative, second_derivative, rest)
        sums[5] += rest * rest
        sums[6] += u * u


@dataclass(frozen=True)
class Identified:
    """Identified second-order drive model.

    Attributes:
        natural_frequency: ωn [rad/s].
        damping: ζ.
        residual: RMS of the model residual, relative to the RMS of the command.
    """

    natural_frequency: float
    damping: float
    residual: float


class DriveIdentifier:
    """Identifier of ωn and ζ of a second-order drive with a known delay.

    Args:
        model_delay: τ [s].
        feedback_delay: number of samples until a measured position is available.
        bandwidth: ω of the low-pass [rad/s]; above the profile's harmonics and below the noise.
        forgetting: factor applied to the measurements at the end of a cycle, 0 to 1.
        step: sampling step [s].
        block: longest block [sample].

    Attributes:
        table: state for `accumulate` and `command_sent`.
    """

    def __init__(
        self,
        *,
        model_delay: float,
        feedback_delay: int,
        bandwidth: float,
        forgetting: float,
        step: float,
        block: int,
    ) -> None:
        whole = int(np.floor(model_delay / step + 1e-9))
        delay = feedback_delay + whole
        self._forgetting = forgetting
        self.table = IdentifierTable(
            delay=delay,
            part=max(model_delay / step - whole, 0.0),
            commands=np.zeros(1 << (delay + block + _LOOK_BACK).bit_length()),
            low=low_pass(bandwidth, step),
            sums=np.zeros(7),
        )

    def block(self, first: int, start: int, stop: int, position: Array) -> None:
        """Process positions ``start`` to ``stop`` of a block that begins at sample ``first`` [m]."""
        accumulate(self.table, first, start, stop, position)

    def commanded(self, first: int, command: Array) -> None:
        """Store the set points of a complete block that begins at sample ``first`` [m]."""
        command_sent(self.table, first, 0, command.size, command)

    def fit(self) -> Identified | None:
        """Estimate the drive model, then apply the forgetting factor to the measurements.

        Returns:
            The model, or None if the measurements do not determine it.
        """
        s11, s12, s22, s1, s2, rest, command = self.table.sums
        found = None
        if excited(s11, s12, s22):
            a1, a2 = coefficients(s11, s12, s22, s1, s2)
            if a1 > 0.0 and a2 > 0.0 and command > 0.0:
                unexplained = max(rest - a1 * s1 - a2 * s2, 0.0)  # rounding may make it negative
                frequency = float(1.0 / np.sqrt(a2))
                found = Identified(frequency, float(a1 * frequency / 2.0), float(np.sqrt(unexplained / command)))
        self.table.sums[:] *= self._forgetting
        return found


_WHOLE = 3e-4  # weight of the equation itself, relative to its difference from the previous revolution
_UNSURE = (0.3, 0.4)  # relative standard deviations of the given a1 and a2


class FitTable(NamedTuple):
    """Accumulated measurements for fitting the model of a drive under a disturbance.

    Attributes:
        given: a1 [s] and a2 [s²] of the given model, shape (2,).
        before: dx/dt, d²x/dt² and u - x of the previous revolution, shape (3, n).
        sums: sums of the normal equations, those of the differences first, shape (10,).
        means: count, and sums of dx/dt, d²x/dt², u - x and (u - x)², used to remove the effect of a constant force.
        forgetting: factor applied to ``sums`` and ``means`` at the end of a revolution.
    """

    given: Array
    before: Array
    sums: Array
    means: Array
    forgetting: float


def no_measurements(given: Array, points: int, forgetting: float) -> FitTable:
    """Create an empty fit table for ``points`` grid points per revolution."""
    return FitTable(given, np.zeros((3, points)), np.zeros(10), np.zeros(5), forgetting)


def forget_measurements(m: FitTable) -> None:
    """Discard all measurements of a fit table."""
    for array in (m.before, m.sums, m.means):
        array[:] = 0.0


@inlined
def sum_up(
    m: FitTable,
    here: int,
    again: bool,  # noqa: FBT001 - kernels take their arguments by position
    velocity: float,
    acceleration: float,
    rest: float,
) -> None:
    """Add dx/dt, d²x/dt² and u - x at grid point ``here``, where the previous revolution has a value if ``again``."""
    sums, before = m.sums, m.before
    if again:
        v, a, r = velocity - before[0, here], acceleration - before[1, here], rest - before[2, here]
        add_products(sums, 0, v, a, r)
    add_products(sums, 5, velocity, acceleration, rest)
    mean = m.means
    mean[0] += 1.0
    mean[1] += velocity
    mean[2] += acceleration
    mean[3] += rest
    mean[4] += rest * rest
    before[0, here], before[1, here], before[2, here] = velocity, acceleration, rest


@inlined
def fitted(m: FitTable) -> tuple[float, float]:
    """Fit a1 [s] and a2 [s²] by least squares; they are not positive if the measurements do not determine them."""
    count, v, a, r, rr = m.means[0], m.means[1], m.means[2], m.means[3], m.means[4]
    whole, s = m.sums[5:].copy(), m.sums[:5].copy()
    # Centred, so that a constant force is not mistaken for a lag.
    for k, mean in enumerate((v * v, v * a, a * a, v * r, a * r)):
        whole[k] -= mean / count
    if not excited(whole[0], whole[1], whole[2]):
        return 0.0, 0.0
    a1, a2 = coefficients(whole[0], whole[1], whole[2], whole[3], whole[4])
    # The force is assumed to be as large at the harmonics of the motion as at the others, where it is the residual.
    left = _WHOLE * max(rr - r * r / count - a1 * whole[3] - a2 * whole[4], 0.0)
    sure1, sure2 = left / (_UNSURE[0] * m.given[0]) ** 2, left / (_UNSURE[1] * m.given[1]) ** 2
    s += _WHOLE * whole
    s[0] += sure1
    s[2] += sure2
    s[3] += sure1 * m.given[0]
    s[4] += sure2 * m.given[1]
    return coefficients(s[0], s[1], s[2], s[3], s[4])


@inlined
def fade(m: FitTable) -> None:
    """Apply the forgetting factor to the measurements at the end of a revolution."""
    put_scaled(m.sums, m.forgetting, m.sums)
    put_scaled(m.means, m.forgetting, m.means)
