# SPDX-License-Identifier: Apache-2.0
"""What lathe_rc reaches on the machine at hand, as ratios measured side by side; ``lathe bench`` runs it.

Each part is a module with a function ``measure(*, quick, say)`` that returns what it found as plain numbers.
"""
