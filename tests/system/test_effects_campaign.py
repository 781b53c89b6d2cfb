# SPDX-License-Identifier: Apache-2.0
"""Total effects of analytic functions, from Saltelli samples of which a dependent part is refused."""

import os

import numpy as np
import pytest

from lathe_explore.sweep import space
from lathe_explore.sweep.effects import Axis, groups, total_effect

pytestmark = pytest.mark.system

POINTS, TRUTH = 128, 200_000


def scaled(u, *ends):
    return [low + (high - low) * column for column, (low, high) in zip(u.T, ends, strict=True)]


def ishigami(u):
    x, y, z = scaled(u, *[(-np.pi, np.pi)] * 3)
    return np.sin(x) + 7.0 * np.sin(y) ** 2 + 0.1 * z**4 * np.sin(x)


def g_function(u):
    a = np.array([0.0, 1.0, 4.5, 9.0, 99.0, 99.0])
    return np.prod((np.abs(4.0 * u - 2.0) + a) / (1.0 + a), axis=1)


def bratley(u):
    return (np.cumprod(u, axis=1) * [-1.0, 1.0, -1.0, 1.0]).sum(axis=1)


def friedman(u):
    return 10.0 * np.sin(np.pi * u[:, 0] * u[:, 1]) + 20.0 * (u[:, 2] - 0.5) ** 2 + 10.0 * u[:, 3] + 5.0 * u[:, 4]


def borehole(u):
    ends = (0.05, 0.15), (100, 5e4), (63070, 115600), (990, 1110), (63.1, 116), (700, 820), (1120, 1680), (9855, 12045)
    radius, reach, upper, head, lower, depth, length, conductivity = scaled(u, *ends)
    ratio = np.log(reach / radius)
    leak = 2.0 * length * upper / (ratio * radius**2 * conductivity)
    return 2.0 * np.pi * upper * (head - depth) / (ratio * (1.0 + leak + upper / lower))


def piston_cycle(u):
    ends = (30, 60), (0.005, 0.02), (0.002, 0.01), (1e3, 5e3), (9e4, 1.1e5), (290, 296), (340, 360)
    mass, area, volume, spring, pressure, ambient, filling = scaled(u, *ends)
    force = pressure * area + 19.62 * mass - spring * volume / area
    at = area / (2.0 * spring) * (np.sqrt(force**2 + 4.0 * spring * pressure * volume * ambient / filling) - force)
    return 2.0 * np.pi * np.sqrt(mass / (spring + area**2 * pressure * volume * ambient / (filling * at**2)))


def additive(u):
    return u @ [4.0, 2.0, 1.0, 0.0]


def step(u):
    return np.where(u[:, 0] > 0.3, 1.0, u[:, 1] * u[:, 2])


FUNCTIONS = {
    ishigami: 3, g_function: 6, bratley: 4, friedman: 5, borehole: 8, piston_cycle: 7, additive: 4, step: 3
}  # fmt: skip


@pytest.mark.parametrize("refused", [0.0, 0.3, 0.6])
@pytest.mark.parametrize("function", FUNCTIONS, ids=lambda each: each.__name__)
def test_campaign_intervals_have_the_true_total_effects(function, refused):
    """The 95 % interval of a total effect has the true one in 95 % of the samples, or is closer to it than 0.03."""
    count = FUNCTIONS[function]
    limit = 2.0 - np.sqrt(2.0 * refused) if refused < 0.5 else np.sqrt(2.0 * (1.0 - refused))

    def outcome(u):
        return np.where(u[:, 0] + u[:, 1] <= limit, function(u), np.nan)

    one, other = np.random.default_rng(1).random((2, TRUTH, count))
    y = outcome(one)
    mixed = (outcome(np.where(np.arange(count) == place, other, one)) for place in range(count))
    true = [np.nanmean((y - changed) ** 2) / 2.0 / np.nanvar(y) for changed in mixed]
    covered = []
    for seed in range(200 if os.environ.get("LATHE_CAMPAIGN") == "whole" else 20):
        points = np.concatenate(list(space._sample("saltelli", (count + 2) * POINTS, count, seed)))
        axes = [Axis(f"x{place}", f"x{place}", column) for place, column in enumerate(points.T)]
        for group, expected in zip(groups(axes, np.zeros(len(points))), true, strict=True):
            found, error = total_effect(group, outcome(points), lot=count + 2)
            covered.append(abs(found - expected) <= max(error, 0.03))
    print(function.__name__, refused, np.mean(covered))
    assert np.mean(covered) >= 0.95
