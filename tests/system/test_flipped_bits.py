# SPDX-License-Identifier: Apache-2.0
"""Single flipped bits in every kind of file that is read again."""

import kept_files
import pytest

pytestmark = pytest.mark.system


@pytest.mark.parametrize("kind", kept_files.KINDS)
def test_no_flipped_bit_changes_a_value_in_silence(kind, tmp_path, monkeypatch, capsys):
    """250 bits of a file: the same values come of it, or one line names the file."""
    kept_files.prepare(monkeypatch, tmp_path)
    kept = kept_files.KINDS[kind](tmp_path / "folder")
    print(kind, kept_files.flip(kept, 250, lambda: capsys.readouterr().err))
