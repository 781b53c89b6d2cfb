# SPDX-License-Identifier: Apache-2.0
"""The recorded tool position beside the re-simulated one."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from lathe_rc import messages
from lathe_rc.bag.reading.recorded import Recorded
from lathe_rc.cell.parameters import remapped
from lathe_rc.cell.stage import Sparse
from lathe_rc.cell.stages.tool import Tool
from lathe_rc.cell.wiring import Cell
from lathe_rc.messages import Samples, Signals
from lathe_rc.part import ErrorsByRevolution

_TYPES = {"/encoder": messages.ENCODER, "/tool": messages.TOOL}


def positions(recorded: Recorded, tool: Tool) -> list[tuple[str, str]]:
    """Topics and fields of a bag whose sum is the tool's position; empty if not all of them are there.

    The tool's own topic, or the measured positions of the drives that move it.
    """
    own = recorded.find(remapped(tool.shared, tool.outputs[0].topic), messages.TOOL)
    if own is not None:
        return [(own, "displacement")]
    names = [remapped(tool.shared, f"{drive}/state") for drive in tool.parameters.drives]
    topics = [recorded.find(name, messages.STATE) for name in names]
    return [(topic, "measured_position") for topic in topics if topic is not None] if all(topics) else []


class Comparison:
    """Form error of the recorded tool position, and how far the re-simulated one is off, by revolution; a sink.

    The recorded one is that of the re-simulation with the recorded position in place of the simulated: same desired
    form, same cross slide, same deflection.

    Args:
        recorded: the bag.
        cell: that runs.
        tool: its tool.
        topics: see `positions`.

    Attributes:
        topics: see above.
    """

    def __init__(self, recorded: Recorded, cell: Cell, tool: Tool, topics: list[tuple[str, str]]) -> None:
        self.topics = topics
        self._encoder = remapped(cell.master.shared, "encoder")
        self._tool = remapped(tool.shared, tool.outputs[0].topic)
        self._tapes = [(recorded.tape(topic), field) for topic, field in topics]
        self._recorded, self._between = ErrorsByRevolution(_TYPES), ErrorsByRevolution(_TYPES)

    def chunk(self, first: int, samples: int, dense: Mapping[str, Signals], sparse: Mapping[str, list[Sparse]]) -> None:
        """See `lathe_rc.cell.engine.Sink`."""
        tool, encoder = dense[self._tool], dense[self._encoder]
        between: Samples = tool["displacement"] - sum(tape.take(samples)[field] for tape, field in self._tapes)
        for sink, error in ((self._recorded, tool["error"] + between), (self._between, between)):
            sink.chunk(first, samples, {"encoder": encoder, "tool": {"error": error}}, {})

    def recorded_rms(self) -> np.ndarray[Any, np.dtype[np.float64]]:
        """Form error of the recorded position by revolution, RMS [m], shape (revolutions,)."""
        return self._recorded.rms()

    def between_rms(self) -> np.ndarray[Any, np.dtype[np.float64]]:
        """Difference of the two positions by revolution, RMS [m], shape (revolutions,)."""
        return self._between.rms()
