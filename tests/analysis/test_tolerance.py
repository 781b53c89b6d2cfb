# SPDX-License-Identifier: Apache-2.0
"""The verdict of a run: in tolerance from which revolution on, and what says so."""

import json
import re

import numpy as np
import pytest
from bags import lathe
from cells import config, scenario
from hypothesis import given
from hypothesis import strategies as st

from lathe_explore.sweep import row
from lathe_rc import harness
from lathe_rc.analysis.tolerance import LAST, growth, judge
from lathe_rc.bag import provenance
from lathe_rc.errors import InputError
from lathe_rc.judge import part
from lathe_rc.signals.zones import Zone

errors = st.lists(st.sampled_from([0.5, 1.0, 1.5, 3.0]), max_size=30)
SHORT = ("run", "piston", "--revolutions", "5")


def page_of(bag, *options):
    """The report of a bag."""
    page = bag.with_suffix(".html")
    done = lathe("report", bag, *options, "-o", page)
    assert done.exit_code == 0, done.output
    return page.read_text(encoding="utf-8")


# --- the rule


@given(errors)
def test_in_tolerance_from_the_revolution_after_the_last_that_is_not(largest):
    found = judge(np.array(largest), 1.0)
    since = max((number for number, value in enumerate(largest, 1) if value > 1.0), default=0) + 1
    assert found.revolutions == len(largest)
    assert found.in_tolerance == (since <= len(largest))
    if found.in_tolerance:
        assert found.since == since
        assert found.over == (max(since, len(largest) - LAST + 1), len(largest))
        assert found.spare == 1.0 - max(largest[found.over[0] - 1 :])
    elif largest:
        assert (found.since, found.spare, found.over) == (0, 1.0 - largest[-1], (len(largest), len(largest)))


def test_revolutions_before_the_first_that_is_there_count():
    found = judge(np.array([3.0, 0.5]), 1.0, before=40)
    assert (found.since, found.over) == (42, (42, 42))


LEARNS = np.array([150.0, 20.0, 3.0])
RIPPLE = 1.0 + 0.4 * np.sin(2.2 * np.arange(60))


@pytest.mark.parametrize(
    ("largest", "since"),
    [
        (100.0 * 1.3 ** np.arange(12), 2),
        (np.concatenate([LEARNS, 1.2 ** np.arange(20)]), 5),
        (np.concatenate([LEARNS, np.hypot(RIPPLE, 1e-4 * 1.25 ** np.arange(60))]), 46),
        (np.concatenate([LEARNS, np.minimum(1.2 ** np.arange(40), 90.0)]), 5),  # a drive at its limits
        (np.concatenate([LEARNS, 2.0 ** np.arange(20), [np.inf, np.nan]]), 5),
    ],
)
def test_a_form_error_that_rises_faster_and_faster_diverges_from_its_first_rise_on(largest, since):
    found = growth(largest * 1e-6, before=7)
    assert found.diverges
    assert found.since - 7 == pytest.approx(since, abs=2 if largest.size == 63 else 0)
    assert repr(found.last) == repr(float(largest[-1] * 1e-6))


@pytest.mark.parametrize(
    "largest",
    [
        LEARNS,
        np.array([1.0, 10.0, 100.0]),
        np.concatenate([LEARNS, RIPPLE]),
        np.concatenate([LEARNS, RIPPLE, [4.0, 40.0, 41.0, 40.0, 42.0]]),  # a fault in the midst of a revolution
        np.concatenate([LEARNS, RIPPLE, 1.3 ** np.arange(9), RIPPLE]),  # and it fell again
        np.concatenate([LEARNS, 1e-9 * 1.3 ** np.arange(9)]),  # rounding
    ],
)
def test_a_form_error_that_does_not_go_on_rising_does_not_grow(largest):
    assert growth(largest * 1e-6) is None


def test_a_form_error_in_proportion_to_time_grows_but_does_not_diverge():
    found = growth(np.concatenate([LEARNS, np.full(5, 1.0), 1.0 + 0.1 * np.arange(60)]) * 1e-6)
    assert not found.diverges
    assert found.told() == "form error grows from revolution 10 on: 2 µm before, 6.9 µm at the end"


# --- the result


def test_a_result_has_the_verdict_and_its_summary_as_well():
    result = harness.run(scenario(spindle_encoder={"revolutions": 5.0}, tool={"tolerance": 2e-6}))
    found, largest = result.verdict, result.errors.largest
    assert 1 < found.since <= 5
    assert largest[found.since - 2] > 2e-6 >= largest[found.since - 1 :].max()
    assert found.spare == 2e-6 - largest[found.since - 1 :].max()
    assert result.summary()["tolerance_um"] == {
        "allowed": 2.0,
        "in_tolerance": True,
        "from_revolution": found.since,
        "largest": found.largest * 1e6,
        "spare": found.spare * 1e6,
        "over_revolutions": [found.since, 5],
    }


