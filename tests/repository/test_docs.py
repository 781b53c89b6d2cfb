# SPDX-License-Identifier: Apache-2.0
"""The pages are true: the reference page, links, the examples of the README, scenarios."""

import ast
import functools
import pkgutil
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pages
import pytest
from click.testing import CliRunner

from lathe_rc import __version__, cli, reference
from lathe_rc.catalogue import OURS
from lathe_rc.cell.host_topics import HOST_TOPICS, MASTER, MEMBER, HostTopic
from lathe_rc.cell.kinds import MASTERS, STAGES
from lathe_rc.cell.scenario import TABLES
from lathe_rc.commands.run import run
from lathe_rc.messages import PACKAGE, store

ROOT = Path(__file__).parents[2]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
WITH_PYTHON = [page for page in PAGES if "```python\n" in page.read_text(encoding="utf-8")]

_LINK = re.compile(r"\]\(([^)#]*)(?:#([^)]*))?\)")
_RUN = re.compile(r"^\$ \./lathe (run .*)$", re.MULTILINE)
_TEST = re.compile(r"`((?:(?:system/)?test_\w+\.py::(?:\w+::)?)?test_[a-z0-9_]+)`")
_CODE = re.compile(r"```.*?```|`[^`]*`|<!--.*?-->", re.DOTALL)


def name(path: Path) -> str:
    return str(path.relative_to(ROOT))


def anchors(page: Path) -> set[str]:
    """The headings of a page as links call them."""
    found = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading).strip().lower().replace(" ", "-") for heading in found}


class TestReference:
    def test_page_is_what_the_command_prints(self) -> None:
        printed = CliRunner().invoke(cli.main, ["reference"])
        assert printed.exit_code == 0
        page = (ROOT / "docs" / "reference.md").read_text(encoding="utf-8")
        assert page == printed.output, "run: ./lathe reference > docs/reference.md"

    @pytest.mark.parametrize("kind", TABLES.own)
    def test_names_every_parameter_and_topic(self, kind: str) -> None:
        page = reference.page()
        missing = [row for row in TABLES[kind].rows() if f"| `{row}` |" not in page]
        if kind in STAGES:
            stage = STAGES[kind](kind, TABLES[kind]())
            topics = [port.topic for port in [*stage.inputs, *stage.outputs]]
            missing += [topic for topic in [*topics, *stage.sparse_topics] if f"| `{topic}` |" not in page]
        assert missing == []

    def test_has_no_field_without_its_meaning_where_it_has_a_number(self) -> None:
        bare = re.findall(r"^\| `\w+` \| `(?:float|u?int)[^|]*` \|\s*\|$", reference.page(), re.MULTILINE)
        assert bare == []


@pytest.fixture(scope="module")
def nodes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Any]]:
    rclpy = pytest.importorskip("rclpy")
    from lathe_rc.harness import free_domain
    from lathe_rc.nodes.cell_node import CellNode
    from lathe_rc.nodes.recorder_role import RecorderRole
    from lathe_rc.nodes.report import Reporter
    from lathe_rc.nodes.spindle_role import SpindleRole
    from lathe_rc.nodes.stage_role import StageRole
    from lathe_rc.protocol.exchange import Exchange

    bag = tmp_path_factory.mktemp("docs") / "bag"
    kinds = {"spindle_encoder": SpindleRole, "tool": StageRole, "recorder": RecorderRole}
    with free_domain() as domain:
        rclpy.init(args=["docs", "--ros-args", "-p", f"recorder:bag:={bag}"], domain_id=domain)
        made = {}
        try:
            for kind, role in kinds.items():
                made[kind] = CellNode(kind, kind, role, Reporter(), Exchange())
                made[kind].trigger_configure()
                made[kind].trigger_activate()
                assert made[kind].protocol.failure is None
            yield made
        finally:
            for node in made.values():
                node.finish()
                node.destroy_node()
            rclpy.try_shutdown()


class TestHostTopics:
    """The reference's table of host topics against the nodes themselves."""

    @pytest.mark.parametrize("topic", HOST_TOPICS, ids=lambda topic: topic.name)
    def test_are_published_and_read_as_the_table_says(self, nodes: dict[str, Any], topic: HostTopic) -> None:
        full = f"/{topic.name.removeprefix('/')}"
        for kind, node in nodes.items():
            outlets = [outlet for outlet in node.publishers if outlet.topic_name == full]
            read = {inlet.topic_name for inlet in node.subscriptions}
            roles = {MEMBER, kind, *([MASTER] if kind in MASTERS else [])}
            assert bool(outlets) == (topic.publisher in roles), f"{kind} publishes {full}"
            assert (full in read) == (topic.subscriber in roles), f"{kind} reads {full}"
            for outlet in outlets:
                package, qos = outlet.msg_type.__module__.partition(".")[0], outlet.qos_profile
                assert f"{package}/msg/{outlet.msg_type.__name__}" == topic.type
                assert (qos.depth, qos.reliability.name) == (topic.depth, "RELIABLE")
                assert qos.durability.name == topic.durability.replace(" ", "_").upper()


