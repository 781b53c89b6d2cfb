# SPDX-License-Identifier: Apache-2.0
"""Whether a part is in tolerance: the form error against what is allowed to each side.

The tolerance ±t is that of a line profile (ISO 1101) whose zone is 2t wide, t to each side of the desired form. A
revolution is in tolerance if its form error is nowhere larger than t; a run, from the revolution on after which each
one is, to its end.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Verdict:
    """What is said of a run.

    Attributes:
        tolerance: form error that is allowed to each side [m].
        revolutions: complete ones that were judged.
        since: revolution, counted from 1, from which on all are in tolerance; 0: the last is not.
        largest: largest magnitude of the form error from there on; of the last revolution, if that is not in
            tolerance; NaN without a revolution [m].
    """

    tolerance: float
    revolutions: int
    since: int
    largest: float

    @property
    def in_tolerance(self) -> bool:
        """Whether the run ends in tolerance."""
        return self.since > 0

    @property
    def spare(self) -> float:
        """What is left of the tolerance; negative: by so much it is exceeded; NaN without a revolution [m]."""
        return self.tolerance - self.largest

    def told(self) -> str:
        """In words, lengths in µm."""
        allowed = f"±{self.tolerance * 1e6:.4g} µm"
        if not self.revolutions:
            return f"not in tolerance ({allowed}): no complete revolution"
        if not self.in_tolerance:
            return f"not in tolerance ({allowed}): {self.largest * 1e6:.4g} µm in the last revolution"
        return f"in tolerance ({allowed}) from revolution {self.since} on, {self.spare * 1e6:.3g} µm to spare"

    def summary(self) -> dict[str, object]:
        """The same for JSON, lengths in µm."""
        return {
            "allowed": self.tolerance * 1e6,
            "in_tolerance": self.in_tolerance,
            "from_revolution": self.since or None,
            "largest": self.largest * 1e6 if self.revolutions else None,
            "spare": self.spare * 1e6 if self.revolutions else None,
        }


class Judge:
    """Judges a run revolution by revolution, in memory that does not grow with it.

    Args:
        tolerance: form error that is allowed to each side [m].
        before: revolutions before the first that it hears of, as of a snapshot.
    """

    def __init__(self, tolerance: float, before: int = 0) -> None:
        self._tolerance, self._before = tolerance, before
        self._count = self._since = 0
        self._largest = np.nan

    def add(self, largest: Array) -> None:
        """Take the largest magnitude of the form error of the next revolutions [m], shape (n,)."""
        if not largest.size:
            return
        outside = np.flatnonzero(~(largest <= self._tolerance))  # what is not a number is outside
        if not outside.size:
            worst = float(largest.max())
            self._largest = max(self._largest, worst) if self._since else worst
            self._since = self._since or self._count + 1
        elif outside[-1] == largest.size - 1:
            self._since, self._largest = 0, float(largest[-1])
        else:
            begin = int(outside[-1]) + 1
            self._since, self._largest = self._count + begin + 1, float(largest[begin:].max())
        self._count += largest.size

    def verdict(self) -> Verdict:
        """Of the revolutions so far."""
        since = self._since + self._before if self._since else 0
        return Verdict(self._tolerance, self._count + self._before if self._count else 0, since, self._largest)


def judge(largest: Array, tolerance: float) -> Verdict:
    """Judge a whole run.

    Args:
        largest: largest magnitude of the form error of each complete revolution [m], shape (revolutions,).
        tolerance: form error that is allowed to each side [m].
    """
    judging = Judge(tolerance)
    judging.add(largest)
    return judging.verdict()
