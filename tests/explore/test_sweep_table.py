# SPDX-License-Identifier: Apache-2.0
"""The table of a sweep over several commands: one schema, the values with which cells ran, and the code of rows."""

import os
import sys
from pathlib import Path

import pandas as pd
import pyarrow.parquet
import pytest
from click.testing import CliRunner

import lathe_explore
from lathe_explore.sweep import inputs, row
from lathe_explore.sweep.folder import Folder
from lathe_explore.sweep.space import Space
from lathe_rc import allowed_code, extensions, harness
from lathe_rc.cell import scenario as scenarios
from lathe_rc.cell.kinds import STAGES
from lathe_rc.cli import main
from lathe_rc.errors import InputError

LEAD, OWN_MODEL = "learning_controller.lead_time", "learning_controller.model_natural_frequency"
FREQUENCY, RPM = "electrodynamic_actuator.natural_frequency", "spindle_encoder.nominal_rpm"
CONFIG = Path(__file__).parents[2] / "config"


@pytest.fixture(scope="module")
def two_channel():
    return scenarios.load(CONFIG / "two_channel.yaml", ["spindle_encoder.revolutions=2"])


@pytest.fixture(scope="module")
def piston():
    return scenarios.load(CONFIG / "piston.yaml", ["spindle_encoder.revolutions=2"])


def schemas(place):
    return {pyarrow.parquet.read_schema(path).remove_metadata().to_string() for path in (place / "rows").iterdir()}


def check_rows(place, scenario):
    """Compare each row with a run of the values that it has, and the columns of all files with each other."""
    assert len(schemas(place)) == 1
    kept = Folder(place)
    frame = pd.read_parquet(place / "rows").sort_values("cell")
    for each in frame.to_dict("records"):
        values = {name: each[name] for name in kept.targets if not pd.isna(each[name])}
        cell = scenario.varied(values | {"seed": int(each["seed"])} if not pd.isna(each["seed"]) else values)
        assert row.digest(harness.run(cell).recording, []) == each["digest"]
        assert {name: cell.value(name) for name in kept.targets} == {name: each[name] for name in kept.targets}
    assert frame["cell"].is_unique
    return frame


def test_a_further_axis_is_a_column_of_all_rows_with_the_values_that_cells_had(two_channel, client, tmp_path):
    place, own = tmp_path / "rows", two_channel.nodes["electrodynamic_actuator"].natural_frequency
    for grid in (
        {"nominal_rpm": "500"},
        {FREQUENCY: "80%"},
        {RPM: "1000"},
        {FREQUENCY: "80%", OWN_MODEL: [own]},  # given, and therefore not the varied drive's
    ):
        lathe_explore.run_sweep(two_channel, Space(grid=grid), place, client=client)
    frame = check_rows(place, two_channel)
    assert frame[RPM].tolist() == [500.0, 1000.0, 1000.0, 1000.0]
    assert frame[OWN_MODEL].tolist() == [own, 0.8 * own, own, own]


def test_whole_numbers_are_the_same_cells_as_real_ones(piston, client, tmp_path):
    for given in ("900,1000", "900:1000:2", [900]):
        found = lathe_explore.run_sweep(piston, Space(grid={"nominal_rpm": given}), tmp_path / "rows", client=client)
    assert found.table()["nominal_rpm"].to_pylist() == [900.0, 1000.0]


def test_targets_that_set_the_same_parameter_are_refused(piston):
    for one, other in (
        ("nominal_rpm", RPM),
        ("spindle_encoder.deviation_amplitude", "spindle_encoder.deviation_amplitude[0]"),
    ):
        with pytest.raises(InputError, match="set the same parameter; allowed: one of them"):
            Space(grid={other: "1", one: "1"}).check(piston)


@pytest.mark.parametrize("call", range(1, 12))
def test_a_further_axis_survives_an_end_at_any_write(call, piston, tmp_path, monkeypatch):
    """After each write and rename that can be the last of a process, rows are whole, and the next command continues."""
    place, space = tmp_path / "rows", Space(grid={LEAD: [1.3e-3, 1.4e-3]})
    folder = Folder.begin(place, piston, space, [])
    for number, lead in enumerate((1.3e-3, 1.4e-3)):
        told = {"cell": number, "key": str(number), "status": row.DONE, LEAD: lead, "seed": 0}
        folder.write([pyarrow.Table.from_pylist([told], folder.schema)])
    calls = 0

    class Killed(BaseException):
        pass

    def counted(function):
        def counting(*arguments, **options):
            nonlocal calls
            calls += 1
            if calls == call:
                raise Killed
            return function(*arguments, **options)

        return counting

    with monkeypatch.context() as patched:
        patched.setattr(Path, "rename", counted(Path.rename))
        patched.setattr(Path, "replace", counted(Path.replace))
        patched.setattr(os, "fsync", counted(os.fsync))
        patched.setattr("shutil.rmtree", lambda *_, **__: None)  # a killed process does not clean up
        more = Space(grid={"nominal_rpm": "500"})
        try:
            Folder.begin(place, piston, more, [])
        except Killed:
            pass
        else:
            assert call == 11
    seen = Folder(place).table()
    assert seen["cell"].to_pylist() == [0, 1]
    assert len({tuple(pyarrow.parquet.read_schema(path).names) for path in Folder(place)._paths()}) == 1
    found = Folder.begin(place, piston, more, [])
    assert found.table()["nominal_rpm"].to_pylist() == [1000.0, 1000.0]
    assert len(schemas(place)) == 1
    assert sorted(path.name for path in place.iterdir() if path.is_dir()) == ["rows"]


