# SPDX-License-Identifier: Apache-2.0
# The public face of lathe_commission, and the only list of it; the names of `ilc` are in its ``__all__``.

from lathe_commission import ilc as ilc
