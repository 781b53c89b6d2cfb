# SPDX-License-Identifier: Apache-2.0
"""The public face: few names, each with an example that runs, and the only ones that pages and templates use."""

import ast
import doctest
import importlib
import re
from pathlib import Path

import pytest

import lathe_bagtools
import lathe_commission
import lathe_explore
import lathe_export
import lathe_machine
import lathe_rc
from lathe_rc.cell.recording import Recording
from lathe_rc.cell.scenario import Scenario

ROOT = Path(__file__).parents[2]
MOST = 31
#: without an example of their own: constants, errors, and what the example of another name shows
SHOWN_ELSEWHERE = {
    *("DONE", "Input", "InputError", "LatheError", "LawParameters", "NodeParameters", "Now", "Output"),
    *("PlantParameters", "Scenario", "messages", "study"),
}
PACKAGES = (lathe_rc, lathe_machine, lathe_bagtools, lathe_commission, lathe_explore, lathe_export)
EXAMPLES = {
    name: getattr(package, name) for package in PACKAGES for name in sorted({*package.__all__} - SHOWN_ELSEWHERE)
}
EXAMPLES |= {"Scenario.varied": Scenario.varied, "Recording.frame": Recording.frame}
#: start processes, of Dask (test_sweep.py and test_tune.py have none) or of cells (test_extending.py has those)
WITH_PROCESSES = {"run_sweep", "tune", "digests_by_host"}
PAGES = sorted([*ROOT.glob("docs/**/*.md"), *ROOT.glob("lathe_rc/templates/*/*.j2"), ROOT / "README.md"])


def test_the_public_names_are_few_and_can_be_imported():
    assert sum(len(package.__all__) for package in PACKAGES) <= MOST
    for package in PACKAGES:
        assert set(package.__all__) <= {*dir(package)}
    with pytest.raises(AttributeError, match="no attribute 'lode'"):
        lathe_rc.lode  # noqa: B018 - it is not there


@pytest.mark.usefixtures("no_pictures")
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.system if name in WITH_PROCESSES else ()) for name in EXAMPLES]
)
def test_the_example_in_its_help_runs(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (example,) = doctest.DocTestFinder(recurse=False).find(EXAMPLES[name], name, globs={"__name__": __name__})
    assert example.examples
    failed, _ = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(example)
    assert failed == 0, capsys.readouterr().out


def is_public(module: str, name: str) -> bool:
    """Tell whether ``from module import name`` uses what the ``__all__`` of a package lists."""
    package, _, last = module.rpartition(".")
    if package and last in importlib.import_module(package).__all__:
        return not name.startswith("_")  # of a public module
    return name in getattr(importlib.import_module(module), "__all__", ())


@pytest.mark.parametrize("page", PAGES, ids=lambda page: f"{page.parent.name}/{page.name}")
def test_pages_and_templates_import_public_names_only(page):
    text = page.read_text(encoding="utf-8")
    code = re.findall(r"```py(?:thon)?[^\n]*\n(.*?)```", text, re.DOTALL) if page.suffix == ".md" else [text]
    lines = re.findall(r"^from lathe_(?!rc_msgs)[^\n]*", "\n".join(code), re.MULTILINE)
    for line in ast.walk(ast.parse(re.sub(r"\{%.*?%\}", "", "\n".join(lines)))):
        if isinstance(line, ast.ImportFrom):
            assert [alias.name for alias in line.names if not is_public(str(line.module), alias.name)] == []


PISTON = lathe_rc.load("piston")


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: lathe_rc.run("piston"), "scenario = 'piston': str; allowed: a Scenario"),
        (lambda: lathe_rc.run([PISTON]), "list; allowed: a Scenario"),
        (lambda: lathe_rc.run(PISTON, mode="Offline"), "mode = 'Offline'; allowed: offline, composed, processes"),
        (lambda: list(lathe_rc.run_many(PISTON)), r"allowed: a list, \[scenario\]"),
        (lambda: list(lathe_rc.run_many(["piston"])), "str; allowed: a Scenario"),
        (lambda: lathe_rc.budget("piston"), "str; allowed: a Scenario"),
        (lambda: lathe_rc.load(3), "allowed: the name of a scenario, or a file"),
        (lambda: lathe_rc.load("piston", "tool.feed=1e-4"), r"allowed: a list of texts, \['tool.feed=1e-4'\]"),
        (lambda: setattr(PISTON.nodes["tool"], "feed", "a"), r"allowed: scenario.varied\(\{'NODE.feed': VALUE\}\)"),
        (lambda: lathe_explore.run_sweep(PISTON, {"tool.feed": 1}, "x"), "allowed: a lathe_explore.Space"),
        (lambda: lathe_explore.tune("piston", {}, [], "x"), "str; allowed: a Scenario"),
    ],
)
def test_a_wrong_argument_is_refused_in_one_line(call, message):
    with pytest.raises(lathe_rc.InputError, match=message) as told:
        call()
    assert "\n" not in str(told.value)
