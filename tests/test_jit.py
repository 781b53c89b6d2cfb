# SPDX-License-Identifier: Apache-2.0
"""The cache of compiled kernels."""

import re
from pathlib import Path

import lathe_rc
from lathe_rc import jit

PACKAGE = Path(lathe_rc.__file__).parent


def test_the_cache_knows_every_file_with_a_kernel():
    """A kernel in a file that it does not look at would go on with old arithmetic."""
    looked_at = {PACKAGE / "jit.py", *(path for pattern in jit._KERNELS for path in PACKAGE.glob(pattern))}
    uses = re.compile(r"^from lathe_rc\.jit import|^from lathe_rc import .*\bjit\b", re.MULTILINE)
    with_kernels = {path for path in PACKAGE.rglob("*.py") if uses.search(path.read_text(encoding="utf-8"))}
    assert with_kernels - looked_at == set()
    assert len(with_kernels) > 30
