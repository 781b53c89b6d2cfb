# SPDX-License-Identifier: Apache-2.0
"""Data runs no code and reaches no files elsewhere: bags, scenarios in bags, announcements, each with a trap in it.

The trap is a module that leaves a mark when it is imported. It lies in the current folder and in the bag's.
"""

import base64
import itertools
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from bags import lathe
from cells import scenario
from sealed_bags import retold

from lathe_rc import allowed_code, extensions, harness
from lathe_rc.bag import provenance
from lathe_rc.bag.reading.source import BagSource
from lathe_rc.cell import scenario as scenarios
from lathe_rc.cell.kinds import STAGES
from lathe_rc.cell.scenario import TABLES
from lathe_rc.errors import InputError
from lathe_rc.nodes import graph
from lathe_rc.nodes.ports import message_class
from lathe_rc.protocol import Announcement

NUMBERS = itertools.count()
FORM = "angle_deg,radius_um\n0,0\n120,30\n240,-10\n"


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A bag of an ordinary run whose form is a file, which is gone since."""
    folder = tmp_path_factory.mktemp("recorded")
    (folder / "form.csv").write_text(FORM)
    form = {"profile": "csv", "profile_file": str(folder / "form.csv")}
    harness.run(scenario(spindle_encoder={"revolutions": 2.0}, tool=form), bag=folder / "bag")
    (folder / "form.csv").unlink()
    return folder / "bag"


class Received:
    """A folder that somebody has sent, in which the user stands.

    Attributes:
        bag: in it.
        module: name of the trap.
        mark: of the trap.
        secret: a file of the user's own.
    """

    def __init__(self, folder, bag):
        self.bag, self.module, self.mark = Path("bag"), f"trap_{next(NUMBERS)}", folder / "mark"
        self.secret = folder / "secret.csv"
        self.secret.write_text("1,2\nmine\n")
        here = folder / "received"
        here.mkdir()
        os.chdir(here)
        shutil.copytree(bag, self.bag)
        text = f"from pathlib import Path\nPath({str(self.mark)!r}).touch()\n"
        text += "from lathe_machine.stages.tool.tool import Tool\n"
        for place in (here, self.bag):
            (place / f"{self.module}.py").write_text(text)

    def change(self, node="", about=None, **values):
        """Let the bag give other values to a node, and hold other texts or lack some (None), sealed by its maker."""

        def change(texts):
            tree = yaml.safe_load(texts[provenance.SCENARIO])
            if node:
                tree.setdefault(f"/**/{node}", {"ros__parameters": {}})["ros__parameters"].update(values)
            texts[provenance.SCENARIO] = yaml.safe_dump(tree)
            texts.update(about or {})
            for key in [key for key, text in texts.items() if text is None]:
                del texts[key]

        retold(self.bag, change)

    def scenario(self, place, node, **values):
        """Write the bag's scenario to a file, with other values."""
        with BagSource(self.bag) as source:
            tree = yaml.safe_load(source.about[provenance.SCENARIO])
        del tree["/**/tool"]["ros__parameters"]["profile_file"]
        tree["/**/tool"]["ros__parameters"]["profile"] = "harmonics"
        tree.setdefault(f"/**/{node}", {"ros__parameters": {}})["ros__parameters"].update(values)
        place.write_text(yaml.safe_dump(tree))
        return place


@pytest.fixture
def received(tmp_path, monkeypatch, recorded):
    monkeypatch.chdir(tmp_path)
    return Received(tmp_path, recorded)


def refused(found, *says):
    """The one line with which a command refused its input."""
    assert found.exit_code == 2, found.output
    assert found.stderr.count("\n") == 1
    for each in says:
        assert each in found.stderr
    return found.stderr


# ---- code that a bag names


NAMED = [
    ("tool", "stage", "bag.{}:Tool"),  # a module of the bag's folder, beside which the user stands
    ("tool", "stage", "{}:Tool"),
    ("tool", "profile", "{}:Tool"),
    ("learning_controller", "q_filter", "{}:Tool"),
    ("spindle_encoder", "deviation_law", "{}:Tool"),
    ("supervisor", "monitors", "{}:Tool"),
    ("tool", "stage", "unittest.__main__:Tool"),
    ("tool", "profile", "venv.__main__:x"),
]
READERS = [
    *(["resim"], ["resim", "--set", "tool.nose_radius=0.0"], ["measure"], ["export", "--csv", "-o", "out"]),
    *(["bag", "info"], ["bag", "check"], ["bag", "recover"], ["bag", "tachogram"]),
    pytest.param(["report", "--budget"], marks=pytest.mark.system),
]


