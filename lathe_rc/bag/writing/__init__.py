# SPDX-License-Identifier: Apache-2.0
"""Writing bags: what a recorder writes, in which order, and snapshots."""
