# SPDX-License-Identifier: Apache-2.0
"""Cutting process: from tool, feed and part to the force, and from the force back to the cutting edge.

    ap = depth + d - y + µ·y(φ - 2π)          depth of cut, never negative
    y  = x + z + σ·c·w                        the edge: cross feed, tool drive, deflection
    f  = 2π·v/Ω                               feed per revolution
    P  = K(f, VB)·ap                          `lathe_machine.plants.cutting_force`, times the factor of a hard spot
    F  = P/(1 + p·T)                          main cutting force Pz
    w  = F/(1 + b·p + a·p²)                   W3 is c·w

With process damping, the flank, worn to a land W, presses on the surface behind the edge, harder while the edge moves
into the part and less while it moves out: F = P/(1 + p·T) - σ·Ksp·B·W²/2·(dy/dt)/v, as long as there is a chip. The
flank thus acts as a damper; B is its width, v the cutting speed, and W the initial land plus VB.

Displacements point out of the part: a positive one moves the edge away from the part and makes the chip thinner. Paper
004 uses the opposite sign for the cross feed, F = +W4·x, so its x is -x here; its y = x + W3·F draws the edge into the
part.

All interactions within a sample are solved together: the force of sample n bends the tool of sample n, whose edge makes
the chip of sample n. As long as there is contact, ap is linear in the force, so the solution takes one division. Both
lags assume inputs that are linear between samples.

The part's surface is stored as a function of the angle (`lathe_machine.plants.chip`), and the chip uses it one
revolution later. Without a cut, the surface is that of the blank, which depth + d already describes.

Source: spec/feed-and-force.md, "Cutting process"; paper 004, W3 and W4; for process damping, see
`lathe_machine.plants.cutting_force`.
"""

from collections.abc import Sequence

import numpy as np

from lathe_machine.plants.chip import (
    DONE,
    DRAWN_IN,
    WEAR,
    CutTable,
    Process,
    blank,
    chip_of,
    failure,
    leave,
    meet,
    press,
    pressed_by,
)
from lathe_machine.plants.cutting_force import RIGID, STEEL, Elasticity, Flank, SpecificForce, Wear
from lathe_machine.plants.workpiece import HardSpot, Workpiece, spot_rows
from lathe_machine.transfer import System, TransferFunction, discretise, rest
from lathe_rc.arrays import Array
from lathe_rc.errors import InputError
from lathe_rc.jit import kernel

_TURN = 2.0 * np.pi
_NEW_EDGE, _NO_DAMPING = Wear(), Flank()


#: input and output arrays of a block, in the order of the kernel
GIVEN = ("angle", "speed", "height", "cross_position", "displacement", "feed_velocity", "allowance")
MADE = ("force", "deflection", "depth_of_cut", "feed", "wear")


@kernel
def cut_along(cut: CutTable, given: tuple[Array, ...], made: tuple[Array, ...]) -> tuple[int, int]:
    """Step the cut through a block, arrays as in `GIVEN` and `MADE`; return the sample reached and the stop reason."""
    angle, speed, height, cross_position, displacement, feed_velocity, allowance = given
    force, deflection, depth_of_cut, feed, wear = made
    per_radian = cut.process.grid / _TURN
    for k in range(angle.size):
        place = angle[k] * per_radian
        reason, feed[k], stiffness, compliance = meet(cut, place, speed[k], height[k], angle[k], feed_velocity[k])
        if reason != DONE:
            return k, reason
        wear[k] = cut.state[WEAR]
        pressed = pressed_by(cut.process, speed[k], wear[k])
        chip = chip_of(
            cut, place, angle[k], cross_position[k], displacement[k], allowance[k], stiffness, compliance, 0.0, pressed
        )
        if np.isnan(chip):
            return k, DRAWN_IN
        depth_of_cut[k] = chip = max(chip, 0.0)
        base = cross_position[k] + displacement[k]
        force[k], deflection[k] = press(cut, chip, stiffness, compliance, speed[k], base, pressed)
        leave(cut, place, chip, base + deflection[k])
    return angle.size, DONE


def _instant(system: System) -> float:
    """Return the change of the output per unit of the input in the same sample."""
    return float(system.through + system.output @ system.now)


def _check_edge(material: SpecificForce, wear: Wear, flank: Flank, elasticity: Elasticity) -> None:
    """Check that all parameters of the edge are finite and in range."""
    for values in (material, wear, flank, elasticity):
        for name, value in values._asdict().items():
            if not 0.0 <= value < np.inf:
                raise InputError(f"cutting: {name} {value:g}; allowed: 0 or more")
    if not (material.kc1 > 0.0 and material.mc < 1.0):
        raise InputError(f"cutting: {material}; allowed: kc1 above 0 (1700 N/mm² is 1.7e9 Pa), mc below 1")
    if elasticity.inertia > 0.0 and not elasticity.damping > 0.0:
        raise InputError("cutting: damping 0 of the edge with inertia; allowed: above 0, or it rings for ever")


