# SPDX-License-Identifier: Apache-2.0
"""Causes of the form error of an own run, by the error budget of ``lathe budget``, computed beside the run."""

import threading
from collections.abc import Callable, Mapping
from typing import Any

from lathe_rc.cell.scenario import Scenario
from lathe_rc.errors import InputError
from lathe_rc.judge.budget import budget

MOST_REVOLUTIONS = 2000  #: length of a run whose budget is computed, which takes 10 to 30 runs of this length


class Causes:
    """Error budget of a run up to now.

    Args:
        so_far: returns the scenario of the run up to its newest complete revolution, with all events, and its number.
    """

    def __init__(self, so_far: Callable[[], tuple[Scenario, int]]) -> None:
        self._so_far, self._one = so_far, threading.Lock()
        self._runs = (0, 0)  # of the budget in progress: done, and known

    def budget(self, _: Mapping[str, Any]) -> dict[str, Any]:
        """Return the shares of the causes in the last ten complete revolutions, as an answer to the page.

        Raises:
            InputError: the run has no budget, or one is being computed.
            LatheError: one of its runs failed.
        """
        if not self._one.acquire(blocking=False):
            done, known = self._runs
            raise InputError(f"run {done} of {known} of the budget is done; allowed: wait for the others")
        try:
            scenario, last = self._so_far()
            if last > MOST_REVOLUTIONS:
                raise InputError(
                    f"revolution {last}; allowed: up to {MOST_REVOLUTIONS} (lathe budget takes longer runs)"
                )
            found = budget(scenario, threads=1, watch=lambda *runs: setattr(self, "_runs", runs))
        finally:
            self._runs = (0, 0)
            self._one.release()
        return {**found.summary(), "last": last}