@pytest.mark.parametrize(("node", "parameter", "name"), NAMED)
def test_no_code_that_a_bag_names_is_imported(received, node, parameter, name):
    name = name.format(received.module)
    received.change(node, **{parameter: [name] if parameter == "monitors" else name})
    refused(lathe("resim", received.bag), "code that no installed package offers", "--allow-code")
    assert not received.mark.exists()
    assert {"unittest.__main__", "venv.__main__"}.isdisjoint(sys.modules)
    checked, told = lathe("bag", "check", received.bag), f"{node}.{parameter} names code, {name}\n"
    assert (checked.exit_code, told in checked.stdout) == (0, True)


@pytest.mark.parametrize("words", READERS, ids=" ".join)
def test_no_command_that_reads_a_bag_imports_code(received, words):
    received.change("tool", stage=f"bag.{received.module}:Tool")
    found = lathe(*words, received.bag)
    assert found.exit_code == (2 if {"resim", "--budget"} & {*words} else 0), found.output
    assert not received.mark.exists()
    if words == ["bag", "info"]:
        assert f"tool.stage names code, bag.{received.module}:Tool" in found.stdout


@pytest.mark.parametrize(
    "key", ["lathe_rc.origins", "lathe_rc.file.tool.stage={0}:Tool #.x", "lathe_rc.file.tool.stage"]
)
def test_other_metadata_of_a_bag_names_no_code(received, key):
    """Neither where classes came from, nor the key of a copy, which once was read as --set."""
    code = f"{received.module}:Tool"
    origins = json.dumps({code: {"source": "0", "used": ["tool.stage"]}})
    received.change(about={key.format(received.module): origins if "origins" in key else ""})
    lathe("resim", received.bag)
    assert not received.mark.exists()


def test_a_bag_whose_scenario_is_none_is_still_read(received):
    received.change(about={provenance.SCENARIO: "- no nodes"})
    for word in ("info", "check"):
        found = lathe("bag", word, received.bag)
        assert (found.exit_code, "no nodes; allowed" in found.stdout) == (0, True), found.output


def test_code_that_is_allowed_for_this_call_runs_from_the_current_folder(received):
    """The user's word lets it in, once."""
    received.change("tool", stage=f"{received.module}:Tool")
    found = lathe("resim", received.bag, "--allow-code", received.module)
    assert (found.exit_code, received.mark.exists()) == (0, True), found.output
    refused(lathe("resim", received.bag), "--allow-code")


def test_a_folder_that_is_no_package_hides_none_of_the_current_folder(received, monkeypatch, tmp_path_factory):
    """As in a checkout, on Python's path, in which `lathe new law my_law` has made my_law/my_law."""
    around = tmp_path_factory.mktemp("around")
    (around / received.module).mkdir()
    monkeypatch.syspath_prepend(around)
    received.change("tool", stage=f"{received.module}:Tool")
    found = lathe("resim", received.bag, "--allow-code", received.module)
    assert (found.exit_code, received.mark.exists()) == (0, True), found.output


@pytest.mark.parametrize("package", ["a.b", "", "a:b"])
def test_a_package_that_is_no_name_is_refused(package):
    refused(lathe("resim", "bag", "--allow-code", package), "the name of a package")


def test_message_types_of_a_bag_or_topic_import_nothing(received):
    for package in (received.module, "antigravity", "unittest", ""):
        with pytest.raises(ImportError, match="no package of interfaces"):
            message_class(f"{package}/msg/Tool")
    assert not received.mark.exists()
    assert "antigravity" not in sys.modules
    assert message_class("std_msgs/msg/String").__name__ == "String"


# ---- scenarios


TAKERS = [
    *(["run"], ["budget"], ["policy"]),
    pytest.param(["sweep", "run", "--vary", "seed=1,2"], marks=pytest.mark.system),
    pytest.param(["tune", "--free", "tool.feed=0:1"], marks=pytest.mark.system),
]


@pytest.mark.parametrize("words", TAKERS, ids=" ".join)
def test_a_scenario_that_lies_in_a_bag_is_data(received, words):
    file = received.scenario(received.bag / "scenario.yaml", "tool", stage=f"{received.module}:Tool")
    refused(lathe(*words, file), "code that no installed package offers")
    assert not received.mark.exists()


