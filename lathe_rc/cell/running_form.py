# SPDX-License-Identifier: Apache-2.0
"""Form error of a part by revolution, in whole and by zone, from the chunks of a run."""

from collections.abc import Mapping, Sequence

import numpy as np

from lathe_rc import messages
from lathe_rc.blocks.ports import Sparse
from lathe_rc.cell.soundness import Soundness
from lathe_rc.messages import Samples, Signals
from lathe_rc.signals.form_errors import FormErrors, RunningErrors, turns_before
from lathe_rc.signals.zones import Zone, ZoneErrors


class RunningForm:
    """Form error of each revolution up to a fault of a signal that it is made of; a sink of the engine and of bags.

    Where samples are missing, it begins anew, as for a snapshot: it is about the complete revolutions since then.

    Args:
        encoder, tool: topics, as the chunks name them; empty: there is none, and thus no form error.
        soundness: end of the samples on which the form error may rest.
        zones: parts of the surface with tolerances of their own.

    Attributes:
        encoder, tool, soundness, zones: see the arguments.
        before: number of revolutions before the first one evaluated.
    """

    def __init__(self, encoder: str, tool: str, soundness: Soundness, zones: Sequence[Zone] = ()) -> None:
        self.encoder, self.tool, self.soundness, self.zones = encoder, tool, soundness, zones
        self._next = -1  # sample after the last one
        self._begin(0)

    @classmethod
    def of(cls, types: Mapping[str, str], zones: Sequence[Zone] = ()) -> "RunningForm":
        """Return the form error of the first tool by the first encoder; ``types``: message type by topic."""
        encoder, tool = (
            next((topic for topic, found in types.items() if found == kind), "")
            for kind in (messages.ENCODER, messages.TOOL)
        )
        return cls(encoder, tool, Soundness.of_form(types), zones)

    def _begin(self, before: int) -> None:
        self.before = before
        self._errors, self._by_zone = RunningErrors(before), ZoneErrors(self.zones, before)

    def chunk(self, first: int, samples: int, dense: Mapping[str, Signals], sparse: Mapping[str, list[Sparse]]) -> None:
        """Add a chunk of the run (implements `lathe_rc.cell.engine.Sink`).

        Raises:
            InputError: a revolution has no sample.
        """
        sound = self.soundness.sound(first, samples, sparse)
        if sound and self.encoder in dense and self.tool in dense:
            tool = {name: signal[:sound] for name, signal in dense[self.tool].items()}
            self.add(first, dense[self.encoder]["angle_true"][:sound], tool)

    def add(self, first: int, angle: Samples, tool: Signals) -> None:
        """Add sound samples.

        Args:
            first: index of the first sample.
            angle: true spindle angle [rad], shape (n,).
            tool: signals of the tool by field; ``error`` [m], and with zones ``height`` [m].

        Raises:
            InputError: a revolution has no sample.
        """
        if first != self._next and angle.size:
            self._begin(turns_before(angle, first))
        self._next = first + angle.size
        self._errors.add(angle, tool["error"])
        if self.zones:
            self._by_zone.add(angle, tool["height"], tool["error"])

    def found(self) -> FormErrors:
        """Return the form error of each complete revolution, as if the run ended after the samples so far."""
        return self._errors.found()

    @property
    def largest(self) -> np.ndarray:
        """Largest form error of each complete revolution [m], shape (revolutions,)."""
        return self._errors.largest()

    @property
    def by_zone(self) -> list[np.ndarray]:
        """Largest form errors outside of all zones and in each [m], shape (revolutions,); empty without zones."""
        return self._by_zone.largest()
