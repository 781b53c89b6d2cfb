# SPDX-License-Identifier: Apache-2.0
"""Identification of the electrodynamic drive from a recorded command u and position x.

    Wi(p) = e^{-pτ}/(1 + 2ζp/ωn + p²/ωn²)        (papers 000 and 001)

The fit has two steps. Initial values come from linear least squares, for a set of delays τ, of the low-pass filtered
equation u(t - τ) = x + a1·dx/dt + a2·d²x/dt² (`lathe_machine.control.identification`). The second step minimises the
mean square of the simulation error: the recorded position less the response of the cell's difference equation to the
recorded command. The sensor noise affects only the position, so with the right model this error equals the noise; in
the equation error of the first step the noise is part of the regressors, and biases the result.

The motion before the record is unknown: the initial state of the comparison is fitted too, as a linear parameter.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import scipy

from lathe_machine.control.identification import DriveIdentifier
from lathe_machine.plants.electrodynamic import ElectrodynamicDrive
from lathe_machine.plants.linear import Discretisation
from lathe_rc.arrays import Array
from lathe_rc.errors import InputError

PARAMETERS = ("natural_frequency", "damping", "delay")  #: in this order wherever they are an array
MOST = 2**19  #: samples that are used; a longer record is cut

_LEAST = 512  # samples required for a fit
_LONGEST_DELAY = 0.1  # [s], as the drive's parameter allows
_DAMPINGS = (0.01, 20.0)
_STILL = 1e-9  # [m] RMS about the mean below which a command counts as constant
_FAR = 10.0  # [m]
_START = 2**17  # samples used for the initial values, where the command moves most
_FORGOTTEN = 40.0  # time constants after which the initial state has decayed
_PIECE = 8192
_BANDWIDTHS = (500.0, 2000.0, 8000.0)  # [rad/s] of the low-pass
_DELAYS = 40  # trial delays
_MOST_STEPS = 60  # of the search
_STRETCHES = 32  # of the residual, between which its correlation is neglected
_SINGULAR = 1e6  # condition number above which the parameters cannot be distinguished
_ILL = 1000.0  # condition number above which there is a warning
_UNKNOWN, _VAGUE = 0.25, 0.05  # standard error over the parameter: error, warning
_TOGETHER = 0.3  # component of a parameter in the worst-determined direction, from which it is named


@dataclass(frozen=True)
class DriveFit:
    """Identified drive model with its uncertainty; parameters by name as in `PARAMETERS`, in rad/s, 1, s.

    Attributes:
        values: parameters of the model.
        errors: standard errors of the parameters, for white or correlated residuals.
        linear: initial values from the linear fit.
        residual_rms: RMS of the simulation error [m].
        nrmse: RMS of the simulation error over the RMS of the position about its mean [1].
        condition: condition number of the position's sensitivities to the parameters, each normalised to length 1.
        vague: parameters hardly distinguished by the command, or with a standard error of 5 % or more; should be empty.
        samples: number of samples compared.
    """

    values: Mapping[str, float]
    errors: Mapping[str, float]
    linear: Mapping[str, float]
    residual_rms: float
    nrmse: float
    condition: float
    vague: tuple[str, ...]
    samples: int

    @property
    def r_squared(self) -> float:
        """Coefficient of determination: part of the position's variance explained by the model."""
        return 1.0 - self.nrmse**2


def _named(values: Array) -> dict[str, float]:
    return dict(zip(PARAMETERS, values.tolist(), strict=True))


class _Record:
    """Recorded command and position, for the comparison with simulated drives."""

    def __init__(self, command: Array, position: Array, step: float, method: Discretisation, stroke: float) -> None:
        self.command, self.position = command, position
        self._step, self._method, self._stroke = step, method, stroke
        self._room = np.empty((3, command.size))

    def residual(self, values: Array, skip: int) -> Array:
        """Compute the simulation error for ωn, ζ, τ starting at sample ``skip`` [m], shape (n - skip,).

        The drive is simulated from rest before the record. By superposition, another state at ``skip`` adds two
        solutions of the homogeneous difference equation, a pulse response of its poles and the same a sample later:
        their least-squares fit is subtracted.
        """
        drive = ElectrodynamicDrive(
            natural_frequency=float(values[0]),
            damping=float(values[1]),
            delay=float(values[2]),
            stroke=self._stroke,
            moving_mass=1.0,
            force_constant=1.0,
            step=self._step,
            method=self._method,
        )
        drive.block(self.command, *self._room)
        error: Array = self.position[skip:] - self._room[0, skip:]
        transition = drive.plant.transition
        slowest = float(np.abs(np.linalg.eigvals(transition)).max())
        length = min(error.size, int(_FORGOTTEN / -np.log(slowest)) + 2)
        pulse = np.zeros((2, length))
        pulse[0, 0] = pulse[1, 1] = 1.0
        poles = [1.0, -np.trace(transition), np.linalg.det(transition)]
        # Orthonormal columns, so that the fit is a product.
        base, _ = np.linalg.qr(scipy.signal.lfilter([1.0], poles, pulse).T)
        error[:length] -= base @ (base.T @ error[:length])
        return error


