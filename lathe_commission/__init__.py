# SPDX-License-Identifier: Apache-2.0
"""From measurements to a cell: models of measured drives, learning laws for them, and corrected forms.

The public names are listed in ``__init__.pyi``.
"""

from lathe_rc import public

__getattr__, __dir__ = public.face(__name__)
