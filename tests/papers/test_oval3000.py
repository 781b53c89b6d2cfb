# SPDX-License-Identifier: Apache-2.0
"""The benchmark ``lathe study oval3000``, its drives, and the law ADRC that takes part in it from a package."""

import json

import numpy as np
import pytest
from click.testing import CliRunner
from machines import line_of
from matplotlib.figure import Figure

from lathe_papers import cells, oval3000
from lathe_papers.adrc import Adrc
from lathe_papers.judge import Judge, Judged
from lathe_rc.cell.wiring import Cell
from lathe_rc.cli import main
from lathe_rc.commands.study import read
from lathe_rc.study import STUDIES, untracked

STUDY = STUDIES["oval3000"]


def found(*settings):
    """The result of the quick study, once its table and figure have been made."""
    result = STUDY.run(read(STUDY, ["quick=true", *settings]))
    result.draw(Figure())
    result.table()
    return result


def test_scores_of_the_second_set_are_those_of_its_seed():
    """With the published seed as the fresh one, both sets have the same drives, noise, speed and scores."""
    same, other = (found(f"fresh_seed={seed}", "laws=001,ours") for seed in (oval3000.PUBLISHED, 7))
    assert same.seeds == [oval3000.PUBLISHED] * 2
    assert other.seeds == [oval3000.PUBLISHED, 7]
    for name in ("largest", "settled", "effort", "margin"):
        first, second = getattr(same, name)
        np.testing.assert_array_equal(first, second)
        np.testing.assert_array_equal(first, getattr(other, name)[0])
    assert np.all(other.largest[0] != other.largest[1])
    # The worst and the median of two drives with their own seeds, and with another one.
    np.testing.assert_array_equal(other.seeded[..., 0], [other.largest.max(axis=-1), other.largest.min(axis=-1)])
    assert np.all(np.diff(other.seeded) != 0.0)
    # A law that leads the memory alone errs by what the speed varies within a revolution.
    assert np.all(same.largest[:, :, 1] < same.largest[:, :, 0])
    assert np.all(same.margin[:, :, 1] > 0.3)


def test_a_fresh_seed_is_drawn_and_told(monkeypatch):
    monkeypatch.setattr(oval3000.secrets, "randbelow", lambda largest: largest - 5)
    told = found("laws=ours").to_json()
    assert told["seeds"] == [oval3000.PUBLISHED, 2**31 - 4]
    assert np.shape(told["worst_um"]) == (2, 1, 1, 2)


def test_drives_fill_their_ranges():
    base = cells.load("oval3000")
    drawn = oval3000.drives_of(base, 5, 1000)
    assert drawn == oval3000.drives_of(base, 5, 1000)
    for name, spread in (
        ("natural_frequency", 0.2), ("damping", 0.2), ("delay", 0.2),
        ("mode_frequency", 0.1), ("mode_damping", 0.5), ("mode_participation", 0.5),
    ):  # fmt: skip
        target = f"loaded_drive.coarse_{name}"
        factors = np.array([each[target] for each in drawn]) / np.array(base.value(target))
        low, high = factors.min(axis=0), factors.max(axis=0)
        assert np.all((1.0 - spread < low) & (low < 1.0 - 0.98 * spread)), name
        assert np.all((1.0 + 0.98 * spread < high) & (high < 1.0 + spread)), name
    frequency, mass = (
        np.array([each[f"loaded_drive.coarse_{name}"] for each in drawn])
        for name in ("natural_frequency", "moving_mass")
    )
    stiffness = mass * frequency**2
    assert 1.4 < stiffness.max() / stiffness.min() < 1.5
    assert len({each["seed"] for each in drawn}) == len(drawn)


def test_a_gauge_corrects_what_no_sensor_of_the_harder_cell_measures():
    """The study judges each zone by its tolerance, as the verdict of a run does."""
    length = {"spindle_encoder": {"revolutions": 40.0}}
    made = [cells.load("oval3000_hard", **length, **other) for other in ({}, {"controller": {"remap": []}})]
    gauge, sensors = (each.excess(2.0)[:40][-10:].max() for each in cells.kept(made, Judge, untracked))
    zones = cells.run("oval3000_hard", **length).verdict.zones
    assert gauge == pytest.approx(max(zone.largest / zone.tolerance for zone in zones))
    assert gauge < 0.5
    assert sensors > 0.9


