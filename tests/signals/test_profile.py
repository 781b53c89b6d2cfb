# SPDX-License-Identifier: Apache-2.0
"""Part profiles: formulas, tables and files."""

import os
import re

import numpy as np
import pytest
from cells import scenario
from hypothesis import given
from hypothesis import strategies as st
from machines import assert_refused, refusals
from numpy.testing import assert_allclose

from lathe_machine.signals import profile_table
from lathe_machine.signals.measured_profile import Measured, doubts, read_csv
from lathe_machine.signals.profile import Harmonics, Piston, Polygon
from lathe_machine.signals.profile_table import ProfileTable, kept
from lathe_rc.cell.wiring import Cell
from lathe_rc.jit import cache_folder

TURN = 2 * np.pi
ANGLES = np.linspace(-TURN, 2 * TURN, 4001)

micrometres = st.floats(-500e-6, 500e-6)
polygons = st.builds(
    lambda sides, radius, part: Polygon(sides, radius, radius * part),
    st.integers(3, 12), st.floats(1e-3, 0.1), st.floats(0.3, 1.0),
)  # fmt: skip


# --- formulas


@given(st.lists(st.tuples(st.integers(0, 40), micrometres, st.floats(-4.0, 4.0)), max_size=4))
def test_harmonics_are_those_of_equation_5(terms):
    order, amplitude, phase = (np.array([term[i] for term in terms], dtype=float) for i in range(3))
    expected = sum((a * np.sin(i * ANGLES + p) for i, a, p in terms), np.zeros_like(ANGLES))
    assert_allclose(Harmonics(order, amplitude, phase).deviation(ANGLES, 0.1), expected, atol=1e-15)


@pytest.mark.parametrize(
    ("height", "along", "oval"),
    [(0.02, 0.0, 0.4e-3), (0.06, -60e-6, 0.5e-3), (0.0, -15e-6, 0.425e-3)],
    ids=["widest", "farther end", "half as far"],
)
def test_piston_has_its_ovality_barrel_and_widest_place(height, along, oval):
    """In diameters: over the pin less across it, and what the barrel takes."""
    piston = Piston(ovality=0.5e-3, ovality_middle=0.4e-3, barrel=30e-6, length=0.06, widest=0.02)
    radius = piston.deviation(np.array([0.0, np.pi / 2, np.pi, 3 * np.pi / 2]), height)
    assert (radius[0] + radius[2], radius[1] + radius[3]) == pytest.approx((along, along - oval))


@given(polygons)
def test_polygon_lies_between_its_circles(polygon):
    radius = polygon.deviation(ANGLES, 0.0)
    half = np.pi / polygon.sides
    corner = (polygon.inscribed_radius - polygon.corner_radius) / np.cos(half) + polygon.corner_radius
    extreme = (corner - polygon.inscribed_radius) / 2
    assert_allclose(polygon.deviation(np.array([0.0, half]), 0.0), [-extreme, extreme], atol=1e-15)
    assert np.abs(radius).max() <= extreme + 1e-15


@given(polygons)
def test_polygon_turns_from_side_to_corner_without_a_kink(polygon):
    half = np.pi / polygon.sides
    straight = (polygon.inscribed_radius - polygon.corner_radius) * np.tan(half)
    touch = np.arctan2(straight, polygon.inscribed_radius)
    h = 1e-6
    before, at, after = polygon.deviation(touch + np.array([-h, 0.0, h]), 0.0)
    # Both slopes are that of the side; a kink would make them differ by far more than h.
    slope = polygon.inscribed_radius * np.tan(touch) / np.cos(touch)
    assert_allclose([(at - before) / h, (after - at) / h], slope, atol=1e-4 * polygon.inscribed_radius)


def test_polygon_sides_are_straight_and_corners_round():
    polygon = Polygon(sides=5, inscribed_radius=0.01, corner_radius=0.004)
    middle = polygon.inscribed_radius - polygon.deviation(np.zeros(1), 0.0)[0]
    side = np.linspace(-0.4, 0.4, 9)
    assert_allclose((polygon.deviation(side, 0.0) + middle) * np.cos(side), 0.01)
    around = np.pi / 5 + np.linspace(-0.1, 0.1, 9)
    radius = polygon.deviation(around, 0.0) + middle
    centre = 0.006 / np.cos(np.pi / 5)
    assert_allclose(np.abs(radius * np.exp(1j * around) - centre * np.exp(1j * np.pi / 5)), 0.004)


@given(polygons)
def test_polygon_repeats_with_its_sides(polygon):
    turned = polygon.deviation(ANGLES + TURN / polygon.sides, 0.0)
    assert_allclose(polygon.deviation(ANGLES, 0.0), turned, atol=1e-12)


