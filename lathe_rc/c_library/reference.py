# SPDX-License-Identifier: Apache-2.0
"""Inputs and outputs of a library's stages in a run of the engine, for a comparison bit by bit."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from lathe_rc.c_library.library import Library, Signal
from lathe_rc.cell.engine import Engine
from lathe_rc.cell.stage import Sparse, Stage
from lathe_rc.cell.wiring import Cell
from lathe_rc.messages import Signals

_LEARN = {"learn": 1.0, "freeze": 0.0}  # events that set the parameter `learning`


class Reference:
    """Signals of a run, and the parameters that events and answers of the engine have changed in it.

    Args:
        library: the library.
        cell: the same cell, before its first sample.
        samples: wanted length [sample]; the reference ends earlier where the run ends, or where the engine does
            something that the library leaves to its caller.

    Attributes:
        samples: length [sample].
        events, answers: changes of parameters, by the scenario and by the engine where a stage has stopped: sample,
            index of the parameter, index of the stage in the library, and value.
    """

    def __init__(self, library: Library, cell: Cell, samples: int) -> None:
        self._library, self.samples = library, min(samples, cell.samples)
        self.events: list[tuple[int, int, int, float]] = []
        self.answers: list[tuple[int, int, int, float]] = []
        self._numbers = {parameter.name: number for number, parameter in enumerate(library.parameters)}
        self._signals = {(each.topic, each.field): list[Any]() for each in (*library.inputs, *library.outputs)}
        for number, part in enumerate(library.parts):
            stage = cell.stages[part.stage.name]
            stage.__dict__["serve"] = self._watched(number, stage, stage.serve)
            stage.__dict__["act"] = self._acting(number, stage, stage.act)
        engine, self._reached = Engine(cell, heard={topic for topic, _ in self._signals}), 0
        for _ in engine.steps([self]):
            if self._reached >= self.samples:
                break
        self.events = sorted(event for event in self.events if event[0] < self.samples)
        self.answers = sorted(answer for answer in self.answers if answer[0] < self.samples)

    def chunk(
        self, first: int, samples: int, dense: Mapping[str, Signals], sparse: Mapping[str, Sequence[Sparse]]
    ) -> None:
        """Keep the signals of a chunk (implements `lathe_rc.cell.engine.Sink`)."""
        for (topic, name), kept in self._signals.items():
            kept.append(dense[topic][name].copy())
        self._reached = first + samples

    def _watched(self, place: int, stage: Stage, serve: Callable[..., list[Sparse]]) -> Callable[..., list[Sparse]]:
        def watched(reason: int, first: int, reached: int, *signals: Any) -> list[Sparse]:
            if reason not in stage.goes_on:
                self.samples = min(self.samples, first)
            found = serve(reason, first, reached, *signals)
            for name, (array, index) in stage.handles.items():
                if name != "learning":
                    number = self._numbers[f"{stage.name}.{name}"]
                    self.answers.append((first + reached, number, place, float(array.flat[index])))
            return found

        return watched

    def _acting(self, place: int, stage: Stage, act: Callable[[str, int], None]) -> Callable[[str, int], None]:
        def acting(action: str, index: int) -> None:
            number = self._numbers.get(f"{stage.name}.learning")
            if action in _LEARN and number is not None:
                self.events.append((index, number, place, _LEARN[action]))
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
            file.write(np.array([self.samples, len(self.events), len(self.answers)], np.int64).tobytes())
            for *whole, value in (*self.events, *self.answers):
                file.write(np.array(whole, np.int64).tobytes() + np.float64(value).tobytes())
            for signal in (*library.inputs, *library.outputs):
                file.write(self.signal(signal).tobytes())
