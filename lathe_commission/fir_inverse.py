# SPDX-License-Identifier: Apache-2.0
"""FIR filters that invert a frequency response, of a model or as measured, for the correction ``fir`` of learning.

Without limit on its length the filter with the least Σ(|1 - HG|² + ρ|H|²) is H = conj(G)/(|G|² + ρ). Its product with
the response G has no phase, as with the zero-phase tracking of Tomizuka (1987, ASME J. Dyn. Syst. 109), and falls where
|G|² is below ρ instead of where zeros cannot be inverted. The variance of a measured response is added to ρ: then it is
the expected sum for the true response.
"""

import numpy as np

from lathe_rc.arrays import Array, Complex


def fir_inverse(
    frequency: Array, response: Complex, penalty: Array, *, lead_time: float, interval: float, taps: int
) -> Array:
    """Return the taps hk of H = Σ hk·e^{jω(T0 - kT')} with the least Σ(|1 - HG|² + ρ|H|²), shape (taps,).

    Args:
        frequency: frequencies [rad/s], shape (n,).
        response: G, shape (n,).
        penalty: ρ, shape (n,).
        lead_time: T0 [s].
        interval: T' [s].
        taps: number of taps.
    """
    waves = np.exp(1j * np.outer(frequency, lead_time - interval * np.arange(taps)))
    rows = np.concatenate((waves * response[:, None], waves * np.sqrt(penalty)[:, None]))
    wanted = np.concatenate((np.ones(frequency.size), np.zeros(frequency.size)))
    rows, wanted = np.concatenate((rows.real, rows.imag)), np.concatenate((wanted, np.zeros(wanted.size)))
    return np.asarray(np.linalg.lstsq(rows, wanted, rcond=None)[0])
