# SPDX-License-Identifier: Apache-2.0
"""Faults, monitors and reactions. The modules in ``__all__`` are public, all others may change."""

__all__ = ["monitors"]
