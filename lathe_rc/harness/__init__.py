# SPDX-License-Identifier: Apache-2.0
"""Execution of a scenario: offline, composed in one process, in groups of nodes, or with one process per node.

    result = run(load(Path("config/piston.yaml")), mode="processes")
    print(result.errors.rms[-1], result.digest)

Nodes report their events over one socket per process (`lathe_rc.nodes.report`); the caller waits for events instead of
polling. All child processes are terminated, however a run ends. This package does not import rclpy.
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
