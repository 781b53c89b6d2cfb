# SPDX-License-Identifier: Apache-2.0
"""Records of finished parts, the corrected form of the next one, and ``lathe correct`` from part to part."""

import json
import re
import sys

import numpy as np
import pytest
from cells import config
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st
from machines import assert_refused, refusals
from numpy.testing import assert_allclose, assert_array_equal

from lathe_commission import form_correction, part_record
from lathe_commission.form_correction import align, correction, evaluate, harmonics, outliers
from lathe_machine.signals.measured_profile import read_csv as read_profile
from lathe_rc import cli, harness
from lathe_rc.signals.quantities import parse_columns

TURN = 2 * np.pi
BLIND = "controller.remap=[]"  # the law learns from the drive's sensor alone
NO_NOISE = np.zeros(51)


def waves(random, highest=50, scale=1e-6):
    found = scale * (random.standard_normal(highest + 1) + 1j * random.standard_normal(highest + 1))
    found[0] = found[0].real
    return found


def even(points):
    return TURN * np.arange(points) / points


# --- harmonics and alignment


@settings(max_examples=20)
@given(st.integers(0, 1000), st.integers(130, 600))
def test_harmonics_of_uneven_points_are_exact(seed, points):
    random = np.random.default_rng(seed)
    amplitudes = waves(random)
    angle = even(points) + 0.3 * TURN / points * random.uniform(-1, 1, points)
    assert_allclose(harmonics(angle, evaluate(amplitudes, angle), 50), amplitudes, atol=1e-15)


@settings(max_examples=20)
@given(st.integers(0, 1000), st.floats(-3.1, 3.1))
def test_the_angle_of_a_record_is_found_beside_deviation_and_noise(seed, offset):
    random = np.random.default_rng(seed)
    form = np.zeros(51, complex)
    form[1:5] = np.array([20, 225, 15, 20]) * 1e-6 * np.exp(1j * random.uniform(0, TURN, 4))
    record = form * np.exp(-1j * np.arange(51) * offset) + waves(random, scale=0.01e-6)
    found = align([form], [record], 0.0, np.pi)
    assert np.angle(np.exp(1j * (found.offset - offset))) == pytest.approx(0.0, abs=3e-4)
    assert found.correlation > 0.999


OVAL = np.zeros(51, complex)
OVAL[2] = 225e-6


@refusals(
    (lambda: align([OVAL], [OVAL], 0.0, np.pi), r"when it is turned by 180°: .*; allowed: --offset with --search "),
    (lambda: align([NO_NOISE], [OVAL], 0.0, np.pi), "round: nothing to align it by; allowed: --offset"),
    (lambda: align([OVAL], [OVAL], 0.5, 0.1), "still rises at 22.92°, the end of the search; allowed: a larger"),
    (lambda: harmonics(even(60), np.zeros(60), 50, "a.csv"), "a.csv: 60 points for 50 harmonics; allowed: 101 points"),
    (lambda: harmonics(even(720)[:500], np.zeros(500), 50), "its gaps are too wide for 50 harmonics; allowed: fewer"),
    (lambda: correction([[OVAL]], lowest=0, gain=1.0, guard=4.0), "one revolution of one part: .*; allowed: several"),
)
def test_what_cannot_be_aligned_or_judged_is_refused(make, message):
    assert_refused(make, message)


@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_an_oval_is_aligned_by_a_search_around_a_known_angle(sense):
    record = OVAL * np.exp(-2j * sense * 0.7)
    assert align([OVAL], [record], 0.6, 0.5, sense).offset == pytest.approx(0.7, abs=1e-6)


# --- the guard against learning noise


def measured(random, deviation, revolutions, rms=0.3e-6, points=720):
    """Harmonics of revolutions with white noise [m]."""
    angle = even(points)
    noise = rms * random.standard_normal((revolutions, points))
    found = np.fft.rfft(noise, axis=1)[:, :51] * 2 / points
    found[:, 0] /= 2
    return list(deviation + found), angle


