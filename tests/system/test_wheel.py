# SPDX-License-Identifier: Apache-2.0
"""sdist and wheel hold the package and its data, and work in an environment that has nothing else."""

import os
import shutil
import subprocess
import tarfile
import zipfile
from pathlib import Path

import pytest
from uv import uv

import workplace
from lathe_rc import __version__
from lathe_rc.catalogue import OURS
from lathe_rc.cell.beside import BESIDE
from lathe_rc.cell.scenario import TABLES

pytestmark = pytest.mark.system

LOCK = workplace.REQUIREMENTS / "python.lock"
EXECUTABLES = {*TABLES.own, *BESIDE, "container", "launch_plan"}  # of `ros2 run`
NOT_COPIED = shutil.ignore_patterns(".git", ".lathe", ".*_cache", ".hypothesis", "bags")


@pytest.fixture(scope="module")
def dist(tmp_path_factory) -> Path:
    """Both sdists, and the wheel that was built from the first, of a copy of this checkout with all its caches."""
    folder = tmp_path_factory.mktemp("dist")
    source = folder / "source"
    shutil.copytree(workplace.ROOT, source, symlinks=True, ignore=NOT_COPIED)
    uv("build", "--quiet", source, "--out-dir", folder)
    uv("build", "--quiet", "--sdist", source / "msg_defs", "--out-dir", folder)
    return folder


def files(folder: str) -> set[str]:
    """Return the files of a folder of the checkout, without caches."""
    found = (workplace.ROOT / folder).rglob("*")
    here = {str(path.relative_to(workplace.ROOT)) for path in found if path.is_file()}
    return {name for name in here if "__pycache__" not in name}


MESSAGES = {name for name in files("msg_defs") if name.endswith((".msg", ".srv")) and name.count("/") == 2}


def test_wheel_holds_the_package_its_data_and_nothing_else(dist):
    (wheel,) = dist.glob("lathe_rc-*.whl")
    names = set(zipfile.ZipFile(wheel).namelist())
    prefix = f"lathe_rc-{__version__}.data/data"
    data = f"{prefix}/share"
    shared = {"package.xml", *files("config"), *files("launch"), *files("urdf")}
    expected = {name for name in files("lathe_rc") if not name.startswith("lathe_rc/msg_defs/")} | {
        name for package in OURS - {"lathe_rc"} for name in files(package)
    }
    expected |= {f"lathe_rc/{name}" for name in MESSAGES}
    expected |= {f"{data}/lathe_rc/{name}" for name in shared}
    expected |= {f"{data}/ament_index/resource_index/packages/lathe_rc"}
    # Not on the PATH, where pip puts scripts, but where `ros2 run` looks.
    expected |= {f"{prefix}/lib/lathe_rc/{name}" for name in EXECUTABLES}
    assert {name for name in names if f"lathe_rc-{__version__}.dist-info/" not in name} == expected


def test_sdists_hold_what_is_built_and_no_tests_and_caches(dist):
    for name, needed in (
        ("lathe_rc", {"setup.py", "pyproject.toml", "package.xml", "LICENSE", "CITATION.cff", *files("config")}),
        ("lathe_rc_msgs", {name.removeprefix("msg_defs/") for name in files("msg_defs")}),
    ):
        (path,) = dist.glob(f"{name}-*.tar.gz")
        with tarfile.open(path) as archive:
            names = {member.name.partition("/")[2] for member in archive if member.isfile()}
        assert needed <= names
        assert [
            name for name in names if name.startswith(("tests/", ".")) or "cache/" in name or name.endswith(".pyc")
        ] == []


def install(dist: Path, place: Path, wanted: str) -> None:
    python = place / "bin" / "python"
    uv("pip", "install", "--quiet", "--python", python, "--find-links", dist, "--constraint", LOCK, wanted)


class Installed:
    """An environment with lathe_rc, called as a user calls it, from a folder of the user's own."""

    def __init__(self, place: Path) -> None:
        self.programs = place / "bin"
        self.folder = place / "work"
        self.folder.mkdir()

    def run(self, program: str, *words: str, code: int = 0) -> str:
        """Return what a program of the environment prints, on both streams."""
        environ = {"PATH": os.defpath, "HOME": str(self.folder)}
        done = subprocess.run(
            [self.programs / program, *words],
            cwd=self.folder,
            env=environ,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            check=False,
        )
        assert done.returncode == code, done.stdout
        return done.stdout


@pytest.fixture(scope="module")
def alone(dist) -> Installed:
    """Without ROS and without any extra."""
    uv("venv", "--quiet", "--python", workplace.BASE_PYTHON, dist / "alone")
    install(dist, dist / "alone", "lathe_rc")
    return Installed(dist / "alone")


def test_it_runs_without_ros(alone):
    assert alone.run("lathe", "--version") == f"lathe, version {__version__}\n"
    assert "5 revolutions" in alone.run("lathe", "run", "piston", "--revolutions", "5", "--bag", "B")
    assert alone.run("lathe", "bag", "check", "B").startswith("clean: ")
    alone.run("lathe", "report", "B", "-o", "report.html")
    assert (alone.folder / "report.html").stat().st_size > 100_000
    assert "Usage: " in alone.run("lathe", "study", "--help")
    assert not (alone.programs / "tool").exists()
    assert alone.run("../lib/lathe_rc/tool", code=1).startswith("lathe: no module ")
    alone.run("lathe", "new", "law", "mine")
    notebook = """
from pathlib import Path
from lathe_rc import harness
from lathe_rc.bag import reader
print(reader.read_bag(Path("B")).plot())
"""
    assert "Figure" in alone.run("python", "-c", notebook)


@pytest.mark.parametrize(
    ("words", "extra"),
    [
        (("run", "piston", "--mode", "processes"), "ros"),
        (("node", "tool"), "ros"),
        (("sweep", "piston", "--vary", "tool.tolerance=1e-6:2e-6:2", "--out", "S"), "sweep"),
        (("view", "B"), "view"),
    ],
)
def test_a_command_without_its_extra_says_what_to_install(alone, words, extra):
    said = alone.run("lathe", *words, code=1)
    assert said.count("\n") == 1
    assert f"pip install 'lathe_rc[{extra}]'" in said


@pytest.mark.timeout(900)  # most of a minute, of which a machine that does other things makes several
def test_with_ros_the_messages_are_built_by_the_installation(dist, alone):
    """The command that the refusals name adds ROS 2 and the messages; then the same cell runs as processes."""
    install(dist, dist / "alone", "lathe_rc[ros]")
    words = ("run", "piston", "--mode", "processes", "--revolutions", "5", "--bag", "nodes")
    assert "0 lost; 5 revolutions" in alone.run("lathe", *words)
    assert alone.run("lathe", "bag", "check", "nodes").startswith("clean: ")
