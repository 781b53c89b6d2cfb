# SPDX-License-Identifier: Apache-2.0
"""Pictures of the pages that take some seconds each: the code still draws them, and the pages have the tables."""

import pytest

import pictures

pytestmark = pytest.mark.system

SLOW = 20  # [s]; the rest is for ./lathe docs --figures
WANTED = [name for name, row in pictures.TABLE.items() if row.steady and pictures.QUICK < row.seconds <= SLOW]


@pytest.mark.parametrize("name", WANTED)
def test_a_picture_is_current_and_its_page_has_what_its_command_prints(name, tmp_path):
    found, _ = pictures.check(name, tmp_path)
    assert found == [], f"run: ./lathe docs --figures {name}"
