# SPDX-License-Identifier: Apache-2.0
"""Age of the samples that the panel shows: distance to the newest sample of the run, and time since that one came."""

import threading
import time

_OTHER = 1.0  # [s] by which the shown sample is after the newest one if it is that of an earlier run


class Age:
    """Newest sample of a run, and when it came. The methods may be called by any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self.begin()

    def begin(self) -> None:
        """Begin with another run."""
        with self._lock:
            self._newest, self._moved = 0, time.monotonic()

    def heard(self, end: int) -> None:
        """Take the sample after the newest one received or computed."""
        with self._lock:
            if end > self._newest:
                self._newest, self._moved = end, time.monotonic()

    def now(self, shown: int, step: float) -> dict[str, float | None]:
        """Return the age for the page.

        Args:
            shown: sample after the newest one shown.
            step: sampling step [s].

        Returns:
            ``behind``: simulated time from the shown to the newest sample [s]; None if the samples shown are those of
            an earlier run. ``still``: time since a new sample came [s].
        """
        with self._lock:
            ahead = (shown - self._newest) * step
            behind = None if ahead > _OTHER else max(0.0, -ahead)
            return {
                "behind": behind if behind is None else round(behind, 1),
                "still": round(time.monotonic() - self._moved, 1),
            }
