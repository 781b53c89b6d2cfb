# SPDX-License-Identifier: Apache-2.0
"""Sweeps whose workers are separate processes that die or are stopped, and sweeps onto a full disk."""

import contextlib
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pyarrow.parquet
import pytest
from cells import until

import lathe_rc
from lathe_rc import allowed_code
from lathe_rc.cell import scenario
from lathe_rc.errors import LatheError
from lathe_rc.sweep import row
from lathe_rc.sweep.folder import Folder
from lathe_rc.sweep.space import Space

pytestmark = pytest.mark.system

LEAD = "learning_controller.lead_time"
CELLS, MANY = 240, 800
PISTON = Path(__file__).parents[2] / "config" / "piston.yaml"


@pytest.fixture
def piston():
    return scenario.load(PISTON, ["spindle_encoder.revolutions=20"])


WORKERS = """
import os
from cells import listening
from lathe_rc.sweep.workers import client_of

with client_of(None, 1):
    print(*listening(os.getpgrp()))
"""


def test_scheduler_and_workers_of_this_machine_listen_to_it_alone():
    # As a process group of its own: the nodes of tests that run beside this one listen too.
    command = [sys.executable, "-c", WORKERS]
    tests = Path(__file__).parents[1]
    places = subprocess.check_output(command, cwd=tests, start_new_session=True, text=True).split()
    assert len(places) >= 4  # scheduler, dashboard, nanny, worker
    assert {place.partition(":")[0] for place in places} == {"0100007F"}  # 127.0.0.1


@contextlib.contextmanager
def program(*words, until):
    """Start a program of Dask and yield the match of ``until`` in its output, and the process."""
    command = [sys.executable, "-m", *words]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        try:
            for line in process.stderr:
                if found := re.search(until, line):
                    break
            else:
                pytest.fail(f"{words}: ended without {until}")
            yield found[0], process
        finally:
            process.kill()


def worker(scheduler):
    return program("distributed.cli.dask_worker", scheduler, "--nthreads=1", "--no-nanny", until="Registered to")


def lathe_sweep(*words, **options):
    command = [sys.executable, "-m", "lathe_rc", "sweep", "piston", "--revolutions=20", *words]
    return subprocess.Popen(command, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE, **options)


def test_a_worker_dies_and_another_one_comes(piston, tmp_path):
    """Every row exists once, with the bits of the same cell computed in this process."""
    space = Space(grid={LEAD: f"1.4e-3:1.5e-3:{CELLS}"})
    with contextlib.ExitStack() as programs:
        start = programs.enter_context
        words = ("distributed.cli.dask_scheduler", "--host=127.0.0.1", "--port=0", "--no-dashboard")
        scheduler, _ = start(program(*words, until=r"tcp://\S+"))
        (_, first), _ = (start(worker(scheduler)) for _ in range(2))
        done = 0

        def watch(event):
            nonlocal done
            if event["event"] == "rows":
                if done < CELLS // 4 <= done + event["statuses"].total():
                    first.kill()
                    start(worker(scheduler))
                done += event["statuses"].total()

        found = lathe_rc.run_sweep(piston, space, tmp_path / "rows", scheduler=scheduler, watch=watch)
    assert first.wait() == -signal.SIGKILL
    rows = found.table().to_pylist()
    assert [each["cell"] for each in rows] == list(range(CELLS))
    for each, values in zip(rows, space.cells(piston), strict=True):
        own = row.compute(piston, values, [LEAD], []) | {"seconds": each["seconds"]}
        own = {name: value.tolist() if hasattr(value, "tolist") else value for name, value in own.items()}
        assert own.items() <= each.items()


def test_ctrl_c_keeps_what_is_computed_and_nothing_is_computed_twice(tmp_path):
    # Long cells: after the first file of rows, which is written after some seconds, most are still to be computed.
    words = ["--revolutions=200", "--vary", f"{LEAD}=1.4e-3:1.5e-3:{MANY}", "--out", str(tmp_path / "rows")]
    with lathe_sweep(*words, start_new_session=True) as stopped:
        for line in stopped.stderr:
            if "dashboard" in line:
                break
        until(lambda: stopped.poll() is not None or any((tmp_path / "rows" / "rows").glob("*.parquet")))
        os.killpg(stopped.pid, signal.SIGINT)  # as a terminal does it
        said = stopped.stderr.read()
    assert stopped.returncode == 130
    assert re.fullmatch(r"lathe: stopped; \d+ of 800 cells are in .*: the same command goes on\n", said)
    parts = sorted((tmp_path / "rows" / "rows").glob("*.parquet"))
    there = {key: path for path in parts for key in pyarrow.parquet.read_table(path)["key"].to_pylist()}
    assert 0 < len(there) < MANY
    with lathe_sweep(*words) as again:
        assert again.wait() == 0
    table = Folder(tmp_path / "rows").table()
    assert table["cell"].to_pylist() == list(range(MANY))
    assert len(set(table["key"].to_pylist())) == MANY
    new = set((tmp_path / "rows" / "rows").glob("*.parquet")) - set(parts)
    assert not there.keys() & {key for path in new for key in pyarrow.parquet.read_table(path)["key"].to_pylist()}


@pytest.mark.parametrize("small_disk", ["100k"], indirect=True)
def test_a_full_disk_is_said_in_a_line_and_what_is_written_is_kept(small_disk):
    words = ["--vary", f"{LEAD}=1.4e-3:1.5e-3:{MANY}", "--out", str(small_disk / "rows"), "--measure", "tool.error:rms"]
    with lathe_sweep(*words) as full:
        _, said = full.communicate()
    assert full.returncode == 1
    (line,) = [line for line in said.splitlines() if line.startswith("lathe:")]
    assert "No space left on device; what was written before is kept" in line
    assert "Traceback" not in said
    kept = Folder(small_disk / "rows").table()
    assert kept["status"].to_pylist() == [row.DONE] * kept.num_rows


DEADLY = '''
import os
from lathe_rc.cell.stages.electrodynamic_actuator import ElectrodynamicActuator

class Deadly(ElectrodynamicActuator):
    """Takes the process with it, as the kernel does where memory runs out."""

    def __init__(self, name, parameters):
        if parameters.damping == 0.75:
            os._exit(9)
        super().__init__(name, parameters)
'''


def test_a_cell_that_kills_its_workers_ends_the_sweep_in_a_line(tmp_path, monkeypatch):
    (tmp_path / "deadly.py").write_text(DEADLY)
    monkeypatch.chdir(tmp_path)
    allowed_code.allow("deadly")
    piston = scenario.load(PISTON, ["spindle_encoder.revolutions=3", "electrodynamic_actuator.stage=deadly:Deadly"])
    space = Space(grid={"electrodynamic_actuator.damping": [0.78, 0.79, 0.8, 0.81, 0.75]})
    with pytest.raises(LatheError, match=r"workers died again and again over cells 4 to 4, .*what is computed is kept"):
        lathe_rc.run_sweep(piston, space, tmp_path / "rows", workers=1)
    assert Folder(tmp_path / "rows").table()["cell"].to_pylist() == [0, 1, 2, 3]
