# SPDX-License-Identifier: Apache-2.0
"""Campaign of fits: random drives, measured with noise, lie in the sets of the fits that are accepted."""

import os
import re
from concurrent.futures import ProcessPoolExecutor
from typing import NamedTuple

import numpy as np
import pytest

from drive_fit_accuracy import TURN
from lathe_commission import modal_fit
from lathe_commission.modal_fit import ResponseData
from lathe_machine.analysis.modal_drive import ModalDrive
from lathe_rc.analysis.frequency_response import FrequencyResponse, deviation_of
from lathe_rc.errors import LatheError

KINDS = ("second order", "modes", "real pole", "complex residues")
DRIVES = 200 if os.environ.get("LATHE_CAMPAIGN") == "whole" else 8


class Outcome(NamedTuple):
    """Result of a fit: why it is refused, or the largest distance of the true response over that of the region."""

    seed: int
    refused: str
    distance: float


def drawn(random: np.random.Generator, kind: str) -> ModalDrive:
    """Drive of a kind with a gain from 0.5 to 2 of either sign."""
    w, z = TURN * random.uniform(90.0, 260.0), random.uniform(0.3, 1.1)
    gain = float(random.choice([-1.0, 1.0]) * np.exp(random.uniform(np.log(0.5), np.log(2.0))))
    modes: list[tuple[float, ...]] = []
    if kind != "second order":
        for frequency in np.sort(random.uniform(400.0, 2200.0, random.integers(kind == "modes", 4))):
            if not modes or TURN * frequency > 1.15 * modes[-1][0]:
                share = float(random.choice([-1.0, 1.0]) * np.exp(random.uniform(np.log(0.003), np.log(0.04))))
                turn = random.uniform(-1.2, 1.2) if kind == "complex residues" else 0.0
                damping = float(np.exp(random.uniform(np.log(0.005), np.log(0.05))))
                modes.append((TURN * float(frequency), damping, share * np.cos(turn), share * np.sin(turn)))
    lags: list[tuple[float, float]] = []
    if kind == "real pole":  # a series connection of drive and lag, or their sum
        pole = TURN * float(np.exp(random.uniform(np.log(150.0), np.log(900.0))))
        series = 1.0 / (1.0 - 2.0 * z * pole / w + (pole / w) ** 2)
        lags = [(1.0 / pole, series if random.random() < 0.5 else float(random.uniform(-0.3, 0.3)))]
    columns = list(zip(*modes, strict=True)) or [()] * 4
    velocity = columns[3] if kind == "complex residues" else ()
    times, shares = zip(*lags, strict=True) if lags else ((), ())
    return ModalDrive(w, z, random.uniform(0.0, 0.6e-3), *columns[:3], gain, velocity, times, shares)


def measured(drive: ModalDrive, random: np.random.Generator) -> FrequencyResponse:
    """H1 estimate at 40 to 2000 frequencies; the coherence falls with the magnitude."""
    count = int(np.exp(random.uniform(np.log(40.0), np.log(2000.0))))
    low, high = random.uniform(3.0, 15.0), random.uniform(1500.0, 2800.0)
    space = np.geomspace if random.random() < 0.5 else np.linspace
    frequency, averages = TURN * space(low, high, count), int(random.integers(16, 129))
    response = drive.response(frequency)
    relative, floor = 10.0 ** random.uniform(-4.0, -2.0), 10.0 ** random.uniform(-5.0, -3.0)
    noise = np.hypot(relative * np.abs(response), floor * abs(drive.gain))
    shape = (averages, count)
    u, other = (random.normal(size=shape) + 1j * random.normal(size=shape) for _ in range(2))
    y = response * u + noise * np.sqrt(averages) * other / np.sqrt(8.0)
    power, cross = np.sum(np.abs(u) ** 2, axis=0), np.sum(u.conj() * y, axis=0)
    coherence = np.abs(cross) ** 2 / (power * np.sum(np.abs(y) ** 2, axis=0))
    kept = coherence > 0.5
    return FrequencyResponse(
        frequency[kept], (cross / power)[kept], deviation_of(coherence[kept], averages), coherence[kept], averages
    )


def fitted(seed: int) -> Outcome:
    """Measure and fit a drive."""
    random = np.random.default_rng(seed)
    true = drawn(random, KINDS[seed % len(KINDS)])
    response = measured(true, random)
    try:
        fit = modal_fit.fit(ResponseData(response))
    except LatheError as error:
        return Outcome(seed, str(error), np.inf)
    low, high = response.frequency[[0, -1]]
    near = [w * (1.0 + z * np.linspace(-2.0, 2.0, 41)) for w, z, *_ in true.modes if low < w < high]
    frequency = np.sort(np.concatenate((np.geomspace(low, high, 400), *near)))
    frequency = frequency[(frequency >= low) & (frequency <= high)]
    off = np.abs(true.response(frequency) - fit.drive.response(frequency)) / fit.envelope(frequency)
    return Outcome(seed, "", float(off.max()))


@pytest.mark.system
def test_campaign_of_random_drives_lie_in_the_sets_of_their_fits():
    """95 % of the true drives within the response envelope; a refusal names the points that are missing."""
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        outcomes = list(pool.map(fitted, range(DRIVES)))
    accepted = [each for each in outcomes if not each.refused]
    for each in outcomes:
        assert not each.refused or re.search(r"measure from [\d.]+ to [\d.]+ Hz", each.refused), each
    assert np.mean([each.distance <= 1.0 for each in accepted]) >= (0.95 if DRIVES > 20 else 0.75), outcomes
    assert len(accepted) >= 0.8 * DRIVES
