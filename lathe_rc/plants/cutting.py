# SPDX-License-Identifier: Apache-2.0
"""Cutting process: from tool, feed and part to the force, and from the force back to the tool's edge.

    ap = depth + d - y + µ·y(φ - 2π)          depth of cut, never negative
    y  = x + z + σ·c·w                        the edge: cross feed, tool drive, deflection
    f  = 2π·v/Ω                               feed a revolution
    P  = K(f, VB)·ap                          `lathe_rc.plants.cutting_force`; times the factor of a hard spot
    F  = P/(1 + p·T)                          main cutting force Pz
    w  = F/(1 + b·p + a·p²)                   W3 is c·w

With process damping the flank, worn to a land W, presses on the surface that the edge leaves where it moves into the
part, and less where it moves out: F = P/(1 + p·T) - σ·Ksp·B·W²/2·(dy/dt)/v, as long as there is a chip. That is a
damper; B is the width of the flank, v the cutting speed, W the land that it began with and VB.

Displacements point out of the part: a positive one takes the edge away from it and makes the chip thinner. Paper 004
has the cross feed the other way round, F = +W4·x, so its x is -x here; its y = x + W3·F draws the edge into the part
(σ = -1), and the realistic y = x - W3·F pushes it away (σ = +1).

All that happens in a sample is solved together: the force of sample n bends the tool of sample n, whose edge makes the
chip of sample n. ap is linear in the force as long as there is contact, so that this is one division. Both lags take
what drives them as linear between samples.

The part's surface is remembered over the angle, so that it is found again at any speed: what the edge leaves between
two samples goes to the grid points between their angles, and the chip reads it a revolution later. Where nothing is cut
nothing is left to meet: the blank is there, which depth + d says already.

Source: spec/feed-and-force.md, "Cutting process"; paper 004, W3 and W4. Process damping: D. W. Wu, J. Engineering for
Industry 111 (1989) 37 (force by the volume that is pressed in); E. Budak, L. T. Tunc, CIRP Annals 59 (2010).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lathe_rc.errors import InputError, LatheError
from lathe_rc.jit import inlined, kernel
from lathe_rc.plants.cutting_force import STEEL, SpecificForce, cutting_stiffness
from lathe_rc.signals.interpolation import linear
from lathe_rc.transfer import System, TransferFunction, discretise, rest, step

Array = npt.NDArray[np.float64]

_TURN = 2.0 * np.pi

# Places in the state: VB, the last angle's place on the grid, what is remembered of it, the next grid point, the edge.
_WEAR, _PLACE, _LEFT, _NEXT, _EDGE = 0, 1, 2, 3, 4
# Why the kernel stopped, and what it counts.
_DONE, _STANDS, _TURNS_BACK, DRAWN_IN = 0, 1, 2, 3
_APART, _BACKWARDS = 0, 1


@dataclass(frozen=True)
class Elasticity:
    """W3 = c/(1 + b·p + a·p²): what the force does to the edge.

    Attributes:
        compliance: c [m/N].
        inertia: a [s²]; 0 with b = 0 for a spring alone.
        damping: b [s].
        away: the force pushes the edge away from the part; False draws it into the part.

    Raises:
        InputError: a value that is out of its range.
    """

    compliance: float
    inertia: float
    damping: float
    away: bool

    def __post_init__(self) -> None:
        for name, value in (("compliance", self.compliance), ("inertia", self.inertia), ("damping", self.damping)):
            if not 0.0 <= value < np.inf:
                raise InputError(f"tool deflection: {name} {value:g}; allowed: 0 or more")
        if self.inertia > 0.0 and not self.damping > 0.0:
            raise InputError("tool deflection: damping 0 with inertia; allowed: above 0, or it rings for ever")

    @property
    def shape(self) -> TransferFunction:
        """W3/c."""
        return TransferFunction((1.0,), (self.inertia, self.damping, 1.0))

    @property
    def transfer(self) -> TransferFunction:
        """W3 [m/N]."""
        return TransferFunction((self.compliance,), (self.inertia, self.damping, 1.0))


RIGID = Elasticity(0.0, 0.0, 0.0, away=True)
PAPER = Elasticity(3.85e-7, 0.003, 0.0005, away=False)  #: as printed in paper 004: 2.9 Hz, ζ = 0.005
REALISTIC = Elasticity(3.85e-7, 0.003**2, 0.0005, away=True)  #: 53 Hz, ζ = 0.083


@dataclass(frozen=True)
class Wear:
    """Wear VB of the tool; it grows while there is a chip.

    Attributes:
        initial: [m].
        per_metre: for each metre of the cutting path [m/m].
        per_second: for each second in the cut [m/s].

    Raises:
        InputError: a negative value.
    """

    initial: float = 0.0
    per_metre: float = 0.0
    per_second: float = 0.0

    def __post_init__(self) -> None:
        if min(self.initial, self.per_metre, self.per_second) < 0.0:
            raise InputError(f"{self}; allowed: 0 or more each, wear does not heal")


@dataclass(frozen=True)
class Flank:
    """The flank that presses on the surface: process damping.

    Attributes:
        pressure: Ksp, force by the volume that is pressed in [N/m³]; 0: no process damping.
        width: B, of the flank along the edge that faces the surface [m].
        land: W of a new edge, to which the wear VB is added [m].

    Raises:
        InputError: a negative value.
    """

    pressure: float = 0.0
    width: float = 0.2e-3
    land: float = 0.0

    def __post_init__(self) -> None:
        if not (0.0 <= self.pressure < np.inf and 0.0 <= self.width < np.inf and 0.0 <= self.land < np.inf):
            raise InputError(f"{self}; allowed: 0 or more each")

    def damping(self, speed: float, wear: float = 0.0) -> float:
        """Force on the edge by its speed out of the part [N·s/m].

        Args:
            speed: cutting speed [m/s].
            wear: VB [m].
        """
        return self.pressure * self.width * (self.land + wear) ** 2 / (2.0 * speed)


@dataclass(frozen=True)
class HardSpot:
    """A place in the part where the force is another.

    Attributes:
        start, width: angular window [rad].
        bottom, top: its heights along the part [m].
        factor: of the force.
    """

    start: float
    width: float
    bottom: float
    top: float
    factor: float

    def __post_init__(self) -> None:
        _check_window("hard spot", self.start, self.width)
        if not self.bottom < self.top:
            raise InputError(f"hard spot from {self.bottom:g} to {self.top:g} m; allowed: a top above the bottom")
        if not 0.0 <= self.factor < np.inf:
            raise InputError(f"hard spot: factor {self.factor:g}; allowed: 0 or more")

    @property
    def row(self) -> tuple[float, ...]:
        """As the kernel has it."""
        return self.start, self.width, self.bottom, self.top, self.factor


def _check_window(what: str, start: float, width: float) -> None:
    if not (np.isfinite(start) and 0.0 < width < _TURN):
        raise InputError(
            f"{what}: window at {start:g} rad of {width:g} rad; allowed: a width above 0 and below a revolution"
        )


@dataclass(frozen=True)
class Part:
    """The part's effect on the cut.

    Attributes:
        radius: at which the cutting path is reckoned [m].
        gaps: angular windows without material (keyways): start and width of each [rad].
        hard_spots: where spots overlap their factors multiply.
        heights, compliances: c along the part [m, m/N], instead of that of the elasticity, linear between heights and
            the same beyond the ends; ``None`` where it does not change. See `lathe_rc.analysis.shaft`.

    Raises:
        InputError: a window or table that is none.
    """

    radius: float = 0.05
    gaps: Sequence[tuple[float, float]] = ()
    hard_spots: Sequence[HardSpot] = ()
    heights: Array | None = None
    compliances: Array | None = None

    def __post_init__(self) -> None:
        if not 0.0 < self.radius < np.inf:
            raise InputError(f"part: radius {self.radius:g} m; allowed: above 0")
        for start, width in self.gaps:
            _check_window("keyway", start, width)
        if (self.heights is None) != (self.compliances is None):
            raise InputError("part: heights without compliances or the other way round; give both or none")
        if self.heights is not None and self.compliances is not None:
            if self.heights.size != self.compliances.size or not self.heights.size:
                raise InputError(
                    f"part: {self.heights.size} heights and {self.compliances.size} compliances; give as many of each"
                )
            if np.any(np.diff(self.heights) <= 0.0) or np.any(self.compliances < 0.0):
                raise InputError("part: heights have to rise, compliances must not be negative; sort or correct them")


class Process(NamedTuple):
    """Constants of a `CuttingProcess` for its kernel.

    Attributes:
        step: sampling step [s].
        depth: [m].
        overlap: µ.
        sign: σ.
        kc1, mc, wear_factor: see `SpecificForce`.
        per_metre, per_second, radius: of the wear.
        lag, mode: of F and w.
        lag_now, mode_now: what a unit of their input changes in their output of the same sample.
        gaps: shape (m, 2).
        spots: shape (m, 5).
        heights, compliances: shape (m,).
        grid: points in a revolution.
        pressure, width, land: see `Flank`.
    """

    step: float
    depth: float
    overlap: float
    sign: float
    kc1: float
    mc: float
    wear_factor: float
    per_metre: float
    per_second: float
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
    pressure: float
    width: float
    land: float


@inlined
def _free(system: System, state: Array) -> float:
    """The next output if the input were 0; the state stays."""
    order = system.now.size
    value = 0.0
    for row in range(order):
        total = system.before[row] * state[order]
        for column in range(order):
            total += system.transition[row, column] * state[column]
        value += system.output[row] * total
    return value


@inlined
def _within(angle: float, start: float, width: float) -> bool:
    """Whether an angle lies in a window [rad]; windows may lie across the zero."""
    since = (angle - start) / _TURN
    return bool((since - np.floor(since)) * _TURN < width)


@inlined
def _missing(gaps: Array, angle: float) -> bool:
    """Whether there is no material at an angle [rad]."""
    missing = False
    for i in range(gaps.shape[0]):
        missing |= _within(angle, gaps[i, 0], gaps[i, 1])
    return missing


@inlined
def _pressed(process: Process, speed: float, wear: float) -> float:
    """The loss of the flank's force for each metre that the edge moves out of the part in a sample [N/m], times σ."""
    if process.pressure == 0.0:
        return 0.0
    land = process.land + wear
    damping = process.pressure * process.width * land * land / (2.0 * process.radius * speed)
    return float(process.sign * damping / process.step)


