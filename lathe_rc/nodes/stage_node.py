# SPDX-License-Identifier: Apache-2.0
"""A stage as a ROS node."""

from bisect import bisect_left
from collections import deque
from collections.abc import Callable, Collection, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from lathe_rc_msgs.srv import Schedule

from lathe_rc import messages
from lathe_rc.bag.writing.record import signal_depth
from lathe_rc.cell import state_file
from lathe_rc.cell.framing import Framer
from lathe_rc.cell.stage import Input, Sparse, Stage, compile_kernels
from lathe_rc.cell.stages import MASTERS, STAGES
from lathe_rc.cell.track import Track, longest_delays
from lathe_rc.cell.wire import Block, Encoder, Pool
from lathe_rc.errors import InputError, LatheError, LossyRunError
from lathe_rc.messages import Samples, Signals
from lathe_rc.nodes.exchange import Run
from lathe_rc.nodes.ports import BlockQueue, message_class, signal_qos
from lathe_rc.nodes.shell import CellNode

_EARLY = 4  # times the blocks in flight are kept until it is known where to go on
_TOGETHER = 2  # parts of the window: so much is computed in one go, and members still work side by side
_OUTSIDE_PERIOD = 0.1  # [s] between looks at who reads what in other processes


class Chain(Protocol):
    """What a node computes together with, see `lathe_rc.nodes.chain.Chain`."""

    def advance(self) -> None:
        """Compute what the inputs from outside allow; the first of the nodes says how far."""

    def ready(self) -> tuple[int, bool] | None:
        """Samples that all can compute, and whether the run ends with them; None while an input is missing."""

    def compute(self, samples: int, *, last: bool) -> None:
        """Let all compute so many samples, with which the run may end, and publish them."""

    def leave(self) -> None:
        """Let each node go on alone, from where it stands."""


