# SPDX-License-Identifier: Apache-2.0
"""One file of every kind that lathe_rc writes and reads again, and damage to it."""

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet

from lathe_explore.sweep import row, study, tune
from lathe_explore.sweep.folder import Folder, Request
from lathe_explore.sweep.space import Space
from lathe_explore.sweep.study import TuningStudy
from lathe_explore.sweep.sweep import ignore
from lathe_machine.control import memory_file
from lathe_machine.signals import profile_table
from lathe_rc import jit
from lathe_rc.cell import checkpoint, program, scenario
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import LatheError

CONFIG = Path(__file__).parents[2] / "config"
OWN = "learning_controller"
LEAD = f"{OWN}.lead_time"


class Kept(NamedTuple):
    """A file, and what its reader makes of it."""

    path: Path
    read: Callable[[], object]


def load() -> scenario.Scenario:
    """A cell that learns."""
    return scenario.load(CONFIG / "piston.yaml", ["spindle_encoder.revolutions=4"])


def made_up(number: int, key: str, lead: float) -> dict[str, Any]:
    """A row that nothing was computed for."""
    error = abs(lead - 1.3e-3) + 1e-6
    found = {"cell": number, "key": key, "status": row.DONE, LEAD: lead, "tool.rms_error": error, "margin": 0.2}
    return found | {"tool.max_errors": [error, 2 * error], "seconds": 0.1, "seed": 0, "version": "1", "digest": key}


def swept(path: Path) -> Folder:
    """A sweep of 40 cells."""
    leads = np.linspace(1e-3, 2e-3, 40).tolist()
    folder = Folder.begin(path, load(), Space(grid={LEAD: leads}), [row.measure("coarse/state.effort:max", load())])
    rows = [made_up(number, f"{number:032x}", lead) for number, lead in enumerate(leads)]
    folder.write([pa.Table.from_pylist(rows, folder.schema)])
    return folder


def computed(_crew: object, order: Any, jobs: Any, *_: object) -> Any:
    """Rows for the jobs of a tuning, in place of `lathe_explore.sweep.workers.rows`."""
    yield pa.Table.from_pylist([made_up(job.number, job.key, job.values[LEAD]) for job in jobs], order.schema)


def tuned(path: Path, trials: int = 8) -> Folder:
    """A tuning whose rows are made up; `computed` has to stand in for the workers."""
    told = Request([LEAD], {LEAD: "1e-3:2e-3"}, ["tool.rms_error"], [], 100.0, Space(), "tpe", 0, 4, formulas=False)
    start = load().varied({LEAD: 1.8e-3})
    folder = Folder.begin(path, start, None, [], told)
    state = TuningStudy(folder)
    while asked := state.ask(trials):
        state.compute(None, asked, ignore)
    return folder


def parquet(columns: dict[str, list[Any]]) -> bytes:
    """A file of rows."""
    content = io.BytesIO()
    pyarrow.parquet.write_table(pa.table(columns), content)
    return content.getvalue()


def _rows(folder: Path) -> Kept:
    path = swept(folder / "sweep").path
    return Kept(path / "rows" / "000000.parquet", lambda: Folder(path).table().to_pylist())


def _sweep(folder: Path) -> Kept:
    path = swept(folder / "sweep").path

    def read() -> object:
        found = Folder(path)
        return found.scenario.name, found.measures, found.spaces, found.tuning, found.targets

    return Kept(path / "sweep.json", read)


def _scenario(folder: Path) -> Kept:
    path = swept(folder / "sweep").path
    return Kept(path / "scenario.yaml", lambda: Folder(path).scenario)


def _journal(folder: Path) -> Kept:
    path = tuned(folder / "tuning").path
    return Kept(path / "trials.log", lambda: [tuple(trial) for trial in tune.load(path).trials])


def _memory(folder: Path) -> Kept:
    path = folder / "memory"
    memory_file.save(path, np.random.default_rng(1).standard_normal(128), 128)
    return Kept(path, lambda: memory_file.load(path, 128, 128).tobytes())


def _checkpoint(folder: Path) -> Kept:
    path, cell = folder / "checkpoint", Cell(load().nodes)
    checkpoint.save(path, checkpoint.take(load(), cell.stages, 1, {}))
    return Kept(path, lambda: repr(checkpoint.load(path)))


def _table(_folder: Path) -> Kept:
    def read() -> object:
        return profile_table.kept(b"one", lambda: np.linspace(0.0, 1.0, 64)).tobytes()

    read()
    (path,) = (jit.cache_folder() / "tables").iterdir()
    return Kept(path, read)


def _compiled(suffix: str) -> Callable[[Path], Kept]:
    def made(_folder: Path) -> Kept:
        def read() -> object:
            passes = jit.kernel(program._passes.py_func)
            return [passes(np.arange(9.0), turn) for turn in (-1.0, 4.0, 8.0, 9.0)]

        read()
        (path,) = jit.cache_folder().glob(f"*/program._passes*{suffix}")
        return Kept(path, read)

    return made


CACHED = ("table of a form", "index of compiled code", "compiled code")
KINDS: dict[str, Callable[[Path], Kept]] = {
    "rows of a sweep": _rows,
    "sweep.json": _sweep,
    "scenario of a sweep": _scenario,
    "journal of a tuning": _journal,
    "memory of a controller": _memory,
    "checkpoint": _checkpoint,
    "table of a form": _table,
    "index of compiled code": _compiled(".nbi"),
    "compiled code": _compiled(".nbc"),
}


def flip(kept: Kept, bits: int, said: Callable[[], str]) -> int:
    """Flip single bits of a file, one after the other, and read it each time.

    Args:
        kept: the file.
        bits: how many.
        said: gives the lines on the error stream since the last call.

    Returns:
        How many of them were noticed; the others changed nothing.

    Raises:
        AssertionError: a value has changed in silence, or the refusal is none in one line that names the file.
    """
    whole, expected, noticed = kept.path.read_bytes(), kept.read(), 0
    size = 8 * len(whole)
    # The same bits each time: the first and the last, and as many between them as were asked for.
    for bit in np.linspace(0, size - 1, bits).astype(int) ^ np.arange(bits) % 8:
        content = bytearray(whole)
        content[bit // 8] ^= 1 << bit % 8
        kept.path.write_bytes(content)
        said()
        try:
            found = kept.read()
        except LatheError as error:
            told, found = f"{error}\n", expected
        else:
            told = said()
        noticed += bool(told)
        assert found == expected or str(kept.path) in told, (bit, found)
        assert not told or (str(kept.path) in told and told.count("\n") == 1), (bit, told)
    kept.path.write_bytes(whole)
    assert kept.read() == expected
    return noticed


def made(kind: str, monkeypatch: Any, folder: Path) -> Kept:
    """A file of a kind, in a cache of its own if it is part of one; tunings have no workers."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(folder))
    monkeypatch.setattr(study, "rows", computed)
    if kind in CACHED:
        monkeypatch.setenv("NUMBA_CACHE_DIR", str(folder))
    return KINDS[kind](folder)
