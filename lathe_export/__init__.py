# SPDX-License-Identifier: Apache-2.0
"""Recordings as tables, and stages as C libraries, functional mock-up units (FMUs) or HAL components.

The public names are listed in ``__init__.pyi``.
"""

from lathe_rc import public

__getattr__, __dir__ = public.face(__name__)