@pytest.mark.parametrize(("parts", "revolutions"), [(1, 2), (1, 5), (5, 1), (3, 3)])
def test_noise_alone_is_not_corrected(parts, revolutions):
    """Of 400 measurements of noise alone, at most 5 % make a correction, with three or more repeats none does."""
    random = np.random.default_rng(7)
    made = [
        correction([measured(random, NO_NOISE, revolutions)[0] for _ in range(parts)], lowest=0, gain=1.0, guard=4.0)
        for _ in range(400)
    ]
    learned = sum(bool(each.corrected.any()) for each in made)
    assert learned <= (0 if parts * revolutions > 2 else 20)
    white = form_correction.white_noise(0.3e-6, 720, parts * revolutions, 50)
    noise = np.sqrt(np.mean([each.noise**2 for each in made], axis=0))
    assert_allclose(noise[1:], white[1:], rtol=1.0)


def test_what_stands_out_is_corrected_by_gain_and_filter():
    random = np.random.default_rng(3)
    deviation = np.zeros(51, complex)
    deviation[[0, 3, 20]] = 5e-6, 1e-6j, 0.5e-6
    found = correction([measured(random, deviation, 4)[0]], lowest=0, gain=0.5, guard=4.0, cutoff=20.0)
    assert np.flatnonzero(found.corrected).tolist() == [0, 3, 20]
    assert_allclose(found.change[[0, 20]].real, [2.5e-6, 0.125e-6], rtol=0.1)
    assert found.change[3].imag == pytest.approx(0.5e-6 * np.exp(-np.log(2) * 0.15**2), rel=0.05)
    without_size = correction([measured(random, deviation, 4)[0]], lowest=2, gain=0.5, guard=4.0)
    assert np.flatnonzero(without_size.corrected).tolist() == [3, 20]


def test_scatter_between_parts_counts_where_revolutions_agree():
    """A clamping that puts each part elsewhere is no deviation, however well its revolutions agree."""
    random, moved = np.random.default_rng(5), np.zeros(51, complex)
    parts = []
    for k in range(3):
        moved[1] = 10e-6 * np.exp(1j * TURN * k / 3) + 1e-6
        parts.append(measured(random, moved, 5, rms=0.01e-6)[0])
    assert not correction(parts, lowest=0, gain=1.0, guard=4.0).corrected[1]
    assert correction(parts[:1], lowest=0, gain=1.0, guard=4.0).corrected[1]


# --- files


def table(path, header, columns, separator=",", *, comma=False):
    text = "\n".join([header, *(separator.join(f"{value:.9g}" for value in row) for row in np.transpose(columns))])
    path.write_text("# from the gauge\n" + (text.replace(".", ",") if comma else text) + "\n", encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("header", "given", "scale", "separator"),
    [
        ("angle_deg,radius_um", [], (360 / TURN, 1e6), ","),
        ("phi [rad],R [mm]", ["angle=phi [rad]", "radius=R [mm]"], (1.0, 1e3), ","),
        ("C;Abweichung", ["angle=C:rev", "radius=Abweichung:µm"], (1 / TURN, 1e6), ";"),
        ("x\ty", ["angle=x:°", "radius=y:m"], (360 / TURN, 1.0), "\t"),
    ],
)
def test_columns_and_units_of_any_csv_are_mapped(tmp_path, header, given, scale, separator):
    angle = even(360)
    radius = 1e-4 * np.sin(3 * angle)
    path = table(tmp_path / "r.csv", header, (angle * scale[0], radius * scale[1]), separator, comma=separator == ";")
    (found,) = part_record.read(path, parse_columns(given))
    assert_allclose(found.angle, angle, atol=1e-8)
    assert_allclose(found.radius, radius, atol=1e-12)


