# SPDX-License-Identifier: Apache-2.0
"""Many variations of a cell: sweeps into a table, and the search for parameters that meet given goals.

The public names are listed in ``__init__.pyi``.
"""

from lathe_rc import public

__getattr__, __dir__ = public.face(__name__)
