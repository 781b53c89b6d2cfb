# SPDX-License-Identifier: Apache-2.0
"""Snapshots: bags of a part of a run, and their text about that part."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from lathe_rc.errors import InputError

SNAPSHOT = "lathe_rc.snapshot"  #: text of a bag that says which part of the run it has, and why

_MOST_TRIGGERS = 1000  # of a snapshot, that are told one by one


@dataclass
class Snapshot:
    """A bag of a part of the run.

    Attributes:
        path: of the bag.
        first: its first sample.
        last: its last sample, if the run goes on until then.
        wanted: the sample that the last trigger asks for.
        triggers: sample and cause of each, at most `_MOST_TRIGGERS`.
        further: triggers beyond those.
        samples: its length; 0 until it is closed.
        whole: the run went on until `wanted`; False until it is closed.
    """

    path: Path
    first: int
    last: int
    wanted: int = 0
    triggers: list[tuple[int, str]] = field(default_factory=list)
    further: int = 0
    samples: int = 0
    whole: bool = False

    def add(self, sample: int, cause: str, wanted: int, last: int) -> None:
        """Take a trigger."""
        if len(self.triggers) < _MOST_TRIGGERS:
            self.triggers.append((sample, cause))
        else:
            self.further += 1
        self.wanted, self.last = max(wanted, self.wanted), max(last, self.last)

    def about(self) -> dict[str, str]:
        """The metadata of its bag."""
        told = {"first_sample": self.first, "samples": self.samples, "whole": self.whole, "triggers": self.triggers}
        return {SNAPSHOT: json.dumps(told | ({"further_triggers": self.further} if self.further else {}))}


def span_of(about: Mapping[str, str]) -> tuple[int, int] | None:
    """First sample and number of samples of a snapshot; no samples if it was never closed. None for a whole run.

    Args:
        about: what the bag says of itself.

    Raises:
        InputError: what it says of the snapshot is not what a recorder writes.
    """
    text = about.get(SNAPSHOT)
    if text is None:
        return None
    try:
        told = json.loads(text)
        span = told["first_sample"], told["samples"]
    except (ValueError, KeyError, TypeError, RecursionError):
        span = None, None
    if not all(type(number) is int and 0 <= number < 2**48 for number in span):
        raise InputError(
            f"{SNAPSHOT} = {text[:80]!r} in the bag; allowed: what a recorder writes, with first_sample and samples"
        )
    return span


def first_sample(about: Mapping[str, str]) -> int:
    """The first sample of a bag: 0, or where a snapshot begins.

    Args:
        about: what the bag says of itself.

    Raises:
        InputError: what it says of the snapshot is not what a recorder writes.
    """
    span = span_of(about)
    return span[0] if span else 0
