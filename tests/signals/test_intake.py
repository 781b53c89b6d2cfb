# SPDX-License-Identifier: Apache-2.0
"""Files as people bring them, through every reader of their kind."""

import numpy as np
import pytest
import user_files
from machines import assert_refused
from numpy.testing import assert_array_equal

from lathe_machine.signals.counts import CsvReader
from lathe_rc.cell import cells_file
from lathe_rc.signals import measurement_file, tachogram
from lathe_rc.signals.quantities import Mapped, parse_columns


@pytest.mark.parametrize("kind", user_files.KINDS)
def test_files_are_read_with_the_numbers_of_the_plain_one_or_refused_by_line_and_cure(tmp_path, kind):
    """Dialects, encodings, heads, preambles, units and faults of a kind of file; its readers agree."""
    wrong = {file.name: said for file in user_files.files(kind) if (said := user_files.verdict(tmp_path, file))}
    assert not wrong


def test_there_are_three_hundred_files():
    assert len(list(user_files.files())) >= 300


@pytest.mark.parametrize(
    ("column", "quantity", "factor"),
    [
        ("time [ms]", "time", 1e-3),
        ("Time (ms)", "time", 1e-3),
        ("time / ms", "time", 1e-3),
        ("t_ms", "time", 1e-3),
        ("Zeit ms", "time", 1e-3),
        ("command um", "command", 1e-6),
        ("Command [µm]", "command", 1e-6),
        ("|H| (dB)", "magnitude", None),
        ("Magnitude dB", "magnitude", None),
        ("Phase [rad]", "phase", 1.0),
        ("f / kHz", "frequency", 2e3 * np.pi),
        ("n [1/min]", "speed", 1.0),
        ("rpm", "speed", 1.0),
    ],
)
def test_names_of_laboratories_have_their_units(tmp_path, column, quantity, factor):
    path = tmp_path / "a.csv"
    path.write_text(f"{column};x;state\n6;2;3\n", encoding="utf-8")
    ((found,),) = measurement_file.read(path).read(quantity)
    assert found == pytest.approx(10**0.3 if factor is None else 6.0 * factor, rel=1e-15)


@pytest.mark.parametrize(
    ("numbers", "value"),
    [
        ("1.234,5", 1234.5), ("1,234.5", 1234.5), ("1 234,5", 1234.5), ("1'234.5", 1234.5), ("12 345", 12345.0),
        ("0,125", 0.125), ("0.125", 0.125), ("-1.234.567,8", -1234567.8), ("1,5E-3", 1.5e-3),
        ("1.234.567", None), ("12.34,5", None), ("1,234,567", None), ("1_000", None), ("5 µm", None),
    ],
)  # fmt: skip
def test_marks_between_thousands_are_read_or_refused(tmp_path, numbers, value):
    path = tmp_path / "a.csv"
    path.write_text(f"time;command\n0;1\n1;{numbers}\n", encoding="utf-8")
    if value is None:
        assert_refused(lambda: measurement_file.read(path).read("command"), "a.csv:3: 'command' is .*; allowed")
    else:
        assert measurement_file.read(path).read("command")[0][1] == value


def test_a_comma_that_may_be_either_is_refused(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text('time,command\n0,"1,234"\n', encoding="utf-8")
    assert_refused(lambda: measurement_file.read(path).read("command"), "a.csv:2: '1,234' may have thousands or dec")


def test_times_of_day_and_counts_keep_all_their_digits(tmp_path):
    """Seconds since 1970, of which a double resolves 0.2 µs, and counters beyond 2^53."""
    path = tmp_path / "a.csv"
    path.write_text("t [s];n [1/min]\n1700000000,000000001;999,5\n1700000000,5;1000\n", encoding="utf-8")
    assert_array_equal(tachogram.read(path)[0], [0.0, 0.499999999])
    path.write_text(
        "edge_s;time_s;index_counts;counts\n0,001;0,002;;9007199254740993\n0,001;0,003;-4;7\n", encoding="utf-8"
    )
    reader = CsvReader(path)
    assert list(reader.read()) == [(2_000_000, 9007199254740993, 1_000_000), (3_000_000, 7, 1_000_000)]
    assert (reader.pulses, reader.numbers) == ([(1, -4)], [2, 3])


def test_a_long_file_has_the_numbers_of_a_short_one(tmp_path):
    """Above 1 MiB columns are read at once; a fault is still told by its line."""
    rows = [f"{k};{k / 7:.17g};x".replace(".", ",") for k in range(60_000)]
    path = tmp_path / "a.csv"
    for text in ("Analyser;7\nt [ms];command [um];remark\n", "time;command;remark\nms;um;\n"):
        path.write_text(text + "\n".join(rows), encoding="utf-8")
        time, command = measurement_file.read(path).read("time", "command")
        assert_array_equal(time, np.arange(60_000) * 1e-3)
        assert_array_equal(command, np.arange(60_000) / 7 * 1e-6)
    path.write_text("time;command;remark\n" + "\n".join([*rows, "60000;1.5;x"]), encoding="utf-8")
    assert_refused(lambda: measurement_file.read(path).read("command"), "a.csv:60002: '1.5' after '0,1428")


def test_columns_of_cells_are_mapped_to_targets(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("Grenze [µm];Nummer\n2,5;0,7\n3;8\n", encoding="cp1252")
    columns = parse_columns(["tool.tolerance=Grenze [µm]:1e-6"], names=())
    found = cells_file.read(path, ["Nummer"], columns)
    assert found == [{"Nummer": "0,7", "tool.tolerance": 2.5 * 1e-6}, {"Nummer": "8", "tool.tolerance": 3.0 * 1e-6}]
    for given, said in (
        (["a=b:c"], "no unit 'c' of a; allowed: a number"),
        (["=b"], "allowed: TARGET=COLUMN"),
        (["a=b", "a=c"], "a is given twice"),
    ):
        assert_refused(lambda given=given: parse_columns(given, names=()), said)
    assert_refused(
        lambda: cells_file.read(path, [], {"a.b": Mapped("c")}), r"a.csv: row 1: 'c' is missing \(--column a.b=c\)"
    )
