# SPDX-License-Identifier: Apache-2.0
"""The events of a cell, as its nodes and the harness report them."""

import signal
from collections.abc import Mapping
from typing import Any

Event = Mapping[str, Any]


def how_it_ended(event: Event) -> str:
    """The description of a process that did not end by itself and in order, from its ``exit``."""
    code = event["code"]
    return f"{event['node']} " + (
        f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
    )


def ignore(event: Event) -> None:
    """Watch nothing."""
