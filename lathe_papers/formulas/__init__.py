# SPDX-License-Identifier: Apache-2.0
"""Formulas used only by the studies of the papers."""

__all__ = ["coupled_loops", "hyperstability", "periodic_example", "sampled_loop"]
