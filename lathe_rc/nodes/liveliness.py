# SPDX-License-Identifier: Apache-2.0
"""Whether other nodes are alive: what DDS hears of them, and whether their processes have ended.

DDS asserts a node's liveliness from a thread of its own, whatever the node computes. It cannot tell a process that has
died from one that is stopped; where the process is on this machine, the operating system can.

Fast DDS may go on taking a writer for alive that says nothing any more: if a sign of life comes at the moment at which
its lease has run out, the timer of the lease is not started again, and only a further sign would start it. So a process
on this machine that is stopped is silent, whatever DDS says.
"""

import os
import select
import time
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any

from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.lifecycle import LifecycleNode
from rclpy.qos import LivelinessPolicy, QoSProfile
from std_msgs.msg import Empty

from lathe_rc.messages import ALIVE
from lathe_rc.protocol import SILENCE, Announcement


@cache
def this_host() -> str:
    """An identity that processes share if they see each other's numbers: the boot of a machine, and the name space."""
    boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    return f"{boot} {Path('/proc/self/ns/pid').stat().st_ino}"


def _is_stopped(pid: int) -> bool:
    """Whether a process of this machine has been stopped by a signal."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8")
    except OSError:
        return False  # it has ended
    return stat.rpartition(") ")[2][:1] in ("T", "t")


def liveliness() -> QoSProfile:
    """Of the topic `lathe_rc.messages.ALIVE`."""
    return QoSProfile(
        depth=1, liveliness=LivelinessPolicy.AUTOMATIC, liveliness_lease_duration=Duration(seconds=SILENCE)
    )


class Watch:
    """Watches members of the cell in other processes.

    Args:
        node: that watches.
        told: called when a member has become silent, or is heard again.

    Attributes:
        silent: since when a member is not heard any more, or stopped [s], monotonic, by fully qualified name.
    """

    def __init__(self, node: LifecycleNode, told: Callable[[], None]) -> None:
        self._node, self._told, self._host = node, told, this_host()
        self._pids: dict[str, int] = {}
        self._processes: dict[str, int] = {}  # file descriptors by member
        self._unheard: set[str] = set()  # by DDS
        self.silent: dict[str, float] = {}

    def follow(self, member: Announcement) -> None:
        """Watch a member from now on; if it announces itself from another process, that one."""
        if (member.pid == os.getpid() and member.host == self._host) or self._pids.get(member.name) == member.pid:
            return
        if member.name not in self._pids:
            self._node.create_subscription(
                Empty,
                f"{member.name}/{ALIVE}",
                lambda _: None,
                liveliness(),
                event_callbacks=SubscriptionEventCallbacks(liveliness=partial(self._changed, member.name)),
            )
        self._pids[member.name] = member.pid
        if member.name in self._processes:
            os.close(self._processes.pop(member.name))
        if member.host == self._host:
            try:
                self._processes[member.name] = os.pidfd_open(member.pid)
            except ProcessLookupError:
                self._processes[member.name] = os.open(os.devnull, os.O_RDONLY)  # always readable: it has ended
            except (OSError, OverflowError) as error:  # no process has such a number, or none may be watched
                self._node.get_logger().warning(f"{member.name}: its process {member.pid} is not watched ({error})")

    def close(self) -> None:
        """Watch nobody any more; the node destroys its subscriptions itself."""
        while self._processes:
            os.close(self._processes.popitem()[1])

    def _changed(self, name: str, status: Any) -> None:
        before = name in self.silent
        if status.alive_count:
            self._unheard.discard(name)
        elif status.not_alive_count:
            self._unheard.add(name)
        self.look()
        if before != (name in self.silent):
            self._told()

    def look(self) -> None:
        """See who is silent."""
        silent = self._unheard | {name for name in self._processes if _is_stopped(self._pids[name])}
        self.silent = {name: self.silent.get(name, time.monotonic()) for name in silent}

    def ended(self) -> set[str]:
        """Members whose process, on this machine, has ended."""
        if not self._processes:
            return set()
        poll = select.poll()
        names = {}
        for name, process in self._processes.items():
            poll.register(process, select.POLLIN)
            names[process] = name
        return {names[process] for process, _ in poll.poll(0)}