@functools.cache
def names_of_tests() -> set[str]:
    """All tests as pytest calls them, below tests/."""
    found, root = set(), Path(__file__).parents[1]
    for path in root.rglob("test_*.py"):
        file = path.relative_to(root).as_posix()
        for outer in ast.parse(path.read_text(encoding="utf-8")).body:
            owner, body = (f"{outer.name}::", outer.body) if isinstance(outer, ast.ClassDef) else ("", [outer])
            names = [node.name for node in body if isinstance(node, ast.FunctionDef)]
            found |= {f"{file}::{owner}{name}" for name in names if name.startswith("test_")}
    return found


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_every_test_that_a_page_names_exists(page: Path) -> None:
    lines = enumerate(page.read_text(encoding="utf-8").splitlines(), 1)
    named = {(number, test) for number, line in lines for test in _TEST.findall(line)}
    known = names_of_tests() | {test.rpartition("::")[2] for test in names_of_tests()}
    assert [f"{name(page)}:{number}: no test {test}" for number, test in sorted(named) if test not in known] == []


def exists(name: str) -> bool:
    """Whether a node, NODE.PARAM, Message.field or dotted name of a package exists."""
    first, _, rest = name.partition(".")
    if first in TABLES:
        return not rest or rest in TABLES[first].rows()
    if first in OURS:
        try:
            pkgutil.resolve_name(name)
        except (ImportError, AttributeError):
            return False
        return True
    fields = store().fielddefs.get(f"{PACKAGE}/msg/{first}", (None, []))[1]
    return rest in {field for field, _ in fields}


def test_every_name_in_the_table_of_terms_exists() -> None:
    page = (ROOT / "docs" / "terms.md").read_text(encoding="utf-8")
    rows = [row.split("|")[1:-1] for row in page.splitlines() if row.startswith("| ")]
    assert {len(row) for row in rows} == {4}, "a | in a cell has to be written \\lvert"
    names = [found for row in rows[1:] for found in re.findall(r"`([^`]+)`", row[-1])]
    assert len(names) > 80
    assert [found for found in names if not exists(found)] == []


def test_paces_of_cells_of_nodes_stand_on_one_page() -> None:
    """Two pages had different paces of the same cell; only that of the benchmarks is made from a stored result."""
    paces = re.compile(r"--group.*\| [\d.]+ to [\d.]+, median|block 64, processes \|")
    assert [page.name for page in (ROOT / "docs").glob("*.md") if paces.search(page.read_text("utf-8"))] == [
        "performance.md"
    ]


def test_one_version_stands_everywhere() -> None:
    said = {
        re.search(pattern, (ROOT / path).read_text(encoding="utf-8"))[1]
        for path, pattern in (
            ("package.xml", "<version>(.+?)<"),
            ("msg_defs/package.xml", "<version>(.+?)<"),
            ("CITATION.cff", r"(?m)^version: (.+)$"),
        )
    }
    assert said == {__version__}


@pytest.mark.parametrize("page", PAGES, ids=name)
class TestPages:
    def test_links_point_to_what_exists(self, page: Path) -> None:
        broken = []
        for target, anchor in _LINK.findall(_CODE.sub("", page.read_text(encoding="utf-8"))):
            if "://" in target:
                continue
            path = (page.parent / target).resolve() if target else page
            if not path.exists() or (anchor and anchor not in anchors(path)):
                broken.append(f"{target}#{anchor}")
        assert broken == []

    def test_commands_have_options_that_exist(self, page: Path) -> None:
        for line in _RUN.findall(page.read_text(encoding="utf-8")):
            words = [word for word in line.split("|")[0].split("#")[0].split() if word.startswith("--")]
            known = {option for parameter in run.params for option in parameter.opts}
            assert set(words) <= known, line


@pytest.mark.parametrize("page", WITH_PYTHON, ids=name)
def test_python_of_a_page_runs(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The Python of a page runs, all its examples one after the other, and prints what the page shows."""
    monkeypatch.chdir(tmp_path)
    pages.run_python(page, tmp_path)
