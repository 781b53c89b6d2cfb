# SPDX-License-Identifier: Apache-2.0
"""Weights of past cycles for repetitive control under random errors.

Each cycle gives the wanted memory with a random error of its own. High-order repetitive control (Pipeleers et al. 2008,
Automatica 44) fixes the weights; equal ones pass the least of the random part. In Gaussian-process repetitive control
(after Mooren, Witvoet, Oomen 2022, Automatica 140) they follow from how the wanted memory changes: here as an
Ornstein-Uhlenbeck process around a constant.
"""

import numpy as np


def of_gaussian_process(cycles: int, length: float, noise: float) -> list[float]:
    """Return the weights of the newest ``cycles``, the newest first, that predict the next one with the least variance.

    This is ordinary kriging: the mean of the process is constant and unknown, so that the sum of the weights is 1.

    Args:
        cycles: number of cycles.
        length: cycles over which the correlation of the wanted memory falls by 1/e.
        noise: variance of the random error, relative to that of the process.

    Example:
        >>> [round(weight, 2) for weight in of_gaussian_process(3, length=2.0, noise=0.1)]
        [0.7, 0.13, 0.17]
    """
    age = np.arange(cycles)
    known = np.exp(-np.abs(age[:, None] - age) / length) + noise * np.eye(cycles)
    wanted, one = np.exp(-(age + 1.0) / length), np.ones(cycles)
    of_mean, weights = np.linalg.solve(known, np.stack((one, wanted), axis=1)).T
    found: list[float] = (weights + of_mean * (1.0 - weights.sum()) / of_mean.sum()).tolist()
    return found
