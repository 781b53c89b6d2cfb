# SPDX-License-Identifier: Apache-2.0
"""Pictures and tables of plain arrays: what results show of themselves. Knows no cell."""
