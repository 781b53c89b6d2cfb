# SPDX-License-Identifier: Apache-2.0
"""Snapshots: bags of a section of a run, and the metadata that describes the section."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from lathe_rc.errors import InputError

SNAPSHOT = "lathe_rc.snapshot"  #: metadata entry with the section of the run that the bag covers, and the triggers
GONE_ON = "lathe_rc.gone_on"  #: metadata entry with the first sample of a run that goes on from a checkpoint
SNAPSHOTS_GONE_ON = "snapshots of a run from a checkpoint; allowed: --set recorder.mode=continuous, or no bag"

_MOST_SAMPLES = 2**48
_MOST_TRIGGERS = 1000  # triggers of a snapshot that are listed individually


@dataclass
class Snapshot:
    """Bag of a section of the run around one or more triggers.

    Attributes:
        path: path of the bag.
        first: first sample of the section.
        last: last sample of the section, if the run continues until then.
        wanted: last sample requested by any trigger.
        triggers: sample and cause of each trigger, at most `_MOST_TRIGGERS`.
        further: number of triggers beyond those listed.
        samples: number of samples; 0 until the snapshot is closed.
        whole: whether the run continued until `wanted`; False until the snapshot is closed.
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
        """Add a trigger, which may extend the snapshot."""
        if len(self.triggers) < _MOST_TRIGGERS:
            self.triggers.append((sample, cause))
        else:
            self.further += 1
        self.wanted, self.last = max(wanted, self.wanted), max(last, self.last)

    def about(self) -> dict[str, str]:
        """Return the snapshot's entry in the metadata of its bag."""
        told = {"first_sample": self.first, "samples": self.samples, "whole": self.whole, "triggers": self.triggers}
        return {SNAPSHOT: json.dumps(told | ({"further_triggers": self.further} if self.further else {}))}


def span_of(about: Mapping[str, str]) -> tuple[int, int] | None:
    """Return the first sample and the number of samples of a snapshot (0 if it was never closed); None for a whole run.

    Args:
        about: strings from the bag's metadata.

    Raises:
        InputError: the snapshot entry is not in the recorder's format.
    """
    text = about.get(SNAPSHOT)
    if text is None:
        return None
    try:
        told = json.loads(text)
        span = told["first_sample"], told["samples"]
    except (ValueError, KeyError, TypeError, RecursionError):
        span = None, None
    if not all(type(number) is int and 0 <= number < _MOST_SAMPLES for number in span):
        raise InputError(
            f"{SNAPSHOT} = {text[:80]!r} in the bag; allowed: what a recorder writes, with first_sample and samples"
        )
    return span


def first_sample(about: Mapping[str, str]) -> int:
    """Return the first sample of a bag: 0, or the beginning of a snapshot or of a run from a checkpoint.

    Args:
        about: strings from the bag's metadata.

    Raises:
        InputError: an entry is not in the recorder's format.
    """
    if span := span_of(about):
        return span[0]
    text = about.get(GONE_ON, "0")
    if not (text.isascii() and text.isdigit() and int(text[:16]) < _MOST_SAMPLES):
        raise InputError(f"{GONE_ON} = {text[:80]!r} in the bag; allowed: the first sample of the run")
    return int(text)
