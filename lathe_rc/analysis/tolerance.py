# SPDX-License-Identifier: Apache-2.0
"""Verdict on a run by an error of each revolution: whether it is in tolerance, and whether it grows.

The error is that of the form, or the following error of a force or position loop; the text speaks of the form. The
tolerance ±t is that of a line profile (ISO 1101) whose zone is 2t wide, t on either side of the desired form. A
revolution is in tolerance if its form error nowhere exceeds t; a run is in tolerance from the first revolution of the
final sequence of revolutions in tolerance. The margin is computed from the last revolutions, since the first one in
tolerance has hardly any margin.

The form error is settled from the first to the last revolution in which it is at most twice its minimum. It grows if
its final value exceeds twice the largest settled value after a rise over several revolutions. It diverges if the rise
accelerates, as in an unstable learning loop; wear and drift cause growth proportional to time. A step, caused by a
fault or by a change of form along the part, is not growth.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lathe_rc.arrays import Array
from lathe_rc.signals.zones import Zone

LAST = 10  #: largest number of revolutions at the end of a run that margin and budget cover
DOUBTED = 0.1  #: part of the tolerance from which the doubt of a form is told
FEWEST = 4  #: largest number of revolutions that do not show whether an error grows
_FACTOR = 2.0  # factor in the definitions of settled error and growth, see the module docstring
_BENT = 1.2  # ratio of the rise in the last third to that in the middle third above which the rise accelerates
_NOTHING = 1e-12  # [m] form error below which a rise is rounding error


@dataclass(frozen=True)
class Quantity:
    """Quantity that is judged.

    Attributes:
        error: name of its error in texts.
        unit: unit in texts and in JSON.
        scale: number of these units in an SI unit.
    """

    error: str
    unit: str
    scale: float

    def told(self, value: float, digits: int = 4) -> str:
        """Format a value in SI units as text with the unit."""
        return f"{value * self.scale:.{digits}g} {self.unit}"


FORM = Quantity("form error", "µm", 1e6)
POSITION = Quantity("position error", "µm", 1e6)
FORCE = Quantity("force error", "N", 1.0)


@dataclass(frozen=True)
class Verdict:
    """Tolerance verdict on a run; errors are in SI units.

    Attributes:
        tolerance: allowed error to each side [m].
        revolutions: number of complete revolutions judged.
        since: first revolution, counted from 1, of the final sequence in tolerance; 0 if the last one is not.
        over: first and last revolution used for `largest`: at most the last `LAST` in tolerance, or only the last
            revolution if it is out of tolerance; (0, 0) without a revolution.
        largest: largest magnitude of the error in these revolutions [m]; NaN without a revolution.
        quantity: quantity that is judged.
        unjudged: reason why the end of the run cannot be judged; empty if it can.
        doubt: how far the desired form may be off between the points of its table [m]
            (`lathe_machine.signals.interpolation_doubt`); a revolution is in tolerance if error and doubt together are.
        place: part of the surface that the figures are of; empty: all of it.
        zones: verdicts on the parts of the surface, if they have tolerances of their own: the part is in tolerance if
            each is, and the other figures are those of the part with the least to spare.
        left: parts of the surface that are not judged.
    """

    tolerance: float
    revolutions: int
    since: int
    over: tuple[int, int]
    largest: float
    quantity: Quantity = FORM
    unjudged: str = ""
    doubt: float = 0.0
    place: str = ""
    zones: "tuple[Verdict, ...]" = ()
    left: tuple[str, ...] = ()

    @property
    def in_tolerance(self) -> bool:
        """Whether the part is in tolerance at the end of the run; False if that cannot be judged."""
        return self.since > 0 and not self.unjudged

    @property
    def spare(self) -> float:
        """Margin to the tolerance [m]; negative if the tolerance is exceeded, NaN without a revolution."""
        return self.tolerance - self.largest

    def told(self) -> str:
        """Describe the result as text."""
        if self.zones:
            return self._by_zone()
        told = self.quantity.told
        allowed = f"±{told(self.tolerance)}" + (f", {self.place}" if self.place else "")
        if self.unjudged:
            return f"not judged ({allowed}): {self.unjudged}"
        if not self.revolutions:
            return f"not in tolerance ({allowed}): no complete revolution"
        doubt = f"the form may be {told(self.doubt, 3)} off between the points of its table"
        if not self.in_tolerance and self.largest <= self.tolerance:
            return f"not shown in tolerance ({allowed}): {told(self.largest)} in the last revolution, but {doubt}"
        if not self.in_tolerance:
            return f"not in tolerance ({allowed}): {told(self.largest)} in the last revolution"
        first, last = self.over
        over = f"the last {last - first + 1}" if first < last else "the last"
        known = f"; {doubt}" if self.doubt > DOUBTED * self.tolerance else ""
        spare = told(self.spare, 3)
        return f"in tolerance ({allowed}) from revolution {self.since} on, {spare} to spare in {over}{known}"

    def _by_zone(self) -> str:
        told, inside = self.quantity.told, [each for each in self.zones if each.in_tolerance]
        outside = [each.told() for each in self.zones if not each.in_tolerance]
        spare = [f"{told(each.spare, 3)} of ±{told(each.tolerance)} ({each.place})" for each in inside]
        where = "the other zones" if outside else f"all zones from revolution {self.since} on"
        kept = [f"in tolerance in {where}, to spare: {', '.join(spare)}"] if spare else []
        left = [f"not judged: {', '.join(self.left)}"] if self.left else []
        return "; ".join([*outside, *kept, *left])

    def summary(self) -> dict[str, object]:
        """Return the result for JSON, in the quantity's unit."""
        scale = self.quantity.scale
        if self.unjudged:
            empty = dict.fromkeys(("in_tolerance", "from_revolution", "largest", "spare", "over_revolutions"))
            return {"allowed": self.tolerance * scale, **empty, "unjudged": self.unjudged}
        return {
            "allowed": self.tolerance * scale,
            "in_tolerance": self.in_tolerance,
            "from_revolution": self.since or None,
            "largest": self.largest * scale if self.revolutions else None,
            "spare": self.spare * scale if self.revolutions else None,
            "over_revolutions": list(self.over) if self.revolutions else None,
            **({"form_doubt": self.doubt * scale} if self.doubt else {}),
            **({"place": self.place} if self.place else {}),
            **({"zones": [each.summary() for each in self.zones], "not_judged": list(self.left)} if self.zones else {}),
        }


