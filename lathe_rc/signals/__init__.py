# SPDX-License-Identifier: Apache-2.0
"""What enters the cell: spindle speed laws, encoder, part profiles."""
