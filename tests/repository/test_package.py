# SPDX-License-Identifier: Apache-2.0
"""Data of the package for ROS and pip: its dependencies, executables and tests."""

import ast
import os
import re
import runpy
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest
import setuptools
from lacking import write_site

import own_spindle
from lathe_rc import extras
from lathe_rc.catalogue import COMMANDS_OF, OURS

ROOT = Path(__file__).parents[2]
#: rosdep keys by requirement; None: rosdep has none, or one for another system alone
KEYS = {
    **{name: f"python3-{name}" for name in ("click", "jinja2", "matplotlib", "numba", "numpy", "platformdirs")},
    **{name: f"python3-{name}" for name in ("pydantic", "rich", "scipy")},
    "pyyaml": "python3-yaml",
    "rosbags": "python3-rosbags-pip",
    **dict.fromkeys(("control", "isal", "lz4", "mcap", "plotext", "pyarrow", "vl-convert-python", "zstandard")),
}
#: packages of ROS whose modules lathe_rc and its launch file may import
OF_ROS = (
    "ament",
    "builtin",
    "composition",
    "diagnostic",
    "domain",
    "launch",
    "lifecycle",
    "rcl",
    "ros",
    "sensor",
    "std",
)


@pytest.fixture(scope="module")
def declared():
    root = ET.parse(ROOT / "package.xml").getroot()  # noqa: S314 - our own
    return {depend.text for depend in root.iter("exec_depend")}


def imported():
    """The modules that the packages and the launch file import, without their submodules."""
    for path in [*ROOT.glob("lathe_*/**/*.py"), *(ROOT / "launch").glob("*.py")]:
        if "msg_defs" in path.parts:
            continue  # the package of the messages, which has a package.xml of its own
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [each.name for each in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and node.module:
                names = [node.module]
            yield from (name.partition(".")[0] for name in names)


def test_ros_packages_that_are_imported_are_declared(declared):
    modules = {name for name in imported() if name.startswith(OF_ROS) and name not in sys.stdlib_module_names}
    assert {"rclpy", "rcl_interfaces", "builtin_interfaces", "ament_index_python", "launch_ros"} <= modules
    assert modules - {"rosbags"} <= declared


def test_requirements_with_a_rosdep_key_are_declared(declared):
    lines = (ROOT / "requirements" / "runtime.in").read_text(encoding="utf-8").splitlines()
    names = {line.partition(">")[0].partition("=")[0].strip() for line in lines if line and not line.startswith("#")}
    assert names == KEYS.keys()
    assert {key for key in KEYS.values() if key} <= declared


@pytest.fixture
def metadata(monkeypatch):
    """The arguments of setup() for a command of setup.py."""

    def given(command):
        found = {}
        monkeypatch.setattr(setuptools, "setup", lambda **words: found.update(words))
        monkeypatch.setattr(sys, "argv", ["setup.py", command])
        monkeypatch.chdir(ROOT)
        runpy.run_path("setup.py")
        return found

    return given


def test_pip_puts_the_command_lathe_alone_on_the_path(metadata):
    """In a wheel the executables of ``ros2 run`` are files in lib/lathe_rc, where colcon puts its scripts."""
    assert metadata("bdist_wheel")["entry_points"]["console_scripts"] == ["lathe = lathe_rc.cli:main"]
    names = {text.partition(" = ")[0] for text in metadata("install")["entry_points"]["console_scripts"]}
    assert {"lathe", "tool", "profile", "container", "launch_plan"} <= names


def test_colcon_finds_the_tests(metadata):
    """Without pytest among the requirements of the tests, ``colcon test`` runs none and is green."""
    assert "pytest" in metadata("install")["extras_require"]["test"]


def test_an_extra_that_python_3_10_lacks_is_not_recommended_there(monkeypatch):
    assert "pip install" in str(extras.refusal("rerun"))
    monkeypatch.setattr(sys, "version_info", (3, 10, 13))
    assert str(extras.refusal("rerun.blueprint")) == "no module rerun.blueprint for Python 3.10; allowed: 3.11 to 3.14"


ALONE = """
import sys
sys.modules.update(dict.fromkeys({beside}))
from lathe_rc.cli import main
for line in ["--help", "run {cell} --bag=B", "bag check B", "report B -o B.html"]:
    assert not main(line.split(), standalone_mode=False)
"""
OWN_CELL = 'spindle: {ros__parameters: {stage: "own_spindle:Spindle", revolutions: 3.0}}'


@pytest.mark.parametrize("cell", ["piston", "own.yaml"])
def test_the_core_runs_without_the_packages_around_it(cell, tmp_path):
    """Without the machine as well, if the stages are a user's own."""
    (tmp_path / "own.yaml").write_text(OWN_CELL)
    shutil.copy(own_spindle.__file__, tmp_path)
    needed = {"lathe_rc", "lathe_machine"} if cell == "piston" else {"lathe_rc"}
    code = ALONE.format(beside=sorted(OURS - needed), cell=cell)
    environ = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, (str(tmp_path), os.environ.get("PYTHONPATH"))))}
    command = [sys.executable, "-c", code]
    ran = subprocess.run(command, cwd=tmp_path, env=environ, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    listed = {*re.findall(r"^  (\w+) ", ran.stdout.partition("Commands:")[2], re.MULTILINE)}
    assert listed >= {*COMMANDS_OF["lathe_rc"]}
    assert not listed & {name for package, names in COMMANDS_OF.items() if package != "lathe_rc" for name in names}
    assert (tmp_path / "B.html").exists()


ELSEWHERE = """
import os
from importlib import import_module
from lathe_rc import catalogue, files
from lathe_rc.cli import main
for name in catalogue.COMMANDS:
    import_module(catalogue.module_of(name))
assert not hasattr(files.os, "O_NONBLOCK"), "nothing is hidden"
for line in ["run piston --revolutions=3 --bag=B", "bag check B", "measure B", "export bag B --csv", "resim B"]:
    main(line.split(), standalone_mode=False)
"""


def test_offline_commands_use_nothing_that_windows_or_macos_lack(tmp_path):
    """All commands can be imported; runs, bags and tables need no module and no name that Linux alone has."""
    write_site(tmp_path)
    command = [sys.executable, "-c", ELSEWHERE]
    environ = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, (str(tmp_path), os.environ.get("PYTHONPATH"))))}
    ran = subprocess.run(command, cwd=tmp_path, env=environ, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    assert (tmp_path / "B-csv" / "tool.csv").exists()
