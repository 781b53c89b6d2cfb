# SPDX-License-Identifier: Apache-2.0
"""Budget of a form error by its causes, from runs in which some of them are switched off; the parts add up.

f(S) is the form error over the angle of a run in which the causes S act and the others are switched off; N are all of
them. The form error e = f(N) is the sum of

    e_i    = f({i}) - f({})                             what cause i does alone
    e_ij   = f({i, j}) - f({i}) - f({j}) + f({})        what i and j do only together
    e_0    = f({})                                      the rest, which is there without any of them

and of what takes three causes or more. A cause that needs another one to act, as the lead needs a speed that varies, is
seen on top of it. The share of a part x in the power of e is the mean of x·e over that of e². Shares add up to 1 since
the parts add up to e; one is negative if its part makes the error smaller.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Causes = frozenset[str]

TOLD = 0.01  #: least share of what causes do together that is told pair by pair


@dataclass(frozen=True)
class Part:
    """A part of the form error.

    Attributes:
        name: the cause, or causes.
        share: in the power of the whole [1].
        rms, largest: of the part by itself [m].
    """

    name: str
    share: float
    rms: float
    largest: float

    def percent(self) -> str:
        """The share in per cent, in words."""
        return f"{round(self.share * 100.0, 1) + 0.0:.1f}"  # + 0.0: no -0.0

    def summary(self) -> dict[str, object]:
        """For JSON, lengths in µm."""
        return {"cause": self.name, "share": self.share, "rms": self.rms * 1e6, "largest": self.largest * 1e6}


@dataclass(frozen=True)
class Budget:
    """The parts of a form error.

    Attributes:
        revolutions: the last ones of the run that it speaks of.
        rms, largest: form error in them [m].
        causes: what each cause does alone.
        rest: the error without any of them.
        interactions: what causes do only together; with causes and rest it is the whole.
        pairs: parts of the interactions, by two causes each; empty if those come to less than `TOLD` together.
        left_out: causes that could not be switched off, and why.
    """

    revolutions: int
    rms: float
    largest: float
    causes: Sequence[Part]
    rest: Part
    interactions: Part
    pairs: Sequence[Part] = ()
    left_out: Mapping[str, str] = field(default_factory=dict)

    @property
    def rows(self) -> list[Part]:
        """As tables show it: causes, rest, interactions, and the pairs of those that come to `TOLD` or more."""
        return [*self.causes, self.rest, self.interactions, *(pair for pair in self.pairs if abs(pair.share) >= TOLD)]

    @property
    def explained(self) -> float:
        """Share of the causes and pairs of them, and of the rest; 1 if no three causes act together."""
        return self.rest.share + sum(part.share for part in (*self.causes, *self.pairs))

    def summary(self) -> dict[str, object]:
        """The output of ``lathe budget --json``, lengths in µm."""
        return {
            "revolutions": self.revolutions,
            "rms": self.rms * 1e6,
            "largest": self.largest * 1e6,
            "causes": [part.summary() for part in self.causes],
            "rest": self.rest.summary(),
            "interactions": self.interactions.summary(),
            "pairs": [part.summary() for part in self.pairs],
            "explained": self.explained,
            "left_out": dict(self.left_out),
        }


class Decomposition:
    """Runs that a budget takes, and the budget that they give.

    Args:
        needs: of each cause the one without which it does nothing, empty if it acts alone; such a cause comes first.
    """

    def __init__(self, needs: Mapping[str, str]) -> None:
        self._needs = needs

    def acting(self, causes: Causes) -> Causes:
        """Causes of these that act: the one that each needs is among them."""
        return frozenset(cause for cause in causes if self._needs[cause] in ("", *causes))

    def _context(self, *causes: str) -> Causes:
        """Causes that others need, beside those themselves."""
        return frozenset(self._needs[cause] for cause in causes if self._needs[cause]) - set(causes)

    def _couples(self) -> Iterator[tuple[str, str]]:
        """Pairs of causes, but for a cause and the one it needs, which act together already."""
        return (pair for pair in combinations(self._needs, 2) if self._needs[pair[1]] != pair[0])

    def alone(self) -> set[Causes]:
        """Runs for all but the pairs."""
        singles = {self._context(cause) | extra for cause in self._needs for extra in (set[str](), {cause})}
        return {frozenset(), frozenset(self._needs), *singles}

    def together(self) -> set[Causes]:
        """Further runs, for the pairs."""
        runs = set[Causes]()
        for first, second in self._couples():
            context = self._context(first, second)
            runs |= {self.acting(context | extra) for extra in ({first, second}, {first}, {second}, set[str]())}
        return runs - self.alone()

    def split(self, runs: Mapping[Causes, Array], left_out: Mapping[str, str]) -> Budget:
        """The budget.

        Args:
            runs: form error over even angles of the last revolutions [m], shape (revolutions, points), by the causes
                that act: those of `alone`, or those of `together` as well.
            left_out: causes that are not among them, and why.
        """
        whole, rest = runs[frozenset(self._needs)], runs[frozenset()]
        power = float(np.mean(whole**2))

        def part(name: str, signal: Array) -> Part:
            share = float(np.mean(signal * whole)) / power if power else 0.0
            return Part(name, share, float(np.sqrt(np.mean(signal**2))), float(np.abs(signal).max()))

        alone = {}
        for cause in self._needs:
            context = self._context(cause)
            alone[cause] = runs[context | {cause}] - runs[context]
        pairs = []
        for first, second in self._couples() if self.together() <= runs.keys() else ():
            context = self._context(first, second)
            both, one, other, none = (
                runs[self.acting(context | extra)] for extra in ({first, second}, {first}, {second}, set[str]())
            )
            pairs.append(part(f"{first} with {second}", both - one - other + none))
        return Budget(
            revolutions=whole.shape[0],
            rms=float(np.sqrt(power)),
            largest=float(np.abs(whole).max()),
            causes=[part(cause, signal) for cause, signal in alone.items()],
            rest=part("rest", rest),
            interactions=part("interactions", whole - rest - sum(alone.values(), np.zeros_like(whole))),
            pairs=pairs,
            left_out=left_out,
        )
