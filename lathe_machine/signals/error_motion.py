# SPDX-License-Identifier: Apache-2.0
"""Error motion of a spindle that repeats with its angle, in the direction of the tool.

    m(φ) = Σ a_i·sin(i·φ + ψ_i),   i ≥ 2, positive where the part moves towards the tool

A tool at rest cuts this motion into the part. The motion is between spindle and housing, so neither the encoder nor the
sensor of a drive measures it. One wave a revolution is the eccentricity of the part, none its size. Source: ISO 230-7,
synchronous error motion of an axis of rotation in a fixed sensitive direction.
"""

import numpy as np

from lathe_rc.arrays import Array
from lathe_rc.jit import kernel


@kernel
def add_motion(lines: Array, angle: Array, error: Array) -> None:
    """Add an error motion to a form error [m] at true angles [rad], shape (n,).

    ``lines`` has shape (3, m): waves per revolution, amplitude [m] and phase [rad].
    """
    for k in range(error.size):
        for i in range(lines.shape[1]):
            error[k] += lines[1, i] * np.sin(lines[0, i] * angle[k] + lines[2, i])
