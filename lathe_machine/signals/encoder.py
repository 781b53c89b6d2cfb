# SPDX-License-Identifier: Apache-2.0
"""Spindle encoder: true and measured angle, measured speed, index pulse."""

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from lathe_machine.signals.edge_time import COUNT, EdgeTable, edge_table, pass_edge, passed
from lathe_machine.signals.encoder_errors import EncoderErrors, ErrorsTable, place_of, rate, seen, seen_along
from lathe_rc.arrays import Array
from lathe_rc.jit import inlined, kernel
from lathe_rc.signals.speed import SpeedLaw, evaluate_along

Fields = tuple[npt.NDArray[Any], ...]

_TURN = 2.0 * np.pi
_PERFECT = EncoderErrors()


class EncoderTable(NamedTuple):
    """A spindle encoder with its state, for kernels (see `Encoder`).

    Attributes:
        step: sampling step [s].
        nominal, lines, tachogram: constants of the speed law.
        counts: counts per revolution; 0 for an ideal encoder.
        errors: errors of disc and signals.
        history: the last angles, shape (speed_window,); sample n is at index n modulo its length.
        revolution: revolution of the last sample, shape (1,).
        edges: time stamps of the edges, if there are any.
        before: true angle [rad] and speed [rad/s] of the last sample, shape (2,).
    """

    step: float
    nominal: float
    lines: Array
    tachogram: Array
    counts: int
    errors: ErrorsTable
    history: Array
    revolution: Array
    edges: EdgeTable
    before: Array


class EncoderSamples(NamedTuple):
    """Samples of an encoder's block, in the order of `EncoderBlock.msg`; arrays of shape (n,).

    Attributes:
        angle: measured angle, unwrapped [rad].
        speed: measured speed [rad/s].
        index_pulse: 1 in the first sample of each measured revolution, else 0.
        angle_true, speed_true: true angle [rad] and speed [rad/s].
    """

    angle: Array
    speed: Array
    index_pulse: Array  # of uint8
    angle_true: Array
    speed_true: Array


@kernel
def encode(encoder: EncoderTable, first: int, samples: Fields) -> None:
    """Fill the encoder signals of a block, starting at sample ``first`` (implements `Encoder.block`)."""
    block = EncoderSamples(*samples)
    follow_law(encoder, first, block.angle_true, block.speed_true)
    read_off(encoder, first, block)


@kernel
def follow_law(encoder: EncoderTable, first: int, angle_true: Array, speed_true: Array) -> None:
    """Fill true angle and speed of a block by the speed law, starting at sample ``first``."""
    evaluate_along(first, encoder.step, encoder.nominal, encoder.lines, encoder.tachogram, angle_true, speed_true)


@kernel
def read_off(encoder: EncoderTable, first: int, block: EncoderSamples) -> None:
    """Fill measured angle, speed and index pulse from the true angle and speed (see `Encoder.block`)."""
    angle, speed, index_pulse = block.angle, block.speed, block.index_pulse
    angle_true, speed_true = block.angle_true, block.speed_true
    step, counts, history, revolution = encoder.step, encoder.counts, encoder.history, encoder.revolution
    before = revolution[0]
    if encoder.errors.real:
        for k in range(angle.size):
            angle[k] = seen(encoder.errors, angle_true[k])
            speed[k] = speed_true[k] * rate(encoder.errors, angle_true[k])
    else:
        for k in range(angle.size):
            angle[k], speed[k] = angle_true[k], speed_true[k]
    if counts == 0:
        for k in range(angle.size):
            whole = np.floor(angle[k] / _TURN)
            index_pulse[k] = whole > before
            before = whole
    else:
        window = history.size
        place = first % window
        for k in range(angle.size):
            # Whole revolutions separately, so that they are exact for any number of counts.
            count = np.floor(angle[k] * counts / _TURN)
            whole = np.floor(count / counts)
            part = count - whole * counts
            if encoder.edges.clock > 0.0:
                part += _since_edge(encoder, (first + k) * step, count, angle_true[k], speed_true[k])
            angle[k] = whole * _TURN + part * _TURN / counts
            # The oldest angle of the ring is at the index of the new one.
            speed[k] = (angle[k] - history[place]) / (window * step)
            history[place] = angle[k]
            place = place + 1 if place + 1 < window else 0
            index_pulse[k] = whole > before
            before = whole
    revolution[0] = before


@inlined
def _since_edge(encoder: EncoderTable, time: float, count: float, angle: float, speed: float) -> float:
    """Return the part of a count known to be passed since the last edge, from the true motion up to a sample."""
    edges, before = encoder.edges, encoder.before
    if count > edges.last[COUNT]:
        place = count * _TURN / encoder.counts
        if encoder.errors.real:
            place = place_of(encoder.errors, place, before[0], angle)
        # The speed is linear between two samples; the root without cancellation.
        acceleration, turned = (speed - before[1]) / encoder.step, angle - place
        root = np.sqrt(max(speed * speed - 2.0 * acceleration * turned, 0.0))
        since = min(max(2.0 * turned / (speed + root), 0.0), encoder.step)
        pass_edge(edges, np.floor((time - since) / edges.clock) * edges.clock, count)
    before[0], before[1] = angle, speed
    return passed(edges, time)


class Encoder:
    """Simulated incremental encoder on a spindle that follows a speed law.

    Args:
        law: spindle speed law.
        step: sampling step [s].
        counts: counts per revolution after quadrature; 0 for an encoder without quantisation, whose angle and speed are
            the true ones if it has no errors.
        speed_window: number of samples over which the measured speed is a difference of the measured angle; it lags
            by half of them. Before sample 0 the spindle is assumed to have turned at its nominal speed.
        errors: errors of disc and signals; none by default.
        edge_clock: resolution of the time stamps of the edges [s]; 0: there are none (see
            `lathe_machine.signals.edge_time`).

    Attributes:
        table: constants and state for `encode`.
    """

    def __init__(
        self,
        law: SpeedLaw,
        step: float,
        counts: int,
        speed_window: int,
        errors: EncoderErrors = _PERFECT,
        edge_clock: float = 0.0,
    ) -> None:
        before = np.arange(-speed_window, 0, dtype=np.float64)
        # history[n % window] holds the angle of sample n; these are the samples before the first.
        history: Array = before * (law.nominal * step)
        table = errors.table
        if table.real:
            seen_along(table, history, history)
        quantum = _TURN / max(counts, 1)
        self.table = EncoderTable(
            step=step,
            nominal=law.nominal,
            lines=law.lines,
            tachogram=law.tachogram,
            counts=counts,
            errors=table,
            history=history,
            revolution=np.array([-1.0]),
            # The edge of count 0 is passed at sample 0.
            edges=edge_table(edge_clock, -quantum / law.nominal, -1.0, law.nominal / quantum),
            before=np.array([-law.nominal * step, law.nominal]),
        )

    def block(self, first: int, *samples: npt.NDArray[Any]) -> None:
        """Fill the encoder signals of a block, starting at sample ``first``.

        Args:
            first: index of the first sample.
            samples: measured angle and speed, index pulse, true angle and speed, shape (n,) each [rad, rad/s, 1, rad,
                rad/s].
        """
        encode(self.table, first, samples)
