# SPDX-License-Identifier: Apache-2.0
"""The tutorials, done by a reader who has nothing but the page: every command runs, and shows what the page shows."""

from pathlib import Path

import pages
import pytest

TUTORIALS = sorted((pages.ROOT / "docs" / "tutorials").glob("*.md"))


@pytest.mark.usefixtures("domain")
@pytest.mark.parametrize("page", TUTORIALS, ids=lambda page: page.stem)
def test_a_reader_who_follows_a_tutorial_sees_what_it_shows(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pages.reader(tmp_path, monkeypatch) as reader:
        reader.follow(page)
