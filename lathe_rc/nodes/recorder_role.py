# SPDX-License-Identifier: Apache-2.0
"""Recorder role of a node: records every signal topic of the cell in one bag, sorted, complete and always closed."""

import json
import shutil
from collections.abc import Mapping
from functools import cache, partial
from pathlib import Path
from typing import Any, cast

import numpy as np
from rclpy.qos import QoSProfile
from std_srvs.srv import Trigger

from lathe_rc import messages
from lathe_rc.bag import loss, provenance
from lathe_rc.bag.snapshot import GONE_ON, SNAPSHOTS_GONE_ON, Snapshot
from lathe_rc.bag.writing.order import Merger
from lathe_rc.bag.writing.record import bag_of, split
from lathe_rc.bag.writing.snapshots import Snapshots
from lathe_rc.bag.writing.writer import FLUSH_PERIOD, Durability, MessageSink, offered_qos
from lathe_rc.blocks.block import Block
from lathe_rc.blocks.ports import signal_depth
from lathe_rc.blocks.wire import Decoder, Encoder
from lathe_rc.cell.host_topics import HOST_TOPICS
from lathe_rc.cell.parameters import Value
from lathe_rc.cell.recorder import RecorderParameters
from lathe_rc.cell.scenario import Scenario
from lathe_rc.errors import InputError, LatheError, LossyRunError
from lathe_rc.nodes import publisher_info
from lathe_rc.nodes.cell_node import CellNode, Role
from lathe_rc.nodes.ports import latched_qos, message_class
from lathe_rc.protocol import Announcement, ForeignMessage, MemberProtocol
from lathe_rc.protocol.block_queue import BlockQueue, explain_losses
from lathe_rc.protocol.exchange import JoinedBlocks
from lathe_rc.protocol.messages import check_sender

_HOST_TOPICS = {"/diagnostics": QoSProfile(depth=100), "cell_state": latched_qos(4)}
_OFFERED = {topic.name: topic for topic in HOST_TOPICS}


