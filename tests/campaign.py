# SPDX-License-Identifier: Apache-2.0
"""Size of the campaigns in tests/system: a tenth, or the whole with LATHE_CAMPAIGN=whole in the environment."""

import os


def sized(number: int) -> int:
    """Return the number of cases to try of a whole campaign."""
    return number if os.environ.get("LATHE_CAMPAIGN") == "whole" else -(-number // 10)
