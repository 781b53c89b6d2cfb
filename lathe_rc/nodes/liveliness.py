# SPDX-License-Identifier: Apache-2.0
"""Liveliness of other nodes: DDS liveliness, and the state of their processes on this machine.

DDS asserts a node's liveliness from a separate thread, whatever the node computes. It cannot distinguish a dead process
from a stopped one; for processes on this machine, the operating system can.

Fast DDS may report a silent writer as alive: if an assertion arrives at the moment at which the lease expires, the
lease timer is not restarted, and only a further assertion would restart it. So a stopped process on this machine
counts as silent, whatever DDS reports.

DDS's state is polled; an event of a changed liveliness can deadlock a node (see `lathe_rc.nodes.graph.unfit`).
"""

import os
import select
import time
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any

from rclpy.duration import Duration
from rclpy.event_handler import QoSSubscriptionEventType, SubscriptionEventCallbacks
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNode
from rclpy.qos import LivelinessPolicy, QoSProfile
from std_msgs.msg import Empty

from lathe_rc.messages import ALIVE
from lathe_rc.protocol import SILENCE, Announcement


@cache
def this_host() -> str:
    """Return an identity shared by processes that see each other's process numbers: boot id and PID name space."""
    boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    return f"{boot} {Path('/proc/self/ns/pid').stat().st_ino}"


def _is_stopped(pid: int) -> bool:
    """Return True if a process of this machine has been stopped by a signal."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8")
    except OSError:
        return False  # the process has ended
    return stat.rpartition(") ")[2][:1] in ("T", "t")


def liveliness() -> QoSProfile:
    """Return the QoS of the topic `lathe_rc.messages.ALIVE`."""
    return QoSProfile(
        depth=1, liveliness=LivelinessPolicy.AUTOMATIC, liveliness_lease_duration=Duration(seconds=SILENCE)
    )


def has_ended(member: Announcement) -> bool:
    """Return True if the process of an announcement is known to have ended; False for those of other machines."""
    if member.host != this_host():
        return False
    try:
        process = os.pidfd_open(member.pid)
    except ProcessLookupError:
        return True
    except (OSError, OverflowError):  # no process number
        return False
    try:
        return bool(_readable([process]))
    finally:
        os.close(process)


def _readable(processes: Iterable[int]) -> set[int]:
    """Return those of the process descriptors whose process has ended."""
    poll = select.poll()  # select.select refuses descriptors from 1024 on
    for process in processes:
        poll.register(process, select.POLLIN)
    return {process for process, _ in poll.poll(0)}


def _is_silent(signs: Any) -> bool:
    """Return True if DDS has heard of a member, and its lease has run out."""
    with signs:
        status = signs.take_event()
    return bool(status and status.not_alive_count and not status.alive_count)


class Watch:
    """Monitor of the liveliness of cell members in other processes.

    Args:
        node: node that monitors the members.

    Attributes:
        silent: monotonic time since which a member is silent or stopped [s], by fully qualified name.
    """

    def __init__(self, node: LifecycleNode) -> None:
        self._node, self._host = node, this_host()
        self._pids: dict[str, int] = {}
        self._processes: dict[str, int] = {}  # file descriptors by member
        self._signs: dict[str, Any] = {}  # liveliness by member, as DDS has it
        self.silent: dict[str, float] = {}

    def follow(self, member: Announcement, *, by_liveliness: bool = True) -> None:
        """Monitor a member; after an announcement from another process, monitor that process."""
        if (member.pid == os.getpid() and member.host == self._host) or self._pids.get(member.name) == member.pid:
            return
        if by_liveliness and member.name not in self._pids:
            none = SubscriptionEventCallbacks(use_default_callbacks=False)
            signs = self._node.create_subscription(
                Empty, f"{member.name}/{ALIVE}", lambda _: None, liveliness(), event_callbacks=none
            )
            changed = QoSSubscriptionEventType.RCL_SUBSCRIPTION_LIVELINESS_CHANGED
            with signs.handle:
                self._signs[member.name] = rclpy_implementation.EventHandle(signs.handle, changed)
        self._pids[member.name] = member.pid
        if member.name in self._processes:
            os.close(self._processes.pop(member.name))
        if member.host == self._host:
            try:
                self._processes[member.name] = os.pidfd_open(member.pid)
            except ProcessLookupError:
                self._processes[member.name] = os.open(os.devnull, os.O_RDONLY)  # always readable: it has ended
            except (OSError, OverflowError) as error:  # no such process, or no permission to monitor it
                self._node.get_logger().warning(f"{member.name}: its process {member.pid} is not watched ({error})")

    def close(self) -> None:
        """Stop the monitoring; the node destroys its subscriptions itself."""
        while self._signs:
            self._signs.popitem()[1].destroy_when_not_in_use()
        while self._processes:
            os.close(self._processes.popitem()[1])

    def look(self) -> None:
        """Update the set of silent members."""
        silent = {name for name in self._processes if _is_stopped(self._pids[name])}
        silent |= {name for name, signs in self._signs.items() if _is_silent(signs)}
        self.silent = {name: self.silent.get(name, time.monotonic()) for name in silent}

    def ended(self) -> set[str]:
        """Return the members whose process on this machine has ended."""
        if not self._processes:
            return set()
        ended = _readable(self._processes.values())
        return {name for name, process in self._processes.items() if process in ended}
