# SPDX-License-Identifier: Apache-2.0
"""The tutorials, done by a reader who has nothing but the page: every command runs, and shows what the page shows."""

import contextlib
from collections.abc import Iterator
from pathlib import Path

import distributed
import pages
import pytest

from lathe_explore.sweep import sweep

pytestmark = pytest.mark.system

TUTORIALS = sorted((pages.ROOT / "docs" / "tutorials").glob("*.md"))


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
