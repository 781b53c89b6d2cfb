# SPDX-License-Identifier: Apache-2.0
"""The cut for kernels: chip of a sample, its force, deflection of the edge, remembered surface.

The equations are those of `lathe_rc.plants.cutting`. Here they stand sample by sample, so that what moves the edge can
be solved together with the chip, see `lathe_rc.plants.tool_drive`.

The surface that the edge leaves is remembered over the angle until it is met again a revolution later: over the angle,
so that it is found again at any speed. What the edge leaves between two samples goes to the grid points between their
angles.
"""

from typing import NamedTuple

import numpy as np

from lathe_rc.arrays import Array
from lathe_rc.control.interpolation import linear
from lathe_rc.errors import LatheError
from lathe_rc.jit import inlined, kernel
from lathe_rc.plants.cutting_force import Flank, SpecificForce, Wear, cutting_stiffness, flank_damping
from lathe_rc.plants.workpiece import hardness, missing
from lathe_rc.transfer import System, step

# Places in what is known of the last sample: its place on the grid, what it left, the next grid point.
_PLACE, _LEFT, _NEXT = 0, 1, 2


class SurfaceTable(NamedTuple):
    """A remembered surface, for kernels.

    Attributes:
        ring: by grid point, modulo its size, which is a power of two [m].
        last: the last sample's place on the grid, what it left there, and the next grid point; NaN before the first.
    """

    ring: Array
    last: Array


def blank(grid: int) -> SurfaceTable:
    """Surface of an uncut part, with ``grid`` points in a revolution."""
    # A power of two, so that a mask wraps the index; a sample may be up to a revolution long.
    return SurfaceTable(np.zeros(1 << (2 * grid + 2).bit_length()), np.array([np.nan, 0.0, 0.0]))


@inlined
def goes_on(last: Array, place: float, grid: int) -> bool:
    """Whether ``place`` [grid point] is less than a revolution beyond that of the last sample, and not before it."""
    return bool(0.0 <= place - (place if np.isnan(last[_PLACE]) else last[_PLACE]) < grid)


@kernel
def surface_at(ring: Array, place: float) -> float:
    """The remembered surface [m] at ``place`` [grid point]."""
    i = int(np.floor(place))
    mask = ring.size - 1
    left = ring[i & mask]
    return float(left + (ring[(i + 1) & mask] - left) * (place - i))


@kernel
def remember(ring: Array, last: Array, place: float, left: float) -> None:
    """Interpolate the surface that the edge left [m] from the last sample to this one, at ``place`` [grid point]."""
    mask = ring.size - 1
    if np.isnan(last[_PLACE]):
        last[_PLACE], last[_LEFT], last[_NEXT] = place, left, np.ceil(place)
    # Each grid point between the two samples; at a slow spindle most samples pass none.
    while last[_NEXT] <= place:
        u = 0.0
        if place > last[_PLACE]:
            u = (last[_NEXT] - last[_PLACE]) / (place - last[_PLACE])
        ring[int(last[_NEXT]) & mask] = last[_LEFT] + (left - last[_LEFT]) * u
        last[_NEXT] += 1.0
    last[_PLACE], last[_LEFT] = place, left


_TURN = 2.0 * np.pi

WEAR, _EDGE = 0, 1  #: places in the state
DONE, _STANDS, _TURNS_BACK, DRAWN_IN = 0, 1, 2, 3  #: why a kernel stopped


class Process(NamedTuple):
    """Constants of a `lathe_rc.plants.cutting.CuttingProcess` for its kernel.

    Attributes:
        step: sampling step [s].
        depth: [m].
        overlap: µ.
        sign: σ.
        material, wear, flank: as given.
        radius: of the part, for the cutting path [m].
        lag, mode: of F and w.
        lag_now, mode_now: what a unit of their input changes in their output of the same sample.
        gaps: shape (m, 2).
        spots: shape (m, 5).
        heights, compliances: shape (m,).
        grid: points in a revolution.
    """

    step: float
    depth: float
    overlap: float
    sign: float
    material: SpecificForce
    wear: Wear
    flank: Flank
    radius: float
    lag: System
    lag_now: float
    mode: System
    mode_now: float
    gaps: Array
    spots: Array
    heights: Array
    compliances: Array
    grid: int


class CutTable(NamedTuple):
    """A `lathe_rc.plants.cutting.CuttingProcess` for its kernel.

    Attributes:
        process: its constants.
        lag_state, mode_state: of F and w.
        state: VB, and where the edge was; NaN before the first sample.
        surface: what it left.
    """

    process: Process
    lag_state: Array
    mode_state: Array
    state: Array
    surface: SurfaceTable


@inlined
def _free(system: System, state: Array) -> float:
    """Next output of a system with an input of 0; the state stays."""
    # `step` would move the state, and the chip needs this output before the force that is the input is known.
    order = system.now.size
    value = 0.0
    for row in range(order):
        total = system.before[row] * state[order]
        for column in range(order):
            total += system.transition[row, column] * state[column]
        value += system.output[row] * total
    return value


