# SPDX-License-Identifier: Apache-2.0
"""Kernels of the cut: chip of a sample, cutting force, deflection of the edge, stored surface.

The equations are those of `lathe_machine.plants.cutting`, evaluated here sample by sample, so that the edge's motion
can be solved together with the chip (see `lathe_machine.plants.tool_drive`).

The surface behind the edge is stored until the edge meets it again a revolution later. It is stored as a function of
the angle, so that it can be looked up at any speed: from one sample to the next, it is interpolated at the grid points
between the two angles.
"""

from typing import NamedTuple

import numpy as np

from lathe_machine.control.interpolation import linear
from lathe_machine.plants.cutting_force import Flank, SpecificForce, Wear, cutting_stiffness, flank_damping
from lathe_machine.plants.workpiece import hardness, missing
from lathe_machine.transfer import System, step
from lathe_rc.arrays import Array
from lathe_rc.errors import LatheError
from lathe_rc.jit import inlined, kernel

# Indices in the data of the last sample: its position on the grid, the surface there, and the next grid point.
_PLACE, _LEFT, _NEXT = 0, 1, 2


class SurfaceTable(NamedTuple):
    """Stored surface of the part, for kernels.

    Attributes:
        ring: surface by grid point [m]; grid point i is at index i modulo the size, a power of two.
        last: position of the last sample on the grid, surface there, and next grid point; NaN before the first sample.
    """

    ring: Array
    last: Array


def blank(grid: int) -> SurfaceTable:
    """Return the surface of an uncut part, with ``grid`` points per revolution."""
    # A power of two, so that a mask wraps the index; a sample may be up to a revolution long.
    return SurfaceTable(np.zeros(1 << (2 * grid + 2).bit_length()), np.array([np.nan, 0.0, 0.0]))


@inlined
def goes_on(last: Array, place: float, grid: int) -> bool:
    """Return whether ``place`` [grid points] is at or beyond the last sample, by less than a revolution."""
    return bool(0.0 <= place - (place if np.isnan(last[_PLACE]) else last[_PLACE]) < grid)


@kernel
def surface_at(ring: Array, place: float) -> float:
    """Return the stored surface [m] at ``place`` [grid points]."""
    i = int(np.floor(place))
    mask = ring.size - 1
    left = ring[i & mask]
    return float(left + (ring[(i + 1) & mask] - left) * (place - i))


@kernel
def remember(ring: Array, last: Array, place: float, left: float) -> None:
    """Store the surface ``left`` [m] at ``place`` [grid points], interpolated from the last sample to this one."""
    mask = ring.size - 1
    if np.isnan(last[_PLACE]):
        last[_PLACE], last[_LEFT], last[_NEXT] = place, left, np.ceil(place)
    # Each grid point between the two samples; at a low spindle speed, most samples pass none.
    while last[_NEXT] <= place:
        u = 0.0
        if place > last[_PLACE]:
            u = (last[_NEXT] - last[_PLACE]) / (place - last[_PLACE])
        ring[int(last[_NEXT]) & mask] = last[_LEFT] + (left - last[_LEFT]) * u
        last[_NEXT] += 1.0
    last[_PLACE], last[_LEFT] = place, left


_TURN = 2.0 * np.pi

WEAR, _EDGE = 0, 1  #: indices in the state
DONE, _STANDS, _TURNS_BACK, DRAWN_IN = 0, 1, 2, 3  #: reasons for a kernel to stop
STOPS = {
    _STANDS: "stands: the spindle, in the cut",
    _TURNS_BACK: "turns back: the spindle, or its angle jumps",
    DRAWN_IN: "drawn in: the force draws the edge into the part",
}  #: the same in words


