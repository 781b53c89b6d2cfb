# SPDX-License-Identifier: Apache-2.0
"""Monitors of the supervisor, which check signals by `rules`, and the `next_step` of an operator.

The modules in ``__all__`` are public; all others may change.
"""

__all__ = ["monitors"]
