# SPDX-License-Identifier: Apache-2.0
"""The table of a sweep over a history of commands: one schema, values with which cells ran, and the code of each row."""

import json
import os
import sys
from pathlib import Path

import pandas as pd
import pyarrow.parquet
import pytest
from click.testing import CliRunner

import lathe_rc
from lathe_rc import allowed_code, extensions, files, harness
from lathe_rc.cell import scenario as scenarios
from lathe_rc.cli import main
from lathe_rc.errors import InputError, LatheError
from lathe_rc.sweep import row
from lathe_rc.sweep.folder import Folder
from lathe_rc.sweep.space import Space

LEAD, OWN_MODEL = "learning_controller.lead_time", "learning_controller.model_natural_frequency"
FREQUENCY, RPM = "electrodynamic_actuator.natural_frequency", "spindle_encoder.nominal_rpm"
CONFIG = Path(__file__).parents[1] / "config"


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
        lathe_rc.run_sweep(two_channel, Space(grid=grid), place, client=client)
    frame = check_rows(place, two_channel)
    assert frame[RPM].tolist() == [500.0, 1000.0, 1000.0, 1000.0]
    assert frame[OWN_MODEL].tolist() == [own, 0.8 * own, own, own]


def test_whole_numbers_are_the_same_cells_as_real_ones(piston, client, tmp_path):
    for given in ("900,1000", "900:1000:2", [900]):
        found = lathe_rc.run_sweep(piston, Space(grid={"nominal_rpm": given}), tmp_path / "rows", client=client)
    assert found.table()["nominal_rpm"].to_pylist() == [900.0, 1000.0]


def test_targets_that_set_the_same_parameter_are_refused(piston):
    for one, other in (("nominal_rpm", RPM), ("spindle_encoder.deviation_amplitude", "spindle_encoder.deviation_amplitude[0]")):
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
