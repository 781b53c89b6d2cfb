# SPDX-License-Identifier: Apache-2.0
"""The cache of compiled kernels."""

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import lathe_rc
from lathe_rc import jit
from lathe_rc.cell import ahead, program
from lathe_rc.cell.kinds import STAGES
from lathe_rc.cell.scenario import TABLES
from lathe_rc.errors import InputError, LatheError

PACKAGE = Path(lathe_rc.__file__).parent


def test_the_cache_knows_every_file_with_a_kernel():
    """A kernel in a file that it does not look at would go on with old arithmetic."""
    looked_at = {PACKAGE / "jit.py", *(path.resolve() for pattern in jit._KERNELS for path in PACKAGE.glob(pattern))}
    uses = re.compile(
        r"^from lathe_rc\.jit import (?!SOURCES$|cache_folder$|check_compiler$)|^from lathe_rc import .*\bjit\b",
        re.MULTILINE,
    )
    with_kernels = {
        path for path in PACKAGE.parent.glob("lathe_*/**/*.py") if uses.search(path.read_text(encoding="utf-8"))
    }
    assert with_kernels - looked_at == set()
    assert len(with_kernels) > 30


@pytest.fixture
def stage():
    return STAGES["profile"]("form", TABLES["profile"].read("form", {"stage": "profile"}))


def test_a_process_that_cannot_compile_is_an_error(stage, monkeypatch):
    monkeypatch.setattr(ahead, "is_kept", lambda _: False)
    monkeypatch.setattr(ahead.sys, "executable", "/bin/false")
    with pytest.raises(LatheError, match="a process that compiles"):
        list(ahead.compile_ahead([stage]))


def test_a_cache_that_cannot_be_written_is_said_once_and_stops_nothing(stage, monkeypatch, capsys):
    monkeypatch.setenv("NUMBA_CACHE_DIR", "/dev/null/none")
    jit.say_not_kept.cache_clear()
    passes = jit.kernel(program._passes.py_func)
    assert passes(np.arange(9.0), 4.0)
    assert not passes(np.arange(9.0), 9.0)
    assert list(ahead.compile_ahead([stage])) == []  # each process compiles for itself
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert "compiled code cannot be kept (Not a directory), so that each process compiles it for itself" in told


def of_a_process(folder, code, **environment):
    """Output of a new Python process in a folder."""
    words, environment = [sys.executable, "-c", code], os.environ | environment
    done = subprocess.run(words, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    return done.stdout + done.stderr


def test_compiled_code_is_kept_in_the_environment_if_the_users_cache_cannot_be_written(tmp_path):
    code = "from lathe_rc import jit; print(jit.cache_folder().parent)"
    for place, folder in ((tmp_path / "new", tmp_path / "new"), ("/dev/null", Path(sys.prefix, "var", "cache"))):
        printed = of_a_process(tmp_path, code, NUMBA_CACHE_DIR="", XDG_CACHE_HOME=str(place))
        assert printed == f"{folder / 'lathe_rc'}\n"


def test_a_settings_file_of_numba_in_the_current_folder_is_not_read(tmp_path):
    """Neither as Numba is imported nor as it compiles; the environment remains the user's choice."""
    (tmp_path / ".numba_config.yaml").write_text("disable_jit: 1\n")
    code = (
        "import lathe_rc.jit, numba; print(numba.config.DISABLE_JIT, int(numba.config.OPT));"
        "numba.njit(lambda: 1)(); print(numba.config.DISABLE_JIT, int(numba.config.OPT))"
    )
    assert of_a_process(tmp_path, code, NUMBA_OPT="2") == "0 2\n0 2\n"


def test_an_offline_run_without_a_compiler_is_refused_by_name(monkeypatch):
    piston = lathe_rc.load("piston")
    monkeypatch.setattr(jit.numba.config, "DISABLE_JIT", 1)
    with pytest.raises(InputError, match=r"NUMBA_DISABLE_JIT = 1; allowed: 0 or unset"):
        lathe_rc.run(piston)
