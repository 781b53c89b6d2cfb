# SPDX-License-Identifier: Apache-2.0
"""Bag as a run of the panel: it is played instead of computed."""

import pickle
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from os import SEEK_END
from pathlib import Path
from typing import Any

from lathe_live.bag_pieces import Piece, pieces
from lathe_live.panel_outlook import plain_outlook
from lathe_live.panel_view import View
from lathe_rc import messages
from lathe_rc.bag import provenance
from lathe_rc.bag.reading.source import BagSource, name_of
from lathe_rc.bag.reading.stream import first_of
from lathe_rc.errors import InputError, LatheError

_EVERY, _MOST = 2**20, 128  # least number of samples between two checkpoints, and about the largest number of these


@dataclass(frozen=True)
class _Checkpoint:
    """State of view and lamp before a sample, and its place in the file of checkpoints."""

    sample: int
    place: int


class Player:
    """Bag of a cell that is played (implements `lathe_live.panel_run.PanelRun`).

    It reads the whole bag once, which fills the timeline and leaves checkpoints in a temporary file. From these, it
    goes to any sample by reading a piece of the bag.

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
        self._open = ExitStack()
        self._file = self._open.enter_context(tempfile.TemporaryFile())  # noqa: SIM115 - it is closed with the bag
        try:
            self._source = source = self._open.enter_context(BagSource(bag))
            types = {t: each.type for t, each in source.topics.items() if each.type in messages.signal_types()}
            dense = [topic for topic, kind in types.items() if kind in messages.block_types()]
            self._step_ns = next(filter(None, map(source.step_ns, dense)), 0)
            if not self._step_ns or not {messages.ENCODER, messages.TOOL} & {*types.values()}:
                raise InputError(f"{bag}: nothing to show: no blocks of an encoder or a tool; allowed: a bag of a cell")
            self.first = self.reached = first_of(source)
            self.step, self._lost = self._step_ns * 1e-9, str(source.loss or "")
            self.view = View(types, self._step_ns)
            self._know()
            self._checkpoints = [self._checkpoint()]
            self._read_through()
        except LatheError as error:
            self.close()
            raise type(error)(str(error) if str(bag) in str(error) else f"{bag}: {error}") from None

    def _know(self) -> None:
        """Show the scenario that the bag contains."""
        about, name = self._source.about, name_of(self._source.path)
        with tempfile.TemporaryDirectory() as folder:
            try:
                self.view.know(provenance.scenario_of(about, Path(folder)))
                self.view.outlook = {**self.view.outlook, "name": name}
            except LatheError as error:
                self.view.say(self.first, "panel", f"the scenario is not known: {error}")
                self.view.outlook = plain_outlook(name, self.step)

    def _checkpoint(self) -> _Checkpoint:
        place = self._file.seek(0, SEEK_END)
        pickle.dump((self.view.state(), self.view.lamp.state()), self._file)
        return _Checkpoint(self.reached, place)

    def _read_through(self) -> None:
        """Read the whole bag: fill the timeline, and leave checkpoints, then return to the first sample."""
        source = self._source
        every = max(_EVERY, (source.last_ns - source.first_ns) // self._step_ns // _MOST)
        for piece in self._pieces():
            if piece.first >= self._checkpoints[-1].sample + every:
                self._checkpoints.append(self._checkpoint())
            self._show(piece)
        self.samples = self.reached
        self._resume(self._checkpoints[0])

    def _pieces(self) -> Iterator[Piece]:
        return pieces(self._source, self.reached, self._step_ns)

    def _show(self, piece: Piece) -> None:
        for sink in (self.view.lamp, self.view):
            sink.chunk(piece.first, piece.samples, piece.dense, piece.sparse)
        self.reached = piece.end

    def _resume(self, checkpoint: _Checkpoint) -> None:
        self._file.seek(checkpoint.place)
        view, lamp = pickle.load(self._file)  # noqa: S301 - our own
        self.view.resume(view)
        self.view.lamp.resume(lamp)
        self.reached = checkpoint.sample
        self._left, self._piece = self._pieces(), Piece(self.reached, 0, {}, {})

    def advance(self, end: int) -> None:
        """Show samples up to ``end``.

        Raises:
            LatheError: the bag has changed.
        """
        while self.reached < end:
            if self.reached == self._piece.end:
                self._piece = next(self._left, self._piece)
            if self.reached == self._piece.end:
                raise LatheError(f"{self._source.path} ends at sample {self.reached}; has it changed?")
            self._show(self._piece.part(self.reached, min(end, self._piece.end)))
            if self.reached == self.samples:
                self.view.finish()
                if self._lost:
                    self.view.say(self.samples, "panel", self._lost)

    def seek(self, sample: int) -> None:
        """Show the run up to a sample.

        Raises:
            InputError: the bag has no such sample.
            LatheError: the bag has changed.
        """
        if not self.first <= sample <= self.samples:
            raise InputError(f"sample {sample}; allowed: from {self.first} to {self.samples}")
        nearest = next(each for each in reversed(self._checkpoints) if each.sample <= sample)
        if sample < self.reached or nearest.sample > self.reached:
            self._resume(nearest)
        self.advance(sample)

    def turn_end(self) -> int:
        """Return the sample at which the revolution in progress ends; of very long bags, perhaps the one after it."""
        last = self.view.timeline.last_of(int(self.view.turns))
        return self.samples if last is None else min(last + 2, self.samples)

    def told(self) -> Mapping[str, Any]:
        """Return the status of the run, for its snapshots."""
        lost = self._lost if self.reached == self.samples else ""
        return {"bag": "", "events": "", "begun": self.first, "version": 1, "lost": lost}

    def close(self) -> None:
        """Close the bag."""
        self._open.close()