def test_revolutions_are_told_apart_by_number_height_or_angle(tmp_path):
    angle = np.degrees(np.tile(even(90), 3))
    number = np.repeat([1.0, 2.0, 3.0], 90)
    columns = parse_columns([])
    going_on = table(tmp_path / "a.csv", "angle_deg,radius_um", (angle + 360 * (number - 1), number))
    anew = table(tmp_path / "b.csv", "angle_deg,radius_um", (angle, number))
    numbered = table(tmp_path / "c.csv", "revolution,angle_deg,radius_um", (number, angle, number))
    heights = table(tmp_path / "d.csv", "angle_deg,height_mm,radius_um", (angle, 5 * number, number))
    for path in (going_on, anew, numbered, heights):
        found = part_record.read(path, columns)
        assert [round(each.radius.mean() * 1e6) for each in found] == [1, 2, 3]
    assert [each.height for each in part_record.read(heights, columns)] == pytest.approx([5e-3, 10e-3, 15e-3])


@pytest.mark.parametrize("first", [0.0, 10.0, 180.0])
@pytest.mark.parametrize("sense", [1.0, -1.0])
@pytest.mark.parametrize("goes_on", [False, True])
def test_a_revolution_begins_at_any_angle_and_goes_either_way(tmp_path, first, sense, goes_on):
    angle = first + sense * 4.0 * np.arange(270)
    columns = (angle if goes_on else angle % 360, np.repeat([1.0, 2.0, 3.0], 90))
    found = part_record.read(table(tmp_path / "r.csv", "angle_deg,radius_um", columns), {})
    assert [set(np.rint(1e6 * each.radius)) for each in found] == [{1.0}, {2.0}, {3.0}]


@pytest.mark.parametrize(
    ("text", "given", "said"),
    [
        ("phi,radius_um\n0,1\n", [], r"columns 'phi', 'radius_um'; allowed: angle and radius, with units"),
        ("phi,radius_um\n0,1\n", ["angle=phi"], r"column 'phi' has no unit; allowed for angle: deg, °, rad, rev"),
        ("angle_deg,angle_rad,radius_um\n0,0,1\n", [], r"'angle_deg' and 'angle_rad' are both angle; allowed: one"),
        ("angle_deg,radius_um\n0,nan\n", [], r"no complete revolution: 0 points over 0°; allowed"),
        ("angle_deg,radius_um\n0,1\n9,1\n18,1\n", [], r"no complete revolution: 3 points over 18°; allowed"),
        ("angle_deg,radius_um\n", ["diameter=d:mm"], r"--column 'diameter=d:mm'; allowed: QUANTITY=COLUMN"),
        ("angle_deg,radius_um\n", ["angle="], r"--column 'angle='; allowed: QUANTITY=COLUMN"),
    ],
)
def test_a_record_that_cannot_be_used_is_one_line(tmp_path, text, given, said):
    path = tmp_path / "r.csv"
    path.write_text(text)
    assert_refused(lambda: part_record.read(path, parse_columns(given)), said)


@pytest.mark.skipif(sys.version_info < (3, 11), reason="x3pio needs Python 3.11")
def test_x3p_is_read_as_its_own_library_writes_it(tmp_path):
    import x3pio

    radius = np.stack([1e-4 * np.sin(2 * even(720)), 1e-4 * np.cos(2 * even(720))])
    radius[1, 5] = np.nan
    x3pio.Profile.from_array(radius, x_scale=1e-4).save(tmp_path / "profile.x3p")
    x3pio.write(tmp_path / "surface.x3p", radius, x_scale=1e-4, y_scale=1e-3)
    for name in ("profile.x3p", "surface.x3p"):
        first, second = part_record.read(tmp_path / name, {})
        assert_allclose(first.radius, radius[0], atol=1e-15)
        assert_allclose(second.angle, np.delete(even(720), 5))
    x3pio.Profile.from_points(np.random.default_rng(1).random((9, 3))).save(tmp_path / "path.x3p")
    (tmp_path / "no.x3p").write_bytes(b"PK")
    assert_refused(lambda: part_record.read(tmp_path / "path.x3p", {}), "coordinates of its own; allowed: a profile or")
    assert_refused(lambda: part_record.read(tmp_path / "no.x3p", {}), "no X3P file")
    assert_refused(lambda: part_record.read(tmp_path / "none.x3p", {}), "cannot be read .*; check the path")
    assert_refused(lambda: part_record.read(tmp_path / "no.x3p", {"angle": ("a", "deg")}), "--column with an X3P file")