@dataclass(frozen=True)
class Growth:
    """Growth of the error beyond its settled range.

    Attributes:
        diverges: True for an accelerating rise; False for a rise proportional to time, as caused by wear or drift.
        since: revolution, counted from 1, in which the growth begins.
        before: largest magnitude in the settled revolutions before the growth [m].
        last: largest magnitude in the last revolution [m].
        quantity: quantity that is judged.
    """

    diverges: bool
    since: int
    before: float
    last: float
    quantity: Quantity = FORM

    def told(self) -> str:
        """Describe the result as text."""
        what = "diverges" if self.diverges else "grows"
        sizes = f"{self.quantity.told(self.before)} before, {self.quantity.told(self.last)} at the end"
        return f"{self.quantity.error} {what} from revolution {self.since} on: {sizes}"

    def summary(self) -> dict[str, object]:
        """Return the result for JSON, in the quantity's unit."""
        sizes = {"before": self.before * self.quantity.scale, "last": self.last * self.quantity.scale}
        return {"diverges": self.diverges, "from_revolution": self.since, **sizes}


def judge(
    largest: Array,
    tolerance: float,
    before: int = 0,
    quantity: Quantity = FORM,
    *,
    unjudged: str = "",
    doubt: float = 0.0,
) -> Verdict:
    """Judge whether a run is in tolerance.

    Args:
        largest: largest magnitude of the error of each complete revolution [m], shape (revolutions,).
        tolerance: allowed error to each side [m].
        before: number of revolutions before the first of these, for a snapshot.
        quantity: quantity that is judged.
        unjudged: reason why the end of the run cannot be judged; empty if it can.
        doubt: how far the desired form may be off between the points of its table [m].
    """
    count = largest.size
    if not count:
        return Verdict(tolerance, 0, 0, (0, 0), np.nan, quantity, unjudged, doubt)
    outside = np.flatnonzero(~(largest + doubt <= tolerance))  # NaN counts as out of tolerance
    inside = int(outside[-1]) + 1 if outside.size else 0  # first of the final sequence in tolerance
    start = max(inside, count - LAST) if inside < count else count - 1
    since = inside + 1 + before if inside < count else 0
    over = (start + 1 + before, count + before)
    return Verdict(tolerance, count, since, over, float(largest[start:].max()), quantity, unjudged, doubt)


