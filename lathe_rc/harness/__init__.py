# SPDX-License-Identifier: Apache-2.0
"""Execution of a scenario: offline, composed in one process, in groups of nodes, or with one process per node.

    result = run(load(Path("config/piston.yaml")), mode="processes")
    print(result.errors.rms[-1], result.digest)

Nodes report their events over one socket per process (`lathe_rc.nodes.report`); the caller waits for events instead of
polling. All child processes are terminated, however a run ends. This package does not import rclpy.
"""

import importlib
from typing import TYPE_CHECKING, Any

from lathe_rc.harness.result import Event, Mode, Result
from lathe_rc.harness.runner import run

if TYPE_CHECKING:
    from lathe_rc.harness.processes import Processes, free_domain, how_it_ended, with_recorder

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


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module("lathe_rc.harness.processes"), name)  # offline runs do without processes
