# SPDX-License-Identifier: Apache-2.0
"""Damage to files that are read again, and what stands in place of them."""

import json
import os
from pathlib import Path

import kept_files
import pyarrow.parquet
import pytest
from machines import line_of

from lathe_explore.sweep.folder import Folder


@pytest.mark.parametrize("kind", kept_files.KINDS)
def test_no_flipped_bit_changes_a_value_in_silence(kind, tmp_path, monkeypatch, capsys):
    """Some bits of a file of each kind; tests/system has more of them."""
    kept = kept_files.made(kind, monkeypatch, tmp_path)
    kept_files.flip(kept, 2 if "compiled" in kind else 4, lambda: capsys.readouterr().err)


@pytest.fixture
def swept(tmp_path):
    return kept_files.swept(tmp_path / "sweep").path


def test_a_folder_of_an_older_version_has_no_checksums_and_is_read(swept):
    table, rows, about = Folder(swept).table(), swept / "rows" / "000000.parquet", swept / "sweep.json"
    pyarrow.parquet.write_table(pyarrow.parquet.read_table(rows), rows)
    about.write_text(
        json.dumps({name: told for name, told in json.loads(about.read_text()).items() if name != "checksum"})
    )
    assert b"lathe_rc checksum" not in rows.read_bytes() + about.read_bytes()
    assert Folder(swept).table().equals(table)


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("sweep.json", b"null", "not written by lathe sweep or lathe tune (Input should be an object)"),
        ("sweep.json", b"[]", "not written by lathe sweep or lathe tune (Input should be an object)"),
        ("sweep.json", b"{", "not written by lathe sweep or lathe tune (Invalid JSON"),
        ("sweep.json", b'{"format": 1}', "not written by lathe sweep or lathe tune (name: Field required)"),
        ("rows/1.parquet", b"PAR1", "no rows of a sweep"),
        ("rows/1.parquet", kept_files.parquet({"a": [1]}), "no rows of a sweep: without the column cell"),
        ("sweep.json", Path("/dev/zero"), "not a file"),
        ("scenario.yaml", Path("/dev/zero"), "not a file"),
        ("rows/1.parquet", Path("/dev/zero"), "not a file"),
        ("rows/1.parquet", Path("nowhere"), "No such file or directory"),
        ("rows/1.parquet", None, "Permission denied"),
        ("sweep.json", None, "Permission denied"),
    ],
)
def test_what_stands_in_place_of_a_file_of_a_sweep_is_refused_in_a_line(swept, name, content, said, monkeypatch):
    path = swept / name
    if isinstance(content, Path):
        path.unlink(missing_ok=True)
        path.symlink_to(content)
    elif content is not None:
        path.write_bytes(content)
    else:  # root may read all

        def refuse(file, *_):
            if str(file) == str(path):
                raise PermissionError(13, "Permission denied", file)
            return os_open(file, *_)

        path.touch()
        os_open = os.open
        monkeypatch.setattr(os, "open", refuse)
    refused = line_of(lambda: Folder(swept).table())
    assert refused.startswith(f"{path}: {said}")