class Process(NamedTuple):
    """Constants of the cutting process for kernels (see `lathe_machine.plants.cutting.CuttingProcess`).

    Attributes:
        step: sampling step [s].
        depth: depth of cut with cross feed, tool and allowance at 0 [m].
        overlap: µ.
        sign: σ.
        material, wear, flank: see `lathe_machine.plants.cutting_force`.
        radius: radius of the part, for the length of the cutting path [m].
        lag, mode: systems of F and w.
        lag_now, mode_now: change of each system's output per unit of its input in the same sample.
        gaps: windows without material, shape (m, 2).
        spots: hard spots, shape (m, 5).
        heights, compliances: table of the compliance, shape (m,).
        grid: points per revolution.
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
    """Cutting process with its state, for kernels (see `lathe_machine.plants.cutting.CuttingProcess`).

    Attributes:
        process: constants.
        lag_state, mode_state: states of F and w.
        state: VB, and the last position of the edge, NaN before the first sample.
        surface: stored surface.
    """

    process: Process
    lag_state: Array
    mode_state: Array
    state: Array
    surface: SurfaceTable


@inlined
def _free(system: System, state: Array) -> float:
    """Return the next output of a system for an input of 0; the state is unchanged."""
    # `step` would change the state, but the chip needs this output before the input (the force) is known.
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
    """Return σ times the decrease of the flank force per metre of outward edge motion within a sample [N/m]."""
    if process.flank.pressure == 0.0:
        return 0.0
    damping = flank_damping(process.flank, process.radius * speed, wear)
    return float(process.sign * damping / process.step)


@inlined
def meet(
    cut: CutTable, place: float, speed: float, height: float, angle: float, feed_velocity: float
) -> tuple[int, float, float, float]:
    """Return the conditions of the cut at ``place`` [grid points]: stop reason, feed, cutting stiffness K, and σ·c."""
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
    """Return the force [N] of a sample without a chip, which decays with the force's lag."""
    return _free(cut.process.lag, cut.lag_state)


@inlined
def _moved(cut: CutTable, base: float) -> float:
    """Return the motion of the edge since the last sample, excluding its deflection [m]."""
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
    """Return the depth of cut [m] of a sample: negative without contact, NaN if the edge is drawn in without bound.

    ``displacement`` is that of the tool drives under the force `held`; ``give`` [m/N] is their compliance under the
    additional force of the chip, 0 unless ``pressed`` (see `pressed_by`) is 0.
    """
    process, lag_now = cut.process, cut.process.lag_now
    # First the chip of a rigid edge, then its decrease by force and flank in this sample. With contact, everything is
    # linear in the chip, so one division solves the equation. A negative chip means that there is no contact.
    chip = process.depth + allowance - cross_position - displacement
    if process.overlap > 0.0:
        chip += process.overlap * surface_at(cut.surface.ring, place - process.grid)
    follows = 1.0 + process.mode_now * pressed * compliance
    bend = (process.mode_now * lag_now * stiffness * compliance + lag_now * stiffness * give) / follows
    if not 1.0 + bend > 0.0:  # the edge would be drawn in by the whole chip or more
        return np.nan
    lagging = held(cut) - pressed * _moved(cut, cross_position + displacement)
    chip -= compliance * (_free(process.mode, cut.mode_state) + process.mode_now * lagging) / follows
    chip /= 1.0 + bend
    return 0.0 if missing(process.gaps, angle) else float(chip)


@inlined
def press(
    cut: CutTable, chip: float, stiffness: float, compliance: float, speed: float, base: float, pressed: float
) -> tuple[float, float]:
    """Step the force [N], the deflection [m] and the wear of the tool through a sample with a chip of 0 or more.

    ``base`` is the position of the edge without its deflection [m]; for ``pressed`` see `pressed_by`.
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
    """Store the position of the edge [m] and, with regeneration, the surface behind it."""
    if cut.process.overlap > 0.0:
        remember(cut.surface.ring, cut.surface.last, place, edge if chip > 0.0 else 0.0)
    cut.state[_EDGE] = edge


def failure(reason: int, angle: float, speed: float, feed: float) -> LatheError:
    """Return the error for a failed cut at an angle [rad], a speed [rad/s] and a feed [m/rev]."""
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