def test_a_law_enters_from_the_current_folder_with_its_parameters(tmp_path, monkeypatch):
    """A law in a module of the current folder gets the scores of the same law that is installed."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "oval_entry.py").write_text("from lathe_papers.adrc import Adrc\n\n\nclass Mine(Adrc):\n    pass\n")
    values = {name: oval3000.LAWS["ADRC"][name] for name in ("observer_bandwidth", "control_bandwidth")}
    told = " ".join(f"{name}={value}" for name, value in values.items())
    options = ["--law", "oval_entry:Mine", "--set", "laws=ADRC", "--set", f"law_set={told}", "--set", "fresh_seed=1"]
    result = CliRunner().invoke(main, ["study", "oval3000", "--quick", "--json", *options])
    assert result.exit_code == 0, result.output
    scores = json.loads(result.stdout)
    assert scores["laws"] == ["ADRC", "Mine"]
    for name in ("worst_um", "median_um", "effort_a"):
        for by_condition in scores[name]:
            assert all(own == installed for own, installed in by_condition), name


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (["law=nolaw"], ["no law 'nolaw'", "disturbance_controller", "adrc", "PACKAGE.MODULE:CLASS"]),
        (["law=tool"], ["no law 'tool'"]),
        (["law=adrc", "law_set=observer"], ["law_set: 'observer'", "PARAM=VALUE"]),
        (["law=adrc", "law_set=bandwidth=3"], ["bandwidth: unknown parameter", "observer_bandwidth"]),
        (["law_set=observer_bandwidth=3"], ["without a law", "PACKAGE.MODULE:CLASS"]),
    ],
)
def test_a_law_that_cannot_enter_is_refused_in_one_line(settings, words):
    refused = line_of(lambda: found(*settings))
    for word in words:
        assert word in refused
    assert refused.count("PACKAGE.MODULE:CLASS") <= 1


QUIET = {
    "spindle_encoder.random_rms": 0.0, "spindle_encoder.counts_per_revolution": 0,
    "loaded_drive.coarse_noise_rms": 0.0, "loaded_drive.coarse_mode_frequency": [],
    "loaded_drive.coarse_mode_damping": [], "loaded_drive.coarse_mode_participation": [],
}  # fmt: skip
STEADY = {
    "loaded_drive.cut_gap_start": [], "loaded_drive.cut_gap_width": [], "loaded_drive.cut_blank": "form",
}  # fmt: skip


def test_adrc_removes_a_constant_force_and_a_part_of_the_keyways():
    """With its model exact ADRC leaves nothing of the form or of a constant force, and something of each keyway."""
    base = cells.load("oval3000", spindle_encoder={"revolutions": 15.0})
    forward = {"stage": "compound_controller", "proportional": 0.0, "integral": 0.0, "derivative": 0.0}

    def error(law, **changes):
        cell = oval3000.entered(base, {**oval3000._ANY, **law}).varied({**QUIET, **changes})
        (judged,) = cells.kept([cell], Judge, untracked)
        return judged.largest[6:14].max()

    adrc = oval3000.LAWS["ADRC"]
    assert error(adrc, **STEADY, **{"loaded_drive.radial_ratio": 0.0}) < 0.01
    assert error(adrc, **STEADY) < 0.01
    assert error(forward, **STEADY) > 10.0
    assert 1.0 < error(adrc) < 0.5 * error(forward)


@pytest.mark.parametrize("bandwidth", [300.0, 1000.0, 4000.0])
def test_poles_of_the_observer_are_at_its_bandwidth(bandwidth):
    """The error of the discrete observer decays by exp(-ωo·T) per sample, with a triple pole."""
    law = oval3000.entered(cells.load("oval3000"), {**oval3000.LAWS["ADRC"], "observer_bandwidth": bandwidth})
    memory = Cell(law.nodes).stages["controller"].start()
    decay = memory.transition - np.outer(memory.gains, memory.transition[0])
    pole = np.exp(-bandwidth * memory.step)
    np.testing.assert_allclose(np.poly(decay), np.poly([pole] * 3), rtol=0.0, atol=1e-12)
    # for a short step the gains are those of the continuous observer
    frequency, damping = 1036.7, 0.7
    first = 3.0 * bandwidth - 2.0 * damping * frequency
    second = 3.0 * bandwidth**2 - frequency**2 - 2.0 * damping * frequency * first
    np.testing.assert_allclose(
        memory.gains / memory.step, [first, second, bandwidth**3], rtol=2.0 * bandwidth * memory.step
    )


@pytest.mark.parametrize(
    ("errors", "revolution"),
    [([1.0, 1.0], 1), ([3.0, 1.0, 3.0, 1.0], 4), ([1.0, np.nan, 1.0], 3), ([1.0, 3.0], np.inf)],
)
def test_revolutions_until_settled_are_counted_from_1(errors, revolution):
    assert Judged(np.array(errors), 0.0, 0.0).settled(2.0) == revolution


def test_the_scenario_has_the_settings_of_ours():
    own = cells.load("oval3000").nodes["controller"]
    assert oval3000.LAWS["ours"].items() <= {**own.model_dump(), **oval3000._ANY}.items()


def test_adrc_is_offered_as_the_laws_of_packages_are():
    assert oval3000.TABLES["adrc"] is Adrc.Parameters
