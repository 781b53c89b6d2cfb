# SPDX-License-Identifier: Apache-2.0
"""How the environment is made: the packages, the messages built against them, and lathe_rc itself.

Each of the three has a key, a hash of all that it is made from, and a stamp with that key, which is written
last and lies inside what it vouches for. So what was interrupted, or deleted, is made anew. Packages that not every
command needs are installed when one is called that does; each group of them has a stamp of its own.
"""

import hashlib
import json
import os
import re
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple, cast

import installer
from environment import Changes, build_environment, changes, complete
from ros import SourcedRos, site_packages
from ros_wheels import FAST_DDS_ALONE, PYTHON_ALONE, cmake_options, mend_cmake_paths
from steps import Step, clear, write_atomically
from workplace import BASE_PYTHON, BUILD, HOME, INSTALL, LOG, PACKAGES, PYTHON, REQUIREMENTS, ROOT, VENV, say

CONSTRAINTS = VENV / "constraints.txt"
PACKAGES_STAMP = VENV / "packages.stamp"
MESSAGES_STAMP = INSTALL / "messages.stamp"
SIMULATION = Path("third_party", "simulation_interfaces")  # in ROOT
ENVIRONMENT = INSTALL / "environment.json"  # also the stamp of the package, the last thing made

CHECK_NETWORK = "correct the fault in the lines above (often the network, or a full disk), then call again"
MESSAGES_LIST = "../msg_defs/requirements.in"  # as seen from requirements/


class Group(NamedTuple):
    """Packages that some commands need.

    Attributes:
        list: file in requirements/ that names them.
        usual: how long they take to install, and how much they take, for the terminal.
        sourced: whether they go with a ROS 2 that is sourced.
        npm: whether they bring npm, which installs what requirements/package.json lists.
    """

    list: str
    usual: str
    sourced: bool
    npm: bool = False


GROUPS = {
    "docs": Group("docs.in", "5 s, 250 MB", sourced=True, npm=True),
    "fmu": Group("fmu.in", "5 s, 20 MB", sourced=False),
    "formats": Group("formats.in", "5 s, 60 MB", sourced=True),
    "notebook": Group("notebook.in", "10 s, 300 MB", sourced=True),
    "panel": Group("panel.in", "5 s, 10 MB", sourced=True),
    "sweep": Group("sweep.in", "5 s, 70 MB", sourced=True),
    "test": Group("test.in", "5 s, 300 MB", sourced=True),
    "view": Group("view.in", "10 s, 400 MB", sourced=False),
}

LIST_PACKAGES = """
from importlib.metadata import distributions
print(*(f"{found.name}=={found.version}" for found in distributions()), sep="\\n")
"""