# --- readings that stand out


def near(angle, width, at=2.0):
    """Distance from an angle over a width, around the circle."""
    return np.abs((angle - at + np.pi) % TURN - np.pi) / width


FORMS = {
    "oval": lambda a: 200e-6 * np.sin(2 * a),
    "steps": lambda a: 50e-6 * np.sign(np.sin(a + 0.3)),
    "keyway": lambda a: np.where(near(a, 0.1) < 1.0, -1e-3, 0.0),
    "slot": lambda a: np.where(near(a, 0.035) < 1.0, -1e-3, 0.0),
    "flat": lambda a: 100e-6 * np.maximum(np.cos(a), 0.3),
    "kinks": lambda a: 100e-6 * np.abs(np.sin(1.5 * a)),
    "chatter": lambda a: 5e-6 * np.sin(70 * a) + 2e-6 * np.sin(133 * a),
    "burst of chatter": lambda a: np.where(near(a, 0.3) < 1.0, 5e-6 * np.sin(80 * a), 0.0),
    "groove": lambda a: -50e-6 * np.exp(-(near(a, 0.03) ** 2)),
    "saw": lambda a: 20e-6 * (a * 5 / TURN % 1.0),
}


@pytest.mark.parametrize("name", FORMS)
@pytest.mark.parametrize("points", [180, 1440])
def test_no_real_form_stands_out(name, points):
    """Edges, keyways, grooves, kinks, and waves above those that are fitted, with noise or without."""
    random = np.random.default_rng(points)
    for noise in (0.0, 1e-7):
        radius = FORMS[name](even(points)) + noise * random.standard_normal(points)
        assert outliers(even(points), radius, 50).size == 0


@pytest.mark.parametrize("points", [360, 720, 1440])
@pytest.mark.parametrize(
    "wrong", [{7: 9e-3}, {7: -1e-3, 90: 2e-3}, {30: 50e-6}, {0: 9e-3, -1: 9e-3}, {5: 1.0, 150: -30e-6}]
)
def test_dust_and_cut_off_flags_stand_out(points, wrong):
    """Two readings side by side as well, unless the record is too coarse to tell them from a groove."""
    wrong = {place: value for place, value in wrong.items() if place >= 0 or points > 360}
    angle = even(points)
    radius = (
        200e-6 * np.sin(2 * angle) + 5e-6 * np.sin(3 * angle) + 0.3e-6 * np.random.default_rng(1).normal(size=points)
    )
    for place, value in wrong.items():
        radius[place] += value
    assert outliers(angle[::-1], radius[::-1], 50).tolist() == sorted(points - 1 - place % points for place in wrong)


def test_too_many_that_stand_out_are_refused():
    radius = 1e-6 * np.sin(2 * even(720))
    radius[::30] = 9e-3
    assert_refused(
        lambda: outliers(even(720), radius, 50), r"24 of 720 points stand out, first 9000 µm at 0°; allowed: up"
    )


def record(path, wrong, gap=""):
    """Four revolutions of an eccentric part with a deviation of 5 µm at 3 UPR; ``wrong``: readings to replace."""
    random, rows = np.random.default_rng(3), []
    for k, angle in enumerate(np.linspace(0.0, 4 * 360.0, 4 * 720, endpoint=False).tolist()):
        at = np.radians(angle)
        value = 20 * np.sin(at) + 225 * np.sin(2 * at) + 10 * np.sin(3 * at) + 20 * np.sin(4 * at)
        value = wrong.get(k, value + 0.1 * random.standard_normal())
        rows.append(f"{angle:.6g},{gap if value is None else f'{value:.7g}'}")
    path.write_text("\n".join(["angle_deg,radius_um", *rows]) + "\n")
    return path