@pytest.mark.parametrize("words", TAKERS[1:], ids=" ".join)
def test_only_run_looks_for_code_in_the_current_folder(received, words):
    file = received.scenario(Path("cell.yaml"), "tool", stage=f"{received.module}:Tool")
    refused(lathe(*words, file), f"--allow-code {received.module}")
    assert lathe("run", file).exit_code == 0
    assert received.mark.exists()


def test_a_scenario_beside_the_user_takes_the_place_of_none_of_ours(received):
    received.scenario(Path("piston.yaml"), "tool", stage=f"{received.module}:Tool")
    refused(lathe("run", "piston"), "piston: piston.yaml here, or ")
    assert not received.mark.exists()


def test_run_finds_no_code_in_a_bag_it_stands_in(received, monkeypatch):
    file = received.scenario(Path("../cell.yaml"), "tool", stage=f"{received.module}:Tool").resolve()
    monkeypatch.chdir(received.bag)
    refused(lathe("run", file), "cannot be imported")
    assert not received.mark.exists()


def test_a_controller_from_a_bag_is_data(received):
    file = received.scenario(received.bag / "mine.yaml", "learning_controller", q_filter=f"{received.module}:Tool")
    refused(lathe("resim", received.bag, "--controller", file), "code that no installed package offers")
    refused(lathe("resim", received.bag, "--scenario", file), "code that no installed package offers")
    assert not received.mark.exists()


def test_a_node_imports_what_the_user_allows(received):
    """Not even code that its command line names; and the parameter file of a bag is data."""
    refused(lathe("node", f"tool:{received.module}:Tool"), f"--allow-code {received.module}")
    file = received.scenario(received.bag / "cell.yaml", "tool", profile=f"{received.module}:Tool")
    refused(lathe("node", "tool", "--ros-args", "--params-file", file), "code that no installed package offers")
    assert not received.mark.exists()


def test_metadata_in_the_current_folder_is_no_installed_package(received):
    info = Path("trap-1.0.dist-info")
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: trap\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[lathe_rc.stages]\ntrap_stage = {received.module}:Tool\n")
    extensions._offered_along.cache_clear()
    with allowed_code.call():
        allowed_code.allow("another")
        assert "trap_stage" not in STAGES
        assert not STAGES.permits(f"{received.module}:Tool")


# ---- announcements


def announced(stage, said, **values):
    """The tables of a cell with one member, as they are announced; ``said`` gets why it is not known."""
    parameters = TABLES.get(stage if stage in TABLES.own else "tool")().model_dump() | values
    member = Announcement("", "/it", stage, parameters=json.dumps(parameters))
    return graph.announced({"/it": member}, ["/it"], "/", lambda *words: said.append(words))[0]


@pytest.mark.parametrize(
    ("stage", "parameter", "value"),
    [
        ("{0}:Tool", "profile", "harmonics"),
        ("unittest.__main__:x", "profile", "harmonics"),
        ("tool", "profile", "{0}:Tool"),
        ("learning_controller", "q_filter", "venv.__main__:x"),
        ("supervisor", "monitors", ["{0}:Tool"]),
        ("tool", "profile_file", "{1}"),
        ("learning_controller", "memory_file", "../secret.csv"),
    ],
)
def test_a_member_that_announces_code_or_files_is_known_by_its_topics_alone(received, stage, parameter, value):
    """The recorder would keep such a file in its bag, the time master read it."""
    told = json.loads(json.dumps(value).replace("{0}", received.module).replace("{1}", str(received.secret)))
    said = []
    with allowed_code.call():
        assert not announced(stage.replace("{0}", received.module), said, **{parameter: told})
    assert said
    assert not received.mark.exists()


def test_a_member_may_announce_the_files_that_the_user_names(received):
    with allowed_code.call():
        allowed_code.user_names(lambda: {str(received.secret)})
        assert announced("tool", [], profile_file=str(received.secret))["it"].profile_file == str(received.secret)


# ---- files


def test_a_bag_with_copies_of_its_files_runs_again_where_they_are_not(received):
    found = lathe("resim", received.bag)
    assert found.exit_code == 0, found.output
    assert "equal to the recording to the bit" in found.stdout


