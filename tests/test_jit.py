# SPDX-License-Identifier: Apache-2.0
"""The cache of compiled kernels."""

import re
from pathlib import Path

import pytest

import lathe_rc
from lathe_rc import jit
from lathe_rc.cell import ahead
from lathe_rc.cell.scenario import TABLES
from lathe_rc.cell.stages import STAGES
from lathe_rc.errors import LatheError

PACKAGE = Path(lathe_rc.__file__).parent


def test_the_cache_knows_every_file_with_a_kernel():
    """A kernel in a file that it does not look at would go on with old arithmetic."""
    looked_at = {PACKAGE / "jit.py", *(path for pattern in jit._KERNELS for path in PACKAGE.glob(pattern))}
    uses = re.compile(r"^from lathe_rc\.jit import|^from lathe_rc import .*\bjit\b", re.MULTILINE)
    with_kernels = {path for path in PACKAGE.rglob("*.py") if uses.search(path.read_text(encoding="utf-8"))}
    assert with_kernels - looked_at == set()
    assert len(with_kernels) > 30


def test_a_process_that_cannot_compile_is_an_error(monkeypatch):
    monkeypatch.setattr(ahead.native, "compiled", set)
    monkeypatch.setattr(ahead.sys, "executable", "/bin/false")
    stage = STAGES["profile"]("form", TABLES["profile"].read("form", {"stage": "profile"}))
    with pytest.raises(LatheError, match="a process that compiles"):
        list(ahead.compile_ahead([stage]))
