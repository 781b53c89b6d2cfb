# SPDX-License-Identifier: Apache-2.0
"""Plants and signals under test: runs in blocks, amplitudes of sines, and refusals."""

import re

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


def line_of(make):
    """The one line with which a call is refused."""
    with pytest.raises(InputError) as refused:
        make()
    assert len(str(refused.value).splitlines()) == 1
    return str(refused.value)


def assert_refused(make, message):
    """The call is refused with one line that matches."""
    assert re.search(message, line := line_of(make)), line
