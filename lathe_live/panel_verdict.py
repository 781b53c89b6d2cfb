# SPDX-License-Identifier: Apache-2.0
"""Headline of the panel on the part: good, bad, or why neither can be told.

The evaluation is that of ``lathe run``. A part is good only with every ground: the newest revolutions are received and
in tolerance, there are enough of them to show a growing error, none grows, and the tool is in the part.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from lathe_rc.analysis.tolerance import FEWEST, Growth, Verdict

GOOD, BAD, OPEN = "good", "bad", "open"


@dataclass(frozen=True)
class Headline:
    """Headline on the part.

    Attributes:
        mood: `GOOD`, `BAD`, or `OPEN` if neither can be told.
        title: the headline.
        text: its ground.
    """

    mood: str
    title: str
    text: str


@dataclass(frozen=True)
class Evaluation:
    """Evaluation of a run up to a sample.

    Attributes:
        verdict, growth: those of the form so far; None if there is none.
        missing: newest revolutions that were not received, or why there is no verdict; empty if all is known.
        loops: statements on the force and position loops, and whether each is good.
        until_out: verdict on the revolutions before those in which the tool was out of the part; None: it was not.
    """

    verdict: Verdict | None = None
    growth: Growth | None = None
    missing: str = ""
    loops: Sequence[tuple[str, bool | None]] = ()
    until_out: Verdict | None = None

    def headline(self, out: str = "") -> Headline:
        """Return the headline on the part; ``out``: whether the tool is out of it, in words; empty: it is not."""
        mood, title, texts = self._of_form(out)
        moods = {good for _, good in self.loops}
        if False in moods:
            mood, title = BAD, f"{title}, LOOP BAD" if self.verdict else "LOOP BAD"
        elif True in moods and not self.verdict:
            mood, title = GOOD, "LOOP GOOD"
        return Headline(mood, title, "; ".join(filter(None, [*texts, *(text for text, _ in self.loops)])))

    def _of_form(self, out: str) -> tuple[str, str, list[str]]:
        """Return mood, headline and ground of the form alone."""
        verdict, grown = self.verdict, self.growth.told() if self.growth else ""
        diverges = bool(self.growth and self.growth.diverges)
        if verdict is None:
            return (BAD, "ERROR DIVERGES", [grown, self.missing]) if diverges else _open(grown, self.missing)
        told = verdict.told()
        if verdict.unjudged or not verdict.revolutions:
            return _open(*([told] if verdict.unjudged else ["no complete revolution yet", out]))
        if not verdict.in_tolerance:
            if verdict.largest <= verdict.tolerance:  # the form is in doubt
                return _open(told, grown, out, self.missing)
            ground = [told, grown, out]
            if out and self.until_out:
                place = f"{out}, {verdict.quantity.told(verdict.largest)} from the form"
                ground = [place, f"up to revolution {self.until_out.over[1]} {self.until_out.told()}"]
            return BAD, "PART BAD", [*ground, self.missing]
        if diverges:
            return BAD, "PART GOOD, BUT DIVERGES", [grown, told, out, self.missing]
        few = f"{FEWEST + 1} revolutions are needed to see whether the error grows"
        grounds = [out, self.missing, few if verdict.revolutions <= FEWEST else "", grown]
        return _open(*grounds, told) if any(grounds) else (GOOD, "PART GOOD", [told])


def _open(*texts: str) -> tuple[str, str, list[str]]:
    return OPEN, "PART NOT JUDGED", list(texts)
