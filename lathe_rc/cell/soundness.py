# SPDX-License-Identifier: Apache-2.0
"""End of the samples on which a result may rest: the first fault of a signal that it is made of.

A fault of a signal that only controllers read, such as a measured position, does not concern the form error: the part
is cut as the true signals say. A result ends for good at its first fault: controllers have learned from it since.
"""

from collections.abc import Collection, Mapping, Sequence

from lathe_rc import messages
from lathe_rc.blocks.ports import Sparse
from lathe_rc.cell.events import FAULT, parse
from lathe_rc.errors import InputError
from lathe_rc.messages import full

#: message types and fields that the form error is made of
FORM = frozenset(
    {(messages.STATE, "position"), (messages.CUT, "deflection")}
    | {(messages.REFERENCE, field) for field in ("reference", "height")}
    | {(messages.TOOL, field) for field in ("reference", "displacement", "error", "height")}
)


def fields_of(types: Mapping[str, str], fields: Collection[tuple[str, str]]) -> set[str]:
    """Return the signals with given message types and fields, as ``/TOPIC.FIELD``; ``types``: by topic."""
    return {f"{full(topic)}.{field}" for topic, kind in types.items() for of, field in fields if of == kind}


def refuse_faults(fields: Collection[str], events: Mapping[str, Sequence[Sparse]], bag: object) -> None:
    """Refuse a bag in which one of the signals, ``/TOPIC.FIELD``, has a fault, given its events by topic.

    Raises:
        InputError: a signal has a fault.
    """
    soundness = Soundness(fields)
    soundness.sound(0, 0, events)
    if soundness.why:
        raise InputError(f"{bag}: {soundness.why}; allowed: signals without a fault (lathe bag copy --end cuts a bag)")


class Soundness:
    """End of the samples on which a result may rest, from the events of a run in order.

    Args:
        fields: signals that the result is made of, as ``/TOPIC.FIELD``; the caller may add further ones.

    Attributes:
        end: first sample with a fault; None: no fault so far.
        why: text about this fault; empty without one.
    """

    def __init__(self, fields: Collection[str]) -> None:
        self._fields = fields
        self.end: int | None = None
        self.why = ""

    @classmethod
    def of_form(cls, types: Mapping[str, str]) -> "Soundness":
        """Return the end of the samples on which the form error may rest; ``types``: message types by topic."""
        return cls(fields_of(types, FORM))

    def sound(self, first: int, samples: int, sparse: Mapping[str, Sequence[Sparse]]) -> int:
        """Return how many samples of a chunk, from its beginning on, are sound; ``sparse``: its messages by topic."""
        for found in sparse.values():
            for message in found:
                if message.type == messages.EVENT and (self.end is None or message.index < self.end):
                    self._take(message)
        return samples if self.end is None else min(max(self.end - first, 0), samples)

    def _take(self, message: Sparse) -> None:
        event = parse(str(message.values["action"]))
        if event.verb != FAULT:
            return
        kind = event.values.partition(" ")[0]
        from lathe_rc.safety.faults import KINDS  # few runs have faults

        if kind not in KINDS or KINDS[kind].what == "cut":  # of the material, not of a signal
            return
        # The target is a field, or the whole encoder.
        places = (place for name in self._fields for place in (name, name.rpartition(".")[0]))
        if any(place.endswith(f"/{event.target}") for place in places):
            node = message.topic.strip("/").removesuffix("/events")
            self.end = message.index
            self.why = f"not measured from sample {self.end} on: {node}: fault {event.fault}"
