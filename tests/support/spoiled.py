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


def _poison(message: Any, value: float) -> None:
    """Give one sample of the first signal of numbers another value."""
    name = next(name for name, array in _arrays(message).items() if array.dtype == np.float64)
    setattr(message, name, np.where(np.arange(64) == 7, value, getattr(message, name)))


def _tear(message: Any) -> None:
    """Take the last sample off one array alone."""
    name, array = next(iter(_arrays(message).items()))
    setattr(message, name, array[:-1])


KINDS: dict[str, Callable[[Any], object]] = {  #: by name: changes a decoded message in place
    "nan": lambda message: _poison(message, np.nan),
    "infinite": lambda message: _poison(message, -np.inf),
    "gap": lambda message: _shift(message, 64),
    "repeat": lambda message: _shift(message, -64),
    "half a repeat": lambda message: _shift(message, -32),
    "short": lambda message: _cut(message, 63),
    "long": lambda message: _cut(message, 65),
    "empty": lambda message: _cut(message, 0),
    "uneven": _tear,
    "step": lambda message: setattr(message.block, "step_ns", message.block.step_ns + 1),
    "stamp": lambda message: setattr(message.header.stamp, "nanosec", message.header.stamp.nanosec + 1),
    "last": lambda message: setattr(message.block, "last", True),
    "far away": lambda message: setattr(message.block, "first_index", 2**63),
    "another run": lambda message: setattr(message.block, "run_id", "another"),
    "another source": lambda message: setattr(message.block, "source", "/nobody"),
    "no block": id,  # its bytes are cut off
}


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
