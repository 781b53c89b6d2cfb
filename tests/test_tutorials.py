# SPDX-License-Identifier: Apache-2.0
"""The tutorials, done by a reader who has nothing but the page: every command runs, and shows what the page shows."""

import contextlib
import re
from collections.abc import Iterator
from pathlib import Path

import distributed
import pages
import pytest

from lathe_rc.sweep import sweep

TUTORIALS = sorted((pages.ROOT / "docs" / "tutorials").glob("*.md"))
TEACHER = (pages.ROOT / "docs" / "tutorials" / "teacher.md").read_text(encoding="utf-8")
EXERCISES = re.split(r"^## (?=\d)", TEACHER, flags=re.MULTILINE)[1:]


@pytest.fixture
def own_workers(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Sweeps and tuning compute in this process: to start others takes seconds."""
    options = {"processes": False, "n_workers": 1, "threads_per_worker": 1, "dashboard_address": ":0"}
    with distributed.Client(set_as_default=False, **options) as client:
        monkeypatch.setattr(sweep, "client_of", lambda *_: contextlib.nullcontext(client))
        yield


@pytest.mark.usefixtures("domain", "own_workers")
@pytest.mark.parametrize("page", TUTORIALS, ids=lambda page: page.stem)
def test_a_reader_who_follows_a_tutorial_sees_what_it_shows(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pages.reader(tmp_path, monkeypatch) as reader:
        reader.follow(page)


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
