# SPDX-License-Identifier: Apache-2.0
"""A node that may compute in a chain with others of its process, see `lathe_rc.nodes.chain`."""

from collections.abc import Collection, Sequence
from typing import Protocol

from lathe_rc.cell.stage import Sparse
from lathe_rc.errors import LatheError
from lathe_rc.messages import Signals
from lathe_rc.nodes.restart import Restartable


class Chain(Protocol):
    """The stages that a node computes together with, see `lathe_rc.nodes.chain.Chain`."""

    def advance(self) -> None:
        """Compute what the inputs from outside allow; the first of the nodes says how far."""

    def ready(self) -> tuple[int, bool] | None:
        """Samples that all can compute, and whether the run ends with them; None while an input is missing."""

    def compute(self, samples: int, *, last: bool) -> None:
        """Let all compute so many samples, with which the run may end, and publish them."""

    def leave(self) -> None:
        """Let each node go on alone, from where it stands."""


class ChainMember(Restartable):
    """A node as its chain calls it.

    Attributes:
        chain: that it computes in; None: it computes alone.
    """

    chain: Chain | None = None

    def activate_part(self) -> None:
        """See `StageTopics`; from now on it can join a chain."""
        super().activate_part()
        self.exchange.stages.append(self)

    def clean_up_part(self) -> None:
        """See `CellNode`."""
        if self.chain is not None:
            self.chain.leave()
        if self in self.exchange.stages:
            self.exchange.stages.remove(self)

    def fail(self, error: LatheError, *, cause: str = "error") -> None:
        """See `CellNode`; those that it computes with go on alone."""
        super().fail(error, cause=cause)
        if self.chain is not None:
            self.chain.leave()

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
        outputs = [copies for copies, _ in memory]
        sparse = self.stage.conclude(self.samples, self.samples + samples, sparse, outputs, last=last)
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