@refusals(
    (lambda: Harmonics(np.ones(2), np.ones(1), np.ones(2)), "2 orders, 1 amplitudes and 2 phases"),
    (lambda: Polygon(2, 0.01, 0.004), "2 sides"),
    (lambda: Polygon(3, 0.01, 0.0), "corner radius 0 m"),
    (lambda: Polygon(3, 0.01, 0.011), "corner radius 0.011 m"),
)
def test_impossible_profile_is_refused(make, message):
    assert_refused(make, message)


# --- tables


def read_table(table, angles, height):
    found = np.empty(angles.size)
    profile_table.deviation_along(table.heights, table.table, angles, np.full(angles.size, height), found)
    return found


@pytest.mark.parametrize(
    ("form", "within"),
    [
        (Harmonics(np.array([1.0, 2.0, 19.0]), np.full(3, 200e-6), np.array([0.3, 0.1, 0.0])), 1e-11),
        (Polygon(3, 1e-3, 0.8e-3), 1e-9),
    ],
)
def test_table_of_a_form_is_the_formula(form, within):
    assert_allclose(read_table(ProfileTable(form), ANGLES, 0.02), form.deviation(ANGLES, 0.02), atol=within)


@pytest.mark.parametrize("height", [-0.01, 0.0, 0.0123, 0.02, 0.0471, 0.0799, 0.09])
def test_table_of_a_piston_is_the_formula_along_the_skirt_and_its_ends_beyond(height):
    form = Piston(ovality=0.5e-3, ovality_middle=0.4e-3, barrel=30e-6, length=0.08, widest=0.02)
    expected = form.deviation(ANGLES, min(max(height, 0.0), 0.08))
    assert_allclose(read_table(ProfileTable(form), ANGLES, height), expected, atol=20e-9)


def test_measured_points_are_on_the_curve():
    angle = np.array([0.1, 1.0, 2.5, 4.0, 6.0])
    radius = np.array([[1.0, 2.0, -1.0, 0.5, 0.0], [2.0, 3.0, 0.0, 1.5, 1.0]]) * 1e-4
    form = Measured(angle, np.array([0.0, 0.01]), radius)
    assert_allclose(form.deviation(angle, 0.0), radius[0], atol=1e-18)
    assert_allclose(form.deviation(angle + TURN, 0.01), radius[1], atol=1e-16)
    assert_allclose(form.deviation(ANGLES, 0.0025), form.deviation(ANGLES, 0.0) + 0.25e-4, atol=1e-16)


def test_demand_of_a_harmonic_is_analytic():
    amplitude, order, speed, acceleration = 150e-6, 6.0, 110.0, 30_000.0
    table = ProfileTable(Harmonics(np.array([order]), np.array([amplitude]), np.array([0.3])))
    demand = table.demand(speed, acceleration, feed=1e-3)
    assert demand.stroke == pytest.approx(amplitude, rel=1e-5)
    assert demand.velocity == pytest.approx(amplitude * order * speed, rel=1e-5)
    # (kΩ)²·sin + k·(dΩ/dt)·cos
    worst = amplitude * np.hypot((order * speed) ** 2, order * acceleration)
    assert demand.acceleration == pytest.approx(worst, rel=1e-5)


def test_feed_along_the_part_adds_to_the_velocity():
    cone = Measured(np.array([0.0, 2.0, 4.0]), np.array([0.0, 0.01]), np.array([[0.0] * 3, [1e-4] * 3]))
    assert ProfileTable(cone).demand(100.0, 0.0, feed=1e-3).velocity == pytest.approx(100.0 / TURN * 1e-5)


# --- files


def write(tmp_path, text):
    path = tmp_path / "form.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def test_file_without_heights(tmp_path):
    form = read_csv(write(tmp_path, "# from the CMM\n\nangle_deg, radius_um\n180,-2.5\n0,1\n 90 , 3e0\n"))
    assert_allclose(form.angle, [0.0, np.pi / 2, np.pi])
    assert_allclose(form.heights, [0.0])
    assert_allclose(form.radius, [[1e-6, 3e-6, -2.5e-6]])


@given(st.permutations([(a, h) for a in (0, 120, 240) for h in (0, 5)]))
def test_file_with_heights_in_any_order(tmp_path_factory, places):
    rows = "".join(f"{a},{h},{a + h}\n" for a, h in places)
    form = read_csv(write(tmp_path_factory.mktemp("form"), TALL + rows))
    assert_allclose(form.heights, [0.0, 0.005])
    assert_allclose(form.radius, np.array([[0, 120, 240], [5, 125, 245]]) * 1e-6)


def every(step, first, last, radius=100.0, height=None):
    """Rows of an oval."""
    place = "" if height is None else f"{height},"
    angles = np.arange(first, last + step / 2, step)
    return "".join(f"{a:g},{place}{radius * np.cos(np.deg2rad(2 * a)):.6g}\n" for a in angles)


