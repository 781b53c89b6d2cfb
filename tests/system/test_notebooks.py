# SPDX-License-Identifier: Apache-2.0
"""The notebooks in examples/: ``./lathe python tests/system/test_notebooks.py`` stores the outputs of piston.ipynb."""

import re
import tempfile
from pathlib import Path

import course
import nbformat
import pages
import pytest
from nbclient import NotebookClient

NOTEBOOKS = sorted((Path(__file__).parents[2] / "examples").glob("*.ipynb"))
LARGEST = 300_000  # [B], with the pictures

pytestmark = pytest.mark.system


def executed(notebook, folder):
    """A notebook whose cells have run in a folder; nothing of the time or the machine stays in it."""
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
    stored = nbformat.read(path, as_version=4)
    assert shown(executed(nbformat.read(path, as_version=4), tmp_path)) == shown(stored)
    assert list(tmp_path.iterdir()) == []
    assert path.stat().st_size < LARGEST


@pytest.mark.parametrize("path", course.UNITS, ids=lambda path: path.stem)
def test_a_unit_of_the_course_as_delivered_asks_for_each_gap(path, tmp_path):
    """A unit whose gaps are open runs without an error, and each cell with a gap says what is missing."""
    notebook = executed(nbformat.read(path, as_version=4), tmp_path)
    for cell in course.gaps(notebook):
        (output,) = cell.outputs
        missing = re.fullmatch(r"fill in (.*); then run this cell again\n", output.text)
        assert set(re.split(r", | and ", missing[1])) == course.names(cell.source.partition("\n\n")[0])


@pytest.mark.parametrize("path", course.UNITS, ids=lambda path: path.stem)
def test_a_unit_of_the_course_with_its_solutions_prints_what_the_page_shows(path, tmp_path):
    """With the solutions of the page, each cell prints the text beside them, draws a figure, and warns of nothing."""
    notebook, filling = nbformat.read(path, as_version=4), course.solutions(path)
    cells = course.fill(notebook, filling)
    executed(notebook, tmp_path)
    for cell, solution in zip(cells, filling, strict=True):
        printed = [output for output in cell.outputs if output.output_type == "stream"]
        assert {output.name for output in printed} == {"stdout"}
        came = "".join(output.text for output in printed)
        assert not pages.different(solution.shown.splitlines(), came.splitlines())
        assert any("image/png" in output.get("data", {}) for output in cell.outputs)
    assert list(tmp_path.iterdir()) == []


if __name__ == "__main__":
    for path in NOTEBOOKS:
        with tempfile.TemporaryDirectory() as place:
            nbformat.write(executed(nbformat.read(path, as_version=4), place), path)
