# SPDX-License-Identifier: Apache-2.0
"""Control laws. The modules in ``__all__`` are public, all others may change."""

__all__ = ["decoupler", "pid", "predistortion", "q_filter", "sampled_link"]
