# SPDX-License-Identifier: Apache-2.0
"""Topics of a cell that the panel shows."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from lathe_rc import messages
from lathe_rc.messages import full
from lathe_rc.view import machine_state


@dataclass(frozen=True)
class Topics:
    """Topics of a cell that the panel shows, by fully qualified name; empty if there is none.

    Attributes:
        encoder, tool, cut, safety: first topics of these kinds.
        drives: states of the drives that move the tool.
        slides: states of the slides, by axis.
        followed: set point and state of these drives, by name.
    """

    encoder: str
    tool: str
    cut: str
    safety: str
    drives: Sequence[str]
    slides: Mapping[str, str]
    followed: Mapping[str, tuple[str, str]]

    @classmethod
    def of(cls, types: Mapping[str, str]) -> "Topics":
        """Return the topics of a cell, given the message type of each topic."""
        named = {full(topic): kind for topic, kind in types.items()}
        first = {kind: topic for topic, kind in reversed(named.items())}
        slides = {
            axis: topic
            for topic, kind in named.items()
            if kind == messages.STATE and (axis := machine_state.source(topic, kind))
        }
        drives = [t for t, kind in named.items() if kind == messages.STATE and t not in slides.values()]
        pairs = {drive: (f"{drive}/command", f"{drive}/state") for drive in (t.removesuffix("/state") for t in drives)}
        followed = {drive.strip("/"): pair for drive, pair in pairs.items() if named.get(pair[0]) == messages.COMMAND}
        kinds = (messages.ENCODER, messages.TOOL, messages.CUT, messages.SAFETY)
        encoder, tool, cut, safety = (first.get(kind, "") for kind in kinds)
        return cls(encoder, tool, cut, safety, drives, slides, followed)
