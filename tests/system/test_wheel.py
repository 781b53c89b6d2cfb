# SPDX-License-Identifier: Apache-2.0
"""The files of a release hold the package and its data, and work in an environment that has nothing else."""

import os
import shutil
import subprocess
import sys
import tarfile
import zipfile
from collections.abc import Iterator
from pathlib import Path
from urllib.request import urlopen

import numpy as np
import pytest
from bags import some
from lacking import write_site

import workplace
from lathe_rc import __version__
from lathe_rc.catalogue import OURS
from lathe_rc.cell.beside import BESIDE
from lathe_rc.cell.scenario import TABLES
from uv import uv

pytestmark = [pytest.mark.system, pytest.mark.timeout(1800)]  # most of it installs and compiles

LOCK = workplace.REQUIREMENTS / "python.lock"
EXECUTABLES = {*TABLES.own, *BESIDE, "container", "launch_plan"}  # of `ros2 run`
NOT_COPIED = shutil.ignore_patterns(".git", ".lathe", ".*_cache", ".hypothesis", "bags")


@pytest.fixture(scope="module")
def dist(tmp_path_factory) -> Path:
    """The files that tools/release.py makes of this checkout and checks, with ROS as well."""
    folder = tmp_path_factory.mktemp("dist")
    source = folder / "source"
    shutil.copytree(workplace.ROOT, source, symlinks=True, ignore=NOT_COPIED)
    commit = ("-c", "user.name=me", "-c", "user.email=me@localhost", "commit", "--quiet", "--message=All")
    for words in (("init", "--quiet"), ("add", "--all"), commit):
        subprocess.run(["git", "-C", source, *words], check=True)
    subprocess.run([sys.executable, source / "tools" / "release.py", folder / "files"], check=True)
    return folder / "files"


def test_a_release_has_packages_sources_notes_and_a_citation(dist):
    release = f"lathe_rc-{__version__}"
    packages = {f"{release}-py3-none-any.whl", f"{release}.tar.gz", f"lathe_rc_msgs-{__version__}.tar.gz"}
    assert {path.name for path in dist.iterdir()} == packages | {f"{release}-source.tar.gz", "NOTES.md", "CITATION.cff"}
    with tarfile.open(dist / f"{release}-source.tar.gz") as archive:
        assert {"lathe_rc/lathe", "lathe_rc/tests/conftest.py", "lathe_rc/.ci/run"} <= set(archive.getnames())
    notes, changelog = (
        path.read_text(encoding="utf-8") for path in (dist / "NOTES.md", workplace.ROOT / "CHANGELOG.md")
    )
    assert changelog[changelog.index("## ") :].startswith(f"#{notes}\n## "), "the top section alone"
    assert "\ndoi: 10.0000/placeholder\n" in (dist / "CITATION.cff").read_text(encoding="utf-8")


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
        with tarfile.open(dist / f"{name}-{__version__}.tar.gz") as archive:
            names = {member.name.partition("/")[2] for member in archive if member.isfile()}
        assert needed <= names
        assert [
            name for name in names if name.startswith(("tests/", ".")) or "cache/" in name or name.endswith(".pyc")
        ] == []


def install(dist: Path, place: Path, wanted: str, base: Path = workplace.BASE_PYTHON) -> None:
    """Install lathe_rc into a new environment, from wheels alone."""
    python = place / "bin" / "python"
    uv("venv", "--quiet", "--python", base, place)
    words = ("--only-binary", ":all:", "--find-links", dist, "--constraint", LOCK, wanted)
    uv("pip", "install", "--quiet", "--python", python, *words)


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
    place = dist.with_name("alone")
    install(dist, place, "lathe_rc")
    return Installed(place)


def test_it_needs_no_ros(alone):
    assert alone.run("lathe", "--version") == f"lathe, version {__version__}\n"
    assert "Usage: " in alone.run("lathe", "study", "--help")
    assert not (alone.programs / "tool").exists()
    assert alone.run("../lib/lathe_rc/tool", code=1).startswith("lathe: no module ")
    alone.run("lathe", "new", "law", "mine")


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


def pythons() -> Iterator[Path]:
    """Yield the Pythons of this machine that lathe_rc supports, one of each version, from the oldest to the newest."""
    folders = [*sorted(Path.home().glob(".pyenv/versions/*/bin")), *map(Path, os.get_exec_path())]
    for name in (f"python3.{minor}" for minor in range(10, 15)):
        paths = (folder / name for folder in folders if folder.name != "shims")
        yield from [path for path in paths if path.is_file()][:1]


PYTHONS = list(pythons())
#: Nothing can be written but one folder, and no program is on the PATH.
BARE = 'mount --bind "$0" "$0" && mount -o remount,bind,ro / && cd "$0/work" && export PATH=/nowhere && exec "$@"'
TEN = """\
run piston --revolutions 20 --bag B
bag check B
bag info B
measure B
export bag B --csv
report B -o B.html
sweep piston --revolutions 3 --vary learning_controller.lead_time=1.3e-3:1.5e-3:2 --out S
fit drive response.csv --averages 64 --drives 2
design piston --drive drive.yaml --revolutions 20
panel piston --no-browser"""
PLOT = "from lathe_rc.bag import reader; from pathlib import Path; reader.read_bag(Path('B')).plot()"


@pytest.mark.parametrize("base", some(PYTHONS, len(PYTHONS)), ids=lambda path: path.name)
def test_offline_use_needs_no_compiler_and_no_folder_but_the_environment(dist, base, tmp_path):
    """Ten commands and a figure, where only the environment can be written, without what Windows or macOS lack."""
    install(dist, tmp_path / "venv", f"lathe_rc[sweep,panel] @ {next(dist.glob('*.whl')).as_uri()}", base)
    place = tmp_path / "venv" / "work"
    place.mkdir()
    write_site(place)
    frequency = np.geomspace(5.0, 1000.0, 60)
    response = 1.0 / (1.0 + 1.4j * frequency / 165.0 - (frequency / 165.0) ** 2)
    columns = np.stack((frequency, response.real, response.imag, np.full(60, 0.9999)), axis=1)
    header = "frequency_hz,real,imag,coherence"
    np.savetxt(place / "response.csv", columns, "%.8g", ",", header=header, comments="")
    environ = {"PATH": os.defpath, "HOME": "/nonexistent", "PYTHONPATH": str(place)}
    for program, *words in [*(["lathe", *line.split()] for line in TEN.splitlines()), ["python", "-c", PLOT]]:
        command = ["unshare", "--mount", "sh", "-c", BARE, place.parent, place.parent / "bin" / program, *words]
        with subprocess.Popen(
            command, env=environ, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        ) as process:
            if words[0] == "panel":
                address = next(text for text in process.stdout if text.startswith("page: ")).split()[1]
                assert b"<html" in urlopen(address).read()  # noqa: S310 - http
                process.terminate()
            assert "cannot be kept" not in (printed := process.stdout.read()), printed
        assert process.returncode == 0, (words, printed)
    assert list((place.parent / "var" / "cache" / "lathe_rc").iterdir())
    assert {path.name for path in place.iterdir()} >= {"B-csv", "B.html", "S", "drive.yaml", "piston-designed.yaml"}
