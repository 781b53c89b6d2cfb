# SPDX-License-Identifier: Apache-2.0
"""The exercises for teachers; tests/system/test_tutorials.py runs the commands of all tutorials."""

import re

import pages
import pytest

TEACHER = (pages.ROOT / "docs" / "tutorials" / "teacher.md").read_text(encoding="utf-8")
EXERCISES = re.split(r"^## (?=\d)", TEACHER, flags=re.MULTILINE)[1:]


@pytest.mark.parametrize("exercise", EXERCISES, ids=lambda text: text.splitlines()[0])
def test_a_solution_has_no_number_that_its_command_does_not_print(exercise: str) -> None:
    """Each number of a solution is one that its command prints, which is compared above, or that the exercise gives."""
    given, _, solution = exercise.partition("<details")
    printed = "".join(block.text for block in pages.blocks_of(solution))
    explained = re.sub(r"```.*?```|\]\(.*?\)", "", solution, flags=re.DOTALL)
    said = re.findall(r"\d+\.\d+", explained)
    known = {float(number) for number in re.findall(r"\d+(?:\.\d+)?", given + printed)}
    assert said
    assert [number for number in said if float(number) not in known] == []
