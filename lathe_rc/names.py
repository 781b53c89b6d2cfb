# SPDX-License-Identifier: Apache-2.0
"""Name utilities: options ``NAME=VALUE``, suggestions for unknown names, namespaces of cells (``/`` or ``/a/b``)."""

import re
from collections.abc import Iterable
from difflib import get_close_matches

from lathe_rc.errors import InputError, shown

_NAMESPACE = re.compile(r"/|(/[A-Za-z_][A-Za-z0-9_]*)+")
_MOST_CLOSE = 3
_MOST_LISTED = 16  # maximum number of names that a message lists


def _in(name: str, other: str) -> bool:
    """Return whether a name of at least two characters is contained in another one."""
    return len(name) > 1 and name in other


def instead(name: str, known: Iterable[str], *, listing: str = "") -> str:
    """Suggest replacements for an unknown name, as readable text.

    Args:
        name: the unknown name.
        known: all known names.
        listing: command or place that lists all names; empty if there is none.
    """
    names = list(known)
    close = dict.fromkeys([*get_close_matches(name, names, _MOST_CLOSE), *(each for each in names if _in(name, each))])
    if close:
        *most, last = map(shown, list(close)[:_MOST_CLOSE])
        words = f"{', '.join(most)} or {last}" if most else last
        return f"did you mean {words}?" + (f" ({listing} lists all)" if listing else "")
    if listing and len(names) > _MOST_LISTED:
        return f"{listing} lists what is allowed"
    return f"allowed: {', '.join(map(shown, names)) or 'none'}"


def pairs(option: str, texts: Iterable[str], allowed: str) -> dict[str, str]:
    """Parse the values ``NAME=VALUE`` of an option into values by name.

    Args:
        option: name of the option.
        texts: its values.
        allowed: description of what is allowed, for the error message.

    Raises:
        InputError: a text has another form, or a name is given twice.
    """
    found: dict[str, str] = {}
    for text in texts:
        name, equals, value = (part.strip() for part in text.partition("="))
        if not (name and equals and value):
            raise InputError(f"{option} {text!r}; allowed: {allowed}")
        if name in found:
            raise InputError(f"{option} {text!r}: {name} is given twice; allowed: once")
        found[name] = value
    return found


def checked_namespace(namespace: str) -> str:
    """Check a ROS namespace and return it.

    Raises:
        InputError: the string is not a valid namespace.
    """
    if not _NAMESPACE.fullmatch(namespace):
        raise InputError(f"namespace {namespace!r}; allowed: / or /NAME or /NAME/NAME, of letters, digits and _")
    return namespace


def absolute(namespace: str, name: str) -> str:
    """Return a name as an absolute name in a namespace."""
    return name if name.startswith("/") else f"{namespace.rstrip('/')}/{name}"
