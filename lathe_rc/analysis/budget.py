# SPDX-License-Identifier: Apache-2.0
"""Error budget: contributions of the causes to a form error, from runs with some causes switched off.

f(S) is the form error over the angle of a run in which the causes S act and the others are switched off; N is the set
of all causes. The form error e = f(N) is the sum of

    e_i    = f({i}) - f({})                             effect of cause i alone
    e_ij   = f({i, j}) - f({i}) - f({j}) + f({})        interaction of i and j
    e_0    = f({})                                      rest, without any of the causes

and of the interactions of three causes or more. If a cause acts only together with another one, as the lead acts only
at varying speed, its effect is computed with the required cause active. The share of a contribution x in the power of e
is the mean of x·e divided by that of e². The shares add up to 1, since the contributions add up to e; a share is
negative if its contribution reduces the error.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np

from lathe_rc.analysis.tolerance import Growth
from lathe_rc.arrays import Array

Causes = frozenset[str]

TOLD = 0.01  #: smallest share of the interactions at which they are reported pair by pair


@dataclass(frozen=True)
class Share:
    """Contribution of a cause, or of an interaction of causes, to the form error.

    Attributes:
        name: cause or causes.
        share: share in the power of the form error [1].
        rms, largest: RMS and largest magnitude of the contribution itself [m].
    """

    name: str
    share: float
    rms: float
    largest: float

    def percent(self) -> str:
        """Format the share in per cent."""
        return f"{round(self.share * 100.0, 1) + 0.0:.1f}"  # + 0.0 turns -0.0 into 0.0

    def summary(self) -> dict[str, object]:
        """Return the contribution for JSON, lengths in µm."""
        return {"cause": self.name, "share": self.share, "rms": self.rms * 1e6, "largest": self.largest * 1e6}


@dataclass(frozen=True)
class Budget:
    """Error budget of a run: form error and its contributions.

    Attributes:
        revolutions: number of evaluated revolutions, the last ones of the run.
        rms, largest: RMS and largest magnitude of the form error in these revolutions [m].
        causes: contribution of each cause alone.
        rest: form error without any of the causes.
        interactions: sum of all interactions; causes, rest and interactions add up to the form error.
        pairs: interactions of two causes each; empty if the interactions have a share below `TOLD`.
        left_out: causes that could not be switched off, with the reason.
        growth: growth of the form error over the run; None if it does not grow.
    """

    revolutions: int
    rms: float
    largest: float
    causes: Sequence[Share]
    rest: Share
    interactions: Share
    pairs: Sequence[Share] = ()
    left_out: Mapping[str, str] = field(default_factory=dict)
    growth: Growth | None = None

    @property
    def rows(self) -> list[Share]:
        """Return the rows of a table: causes, rest, interactions, and the pairs with a share of `TOLD` or more."""
        return [*self.causes, self.rest, self.interactions, *(pair for pair in self.pairs if abs(pair.share) >= TOLD)]

    @property
    def warning(self) -> str:
        """Why the shares do not tell the cause; empty if they do."""
        if self.growth is None or not self.growth.diverges:
            return ""
        told = self.growth.told()
        return f"{told}; the shares are of what the loop amplifies, not its cause (see the stability margin)"

    @property
    def explained(self) -> float:
        """Return the total share of causes, pairs and rest; 1 if there is no interaction of three or more causes."""
        return self.rest.share + sum(part.share for part in (*self.causes, *self.pairs))

    def summary(self) -> dict[str, object]:
        """Return the budget for JSON, the output of ``lathe budget --json``, lengths in µm."""
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
            "warning": self.warning,
        }


class Decomposition:
    """Plan of the runs required for an error budget, and the evaluation of these runs.

    Args:
        needs: required cause of each cause, or an empty string; a required cause precedes the causes that need it.
    """

    def __init__(self, needs: Mapping[str, str]) -> None:
        self._needs = needs

    def acting(self, causes: Causes) -> Causes:
        """Return the causes with an effect: those that need no other cause, or whose required cause is included."""
        return frozenset(cause for cause in causes if self._needs[cause] in ("", *causes))

    def _context(self, *causes: str) -> Causes:
        """Return the causes required by ``causes``, without ``causes`` themselves."""
        return frozenset(self._needs[cause] for cause in causes if self._needs[cause]) - set(causes)

    def _couples(self) -> Iterator[tuple[str, str]]:
        """Yield all pairs of causes except a cause and its required cause, which always act together."""
        return (pair for pair in combinations(self._needs, 2) if self._needs[pair[1]] != pair[0])

    def alone(self) -> set[Causes]:
        """Return the runs required for all contributions except the pairs."""
        singles = {self._context(cause) | extra for cause in self._needs for extra in (set[str](), {cause})}
        return {frozenset(), frozenset(self._needs), *singles}

    def together(self) -> set[Causes]:
        """Return the additional runs required for the pairs."""
        runs = set[Causes]()
        for first, second in self._couples():
            context = self._context(first, second)
            runs |= {self.acting(context | extra) for extra in ({first, second}, {first}, {second}, set[str]())}
        return runs - self.alone()

    def split(self, runs: Mapping[Causes, Array], left_out: Mapping[str, str]) -> Budget:
        """Compute the error budget from the form errors of the runs.

        Args:
            runs: form error at equidistant angles of the last revolutions [m], shape (revolutions, points), by the
                set of active causes: the runs of `alone`, optionally also those of `together`.
            left_out: causes that could not be switched off, with the reason.
        """
        whole, rest = runs[frozenset(self._needs)], runs[frozenset()]
        power = float(np.mean(whole**2))

        def part(name: str, signal: Array) -> Share:
            share = float(np.mean(signal * whole)) / power if power else 0.0
            return Share(name, share, float(np.sqrt(np.mean(signal**2))), float(np.abs(signal).max()))

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