def test_a_tolerance_is_that_of_the_tool_whose_error_is_told():
    renamed = scenario(learning_controller={"remap": ["tool:=part"]}, tool={"remap": ["tool:=part"], "tolerance": 2e-6})
    assert harness.run(renamed).verdict.tolerance == 2e-6


def test_a_tolerance_changes_neither_bits_nor_identity():
    """Without one there is no verdict."""
    short = "spindle_encoder.revolutions=2"
    one, other = (config("piston", short, f"tool.tolerance={value}") for value in (0.0, 1e-6))
    assert one.shared.run_id == other.shared.run_id
    without, judged = harness.run(one), harness.run(other)
    assert without.digest == judged.digest
    assert (without.verdict, without.summary()["tolerance_um"]) == (None, None)


# --- the command


def test_the_terminal_and_json_tell_it():
    told = lathe(*SHORT, "--set", "tool.tolerance=2e-6")
    said = r"(?m)^in tolerance \(±2 µm\) from revolution 4 on, [\d.]+ µm to spare in the last 2$"
    assert re.search(said, told.stdout)
    assert json.loads(lathe(*SHORT, "--json").stdout)["tolerance_um"]["from_revolution"] == 4


@pytest.mark.parametrize(("tolerance", "code"), [("2e-6", 0), ("0.1e-6", 1)])
def test_who_requires_the_tolerance_gets_it_as_an_exit_code(tolerance, code):
    done = lathe(*SHORT, "--json", "--require-tolerance", "--set", f"tool.tolerance={tolerance}")
    assert done.exit_code == code
    assert json.loads(done.stdout)["tolerance_um"]["in_tolerance"] == (not code)
    refusals = [line for line in done.stderr.splitlines() if line.startswith("lathe: ")]
    assert len(refusals) == code
    assert all(re.search(r"piston is not in tolerance \(±0\.1 µm\): .*allowed: ", line) for line in refusals)


def test_a_run_without_a_revolution_is_not_in_tolerance():
    done = lathe("run", "piston", "--revolutions", "0.5", "--require-tolerance")
    assert done.exit_code == 1
    assert "not in tolerance (±2 µm): no complete revolution" in done.stderr


@pytest.mark.usefixtures("no_pictures")
def test_terminal_json_and_report_say_alike_that_a_run_diverges_though_it_is_in_tolerance(tmp_path):
    """A lead that is too long: the form error falls, then grows, within a wide tolerance."""
    lead = ("--set", "learning_controller.lead_time=3e-3", "--set", "learning_controller.allow_unstable=true")
    run = ("run", "piston", "--revolutions", "30", *lead, "--set", "tool.tolerance=300e-6")
    said = lathe(*run, "--bag", tmp_path / "bag").stdout
    (line,) = re.findall(r"(?m)^form error diverges from revolution \d+ on: .*$", said)
    found = json.loads(lathe(*run, "--json").stdout)["growth_um"]
    assert found["diverges"]
    assert f" {found['from_revolution']} on: {found['before']:.4g} µm before, {found['last']:.4g} µm at" in line
    text = page_of(tmp_path / "bag")
    assert '<section class="verdict bad"' in text
    assert f'<p class="said">F{line[1:]}. In tolerance (±300 µm) from revolution ' in text
    assert "What limits it" not in text, "neither noise nor the Q filter makes it diverge"


# --- the report


@pytest.mark.parametrize(
    ("tolerance", "mood", "said", "options"),
    [(2e-6, "good", "in tolerance", ["--budget"]), (0.1e-6, "bad", "not in tolerance", [])],
)
@pytest.mark.usefixtures("no_pictures")
def test_a_report_begins_with_it_and_shows_the_budget_if_it_is_asked_for(tmp_path, tolerance, mood, said, options):
    cell = scenario(spindle_encoder={"revolutions": 5.0}, tool={"tolerance": tolerance})
    harness.run(cell, bag=tmp_path / "bag")
    text = page_of(tmp_path / "bag", *options)
    verdict = re.search(rf'<section class="verdict {mood}".*?<p class="said">([^<]*)</p>', text, re.DOTALL)
    assert verdict[1].lower().startswith(said)
    section = text.partition(">What the form error is made of</h2>")[2]
    assert bool(section) == bool(options)
    if not section:
        return
    rows = re.findall(r'<tr><td class="text">([^<]*)</td><td>([^<]*)</td>', section.partition("<h2")[0])
    assert [name for name, _ in rows] == ["Q floor", "rest", "interactions", "form error"]
    assert sum(float(share) for _, share in rows[:-1]) == pytest.approx(100.0, abs=0.2)