@pytest.mark.parametrize(
    ("wrong", "gap", "left_out"),
    [
        ({}, "", 0),
        ({1540: 9000.0, 1541: 9000.0, 1542: 9000.0}, "", 3),
        ({5: -9999.0, 800: 500.0}, "", 2),
        (dict.fromkeys(range(100, 112)), "", 0),
        (dict.fromkeys(range(900, 912)), "NaN", 0),
        ({**dict.fromkeys(range(900, 906)), 2000: 9000.0}, " ", 1),
    ],
)
def test_readings_that_stand_out_and_gaps_change_no_correction(tmp_path, wrong, gap, left_out):
    """They are named with angle and value."""
    path = record(tmp_path / "r.csv", wrong, gap)
    told = lathe(path, "--scenario", form_scenario(tmp_path), "-o", tmp_path / "form.csv", "--json")
    assert [(each["revolution"], each["angle_deg"], each["value_um"]) for each in told["left_out"]] == [
        (k // 720 + 1, pytest.approx(k % 720 / 2), value) for k, value in wrong.items() if value is not None
    ]
    assert len(told["left_out"]) == left_out
    assert told["harmonics"][3]["change"] == pytest.approx(5.0, abs=0.05)


def form_scenario(folder):
    path = folder / "cell.yaml"
    tool = (
        "{harmonic_order: [1, 2, 3, 4], harmonic_amplitude: [20.0e-6, 225.0e-6, 15.0e-6, 20.0e-6], tolerance: 1.0e-6}"
    )
    path.write_text(
        "/spindle_encoder: {ros__parameters: {revolutions: 2.0}}\n/electrodynamic_actuator: {ros__parameters: {}}\n"
        f"/learning_controller: {{ros__parameters: {{}}}}\n/tool: {{ros__parameters: {tool}}}\n"
    )
    return path


def test_a_correction_of_nothing_for_want_of_clean_data_is_no_success(tmp_path):
    """Noise that hides deviations above the tolerance: no file, exit code 1; less noise is a success."""
    random = np.random.default_rng(2)
    for noise, code in ((400.0, 1), (0.05, 0)):
        angle = np.linspace(0.0, 4 * 360.0, 4 * 720, endpoint=False)
        at = np.radians(angle)
        radius = 20 * np.sin(at) + 225 * np.sin(2 * at) + 15 * np.sin(3 * at) + 20 * np.sin(4 * at)
        path = table(
            tmp_path / "r.csv", "angle_deg,radius_um", (angle, radius + noise * random.normal(size=angle.size))
        )
        given = ("--scenario", form_scenario(tmp_path), "-o", tmp_path / "form.csv", "--offset", 0, "--search", 0)
        told = lathe(path, *given, code=code)
        assert (tmp_path / "form.csv").exists() == (not code)
        if code:
            assert "nothing is corrected, and the noise hides deviations up to" in told
            assert "(tolerance: ±1 µm); no file written" in told


# --- the command, from part to part


def lathe(*arguments, code=0):
    done = CliRunner().invoke(cli.main, ["correct", *map(str, arguments)])
    assert done.exit_code == code, done.output
    return json.loads(done.stdout) if "--json" in arguments else done.output


def gauge_part(path, result, form, random, *, revolutions=3, noise=0.3e-6, turned=0.0, points=720):
    """A roundness record of the last revolutions of a part, clamped at another angle [rad]."""
    rows, angle = [], even(points)
    for k in range(revolutions):
        whole = result.part.profile[-1 - k]
        at = (angle - turned) % TURN
        radius = np.interp(at, np.append(even(whole.size), TURN), np.append(whole, whole[0])) + form(at)
        rows.append(
            (np.degrees(angle), np.full(points, k + 1.0), 1e3 * (radius + noise * random.standard_normal(points)))
        )
    return table(path, "C_deg,turn,R", np.concatenate(rows, axis=1))


COLUMNS = ("--column", "angle=C_deg", "--column", "radius=R:mm", "--column", "revolution=turn")


def desired(angle):
    return sum(a * 1e-6 * np.sin(n * angle) for n, a in ((1, 20), (2, 225), (3, 15), (4, 20)))


def test_five_parts_bring_57_micrometres_below_one_under_noise_of_a_third_of_one(tmp_path):
    """Each part is clamped at another angle in a gauge of 0.3 µm of noise; the correlation finds the angle."""
    random, told, largest = np.random.default_rng(11), [], []
    for part in range(1, 6):
        result = harness.run(config("gauged", BLIND, "spindle_encoder.revolutions=12.0", *told))
        largest.append(result.errors.largest[-1])
        record = gauge_part(tmp_path / "record.csv", result, desired, random, turned=random.uniform(0, TURN))
        sets = [word for each in told for word in ("--set", each)]
        lathe(record, "--scenario", "gauged", *sets, *COLUMNS, "-o", tmp_path / f"form{part + 1}.csv")
        told = [f"profile.programmed_file={tmp_path / f'form{part + 1}.csv'}"]
    assert largest[0] > 54e-6
    assert largest[4] < 1e-6
    assert np.all(np.diff(largest[:3]) < 0.0)


def test_learning_from_noise_alone_raises_the_error_by_less_than_a_tenth(tmp_path):
    """Five parts of a machine that turns as told, corrected one after the other from records of noise alone."""
    random, told, errors = np.random.default_rng(12), [], []
    rigid = ("loaded_drive.cut_elasticity=rigid", BLIND, "spindle_encoder.revolutions=30.0")
    for part in range(5):
        result = harness.run(config("gauged", *rigid, *told))
        errors.append(result.errors.rms[-5:].mean())
        record = tmp_path / "noise.csv"
        whole = result.part
        gauge_part(record, type("Part", (), {"part": type("P", (), {"profile": 0 * whole.profile})}), desired, random)
        sets = [word for each in told for word in ("--set", each)]
        lathe(record, "--scenario", "gauged", *sets, *COLUMNS, "--offset", 0, "-o", tmp_path / f"{part}.csv")
        told = [f"profile.programmed_file={tmp_path / f'{part}.csv'}"]
    assert max(errors) < 1.1 * errors[0]


def test_a_form_told_one_percent_too_small_is_mended_at_the_node_that_was_told_it(tmp_path):
    """--node corrects the form of a law that has one of its own."""
    small = [
        "controller.harmonic_order=[1, 2, 3, 4]",
        "controller.harmonic_amplitude=[19.8e-6, 222.75e-6, 14.85e-6, 19.8e-6]",
    ]
    cell = (BLIND, "loaded_drive.cut_elasticity=rigid", "spindle_encoder.revolutions=20.0", *small)
    before = harness.run(config("gauged", *cell))
    record = gauge_part(tmp_path / "r.csv", before, desired, np.random.default_rng(1))
    sets = [word for each in small for word in ("--set", each)]
    out = tmp_path / "told.csv"
    summary = lathe(
        record, "--scenario", "gauged", *sets, *COLUMNS, "--offset", 0, "--node", "controller", "-o", out, "--json"
    )
    assert summary["node"] == "controller"
    after = harness.run(config("gauged", *cell, f"controller.programmed_file={out}"))
    assert before.errors.largest[-1] > 2.2e-6
    assert after.errors.largest[-1] < 0.2e-6


def test_a_bag_with_a_gauge_is_a_record(tmp_path):
    """The readings of the newest revolutions, drop-outs and all, are the deviation from the form."""
    short = [BLIND, "spindle_encoder.revolutions=20.0", "gauge.dropouts_per_revolution=3.0"]
    result = harness.run(config("gauged", *short), bag=tmp_path / "part")
    out = tmp_path / "told.csv"
    summary = lathe(tmp_path / "part", "--scenario", "gauged", "--last", 5, "-o", out, "--json")
    assert summary["records"][0]["revolutions"] == 5
    mean = -result.part.profile[-7:-2].mean()  # desired less actual
    assert summary["harmonics"][0]["change"] == pytest.approx(abs(mean) * 1e6, rel=0.01)
    told = read_profile(out)
    assert np.mean(told.radius) == pytest.approx(mean, rel=0.01)
    printed = lathe(tmp_path / "part", "--scenario", "gauged", "-o", out)
    assert printed.splitlines()[-1] == f"next part: --set profile.programmed_file={out}"
    said = lathe(tmp_path / "part", "--scenario", "piston", "-o", tmp_path / "no" / "file.csv", code=2)
    assert "--output" in said


def test_one_of_several_gauges_is_named(tmp_path):
    """The second one reads 0.5 rad ahead: the revolution in which its readings begin is none."""
    cell = config("gauged", BLIND, "spindle_encoder.revolutions=6.0", "gauge.noise_rms=0.0")
    remap = [f"gauge/{name}:=second/gauge/{name}" for name in ("reading", "state")]
    second = cell.nodes["gauge"].model_copy(update={"stage": "gauge", "remap": remap, "angle_offset": 0.5})
    harness.run(type(cell)("two", {**cell.nodes, "second": second}), bag=tmp_path / "part")
    options = (tmp_path / "part", "--scenario", "gauged", "-o", tmp_path / "f.csv")
    said = lathe(*options, code=2)
    assert re.search(r"readings of 2 gauges; allowed: --topic with one of /gauge/reading, /second/gauge/reading", said)
    assert "--topic /tool: not in" in lathe(*options, "--topic", "/tool", code=2)
    found, angle = [], even(512)
    for topic in ("/gauge/reading", "/second/gauge/reading"):
        lathe(*options, "--guard", 0, "--last", 3, "--topic", topic)
        change = read_profile(tmp_path / "f.csv").deviation(angle, 0.0) - desired(angle)
        found.append(np.mean(change * np.exp(-1j * angle)))
    assert np.angle(found[1] / found[0]) == pytest.approx(0.5, abs=0.2)  # the cell settles


def test_a_roundness_record_leaves_size_and_centre_and_a_reversed_one_is_turned(tmp_path):
    angle = even(720)
    lobe = desired(angle) + 30e-6 + 10e-6 * np.cos(angle) - 2e-6 * np.sin(5 * angle + 0.3)
    noise = 0.02e-6 * np.random.default_rng(2).standard_normal((2, 720))
    rows = [np.tile(np.degrees(-angle % TURN), 2), np.repeat([1.0, 2.0], 720), 1e6 * (lobe + noise).ravel()]
    record = table(tmp_path / "r.csv", "angle_deg,revolution,radius_um", rows)
    options = ("--scenario", "gauged", "--roundness", "--reverse", "-o", tmp_path / "f.csv", "--json")
    found = lathe(record, *options)
    assert [wave["upr"] for wave in found["harmonics"] if wave["change"] > 0.05] == [5]
    assert found["harmonics"][5]["change"] == pytest.approx(2.0, rel=0.01)
    told = read_profile(tmp_path / "f.csv")
    assert_allclose(told.deviation(angle, 0.0), desired(angle) + 2e-6 * np.sin(5 * angle + 0.3), atol=0.05e-6)


@pytest.mark.parametrize(
    "options", [("--offset", 70), ("--offset", 60, "--search", 20), (), ("--offset", 70, "--deviation")]
)
@pytest.mark.parametrize("sense", [1, -1])
def test_the_offset_is_the_angle_of_the_record_at_angle_0_of_the_part(tmp_path, options, sense):
    """With the record's angle against that of the part, too."""
    angle = even(720)
    lobe = 2e-6 * np.sin(5 * angle + 0.3) + (0.0 if "--deviation" in options else desired(angle))
    noise = 0.02e-6 * np.random.default_rng(2).standard_normal((2, 720))
    turned = np.degrees(sense * angle + np.radians(70)) % 360
    record = table(tmp_path / "r.csv", "angle_deg,radius_um", (np.tile(turned, 2), 1e6 * (lobe + noise).ravel()))
    way = ("--reverse",) if sense < 0 else ()
    found = lathe(record, "--scenario", "gauged", *options, *way, "-o", tmp_path / "f.csv", "--json")
    assert found["records"][0]["offset_deg"] == pytest.approx(70.0, abs=0.01)
    told = read_profile(tmp_path / "f.csv").deviation(angle, 0.0)
    assert_allclose(told, desired(angle) - 2e-6 * np.sin(5 * angle + 0.3), atol=0.05e-6)


@pytest.mark.parametrize(
    ("scale", "mean", "options", "said"),
    [
        (1.0, 50e3, (), r"the mean radius is 50 mm; allowed: deviations .* or --roundness"),
        (1e-3, 0.0, (), r"the record is 0.001 times the form; allowed: the right unit"),
        (1.0, 0.0, ("--offset", 90), r"the correlation with the form is -0.97\d*; allowed: 0.5 or more"),
        (1.0, 0.0, ("--scenario", "piston"), r"no heights, and the form changes along the part; allowed: --height"),
    ],
)
def test_a_record_in_another_unit_or_of_another_form_is_refused(tmp_path, scale, mean, options, said):
    angle = even(720)
    radius = np.tile(1e6 * desired(angle) * scale + mean, 2)
    rows = (np.tile(np.degrees(angle), 2), np.repeat([1.0, 2.0], 720), radius)
    record = table(tmp_path / "r.csv", "angle_deg,revolution,radius_um", rows)
    found = lathe(record, "--scenario", "gauged", *options, "-o", tmp_path / "f.csv", code=2)
    assert re.search(said, found), found


def test_the_deviation_that_lathe_measure_writes_is_a_record(tmp_path):
    angle = even(512)
    record = table(tmp_path / "d.csv", "angle_deg,radius_um", (np.degrees(angle), 3.0 * np.cos(4 * angle)))
    found = lathe(record, "--scenario", "piston", "--deviation", "--noise", 0.3, "-o", tmp_path / "f.csv", "--json")
    assert found["harmonics"][4]["change"] == pytest.approx(3.0)
    assert found["harmonics"][2]["noise"] == pytest.approx(2 * 0.3 / np.sqrt(512))
    told, form = read_profile(tmp_path / "f.csv"), config("piston").nodes["tool"].form("tool")
    assert_allclose(told.heights, form.heights)
    wanted = form.deviation(angle, 0.02) - 3e-6 * np.cos(4 * angle)
    assert_allclose(told.deviation(angle, 0.02), wanted, atol=1e-9)


# --- the form that the controllers are told


def test_the_form_error_stays_that_of_the_form_when_the_controllers_are_told_another(tmp_path):
    """A told form that is 1 µm larger is turned 1 µm too large, along a part with heights too."""
    form = config("piston").nodes["tool"].form("tool")
    record = table(tmp_path / "d.csv", "angle_deg,radius_um", (np.degrees(even(90)), np.full(90, -1.0)))
    out = tmp_path / "f.csv"
    lathe(record, "--scenario", "piston", "--deviation", "--noise", 0.01, "--harmonics", 4, "-o", out)
    long = "spindle_encoder.revolutions=20.0"
    plain, told = (harness.run(config("piston", long, *more)) for more in ([], [f"tool.programmed_file={out}"]))
    assert_allclose(told.part.profile[-1] - plain.part.profile[-1], 1e-6, atol=0.02e-6)
    assert_array_equal(read_profile(out).heights, form.heights)


def test_a_law_is_told_the_form_of_the_tool(tmp_path):
    out = table(tmp_path / "f.csv", "angle_deg,radius_um", (np.degrees(even(360)), 100.0 * np.sin(2 * even(360))))
    cell = config("robust", f"tool.programmed_file={out}")
    assert cell.nodes["disturbance_controller"].programmed_file == str(out)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--scenario", "gauged", "--node", "gauge"], "--node gauge: no form of its own; allowed: "),
        (["--scenario", "force_turning"], ""),
    ],
)
def test_a_scenario_without_a_form_is_refused(tmp_path, arguments, said):
    record = table(tmp_path / "d.csv", "angle_deg,radius_um", (np.degrees(even(90)), np.zeros(90)))
    assert said in lathe(record, *arguments, "-o", tmp_path / "f.csv", code=2)
