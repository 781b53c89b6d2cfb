# SPDX-License-Identifier: Apache-2.0
"""The machine: physics, control laws and stages of spindle, learning, drives, cut, tool, feed and supervisor.

The core, ``lathe_rc``, runs cells of any stages and finds these by name (`lathe_rc.catalogue`). Without this package it
runs cells of other stages alone. The public names are listed in ``__init__.pyi``.
"""

from lathe_rc import public

__getattr__, __dir__ = public.face(__name__)