@inlined
def pressed_by(process: Process, speed: float, wear: float) -> float:
    """Loss of the flank's force for each metre that the edge moves out of the part in a sample [N/m], times σ."""
    if process.flank.pressure == 0.0:
        return 0.0
    damping = flank_damping(process.flank, process.radius * speed, wear)
    return float(process.sign * damping / process.step)


@inlined
def meet(
    cut: CutTable, place: float, speed: float, height: float, angle: float, feed_velocity: float
) -> tuple[int, float, float, float]:
    """Conditions of the cut at ``place`` [grid point]: the reason to stop, feed, K, and σ·c; nothing changes."""
    process, state = cut.process, cut.state
    if not speed > 0.0:
        return _STANDS, 0.0, 0.0, 0.0
    if process.overlap > 0.0 and not goes_on(cut.surface.last, place, process.grid):
        return _TURNS_BACK, 0.0, 0.0, 0.0
    feed = max(feed_velocity * _TURN / speed, 0.0)
    stiffness = cutting_stiffness(process.material, feed, state[WEAR])
    stiffness *= hardness(process.spots, angle, height)
    return DONE, feed, stiffness, process.sign * linear(process.heights, process.compliances, height)


@inlined
def held(cut: CutTable) -> float:
    """Force [N] of a sample without a chip, which its lag keeps from before."""
    return _free(cut.process.lag, cut.lag_state)


@inlined
def _moved(cut: CutTable, base: float) -> float:
    """Motion of the edge since the last sample, without its deflection [m]."""
    before = cut.state[_EDGE]
    return 0.0 if np.isnan(before) else base - before


@inlined
def chip_of(
    cut: CutTable,
    place: float,
    angle: float,
    cross_position: float,
    displacement: float,
    allowance: float,
    stiffness: float,
    compliance: float,
    give: float,
    pressed: float,
) -> float:
    """Depth of cut [m] of a sample, negative where the edge is clear of the part; NaN: it is drawn in without end.

    ``displacement`` of the tool drives is that with the force `held`, to which they give way by ``give`` [m/N] of what
    the chip adds to it. ``pressed``: see `pressed_by`; where it is not 0, ``give`` is.
    """
    process, lag_now = cut.process, cut.process.lag_now
    # The chip that a rigid edge would have, then what force and flank of this sample take from it: with contact all of
    # that is linear in the chip, so that one division solves it. A chip below 0 says that there is no contact.
    chip = process.depth + allowance - cross_position - displacement
    if process.overlap > 0.0:
        chip += process.overlap * surface_at(cut.surface.ring, place - process.grid)
    follows = 1.0 + process.mode_now * pressed * compliance
    bend = (process.mode_now * lag_now * stiffness * compliance + lag_now * stiffness * give) / follows
    if not 1.0 + bend > 0.0:  # the edge would be drawn in by all of the chip, or more
        return np.nan
    lagging = held(cut) - pressed * _moved(cut, cross_position + displacement)
    chip -= compliance * (_free(process.mode, cut.mode_state) + process.mode_now * lagging) / follows
    chip /= 1.0 + bend
    return 0.0 if missing(process.gaps, angle) else float(chip)


@inlined
def press(
    cut: CutTable, chip: float, stiffness: float, compliance: float, speed: float, base: float, pressed: float
) -> tuple[float, float]:
    """Step force [N], deflection [m] and wear of the tool by a sample with a chip of 0 or more.

    ``base``: place of the edge but for its deflection [m]; ``pressed``: see `pressed_by`.
    """
    process, state = cut.process, cut.state
    free = _free(process.mode, cut.mode_state)
    force = step(process.lag, cut.lag_state, stiffness * chip)
    if chip > 0.0 and pressed != 0.0:
        follows = 1.0 + process.mode_now * pressed * compliance
        force -= pressed * (_moved(cut, base) + compliance * (free + process.mode_now * force)) / follows
    deflection = compliance * step(process.mode, cut.mode_state, force)
    if chip > 0.0:
        path = process.wear.per_metre * process.radius * speed
        state[WEAR] += (path + process.wear.per_second) * process.step
    return force, deflection


@inlined
def leave(cut: CutTable, place: float, chip: float, edge: float) -> None:
    """Remember the place of the edge [m], and the surface that it left if that is met again."""
    if cut.process.overlap > 0.0:
        remember(cut.surface.ring, cut.surface.last, place, edge if chip > 0.0 else 0.0)
    cut.state[_EDGE] = edge


def failure(reason: int, angle: float, speed: float, feed: float) -> LatheError:
    """Return the error of a cut that cannot go on at an angle [rad], a speed [rad/s] and a feed [m/rev]."""
    if reason == _STANDS:
        return LatheError(
            f"the spindle's speed is {speed:.6g} rad/s in the cut; allowed: above 0 (reduce its deviation)"
        )
    if reason == _TURNS_BACK:
        return LatheError(
            f"the spindle turns back or jumps to {angle:.6g} rad; regeneration needs an angle that rises by less than "
            "a revolution a sample"
        )
    return LatheError(
        f"the force draws the edge into the part without end at a feed of {feed:.4g} m/rev; reduce the feed, the "
        "compliance or the sampling step"
    )
