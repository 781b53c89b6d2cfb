# SPDX-License-Identifier: Apache-2.0
# The public face of lathe_export, and the only list of it.

from lathe_export.tables.export import export_bag as export_bag
