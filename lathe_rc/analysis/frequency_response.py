# SPDX-License-Identifier: Apache-2.0
"""Measured frequency responses: read from a file, or estimated from a record of command and response.

The estimate is H1 by Welch's method, the cross spectrum over the spectrum of the command, with the coherence

    γ² = |Suy|²/(Suu·Syy)

and the variance of real and imaginary part each (Bendat and Piersol, Random Data, 4th ed., ch. 9.2)

    (1 - γ²)/(2·n·γ²)·|H1|²,

n the number of independent averages. A periodic command is averaged over its periods without a window, which has no
leakage. Another one takes Hann windows with an overlap of 3/4. A bin then shows the response averaged over the
frequencies near it, weighted by the power of the command times that of the window. The mean frequency and the spread of
these weights follow from a second transform, with the derivative of the window (Auger and Flandrin 1995); so a line of
the command counts at its own frequency, and `FrequencyResponse.smoothed` averages a model to second order alike. It
also adds the images of the model's response above the sampling frequency. Every second bin is used: neighbours are
correlated.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt
import scipy

from lathe_rc.arrays import Array, Complex
from lathe_rc.errors import InputError, at_most
from lathe_rc.signals.measurement_file import MeasuredQuantities
from lathe_rc.signals.table import write_table

Hold = Literal["linear", "zero", "none"]

LEAST = 16  #: points of a response
AVERAGES = 16.0  #: assumed for a coherence whose number of averages is not given

_LEAST_SAMPLES = 512
_HIGHEST, _MOST_FREQUENCY = 0.2, 0.4  # of the sampling frequency, without a wish and at most
_CLOCK_ERROR = 1e-6  # of the sampling frequency, as times in a file are rounded
_APPROXIMATE = 1e-4  # relative error of the estimate itself: smoothing to second order
_RESOLUTION = 0.5  # [Hz], the finest without a wish
_SEGMENTS = 8  # of the record, at least, without a wish
_LONGEST = 2**22  # samples of a segment
_LEAST_COHERENCE = 0.5
_TREND = 31  # bins over which the coherence is judged
_EDGE = 0.1  # part of a sweep's power in the first or last segment
_REST = 0.05  # of the RMS of the response, within which the drive is at rest
_FAR = 1.5  # bins of spread; 0.58 in noise
_NEXT = 1.0  # bins, to the next one that is used
_SWEEPING = 0.25  # part of the segments that command a frequency, below which the command sweeps; 1/2 in noise
_LEAST_POWER = 1e-10  # of the command in a bin, over the largest
_SURE = 1e-12  # of the coherence below 1
_LEAST_DEVIATION = 1e-6  # relative, below which a measurement is never
_PERIODIC = 0.01  # RMS difference between two periods of the command, over its RMS
_SEARCHED = 2**21  # samples in which a period is searched
_PERIODS = 4  # at least, after the first, in which the drive settles
_STILL = 1e-12


@dataclass(frozen=True)
class FrequencyResponse:
    """Measured frequency response.

    Args:
        frequency: frequencies, increasing, above 0 [rad/s], shape (n,), n at least `LEAST`.
        value: response, shape (n,).
        deviation: standard deviation of real and imaginary part each, relative to the magnitude, shape (n,); None if
            unknown.
        coherence: coherence γ² between command and response, shape (n,); None if unknown.
        averages: number of independent averages; 0 if unknown.
        spread: standard deviation of the frequencies over which each value is an average [rad/s], shape (n,); None: 0.
        sampling: sampling frequency whose images of the response the values contain [rad/s]; 0: none.
        holding: power with which the hold of the command lowers the images: 1 held, 2 linear.
        left_out: which points of the measurement are left out and why, in words.

    Raises:
        InputError: the arrays are not such a response.
    """

    frequency: Array
    value: Complex
    deviation: Array | None = None
    coherence: Array | None = None
    averages: float = 0.0
    spread: Array | None = None
    sampling: float = 0.0
    holding: int = 0
    left_out: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        frequency, count = self.frequency, self.frequency.size
        if count < LEAST:
            raise InputError(f"frequency response: {count} points; allowed: {LEAST} or more")
        falling = np.flatnonzero(np.diff(frequency, prepend=0.0) <= 0.0)
        if falling.size:
            at = int(falling[0])
            raise InputError(
                f"frequency response: {frequency[at] / (2.0 * np.pi):.6g} Hz at point {at + 1}; allowed: above 0 and "
                "increasing"
            )
        if not np.all(np.abs(self.value) > 0.0):
            at = int(np.argmin(np.abs(self.value)))
            raise InputError(
                f"frequency response: 0 at {frequency[at] / (2.0 * np.pi):.6g} Hz; allowed: a magnitude above 0 (leave "
                "the point out)"
            )

    def smoothed(self, response: Callable[[Array], Complex]) -> Complex:
        """Return a model's response as this measurement would show it, from one of frequencies [rad/s].

        Args:
            response: function of frequencies of shape (n,), with a result of shape (n,) or (n, k).
        """
        shown = response(self.frequency)
        if self.spread is not None:
            # Three points with the weights 1/6, 2/3, 1/6 have this spread.
            offset = np.sqrt(3.0) * self.spread
            shown = (response(self.frequency - offset) + 4.0 * shown + response(self.frequency + offset)) / 6.0
        if self.sampling:
            for image in (self.frequency - self.sampling, self.frequency + self.sampling):
                part = (self.frequency / image) ** self.holding
                shown = shown + (response(image).T * part).T
        return shown

    def at(self, kept: npt.NDArray[np.bool_] | npt.NDArray[np.intp]) -> "FrequencyResponse":
        """Return some of the points.

        Raises:
            InputError: too few points are left.
        """
        return FrequencyResponse(
            self.frequency[kept],
            self.value[kept],
            None if self.deviation is None else self.deviation[kept],
            None if self.coherence is None else self.coherence[kept],
            self.averages,
            None if self.spread is None else self.spread[kept],
            self.sampling,
            self.holding,
            self.left_out,
        )

    def within(self, low: float, high: float) -> "FrequencyResponse":
        """Return the points from ``low`` to ``high`` [rad/s].

        Raises:
            InputError: too few points are left.
        """
        return self.at((self.frequency >= low) & (self.frequency <= high))


def deviation_of(coherence: Array, averages: float) -> Array:
    """Return the relative standard deviation of real and imaginary part of H1 for a coherence, shape (n,)."""
    rest = np.maximum(1.0 - coherence, _SURE)
    return np.maximum(np.sqrt(rest / (2.0 * averages * coherence)), _LEAST_DEVIATION)


def _period(command: Array) -> int:
    """Return the period of a command in samples; 0 if it has none, or too few of them."""
    part = command[:_SEARCHED] - command[:_SEARCHED].mean()
    size = scipy.fft.next_fast_len(2 * part.size, real=True)
    spectrum = scipy.fft.rfft(part, size)
    # Products of the two parts that overlap at a lag, over their RMS: 1 at a period.
    product = scipy.fft.irfft(np.abs(spectrum) ** 2, size)[: part.size]
    energy = np.append(0.0, np.cumsum(part**2))
    lags = np.arange(1, part.size * 2 // 3)
    likeness = product[lags] / np.sqrt(np.maximum(energy[part.size - lags] * (energy[-1] - energy[lags]), _STILL**2))
    below = np.flatnonzero(likeness < 0.9)
    if not below.size:
        return 0
    near = np.flatnonzero(likeness[below[0] :] > 1.0 - _PERIODIC) + below[0]
    if not near.size:
        return 0
    # The first maximum: smooth commands are alike at some lags around it, too.
    begin = int(near[0])
    end = begin + int(np.argmax(np.append(likeness[begin:] < 1.0 - _PERIODIC, True)))
    period = int(lags[begin + int(np.argmax(likeness[begin:end]))])
    difference = command[period:] - command[:-period]
    alike = np.sqrt(np.mean(difference**2)) <= _PERIODIC * np.std(command)
    return period if alike and command.size >= (_PERIODS + 1) * period else 0


@dataclass
class _Spectra:
    """Sums over the segments of Welch's method, shape (m,) each.

    They are those of `scipy.signal.csd` up to a factor, in memory that does not grow with the record.

    Attributes:
        power_u, cross, power_y: Suu, Suy and Syy.
        square_u: sum of the squares of the segments' Suu.
        edges_u: Suu of the first and the last segment, shape (2, m).
        offset: sum of (ν - f)·|U(ν)|² over the frequencies ν in the bin f, in bins times power.
        offset_square: sum of (ν - f)²·|U(ν)|², in bins² times power.
        segments: number of segments.
    """

    power_u: Array
    cross: Complex
    power_y: Array
    square_u: Array
    edges_u: Array
    offset: Array
    offset_square: Array
    segments: int

    @classmethod
    def of(cls, signals: tuple[Array, Array], window: Array, hop: int, first: int) -> "_Spectra":
        """Return the sums for a command and a response, in windows ``hop`` samples apart from sample ``first`` on."""
        size, bins = window.size, window.size // 2 + 1
        begins = range(first, signals[0].size - size + 1, hop)
        zeros = np.zeros((5, bins))
        edges = np.zeros((2, bins))
        sums = cls(zeros[0], np.zeros(bins, np.complex128), zeros[1], zeros[2], edges, zeros[3], zeros[4], len(begins))
        # The derivative of a window over time multiplies its transform by 2πj·(f - ν).
        slope = scipy.fft.irfft(2j * np.pi * np.arange(bins) * scipy.fft.rfft(window), size) if hop < size else None
        for begin in begins:
            u, y = (scipy.fft.rfft(window * signal[begin : begin + size]) for signal in signals)
            if slope is not None:
                turned = scipy.fft.rfft(slope * signals[0][begin : begin + size]) / (2j * np.pi)
                sums.offset -= u.real * turned.real + u.imag * turned.imag
                sums.offset_square += turned.real**2 + turned.imag**2
            power = u.real**2 + u.imag**2
            sums.power_u += power
            sums.square_u += power**2
            if begin == first:
                edges[0] = power
            edges[1] = power
            sums.power_y += y.real**2 + y.imag**2
            sums.cross += u.conj() * y
        return sums

    def sweeps(self, bins: npt.NDArray[np.intp]) -> bool:
        """Return whether a frequency is commanded in few of the segments only, as by a chirp."""
        share = self.power_u[bins] ** 2 / (self.segments * np.maximum(self.square_u[bins], np.finfo(float).tiny))
        return bool(np.median(share) < _SWEEPING)


def _independent(window: Array, hop: int, segments: int) -> float:
    """Return the number of independent averages of overlapping segments (Welch 1967)."""
    lags = np.arange(1, -(-window.size // hop))
    likeness = np.array([window[lag * hop :] @ window[: -lag * hop] for lag in lags]) / (window @ window)
    return segments / float(1.0 + 2.0 * np.sum(likeness**2 * np.maximum(1.0 - lags / segments, 0.0)))


def estimate(
    command: Array,
    response: Array,
    step: float,
    *,
    hold: Hold = "linear",
    resolution: float | None = None,
    highest: float | None = None,
) -> FrequencyResponse:
    """Estimate the frequency response of a drive from its command and response.

    Args:
        command: command, shape (n,).
        response: response, shape (n,).
        step: sampling step [s].
        hold: course of the command between its samples: ``linear``, as in the cell; ``zero``: constant until the next,
            as a converter holds it; ``none``: both are samples of analogue signals.
        resolution: distance of the bins [Hz]; None: at least 8 segments, and at least 0.5 Hz. A periodic command has
            the distance of its lines.
        highest: highest frequency [rad/s], up to 0.4 of the sampling frequency; None: 0.2 of it.

    Raises:
        InputError: the record is too short, the command is constant, the response does not follow it, or an option is
            out of range.
    """
    if command.size < _LEAST_SAMPLES:
        raise InputError(f"record: {command.size} samples; allowed: {_LEAST_SAMPLES} or more")
    signals = (command - command.mean(), response - response.mean())
    for name, signal in zip(("command", "response"), signals, strict=True):
        if np.sqrt(np.mean(signal**2)) < _STILL:
            raise InputError(f"record: the {name} does not move; nothing to identify")
    period = _period(command) if resolution is None else 0
    if period:
        window, hop, first = np.ones(period), period, period
    else:
        size = _segment(command.size, step, resolution)
        window, hop, first = scipy.signal.get_window("hann", size), size // 4, 0
    frequency = np.arange(window.size // 2 + 1) / (window.size * step)
    bins = np.arange(1, frequency.size) if period else np.arange(2, frequency.size, 2)
    most = _HIGHEST / step if highest is None else highest / (2.0 * np.pi)
    if most > _MOST_FREQUENCY / step * (1.0 + _CLOCK_ERROR):
        raise InputError(
            f"--band up to {most:.6g} Hz of a record at {1.0 / step:.6g} Hz; allowed: up to "
            f"{at_most(_MOST_FREQUENCY / step)} Hz ({_MOST_FREQUENCY:g} of the sampling frequency)"
        )
    bins = bins[frequency[bins] <= most]
    if not bins.size:
        raise _too_few(0)
    sums = _Spectra.of(signals, window, hop, first)
    if not period and sums.sweeps(bins):
        sums, bins = _swept(signals, window, hop, bins)
        if not bins.size:
            raise _too_few(0)
    averages = _independent(window, hop, sums.segments) if hop < window.size else float(sums.segments)
    power_u, cross, power_y = sums.power_u, sums.cross, sums.power_y
    bins = bins[power_u[bins] > _LEAST_POWER * power_u[bins].max()]
    coherence = np.minimum(
        np.abs(cross[bins]) ** 2 / np.maximum(power_u[bins] * power_y[bins], np.finfo(float).tiny), 1
    )
    # The band ends where most bins are incoherent: single ones chosen by their coherence would be too large by chance.
    trend = scipy.ndimage.median_filter(coherence, min(_TREND, coherence.size))
    sure = (trend >= _LEAST_COHERENCE) & (coherence >= min(3.0 / averages, _LEAST_COHERENCE))
    width = 2.0 * np.pi / (window.size * step)
    offset = sums.offset[bins] / power_u[bins]
    spread = np.sqrt(np.maximum(sums.offset_square[bins] / power_u[bins] - offset**2, 0.0))
    own = (np.abs(offset) < _NEXT) & (spread < _FAR)  # otherwise it shows other bins
    left_out = _left_out("bins", frequency[bins], ~sure, "incoherent with the command there")
    left_out += _left_out("bins", frequency[bins], sure & ~own, "the command moves at neighbouring frequencies instead")
    sure &= own
    bins, coherence, offset, spread = bins[sure], coherence[sure], offset[sure], spread[sure] * width
    if bins.size < LEAST:
        raise _too_few(bins.size)
    true = (bins + offset) * width
    cycles = true * step / (2.0 * np.pi)
    return FrequencyResponse(
        true,
        cross[bins] / power_u[bins] / _held(cycles, hold),
        np.hypot(deviation_of(coherence, averages), _APPROXIMATE),
        coherence,
        averages,
        None if period else spread,
        0.0 if hold == "none" else 2.0 * np.pi / step,
        2 if hold == "linear" else 1,
        left_out,
    )


def _left_out(kind: str, frequency: Array, where: npt.NDArray[np.bool_], reason: str) -> tuple[str, ...]:
    """Return how many of the frequencies [Hz] are left out, from which to which, and why; empty if none is."""
    if not where.any():
        return ()
    low, high = frequency[where].min(), frequency[where].max()
    between = f"at {low:.4g} Hz" if low == high else f"between {low:.4g} and {high:.4g} Hz"
    return (f"{np.count_nonzero(where)} of {where.size} {kind} left out, {between}: {reason}",)


def _too_few(frequencies: int) -> InputError:
    """Return the error for a record that shows the response at too few frequencies."""
    return InputError(
        f"record: the response follows the command at {frequencies} frequencies (coherence from {_LEAST_COHERENCE:g}); "
        f"allowed: {LEAST} or more (a longer record, a wider --band, or a command that moves at more frequencies)"
    )


def _swept(
    signals: tuple[Array, Array], window: Array, hop: int, bins: npt.NDArray[np.intp]
) -> tuple[_Spectra, npt.NDArray[np.intp]]:
    """Return the sums of a sweep, and the bins that its ends do not falsify.

    The windows overlap less at the ends of the record. A segment of rest before a sweep that begins at rest makes all
    its parts count alike; frequencies of its end, and of a beginning out of motion, are left out.
    """
    u, y = signals
    at_rest = abs(y[0]) < _REST * np.std(y)
    rest = window.size if at_rest else 0
    sums = _Spectra.of((np.pad(u, (rest, 0)), np.pad(y, (rest, 0))), window, hop, 0)
    share = sums.edges_u[:, bins] / np.maximum(sums.power_u[bins], np.finfo(float).tiny)
    return sums, bins[share[int(at_rest) :].max(axis=0) < _EDGE]


def _segment(samples: int, step: float, resolution: float | None) -> int:
    """Return the length of a Hann window: that of the resolution, or without one a power of 2."""
    if resolution is None:
        most = min(samples // _SEGMENTS, int(1.0 / (_RESOLUTION * step)), _LONGEST)
        return 1 << int(np.log2(max(most, 64)))
    size = int(np.ceil(1.0 / (resolution * step)))
    if not 64 <= size <= min(samples // 2, _LONGEST):
        finest = 1.0 / (min(samples // 2, _LONGEST) * step)
        raise InputError(
            f"--resolution {resolution:g} Hz of {samples} samples; allowed: from {finest:.4g} to "
            f"{1.0 / (64 * step):.4g} Hz"
        )
    return size


def _held(cycles: Array, hold: Hold) -> Complex:
    """Return the response of the hold at frequencies in parts of the sampling frequency."""
    if hold == "none":
        return np.ones(cycles.size, np.complex128)
    if hold == "zero":
        return np.asarray(np.sinc(cycles) * np.exp(-1j * np.pi * cycles), np.complex128)
    return np.asarray(np.sinc(cycles) ** 2, np.complex128)


def of_states(measurement: MeasuredQuantities) -> list[FrequencyResponse]:
    """Return the frequency responses in a file, one for each number in its column ``state``, if it has one.

    Raises:
        InputError: see `of_measurement`.
    """
    if "state" not in measurement:
        return [of_measurement(measurement)]
    _, states = measurement.read("frequency", "state")
    return [of_measurement(measurement, rows=states == state) for state in np.unique(states)]


def of_measurement(
    measurement: MeasuredQuantities, averages: float | None = None, rows: npt.NDArray[np.bool_] | None = None
) -> FrequencyResponse:
    """Return the frequency response in a file.

    The file has ``frequency`` with ``magnitude`` and ``phase``, ``real`` and ``imaginary``, or a complex ``response``;
    besides, if known, ``relative_uncertainty`` (one standard deviation) or ``coherence``.

    Args:
        measurement: columns of the file.
        averages: number of averages of the coherence; None: `AVERAGES`.
        rows: whether each row is used, shape (n,); None: all are.

    Raises:
        InputError: a column is missing or out of range, or ``averages`` has no use.
    """
    frequency, value = _values(measurement)
    coherence = _between(measurement, "coherence", 1.0)
    given = _between(measurement, "relative_uncertainty", np.inf)
    order = np.argsort(frequency, kind="stable")
    order = order if rows is None else order[rows[order]]
    kept = order[frequency[order] > 0.0]  # the point at 0 Hz of an analyser has no phase
    if averages is not None and (coherence is None or given is not None):
        known = "no coherence" if coherence is None else "a relative_uncertainty"
        raise InputError(f"{measurement.name}: --averages of a response with {known}; allowed: with a coherence alone")
    count = AVERAGES if averages is None else averages
    left_out = _left_out("points", frequency, frequency <= 0.0, "no response at 0 Hz")
    if coherence is not None:
        low = coherence[kept] < _LEAST_COHERENCE
        left_out += _left_out("points", frequency[kept] / (2.0 * np.pi), low, f"coherence below {_LEAST_COHERENCE:g}")
        kept = kept[~low]
    if given is not None:
        deviation = np.maximum(given, _LEAST_DEVIATION)
    elif coherence is not None:
        deviation = deviation_of(np.maximum(coherence, _LEAST_COHERENCE), count)
    else:
        deviation = None
    try:
        return FrequencyResponse(
            frequency[kept],
            value[kept],
            None if deviation is None else deviation[kept],
            None if coherence is None else coherence[kept],
            0.0 if coherence is None or given is not None else count,
            left_out=left_out,
        )
    except InputError as error:
        raise InputError(f"{measurement.name}: {error}") from None


def _values(measurement: MeasuredQuantities) -> tuple[Array, Complex]:
    """Return the frequencies and the complex response in a file, shape (n,) each."""
    if "real" in measurement and "imaginary" in measurement:
        frequency, real, imaginary = measurement.read("frequency", "real", "imaginary")
        return frequency, np.asarray(real + 1j * imaginary)
    if "magnitude" in measurement and "phase" in measurement:
        frequency, magnitude, phase = measurement.read("frequency", "magnitude", "phase")
        return frequency, np.asarray(magnitude * np.exp(1j * phase))
    if "response" in measurement:
        frequency, value = measurement.read("frequency", "response")
        if value.dtype.kind == "c":
            return frequency, value
    raise measurement.lacking("frequency with magnitude and phase, with real and imaginary, or a complex response")


def _between(measurement: MeasuredQuantities, quantity: str, most: float) -> Array | None:
    """Return a quantity between 0 and ``most``, one value a frequency; None if the measurement lacks it."""
    if quantity not in measurement:
        return None
    _, values = measurement.read("frequency", quantity)
    outside = np.flatnonzero((values < 0.0) | (values > most))
    if outside.size:
        at = int(outside[0])
        allowed = "from 0" if np.isinf(most) else f"from 0 to {most:g}"
        raise InputError(f"{measurement.name}: {quantity} {values[at]:g} in row {at + 1}; allowed: {allowed}")
    return values


def write_points(path: Path, response: FrequencyResponse, deviation: Array, comment: str) -> None:
    """Write the points of a response as a CSV file that `of_measurement` reads.

    Args:
        path: CSV file.
        response: measured response.
        deviation: its relative uncertainty, one standard deviation of real and imaginary part each, shape (n,).
        comment: first line of the file.

    Raises:
        InputError: the file cannot be written.
    """
    columns = {
        "frequency_hz": response.frequency / (2.0 * np.pi),
        "real": response.value.real,
        "imaginary": response.value.imag,
        "relative_uncertainty": deviation,
    }
    if response.coherence is not None:
        columns["coherence"] = response.coherence
    write_table(path, ",".join(columns), np.stack(list(columns.values()), axis=1), comment, digits=12)


def write_states(path: Path, responses: Sequence[FrequencyResponse], comment: str) -> None:
    """Write the points of a drive in several states as one CSV file that `of_states` reads.

    Raises:
        InputError: the file cannot be written.
    """
    rows = [
        np.stack(
            (np.full(each.frequency.size, state), each.frequency / (2.0 * np.pi), each.value.real, each.value.imag)
        )
        for state, each in enumerate(responses, 1)
    ]
    write_table(path, "state,frequency_hz,real,imaginary", np.concatenate(rows, axis=1).T, comment, digits=12)