def judge_zones(
    largest: Array,
    by_zone: Sequence[Array],
    tolerance: float,
    zones: Sequence[Zone],
    before: int = 0,
    *,
    unjudged: str = "",
    doubt: float = 0.0,
) -> Verdict:
    """Judge whether a part is in tolerance, by zones of its surface if it has any.

    Args:
        largest: see `judge`.
        by_zone: largest errors outside of all zones and in each, see `ZoneErrors.largest`.
        tolerance: allowed error to each side outside of the zones [m].
        zones: the zones.
        before: see `judge`.
        unjudged: see `judge`.
        doubt: see `judge`.
    """
    if unjudged or not zones:
        return judge(largest, tolerance, before, unjudged=unjudged, doubt=doubt)
    named = [(tolerance, "elsewhere"), *((zone.tolerance, zone.name) for zone in zones)]
    parts = [
        replace(judge(errors, allowed, before, doubt=doubt), place=place)
        for errors, (allowed, place) in zip(by_zone, named, strict=True)
        if allowed
    ]
    worst = min(parts, key=lambda each: each.spare if each.spare == each.spare else -np.inf)
    since = min(each.since for each in parts) and max(each.since for each in parts)
    return replace(
        worst, since=since, zones=tuple(parts), left=tuple(zone.name for zone in zones if not zone.tolerance)
    )


def growth(largest: Array, before: int = 0, quantity: Quantity = FORM) -> Growth | None:
    """Detect growth of the error of a run; None without growth, for a step, or with too few revolutions.

    Args:
        largest: largest magnitude of the error of each complete revolution [m], shape (revolutions,).
        before: number of revolutions before the first of these, for a snapshot.
        quantity: quantity that is judged.
    """
    finite = largest[np.isfinite(largest)]
    if finite.size <= FEWEST:
        return None
    sizes = np.fmax(np.where(np.isfinite(largest), largest, _FACTOR * finite.max()), _NOTHING)
    near = np.flatnonzero(sizes <= _FACTOR * sizes.min())
    settled = sizes[near[0] : near[-1] + 1]
    start = int(near[0] + np.flatnonzero(settled <= np.median(settled))[-1])  # last at or below the median
    while start > near[0] and sizes[start - 1] < sizes[start]:
        start -= 1
    rise = sizes[start + 1 :]
    if not rise.size or rise[-1] <= _FACTOR * settled.max():
        return None
    # Only up to half of the largest rise, because the error stops growing at the limits of a drive.
    climb = sizes[start : start + 2 + int(np.argmax(rise >= rise.max() / _FACTOR))]
    steps = np.diff(np.log(climb))
    if climb.size <= FEWEST or steps.max() > steps.sum() / 2.0:
        return None
    first, middle, last = (float(third.mean()) for third in np.array_split(climb, 3))
    diverges = last - middle > _BENT * (middle - first)
    return Growth(diverges, start + 2 + before, float(settled.max()), float(largest[-1]), quantity)


def swing_growth(largest: Array, before: int = 0, quantity: Quantity = FORM) -> Growth | None:
    """Detect growth as `growth` does, also of swings that take several revolutions.

    The largest errors of groups of 1, 2, 4 and more revolutions are checked. The first group length whose errors
    diverge counts; without one, the first whose errors grow.
    """
    found: Growth | None = None
    group = 1
    while largest.size // group > FEWEST:
        whole = largest[: largest.size // group * group].reshape(-1, group)
        grown = growth(whole.max(axis=1), quantity=quantity)
        if grown and (found is None or grown.diverges):
            since = (grown.since - 1) * group + 1 + before
            found = Growth(grown.diverges, since, grown.before, grown.last, quantity)
            if found.diverges:
                return found
        group *= 2
    return found