HEAD = "angle_deg,radius_um\n"
TALL = "angle_deg,height_mm,radius_um\n"
GOOD = "0,1\n90,2\n180,3\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no header; allowed: a first line with the names"),
        (GOOD, ":1: numbers in place of a header; allowed"),
        (HEAD, "no rows below its header"),
        (HEAD + "0,1\n90,2\n", "2 different angles; allowed: 3 or more"),
        (HEAD + GOOD + "270,nan\n", ":5: 'radius_um' is 'nan'; allowed: a finite number"),
        (HEAD + GOOD + "270,1e999\n", ":5: 'radius_um' is '1e999'; allowed"),
        ("# c\n" + HEAD + "\n" + GOOD + "270,four\n", ":7: 'radius_um' is 'four'; allowed"),
        (HEAD + GOOD + "270,\n", ":5: 'radius_um' is empty; allowed"),
        (HEAD + GOOD + "270\n", ":5: 1 values; allowed: 2"),
        (HEAD + "0,1,5\n90,2\n", ":2: 3 values; allowed: 2, as in the header (between columns a semicolon, or"),
        (HEAD + GOOD + "90,2\n", ": angle 90° at height 0 mm appears more than once"),
        (HEAD + "360,1\n120,2\n240,3\n360,1\n", ": angle 0° at height 0 mm appears more than once"),
        (HEAD + GOOD + "360.5,1\n", ": angle 360.5°; allowed: 0 up to 360, where 360 is 0 again"),
        (HEAD + GOOD + "-1,1\n", ": angle -1°; allowed"),
        (HEAD + GOOD + "360,1.002\n", ": radius_um = 1 at 0° and 1.002 at 360°, height 0 mm; allowed: the same, or"),
        (TALL + "0,5,1\n120,5,2\n240,5,3\n360,5,9\n", ": radius_um = 1 at 0° and 9 at 360°, height 5 mm; allowed"),
        (TALL + "0,0,1\n120,0,2\n240,0,3\n120,5,2\n240,5,3\n", ": no point at angle 0°, height 5 mm"),
        (TALL + "0,0,1\n90,0,1\n180,0,1\n0,1e-9,1\n", ": heights 0 and 1e-09 mm are too close"),
        (HEAD + every(5, 0, 235), ": no point from 235° to 0°, while others are 5° apart; allowed: points all round"),
        (HEAD + every(1, 30, 90), ": no point from 90° to 30°, while others are 1° apart"),
        ("angle_deg|radius_um\n0|1\n", "columns 'angle_deg|radius_um'; allowed: angle and radius"),
        (HEAD + GOOD + "1e-320,1\n", ": angles 0 and 9.999888672e-321° are too close"),
        (HEAD + GOOD + "359.9999999,1\n", ": angles 359.9999999 and 360° are too close"),
        (HEAD + GOOD + '270,"4\n', ":5: not CSV"),
        (HEAD + '0,"1\n"\n90,2\n180,3\n', ":2: not CSV"),
        (b"\xff\xfe\x00a\x00n\x00", "not a text file"),
        (HEAD.encode() + b"0,\x81\n", "not a text file; allowed: CSV in UTF-8, UTF-16 with a byte order mark, or Win"),
        (HEAD.encode() + b"0,\x00\n", "not a text file"),
        (HEAD + "0,0\n1.571,10\n3.142,0\n4.712,-10\n", "spans 0 to 4.712, which looks like radians; allowed: degrees"),
        (HEAD + "0,0\n0.25,10\n0.5,0\n0.75,-10\n", "angle_deg spans 0 to 0.75, which looks like revolutions"),
        (HEAD + "0,0\n90,225e-6\n180,0\n270,-225e-6\n", "radius_um is 0.00045 µm from peak to valley, which looks "),
        (HEAD + "0,50000\n90,50225\n180,50000\n270,49775\n", "radius_um is 4.978e+04 µm or more everywhere, which "),
    ],
)
def test_bad_file_is_refused(tmp_path, text, message):
    path = write(tmp_path, text)
    assert_refused(lambda: read_csv(path), f"{re.escape(str(path))}.*{re.escape(message)}")


@given(st.binary(max_size=200))
def test_junk_is_refused(tmp_path_factory, junk):
    path = write(tmp_path_factory.mktemp("junk"), HEAD.encode() + b"0,1\n" + junk)
    assert_refused(lambda: read_csv(path), "form.csv")


def test_what_is_no_file_or_far_too_large_is_refused_unread(tmp_path):
    """Reading a pipe would wait for its writer, for ever."""
    os.mkfifo(tmp_path / "pipe")
    with (tmp_path / "large").open("wb") as file:
        file.truncate(2**40)
    for name, message in (
        ("no.csv", r"no\.csv: cannot be read \(no such file\)"),
        ("", r"cannot be read \(a folder\)"),
        ("pipe", r"cannot be read \(not a file\)"),
        ("large", "not a text file"),
    ):
        assert_refused(lambda name=name: read_csv(tmp_path / name), message)


