# SPDX-License-Identifier: Apache-2.0
"""ROS namespaces of cells: ``/`` or ``/a/b``."""

import re

from lathe_rc.errors import InputError

_NAMESPACE = re.compile(r"/|(/[A-Za-z_][A-Za-z0-9_]*)+")


def checked(namespace: str) -> str:
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
