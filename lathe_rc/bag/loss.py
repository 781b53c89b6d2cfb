# SPDX-License-Identifier: Apache-2.0
"""Loss of members or blocks in a recorded run: the sample at which the readers of its bag end, and the reason.

From there on samples of lost members or lost blocks are held, and samples of all other nodes may rest on held ones.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from lathe_rc.errors import InputError

HELD = "lathe_rc.held"  #: for each topic of a lost node, the sample from which its last value was held
GAPS = "lathe_rc.gaps"  #: for each topic of a free-running cell that a reader lost blocks of, the first lost sample
SOUND = "lathe_rc.sound"  #: number of samples of a run with lost members that do not rest on held ones
_MOST_TOPICS, _LONGEST = 256, 256
_MOST_SAMPLES = 2**48


@dataclass(frozen=True)
class Loss:
    """Loss of members in a recorded run.

    Attributes:
        first: first sample that is held, or may rest on held samples.
        why: the topics that are held, or the cell's safe state.
    """

    first: int
    why: str

    def __str__(self) -> str:
        """Return sample and reason as text."""
        return f"not read from sample {self.first} on: {self.why}"


def held(about: Mapping[str, str], key: str = HELD) -> dict[str, int]:
    """Return, for each topic of a lost node, the sample from which its last value was held; or the entry `GAPS`.

    Raises:
        InputError: the entry is not in the recorder's format.
    """
    try:
        told = json.loads(about.get(key, "{}"))
        found = {str(topic)[:_LONGEST]: int(first) for topic, first in list(told.items())[:_MOST_TOPICS]}
    except (ValueError, TypeError, AttributeError, RecursionError, OverflowError):
        raise _wrong(about, key, '{"/TOPIC": SAMPLE, ...}') from None
    if not all(0 <= first < _MOST_SAMPLES for first in found.values()):
        raise _wrong(about, key, "samples from 0 on")
    return found


def loss_of(about: Mapping[str, str]) -> Loss | None:
    """Return the loss of members or blocks in a bag's run; None if all members ran to its end without a loss.

    Raises:
        InputError: an entry is not in the recorder's format.
    """
    lost, text = held(about) or held(about, GAPS), about.get(SOUND)
    if text is None and not lost:
        return None
    if text is not None and not (text.isascii() and text.isdigit() and len(text) < len(str(_MOST_SAMPLES))):
        raise _wrong(about, SOUND, "a number of samples")
    first = min(int(text) if text is not None else _MOST_SAMPLES, *lost.values(), _MOST_SAMPLES)
    if not lost:
        return Loss(first, "the cell went to its safe state")
    earliest = min(lost, key=lambda topic: (lost[topic], topic))
    more = f", and so {'are' if len(lost) > 2 else 'is'} {len(lost) - 1} more" if len(lost) > 1 else ""
    why = "its node was lost" if held(about) else "where blocks were lost"
    return Loss(first, f"{earliest} is held from sample {lost[earliest]} on, {why}{more}")


def together(abouts: Sequence[Mapping[str, str]]) -> dict[str, str]:
    """Return the entries for a bag with messages of several bags: all held topics, and the earliest loss.

    Raises:
        InputError: an entry is not in the recorder's format.
    """
    losses = [loss.first for about in abouts if (loss := loss_of(about))]
    merged: dict[str, str] = {}
    for key in (HELD, GAPS):
        lost: dict[str, int] = {}
        for topic, first in (each for about in abouts for each in held(about, key).items()):
            lost[topic] = min(first, lost.get(topic, first))
        merged |= {key: json.dumps(lost)} if lost or key == HELD else {}
    return {**merged, SOUND: str(min(losses))} if losses else {}


def _wrong(about: Mapping[str, str], key: str, allowed: str) -> InputError:
    return InputError(f"{key} = {about[key][:80]!r} in the bag; allowed: what a recorder writes, {allowed}")