class StageNode(CellNode):
    """Feeds a stage in order and publishes what it computes.

    Attributes:
        stage: what it runs, once configured.
        blocks: computed so far.
        samples: computed so far.
        together: blocks that are computed in one go, at most.
        dense: fully qualified topic of each output.
        chain: that it computes in; None: it computes alone.
    """

    stage: Stage
    chain: Chain | None = None

    def configure_part(self) -> None:
        """Build the stage and compile its kernels: the first block then takes no longer than the next."""
        self.stage = STAGES[self.kind](self.get_name(), self.table)
        compile_kernels(self.stage)
        self.blocks = 0
        self.samples = 0
        self._started = False
        self._restart_file = getattr(self.table, "restart_file", "")
        self._keep_at = 0
        self._reach: int | None = None  # sample up to which it may go, if no input holds it back
        if self._restart_file and not self.table.window:
            raise InputError(f"{self.get_name()}.restart_file with window = 0: nobody waits for a restart; allowed: ''")
        self._framer = Framer(self.table.run_id, self.full_name, self.table.step_ns)
        self._encoders = [
            (
                self.topic(port.topic),
                Encoder(port.type, self.table.run_id, self.full_name, self.table.step_ns),
            )
            for port in self.stage.outputs
        ]
        self.dense = [topic for topic, _ in self._encoders]
        for _, encoder in self._encoders:
            encoder.prepare(self.table.block_size)
        most = min(self.table.window // _TOGETHER, messages.MAX_BLOCK // self.table.block_size)
        self.together, self._size = max(most, 1), self.table.block_size
        self._pools = [Pool(port.type) for port in self.stage.outputs]
        self._sparse_topics = {topic: self.topic(topic) for topic in self.stage.sparse_topics}
        self._queues: dict[str, BlockQueue] = {}
        self._tracks: dict[str, Track] = {}
        ports = self.ports()
        for topic, port in ports:
            delays = longest_delays(p for other, p in ports if other == topic)
            self._queues[topic] = BlockQueue(topic, port.type, self.table, sorted(delays))
            self._tracks[topic] = Track(port.type, delays, self.together * self.table.block_size)
        self._wire()

    def ports(self) -> list[tuple[str, Input]]:
        """Fully qualified topic of each input, and the input."""
        return [(self.topic(port.topic), port) for port in self.stage.inputs]

    def _wire(self, without: Collection[str] = ()) -> None:
        """Put queues and tracks in the order in which they are read; nothing waits for the topics ``without``."""
        ports = self.ports()
        self._inputs = [(self._queues[topic], self._tracks[topic], port.delay) for topic, port in ports]
        self._delayed = [port for port in self._inputs if port[2] and port[0].topic not in without]
        waits = [(topic, port.delay) for topic, port in ports if topic not in without]
        self._feedback = [self._queues[topic] for topic in dict.fromkeys(t for t, delay in waits if delay)]
        self._forward = [self._queues[topic] for topic in dict.fromkeys(t for t, delay in waits if not delay)]

    def activate_part(self) -> None:
        """Make publishers, subscriptions and the service that schedules events."""
        for topic, msgtype, _ in self.publications():
            self.outlets[topic] = self.create_publisher(message_class(msgtype), topic, signal_qos(self.table))
        for topic, queue in self._queues.items():
            queue.inside = self.exchange.has(topic)
            self.listen(topic, queue.type, partial(self._take_in, queue), queue.take)
        self._outside, self._outside_due = set(self.outlets), 0.0
        # Computed in this process for readers to share, and nothing of their past is wanted: no need to copy.
        self._shared = [q for topic, q in self._queues.items() if q.inside and not self._tracks[topic].delay]
        # Who may go on in place of another process does not know yet where: what comes until then is looked at later.
        self._waits = bool(self._restart_file)
        self._early: deque[tuple[BlockQueue, bytes]] = deque(
            maxlen=_EARLY * signal_depth(self.table) * len(self._queues)
        )
        self.create_service(Schedule, "~/schedule", self._on_schedule)
        self.exchange.stages.append(self)

    def clean_up_part(self) -> None:
        """See `CellNode`."""
        if self.chain is not None:
            self.chain.leave()
        if self in self.exchange.stages:
            self.exchange.stages.remove(self)

    def tick(self, now: float) -> None:
        """See `CellNode`."""
        super().tick(now)
        # To ask for every message would cost as much as a small stage. Once ready, the cell's own readers are there.
        if self._ready and now >= self._outside_due:
            self._outside_due = now + _OUTSIDE_PERIOD
            self._outside = {topic for topic, outlet in self.outlets.items() if outlet.get_subscription_count()}

    def relative_topics(self) -> list[str]:
        """See `CellNode`."""
        inputs, outputs = ([port.topic for port in self.stage.inputs], [port.topic for port in self.stage.outputs])
        return [*inputs, *outputs, *self.stage.sparse_topics]

    def publications(self) -> list[tuple[str, str, bool]]:
        """See `CellNode`."""
        if not hasattr(self, "stage"):
            return []
        dense = [(self.topic(port.topic), port.type, False) for port in self.stage.outputs]
        return dense + [(self.topic(topic), kind, True) for topic, kind in self.stage.sparse_topics.items()]

    def subscriptions_wanted(self) -> list[str]:
        """See `CellNode`."""
        return list(self._queues) if hasattr(self, "stage") else []

    def _take_in(self, queue: BlockQueue, data: bytes) -> None:
        if self._waits:
            self._early.append((queue, data))
        else:
            queue.add(data)

    def members_changed(self) -> None:
        """Learn whose blocks to accept, before the first of them."""
        if self._waits and any(m.stage in MASTERS and not m.members for m in self.members.values()):
            self._waits = False  # alone with a spindle, it joins where it can
        if self._waits:
            return
        peers = self.master.members if self.master else list(self.members)
        for name in peers:
            member = self.members.get(name)
            for topic in member.publishes if member else ():
                queue = self._queues.get(topic)
                if queue and (queue.open or queue.source not in peers):
                    self._expect(queue, name)

    def _expect(self, queue: BlockQueue, source: str) -> None:
        """Accept a member's blocks: in a cell from the first on; alone, with a run, from whichever comes first."""
        if self.master is None:
            if self.table.run_id and not queue.source:
                queue.expect(source, None)
            return
        if self._started:
            raise LatheError(f"{queue.topic}: {queue.source} was heard before the cell of {source}; start anew")
        queue.expect(source)
        queue.repeats = self.restarts(source)

    def statistics(self) -> dict[str, object]:
        """See `CellNode`."""
        waiting = {f"waiting for {topic}": not queue.blocks for topic, queue in self._queues.items()}
        return {"blocks": self.blocks, "samples": self.samples, "lost blocks": self.lost, **waiting}

    @property
    def lost(self) -> int:
        """Blocks that never came, in a free-running cell."""
        return sum(queue.lost for queue in self._queues.values())

    def matched(self) -> bool:
        """See `CellNode`; who may join in mid-run must know whether the cell is running."""
        return (self._cell is not None or not self._restart_file) and super().matched()

    def begin(self, *, joins: bool) -> None:
        """See `CellNode`.

        Raises:
            LatheError: the cell is running, and there is nothing to go on from.
        """
        if not self._restart_file:
            if joins:
                raise LatheError(
                    f"{self.full_name}: the cell is running already, and this node cannot go on in mid-run"
                )
            return
        if joins:
            self._resume()
        self._waits = False
        self.members_changed()
        while self._early:
            self.guarded(partial(self._take_in, self._early[0][0]))(self._early.popleft()[1])
        self._keep()
        self.due = True

    def _keep(self) -> None:
        """Keep the state, as long as those who supply it still hold the blocks that follow."""
        self._keep_at = self.blocks + self.table.window
        state_file.save(Path(self._restart_file), self._kept())

    def _kept(self) -> dict[str, object]:
        """All that the next block depends on, and of which start of the cell it is."""
        assert self.master is not None, "it has announced all members"
        return {
            "of": (self.full_name, self.table.run_id, self.master.host, self.master.pid),
            "blocks": self.blocks,
            "samples": self.samples,
            "companions": self._framer.companions,
            "stage": self.stage,
            "tracks": self._tracks,
            "queues": {topic: queue.state() for topic, queue in self._queues.items()},
        }

    def _resume(self) -> None:
        """Go on from what another process has kept."""
        fresh = self._kept()
        state = state_file.load(Path(self._restart_file), self.table, fresh, Block)
        if state["of"] != fresh["of"]:
            raise LatheError(f"{self._restart_file}: the state of another node or run; expected {fresh['of']}")
        self.blocks, self.samples, self._started = state["blocks"], state["samples"], True
        self._reported_blocks, self._framer.companions = self.blocks, state["companions"]
        self.stage, self._tracks = state["stage"], state["tracks"]
        assert self.master is not None, "it has announced all members"
        sources = {topic: name for name in self.master.members for topic in self.members[name].publishes}
        for topic, queue in self._queues.items():
            queue.resume(sources[topic], state["queues"][topic])
        self._wire()
        self.get_logger().info(f"goes on from block {self.blocks}")
        self.reporter("resumed", self.get_name(), blocks=self.blocks, sample=self.samples)

    def fail(self, error: LatheError, *, cause: str = "error") -> None:
        """See `CellNode`; those that it computes with go on alone."""
        super().fail(error, cause=cause)
        if self.chain is not None:
            self.chain.leave()

    def lose(self, lost: set[str], first: int, end: int) -> None:
        """See `CellNode`; what is read from them is held."""
        if self.chain is not None:
            self.chain.leave()
        for queue in self._queues.values():
            if queue.source in lost and queue.held_from is None:
                queue.hold(end)
        if not self._safe:
            self.stage.lose(first)
        if self._forward and all(queue.held_from is not None for queue in self._forward) and self._reach is None:
            self._follow_the_master(first)
        self.due = True

    def _follow_the_master(self, first: int) -> None:
        """Who reads from lost members alone would run ahead to the end: go no further than the spindle has come."""
        assert self.master is not None, "it has declared the safe state"
        self._reach = first
        topic = next(
            topic for topic, sparse in zip(self.master.publishes, self.master.sparse, strict=True) if not sparse
        )
        pace = BlockQueue(topic, messages.ENCODER, self.table, [])
        pace.expect(self.master.name, first)
        pace.repeats = True

        def come(take: Callable[[Any], object], delivery: Any) -> None:
            take(delivery)
            pace.blocks.clear()
            self._reach = max(first, pace.end)

        self.listen(topic, messages.ENCODER, partial(come, pace.add), partial(come, pace.take))

    # ---- events -------------------------------------------------------------------------------------

    def _on_schedule(self, request: Any, response: Any) -> Any:
        index = max(self.samples, int(request.not_before))
        if self._waits or self.failure:
            response.message = str(self.failure or f"{self.full_name} is not ready yet; ask again")
            return response
        try:
            self.stage.schedule(request.action, index)
        except InputError as error:
            response.message = str(error)
            return response
        if self._restart_file and not self.over:
            self.attempt(self._keep)  # another process has to know of it
        response.accepted, response.sample_index = True, index
        return response

    # ---- data ---------------------------------------------------------------------------------------

    def work(self) -> None:
        """Compute what the blocks that came allow."""
        if self.active and not self.failure and not self._waits:
            self.attempt(self.advance)

    @staticmethod
    def _load(queue: BlockQueue, track: Track, until: int) -> None:
        """Move queued blocks into the topic's track until it reaches sample ``until``, as far as they have come."""
        while track.end < until and queue.blocks:
            block = queue.blocks.popleft()
            try:
                # Who computes a block in this process has checked it.
                block.copy_to(track.extend(block.samples), check=not queue.inside)
            except ValueError as error:
                raise LatheError(f"{queue.topic}: {error}") from None

    @staticmethod
    def _taken(queue: BlockQueue, samples: int) -> Signals:
        """The next samples of blocks that were computed in this process; without a copy if they are one piece."""
        if queue.blocks[0].samples == samples:
            return queue.blocks.popleft().signals
        pieces = [block.signals for block in queue.until(queue.blocks[0].first_index + samples)]
        return {name: np.concatenate([piece[name] for piece in pieces]) for name in pieces[0]}

    # ---- in a chain ---------------------------------------------------------------------------------

    @property
    def may_join(self) -> bool:
        """Whether it can compute in a chain from now on."""
        return not self._started and not self._restart_file and bool(self.table.window) and self.computes

    @property
    def cell(self) -> str:
        """Name of its time master; empty as long as it has none."""
        return self.master.name if self.master is not None else ""

    @property
    def computes(self) -> bool:
        """Whether it takes part in a cell that runs."""
        return self.active and self.master is not None and not (self.failure or self.over or self._waits)

    def join(self, chain: Chain, inside: Collection[str]) -> None:
        """Compute in a chain from sample 0 on; what its nodes publish is ``inside``."""
        self.chain = chain
        self._wire(inside)
        self._shared = []
        self._join(0)

    def lead(self) -> None:
        """As the first of a chain, let it compute what the inputs allow."""
        while self.chain is not None and (ready := self.chain.ready()):
            self.chain.compute(ready[0], last=ready[1])

    def take(self, place: int, samples: int) -> Signals:
        """The next samples of an input."""
        queue, track, delay = self._inputs[place]
        self._load(queue, track, self.samples + samples - delay)
        return track.view(self.samples - delay, samples)

    def publish_copies(self, sparse: list[Sparse], outputs: Sequence[Signals], *, last: bool) -> None:
        """Publish what the chain has computed: copies, for readers keep what they are given."""
        samples = next(iter(outputs[0].values())).size
        memory = [pool.take(samples) for pool in self._pools]
        for (copies, _), signals in zip(memory, outputs, strict=True):
            for name, array in copies.items():
                array[:] = signals[name]
        sparse = self.stage.conclude(self.samples, sparse, [copies for copies, _ in memory], last=last)
        self._publish(sparse, memory, last=last)

    def pass_over(self, inside: Collection[str]) -> None:
        """Put what has been handed over to it ``inside`` of the chain where it would be had it computed alone."""
        for topic, track in self._tracks.items():
            if topic in inside:
                queue = self._queues[topic]
                if track.delay:
                    self._load(queue, track, self.samples)
                else:
                    for _ in queue.until(self.samples):
                        pass

    def part(self, inside: Collection[str]) -> None:
        """Compute alone from now on."""
        self.chain, self.due = None, True
        for topic, track in self._tracks.items():
            if topic in inside and not track.delay:
                track.restart(self.samples)
        self._wire()

    # ---- alone --------------------------------------------------------------------------------------

    def next(self) -> tuple[int, bool] | None:
        """Samples to compute in one go, and whether the run ends with them; None while an input is missing."""
        if not self._started:
            if not all(queue.blocks for queue in self._forward):
                return None
            # Alone, a node may join a stream that is under way; in a cell it begins at 0.
            self._join(self._forward[0].blocks[0].first_index)
            self._check_cut([queue.blocks[0].first_index for queue in self._forward], "begin")
        end, ended = self.samples + self.together * self._size, False
        for queue in self._forward:
            end = min(end, queue.end)
            ended = ended or queue.ended
        if end <= self.samples:
            return None
        for queue in self._feedback:
            # It may not be needed for a long time yet, but what piles up unread DDS gives up some day.
            if queue.received + self.table.window < self.blocks and self.master is not None and self.table.window:
                return None
        if self._reach is not None:
            end = min(end, self._reach)
        for queue, track, delay in self._delayed:
            self._load(queue, track, end - delay)
            end = min(end, track.end + delay)
        last = ended and self._ends_with(end)
        samples = end - self.samples
        if not last:
            samples -= samples % self._size
        return (samples, last) if samples > 0 else None

    def _ends_with(self, end: int) -> bool:
        """Whether the run ends before sample ``end``.

        Raises:
            LatheError: it ends with another sample for another input.
        """
        ends = [queue.end for queue in self._forward]
        if max(ends) > min(queue.end for queue in self._forward if queue.ended):
            self._check_cut(ends, "end")
        return all(queue.ended and queue.end == end for queue in self._forward)

    def _check_cut(self, places: Sequence[int], what: str) -> None:
        if len(set(places)) > 1:
            where = ", ".join(f"{queue.topic} {place}" for queue, place in zip(self._forward, places, strict=True))
            raise LatheError(f"inputs do not {what} with the same sample: {where}")

    def _join(self, first: int) -> None:
        self._started = True
        self.samples = first
        for track in self._tracks.values():
            track.restart(first)

    def advance(self) -> None:
        """Compute every block whose inputs are there."""
        if not self._started and any(queue.blocks for queue in self._forward):
            self.exchange.form(self, None)
        if self.chain is not None:
            self.chain.advance()
            return
        while not self.over and not self.failure:
            ready = self.next()
            if ready is None:
                return
            samples, last = ready
            self.compute(samples, self.read(samples), last=last)

    def read(self, samples: int) -> list[Signals]:
        """The next samples of all inputs, which are there."""
        taken = {queue.topic: self._taken(queue, samples) for queue in self._shared}
        inputs: list[Signals] = []
        for queue, track, delay in self._inputs:
            if queue.topic in taken:
                inputs.append(taken[queue.topic])
                continue
            if not delay:
                self._load(queue, track, self.samples + samples)
            inputs.append(track.view(self.samples - delay, samples))
        return inputs

    def _goes_out(self, topic: str) -> bool:
        """Whether to publish: unless all who read the topic are in this process."""
        return topic in self._outside or not self.exchange.read(topic)

    def compute(self, samples: int, inputs: Sequence[Signals], *, last: bool) -> None:
        """Compute some blocks in one go, and publish each; the last one of the run may be shorter."""
        memory = [pool.take(samples) for pool in self._pools]
        self._publish(
            self.stage.advance(self.samples, inputs, [signals for signals, _ in memory], last=last), memory, last=last
        )

    def _publish(self, said: Sequence[Sparse], memory: Sequence[tuple[Signals, Samples | None]], *, last: bool) -> None:
        samples = next(iter(memory[0][0].values())).size
        before, found = self._framer.companions, []
        for sparse in said:
            found.append(sparse.index)
            framed = self._framer.sparse(sparse)
            topic, data = self._sparse_topics[sparse.topic], messages.encode(sparse.type, framed)
            if self._goes_out(topic):
                self.outlets[topic].publish(data)
            self.exchange.hand_over(topic, data)
            if sparse.type == messages.LEARNING:
                values = {key: float(value) for key, value in sparse.values.items()}
                self.reporter("cycle", self.get_name(), sample=sparse.index, **values)
        companions = [before + len(found)]
        if samples > self._size:
            ends = range(self.samples + self._size, self.samples + samples, self._size)
            companions = [*(before + bisect_left(found, end) for end in ends), *companions]
        for (topic, encoder), (signals, whole) in zip(self._encoders, memory, strict=True):
            block = encoder.block(self.samples, signals, whole, last=last, companions=companions[-1])
            try:
                block.check()
            except ValueError as error:
                raise LatheError(f"{topic}: {error}") from None
            run = Run(block, companions)
            if self._goes_out(topic):
                for each in run.blocks(self._size):
                    first, end, count = each.first_index, each.last, each.companions
                    self.outlets[topic].publish(encoder.encode(first, each.signals, last=end, companions=count)[1])
            self.exchange.hand_over(topic, run)
        self.blocks += len(companions)
        self.samples += samples
        self.progressed(self.blocks, self.samples, last=last)
        if last:
            self.ended()
        elif self._restart_file and self.blocks >= self._keep_at:
            self._keep()

    def ended(self) -> None:
        """The last block has been computed."""
        if waiting := self.stage.waiting:
            self.get_logger().warning(f"not reached: {'; '.join(waiting)}")
            self.reporter("not_reached", self.get_name(), events=waiting)
        self.end(list(self.outlets.values()))
        if self.lost:
            self.fail(LossyRunError(f"{self.full_name}: lost {self.lost} blocks of a free-running cell"))
