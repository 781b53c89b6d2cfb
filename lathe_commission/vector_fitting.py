# SPDX-License-Identifier: Apache-2.0
"""Poles of a rational function that approximates a frequency response: vector fitting.

Source: Gustavsen and Semlyen, Rational approximation of frequency domain responses by vector fitting, IEEE Trans. Power
Delivery 14 (1999) 1052. The function is strictly proper. Poles that are not stable are mirrored.
"""

import numpy as np

from lathe_rc.arrays import Array, Complex

_LEAST_DAMPING = 1e-4  # of a pole


def _basis(p: Complex, poles: Complex) -> Complex:
    """Return partial fractions with real coefficients at ``p``, shape (n, m); of a pair the pole with Im > 0 counts."""
    columns = []
    for pole in poles:
        one = 1.0 / (p - pole)
        if pole.imag == 0.0:
            columns.append(one)
        else:
            other = 1.0 / (p - pole.conjugate())
            columns += [one + other, 1j * (one - other)]
    return np.stack(columns, axis=1)


def real_and_imaginary(values: Complex) -> Array:
    """Return real and imaginary parts one after the other, shape (2n,) or (2n, k)."""
    return np.concatenate((values.real, values.imag))


def first_poles(low: float, high: float, order: int) -> Complex:
    """Return an order's poles to begin with, of pairs those with Im > 0: spread from ``low`` to ``high`` [rad/s]."""
    pairs = np.geomspace(low, high, order // 2 + 2)[1:-1] * (-0.05 + 1j)
    return np.append(pairs, [complex(-np.sqrt(low * high))] * (order % 2))


def relocated(frequency: Array, value: Complex, weight: Array, poles: Complex, rounds: int) -> tuple[Complex, float]:
    """Move poles to those of the weighted least-squares approximation of a response.

    Args:
        frequency: frequencies [rad/s], shape (n,).
        value: response, shape (n,).
        weight: weight of each point, shape (n,).
        poles: poles to begin with [rad/s], of pairs those with Im > 0.
        rounds: number of relocations.

    Returns:
        The poles, and the sum of the squares of the weighted residuals in the last round.
    """
    scale = float(frequency[-1])
    p, poles = np.asarray(1j * frequency / scale, np.complex128), poles / scale
    rest = np.inf
    for _ in range(rounds):
        basis = _basis(p, poles)
        order = basis.shape[1]
        both = weight[:, None] * np.hstack((basis, -value[:, None] * basis))
        matrix = real_and_imaginary(np.asarray(both, np.complex128))
        wanted = real_and_imaginary(np.asarray(weight * value, np.complex128))
        lengths = np.maximum(np.linalg.norm(matrix, axis=0), np.finfo(float).tiny)
        solution = np.linalg.lstsq(matrix / lengths, wanted, rcond=None)[0] / lengths
        rest = float(np.sum((matrix @ solution - wanted) ** 2))
        poles = _zeros(poles, solution[order:])
    return poles * scale, rest


def _zeros(poles: Complex, residues: Array) -> Complex:
    """Return the zeros of 1 + Σ residue/(p - pole), mirrored to be stable; of pairs those with Im > 0."""
    order = residues.size
    a, b, place = np.zeros((order, order)), np.zeros(order), 0
    for pole in poles:
        if pole.imag == 0.0:
            a[place, place], b[place] = pole.real, 1.0
            place += 1
        else:
            a[place : place + 2, place : place + 2] = [[pole.real, pole.imag], [-pole.imag, pole.real]]
            b[place] = 2.0
            place += 2
    found = np.linalg.eigvals(a - np.outer(b, residues))
    kept = found[found.imag >= 0.0]
    moved = -np.maximum(np.abs(kept.real), _LEAST_DAMPING * np.abs(kept)) + 1j * kept.imag
    return np.asarray(moved, np.complex128)
