# SPDX-License-Identifier: Apache-2.0
"""Models of drives, spindle and cutting process. The modules in ``__all__`` are public; all others may change.

Tool drives: `electrodynamic`, `piezo` with `hysteresis`, `tool_drive` with `tool_motion` and `coil` (both drives in
series, under the cutting force); `linear` discretises drives. Cut: `cutting` with `chip`, `cutting_force`, `workpiece`.
Slides: `feed` with `feed_models`, `friction`, `screw`. Spindle under the load of the cut: `spindle`.
"""

__all__ = ["feed", "feed_models", "hysteresis"]
