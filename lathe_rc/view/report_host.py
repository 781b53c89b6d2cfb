# SPDX-License-Identifier: Apache-2.0
"""Recorded host topics: state of the nodes, and lateness of the cell."""

import math
from array import array
from dataclasses import dataclass, field
from typing import Any

from lathe_rc import messages
from lathe_rc.blocks.latency_histogram import LATENCY, LATENESS, Durations

DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
TYPES = frozenset({DIAGNOSTICS, messages.CELL_STATE})

_STATES = ("waiting", "running", "ended", "failed", "safe")
_FAILED, _SAFE = 3, 4
_ERROR = 2  # level of an error status
_MOST_NODES = 128
_MOST_LINES = 50
_MOST_VALUES = 64  # largest number of values kept from a status


@dataclass
class Node:
    """Newest reported state of a node.

    Attributes:
        reports: number of reports.
        level: worst level.
        message: last message.
        values: last values.
    """

    reports: int = 0
    level: int = 0
    message: str = ""
    values: dict[str, str] = field(default_factory=dict)


class Host:
    """State of the nodes and timing of the cell, from the messages of host topics.

    Attributes:
        nodes: state of each node, by name.
        states: lines for the cell states that the time master declared.
        errors: lines for failures.
        unreadable: number of messages that could not be decoded.
        left_out: number of nodes, states and errors beyond the limits.
        pace: samples per wall time between two reports of the time master [1/s].
        lateness, latency: lateness and latency of blocks in the last report of each time master, by its name.
    """

    def __init__(self) -> None:
        self.nodes: dict[str, Node] = {}
        self.states: list[str] = []
        self.errors: list[str] = []
        self.unreadable = self.left_out = 0
        self.pace = array("d")
        self.lateness: dict[str, Durations] = {}
        self.latency: dict[str, Durations] = {}
        self._marks: dict[str, tuple[float, float, float]] = {}  # wall time [s], blocks and samples of the last report

    def add(self, msgtype: str, data: bytes) -> None:
        """Add a message of one of `TYPES`."""
        try:
            message = messages.decode(msgtype, data)
        except ValueError:
            self.unreadable += 1
            return
        if msgtype == messages.CELL_STATE:
            self._state(message)
            return
        for status in message.status:
            self._status(messages.stamp_ns(message) * 1e-9, status)

    def _append(self, lines: list[str], text: str) -> None:
        """Append a line unless it repeats the last line or the list is full."""
        if text in lines[-1:]:
            return
        if len(lines) < _MOST_LINES:
            lines.append(text)
        else:
            self.left_out += 1

    def _state(self, message: Any) -> None:
        named = _STATES[message.state] if message.state < len(_STATES) else f"state {message.state}"
        text = f"{named} from sample {message.first_index}" + (f": {message.message}" if message.message else "")
        self._append(self.states, text)
        failures = {_SAFE: "safe state from sample {} on: {}", _FAILED: "the cell failed at sample {}: {}"}
        if failure := failures.get(message.state):
            self._append(self.errors, failure.format(message.first_index, message.message))

    def _status(self, wall: float, status: Any) -> None:
        if status.name not in self.nodes and len(self.nodes) >= _MOST_NODES:
            self.left_out += 1
            return
        node = self.nodes.setdefault(status.name, Node())
        # A byte in ROS: an int in rosbags, bytes of length 1 in rclpy.
        level = status.level if isinstance(status.level, int) else int.from_bytes(bytes(status.level), "little")
        node.reports += 1
        node.level = max(node.level, level)
        node.message = status.message
        node.values = {pair.key: pair.value for pair in status.values[:_MOST_VALUES]}
        if level >= _ERROR:
            self._append(self.errors, f"{status.name}: {status.message}")
        self._compare_reports(status.name, wall, node.values)

    def _compare_reports(self, name: str, wall: float, values: dict[str, str]) -> None:
        """Compute the pace from two consecutive reports of the time master."""
        if "schedule slipped [s]" not in values:
            return  # report of another node
        try:
            blocks, samples = (float(values[key]) for key in ("blocks", "samples"))
            durations = [Durations.parse(values.get(key, "")) for key in (LATENESS, LATENCY)]
        except (KeyError, ValueError):
            return
        self.lateness[name], self.latency[name] = durations
        began, done, turned = self._marks.get(name, (wall, 0.0, 0.0))
        self._marks[name] = wall, blocks, samples
        if done and wall > began and blocks > done:  # the cell was running throughout the interval
            pace = (samples - turned) / (wall - began)
            if math.isfinite(pace):
                self.pace.append(pace)

    @property
    def lost_blocks(self) -> dict[str, int]:
        """Return the number of lost blocks by node, omitting nodes that lost none."""
        counts = {name: node.values.get("lost blocks", "0") for name, node in self.nodes.items()}
        return {name: int(count) for name, count in counts.items() if count.isdecimal() and count.strip("0")}
