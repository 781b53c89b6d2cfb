# SPDX-License-Identifier: Apache-2.0
"""Plants and signals under test: runs in blocks, amplitudes of sines, and refusals."""

import numpy as np
import pytest
from cells import in_blocks

from lathe_rc.errors import InputError


def run(block, rows, *inputs, lengths=None):
    """Rows of outputs, shape (rows, n), that ``block(first, *inputs, *outputs)`` fills in blocks of some lengths."""
    outputs = np.full((rows, inputs[0].size), np.nan)
    in_blocks(lengths or [inputs[0].size], block, *inputs, *outputs)
    return outputs


def amplitude(signal, frequency, period, step):
    """Complex amplitude of a sine in the last ``period`` samples; 1 for a sine of amplitude 1 from sample 0 on."""
    time = np.arange(signal.size)[-period:] * step
    return 2j / period * (signal[-period:] * np.exp(-1j * frequency * time)).sum()


def refusals(*rows):
    """Parametrise a test by calls and what the lines match with which they are refused."""
    return pytest.mark.parametrize(("make", "message"), rows)


def assert_refused(make, message):
    """The call is refused with one line that matches."""
    with pytest.raises(InputError, match=message) as refusal:
        make()
    assert len(str(refusal.value).splitlines()) == 1