def test_a_bag_that_states_no_judgement_has_no_tolerance_but_a_reason():
    with pytest.raises(InputError, match=r"^lathe_rc\.scenario of the bag: no nodes; allowed: "):
        provenance.values_of({provenance.SCENARIO: "[1, 2]"})
    assert provenance.judged({}) == {}
    with pytest.raises(InputError, match=r"^the bag has no lathe_rc\.judged, .*; lathe resim makes one that has$"):
        provenance.judged({provenance.SCENARIO: "tool: {}"})
    for text, said in (
        ('{"tool": {"topic": "tool", "quantity": "form", "step": 1e-5, "tolerance": 1e999}}', "tool.tolerance: "),
        ('{"tool": {"topic": "tool", "quantity": "colour", "step": 1e-5}}', "tool.quantity: "),
        ("[]", "text: "),
    ):
        with pytest.raises(InputError, match=rf"^lathe_rc\.judged of the bag: {said}"):
            provenance.judged({provenance.JUDGED: text})


def test_a_node_declares_its_tolerance_by_the_topic_after_remapping(tmp_path):
    scenario = config("piston", "tool.tolerance=1e-6", "tool.remap=['tool:=part']")
    declared = provenance.judged(provenance.tell(scenario, []))
    assert part.tolerances(declared) == {"part": 1e-6}


# --- zones


ZONES = [
    "tool.zone_start=[0.0, 6.0, 1.0]", "tool.zone_width=[0.5, 0.4, 0.5]", "tool.zone_tolerance=[1e-6, 5e-6, 0.0]"
]  # fmt: skip


def by_hand(recording, tolerances):
    """First revolution in tolerance in each zone by its samples; the zones of `ZONES`, the rest first."""
    angle, error = recording.dense["/encoder"]["angle_true"], abs(recording.dense["/tool"]["error"])
    place = np.degrees(angle) % 360.0
    first = place < np.degrees(0.5)
    second = (place >= np.degrees(6.0)) | (place < np.degrees(0.4 + 6.0) - 360.0)
    third = (place >= np.degrees(1.0)) & (place < np.degrees(1.5))
    found = []
    for inside, allowed in zip((~(first | second | third), first, second & ~first), tolerances, strict=True):
        late = np.flatnonzero(inside & (error > allowed))
        found.append(int(angle[late[-1]] / (2.0 * np.pi)) + 2 if late.size else 1)
    return found


@pytest.mark.usefixtures("no_pictures")
def test_zones_are_judged_each_by_its_tolerance(tmp_path):
    """Result, JSON, report and row of a sweep agree with the samples; a zone without a tolerance is named."""
    changes = ["spindle_encoder.revolutions=8", "tool.tolerance=2e-6", *ZONES]
    result = harness.run(config("piston", *changes), bag=tmp_path / "bag")
    found = result.verdict
    wanted = by_hand(result.recording, np.array([2e-6, 1e-6, 5e-6]) - found.doubt)
    assert [each.since for each in found.zones] == wanted
    assert len(set(wanted)) > 1
    assert (found.since, found.in_tolerance) == (max(wanted), True)
    assert found.spare == min(each.spare for each in found.zones)
    told = result.summary()["tolerance_um"]
    assert [each["place"] for each in told["zones"]] == ["elsewhere", "0° to 28.65°", "343.8° to 6.693°"]
    assert told["not_judged"] == ["57.3° to 85.94°"]
    assert found.told() in page_of(tmp_path / "bag").replace("In tolerance", "in tolerance")
    assert row.compute(config("piston", *changes), {}, [], [])["tool.in_tolerance_from"] == found.since


def test_a_zone_out_of_tolerance_is_named_and_fails_the_run():
    strict = [word for each in (*ZONES[:2], "tool.zone_tolerance=[0.1e-6, 5e-6, 0.0]") for word in ("--set", each)]
    done = lathe(*SHORT, "--set", "tool.tolerance=2e-6", *strict, "--require-tolerance")
    assert done.exit_code == 1
    assert "piston is not in tolerance (±0.1 µm, 0° to 28.65°): " in done.output
    assert "; in tolerance in the other zones, to spare: " in done.output


def test_zones_have_heights():
    below, above = np.array([0.0, 0.4e-3]), np.array([0.5e-3, 1e-3])
    zone = Zone(0.0, 2.0 * np.pi, 1e-6, 0.0, 0.45e-3)
    assert zone.covers(np.zeros(2), below).all()
    assert not zone.covers(np.zeros(2), above).any()
    assert zone.name == "0° to 0°, 0 to 0.45 mm"
