# SPDX-License-Identifier: Apache-2.0
"""Quantities of measurements, the names that their columns have in files, and their units.

A column is named by its quantity, or by another name that laboratories use, with its unit after it: ``time_ms``,
``t [ms]``, ``time / ms``, ``|H| (dB)``.
"""

import re
from collections.abc import Collection, Iterable, Mapping
from typing import NamedTuple

import numpy as np

from lathe_rc.errors import InputError
from lathe_rc.names import pairs

_LENGTHS = {"m": 1.0, "mm": 1e-3, "um": 1e-6, "nm": 1e-9, "in": 25.4e-3}
_LENGTH = {**_LENGTHS, "": 1.0, "1": 1.0}
_RATIO = {"": 1.0, "1": 1.0, "%": 1e-2, "pct": 1e-2}
_DECIBEL = "db"
_TURN = 2.0 * np.pi

UNITS: Mapping[str, Mapping[str, float]] = {
    "time": {"s": 1.0, "sec": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "": 1.0},
    "command": _LENGTH,
    "response": _LENGTH,
    "displacement": _LENGTH,
    "position": _LENGTHS,
    "offset": _LENGTHS,
    "force": {"n": 1.0, "kn": 1e3, "mn": 1e-3},
    "frequency": {"hz": _TURN, "khz": 1e3 * _TURN, "rad/s": 1.0, "rad_s": 1.0, "": _TURN},
    "speed": {"rpm": 1.0, "1/min": 1.0, "min^-1": 1.0, "u/min": 1.0, "hz": 60.0, "rad/s": 60.0 / _TURN},
    "magnitude": {**_RATIO, _DECIBEL: 1.0},
    "phase": {"deg": np.pi / 180.0, "°": np.pi / 180.0, "rad": 1.0, "": np.pi / 180.0},
    "real": _RATIO,
    "imaginary": _RATIO,
    "coherence": _RATIO,
    "relative_uncertainty": _RATIO,
    "state": {"": 1.0, "1": 1.0},
    "angle": {"deg": _TURN / 360.0, "°": _TURN / 360.0, "rad": 1.0, "rev": _TURN},
    "radius": _LENGTHS,
    "height": _LENGTHS,
    "revolution": {"": 1.0, "1": 1.0},
}  #: factors to [s, m, N, rad/s, 1, rad], of a speed to 1/min, by quantity and unit; "": no unit known
_OTHER_NAMES = {
    "time": "t zeit",
    "command": "cmd set_point setpoint",
    "response": "resp",
    "frequency": "f freq frequenz",
    "speed": "n rpm drehzahl",
    "magnitude": "mag |h| |g| |h(f)| |h(jw)| |g(jw)|",
    "phase": "phi arg",
    "real": "re re(h) re(g) realteil",
    "imaginary": "im imag im(h) im(g) imaginärteil",
    "coherence": "coh gamma2 gamma^2 gamma² γ2 γ^2 γ² kohärenz",
    "angle": "winkel",
    "height": "z",
}
_KNOWN = {unit for units in UNITS.values() for unit in units} - {""}
_PLAIN = "|".join(sorted(map(re.escape, _KNOWN - {"1"}), key=len, reverse=True))
_NAMED = re.compile(
    r"(?P<name>.*?)(?:[\s_]*[\[(]\s*(?P<bracket>[^\[\]()]*?)\s*[\])]|\s*/\s*(?P<slash>\S+)|"
    rf"[\s_]+(?P<plain>{_PLAIN}))?",
    re.IGNORECASE,
)


def _micro(text: str) -> str:
    return text.strip().replace("µ", "u").replace("μ", "u")


def _plain(text: str) -> str:
    """Return a name or a unit in the spelling of this module."""
    return re.sub(r"\s+", "_", _micro(text)).casefold()


def _names(quantity: str) -> list[str]:
    return [quantity, *_OTHER_NAMES.get(quantity, "").split()]


def unit_of(quantity: str, column: str) -> str | None:
    """Return the unit in the name of a column; None if it has none."""
    text = _plain(column)
    if text == "rpm":
        return text
    found = _NAMED.fullmatch(_micro(column))
    if found is None or text in _names(quantity):
        return None
    if (unit := found["bracket"]) is not None:
        return unit if re.search("[^\\W\\d]|[%°]", unit) else None  # "[2]" is no unit
    unit = found["slash"] or found["plain"]
    return unit if unit and _plain(unit) in UNITS[quantity] else None


def rank(quantity: str, column: str) -> int:
    """Return 2 for a column named by a quantity, with or without its unit, 1 for another name of it, otherwise 0."""
    found = _NAMED.fullmatch(_micro(column))
    unit = found and (found["slash"] or found["plain"])
    parted = found is not None and (not unit or _plain(unit) in UNITS[quantity])
    texts = {_plain(column)} | ({_plain(found["name"])} if found and parted else set())
    first, *others = _names(quantity)
    return 2 if first in texts else int(not texts.isdisjoint(others))


def is_quantity(column: str) -> bool:
    """Return whether a column is named by a quantity."""
    return any(rank(quantity, column) for quantity in UNITS)


def is_unit(text: str) -> bool:
    """Return whether a field below a header is a unit, in brackets or without."""
    return _plain(text).strip("[]()- ") in _KNOWN | {""}


def factor(quantity: str, unit: str) -> float | None:
    """Return the value of 1 in a unit: one of `UNITS`, or a number, the SI value of 1; None for another text."""
    units = UNITS.get(quantity, {})
    found = units.get(_plain(unit))
    if found is None:
        try:
            found = float(unit) * units.get("rad/s", 1.0)
        except ValueError:
            return None
    return found if np.isfinite(found) and found else None


def is_decibel(unit: str) -> bool:
    """Return whether a unit is a logarithmic ratio."""
    return _plain(unit) == _DECIBEL


class Mapped(NamedTuple):
    """Column of a quantity as a user names it; an empty unit: that of the column."""

    column: str
    unit: str = ""


def parse_columns(given: Iterable[str], names: Collection[str] = UNITS) -> dict[str, Mapped]:
    """Parse the values ``NAME=COLUMN[:UNIT]`` of ``--column``; the unit may be a number, the SI value of 1.

    Args:
        given: values of the option.
        names: quantities that are allowed; empty: any name, with numbers as units.

    Raises:
        InputError: a text has another form, a name or a unit is unknown, or a name is given twice.
    """
    form = f"QUANTITY=COLUMN[:UNIT], QUANTITY of {', '.join(names)}" if names else "TARGET=COLUMN[:FACTOR]"
    found = {}
    for name, text in pairs("--column", given, form).items():
        column, colon, unit = text.rpartition(":")
        option = f"--column {f'{name}={text}'!r}"
        if (names and name not in names) or (colon and not column):
            raise InputError(f"{option}; allowed: {form}")
        if colon and factor(name, unit) is None:
            units = [each for each in UNITS.get(name, ()) if each]
            known = f"{', '.join(units)}, or a number, the SI value of 1" if units else "a number"
            raise InputError(f"{option}: no unit {unit!r} of {name}; allowed: {known}")
        found[name] = Mapped(column, unit) if colon else Mapped(text)
    return found
