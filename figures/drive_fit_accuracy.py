# SPDX-License-Identifier: Apache-2.0
"""Prints the table of drives.md: errors of drives fitted to simulated measurements, and how many regions cover them."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import scipy

from lathe_commission import modal_fit
from lathe_commission.modal_fit import ResponseData
from lathe_machine.analysis.modal_drive import ModalDrive
from lathe_machine.transfer import LinearSystem, TransferFunction
from lathe_rc.analysis.frequency_response import FrequencyResponse, deviation_of, estimate

Array = npt.NDArray[np.float64]

TURN = 2.0 * np.pi
RATE = 20_000.0  # [Hz]
STEP = 1.0 / RATE
HEAD = ("measurement", "drives", "in the region", "frequency", "damping", "delay")


def drawn(random: np.random.Generator) -> ModalDrive:
    """Drive near 165 Hz with modes near 900 and 1600 Hz."""
    return ModalDrive(
        TURN * 165.0 * random.uniform(0.85, 1.15),
        random.uniform(0.5, 1.0),
        random.uniform(0.2e-3, 0.6e-3),
        tuple(TURN * np.array([900.0, 1600.0]) * random.uniform(0.93, 1.07, 2)),
        tuple(random.uniform(0.014, 0.026, 2)),
        tuple(random.choice([-1.0, 1.0], 2) * random.uniform(0.005, 0.03, 2)),
    )


def measured(drive: ModalDrive, frequency: Array, random: np.random.Generator, averages: int = 32) -> FrequencyResponse:
    """H1 estimate at frequencies [rad/s] of white noise at 60 dB whose coherence falls to 0.85 at the modes."""
    response, shape = drive.response(frequency), (averages, frequency.size)
    coherence = np.full(frequency.size, 1.0 / (1.0 + 1e-6))
    for mode, damping, *_ in drive.modes:
        coherence *= 1.0 - 0.15 / (1.0 + ((frequency - mode) / (2.0 * damping * mode)) ** 2)
    u, noise = (random.normal(size=shape) + 1j * random.normal(size=shape) for _ in range(2))
    y = response * u + np.abs(response) * np.sqrt((1.0 - coherence) / coherence) * noise
    power, cross = np.sum(np.abs(u) ** 2, axis=0), np.sum(u.conj() * y, axis=0)
    coherence = np.abs(cross) ** 2 / (power * np.sum(np.abs(y) ** 2, axis=0))
    return FrequencyResponse(frequency, cross / power, deviation_of(coherence, averages), coherence, averages)


def simulated(drive: ModalDrive, command: Array, hold: str = "foh") -> Array:
    """Exact position [m] of a drive whose delay is a whole number of samples, from its command [m]."""
    position = np.zeros(command.size)
    for frequency, damping, share, velocity in drive.sections:
        part = np.empty(command.size)
        bottom = (1.0, 2.0 * damping * frequency, frequency**2)
        top = (velocity * frequency, share * frequency**2)
        LinearSystem(TransferFunction(top, bottom), STEP, hold).block(command, part)
        position += drive.gain * part
    late = round(drive.delay / STEP)
    return np.concatenate((np.zeros(late), position[: position.size - late]))


def noisy(position: Array, random: np.random.Generator, ratio: float = 1e-3) -> Array:
    """Position with white noise, by default at 60 dB."""
    return position + ratio * np.std(position) * random.normal(size=position.size)


def of_response(true: ModalDrive, random: np.random.Generator) -> FrequencyResponse:
    """Measure 2000 points of a frequency response."""
    return measured(true, TURN * np.linspace(5.0, 2500.0, 2000), random)


def of_noise(true: ModalDrive, random: np.random.Generator) -> FrequencyResponse:
    """Estimate the response from 20 s of noise."""
    command = random.normal(size=400_000)
    return estimate(command, noisy(simulated(true, command), random), STEP)


def of_sweep(true: ModalDrive, random: np.random.Generator) -> FrequencyResponse:
    """Estimate the response from a sweep of 20 s."""
    command = scipy.signal.chirp(np.arange(400_000) * STEP, 5.0, 20.0, 3000.0, phi=-90)
    return estimate(command, noisy(simulated(true, command), random), STEP)


KINDS = {
    "frequency response, 2000 points, 32 averages": (of_response, 50),
    "record of noise, 20 s at 20 kHz": (of_noise, 30),
    "record of a sweep, 20 s at 20 kHz": (of_sweep, 8),
}


def errors(found: ModalDrive, true: ModalDrive) -> tuple[float, float, float]:
    """Largest relative errors of frequencies and dampings, and that of the delay [s]; infinite for other modes."""
    if len(found.modes) != len(true.modes):
        return np.inf, np.inf, np.inf
    pairs = [
        (np.array([own, *modes]), np.array([own_true, *modes_true]))
        for own, modes, own_true, modes_true in (
            (found.natural_frequency, found.mode_frequency, true.natural_frequency, true.mode_frequency),
            (found.damping, found.mode_damping, true.damping, true.mode_damping),
        )
    ]
    frequency, damping = (float(np.max(np.abs(one / other - 1.0))) for one, other in pairs)
    return frequency, damping, abs(found.delay - true.delay)


def row(kind: str, measure: Callable[[ModalDrive, np.random.Generator], FrequencyResponse], count: int) -> str:
    """One line of the table: ``count`` drives, each measured and fitted."""
    random, inside, largest = np.random.default_rng(1), 0, np.zeros(3)
    for _ in range(count):
        true = drawn(random)
        true = replace(true, delay=round(true.delay / STEP) * STEP)  # as `simulated` requires
        fit = modal_fit.fit(ResponseData(measure(true, random)))
        found = errors(fit.drive, true)
        inside += np.isfinite(found[0]) and fit.distance(true) < fit.limit
        largest = np.maximum(largest, found)
    frequency, damping, delay = largest
    return f"| {kind} | {count} | {inside} | {100 * frequency:.2g} % | {100 * damping:.2g} % | {1e6 * delay:.2g} µs |"


if __name__ == "__main__":
    print(f"| {' | '.join(HEAD)} |\n| --- |{' ---: |' * 5}")
    for name, (measurement, drives) in KINDS.items():
        print(row(name, measurement, drives), flush=True)