class CuttingProcess:
    """Simulated cutting process, which starts at the first sample.

    Args:
        material: specific force, and the effect of wear on it.
        depth: depth of cut with cross feed, tool and allowance at 0 [m].
        lag: T [s]; 0 for no lag.
        elasticity: W3.
        wear: wear of the tool.
        part: keyways, hard spots, and compliance along the part.
        overlap: µ, fraction of the last revolution's surface that the edge meets again, 0 to 1; 0 for no regeneration.
        grid: number of points per revolution at which the surface is stored.
        flank: process damping.
        step: sampling step [s].

    Attributes:
        table: constants and state for `cut_along`.

    Raises:
        InputError: a value is out of range.
    """

    def __init__(
        self,
        *,
        material: SpecificForce = STEEL,
        depth: float,
        lag: float = 0.075,
        elasticity: Elasticity = RIGID,
        wear: Wear = _NEW_EDGE,
        part: Workpiece | None = None,
        overlap: float = 0.0,
        grid: int = 4096,
        flank: Flank = _NO_DAMPING,
        step: float,
    ) -> None:
        least = float(f"{step / 1000.0:g}")  # the rounded number in the message is itself allowed
        if not (lag == 0.0 or least <= lag < np.inf):
            raise InputError(f"cutting: lag {lag:g} s at a step of {step:g} s; allowed: 0 or at least {least:g} s")
        if not 0.0 <= overlap <= 1.0:
            raise InputError(f"cutting: overlap {overlap:g}; allowed: 0 (no regeneration) up to 1")
        if grid < 16:
            raise InputError(f"cutting: {grid} grid points in a revolution; allowed: 16 or more")
        _check_edge(material, wear, flank, elasticity)
        part = part or Workpiece()
        following = discretise(TransferFunction((1.0,), (lag, 1.0)), step, "foh")
        mode = discretise(elasticity.shape, step, "foh")
        heights, compliances = part.heights, part.compliances
        if heights is None or compliances is None:
            heights, compliances = np.zeros(1), np.array([elasticity.compliance])
        # Undamaged process: each call of `damage` starts from it, so that a repair reverts all damage.
        self._whole = Process(
            step=step,
            depth=depth,
            overlap=overlap,
            sign=1.0 if elasticity.away else -1.0,
            material=material,
            wear=wear,
            flank=flank,
            radius=part.radius,
            lag=following,
            lag_now=_instant(following),
            mode=mode,
            mode_now=_instant(mode),
            gaps=np.array(part.gaps, dtype=np.float64).reshape(-1, 2),
            spots=spot_rows(part.hard_spots),
            heights=np.ascontiguousarray(heights, dtype=np.float64),
            compliances=np.ascontiguousarray(compliances, dtype=np.float64),
            grid=grid,
        )
        self.table = CutTable(
            process=self._whole,
            lag_state=rest(following),
            mode_state=rest(mode),
            state=np.array([wear.initial, np.nan]),
            surface=blank(grid),
        )

    def damage(self, *, shorter: float = 0.0, spots: Sequence[HardSpot] = ()) -> None:
        """Shorten the initial length of the edge [m], and add hard spots to those of the part; default: no damage."""
        all_spots = np.concatenate((self._whole.spots, spot_rows(spots)))
        process = self._whole._replace(depth=self._whole.depth - shorter, spots=all_spots)
        self.table = self.table._replace(process=process)

    def block(self, **arrays: Array) -> None:
        """Step the cut through a block.

        Args:
            **arrays: arrays of shape (n,). Inputs by the names of `GIVEN`: true spindle angle [rad], which must not
                decrease with regeneration; true spindle speed [rad/s], above 0; height of the edge along the part [m];
                x of the cross feed and z of the tool drive, out of the part [m]; velocity of the longitudinal feed
                [m/s]; d [m]. Outputs by the names of `MADE`: F [N]; deflection σ·c·w of the edge out of the part [m];
                ap [m]; f [m/rev]; VB [m].

        Raises:
            LatheError: the spindle is at rest, or turns back or jumps with regeneration, or the force draws the edge
                into the part faster than it can cut.
        """
        made = tuple(arrays[name] for name in MADE)
        reached, reason = cut_along(self.table, tuple(arrays[name] for name in GIVEN), made)
        if reason != DONE:
            raise failure(reason, *(float(arrays[name][reached]) for name in ("angle", "speed", "feed")))
