# SPDX-License-Identifier: Apache-2.0
"""The page of the slow tests agrees with the tests' docstrings, and is made of a report of their times."""

import json

import pytest

import slow_tests
from slow_tests import Cost, Name
from workplace import RefusalError

REPORT = """<testsuites><testsuite>
<testcase classname="tests.test_a" name="test_one[x-[y]]" time="2.5"><properties>
<property name="processes" value="5"/><property name="programs" value="1"/></properties></testcase>
<testcase classname="tests.test_a" name="test_one[z]" time="0.5"/>
<testcase classname="tests.test_a.TestFullCell" name="test_is_held" time="4"/>
<testcase classname="" name="tests.test_b" time="0"><skipped message="no rerun"/></testcase>
</testsuite></testsuites>
"""


@pytest.fixture
def files(tmp_path, monkeypatch):
    """A report of two test files, one of them skipped."""
    (tmp_path / "test_a.py").write_text(
        """
class TestFullCell:
    def test_is_held(self):
        '''The force|edge is held.

        More of it.
        '''

def test_one(x):
    '''Not what "processes" do.'''

def test_the_paper_s_two():
    pass
""",
        encoding="utf-8",
    )
    (tmp_path / "test_b.py").touch()
    monkeypatch.setattr(slow_tests, "TESTS", tmp_path)
    report = tmp_path / "report.xml"
    report.write_text(REPORT, encoding="utf-8")
    return report


def test_promises_are_listed_from_docstrings_and_names(files, capsys):
    assert slow_tests.promises(["_a"]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "test_a.py",
        "  TestFullCell::test_is_held: The force|edge is held.",
        '  test_one: Not what "processes" do.',
        "  test_the_paper_s_two: the paper's two",
    ]
    assert slow_tests.promises([]) == 0
    assert "test_b.py" in capsys.readouterr().out.splitlines()


def test_the_page_says_what_the_tests_say():
    assert slow_tests.wrong(slow_tests.PAGE.read_text(encoding="utf-8"), slow_tests.told()) == []


def test_the_page_has_all_rows_and_the_share_of_each_file():
    page = slow_tests.PAGE.read_text(encoding="utf-8")
    assert len(slow_tests._ROW.findall(page)) == slow_tests.SLOWEST
    rows = [line for line in page.splitlines() if line.startswith("| ")][2:]
    assert len(rows) == slow_tests.SLOWEST + len(slow_tests.shares())
    assert 50.0 < sum(slow_tests.shares().values()) <= 100.0


def test_cases_are_added_up_by_test_and_class(files):
    assert slow_tests.took(files) == {
        Name("test_a", "", "test_one"): Cost(3.0, 2, with_cell=1, processes=5, programs=1),
        Name("test_a", "TestFullCell", "test_is_held"): Cost(4.0, 1),
        Name("test_b", "", "tests.test_b"): Cost(0.0, 1),
    }


def test_a_promise_is_the_first_line_of_the_docstring_or_else_the_name(files):
    assert {name.test: promise for name, promise in slow_tests.told().items()} == {
        "test_is_held": "The force|edge is held.",
        "test_one": 'Not what "processes" do.',
        "test_the_paper_s_two": "the paper's two",
    }
    assert slow_tests.in_words(Name("test_a", "TestFullCell", "test_is_held")) == "full cell: is held"


def test_the_slowest_come_first_by_file_and_what_is_wrong_is_named(files):
    said = slow_tests.told()
    page = slow_tests.written(slow_tests.took(files), said)
    assert page.splitlines()[-3:] == [
        "| **test_a** | 100.0 % | | | |",
        r"| TestFullCell.`test_is_held` | 57.1 % | 1 |  | The force\|edge is held. |",
        '| `test_one` | 42.9 % | 2 | 5 processes, 1 program | Not what "processes" do. |',
    ]
    assert "starts: 1 tests,\nin 1 cases, start processes of cells, and 0 others programs." in page
    assert slow_tests.wrong(page, said) == []
    del said[Name("test_a", "", "test_one")]
    said[Name("test_a", "TestFullCell", "test_is_held")] = "The force is held."
    assert slow_tests.wrong(page, said) == [
        "test_is_held says: The force is held.",
        "no test test_one in test_a.py",
    ]


def test_the_coverage_is_that_of_the_last_measurement_or_what_the_page_says(files, monkeypatch):
    folder, page = files.parent / "coverage", files.with_name("tests.md")
    monkeypatch.setattr(slow_tests, "COVERAGE", folder)
    monkeypatch.setattr(slow_tests, "PAGE", page)
    assert slow_tests.coverage().startswith("Coverage: not measured")
    folder.mkdir()
    totals = {"percent_covered": 87.65, "num_statements": 2000, "num_branches": 700}
    (folder / slow_tests.FIGURES).write_text(json.dumps({"totals": totals}), encoding="utf-8")
    said = slow_tests.coverage()
    assert "87.7 % of 2000 statements and 700 branches" in said
    page.write_text(slow_tests.written(slow_tests.took(files), slow_tests.told()), encoding="utf-8")
    (folder / slow_tests.FIGURES).unlink()
    assert slow_tests.coverage() == said


def test_a_report_of_some_files_makes_no_page(files):
    (files.parent / "test_c.py").touch()
    with pytest.raises(RefusalError, match=r"the last ./lathe test ran 2 of 3 files of tests \(test_c is missing\)"):
        slow_tests.took(files)
    with pytest.raises(RefusalError, match=r"run ./lathe test first"):
        slow_tests.took(files.with_name("none.xml"))
