# SPDX-License-Identifier: Apache-2.0
"""What every member of a cell does, in plain rclpy; docs/foreign_nodes.md says why."""

import os
from pathlib import Path

import rclpy
from lathe_rc_msgs.msg import CellState, Member, Progress
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import Empty


def latched(depth):
    return QoSProfile(depth=depth, durability=DurabilityPolicy.TRANSIENT_LOCAL)  # reliable, as all are by default


class CellMember(Node):
    """A node that joins, computes what its blocks allow, and leaves with the cell."""

    def __init__(self, name, stage):
        super().__init__(name)
        run_id, self.window = (self.declare_parameter(*each).value for each in (("run_id", ""), ("window", 64)))
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
        host = f"{boot} {Path('/proc/self/ns/pid').stat().st_ino}"
        name = self.get_fully_qualified_name()
        self.me = Member(run_id=run_id, name=name, stage=stage, parameters="{}", host=host, pid=os.getpid())
        self.so_far = Progress(run_id=run_id, name=name)
        self.states, self.named, self.done = {}, [], rclpy.task.Future()
        self.create_publisher(Empty, "~/alive", QoSProfile(depth=1, liveliness_lease_duration=Duration(seconds=0.08)))
        self.announcements = self.create_publisher(Member, "members", latched(1))
        self.progress = self.create_publisher(Progress, "progress", latched(1))
        self.create_subscription(Member, "members", self.on_member, latched(256))
        self.create_subscription(CellState, "cell_state", self.on_cell_state, latched(1))

    def reads(self, kind, topic, callback):
        """Let a callback have the blocks of a topic, of this run and one after the other; it returns their length."""
        end = 0

        def take(message):
            nonlocal end
            if message.block.run_id != self.me.run_id or self.me.state == Member.FAILED:
                return
            if message.block.first_index < end:
                return  # a controller that was killed and goes on sends some blocks once more
            if message.block.first_index == end:
                end += callback(message)
            else:
                self.announce(Member.FAILED, f"{topic} goes from sample {end} to {message.block.first_index}")

        self.me.subscribes.append(self.create_subscription(kind, topic, take, latched(3 * self.window + 32)).topic_name)

    def publishes(self, kind, topic):
        """A publisher of blocks."""
        publisher = self.create_publisher(kind, topic, latched(3 * self.window + 32))
        self.me.publishes.append(publisher.topic_name)
        self.me.types.append(f"lathe_rc_msgs/msg/{kind.__name__}")
        self.me.sparse.append(False)
        return publisher

    def beside(self, kind, block):
        """A block of this node for the samples of another block."""
        made = kind(header=block.header, block=block.block)
        made.block.source, made.block.companions = self.me.name, 0
        return made

    def completed(self, block, samples):
        """Tell the time master, at the same blocks as all others."""
        self.so_far.blocks, self.so_far.samples = self.so_far.blocks + 1, self.so_far.samples + samples
        if block.block.last or self.so_far.blocks % max(1, self.window // 4) == 0:
            self.progress.publish(self.so_far)

    def announce(self, state, why=""):
        self.me.state, self.me.message = state, why
        self.announcements.publish(self.me)

    def on_member(self, member):
        if member.run_id == self.me.run_id:
            self.states[member.name], self.named = member.state, member.members or self.named
        if self.me.state == Member.WIRED and self.named and all(self.states.get(name) for name in self.named):
            self.announce(Member.READY)  # all have joined: JOINING is 0

    def on_cell_state(self, cell):
        if cell.run_id == self.me.run_id and cell.state == CellState.SAFE:
            self.announce(Member.FAILED, f"cannot go on without {', '.join(cell.lost)}")
        if cell.run_id == self.me.run_id and cell.state in (CellState.ENDED, CellState.FAILED):
            self.done.set_result(int(cell.state == CellState.FAILED or self.me.state == Member.FAILED))


def run(make):
    """Run a member until its cell has ended; exit code 1 if that failed."""
    rclpy.init()
    member = make()
    member.announce(Member.WIRED)
    rclpy.spin_until_future_complete(member, member.done)
    raise SystemExit(member.done.result())