@inlined
def _hardness(spots: Array, angle: float, height: float) -> float:
    factor = 1.0
    for i in range(spots.shape[0]):
        if spots[i, 2] <= height <= spots[i, 3] and _within(angle, spots[i, 0], spots[i, 1]):
            factor *= spots[i, 4]
    return factor


@kernel
def _read(surface: Array, place: float) -> float:
    """The remembered surface at ``place`` [grid point]; the length of the ring is a power of two."""
    i = int(np.floor(place))
    mask = surface.size - 1
    left = surface[i & mask]
    return float(left + (surface[(i + 1) & mask] - left) * (place - i))


@kernel
def _remember(surface: Array, state: Array, place: float, left: float) -> None:
    """Lay down what the edge left between the last sample and this one."""
    mask = surface.size - 1
    if np.isnan(state[_PLACE]):
        state[_PLACE], state[_LEFT], state[_NEXT] = place, left, np.ceil(place)
    while state[_NEXT] <= place:
        u = 0.0
        if place > state[_PLACE]:
            u = (state[_NEXT] - state[_PLACE]) / (place - state[_PLACE])
        surface[int(state[_NEXT]) & mask] = state[_LEFT] + (left - state[_LEFT]) * u
        state[_NEXT] += 1.0
    state[_PLACE], state[_LEFT] = place, left


