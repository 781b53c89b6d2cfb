# SPDX-License-Identifier: Apache-2.0
"""Advice to the operator on the part, in words, where a run's state tells it; one line of the panel's header.

The steps after an alarm are those of the supervisor (`lathe_machine.safety.next_step`).
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

from lathe_live.panel_verdict import Evaluation
from lathe_rc.analysis.tolerance import FEWEST
from lathe_rc.arrays import Array


@dataclass(frozen=True)
class Situation:
    """State of a run, as far as advice rests on it.

    Attributes:
        evaluation: that of the part.
        errors: form errors of the last revolutions over the angle [m], shape (revolutions, angles).
        unstable: whether the stability margin is below 0.
        falls: whether the error still falls from revolution to revolution.
        learning: whether a controller learned in its last cycle.
        memories: learning controllers whose memories can be cleared.
        limited: nodes at the limits of their commands.
    """

    evaluation: Evaluation
    errors: Array
    unstable: bool
    falls: bool
    learning: bool
    memories: Collection[str]
    limited: Collection[str]

    def advice(self, outlook: Mapping[str, Any], *, alarmed: bool) -> str:
        """Return the step that helps most; empty: none follows from the state.

        Args:
            outlook: see `lathe_live.panel_outlook`.
            alarmed: whether the supervisor has a step of its own for the operator.
        """
        force, limit = outlook.get("force", 0.0), outlook.get("force_limit", 0.0)
        if force > limit > 0.0:
            return f"the set point of the force, {force:g} N, is above the supervisor's limit, {limit:g} N: change one"
        return "" if alarmed else self._of_part(outlook)

    def _of_part(self, outlook: Mapping[str, Any]) -> str:
        verdict, growth = self.evaluation.verdict, self.evaluation.growth
        bad = bool(verdict and verdict.revolutions and not verdict.in_tolerance)
        if bad and self.limited:
            told = " and ".join(sorted(self.limited))
            return f"lower the speed, or ask less of {told}, whose command is at its limits: learning does not help"
        names, steady = " and ".join(sorted(self.memories)), len(self.errors) >= FEWEST and not self.falls
        if names and ((self.unstable and steady) or (growth and growth.diverges)):
            first = "freeze and clear" if self.learning else "clear"
            return f"{first} {names}, in which learning diverges; then set a smaller learning_gain or a larger q_time"
        if growth and not growth.diverges:
            return "the error grows as by wear or drift: change a worn edge, or find what drifts"
        return self._of_bad_part(outlook, steady=steady) if bad else ""

    def _of_bad_part(self, outlook: Mapping[str, Any], *, steady: bool) -> str:
        if self.falls:
            return "wait: learning is not over, the error falls"
        size = float(self.errors.mean()) if steady else 0.0
        if outlook.get("bent") and size**2 > float((self.errors**2).mean()) / 2.0:
            bent = f"the force bends tool and part by {abs(size) * 1e6:.2g} µm, which no sensor of a drive sees"
            return f"{bent}: cut less deep, change a worn edge, or correct it by a gauge or a predistortion"
        return ""
