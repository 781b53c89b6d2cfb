# SPDX-License-Identifier: Apache-2.0
"""Bags at work: cells simulated again, messages published again, any topics recorded.

The public names are listed in ``__init__.pyi``.
"""

from lathe_rc import public

__getattr__, __dir__ = public.face(__name__)
