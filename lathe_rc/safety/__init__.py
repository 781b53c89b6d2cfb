# SPDX-License-Identifier: Apache-2.0
"""Faults, monitors and reactions.

The modules in ``__all__`` are public, all others may change. `faults` and `injection`: kinds of faults and their
application at ports. `monitors` with their `rules`, and the `state_machine` driven by their alarms.
"""

__all__ = ["monitors"]
