# SPDX-License-Identifier: Apache-2.0
"""Damage to files that are read again."""

import kept_files
import pytest


@pytest.mark.parametrize("kind", kept_files.KINDS)
def test_no_flipped_bit_changes_a_value_in_silence(kind, tmp_path, monkeypatch, capsys):
    """Four bits of a file of each kind; tests/system has more of them."""
    kept_files.prepare(monkeypatch, tmp_path)
    kept = kept_files.KINDS[kind](tmp_path / "folder")
    kept_files.flip(kept, 4, lambda: capsys.readouterr().err)
