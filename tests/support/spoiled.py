# SPDX-License-Identifier: Apache-2.0
"""Bad blocks of a member that goes on: what a program by others, or a fault of memory, may send once.

`spoil` makes the next processes of a cell send one bad block, by a module that Python imports at their start.
"""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from lathe_rc import messages

KINDS: dict[str, Callable[[Any], object]] = {}  #: by name: changes a decoded message in place


def kind(change: Callable[[Any], object]) -> Callable[[Any], object]:
    KINDS[change.__name__.replace("_", " ").strip()] = change
    return change


def _arrays(message: Any) -> dict[str, Any]:
    return {name: each for name, each in vars(message).items() if isinstance(each, np.ndarray)}


def _cut(message: Any, samples: int) -> None:
    """Give all arrays another length; the stamp is that of the last sample."""
    before = next(iter(_arrays(message).values())).size
    for name, array in _arrays(message).items():
        setattr(message, name, np.resize(array, samples))
    message.header.stamp.nanosec += (samples - before) * message.block.step_ns


def _shift(message: Any, samples: int) -> None:
    message.block.first_index += samples
    message.header.stamp.nanosec += samples * message.block.step_ns


@kind
def nan(message):
    name = next(name for name, array in _arrays(message).items() if array.dtype == np.float64)
    setattr(message, name, np.where(np.arange(64) == 7, np.nan, getattr(message, name)))


@kind
def infinite(message):
    name = next(name for name, array in _arrays(message).items() if array.dtype == np.float64)
    setattr(message, name, np.where(np.arange(64) == 7, -np.inf, getattr(message, name)))


@kind
def gap(message):
    _shift(message, 64)


@kind
def repeat(message):
    _shift(message, -64)


@kind
def half_a_repeat(message):
    _shift(message, -32)


@kind
def short(message):
    _cut(message, 63)


@kind
def long(message):
    _cut(message, 65)


@kind
def empty(message):
    _cut(message, 0)


@kind
def uneven(message):
    setattr(message, name := next(iter(_arrays(message))), getattr(message, name)[:-1])


@kind
def step(message):
    message.block.step_ns += 1


@kind
def stamp(message):
    message.header.stamp.nanosec += 1


@kind
def last(message):
    message.block.last = True


@kind
def far_away(message):
    message.block.first_index = 2**63


@kind
def another_run(message):
    message.block.run_id = "another"


@kind
def another_source(message):
    message.block.source = "/nobody"


@kind
def no_block(message):
    """Bytes that are cut off."""


def spoil_encoder(source: str, kind: str, sample: int) -> None:
    """Spoil the first block that holds a sample, of those that a node of this process publishes."""
    from lathe_rc.blocks.wire import Encoder

    encode = Encoder.encode
    waits = True

    def spoiled(self: Encoder, first: int, signals: Any, *, last: bool, companions: int) -> tuple[int, bytes]:
        nonlocal waits
        log_ns, data = encode(self, first, signals, last=last, companions=companions)
        if waits and self._source == source and first >= sample:
            waits = False
            message = messages.decode(self._type, data)
            KINDS[kind](message)
            data = messages.encode(self._type, message)[: 40 if kind == "no block" else None]
        return log_ns, data

    Encoder.encode = spoiled


_AT_START = """
import sys

class Finder:
    def find_spec(self, name, path=None, target=None):
        if name == "lathe_rc.nodes.outputs":
            sys.meta_path.remove(self)
            sys.path.append({tests!r})
            from spoiled import spoil_encoder
            spoil_encoder({source!r}, {kind!r}, {sample})

sys.meta_path.insert(0, Finder())
"""


def spoil(folder: Path, source: str, kind: str, sample: int) -> str:
    """Write the module that spoils a block; return the search path with which processes import it."""
    text = _AT_START.format(tests=str(Path(__file__).parent), source=source, kind=kind, sample=sample)
    (folder / "sitecustomize.py").write_text(text, encoding="utf-8")
    return f"{folder}:{os.environ.get('PYTHONPATH', '')}"
