# SPDX-License-Identifier: Apache-2.0
"""Time master role of the spindle: checks the cell, releases blocks by window and pace, publishes simulated time."""

import time
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any, cast

from lathe_rc_msgs.msg import Progress as ProgressMessage
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger

from lathe_rc import messages
from lathe_rc.blocks.latency_histogram import LATENCY, LATENESS, PERCENT
from lathe_rc.cell.parameters import Value
from lathe_rc.cell.time_master import TimeMaster, TimeMasterParameters
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import InputError, PaceError
from lathe_rc.nodes.cell_node import CellNode, from_ros
from lathe_rc.nodes.ports import latched_qos
from lathe_rc.nodes.simulation_services import SimulationServices
from lathe_rc.nodes.stage_role import StageRole
from lathe_rc.protocol import Announcement, Pace, Progress, Reactions, TimeMasterProtocol, actions
from lathe_rc.protocol.leading_run import LeadingRun

_JUDGED = 1.0  # simulated time after which the pace is evaluated [s]


def _per_block(table: TimeMasterParameters) -> float:
    """Return the wall time per block [s]; 0: no pace."""
    return table.block_size * table.step / table.speed_factor if table.speed_factor else 0.0


class SpindleRole(LeadingRun, StageRole):
    """Role of the time master; its stage is the spindle and its encoder."""

    stage: TimeMaster

    def __init__(self, node: CellNode) -> None:
        super().__init__(node)
        table = self.table = cast("TimeMasterParameters", node.table)
        self._check_pace(table)
        if table.start_from and not table.members:
            raise InputError(f"{node.get_name()}.start_from of a spindle that runs alone; allowed: with members")
        self.prepare()
        block = table.block_size * table.step
        self.pace = Pace(_per_block(table), table.window, round(_JUDGED / block))
        self._simulation: SimulationServices | None = None

    def _check_pace(self, table: TimeMasterParameters) -> None:
        if table.strict_pace and not table.speed_factor:
            raise InputError(
                f"{self.node.get_name()}.strict_pace with speed_factor = 0: there is no pace; allowed: a speed_factor "
                "above 0"
            )
        if table.members and not table.window and not table.speed_factor:
            raise InputError(
                f"{self.node.get_name()}.speed_factor = 0 with window = 0: nothing would hold the spindle back; "
                "allowed: a speed_factor above 0, or a window"
            )

    @property
    def tunable(self) -> tuple[str, ...]:
        """Return the parameters that may change in a run (extends `StageRole`)."""
        return (*super().tunable, "speed_factor")

    def tune(self, values: Mapping[str, Value]) -> str:
        """Change the pace of the run at once; it touches no sample (extends `StageRole`).

        Raises:
            InputError: nothing would hold the spindle back.
        """
        table = self.table.changed(self.node.get_name(), values)
        self._check_pace(table)
        self.table = table
        self.pace.change(_per_block(table), self.blocks, time.monotonic())
        self.node.next_tick = time.monotonic()
        return f"from block {self.blocks} on"

    def protocol(self, own: Announcement) -> TimeMasterProtocol:
        """Create and return the time master's protocol object (implements `Role`)."""
        table = self.table
        reactions = Reactions(
            stall_reaction=table.stall_reaction,
            stall_time=table.stall_time,
            restart_time=table.restart_time,
            safe_samples=max(1, round(table.safe_time * table.sample_rate)),
            block_size=table.block_size,
        )
        protocol = TimeMasterProtocol(own, table.window, reactions, first=self.samples)
        protocol.know_end(self.stage.samples)
        if table.simulation_services == "paused":
            protocol.held_at = 0
        return protocol

    def member_names(self) -> list[str]:
        """Return the names of all members, spindle included; empty if it runs alone (implements `Role`)."""
        if not self.table.members:
            return []
        others = (name if name.startswith("/") else self.node.namespace + name for name in self.table.members)
        return [self.node.full_name, *others]

    def activate(self) -> None:
        """Create the publishers, subscriptions and services of the time master (implements `Role`)."""
        super().activate()
        node = self.node
        self._clock_publisher = node.create_publisher(Clock, "/clock", QoSProfile(depth=10))
        node.subscribe(ProgressMessage, "progress", self._on_progress, latched_qos())
        node.create_service(Trigger, "~/end", self._on_end)
        if self.table.simulation_services:
            self._simulation = SimulationServices(node, self.leads, self.pace)

    def _on_end(self, _request: Any, response: Any) -> Any:
        """End the run with the next block."""
        leads = self.leads
        if leads.running and not leads.failure:
            self.node.attempt(leads.end_run, f"{self.node.full_name} was ended by its service", time.monotonic())
            response.success = True
            response.message = leads.cut or "the run ends with its safe state"
        else:
            response.message = "no run to end: it has not begun, or it is over"
        return response

    def _on_progress(self, data: bytes, sender: str) -> None:
        self.leads.hear_progress(from_ros("progress", data, ProgressMessage, Progress), time.monotonic(), sender)

    def statistics(self) -> dict[str, object]:
        """Return the time master's figures for the diagnostics (implements `Role`)."""
        leads, pace = self.leads, self.pace.figures()
        lateness = {f"lateness, {percent} % within [s]": late for percent, late in pace.within.items()} if pace else {}
        return {
            **super().statistics(),
            **lateness,
            **({"late blocks": pace.late, "worst lateness [s]": pace.worst} if pace else {}),
            **{f"latency, {percent} % within [s]": leads.latency.within(percent) for percent in PERCENT},
            "blocks in flight": self.blocks - leads.least,
            "slowest member": leads.slowest,
            "schedule slipped [s]": round(self.pace.slipped, 3),
            LATENESS: self.pace.lateness,
            LATENCY: leads.latency,
        }

    # ---- requests of the protocol -------------------------------------------------------------------

    def perform(self, action: actions.Action) -> None:
        """Perform an action of the time master's protocol (implements `Role`)."""
        match action:
            case actions.TellTime(samples):
                stamp = messages.header(max(samples - 1, 0), self.table.step_ns).stamp
                clock = Clock()
                clock.clock.sec, clock.clock.nanosec = stamp.sec, stamp.nanosec
                self._clock_publisher.publish(clock)
            case actions.TellPace():
                if figures := self.pace.figures():
                    self.node.reporter("pace", self.node.get_name(), **asdict(figures))
                    for line in () if self.node.reporter.attached else figures.lines():  # a harness prints them itself
                        self.node.get_logger().info(line)
            case _:
                super().perform(action)
        if self._simulation is not None:
            self._simulation.look()

    def failed(self) -> None:
        """Dissolve the chain, and answer a client that waits for a step (extends `StageRole`)."""
        super().failed()
        if self._simulation is not None:
            self._simulation.look()

    def check_cell(self) -> Cell:
        """Check the cell as before an offline run, with the members' actual parameters (implements `LeadingRun`)."""
        cell = Cell(*self.node.announced(self.leads.own.members))
        cell.check()
        for left_out in cell.unchecked:
            self.node.get_logger().warning(f"not checked: {left_out}")
        for warning in cell.warnings:
            self.node.get_logger().warning(warning)
        return cell

    # ---- pace ---------------------------------------------------------------------------------------

    def lags(self, lag: float) -> None:
        """Warn early that the members cannot hold the pace, and suggest a cheaper grouping with fewer processes."""
        text = f"the cell holds {1.0 - lag:.0%} of its pace; {self._remedy()}"
        self.node.get_logger().warning(text)
        self.node.reporter("behind", self.node.get_name(), message=text)

    def _remedy(self) -> str:
        """Name the slowest member, and a grouping with fewer processes if there is one."""
        members = self.leads.members.values()
        processes = {member.process for member in members}
        recorders = [member.name for member in members if not member.publishes]
        together = "+".join(m.name.rpartition("/")[2] for m in members if m.name not in recorders)
        cure = (
            f"--group {together}"
            if len(processes) > 1 + len(recorders)
            else "a smaller speed_factor, a larger block_size"
        )
        return f"{self.leads.slowest} is the slowest member; try {cure}"

    def fall_behind(self, late: float) -> None:
        """Postpone the schedule by ``late`` [s]: the members are too slow for the pace.

        Raises:
            PaceError: the pace is strict.
        """
        if self.table.strict_pace:
            raise PaceError(
                f"{self.node.get_name()}.strict_pace: block {self.blocks} is {late * 1e3:.3g} ms late; allowed: half a "
                f"window, {self.pace.most_late * 1e3:.3g} ms; {self._remedy()}"
            )
        super().fall_behind(late)

    def tick(self, now: float) -> float:
        """Release blocks that are due; return the time of the next call (implements `Role`)."""
        super().tick(now)
        due = self.release_due(now)
        if self._simulation is not None:
            self._simulation.tick(now)
        return min(due, self.node.next_tick)
