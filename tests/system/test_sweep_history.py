# SPDX-License-Identifier: Apache-2.0
"""A random history of commands on one folder of a sweep, and its table in the readers that users have."""

import json
import os
import random
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import dask
import distributed
import pytest

import lathe_explore
from lathe_explore.sweep import inputs, row, workers
from lathe_explore.sweep.folder import Folder
from lathe_explore.sweep.space import Space
from lathe_rc import allowed_code, extensions, harness
from lathe_rc.cell import scenario as scenarios
from lathe_rc.cell.kinds import STAGES
from lathe_rc.errors import InputError, LatheError
from uv import uv

pytestmark = pytest.mark.system

LEAD, Q, RPM = "learning_controller.lead_time", "learning_controller.q_time", "nominal_rpm"
VALUES = {
    LEAD: [1.2e-3, 1.3e-3, 1.4e-3, 1.5e-3, 4e-3],  # the last is refused
    Q: [60e-6, 80e-6, 100e-6],
    RPM: [500, 800, 1000],
    "electrodynamic_actuator.damping": [0.7, 0.8],
    "learning_controller.lead_law": ["constant_angle", "variable"],
    "learning_controller.model_damping": [0.75, 0.8],
}
SCENARIO = ["spindle_encoder.revolutions=2", "electrodynamic_actuator.stage=my_drive:Drive"]
PISTON = Path(__file__).parents[2] / "config" / "piston.yaml"
DRIVE = '''
from lathe_machine.stages.drive.electrodynamic_actuator import ElectrodynamicActuator

class Drive(ElectrodynamicActuator):
    """A drive of one's own, version {}."""
'''
READERS = """
    import json, sys
    import duckdb, pandas, polars

    rows = sys.argv[1]
    files = f"{rows}/*.parquet"
    frames = pandas.read_parquet(rows), polars.read_parquet(files).to_pandas(), duckdb.sql(f"FROM '{files}'").df()
    print(json.dumps([json.loads(each.sort_values("cell").to_json(orient="records")) for each in frames]))
"""


@pytest.fixture
def drive(tmp_path, monkeypatch):
    """Function that writes a version of the own drive, as an editor would."""
    monkeypatch.chdir(tmp_path)

    def write(version):
        (tmp_path / "my_drive.py").write_text(DRIVE.format(version))
        sys.modules.pop("my_drive", None)
        STAGES._found.pop("my_drive:Drive", None)
        extensions.source_hash.cache_clear()
        inputs._hash_here.cache_clear()

    with allowed_code.call(own=True):
        allowed_code.allow("my_drive")
        write(1)
        yield write
    STAGES._found.pop("my_drive:Drive", None)


KILLED = """
import lathe_rc
from lathe_rc import allowed_code

if __name__ == "__main__":
    allowed_code.allow("my_drive")
    piston, space = lathe_rc.load({}, {}), lathe_explore.Space(grid={})
    lathe_explore.run_sweep(piston, space, {}, workers=1, watch=lambda event: print(event["event"], flush=True))
"""


def killed(place, grid, events):
    """Run the command in a process of its own, and kill it and its workers after some events."""
    command = [sys.executable, "-c", KILLED.format(repr(str(PISTON)), SCENARIO, grid, repr(str(place)))]
    with subprocess.Popen(command, stdout=subprocess.PIPE, start_new_session=True) as made:
        for _ in range(events):
            made.stdout.readline()
        os.killpg(made.pid, signal.SIGKILL)


@pytest.mark.timeout(3600)
@pytest.mark.parametrize("small_disk", ["3M"], indirect=True)
def test_campaign_rows_of_a_random_history_are_those_of_direct_runs(small_disk, drive, tmp_path):
    """New axes and values, an edited drive, kills, a full disk and two machines: one schema, and no row is wrong."""
    commands = 200 if os.environ.get("LATHE_CAMPAIGN") == "whole" else 24
    lot, place = random.Random(1), small_disk / "rows"  # noqa: S311 - a history, no secret
    done = dict.fromkeys(("run", "refused", "killed", "full", "no room"), 0)
    with (
        dask.config.set(workers._SETTINGS),
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, dashboard_address=None, silence_logs=50
        ) as machines,
        distributed.Client(machines, set_as_default=False) as two,
        distributed.Client(processes=False, n_workers=1, threads_per_worker=1, dashboard_address=None) as one,
    ):
        piston = scenarios.load(PISTON, SCENARIO)

        def run(grid, client):
            return lathe_explore.run_sweep(scenarios.load(PISTON, SCENARIO), Space(grid=grid), place, client=client)

        for number in range(commands):
            axes = lot.sample(sorted(VALUES)[: 2 + 4 * number // commands], lot.randint(1, 2))
            grid = {target: lot.sample(VALUES[target], lot.randint(1, 2)) for target in axes}
            kind = lot.choices(["run", "refused", "killed", "full"], [20, 3, 2, 3])[0]
            client = lot.choice([one, two])
            if kind == "refused" and (place / "sweep.json").exists():
                drive(2)
                with pytest.raises(InputError, match="my_drive:Drive has the hash"):
                    run(grid, client)
                drive(1)
            elif kind == "killed":
                killed(place, grid, lot.randint(1, 4))
            elif kind == "full":
                left = os.statvfs(small_disk)
                (small_disk / "filler").write_bytes(bytes(left.f_bavail * left.f_frsize))
                try:
                    run(grid, client)  # nothing new needs no room
                except LatheError as error:
                    assert "No space left on device" in str(error)  # noqa: PT017 - or no error
                    done["no room"] += 1
                (small_disk / "filler").unlink()
            run(grid, client)
            done[kind] += 1
    print(done)
    folder, table = Folder(place), Folder(place).table()
    rows = table.to_pylist()
    assert [each["cell"] for each in rows] == list(range(len(rows)))
    for each in rows:
        cell = piston.varied({name: each[name] for name in folder.targets if each[name] is not None})
        assert {name: cell.value(name) for name in folder.targets} == {name: each[name] for name in folder.targets}
        if each["status"] == row.DONE:
            assert row.digest(harness.run(cell).recording, []) == each["digest"]
        else:
            assert each["status"] == row.REFUSED
    venv = tmp_path / "readers"
    uv("venv", "--quiet", "--python", sys.executable, venv)
    uv("pip", "install", "--quiet", "--python", venv / "bin" / "python", "pandas", "pyarrow", "polars", "duckdb")
    command = [venv / "bin" / "python", "-c", textwrap.dedent(READERS), place / "rows"]
    read = json.loads(subprocess.check_output(command, text=True))
    assert read[0] == read[1] == read[2]
    assert [list(each) for each in read[0]] == [table.column_names] * len(rows)
    assert [each["digest"] for each in read[0]] == [each["digest"] for each in rows]