class CutTable(NamedTuple):
    """A `CuttingProcess` for its kernel.

    Attributes:
        process: its constants.
        lag_state, mode_state: of F and w.
        state: VB, the last angle's place on the grid, what is remembered of it, the next grid point, and where the edge
            was; NaN before the first sample.
        surface: the remembered surface.
        counts: see `CuttingProcess.apart` and `CuttingProcess.backwards`.
    """

    process: Process
    lag_state: Array
    mode_state: Array
    state: Array
    surface: Array
    counts: npt.NDArray[np.int64]


@inlined
def meet(
    cut: CutTable, place: float, speed: float, height: float, angle: float, feed_velocity: float
) -> tuple[int, float, float, float]:
    """The cut at ``place`` [grid point]: the reason to stop, feed, K, and σ·c; nothing changes."""
    process, state = cut.process, cut.state
    if not speed > 0.0:
        return _STANDS, 0.0, 0.0, 0.0
    if (
        process.overlap > 0.0
        and not 0.0 <= place - (place if np.isnan(state[_PLACE]) else state[_PLACE]) < process.grid
    ):
        return _TURNS_BACK, 0.0, 0.0, 0.0
    feed = max(feed_velocity * _TURN / speed, 0.0)
    stiffness = cutting_stiffness(process.kc1, process.mc, process.wear_factor, feed, state[_WEAR])
    stiffness *= _hardness(process.spots, angle, height)
    return _DONE, feed, stiffness, process.sign * linear(process.heights, process.compliances, height)


@inlined
def held(cut: CutTable) -> float:
    """Force [N] that a sample has without a chip: what the lag keeps."""
    return _free(cut.process.lag, cut.lag_state)


