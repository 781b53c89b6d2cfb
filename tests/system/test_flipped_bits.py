# SPDX-License-Identifier: Apache-2.0
"""Single flipped bits in every kind of file that is read again."""

import kept_files
import pytest
from bags import sized

pytestmark = pytest.mark.system


@pytest.mark.parametrize("kind", kept_files.KINDS)
def test_no_flipped_bit_changes_a_value_in_silence(kind, tmp_path, monkeypatch, capsys):
    """250 bits of a file, of compiled code 50: the same values come of it, or one line names the file."""
    kept = kept_files.made(kind, monkeypatch, tmp_path)
    kept_files.flip(kept, sized(50 if "compiled" in kind else 250), lambda: capsys.readouterr().err)