def _busiest(command: Array) -> slice:
    """Return the slice of the record in which the command moves most."""
    if command.size <= _START:
        return slice(0, command.size)
    travel = np.append(0.0, np.cumsum(np.diff(command) ** 2))
    begin = int(np.argmax(travel[_START - 1 :] - travel[: travel.size - _START + 1]))
    return slice(begin, begin + _START)


def _linear(record: _Record, step: float) -> list[Array]:
    """Fit ωn, ζ, τ by linear least squares, with the best delay for each low-pass, shape (3,) each."""
    part = _busiest(record.command)
    # The gain is 1, so a common offset may be removed: the low-passes begin at 0.
    level = record.position[part][0]
    command, position = record.command[part] - level, record.position[part] - level
    longest = min(_LONGEST_DELAY, command.size * step / 4.0)
    starts = []
    for bandwidth in _BANDWIDTHS:
        found = []
        for delay in longest * np.linspace(0.0, 1.0, _DELAYS) ** 2:
            identifier = DriveIdentifier(
                model_delay=float(delay), feedback_delay=0, bandwidth=bandwidth, forgetting=0.0, step=step, block=_PIECE
            )
            for first in range(0, command.size, _PIECE):
                piece = command[first : first + _PIECE]
                identifier.commanded(first, piece)
                identifier.block(first, 0, piece.size, position[first : first + _PIECE])
            fit = identifier.fit()
            if fit is not None:
                found.append((fit.residual, np.array([fit.natural_frequency, fit.damping, float(delay)])))
        if found:
            starts.append(min(found, key=lambda pair: pair[0])[1])
    return starts


def fit(
    command: Array, position: Array, step: float, *, method: Discretisation = "foh", stroke: float = np.inf
) -> DriveFit:
    """Identify a drive from its command and position.

    Args:
        command: set points [m], shape (n,); only the first `MOST` are used.
        position: measured position [m], shape (n,).
        step: sampling step [s].
        method: discretisation of the model.
        stroke: end stops at ± this displacement [m].

    Raises:
        InputError: an array is too short or not finite, or the command is constant or does not determine a parameter,
            which is named.
    """
    if command.size != position.size or command.size < _LEAST:
        raise InputError(
            f"{command.size} samples of the command, {position.size} of the position; allowed: as many of each, "
            f"{_LEAST} or more"
        )
    for name, values in (("command", command), ("position", position)):
        if not np.all(np.abs(values) <= _FAR):
            bad = int(np.flatnonzero(~(np.abs(values) <= _FAR))[0])
            raise InputError(f"{name} = {values[bad]} m at sample {bad}; allowed: from {-_FAR:g} to {_FAR:g} m")
    record = _Record(command[:MOST], position[:MOST], step, method, stroke)
    for name, values in (("command", record.command), ("position", record.position)):
        if np.std(values) < _STILL:
            raise InputError(
                f"the {name} does not move: {np.std(values):.3g} m RMS about its mean; nothing to identify"
            )
    starts = _linear(record, step)
    if not starts:
        raise InputError("the position does not follow the command as a stable drive would; nothing to identify")
    return _polished(record, starts, step)


