# SPDX-License-Identifier: Apache-2.0
"""The notebooks in examples/: ``./lathe python tests/system/test_notebooks.py`` stores their outputs anew."""

import tempfile
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

NOTEBOOKS = sorted((Path(__file__).parents[2] / "examples").glob("*.ipynb"))
LARGEST = 300_000  # [B], with the pictures

pytestmark = pytest.mark.system


def executed(path, folder):
    """A notebook whose cells have run in a folder; nothing of the time or the machine stays in it."""
    notebook = nbformat.read(path, as_version=4)
    about = notebook.metadata.copy()
    where = {"metadata": {"path": str(folder)}}
    NotebookClient(notebook, timeout=None, record_timing=False, resources=where).execute()
    notebook.metadata = about
    return notebook


def shown(notebook):
    """The outputs as texts; of a picture, that it is one."""
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    found = [output.get("data", {"text/plain": output.get("text")}) for output in outputs]
    return ["a picture" if "image/png" in each else each["text/plain"] for each in found]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_and_prints_what_is_stored_in_it(path, tmp_path):
    """A notebook runs from top to bottom, prints what is stored in it and leaves nothing behind."""
    assert shown(executed(path, tmp_path)) == shown(nbformat.read(path, as_version=4))
    assert list(tmp_path.iterdir()) == []
    assert path.stat().st_size < LARGEST


if __name__ == "__main__":
    for notebook in NOTEBOOKS:
        with tempfile.TemporaryDirectory() as place:
            nbformat.write(executed(notebook, place), notebook)
