# SPDX-License-Identifier: Apache-2.0
"""Formulas that only the papers need."""

__all__ = ["coupled_loops", "hyperstability", "periodic_example", "sampled_loop"]
