# SPDX-License-Identifier: Apache-2.0
"""``lathe measure`` and its profiles: the measurements of a bag agree with the turned part."""

import json

import numpy as np
import pytest
from bags import lathe
from cells import scenario
from numpy.testing import assert_allclose

from lathe_machine.signals import measured_profile
from lathe_rc import harness
from lathe_rc.judge import part

ORDERS, AMPLITUDES = [1, 2, 12], [20e-6, 100e-6, 2e-6]


@pytest.fixture(scope="module")
def turned(tmp_path_factory):
    """The bag and the result of six revolutions."""
    bag = tmp_path_factory.mktemp("turned") / "bag"
    given = {"profile": "harmonics", "harmonic_order": ORDERS, "harmonic_amplitude": AMPLITUDES, "feed": 1e-3}
    result = harness.run(scenario(spindle_encoder={"revolutions": 6.2}, tool=given), bag=bag)
    return bag, result


def test_a_bag_is_measured_as_the_run_was(turned):
    bag, result = turned
    told = json.loads(lathe("measure", bag, "--revolutions", "1,3-6", "--json").stdout)
    assert [line["revolution"] for line in told["revolutions"]] == [1, 3, 4, 5, 6]
    assert told["revolutions"] == [part.numbers(result.part, k) for k in (0, 2, 3, 4, 5)]


def test_before_anything_is_learned_the_form_itself_is_missing(turned):
    _, result = turned
    first = part.numbers(result.part, 0)
    assert first["largest_upr"] == {"upr": 2, "amplitude": pytest.approx(100.0, rel=0.03)}
    assert np.hypot(*first["centre"]) == pytest.approx(20.0, rel=0.03)
    assert first["ront"] < first["peak_to_valley"]


def test_written_profiles_are_read_back_at_their_heights(turned, tmp_path):
    bag, result = turned
    path = tmp_path / "parts.csv"
    assert lathe("measure", bag, "--revolutions", "1,2", "--profile", path).exit_code == 0
    back = measured_profile.read_csv(path)
    angle = 2 * np.pi * np.arange(100) / 100
    for k in (0, 1):
        expected = np.interp(angle, 2 * np.pi * np.arange(4096) / 4096, result.part.profile[k])
        assert_allclose(back.deviation(angle, (k + 0.5) * 1e-3), expected, atol=2e-7)


def test_the_last_profile_of_a_run_is_written(tmp_path):
    path = tmp_path / "profile.csv"
    done = lathe("run", "piston", "--revolutions", "3", "--profile", path)
    assert done.exit_code == 0, done.output
    assert path.read_text(encoding="utf-8").splitlines()[:2] == [
        "# deviation from the desired form, revolution 3",
        "angle_deg,radius_um",
    ]
