# SPDX-License-Identifier: Apache-2.0
"""Names: suggestions for an unknown one, and ROS namespaces of cells, ``/`` or ``/a/b``."""

import re
from collections.abc import Iterable
from difflib import get_close_matches

from lathe_rc.errors import InputError, shown

_NAMESPACE = re.compile(r"/|(/[A-Za-z_][A-Za-z0-9_]*)+")
_MOST_CLOSE = 3
_MOST_LISTED = 16  # names that a message lists; more of them are looked up elsewhere


def _in(name: str, other: str) -> bool:
    """Whether a name is what somebody remembers of another one."""
    return len(name) > 1 and name in other


def instead(name: str, known: Iterable[str], *, listing: str = "") -> str:
    """The names that may replace an unknown one, in words.

    Args:
        name: that nobody has.
        known: the names that there are.
        listing: what lists them all, a command or a place; empty: nothing does.
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


def checked_namespace(namespace: str) -> str:
    """The namespace, if it is one.

    Raises:
        InputError: it is none.
    """
    if not _NAMESPACE.fullmatch(namespace):
        raise InputError(f"namespace {namespace!r}; allowed: / or /NAME or /NAME/NAME, of letters, digits and _")
    return namespace


def absolute(namespace: str, name: str) -> str:
    """A name after its namespace has been put before it."""
    return name if name.startswith("/") else f"{namespace.rstrip('/')}/{name}"
