# SPDX-License-Identifier: Apache-2.0
"""Course and exercises; tests/system runs their notebooks and commands."""

import re
from pathlib import Path

import course
import nbformat
import pages
import pytest

TEACHER = pages.ROOT / "docs" / "tutorials" / "teacher.md"


def parts(page: Path) -> list[str]:
    return re.split(r"^## (?=\d)", page.read_text(encoding="utf-8"), flags=re.MULTILINE)[1:]


def sources(unit: Path) -> str:
    return "\n".join(cell.source for cell in nbformat.read(unit, as_version=4).cells)


CASES = [(part, "") for part in parts(TEACHER)]
CASES += [(part, sources(unit)) for part, unit in zip(parts(course.PAGE), course.UNITS, strict=True)]


@pytest.mark.parametrize(("part", "given"), CASES, ids=[part.partition("\n")[0] for part, _ in CASES])
def test_a_solution_has_no_number_that_its_command_does_not_print(part: str, given: str) -> None:
    """Each number of a solution is one that its program prints, which is compared, or that the exercise gives."""
    before, _, solution = part.partition("<details")
    printed = "".join(block.text for block in pages.blocks_of(solution))
    explained = re.sub(r"```.*?```|\]\(.*?\)", "", solution, flags=re.DOTALL)
    said = re.findall(r"\d+\.\d+", explained)
    known = {float(number) for number in re.findall(r"\d+(?:\.\d+)?", given + before + printed)}
    assert printed
    assert [number for number in said if float(number) not in known] == []


@pytest.mark.parametrize("unit", course.UNITS, ids=lambda unit: unit.stem)
def test_a_solution_fills_each_gap_of_a_notebook(unit: Path) -> None:
    """A unit of the course holds no output, asks for the names that its solutions define, and links to them."""
    notebook = nbformat.read(unit, as_version=4)
    assert notebook.metadata.language_info.file_extension == ".py"  # of jupyter nbconvert --to script
    assert not any(cell.get("outputs") for cell in notebook.cells)
    filling = course.solutions(unit)
    asked = [cell.source.partition("\n\n")[0] for cell in course.gaps(notebook)]
    assert [course.names(each) for each in asked] == [course.names(solution.code) for solution in filling]
    (title,) = (part.partition("\n")[0] for part in parts(course.PAGE) if unit.name in part)
    assert f"\n# {title}\n" in notebook.cells[0].source
    anchor = re.sub(r"[^\w -]", "", title).lower().replace(" ", "-")
    assert f"](../../docs/tutorials/course.md#{anchor})" in notebook.cells[-1].source
