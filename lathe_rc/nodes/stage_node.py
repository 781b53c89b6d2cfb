# SPDX-License-Identifier: Apache-2.0
"""A stage as a ROS node."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from lathe_rc_msgs.srv import Schedule

from lathe_rc import messages
from lathe_rc.errors import InputError, LatheError, LossyRunError
from lathe_rc.messages import Signals
from lathe_rc.nodes.chain_member import ChainMember
from lathe_rc.nodes.ports import BlockQueue


class StageNode(ChainMember):
    """Feeds a stage in order and publishes what it computes."""

    def configure_part(self) -> None:
        """Build the stage and compile its kernels: the first block then takes no longer than the next."""
        super().configure_part()
        self._reach: int | None = None  # sample up to which it may go, if no input holds it back

    def activate_part(self) -> None:
        """Make publishers, subscriptions and the service that schedules events."""
        super().activate_part()
        self.create_service(Schedule, "~/schedule", self._on_schedule)

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
        """Go no further than the spindle: a node that reads from lost members alone would run ahead to the end."""
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
        if not self.over:
            self.attempt(partial(self.keep_event, request.action, index))
        response.accepted, response.sample_index = True, index
        return response

    # ---- data ---------------------------------------------------------------------------------------

    def work(self) -> None:
        """Compute what the blocks that came allow."""
        if self.active and not self.failure and not self._waits:
            self.attempt(self.advance)

    @staticmethod
    def _taken(queue: BlockQueue, samples: int) -> Signals:
        """The next samples of blocks that were computed in this process; without a copy if they are one piece."""
        if queue.blocks[0].samples == samples:
            return queue.blocks.popleft().signals
        pieces = [block.signals for block in queue.until(queue.blocks[0].first_index + samples)]
        return {name: np.concatenate([piece[name] for piece in pieces]) for name in pieces[0]}

    def next(self) -> tuple[int, bool] | None:
        """Samples to compute in one go, and whether the run ends with them; None while an input is missing."""
        if not self._started:
            if not all(queue.blocks for queue in self._forward):
                return None
            # Alone, a node may join a stream that is under way; in a cell it begins at 0.
            self._join(self._forward[0].blocks[0].first_index)
            self._check_cut([queue.blocks[0].first_index for queue in self._forward], "begin")
        end, ended = self.samples + self.at_once() * self._size, False
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

    def compute(self, samples: int, inputs: Sequence[Signals], *, last: bool) -> None:
        """Compute some blocks in one go, and publish each; the last one of the run may be shorter."""
        memory = [pool.take(samples) for pool in self._pools]
        self._publish(
            self.stage.advance(self.samples, inputs, [signals for signals, _ in memory], last=last), memory, last=last
        )

    def ended(self) -> None:
        """The last block has been computed."""
        if waiting := self.stage.waiting:
            self.get_logger().warning(f"not reached: {'; '.join(waiting)}")
            self.reporter("not_reached", self.get_name(), events=waiting)
        self.end(list(self.outlets.values()))
        if self.lost:
            self.fail(LossyRunError(f"{self.full_name}: lost {self.lost} blocks of a free-running cell"))
