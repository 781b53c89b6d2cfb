# SPDX-License-Identifier: Apache-2.0
"""`lathe_rc.nodes.container` as it is, but for what the environment asks for.

LATHE_BENCH_EXECUTOR=single   a SingleThreadedExecutor in place of the EventsExecutor
LATHE_BENCH_DURATIONS=FILE    how late each block was and how long it took are written there [s], not only counted
"""

import atexit
import os

import numpy as np
import rclpy.executors

from lathe_rc.cell.latency_histogram import Durations
from lathe_rc.nodes import container, process
from lathe_rc.protocol import pace, time_master

EXECUTOR, DURATIONS = "LATHE_BENCH_EXECUTOR", "LATHE_BENCH_DURATIONS"


class _Kept(Durations):
    """Durations that are kept one by one as well."""

    made: list["_Kept"] = []  # noqa: RUF012 - all of this process, in the order in which the spindle makes them

    def __init__(self) -> None:
        super().__init__()
        self.seconds: list[float] = []
        self.made.append(self)

    def add(self, seconds: float, count: int = 1) -> None:
        """See `Durations`."""
        super().add(seconds, count)
        self.seconds.append(seconds)


def _keep(file: str) -> None:
    """Write them out at the end, if the spindle is in this process."""
    if _Kept.made:
        lateness, latency = _Kept.made
        np.savez(file, lateness=lateness.seconds, latency=latency.seconds)


def main() -> None:
    """Run the nodes."""
    if os.environ.get(EXECUTOR) == "single":
        setattr(process, "EventsExecutor", rclpy.executors.SingleThreadedExecutor)  # noqa: B010 - it is only imported there
    if DURATIONS in os.environ:
        for module in (pace, time_master):
            setattr(module, "Durations", _Kept)  # noqa: B010 - likewise
        atexit.register(_keep, os.environ[DURATIONS])
    container.main()


if __name__ == "__main__":
    main()
