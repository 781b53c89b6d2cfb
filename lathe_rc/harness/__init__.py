# SPDX-License-Identifier: Apache-2.0
"""Running a scenario: offline, composed in one process, grouped, or each node a process of its own.

    result = run(load(Path("config/piston.yaml")), mode="processes")
    print(result.errors.rms[-1], result.digest)

Nodes report their events over a socket each (`lathe_rc.nodes.report`), so whoever drives a cell waits for events,
never for time. Every child is ended, however a run goes; this package does not import rclpy.
"""

from lathe_rc.harness.processes import Event, Processes, free_domain, how_it_ended, with_recorder
from lathe_rc.harness.result import Mode, Result
from lathe_rc.harness.runner import run

__all__ = [
    "Event",
    "Mode",
    "Processes",
    "Result",
    "free_domain",
    "how_it_ended",
    "run",
    "with_recorder",
]