@inlined
def _moved(cut: CutTable, base: float) -> float:
    """How far the edge is from where it was a sample before, as far as the tool is not bent [m]."""
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
    the chip adds to it. ``pressed``: see `_pressed`; where it is not 0, ``give`` is.
    """
    process, lag_now = cut.process, cut.process.lag_now
    chip = process.depth + allowance - cross_position - displacement
    if process.overlap > 0.0:
        chip += process.overlap * _read(cut.surface, place - process.grid)
    follows = 1.0 + process.mode_now * pressed * compliance
    bend = (process.mode_now * lag_now * stiffness * compliance + lag_now * stiffness * give) / follows
    if not 1.0 + bend > 0.0:
        return np.nan
    lagging = held(cut) - pressed * _moved(cut, cross_position + displacement)
    chip -= compliance * (_free(process.mode, cut.mode_state) + process.mode_now * lagging) / follows
    chip /= 1.0 + bend
    return 0.0 if _missing(process.gaps, angle) else float(chip)


@inlined
def press(
    cut: CutTable, chip: float, stiffness: float, compliance: float, speed: float, base: float, pressed: float
) -> tuple[float, float]:
    """Step force [N] and deflection [m] on by a sample with a chip of 0 or more; the tool wears.

    ``base``: place of the edge but for its deflection [m]; ``pressed``: see `_pressed`.
    """
    process, state = cut.process, cut.state
    free = _free(process.mode, cut.mode_state)
    force = step(process.lag, cut.lag_state, stiffness * chip)
    if chip > 0.0 and pressed != 0.0:
        follows = 1.0 + process.mode_now * pressed * compliance
        force -= pressed * (_moved(cut, base) + compliance * (free + process.mode_now * force)) / follows
    deflection = compliance * step(process.mode, cut.mode_state, force)
    if chip > 0.0:
        path = process.per_metre * process.radius * speed
        state[_WEAR] += (path + process.per_second) * process.step
    return force, deflection


@inlined
def leave(cut: CutTable, place: float, chip: float, edge: float) -> None:
    """Remember where the edge [m] is, and where it has been if that is met again."""
    if cut.process.overlap > 0.0:
        _remember(cut.surface, cut.state, place, edge if chip > 0.0 else 0.0)
    cut.state[_EDGE] = edge


@kernel
def cut_along(
    cut: CutTable,
    angle: Array,
    speed: Array,
    height: Array,
    cross_position: Array,
    displacement: Array,
    feed_velocity: Array,
    allowance: Array,
    force: Array,
    deflection: Array,
    depth_of_cut: Array,
    feed: Array,
    wear: Array,
) -> tuple[int, int]:
    """Step through a block, see `CuttingProcess.block`; returns the sample at which it stopped and why."""
    per_radian = cut.process.grid / _TURN
    for k in range(angle.size):
        place = angle[k] * per_radian
        reason, feed[k], stiffness, compliance = meet(cut, place, speed[k], height[k], angle[k], feed_velocity[k])
        if reason != _DONE:
            return k, reason
        wear[k] = cut.state[_WEAR]
        pressed = _pressed(cut.process, speed[k], wear[k])
        chip = chip_of(
            cut, place, angle[k], cross_position[k], displacement[k], allowance[k], stiffness, compliance, 0.0, pressed
        )
        if np.isnan(chip):
            return k, DRAWN_IN
        cut.counts[_BACKWARDS] += feed_velocity[k] < 0.0
        cut.counts[_APART] += chip < 0.0
        depth_of_cut[k] = chip = max(chip, 0.0)
        base = cross_position[k] + displacement[k]
        force[k], deflection[k] = press(cut, chip, stiffness, compliance, speed[k], base, pressed)
        leave(cut, place, chip, base + deflection[k])
    return angle.size, _DONE


def _instant(system: System) -> float:
    """The change of the output for a unit of the input of the same sample."""
    return float(system.through + system.output @ system.now)


class CuttingProcess:
    """The cut as a machine; it has not begun before the first sample.

    Args:
        material: specific force and what wear does to it.
        depth: of the cut that cross feed, tool and allowance of 0 give [m].
        lag: T [s]; 0 for none.
        elasticity: W3.
        wear: of the tool.
        part: keyways, hard spots, compliance along the part.
        overlap: µ, how much of the last revolution's surface the edge meets again, 0 up to 1; 0: no regeneration.
        grid: points in a revolution at which the surface is remembered.
        flank: process damping.
        step: sampling step [s].

    Attributes:
        apart: samples so far in which the edge was clear of the part although there was material; before the first
            contact too.
        backwards: samples so far in which the feed went back; no chip has a negative thickness, and 0 was taken.
        table: for `cut_along`.

    Raises:
        InputError: a value that is out of its range.
    """

    def __init__(
        self,
        *,
        material: SpecificForce = STEEL,
        depth: float,
        lag: float = 0.075,
        elasticity: Elasticity = RIGID,
        wear: Wear | None = None,
        part: Part | None = None,
        overlap: float = 0.0,
        grid: int = 4096,
        flank: Flank | None = None,
        step: float,
    ) -> None:
        if not (lag == 0.0 or step / 1000.0 <= lag < np.inf):
            raise InputError(
                f"cutting: lag {lag:g} s at a step of {step:g} s; allowed: 0 or at least {step / 1000.0:g} s"
            )
        if not 0.0 <= overlap <= 1.0:
            raise InputError(f"cutting: overlap {overlap:g}; allowed: 0 (no regeneration) up to 1")
        if grid < 16:
            raise InputError(f"cutting: {grid} grid points in a revolution; allowed: 16 or more")
        part, wear, flank = part or Part(), wear or Wear(), flank or Flank()
        following = discretise(TransferFunction((1.0,), (lag, 1.0)), step, "foh")
        mode = discretise(elasticity.shape, step, "foh")
        heights, compliances = part.heights, part.compliances
        if heights is None or compliances is None:
            heights, compliances = np.zeros(1), np.array([elasticity.compliance])
        self._whole = Process(
            step=step,
            depth=depth,
            overlap=overlap,
            sign=1.0 if elasticity.away else -1.0,
            kc1=material.kc1,
            mc=material.mc,
            wear_factor=material.wear_factor,
            per_metre=wear.per_metre,
            per_second=wear.per_second,
            radius=part.radius,
            lag=following,
            lag_now=_instant(following),
            mode=mode,
            mode_now=_instant(mode),
            gaps=np.array(part.gaps, dtype=np.float64).reshape(-1, 2),
            spots=np.array([spot.row for spot in part.hard_spots], dtype=np.float64).reshape(-1, 5),
            heights=np.ascontiguousarray(heights, dtype=np.float64),
            compliances=np.ascontiguousarray(compliances, dtype=np.float64),
            grid=grid,
            pressure=flank.pressure,
            width=flank.width,
            land=flank.land,
        )
        self.table = CutTable(
            process=self._whole,
            lag_state=rest(following),
            mode_state=rest(mode),
            state=np.array([wear.initial, np.nan, 0.0, 0.0, np.nan]),
            # A power of two, so that a mask wraps the index; a sample may be up to a revolution long.
            surface=np.zeros(1 << (2 * grid + 2).bit_length()),
            counts=np.zeros(2, dtype=np.int64),
        )

    def damage(self, *, shorter: float = 0.0, spots: Sequence[HardSpot] = ()) -> None:
        """Let the edge be shorter [m] than it was made, and the part further hard spots; nothing given: neither."""
        further = np.array([spot.row for spot in spots], dtype=np.float64).reshape(-1, 5)
        process = self._whole._replace(
            depth=self._whole.depth - shorter, spots=np.concatenate((self._whole.spots, further))
        )
        self.table = self.table._replace(process=process)

    @property
    def apart(self) -> int:
        """See the class."""
        return int(self.table.counts[_APART])

    @property
    def backwards(self) -> int:
        """See the class."""
        return int(self.table.counts[_BACKWARDS])

    def block(
        self,
        *,
        angle: Array,
        speed: Array,
        height: Array,
        cross_position: Array,
        displacement: Array,
        feed_velocity: Array,
        allowance: Array,
        force: Array,
        deflection: Array,
        depth_of_cut: Array,
        feed: Array,
        wear: Array,
    ) -> None:
        """Step through a block; arrays of shape (n,), the last five filled.

        Args:
            angle: true spindle angle [rad]; with regeneration it must not fall.
            speed: true spindle speed [rad/s], above 0.
            height: of the edge along the part [m].
            cross_position: x of the cross feed, out of the part [m].
            displacement: z of the tool drive, out of the part [m].
            feed_velocity: of the longitudinal feed [m/s].
            allowance: d [m].
            force: F [N].
            deflection: σ·c·w of the edge, out of the part [m].
            depth_of_cut: ap [m].
            feed: f [m/rev].
            wear: VB [m].

        Raises:
            LatheError: the spindle stands, or turns back or jumps under regeneration; or the force draws the edge into
                the part faster than it can cut.
        """
        reached, reason = cut_along(
            self.table, angle, speed, height, cross_position, displacement, feed_velocity, allowance, force, deflection,
            depth_of_cut, feed, wear,
        )  # fmt: skip
        if reason != _DONE:
            raise failure(reason, angle[reached], speed[reached], feed[reached])


def failure(reason: int, angle: float, speed: float, feed: float) -> LatheError:
    """Why a cut cannot go on at an angle [rad], a speed [rad/s] and a feed [m/rev]."""
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