class RecorderRole(Role):
    """Role of the recorder; subscribes to the topics of all members, or without a cell to all announced topics.

    Args:
        node: node that has this role.

    Attributes:
        whole: bag of a complete run that is closed; None before.
    """

    def __init__(self, node: CellNode) -> None:
        self.node = node
        self.whole: Path | None = None
        self.table = cast("RecorderParameters", node.table)
        self._path = self.table.folder
        self._snapshots: Snapshots | None = None
        if self.table.mode != "continuous":
            place, namespace = self.table.snapshots_of(self._path), node.namespace
            self._snapshots = Snapshots(
                place, self.table, name=node.get_name(), namespace=namespace, told=self._tell_snapshot
            )
        self._writer: MessageSink | None = bag_of(self._path, self.table, self._snapshots)
        self._depth = signal_depth(self.table.window)
        self._queues: dict[str, BlockQueue] = {}
        self._sparse: dict[str, str] = {}  # topic -> source
        self._processes: dict[str, int] = {}  # process number of the members that can be restarted
        self._joints: dict[str, tuple[int, set[int]]] = {}  # period, and samples of waiting messages, by topic
        self._newest: dict[str, bytes] = {}  # newest message of each topic from another process
        self._encoder = cache(Encoder)  # by message type, run, source and step [ns]
        self._merger: Merger | None = None
        self._first = self._blocks = self._samples = self._sound = 0
        self._log_ns = messages.START_NS
        self._flush_due = 0.0

    def protocol(self, own: Announcement) -> MemberProtocol:
        """Return the node's protocol object; it is wired after the subscriptions are created (implements `Role`)."""
        return MemberProtocol(own, self.table.window, wired=False)

    @property
    def tunable(self) -> tuple[str, ...]:
        """Return the parameters that may change in a run (implements `Role`)."""
        return () if self.table.mode == "snapshot" else ("split_duration",)

    def tune(self, values: Mapping[str, Value]) -> str:
        """Change the length of the bag's files (implements `Role`).

        Raises:
            InputError: the bag is closed.
        """
        if self._writer is None:
            raise InputError(f"{self.node.full_name}: bag {self._path} is closed")
        split(self._writer, float(cast("float", values["split_duration"])))
        return "from the next message on"

    def begin(self, *, joins: bool) -> None:
        """Prepare for block 0 (implements `Role`).

        Raises:
            LatheError: the cell is running already, and its first blocks are lost.
        """
        if joins:
            raise LatheError(
                f"{self.node.full_name}: the cell is running already; start a recorder before it, or use lathe record"
            )

    def activate(self) -> None:
        """Create the snapshot service and subscribe to the host topics; signal topics follow when announced."""
        self.node.create_service(Trigger, "~/snapshot", self._on_snapshot)
        for topic, qos in _HOST_TOPICS.items():
            full, offered = self.node.topic(topic), _OFFERED[topic]
            durability = cast("Durability", offered.durability.replace(" ", "_"))
            self._open.add_topic(full, offered.type, offered_qos(offered.depth, durability))
            self.node.subscribe(message_class(offered.type), full, partial(self._on_host, offered.type, full), qos)

    def clean_up(self) -> None:
        """Reset the role; the bag of a cell that did not begin holds no block and is removed (implements `Role`)."""
        self.finish()
        if not self._blocks and self._path.is_dir():
            shutil.rmtree(self._path)
            self.node.get_logger().info(f"bag {self._path} removed: no block has come")

    @property
    def _open(self) -> MessageSink:
        assert self._writer is not None, "the bag is closed"
        return self._writer

    def _on_host(self, msgtype: str, topic: str, data: bytes, sender: str) -> None:
        if self._writer is None:
            return
        try:
            told = messages.decode(msgtype, data)
        except ValueError:
            return
        # All cells of a domain share /diagnostics.
        if msgtype == messages.CELL_STATE:
            ours = told.run_id == self.table.run_id and self._is_master(sender)
        else:
            ours = sender in self.node.protocol.members and {status.name for status in told.status} == {sender}
        if ours:
            self._open.write(topic, self._log_ns, data)

    def _is_master(self, name: str) -> bool:
        master = self.node.protocol.master
        return master is None or name in ("", master.name)

    def subscriptions(self) -> list[str]:
        """Return all signal topics of the members."""
        return [*self._queues, *self._sparse]

    def statistics(self) -> dict[str, object]:
        """Return the recorder's figures for the diagnostics (implements `Role`)."""
        told: dict[str, object] = {"blocks": self._blocks, "lost blocks": self._lost, "bag": str(self._path)}
        if self._snapshots is not None:
            told |= {"snapshots": self._snapshots.bags, "memory for snapshots [B]": self._snapshots.held}
        return told

    @property
    def _lost(self) -> int:
        return sum(queue.lost for queue in self._queues.values())

    # ---- topics -------------------------------------------------------------------------------------

    def members_changed(self) -> None:
        """Subscribe once all members are known; with a spindle that runs alone, to every announced topic."""
        members = self.node.protocol.members
        for name, pid in self._processes.items():
            if self._merger is not None and members[name].pid != pid:
                self._processes[name] = members[name].pid
                self._merger.restarted(name)
        alone = self.node.protocol.alone
        if not alone and (self._queues or not self.node.protocol.complete):
            return
        before = len(self._queues) + len(self._sparse)
        for name in self.node.protocol.names:
            member = members[name]
            for topic, msgtype, sparse in zip(member.publishes, member.types, member.sparse, strict=True):
                if topic not in self._queues and topic not in self._sparse:
                    self._subscribe(topic, msgtype, name, sparse=sparse, in_cell=not alone)
        if len(self._queues) + len(self._sparse) == before:
            return
        self._explain()
        if begun := self.node.begun():
            if self._snapshots is not None:
                raise InputError(f"{self.node.get_name()}.mode: {SNAPSHOTS_GONE_ON}")
            self._first = self._samples = begun.sample
            self._open.tell({GONE_ON: str(self._first)})
        dense = {topic: (queue.type, queue.source) for topic, queue in self._queues.items()}
        if self._snapshots is not None and dense:
            self._prepare(self._snapshots, dense)
        restarts = self.node.protocol.restarts
        self._processes = {name: member.pid for name, member in members.items() if restarts(name)}
        if not alone and self.table.window:
            self._merger = Merger(
                self._open,
                dense,
                self._sparse,
                run_id=self.table.run_id,
                step_ns=self.table.step_ns,
                samples=self.table.block_size,
                first=self._first,
            )
        self.node.describe(subscribes=tuple(self.subscriptions()))

    def _prepare(self, snapshots: Snapshots, dense: dict[str, tuple[str, str]]) -> None:
        names = [name.removeprefix(self.node.namespace) for name in self.node.protocol.members]
        needed = snapshots.prepare(dense, names)
        self.node.get_logger().info(f"snapshots: up to {needed} B of memory, bags in {snapshots.folder}")

    def _explain(self) -> None:
        """Store the scenario in the bag, with the parameters that the members announce."""
        tables, _ = self.node.announced(self.node.protocol.names)
        if tables:
            host = [self.node.topic(topic) for topic in _HOST_TOPICS]
            self._open.tell(provenance.tell(Scenario(self.table.run_id or "cell", tables), host))

    def _subscribe(self, topic: str, msgtype: str, source: str, *, sparse: bool, in_cell: bool) -> None:
        assumed = offered_qos(self._depth, "transient_local")
        qos = publisher_info.offered_or(assumed, self.node.get_publishers_info_by_topic(topic))
        self._open.add_topic(topic, msgtype, qos)
        if sparse:
            self._sparse[topic] = source
            period = self.node.protocol.parameter(source, "joint_state_period")
            self._joints[topic] = period if isinstance(period, int) else self.table.joint_state_period, set()
            self.node.listen(
                topic, msgtype, partial(self._on_message_at, topic, msgtype), partial(self._on_sparse, topic)
            )
            return
        queue = self._queues[topic] = BlockQueue(topic, msgtype, self.table, [])
        queue.run_end = lambda: self.node.protocol.end
        begun = self.node.begun()
        queue.expect(source, (begun.sample if begun else 0) if in_cell else None)
        queue.repeats = in_cell and self.node.protocol.restarts(source)
        self.node.listen(topic, msgtype, partial(self._on_message, queue), partial(self._on_run, queue))

    def lose(self, lost: frozenset[str], first: int, end: int, *, again: bool) -> None:
        """Hold the newest samples of lost members; the bag records from which sample (implements `Role`)."""
        assert self._merger is not None, "only a cell with a window has a safe state"
        held: dict[str, int] = {}
        for topic, queue in self._queues.items():
            if queue.source in lost and queue.held_from is None:
                data = self._newest.get(topic)
                queue.hold_newest(end, Decoder(queue.type).decode(data) if data else None)
            if queue.held_from is not None and queue.held_from < end:
                held[topic] = queue.held_from
        if self._snapshots is not None and not again:
            self._snapshots.trigger(f"cell: lost {', '.join(sorted(lost))}", first)
        # Other readers may have received fewer of a lost member's last blocks, but all that precede the window. Without
        # a lost member, the time master has lost its encoder.
        sound = max(first - self.table.window * self.table.block_size, 0) if lost else first
        self._sound = min([sound, *held.values(), *([self._sound] if again else [])])
        self._open.tell({loss.HELD: json.dumps(held), loss.SOUND: str(self._sound)})
        self._merger.forget(lost)
        for topic, queue in self._queues.items():
            while queue.blocks:
                self._merger.add_block(topic, queue.blocks.popleft())
        self._drain()

    # ---- snapshots ----------------------------------------------------------------------------------

    def _tell_snapshot(self, snapshot: Snapshot) -> None:
        """Report that a snapshot was begun or closed."""
        sample, cause = snapshot.triggers[0]
        span = f"samples {snapshot.first} to {snapshot.first + snapshot.samples - 1}"
        if not snapshot.samples:
            text = f"snapshot {snapshot.path} begun: {cause} at sample {sample}"
        elif snapshot.whole:
            text = f"snapshot {snapshot.path} closed: {span}"
        else:
            text = f"snapshot {snapshot.path} closed: {span}; wanted up to {snapshot.wanted}, the run ended before"
        self.node.get_logger().info(text)
        self.node.reporter(
            "snapshot",
            self.node.get_name(),
            bag=str(snapshot.path),
            sample=sample,
            first=snapshot.first,
            samples=snapshot.samples,
            whole=snapshot.whole,
        )

    def _on_snapshot(self, request: Any, response: Any) -> Any:
        if self._snapshots is None:
            response.message = f"{self.node.get_name()}.mode = 'continuous'; allowed for snapshots: snapshot or both"
        elif self._writer is None or self.node.protocol.failure or not self._queues:
            response.message = "nothing is being recorded: the cell has not started, or it has ended"
        else:
            sample = self._snapshots.next_sample
            try:
                found = self._snapshots.trigger(f"{self.node.get_name()}: service", sample)
            except LatheError as error:
                self.node.fail(error)
                response.message = str(error)
                return response
            response.success, response.message = True, f"sample {sample}: {found.path}"
        return response

    # ---- data ---------------------------------------------------------------------------------------

    def tick(self, now: float) -> float:
        """Flush the bag periodically, so that a crash loses a bounded time (implements `Role`)."""
        queues = self._queues.values()
        for queue in queues:
            queue.end_with(queues, now)
        if self._merger is None and self._all_ended:
            self.node.attempt(self._end_unsorted, max(queue.end for queue in queues))
        if self._writer is not None and now >= self._flush_due:
            self._flush_due = now + FLUSH_PERIOD
            self._tell_gaps()
            self.node.attempt(self._writer.flush)
        return self._flush_due

    def _on_message_at(self, topic: str, msgtype: str, data: bytes, sender: str) -> None:
        """Check and record a message at a chosen sample from a node in another process."""
        try:
            message = messages.decode(msgtype, data)
        except ValueError as error:
            raise ForeignMessage(topic, "", "", str(error)) from None
        # Messages of types outside lathe_rc do not name their sender.
        source, run_id = getattr(message, "source", self._sparse[topic]), getattr(message, "run_id", self.table.run_id)
        if source != self._sparse[topic] or (self.table.run_id and run_id != self.table.run_id):
            raise ForeignMessage(topic, source, run_id, f"expected {self._sparse[topic]} of run {self.table.run_id!r}")
        check_sender(topic, source, run_id, sender)
        sample, rest = divmod(messages.stamp_ns(message) - messages.START_NS, self.table.step_ns)
        begin = self._first + (self._merger.samples if self._merger else 0)
        end = begin + self._depth * self.table.block_size if self._merger else sample + 1
        if sample < begin and source in self._processes:
            return  # repeated by a process that resumes in place of the first
        if rest or not begin <= sample < end:
            raise ForeignMessage(topic, source, run_id, f"expected a time of samples {begin} to {end - 1}")
        if msgtype == messages.JOINTS and self._merger is not None:
            self._expect_joints(topic, sample, begin)
        self._on_sparse(topic, data)

    def _expect_joints(self, topic: str, sample: int, begin: int) -> None:
        """Reject unexpected joint states: they name no sender, but one is due per period."""
        period, waiting = self._joints[topic]
        waiting -= {other for other in waiting if other < begin}
        if sample % period or sample in waiting:
            expected = f"expected one at every sample that is a multiple of {period}"
            raise ForeignMessage(topic, self._sparse[topic], self.table.run_id, expected)
        waiting.add(sample)

    def _on_sparse(self, topic: str, data: bytes) -> None:
        if self.node.protocol.over:
            return
        stamp = messages.stamp_of(data)
        if self._merger is None:
            self._write(stamp, topic, data)
        else:
            self._merger.add_sparse(topic, stamp, data)

    def _on_message(self, queue: BlockQueue, data: bytes, sender: str) -> None:
        """Record a block from a node in another process."""
        if self.node.protocol.over:
            return
        block = queue.add(data, sender)
        if block is None:
            return
        self._newest[queue.topic] = data = queue.message
        queue.blocks.clear()
        if self._merger is None:
            self._write_unsorted(queue, block, data)
        else:
            self._merger.add_block(queue.topic, block, data)

    def _on_run(self, queue: BlockQueue, run: JoinedBlocks) -> None:
        """Record blocks from a node in this process; their messages at chosen samples have arrived before."""
        if self.node.protocol.over:
            return
        queue.take(run)
        queue.blocks.clear()
        whole = run.block
        if self._merger is not None:
            if len(run.companions) == 1:
                self._merger.add_block(queue.topic, whole)
            else:
                numbers = np.array(run.companions)
                self._merger.add_blocks(queue.topic, whole.first_index, whole.signals, numbers, last=whole.last)
            return
        encoder = self._encoder(queue.type, whole.run_id, whole.source, whole.step_ns)
        for block in run.blocks(self.table.block_size):
            first, last, companions = block.first_index, block.last, block.companions
            _, data = encoder.encode(first, block.signals, last=last, companions=companions)
            self._write_unsorted(queue, block, data)

    def _write_unsorted(self, queue: BlockQueue, block: Block, data: bytes) -> None:
        """Write a block of a free-running cell in order of arrival: blocks may be missing, so sorting cannot wait."""
        self._write(block.log_ns, queue.topic, data)
        if block.last:
            self._end_unsorted(block.first_index + block.samples)

    @property
    def _all_ended(self) -> bool:
        return bool(self._queues) and all(queue.ended for queue in self._queues.values())

    def _end_unsorted(self, end: int) -> None:
        """Finish once all topics of a free-running cell have ended before sample ``end``."""
        if self._all_ended and not self.node.protocol.over:
            self._samples = end
            self._blocks = -(-self._samples // self.table.block_size)
            self._complete()

    def _tell_gaps(self) -> None:
        """Store in the bag from which sample on blocks of each topic were lost."""
        gaps = {topic: queue.lost_from for topic, queue in self._queues.items() if queue.lost_from is not None}
        if gaps:
            self._open.tell({loss.GAPS: json.dumps(gaps)})

    def _complete(self) -> None:
        """Finish after the last block of every topic is written."""
        self.node.reporter("complete", self.node.get_name(), blocks=self._blocks)
        self.finish()
        self.node.completed(self._blocks, self._samples, last=True)
        self.node.complete_part()

    def work(self) -> None:
        """Write the blocks that are complete on all topics (implements `Role`)."""
        if self._merger is not None and self._merger.ready and not self.node.protocol.over:
            self._drain()

    def _drain(self) -> None:
        assert self._merger is not None
        self._merger.release()
        self._log_ns, self._blocks = self._merger.log_ns, self._merger.rows
        self._samples = self._first + self._merger.samples
        if self._merger.complete:
            self._complete()
        else:
            self.node.completed(self._blocks, self._samples, last=False)

    def _write(self, log_ns: int, topic: str, data: bytes) -> None:
        self._open.write(topic, log_ns, data)
        self._log_ns = max(self._log_ns, log_ns)

    def finish(self) -> None:
        """Write the remaining data and close the bag."""
        if self._writer is None:
            return
        self._tell_gaps()
        complete = bool(self._queues) and self._merger.complete if self._merger else self._all_ended
        if self._snapshots is not None and (self.node.protocol.cut or not complete):
            why = self.node.protocol.failure or self.node.protocol.cut or "interrupted"
            cause = f"{self.node.get_name()}: {why}"
            self.node.attempt(self._snapshots.interrupt, cause)
        if self._merger is not None:
            self.node.attempt(self._merger.write_rest)
        try:
            self.node.attempt(self._open.close)
        except OSError as error:
            self.node.fail(LatheError(f"{self._path}: cannot be closed ({error.strerror})"))
        finally:
            self._writer = None
        complete = complete and not self.node.protocol.failure
        self.whole = self._path if complete and not self._lost and self.table.mode != "snapshot" else None
        whole = "complete" if complete else "interrupted"
        if complete and self.node.protocol.safe:
            whole = "to the end of the safe state; what lost members published is held"
        self.node.get_logger().info(f"bag {self._path} closed: {self._blocks} blocks, {whole}")
        self.node.reporter("closed", self.node.get_name(), bag=str(self._path), blocks=self._blocks, complete=complete)
        if losses := explain_losses(self.node.full_name, self._queues.values()):
            self.node.fail(LossyRunError(losses))
