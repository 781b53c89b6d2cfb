# SPDX-License-Identifier: Apache-2.0
"""The signals of a whole run, from whatever host, and their digests."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lathe_rc.cell.messages import NOT_SIGNALS, Samples, Signals


@dataclass(frozen=True)
class SparseTopic:
    """Messages at chosen samples: time stamps [ns] and, by field, one value a message."""

    stamps: list[int] = field(default_factory=list)
    values: dict[str, list[Any]] = field(default_factory=dict)

    def add(self, stamp: int, message: Any) -> None:
        """Append a message."""
        self.append(stamp, {name: value for name, value in vars(message).items() if name not in NOT_SIGNALS})

    def append(self, stamp: int, values: Mapping[str, Any]) -> None:
        """Append the values of a message."""
        self.stamps.append(stamp)
        for name, value in values.items():
            self.values.setdefault(name, []).append(value)


@dataclass(frozen=True)
class Recording:
    """All signal topics of a run.

    Attributes:
        types: message type by fully qualified topic.
        dense: by fully qualified topic, the arrays of each field, shape (samples,).
        sparse: by fully qualified topic.
    """

    types: Mapping[str, str]
    dense: Mapping[str, Signals]
    sparse: Mapping[str, SparseTopic]

    def of_type(self, msgtype: str) -> Signals:
        """The signals of the first topic of a block type."""
        return next(signals for topic, signals in self.dense.items() if self.types[topic] == msgtype)

    def digests(self) -> dict[str, str]:
        """One digest for each signal topic, by topic.

        It is the SHA-256 of the SHA-256 of each field's samples in the order of the fields, little-endian; of sparse
        topics the time stamps come first. Blocks leave no trace in it.
        """
        digester = Digester()
        for topic, signals in self.dense.items():
            digester.dense(topic, signals)
        return digester.result(self.sparse)


class Digester:
    """Digests of a run whose signals come in pieces; see `Recording.digests`."""

    def __init__(self) -> None:
        self._fields: dict[str, dict[str, Any]] = {}

    def dense(self, topic: str, signals: Signals) -> None:
        """Take the next samples of a dense topic, arrays of shape (n,) by field."""
        fields = self._fields.get(topic)
        if fields is None:
            fields = self._fields[topic] = {name: hashlib.sha256() for name in signals}
        for name, samples in signals.items():
            fields[name].update(_bytes(samples))

    def result(self, sparse: Mapping[str, SparseTopic]) -> dict[str, str]:
        """One digest for each topic, the sparse ones whole."""
        found = {topic: [part.digest() for part in fields.values()] for topic, fields in self._fields.items()}
        for topic, part in sparse.items():
            arrays = [np.array(part.stamps, dtype=np.int64), *map(_flat, part.values.values())]
            found[topic] = [hashlib.sha256(_bytes(array)).digest() for array in arrays]
        return {topic: hashlib.sha256(b"".join(parts)).hexdigest() for topic, parts in sorted(found.items())}


def _bytes(samples: Samples) -> memoryview:
    return np.ascontiguousarray(samples, samples.dtype.newbyteorder("<")).data


def _flat(values: Sequence[Any]) -> Samples:
    """One array of a field's values: numbers end to end, texts as their bytes with an end mark."""
    parts = []
    for value in values:
        for item in value if isinstance(value, list) else [value]:
            text = isinstance(item, str)
            parts.append(np.frombuffer(f"{item}\0".encode(), np.uint8) if text else np.atleast_1d(item))
    return np.concatenate(parts) if parts else np.empty(0)
