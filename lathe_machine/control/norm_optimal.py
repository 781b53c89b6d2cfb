# SPDX-License-Identifier: Apache-2.0
"""Norm-optimal learning of a periodic command within limits.

The quadratic program min Σ wi·(xi - x̂i)² subject to A·x <= b becomes, with z = √w·(x - x̂), a search for the least |z|
with G·z >= h, which one nonnegative least-squares problem solves exactly (Lawson, Hanson, Solving Least Squares
Problems, 1974, ch. 23: LDP).
"""

import numpy as np
import scipy

from lathe_rc.arrays import Array


def nearest(wanted: Array, weights: Array, rows: Array, bounds: Array) -> Array:
    """Return the x nearest to x̂ in the weighted norm with A·x <= b, shape (n,).

    The set of such x must not be empty.

    Args:
        wanted: x̂, shape (n,).
        weights: w, above 0, shape (n,).
        rows: A, shape (m, n).
        bounds: b, shape (m,).
    """
    over = rows @ wanted - bounds
    scale = np.abs(over).max(initial=0.0)
    if not over.size or over.max() <= 0.0:
        return wanted
    root = np.sqrt(weights)
    system = np.vstack((-(rows / root).T, over / scale))
    target = np.zeros(wanted.size + 1)
    target[-1] = 1.0
    share = scipy.optimize.nnls(system, target)[0]
    rest = system @ share - target
    return np.asarray(wanted - scale * rest[:-1] / (rest[-1] * root))


def waves(angle: Array, orders: int, derivative: int = 0) -> Array:
    """Return the derivative of 1, cos nφ and sin nφ at some angles [rad], n from 1 to ``orders``, shape (m, 2n + 1)."""
    n = np.arange(orders + 1)
    turned = np.outer(angle, n) + 0.5 * np.pi * derivative
    scale = n.astype(float) ** derivative
    return np.hstack((scale * np.cos(turned), (scale * np.sin(turned))[:, 1:]))