class Recipe:
    """The set-up of this checkout for this interpreter and this source of ROS 2.

    Args:
        ros: the ROS 2 to build against; None stands for the wheels.
    """

    def __init__(self, ros: SourcedRos | None) -> None:
        self._ros = ros
        tools = ROOT / "tools"
        self._packages_key = digest(
            [str(ROOT), str(Path(BASE_PYTHON).resolve()), str(ros)],
            [
                *(path for path in REQUIREMENTS.iterdir() if path.name != "debian.txt"),  # of the system tests
                *(ROOT / "msg_defs" / name for name in ("requirements.in", "ros_wheels.py")),
                *(tools / name for name in ("recipe.py", "ros.py")),
            ],
        )
        self._messages_key = digest([self._packages_key], [*sources(ROOT / "msg_defs"), *sources(ROOT / SIMULATION)])
        # lathe_rc is installed as links: only a new file that is not a module needs a new installation.
        linked = [path for folder in ("config", "launch", "urdf") for path in sources(ROOT / folder)]
        self._package_key = digest(
            [self._messages_key, *sorted(map(str, linked))],
            [
                *(
                    ROOT / name
                    for name in (
                        "setup.py",
                        "setup.cfg",
                        "package.xml",
                        "lathe_rc/catalogue.py",
                        "tools/environment.py",
                    )
                )
            ],
        )

    def ready(self, groups: Iterable[str] = ()) -> Changes | None:
        """Return what lathe_rc needs in its environment if all is made, groups too, and nothing has changed since."""
        if not PACKAGES_STAMP.exists() or not ENVIRONMENT.exists() or self._missing(groups):
            return None
        kept = json.loads(ENVIRONMENT.read_text(encoding="utf-8"))
        return cast("Changes", kept["changes"]) if kept["key"] == self._package_key else None

    def _missing(self, groups: Iterable[str]) -> list[str]:
        """Return those of some groups that have to be installed."""
        wanted = [name for name in groups if GROUPS[name].sourced or not self._ros]
        return [name for name in wanted if read(stamp_of(name)) != self._packages_key]

    def make(self, lock: int, groups: Iterable[str] = ()) -> Changes:
        """Make what is missing or out of date.

        Raises:
            StepError: a command failed.
        """
        say(f"setting up in {HOME}")
        if read(PACKAGES_STAMP) != self._packages_key:
            clear(INSTALL, BUILD, VENV)
            self._make_virtual_environment(lock)
            self._install_packages(lock)
            write_atomically(PACKAGES_STAMP, self._packages_key)
        for name in self._missing(groups):
            self._install_group(name, lock)
            write_atomically(stamp_of(name), self._packages_key)
        if (kept := self.ready()) is not None:
            return kept
        if read(MESSAGES_STAMP) != self._messages_key:
            clear(INSTALL, BUILD)
            self._build_messages(lock)
            write_atomically(MESSAGES_STAMP, self._messages_key)
        clear(BUILD / "lathe_rc", INSTALL / "lib" / "lathe_rc", INSTALL / "share" / "lathe_rc")
        found = self._install_lathe_rc(lock)
        write_atomically(ENVIRONMENT, json.dumps({"key": self._package_key, "changes": found}, indent=1))
        return found

    def _make_virtual_environment(self, lock: int) -> None:
        options = ["--system-site-packages"] if self._ros else []
        with Step("virtual environment", "5 s", "see the log, then call again", lock) as step:
            step.run(BASE_PYTHON, "-m", "venv", *options, VENV, environ=build_environment(self._ros))

    def _install_packages(self, lock: int) -> None:
        with Step("packages", "20 s, 1000 MB", CHECK_NETWORK, lock) as step:
            if self._ros:
                environ = build_environment(self._ros)
                found = step.run(BASE_PYTHON, "-c", LIST_PACKAGES, environ=environ).splitlines()
                locked = (REQUIREMENTS / "sourced.lock").read_text(encoding="utf-8").splitlines()
                CONSTRAINTS.write_text("\n".join(constrain(locked, found)), encoding="utf-8")
                self._install(step, "runtime.in", "build.in")
            else:
                text = (REQUIREMENTS / "python.lock").read_text(encoding="utf-8")
                CONSTRAINTS.write_text(pinned("uv", text), encoding="utf-8")
                step.run(
                    *installer.pip("-r", CONSTRAINTS), environ=installer.pip_environment(*self._pip_settings(step))
                )
                self._install(step, "ros.in", MESSAGES_LIST, "runtime.in", "build.in")
                mend_cmake_paths(VENV, site_packages())

    def _install_group(self, name: str, lock: int) -> None:
        with Step(f"packages: {name}", GROUPS[name].usual, CHECK_NETWORK, lock) as step:
            self._install(step, GROUPS[name].list)
            if GROUPS[name].npm:
                step.run(*installer.npm(), environ=build_environment(self._ros))

    def _install(self, step: Step, *lists: str) -> None:
        """Install what files in requirements/ list: beside a sourced ROS 2 with pip, which knows its packages."""
        settings, environ = self._pip_settings(step)
        if self._ros:
            files = [word for name in lists for word in ("-r", REQUIREMENTS / name)]
            environ = installer.pip_environment(settings, environ)
            step.run(*installer.pip(*files, "--constraint", CONSTRAINTS), environ=environ)
        else:
            locked = installer.uv(lists, ["ros.lock", "python.lock"])
            step.run(*locked, environ=installer.uv_environment(settings, environ))

    def _pip_settings(self, step: Step) -> tuple[dict[str, str], dict[str, str]]:
        """Return the user's settings of pip, and the environment of the set-up."""
        environ = build_environment(self._ros)
        # To "config list", too, PIP_USER and "user = true" of a file mean --user: the user's own file alone.
        listed = step.run(PYTHON, "-m", "pip", "config", "list", environ=environ | {"PIP_USER": "0"})
        return installer.pip_settings(listed), environ

    def _build_messages(self, lock: int) -> None:
        advice = "correct msg_defs/, or remove .lathe/, then call again"
        # Beside a sourced ROS 2 that has the whole package there must be no second one of its name.
        there = self._ros and any(Path(prefix, "share", SIMULATION.name).exists() for prefix in self._ros.prefixes)
        folders = [Path("msg_defs"), *([] if there else [SIMULATION])]
        with Step("messages", "90 s", advice, lock) as step:
            place = ROOT
            if HOME.parent != ROOT:  # CMake cannot handle the path of the checkout
                place = BUILD / "source"
                for folder in folders:
                    shutil.copytree(ROOT / folder, place / folder)
            step.run(
                *colcon("--paths", *(place / folder for folder in folders)),
                *("--cmake-args", *cmake_options(PYTHON), *(() if self._ros else (PYTHON_ALONE,))),
                environ=self._colcon_environment() | ({} if self._ros else FAST_DDS_ALONE),
            )

    def _install_lathe_rc(self, lock: int) -> Changes:
        advice = "correct setup.py, or remove .lathe/, then call again"
        with Step("lathe_rc", "3 s", advice, lock) as step:
            step.run(*colcon("--paths", ROOT, "--symlink-install"), environ=self._colcon_environment())
            # Some environments forbid Python to write byte code, and each start would compile a hundred modules anew.
            step.run(PYTHON, "-m", "compileall", "-q", *PACKAGES, environ=build_environment(self._ros))
            for script in (INSTALL / "setup.sh", INSTALL / "setup.bash"):
                script.write_text(complete(script.read_text(encoding="utf-8"), self._ros), encoding="utf-8")
            command = PYTHON.with_name("lathe")
            command.unlink(missing_ok=True)
            command.symlink_to(ROOT / "lathe")
            listing = BUILD / "environment"
            step.run(
                *("bash", "-c", '. "$0" && env -0 > "$1"', INSTALL / "setup.bash", listing),
                environ={"PATH": os.defpath},
            )
            return changes(dict(line.split("=", 1) for line in listing.read_text().split("\0") if line))

    def _colcon_environment(self) -> dict[str, str]:
        return {
            **build_environment(self._ros),
            "COLCON_HOME": str(HOME / "colcon"),  # the user's own defaults are for the user's own builds
            "MAKEFLAGS": "-j",  # keeps colcon from holding Ninja back whenever the machine has other work
        }