@pytest.mark.parametrize(
    "rows",
    [
        HEAD + every(5, 0, 355),
        HEAD + every(5, 5, 360),
        HEAD + "360,100.0004\n" + every(5, 0, 355),
        TALL + "".join(every(5, 0, end, height=h) for h, end in ((0, 360), (10, 355), (20, 360))),
        TALL + "".join(every(5, start, 360, height=h) for h, start in ((0, 5), (10, 0), (20, 5))),
        "\ufeff" + HEAD + every(5, 0, 360) + "\n\n# the end",
        '"angle_deg","radius_um"\r\n' + every(5, 0, 360).replace("\n", "\r\n"),
    ],
)
def test_a_row_at_360_closes_the_turn(tmp_path, rows):
    form = read_csv(write(tmp_path, rows))
    assert_allclose(np.rad2deg(form.angle), np.arange(0, 360, 5))
    assert_allclose(form.radius[:, 0], 100e-6)
    assert doubts(form) == []


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        (HEAD + every(5, 0, 90) + every(5, 180, 355), "no point from 90° to 180°, 90° wide, while others are 5° apart"),
        (HEAD + every(5, 50, 345), "no point from 345° to 50°, 65° wide, while others are 5° apart"),
        (HEAD + every(1, 0, 200) + every(1, 216, 359), "no point from 200° to 216°, 16° wide, while others are 1°"),
        (HEAD + every(5, 0, 355, 0.1), "radius_um goes from -0.1 to 0.1 µm; if these are millimetres, multiply by"),
        (HEAD + "0,49.8\n120,50.2\n240,50\n", "radius_um goes from 49.8 to 50.2 µm; if these are millimetres"),
        (TALL + every(90, 0, 270, height=0) + every(90, 0, 270, height=0.06), "height_mm goes over 0.06 mm; if these"),
        (HEAD + every(1, 0, 200) + every(1, 214, 359), ""),
        (HEAD + "0,1\n90,2\n180,5\n", ""),
        (HEAD + every(5, 0, 355, 1.1), ""),
        (HEAD + "0,0\n90,0\n180,0\n", ""),
    ],
)
def test_a_form_that_can_be_meant_but_seems_not_to_be_is_told(tmp_path, rows, said):
    path = write(tmp_path, rows)
    told = doubts(read_csv(path))
    assert len(told) == bool(said)
    assert said in " ".join(told)
    cell = Cell(scenario(tool={"profile": "csv", "profile_file": str(path)}).nodes)
    cell.check()
    assert cell.warnings[: len(told)] == [f"tool.profile_file = {path}: {line}" for line in told]


# --- tables on the disk


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Where tables are kept."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    return cache_folder() / "tables"


def test_a_table_is_made_once_and_read_from_then_on(folder):
    made = []

    def table(content):
        return kept(content, lambda: made.append(content) or np.array([[1.0 / 3.0], [len(made)]]))

    first = table(b"one")
    (file,) = folder.iterdir()
    assert np.array_equal(table(b"one"), first)
    assert table(b"two")[1] == 2.0
    for damage in (b"", file.read_bytes()[:-30], file.read_bytes().replace(first.tobytes(), bytes(16))):
        file.write_bytes(damage)
        assert table(b"one")[1] == len(made)
    assert made == [b"one", b"two", b"one", b"one", b"one"]
    assert len(list(folder.iterdir())) == 2


def test_few_tables_are_kept_and_none_where_nothing_can_be_written(folder):
    for number in range(40):
        kept(b"%d" % number, lambda: np.zeros(1))
    assert len(list(folder.iterdir())) == 32
    for file in folder.iterdir():
        file.unlink()
    folder.rmdir()
    folder.write_text("no folder")
    assert kept(b"one", lambda: np.ones(1)) == 1.0


def test_the_form_of_a_file_is_kept_with_its_bits_and_no_other(folder):
    """A form that is computed varies with its parameters; a sweep would keep thousands."""
    points = np.linspace(0.0, TURN, 7)[:-1]
    for form, files in [(Piston(0.0, 0.0, 30e-6, 0.06, 0.0), 0), (Measured(points, np.zeros(1), points[None]), 1)]:
        tables = []
        for _ in range(2):
            profile_table._table.cache_clear()  # as in another process
            tables.append(profile_table.tabulated(form).table)
        assert tables[0].tobytes() == tables[1].tobytes() == ProfileTable(form).table.tobytes()
        assert not tables[1].flags.writeable
        assert len(list(folder.glob("*"))) == files
