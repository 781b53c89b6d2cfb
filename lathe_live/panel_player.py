# SPDX-License-Identifier: Apache-2.0
"""Bag as a run of the panel: it is played instead of computed."""

import tempfile
from bisect import bisect_left
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lathe_live.panel_outlook import plain_outlook
from lathe_live.panel_view import View
from lathe_rc import messages
from lathe_rc.bag import provenance
from lathe_rc.bag.reader import read_bag
from lathe_rc.bag.reading.source import Source, name_of
from lathe_rc.blocks.ports import Sparse
from lathe_rc.cell.soundness import Soundness
from lathe_rc.errors import InputError, LatheError
from lathe_rc.messages import MAX_BLOCK, Signals

_AT_ONCE = 2**20  # samples that the timeline takes at once


class Player:
    """Bag of a cell, read into memory, that is played (implements `lathe_live.panel_run.Run`).

    Args:
        bag: path of the bag.

    Attributes:
        first: index of the first sample.
        reached: number of samples shown.
        samples: index after the last sample.
        step: sampling step [s].
        block: samples between two commands.

    Raises:
        InputError: not a bag of a cell.
        LatheError: the bag is incomplete.
    """

    block = 64

    def __init__(self, bag: Path) -> None:
        self._recording = recording = read_bag(bag)
        if not recording.step_ns or not {messages.ENCODER, messages.TOOL} & {*recording.types.values()}:
            raise InputError(f"{bag}: nothing to show: no blocks of an encoder or a tool; allowed: a bag of a cell")
        self.first = self.reached = recording.first
        lengths = [array.size for signals in recording.dense.values() for array in signals.values()]
        self.samples = self.first + min(lengths)
        self.step = recording.step_ns * 1e-9
        self.view = View(recording.types, recording.step_ns)
        said = [message for topic in recording.sparse for message in recording.messages(topic)]
        self._said = sorted(said, key=lambda message: message.index)
        self._angle = next(
            (signals["angle_true"] for topic, signals in recording.dense.items() if topic == self.view.topics.encoder),
            np.empty(0),
        )
        try:
            self._fill_timeline()
        except LatheError as error:
            raise LatheError(f"{bag}: {error}") from None
        if recording.lost:
            self.view.say(self.samples, "panel", recording.lost)
        with Source(bag) as source, tempfile.TemporaryDirectory() as folder:
            about, name = source.about, name_of(bag)
            try:
                self.view.know(provenance.scenario_of(about, Path(folder)))
                self.view.outlook = {**self.view.outlook, "name": name}
            except LatheError as error:
                self.view.say(self.first, "panel", f"the scenario is not known: {error}")
                self.view.outlook = plain_outlook(name, self.step)

    def _fill_timeline(self) -> None:
        """Take the whole bag into the timeline, so that it is there before the bag is played."""
        soundness = Soundness.of_form(self._recording.types)
        for first in range(self.first, self.samples, _AT_ONCE):
            samples = min(_AT_ONCE, self.samples - first)
            dense, sparse = self._chunk(first, first + samples)
            self.view.timeline.chunk(first, samples, dense, sparse, soundness.sound(first, samples, sparse))

    def _chunk(self, first: int, end: int) -> tuple[dict[str, Signals], Mapping[str, list[Sparse]]]:
        """Return signals and messages by topic, from sample ``first`` to before ``end``."""
        span = slice(first - self.first, end - self.first)
        dense = {
            topic: {name: array[span] for name, array in signals.items()}
            for topic, signals in self._recording.dense.items()
        }
        begin, stop = (bisect_left(self._said, place, key=lambda message: message.index) for place in (first, end))
        sparse: defaultdict[str, list[Sparse]] = defaultdict(list)
        for message in self._said[begin if first > self.first else 0 : stop]:
            sparse[message.topic].append(message)
        return dense, sparse

    def advance(self, end: int) -> None:
        """Show samples up to ``end``."""
        while self.reached < end:
            first, end_here = self.reached, min(end, self.reached + MAX_BLOCK, self.samples)
            dense, sparse = self._chunk(first, end_here)
            for sink in (self.view.lamp, self.view):
                sink.chunk(first, end_here - first, dense, sparse)
            self.reached = end_here
            if end_here == self.samples:
                self.view.finish()
                return

    def seek(self, sample: int) -> None:
        """Show the run up to a sample.

        Raises:
            InputError: the bag has no such sample.
        """
        if not self.first <= sample <= self.samples:
            raise InputError(f"sample {sample}; allowed: from {self.first} to {self.samples}")
        if sample < self.reached:
            self.view.clear()
            self.view.lamp.clear()
            self.reached = self.first
        self.advance(sample)

    def turn_end(self) -> int:
        """Return the sample at which the revolution in progress ends."""
        place = int(np.searchsorted(self._angle, 2.0 * np.pi * (np.floor(self.view.turns) + 1.0)))
        return min(self.first + place + 1, self.samples)

    def told(self) -> Mapping[str, Any]:
        """Return the status of the run, for its snapshots."""
        lost = self._recording.lost if self.reached == self.samples else ""
        return {"bag": "", "events": "", "begun": self.first, "version": 1, "lost": lost}

    def close(self) -> None:
        """Nothing is open."""
