# SPDX-License-Identifier: Apache-2.0
"""What breaks, what notices it, and what is done about it."""
