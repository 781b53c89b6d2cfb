# SPDX-License-Identifier: Apache-2.0
"""Draws img/compensation.png and prints the tables of learning.md: what direct piezo compensation can do."""

from functools import partial

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from lathe_machine.plants.hysteresis import PrandtlIshlinskii
from lathe_papers import marks
from lathe_papers.formulas.responses import Response, in_series
from lathe_papers.formulas.structures import limit_frequency, uncompensated
from lathe_papers.formulas.tuning import FREQUENCIES, START
from lathe_papers.formulas.vibration import describing_function, reduction, widest_band
from place import PICTURES

HERTZ = 2 * np.pi
HIGHEST = 4e4  # [rad/s]
RATE, SAMPLES = 64_000, 2**18  # of the random vibration
BANDS = (10.0, 100.0, 500.0, 1000.0, 1500.0)  # [Hz]
# Ten plays as in spec/learning.md, weighted so that the loop over the whole stroke is 15 % of its height wide.
THRESHOLDS, WEIGHTS, PROPORTIONAL = np.arange(1, 11) / 11, np.full(10, 0.055), 0.725

coarse, piezo = START.coarse, START.fine
mounted = partial(
    in_series,
    natural_frequency=piezo.natural_frequency,
    damping=piezo.damping,
    mass_ratio=0.1,
    carriage_natural_frequency=coarse.natural_frequency,
    carriage_damping=coarse.damping,
)


def hysteretic(amplitude: float) -> Response:
    """N·Wpk for a sine of ``amplitude`` half-strokes."""
    gain = describing_function(amplitude, THRESHOLDS, WEIGHTS, PROPORTIONAL)
    return lambda frequency: np.asarray(gain * piezo.drive(frequency))


def noise(band: float, rms: float) -> npt.NDArray[np.float64]:
    """Periodic Gaussian noise from 0 to ``band`` [Hz] with ``rms`` half-strokes."""
    frequency = np.fft.rfftfreq(SAMPLES, 1 / RATE)
    random = np.random.default_rng(0)
    lines = random.normal(size=(2, frequency.size)) * ((frequency > 0.0) & (frequency <= band))
    vibration = np.fft.irfft(lines[0] + 1j * lines[1])
    return np.asarray(vibration * rms / vibration.std())


def random_reduction(band: float, rms: float) -> float:
    """RMS of a random vibration over what the hysteretic piezo leaves of it."""
    vibration = noise(band, rms)
    displacement, hysteresis = np.empty(SAMPLES), PrandtlIshlinskii(THRESHOLDS, WEIGHTS, PROPORTIONAL)
    for _ in range(2):  # the second period begins where the first one ended
        hysteresis.block(vibration, displacement)
    response = piezo.drive(HERTZ * np.fft.rfftfreq(SAMPLES, 1 / RATE))
    left = vibration - np.fft.irfft(np.fft.rfft(displacement) * response)
    return float(vibration.std() / left.std())


NEAR = r"$\lvert 1 - W\rvert"
print(f"| response $W$ | {NEAR} = 0.5$ [Hz] | {NEAR} = 1$ [Hz] | {NEAR}$ at 500 … 2000 rad/s |")
print("| --- | ---: | ---: | --- |")
responses: dict[str, Response] = {
    "coarse drive without its delay": lambda w: coarse.drive(w) * np.exp(1j * w * coarse.delay),
    "coarse drive": coarse.drive,
    "piezo alone": piezo.drive,
    "piezo on the carriage, m/M = 0.1": mounted,
    "piezo with hysteresis, full stroke": hysteretic(1.0),
}
for name, response in responses.items():
    limits = " | ".join(f"{limit_frequency(response, HIGHEST, level) / HERTZ:.1f}" for level in (0.5, 1.0))
    values = " ".join(f"{value:.4f}" for value in np.abs(uncompensated(response(FREQUENCIES))))
    print(f"| {name} | {limits} | {values} |")

print(
    f"\n| vibration from 0 Hz to | {' | '.join(f'{band:.0f} Hz' for band in BANDS)} | 3 times up to | 2 times up to |"
)
print(f"| --- |{' ---: |' * (len(BANDS) + 2)}")
compensators: dict[str, Response] = {
    "linear piezo": piezo.drive,
    "15 % hysteresis, sines of the whole stroke": hysteretic(1.0),
    "15 % hysteresis, sines of a third of it": hysteretic(1 / 3),
}
for name, response in compensators.items():
    times = " | ".join(f"{reduction(response, band * HERTZ):.2f}" for band in BANDS)
    bands = " | ".join(f"{widest_band(response, wanted, HIGHEST) / HERTZ:.0f} Hz" for wanted in (3.0, 2.0))
    print(f"| {name} | {times} | {bands} |")
times = " | ".join(f"{random_reduction(band, 0.2):.2f}" for band in BANDS)
print(f"| 15 % hysteresis, noise of 0.2 half-strokes RMS, simulated | {times} | | |")

print("\n| amplitude [half-strokes] | $N$ | $1/\\lvert 1 - N\\rvert$ |")
print("| ---: | ---: | ---: |")
for amplitude in (1 / 10, 1 / 3, 1.0):
    gain = describing_function(amplitude, THRESHOLDS, WEIGHTS, PROPORTIONAL)
    print(f"| {amplitude:.2f} | {gain.real:.3f} − {-gain.imag:.3f}j | {1 / abs(1 - gain):.2f} |")

figure = Figure(figsize=(11, 3.6), layout="constrained")
by_frequency, by_band = figure.subplots(1, 2)
frequency = np.geomspace(10.0, 4000.0, 800)
for k, (name, response) in enumerate(compensators.items()):
    by_frequency.loglog(frequency, np.abs(uncompensated(response(frequency * HERTZ))), label=name, **marks.curve(k))
    by_band.loglog(frequency, [reduction(response, band * HERTZ) for band in frequency], label=name, **marks.curve(k))
by_frequency.loglog(frequency, np.abs(uncompensated(mounted(frequency * HERTZ))), color="#999999", label="m/M = 0.1")
by_frequency.axhline(1.0, color="black", lw=0.6)
by_frequency.set(xlabel="frequency [Hz]", ylabel="|1 − Wpk|", ylim=(1e-3, 5))
by_frequency.set_title("what is left of a sine", fontsize=10)
by_band.axhspan(2.0, 3.0, color="#cccccc", label="2 to 3 times")
by_band.set(xlabel="upper end of the band [Hz]", ylabel="RMS before / RMS after", ylim=(0.5, 100))
by_band.set_title("reduction of a vibration from 0 Hz up", fontsize=10)
for axes in (by_frequency, by_band):
    axes.grid(visible=True, which="both", alpha=0.25)
    axes.legend(fontsize=8)
figure.savefig(PICTURES / "compensation.png", dpi=130)
