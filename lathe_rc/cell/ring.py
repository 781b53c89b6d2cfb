# SPDX-License-Identifier: Apache-2.0
"""The recent past of a topic in an offline host, which writes it chunk by chunk."""

from collections.abc import Collection, Mapping
from math import ceil, lcm

import numpy as np

from lathe_rc.cell import messages
from lathe_rc.cell.messages import Samples, Signals


class Ring:
    """Samples of a topic: the newest chunk and, of fields that are read late, those before it that this needs.

    A chunk goes where the oldest one was: nothing is moved, and little memory is touched, which is what counts.
    Before sample 0 everything is zero. What is handed out is good until the next chunk.

    Args:
        msgtype: message type of the topic.
        delays: longest delay at which each field is read [sample].
        chunk: length of every chunk but the last, which may be shorter [sample].
        lanes: length of a second axis, for cells that run at once; 0: there is none.
        shared: fields without it.

    Attributes:
        period: chunks after which the same memory comes again.
    """

    def __init__(
        self, msgtype: str, delays: Mapping[str, int], chunk: int, lanes: int = 0, shared: Collection[str] = ()
    ) -> None:
        types = messages.sample_fields(msgtype)
        chunks = {name: 1 + ceil(delay / chunk) for name, delay in delays.items()}
        self._delays = delays
        self._arrays = {
            name: np.zeros((count * chunk, lanes) if lanes and name not in shared else count * chunk, types[name])
            for name, count in chunks.items()
        }
        self.period = lcm(*chunks.values())

    def newest(self, first: int, samples: int) -> Signals:
        """Views of the next chunk, for the caller to fill; it begins at sample ``first``."""
        return self.view(first, samples, 0)

    def view(self, first: int, samples: int, delay: int) -> Signals:
        """What a port with this delay reads at the samples ``first`` on; a view if the delay is whole chunks."""
        return {
            name: _piece(array, (first - delay) % len(array), samples)
            for name, array in self._arrays.items()
            if delay <= self._delays[name]
        }


def _piece(array: Samples, start: int, samples: int) -> Samples:
    over = start + samples - len(array)
    return np.concatenate((array[start:], array[:over])) if over > 0 else array[start : start + samples]
