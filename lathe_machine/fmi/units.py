# SPDX-License-Identifier: Apache-2.0
"""Units by their powers of the SI base units, as in an FMU's unit definitions."""

import re
from collections.abc import Mapping
from functools import cache
from types import MappingProxyType

Powers = Mapping[str, int]  #: power by SI base unit and ``rad``; those that are missing are 0

BASE = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")

_KNOWN: dict[str, Powers] = {
    **{name: {name: 1} for name in BASE},
    "1": {},
    "rev": {},
    "sample": {},
    "Hz": {"s": -1},
    "N": {"kg": 1, "m": 1, "s": -2},
    "Nm": {"kg": 1, "m": 2, "s": -2},
    "Pa": {"kg": 1, "m": -1, "s": -2},
    "W": {"kg": 1, "m": 2, "s": -3},
    "V": {"kg": 1, "m": 2, "s": -3, "A": -1},
    "ohm": {"kg": 1, "m": 2, "s": -3, "A": -2},
    "Ohm": {"kg": 1, "m": 2, "s": -3, "A": -2},
    "H": {"kg": 1, "m": 2, "s": -2, "A": -2},
    "F": {"kg": -1, "m": -2, "s": 4, "A": 2},
}
_FACTOR = re.compile(r"([A-Za-z]+|1)(?:\^?(-?\d+))?")


@cache
def powers(unit: str) -> Powers | None:
    """Return the powers of a unit without a factor, such as ``m/s^2`` or ``N*s/m``; None if it is not known."""
    found: dict[str, int] = {}
    for place, part in enumerate(unit.replace("²", "^2").split("/")):
        for text in re.split(r"[*.·]", part.strip("() ")):
            match = _FACTOR.fullmatch(text)
            if match is None or match[1] not in _KNOWN:
                return None
            power = int(match[2] or 1) * (1 if place == 0 else -1)
            for name, exponent in _KNOWN[match[1]].items():
                found[name] = found.get(name, 0) + exponent * power
    return MappingProxyType({name: power for name, power in found.items() if power})


def alike(one: Powers, other: Powers) -> bool:
    """Return whether two units measure the same quantity; an angle in radians is a number."""
    return all(one.get(name, 0) == other.get(name, 0) for name in BASE if name != "rad")
