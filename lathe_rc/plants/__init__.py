# SPDX-License-Identifier: Apache-2.0
"""The plants: tool drives and the tool itself. The modules in ``__all__`` are public, all others may change."""

__all__ = ["feed", "feed_models", "hysteresis"]
