# SPDX-License-Identifier: Apache-2.0
"""Faults, monitors and reactions.

The modules in ``__all__`` are public; all others may change. `faults` defines the kinds of faults, and `injection`
applies them at ports. The alarms of `monitors`, which check signals by `rules`, drive the `state_machine`.
"""

__all__ = ["monitors"]