def stamp_of(group: str) -> Path:
    """Return the stamp of a group of packages."""
    return VENV / f"{group}.stamp"


def colcon(*options: str | Path) -> list[str | Path]:
    """Return a colcon command line; its output goes where ours goes, as it comes."""
    return [
        *(PYTHON, "-m", "colcon", "--log-base", LOG / "colcon"),
        *("build", "--merge-install", "--build-base", BUILD, "--install-base", INSTALL),
        *("--event-handlers", "console_direct+", "--executor", "sequential"),
        *options,
    ]


def pinned(name: str, lock: str) -> str:
    """Return the lines of a lock file on one package: its version and the hashes of its files."""
    found = re.search(rf"^{re.escape(name)}==.*(?:\n +--hash=.*)*", lock, re.MULTILINE)
    if found is None:
        raise LookupError(f"no {name} in the lock file")
    return found[0] + "\n"


def constrain(lock: Iterable[str], found: Iterable[str]) -> list[str]:
    """Return pip's constraints beside a sourced ROS 2: its NumPy stays, what is missing comes from the lock.

    Whatever else is there pip leaves alone, if it is new enough.
    """
    there = {normal(line): line for line in found}
    settled = there.keys() | {"numpy-typing-compat"}  # has one release for each of NumPy's
    missing = [line for line in lock if line and not line.startswith("#") and normal(line) not in settled]
    return [*missing, *(line for name, line in there.items() if name == "numpy")]


def normal(requirement: str) -> str:
    """Return the normal form of the name in a line such as ``ruamel.yaml==0.18``."""
    return re.sub(r"[-_.]+", "-", re.split(r"[^\w.-]", requirement, maxsplit=1)[0]).lower()


def sources(folder: Path) -> list[Path]:
    """Return the files in a folder, without what Python has compiled from them."""
    return [path for path in folder.rglob("*.*") if path.suffix != ".pyc"]


def read(stamp: Path) -> str | None:
    """Return the key in a stamp, if there is one."""
    return stamp.read_text(encoding="utf-8") if stamp.exists() else None


def digest(words: Iterable[str], paths: Iterable[Path]) -> str:
    """Return a hash of words and of files with their names."""
    result = hashlib.sha256()
    for word in words:
        result.update(word.encode() + b"\0")
    for path in sorted(path for path in paths if path.is_file()):
        content = path.read_bytes()
        result.update(f"{path.relative_to(ROOT)}\0{len(content)}\0".encode() + content)
    return result.hexdigest()
