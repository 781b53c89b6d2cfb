# SPDX-License-Identifier: Apache-2.0
"""Faults, monitors and reactions. The modules in ``__all__`` are public, all others may change.

`faults` and `injection`: what breaks, and at which ports. `monitors` with their `rules`, and the `state_machine` that
their alarms lead through.
"""

__all__ = ["monitors"]
