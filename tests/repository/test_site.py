# SPDX-License-Identifier: Apache-2.0
"""The site says what the pages say, and its picture of the packages is true; linters build it."""

import ast
import re
from collections import Counter
from pathlib import Path

import pytest
from markdown import Markdown
from markdown_it import MarkdownIt

import architecture
import equations
import pictures
from gfm import for_python_markdown
from lathe_rc.catalogue import OURS

ROOT = Path(__file__).parents[2]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
EXTENSIONS = ["attr_list", "md_in_html", "pymdownx.betterem", "pymdownx.superfences", "sane_lists", "tables"]
QUICK = [name for name, row in pictures.TABLE.items() if row.steady and row.seconds <= pictures.QUICK]


def elements(html):
    """How many of each element there are, of those that a wrong indentation changes."""
    return Counter(re.findall(r"<(h[1-6]|li|pre|table|tr|td|ul|ol|img)\b", html))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_a_page_is_the_same_on_the_site_as_on_github(page):
    """Lists, tables and blocks; and an equation in a line has nothing that GitHub takes for Markdown.

    Before it looks for equations, GitHub takes \\, for a comma, and a bar ends a cell of a table.
    """
    text = page.read_text(encoding="utf-8")
    github = MarkdownIt("commonmark").enable("table").render(text)
    site = Markdown(extensions=EXTENSIONS).convert(for_python_markdown(text))
    assert elements(site) == elements(github)
    prose = re.sub(r"^( *`{3,}).*?^ *`{3,}$", "", text, flags=re.MULTILINE | re.DOTALL)
    found = [tex for _, tex in equations._INLINE.findall(prose) if tex]
    assert [tex for tex in found if re.search(r"\\[^a-zA-Z]|[|*]|<(?! )", tex)] == []


def imports():
    """Which package of the core, or beside it, imports which, and where it does."""

    def box(parts):
        return parts[1] if parts[0] == "lathe_rc" and len(parts) > 1 else parts[0]

    for path in sorted(ROOT.glob("lathe_*/**/*.py")):
        package = box(path.relative_to(ROOT).with_suffix("").parts)
        tree = ast.parse(path.read_text(encoding="utf-8"))
        typing = [
            each for each in ast.walk(tree) if isinstance(each, ast.If) and ast.unparse(each.test) == "TYPE_CHECKING"
        ]
        only_for_types = {id(node) for each in typing for node in ast.walk(each)}
        for node in ast.walk(tree):
            if not isinstance(node, ast.Import | ast.ImportFrom) or id(node) in only_for_types:
                continue
            module = f"{node.module}." if isinstance(node, ast.ImportFrom) else ""
            for alias in node.names:
                parts = f"{module}{alias.name}".split(".")
                if parts[0].startswith("lathe_") and (imported := box(parts)) != package:
                    yield package, imported, path.relative_to(ROOT)


def test_the_picture_of_the_architecture_is_true():
    layer = {name: index for index, level in enumerate(architecture.LAYERS) for name in level.boxes}
    packages = {path.parent.name for path in (ROOT / "lathe_rc").glob("*/__init__.py")} - {"msg_defs", "templates"}
    assert set(layer) == packages | (OURS - {"lathe_rc", "lathe_papers"})
    known = [found for found in imports() if found[0] in layer and found[1] in layer]
    upwards = [found for found in known if layer[found[1]] < layer[found[0]]]
    assert upwards == [], "an import from a layer above"
    beside = {(one, other) for one, other, _ in known if layer[one] == layer[other]}
    assert beside == set(architecture.BESIDE)
    assert {one for one, other, _ in known if other == "nodes"} <= {
        "commands",
        "harness",
        "lathe_bagtools",
        "lathe_live",
        "lathe_machine",
    }, "which know of ROS"
    drawn = (ROOT / "docs" / "img" / "architecture.svg").read_text(encoding="utf-8")
    assert drawn == architecture.picture(), "run: ./lathe python figures/architecture.py"


def test_the_sentences_of_the_architecture_are_contracts_of_the_linters():
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    sentences = re.findall("^- (.+)$", page.partition("## What each part")[2].partition("\n## ")[0], re.MULTILINE)
    contracts = re.findall('^name = "(.+)"$', (ROOT / "pyproject.toml").read_text(encoding="utf-8"), re.MULTILINE)
    assert len(sentences) == 8
    assert {*sentences} <= {*contracts}


class TestPictures:
    def test_each_is_drawn_by_a_command_and_shown_by_its_page(self):
        assert {path.name for path in pictures.PICTURES.iterdir()} == set(pictures.TABLE)
        for name, picture in pictures.TABLE.items():
            assert f"img/{name})" in (ROOT / "docs" / picture.page).read_text(encoding="utf-8"), picture.page

    def test_no_script_draws_what_nobody_shows(self):
        scripts = {path.name for path in (ROOT / "figures").glob("*.py")} - {"chromium.py", "place.py"}
        drawing = {Path(word).name for picture in pictures.TABLE.values() for word in picture.command.split()}
        shown = "".join(page.read_text(encoding="utf-8") for page in PAGES)
        assert [name for name in scripts - drawing if f"figures/{name}" not in shown] == []

    @pytest.mark.parametrize("name", QUICK)
    def test_is_what_the_code_draws_and_its_page_has_what_it_prints(self, name, tmp_path):
        """Of the quick ones; ./lathe docs --figures does it with all."""
        found, _ = pictures.check(name, tmp_path)
        assert found == [], f"run: ./lathe docs --figures {name}"
