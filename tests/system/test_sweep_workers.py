# SPDX-License-Identifier: Apache-2.0
"""Sweeps whose workers are separate processes that die or are stopped, and sweeps onto a full disk."""

import contextlib
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import dask
import distributed
import numpy as np
import pyarrow.parquet
import pytest
from cells import until

import lathe_explore
from lathe_explore.sweep import row, workers
from lathe_explore.sweep.folder import Folder
from lathe_explore.sweep.space import Space
from lathe_rc import allowed_code
from lathe_rc.cell import scenario

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
from lathe_explore.sweep.workers import client_of

with client_of(None, 1):
    print(*listening(os.getpgrp()))
"""


def test_scheduler_and_workers_of_this_machine_listen_to_it_alone():
    # As a process group of its own: the nodes of tests that run beside this one listen too.
    command = [sys.executable, "-c", WORKERS]
    tests = Path(__file__).parents[1] / "support"
    places = subprocess.check_output(command, cwd=tests, start_new_session=True, text=True).split()
    assert len(places) >= 4  # scheduler, dashboard, nanny, worker
    assert {place.partition(":")[0] for place in places} == {"0100007F"}  # 127.0.0.1


def test_without_shared_memory_the_cause_and_a_cure_are_named(tmp_path):
    alone = 'mount -t tmpfs -o ro tmpfs /dev/shm && exec "$0" -m lathe_rc sweep piston --vary "$1=1e-3:2e-3:2"'
    command = ["unshare", "--mount", "sh", "-c", alone, sys.executable, LEAD]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "Read-only file system); they need a writable /dev/shm" in done.stderr.splitlines()[-1]


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

        found = lathe_explore.run_sweep(piston, space, tmp_path / "rows", scheduler=scheduler, watch=watch)
    assert first.wait() == -signal.SIGKILL
    rows = found.table().to_pylist()
    assert [each["cell"] for each in rows] == list(range(CELLS))
    for each, values in zip(rows, space.cells(piston), strict=True):
        own = row.compute(piston, values, [LEAD], []) | {"seconds": each["seconds"]}
        own = {name: value.tolist() if hasattr(value, "tolist") else value for name, value in own.items()}
        assert own.items() <= each.items()


def test_ctrl_c_keeps_what_is_computed_and_nothing_is_computed_twice(tmp_path):
    # Long cells: after the first file of rows, which is written after some seconds, most are still to be computed.
    words = ["--revolutions=100", "--vary", f"{LEAD}=1.4e-3:1.5e-3:{CELLS}", "--out", str(tmp_path / "rows")]
    with lathe_sweep(*words, start_new_session=True) as stopped:
        for line in stopped.stderr:
            if "dashboard" in line:
                break
        until(lambda: stopped.poll() is not None or any((tmp_path / "rows" / "rows").glob("*.parquet")))
        os.killpg(stopped.pid, signal.SIGINT)  # as a terminal does it
        said = stopped.stderr.read()
    assert stopped.returncode == 130
    assert re.fullmatch(r"lathe: stopped; \d+ of 240 cells are in .*: the same command goes on\n", said)
    parts = sorted((tmp_path / "rows" / "rows").glob("*.parquet"))
    there = {key: path for path in parts for key in pyarrow.parquet.read_table(path)["key"].to_pylist()}
    assert 0 < len(there) < CELLS
    with lathe_sweep(*words) as again:
        assert again.wait() == 0
    table = Folder(tmp_path / "rows").table()
    assert table["cell"].to_pylist() == list(range(CELLS))
    assert len(set(table["key"].to_pylist())) == CELLS
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


POISON = '''
import ctypes, os, sys
import numpy as np
from lathe_machine.stages.drive.electrodynamic_actuator import ElectrodynamicActuator

def fill():
    kept = []
    while True:
        kept.append(np.empty(2**22))

def hang():
    while True:
        pass

KINDS = [hang, lambda: os._exit(9), fill, lambda: ctypes.string_at(0), lambda: 1 / 0, lambda: sys.exit("done")]

class Poison(ElectrodynamicActuator):
    """Ends, blocks or exhausts its process, for dampings below 0.7 according to the sixth digit."""

    def __init__(self, name, parameters):
        if parameters.damping < 0.7:
            KINDS[round(parameters.damping * 1e6) % 10]()
        super().__init__(name, parameters)
'''
DAMPING = "electrodynamic_actuator.damping"
REASONS = [
    "no end within 5 s, in poison.py",
    "its process ended with exit code 9",
    "MemoryError in poison.py",
    "its process was ended by SIGSEGV, in ",
    "ZeroDivisionError in poison.py",
    "SystemExit in poison.py",
]  #: beginnings of the reasons, by kind


@pytest.mark.timeout(3600)
def test_poison_in_a_campaign_costs_its_own_cells_alone(tmp_path, monkeypatch):
    """5 % of the cells end, block or exhaust their process: each has a row with its reason, and the rest is there."""
    whole = os.environ.get("LATHE_CAMPAIGN") == "whole"
    (tmp_path / "poison.py").write_text(POISON)
    monkeypatch.chdir(tmp_path)
    allowed_code.allow("poison")
    poisoned, healthy = (48, 952) if whole else (6, 54)
    poison = [0.6 + 1e-4 * k + 1e-6 * (k % 6) for k in range(poisoned)]
    early, late = np.split(np.linspace(0.75, 0.85, healthy), 2)
    dampings = [*early, *poison, *late]  # early: the first cell of a process may block for half a minute longer
    if whole:
        dampings = np.random.default_rng(1).permutation(dampings).tolist()
    piston = scenario.load(PISTON, ["spindle_encoder.revolutions=3", "electrodynamic_actuator.stage=poison:Poison"])
    space, place, computed = Space(grid={DAMPING: dampings}), tmp_path / "rows", []

    def watch(event):
        if event["event"] == "rows":
            computed.append(event["statuses"].total())

    with (
        dask.config.set(workers._SETTINGS),
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, memory_limit="1.5GB", dashboard_address=None, silence_logs=50
        ) as cluster,
        distributed.Client(cluster, set_as_default=False) as client,
    ):
        options = {"client": client, "cell_time": 5.0, "watch": watch}
        found = lathe_explore.run_sweep(piston, space, place, **options)
        rows = found.table().to_pylist()
        assert [each["cell"] for each in rows] == list(range(poisoned + healthy))
        for each, damping in zip(rows, dampings, strict=True):
            assert each[DAMPING] == damping
            if damping < 0.7:
                assert each["status"] == row.FAILED
                assert each["reason"].startswith(REASONS[round(damping * 1e6) % 10])
            else:
                assert each["status"] == row.DONE
        again = lathe_explore.run_sweep(piston, space, place, **options)
        assert sum(computed) == poisoned + healthy  # the second call computes nothing
        assert again.table().to_pylist() == rows
