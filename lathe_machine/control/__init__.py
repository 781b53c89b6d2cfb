# SPDX-License-Identifier: Apache-2.0
"""Control laws.

The modules in ``__all__`` are public; all others may change. Learning over the angle: `repetitive` with `angle_memory`,
`lead`, `correction`, `q_filter`, `interpolation` and `memory_file`; `disturbance` with `disturbance_memory` and
`angle_filter`; `identification` of drive models. Control of slides: `pid`, `sampled_link`, `periodic`, `decoupler` and
`predistortion`. Limits on commands: `limits`, `bounded`.
"""

__all__ = ["decoupler", "pid", "predistortion", "q_filter", "sampled_link"]