@pytest.mark.parametrize("node", ["learning_controller", "tool"])
@pytest.mark.parametrize("place", ["absolute", "relative"])
def test_no_file_that_a_bag_names_gets_into_the_new_bag(received, node, place):
    """The copy is of no file of the user's; a memory, which a run writes, begins anew."""
    named = str(received.secret) if place == "absolute" else "../" * 40 + str(received.secret).lstrip("/")
    key = {"learning_controller": "memory_file", "tool": "profile_file"}[node]
    about = {f"lathe_rc.file.{node}.{key}_": ""}
    if node == "tool":
        about = {"lathe_rc.file.tool.profile_file": None, "lathe_rc.file.tool.other": ""}
    received.change(node, **{key: named}, about=about)
    assert f"{node}.{key} names a file that the bag does not hold, " in lathe("bag", "check", received.bag).stdout
    found = lathe("resim", received.bag, "-o", "new")
    if node == "tool":
        assert "mine" not in refused(found, "does not hold; allowed: --set tool.profile_file=FILE")
        Path("own.csv").write_text(FORM)
        found = lathe("resim", received.bag, "-o", "new", "--set", "tool.profile_file=own.csv")
    assert found.exit_code == 0, found.output
    with BagSource(Path("new")) as source:
        kept = [base64.b64decode(text) for key, text in source.about.items() if key.startswith(provenance.FILE)]
    assert kept == [FORM.encode()]
    assert received.secret.read_text() == "1,2\nmine\n"


@pytest.mark.parametrize(
    ("node", "parameter", "value"),
    [
        ("tool", "profile_file", "{}"),
        ("tool", "profile_file", "../../secret.csv"),
        ("tool", "profile_file", "link.csv"),
        ("spindle_encoder", "tachogram_file", "{}"),
        ("learning_controller", "memory_file", "{}.new"),
        ("learning_controller", "restart_file", "{}.new"),
        ("recorder", "bag", "../../new"),
        ("recorder", "snapshots", "{}.new"),
    ],
)
@pytest.mark.parametrize("word", ["run", "node"])
def test_a_scenario_that_lies_in_a_bag_names_files_in_it_alone(received, word, node, parameter, value):
    """Neither to read nor to write; a link leads nowhere else."""
    (received.bag / "link.csv").symlink_to(received.secret)
    file = received.scenario(received.bag / "cell.yaml", node, **{parameter: value.format(received.secret)})
    words = ["run", file] if word == "run" else ["node", node, "--ros-args", "--params-file", file]
    refused(lathe(*words), f"{node}.{parameter} = ", "a file outside of the bag")
    assert sorted(Path("..").resolve().iterdir()) == sorted([Path.cwd(), received.secret])


@pytest.mark.parametrize("words", READERS, ids=" ".join)
def test_a_link_in_a_bag_leads_to_nothing_outside(received, words):
    storage = next(received.bag.glob("*.mcap"))
    storage.rename("elsewhere.mcap")
    storage.symlink_to(Path("elsewhere.mcap").resolve())
    refused(lathe(*words, received.bag), "a link that leads out of the bag")


# ---- processes


SHADOWS = ("json", "numpy", "click", "rich", "threading", "lathe_rc", "sitecustomize", "usercustomize", "runpy")


@pytest.mark.parametrize("start", ["command", "child"])
def test_files_of_the_current_folder_take_the_place_of_no_module(received, start):
    """The command line, and a process that it starts, with the path that it hands on."""
    for name in SHADOWS:
        shutil.copy(f"{received.module}.py", f"{name}.py")
    words = [
        sys.executable,
        Path(harness.__file__).parents[1] / "__main__.py",
        "bag",
        "info",
        "--no-metrics",
        received.bag,
    ]
    environment = dict(os.environ)
    if start == "child":
        with allowed_code.call():
            allowed_code.allow(received.module)
            words = [*allowed_code.interpreter("lathe_rc.nodes.container"), *allowed_code.arguments(), "--help"]
            environment["PYTHONPATH"] = extensions.search_path()
    done = subprocess.run(words, capture_output=True, text=True, check=False, env=environment)
    assert (done.returncode, received.mark.exists()) == (0, False), done.stderr


def test_children_are_allowed_the_same():
    with allowed_code.call():
        for package in ("second", "first"):
            allowed_code.allow(package)
        words = allowed_code.arguments()
    with allowed_code.call():
        assert allowed_code.taken_from([*words, "tool", "--allow-code=third"]) == ["tool"]
        assert [allowed_code.is_allowed(name) for name in ("first.a", "second", "third", "fourth")] == [
            True,
            True,
            True,
            False,
        ]


def test_a_python_program_looks_for_code_on_its_own_path_alone(received):
    """Code that its own scenarios name is allowed; the current folder is not searched."""
    file = received.scenario(Path("cell.yaml"), "tool", stage=f"{received.module}:Tool")
    with pytest.raises(InputError, match="cannot be imported: ModuleNotFoundError"):
        scenarios.load(file)
    assert not received.mark.exists()
