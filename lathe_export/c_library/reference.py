# SPDX-License-Identifier: Apache-2.0
"""Inputs and outputs of a library's stages in a run of the engine, for a comparison bit by bit."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from lathe_export.c_library.library import LEARN, Library, Signal
from lathe_rc.blocks.ports import Sparse
from lathe_rc.cell.engine import Engine
from lathe_rc.cell.stage import Stage
from lathe_rc.cell.wiring import Cell
from lathe_rc.messages import Signals


class Reference:
    """Signals of a run, and the parameters that events have changed in it.

    Args:
        library: the library.
        cell: the same cell, before its first sample.
        samples: wanted length [sample]; the reference ends earlier where the run ends, or where the engine does
            something that the library leaves to its caller.

    Attributes:
        samples: length [sample].
        events: changes of parameters by the scenario: sample, index of the parameter, and value.
    """

    def __init__(self, library: Library, cell: Cell, samples: int) -> None:
        self._library, self.samples = library, min(samples, cell.samples)
        self.events: list[tuple[int, int, float]] = []
        self._numbers = {parameter.name: number for number, parameter in enumerate(library.parameters)}
        self._signals = {(each.topic, each.field): list[Any]() for each in (*library.inputs, *library.outputs)}
        for part in library.parts:
            stage = cell.stages[part.stage.name]
            stage.__dict__["serve"] = self._watched(stage, stage.serve)
            stage.__dict__["act"] = self._acting(stage, stage.act)
        engine, self._reached = Engine(cell, heard={topic for topic, _ in self._signals}), 0
        for _ in engine.steps([self]):
            if self._reached >= self.samples:
                break
        self.events = sorted(event for event in self.events if event[0] < self.samples)

    def chunk(
        self, first: int, samples: int, dense: Mapping[str, Signals], sparse: Mapping[str, Sequence[Sparse]]
    ) -> None:
        """Keep the signals of a chunk (implements `lathe_rc.cell.engine.Sink`)."""
        for (topic, name), kept in self._signals.items():
            kept.append(dense[topic][name].copy())
        self._reached = first + samples

    def _watched(self, stage: Stage, serve: Callable[..., list[Sparse]]) -> Callable[..., list[Sparse]]:
        def watched(reason: int, first: int, *rest: Any) -> list[Sparse]:
            if reason not in stage.goes_on:
                self.samples = min(self.samples, first)
            return serve(reason, first, *rest)

        return watched

    def _acting(self, stage: Stage, act: Callable[[str, int], None]) -> Callable[[str, int], None]:
        def acting(action: str, index: int) -> None:
            number = self._numbers.get(f"{stage.name}.learning")
            if action in LEARN and number is not None:
                self.events.append((index, number, LEARN[action]))
            else:
                self.samples = min(self.samples, index)
            act(action, index)

        return acting

    def signal(self, signal: Signal) -> npt.NDArray[Any]:
        """Return a signal as the caller gives or gets it, shape (samples,)."""
        whole = np.concatenate(self._signals[signal.topic, signal.field])[: self.samples]
        late = np.zeros_like(whole)
        late[signal.delay :] = whole[: whole.size - signal.delay]
        return late

    def write(self, path: Path) -> None:
        """Write the file that the program of the library reads: counts, settings, then one array after the other."""
        library = self._library
        with path.open("wb") as file:
            file.write(np.array([self.samples, len(self.events)], np.int64).tobytes())
            for *whole, value in self.events:
                file.write(np.array(whole, np.int64).tobytes() + np.float64(value).tobytes())
            for signal in (*library.inputs, *library.outputs):
                file.write(self.signal(signal).tobytes())