def _polished(record: _Record, starts: list[Array], step: float) -> DriveFit:
    """Minimise the simulation error, starting from the best initial values."""
    longest = max(float(start[2] + 2.0 * (start[2] + 2.0 * start[1] / start[0])) for start in starts)
    longest = min(longest, _LONGEST_DELAY, record.command.size * step / 4.0)
    skip = int(np.ceil(longest / step)) + 3
    spread = float(np.std(record.position[skip:]))
    if spread < _STILL:
        raise InputError("the position does not move after its first samples; nothing to identify")
    low = np.array([2.0 / (record.command.size * step), _DAMPINGS[0], 0.0])
    high = np.array([np.pi / step, _DAMPINGS[1], longest])
    inside = [np.clip(start, low, high) for start in starts]
    linear = min(inside, key=lambda start: float(np.mean(record.residual(start, skip) ** 2)))
    scale = 1.0 / linear[0]  # of the delay

    # Logarithms of ωn and ζ: both stay positive, and a step of the search is relative.
    def values(x: Array) -> Array:
        return np.array([np.exp(x[0]), np.exp(x[1]), x[2] * scale])

    def place(of: Array) -> Array:
        return np.array([np.log(of[0]), np.log(of[1]), of[2] / scale])

    def residual(x: Array) -> Array:
        return record.residual(values(x), skip) / spread

    found = scipy.optimize.least_squares(
        residual,
        np.clip(place(linear), place(low), place(high)),
        bounds=(place(low), place(high)),
        jac="3-point",
        method="dogbox",
        x_scale="jac",
        xtol=1e-12,
        ftol=1e-13,
        gtol=1e-14,
        max_nfev=_MOST_STEPS,
    )
    best, jacobian = values(found.x), np.asarray(found.jac)
    lengths = np.linalg.norm(jacobian, axis=0)
    lengths[lengths == 0.0] = np.inf  # a parameter without any effect is unknown, not a division by 0
    _, sizes, directions = np.linalg.svd(jacobian / lengths, full_matrices=False)
    condition = float(sizes[0] / sizes[2]) if sizes[2] > 0.0 else np.inf
    worst = tuple(name for name, part in zip(PARAMETERS, directions[2], strict=True) if abs(part) > _TOGETHER)
    if condition > _SINGULAR:
        raise InputError(f"the command does not tell {' and '.join(worst)} apart (condition number {condition:.3g})")
    errors = _standard_errors(jacobian, found.fun, lengths, sizes, directions) * np.array([best[0], best[1], scale])
    # The error of a delay is relative to the total lag.
    relative = errors / np.array([best[0], best[1], best[2] + 2.0 * best[1] / best[0]])
    unknown = [name for name, error in zip(PARAMETERS, relative, strict=True) if not error < _UNKNOWN]
    if unknown:
        said = ", ".join(
            f"{name} = {best[PARAMETERS.index(name)]:.4g} ± {errors[PARAMETERS.index(name)]:.2g}" for name in unknown
        )
        raise InputError(f"the command leaves {' and '.join(unknown)} open ({said}; condition number {condition:.3g})")
    vague = {name for name, error in zip(PARAMETERS, relative, strict=True) if error > _VAGUE}
    # A search that has not converged moves along a direction that hardly changes the position.
    vague |= set(worst) if condition > _ILL or found.status == 0 else set()
    rms = float(np.sqrt(np.mean(found.fun**2)))
    return DriveFit(
        values=_named(best),
        errors=_named(errors),
        linear=_named(linear),
        residual_rms=rms * spread,
        nrmse=rms,
        condition=condition,
        vague=tuple(name for name in PARAMETERS if name in vague),
        samples=record.command.size - skip,
    )


def _standard_errors(jacobian: Array, residual: Array, lengths: Array, sizes: Array, directions: Array) -> Array:
    """Compute the standard errors, shape (3,): the larger value for a white and a correlated residual.

    White: σ²·(JᵀJ)⁻¹. Correlated within stretches of the record: (JᵀJ)⁻¹·(Σ g·gᵀ)·(JᵀJ)⁻¹ with g the sum of
    J·residual over a stretch; this is too low if the drive moves in a single stretch only, as after a step.
    """
    inverse = (directions.T / sizes**2) @ directions / np.outer(lengths, lengths)
    edges = np.arange(_STRETCHES) * residual.size // _STRETCHES
    sums = np.add.reduceat(jacobian * residual[:, None], edges)
    spread = sums.T @ sums * (_STRETCHES / (_STRETCHES - 3.0))
    white = np.diag(inverse) * (residual @ residual) / (residual.size - 3.0)
    return np.asarray(np.sqrt(np.maximum(white, np.diag(inverse @ spread @ inverse))))