# ---- the code of a row -------------------------------------------------------------------------------------------


LAW = '''
from lathe_machine.stages.drive.electrodynamic_actuator import ElectrodynamicActuator
import my_gain

class Drive(ElectrodynamicActuator):
    """A drive of one's own."""
'''


@pytest.fixture
def own_drive(tmp_path, monkeypatch):
    """A scenario with a drive in the current folder, and a function that edits a module beside it."""
    (tmp_path / "my_gain.py").write_text("GAIN = 1.0\n")
    (tmp_path / "my_drive.py").write_text(LAW)
    monkeypatch.chdir(tmp_path)
    registries = [STAGES._found]

    def forget():
        for name in ("my_drive", "my_gain"):
            sys.modules.pop(name, None)
        for found in registries:
            found.pop("my_drive:Drive", None)
        extensions.source_hash.cache_clear()
        inputs._hash_here.cache_clear()

    def edit(text):
        (tmp_path / "my_gain.py").write_text(text)
        forget()

    def load():
        return scenarios.load(
            CONFIG / "piston.yaml", ["spindle_encoder.revolutions=2", "electrodynamic_actuator.stage=my_drive:Drive"]
        )

    with allowed_code.call(own=True):
        allowed_code.allow("my_drive")
        yield load, edit
    forget()


def test_rows_of_other_code_are_not_mixed(own_drive, client, tmp_path):
    """A module that an own class imports is edited: the folder refuses further cells, and shows the old rows."""
    load, edit = own_drive
    place, space = tmp_path / "rows", Space(grid={LEAD: [1.3e-3]})
    found = lathe_explore.run_sweep(load(), space, place, client=client)
    (before,) = found.table().to_pylist()
    assert before["code"].startswith("xxh3:")
    edit("GAIN = 2.0\n")
    with pytest.raises(InputError, match=r"my_drive:Drive has the hash \w{12} here, and \w{12} in the rows; allowed"):
        lathe_explore.run_sweep(load(), space, place, client=client)
    (other,) = lathe_explore.run_sweep(load(), space, tmp_path / "other", client=client).table().to_pylist()
    assert other["code"] != before["code"]
    assert other["key"] != before["key"]
    edit("GAIN = 1.0\n")
    assert lathe_explore.run_sweep(load(), space, place, client=client).table().to_pylist() == [before]


def test_results_are_shown_without_the_files_and_code_of_the_cell(own_drive, client, tmp_path):
    load, _ = own_drive
    place = tmp_path / "rows"
    lathe_explore.run_sweep(load(), Space(grid={LEAD: [1.3e-3, 1.4e-3]}), place, client=client)
    (tmp_path / "my_drive.py").unlink()
    sys.modules.pop("my_drive")
    STAGES._found.pop("my_drive:Drive")
    done = CliRunner().invoke(main, ["sweep", "show", str(place)])
    assert (done.exit_code, "2 done" in done.stdout) == (0, True)
    again = CliRunner().invoke(main, ["sweep", "show", str(place), "--cell", "0"])
    assert (again.exit_code, "my_drive" in again.stderr) == (2, True)


def test_another_digest_than_in_the_row_is_a_failure(piston, client, tmp_path):
    place = tmp_path / "rows"
    found = lathe_explore.run_sweep(piston, Space(grid={LEAD: [1.3e-3]}), place, client=client)
    (path,) = (place / "rows").iterdir()
    rows = found.table().to_pylist()
    rows[0] |= {"digest": "xxh3:0", "version": "0.0.1"}
    path.unlink()
    found.folder.write([pyarrow.Table.from_pylist(rows, found.folder.schema)])
    for words in ([], ["--json"]):
        done = CliRunner().invoke(main, ["sweep", "show", str(place), "--cell", "0", *words])
        assert done.exit_code == 1
    events = []
    lathe_explore.run_sweep(piston, Space(grid={LEAD: [1.3e-3]}), place, client=client, watch=events.append)
    assert events[0]["others"] == {"0.0.1": 1}


def test_a_sweep_of_another_cell_says_what_differs(piston, tmp_path):
    Folder.begin(tmp_path / "rows", piston, Space(seeds=2), [])
    for changed, said in (
        ({"nominal_rpm": 900.0}, "nominal_rpm = 1000.0 there, and 900.0 here; allowed: a new folder"),
        ({LEAD: 1e-3}, f"{LEAD} = 0.001425 there"),
    ):
        with pytest.raises(InputError, match=f"holds a sweep of another cell: .*{said}"):
            Folder.begin(tmp_path / "rows", piston.varied(changed), Space(seeds=2), [])
