# SPDX-License-Identifier: Apache-2.0
"""`lathe_rc.nodes.container` as it is, but for what the environment asks for.

LATHE_BENCH_EXECUTOR=NAME     an executor of rclpy, EventsExecutor or SingleThreadedExecutor, in place of our own
LATHE_BENCH_DURATIONS=FILE    how late each block was and how long it took are written there [s], not only counted
"""

import atexit
import os
from collections.abc import Sequence

import numpy as np
from rclpy.executors import SingleThreadedExecutor
from rclpy.experimental import EventsExecutor
from rclpy.node import Node

from lathe_rc.blocks.latency_histogram import Durations
from lathe_rc.nodes import container, process
from lathe_rc.protocol import pace, time_master

EXECUTOR, DURATIONS = "LATHE_BENCH_EXECUTOR", "LATHE_BENCH_DURATIONS"


class _OfRclpy:
    """The executor that the environment names, in place of `lathe_rc.nodes.executor.Events`."""

    def __init__(self, nodes: Sequence[Node]) -> None:
        made = {"EventsExecutor": EventsExecutor, "SingleThreadedExecutor": SingleThreadedExecutor}
        self._executor = made[os.environ[EXECUTOR]]()
        for node in nodes:
            self._executor.add_node(node)

    def spin(self, wait: float) -> None:
        """See `lathe_rc.nodes.executor.Events`."""
        self._executor.spin_once(timeout_sec=wait)


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
    if os.environ.get(EXECUTOR):
        setattr(process, "Events", _OfRclpy)  # noqa: B010 - it is only imported there
    if DURATIONS in os.environ:
        for module in (pace, time_master):
            setattr(module, "Durations", _Kept)  # noqa: B010 - likewise
        atexit.register(_keep, os.environ[DURATIONS])
    container.main()


if __name__ == "__main__":
    main()
