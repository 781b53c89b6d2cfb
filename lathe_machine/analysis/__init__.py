# SPDX-License-Identifier: Apache-2.0
"""Analysis of the machine's loops and models. The modules in ``__all__`` are public; all others may change.

Loops: `learning`, `feedback`, `pid_tuning`, `regeneration`. Models of drives: `drive_fit`, `modal_drive`,
`rational_model`. `shaft`: compliance of the part.
"""

__all__ = ["shaft"]
