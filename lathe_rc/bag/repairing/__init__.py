# SPDX-License-Identifier: Apache-2.0
"""Making bags readable that were cut off or broken."""
