# SPDX-License-Identifier: Apache-2.0
"""Environments that users bring: each leaves the numbers as they are, or is refused by name before anything is made."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from cells import until

import workplace

pytestmark = pytest.mark.system

RUN = ("run", "piston", "--revolutions", "1", "--json")
CLEAN = {"PATH": os.environ["PATH"], "HOME": os.environ["HOME"]}
NOT_COPIED = shutil.ignore_patterns(".git", ".lathe", ".*_cache", ".hypothesis", "bags", "__pycache__")
#: Packages come from where the tests' own came from.
SOURCES = {name: value for name, value in os.environ.items() if name.startswith(("PIP_", "UV_", "SSL_"))}


def lathe(
    *words: str, root: Path = workplace.ROOT, prefix: tuple[str, ...] = (), **environ: str
) -> subprocess.CompletedProcess[str]:
    """Run ./lathe in nothing but the given environment."""
    return subprocess.run(
        [*prefix, root / "lathe", *words], env=environ, cwd="/", capture_output=True, text=True, check=False
    )


def errors(done: subprocess.CompletedProcess[str]) -> object:
    """Return the errors that a run has printed."""
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)["error_um"]


@pytest.fixture(scope="module")
def wanted() -> object:
    """The errors of a run in a clean environment."""
    return errors(lathe(*RUN, **CLEAN))


@pytest.fixture(scope="module")
def brought(tmp_path_factory) -> Path:
    """Folder with modules and libraries of others."""
    folder = tmp_path_factory.mktemp("brought")
    version = f"python{sys.version_info[0]}.{sys.version_info[1]}"
    for place in ("yaml", "json", "mine", f"base/lib/{version}/site-packages", "lib", "read-only"):
        (folder / place).mkdir(parents=True)
    fault = "raise RuntimeError(__file__)"
    for module in ("yaml/yaml.py", "json/json.py", f"base/lib/{version}/site-packages/yaml.py", "startup.py"):
        (folder / module).write_text(fault)
    (folder / "mine" / "mine.py").touch()
    (folder / "lib" / "libstdc++.so.6").touch()
    (folder / "read-only").chmod(0o500)
    return folder


#: Changes of the environment, and the words of a refusal; none: the run has the numbers of a clean environment.
SPOILED = {
    "PIP_USER": ({"PIP_USER": "1"}, ()),
    "PIP_TARGET": ({"PIP_TARGET": "{}/elsewhere"}, ()),
    "PIP_REQUIRE_VIRTUALENV": ({"PIP_REQUIRE_VIRTUALENV": "1"}, ()),
    "PYTHONPATH": ({"PYTHONPATH": "{}/mine"}, ()),
    "PYTHONPATH that hides a package": ({"PYTHONPATH": "{}/yaml"}, ("{}/yaml/yaml.py hides the yaml", "PYTHONPATH")),
    "PYTHONPATH that hides Python": ({"PYTHONPATH": "{}/json"}, ("{}/json/json.py hides the json", "PYTHONPATH")),
    "PYTHONHOME": ({"PYTHONHOME": "{}"}, ()),
    "PYTHONPLATLIBDIR": ({"PYTHONPLATLIBDIR": "other"}, ()),
    "PYTHONSTARTUP": ({"PYTHONSTARTUP": "{}/startup.py"}, ()),
    "PYTHONUSERBASE": ({"PYTHONUSERBASE": "{}/base"}, ()),
    "PYTHONSAFEPATH": ({"PYTHONSAFEPATH": "1"}, ()),
    "LD_LIBRARY_PATH": ({"LD_LIBRARY_PATH": "{}/mine"}, ()),
    "LD_LIBRARY_PATH with a broken library": (
        {"LD_LIBRARY_PATH": "{}/lib"},
        ("{}/lib/libstdc++.so.6 file too short", "LD_LIBRARY_PATH"),
    ),
    "LD_PRELOAD": ({"LD_PRELOAD": "{}/none.so"}, ()),
    "virtual environment": ({"VIRTUAL_ENV": "{}/venv", "PATH": "{}/venv/bin:" + os.environ["PATH"]}, ()),
    "conda": ({"CONDA_PREFIX": "{}/conda", "CONDA_DEFAULT_ENV": "base", "CONDA_SHLVL": "1"}, ()),
    "C locale": ({"LC_ALL": "C", "LANG": "C"}, ()),
    "unknown locale": ({"LC_ALL": "xx_YY.UTF-8"}, ()),
    "ASCII output": ({"PYTHONIOENCODING": "ascii"}, ()),
    "no folder for temporary files": ({"TMPDIR": "{}/none"}, ()),
    "home that is a file": ({"HOME": "{}/startup.py", "XDG_CACHE_HOME": str(Path.home() / ".cache")}, ()),
    "stale ROS": ({"AMENT_PREFIX_PATH": "{}/ros", "COLCON_PREFIX_PATH": "{}/ros"}, ()),
    "short PATH": ({"PATH": "/usr/bin:/bin"}, ()),
}


def harmless() -> list[dict[str, str]]:
    """Changes that leave the numbers: all at once that set different variables, or each with LATHE_CAMPAIGN=whole."""
    found: list[dict[str, str]] = []
    for changes, refusal in SPOILED.values():
        others = [] if os.environ.get("LATHE_CAMPAIGN") == "whole" else found
        free = next((each for each in others if not each.keys() & changes.keys()), None)
        if free is not None and not refusal:
            free |= changes
        elif not refusal:
            found.append(dict(changes))
    return found


@pytest.mark.parametrize("changes", harmless(), ids=" ".join)
def test_an_environment_leaves_the_numbers(changes, brought, wanted):
    assert errors(lathe(*RUN, **CLEAN | {name: value.format(brought) for name, value in changes.items()})) == wanted


@pytest.mark.parametrize("case", [case for case, (_, refusal) in SPOILED.items() if refusal])
def test_an_environment_that_hides_or_breaks_a_package_is_refused_by_name(case, brought):
    changes, refusal = SPOILED[case]
    done = lathe(*RUN, **CLEAN | {name: value.format(brought) for name, value in changes.items()})
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert [word for word in refusal if word.format(brought) not in done.stderr] == []


def test_a_run_needs_no_home_and_no_right_to_write_in_the_checkout(wanted, tmp_path):
    """HOME is unset, umask is 077, and the file system of the checkout is read-only."""
    read_only = (
        'umask 077; mount --bind "$0" "$0" && mount -o remount,bind,ro "$0" "$0" && cd /tmp && exec "$0/lathe" "$@"'
    )
    command = ["unshare", "--mount", "sh", "-c", read_only, workplace.ROOT, *RUN]
    bare = {"PATH": os.environ["PATH"]}
    done = subprocess.run(command, env=bare, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert errors(done) == wanted


@pytest.mark.timeout(1200)
def test_a_set_up_withstands_all_of_it_at_once_and_its_own_death(tmp_path, brought):
    """An archive without git is set up where no letter is plain; after a kill and a move it is made anew."""
    root = tmp_path / "Müller's 日本 (a) [1]"
    shutil.copytree(workplace.ROOT, root, symlinks=True, ignore=NOT_COPIED)
    (root / ".git").write_text("gitdir: /nowhere\n")  # as in a copied worktree
    (tmp_path / "pip.conf").write_text("[global]\nuser = true\n[install]\ntarget = /nowhere\n")
    (tmp_path / "config" / "uv").mkdir(parents=True)
    (tmp_path / "config" / "uv" / "uv.toml").write_text('[pip]\ntarget = "/nowhere"\n')
    spoiled = [changes for changes, refusal in SPOILED.values() if not refusal and "PATH" not in changes]
    environ = {"PATH": os.environ["PATH"], **SOURCES}
    for changes in spoiled:
        environ |= {name: value.format(brought) for name, value in changes.items()}
    environ |= {f"XDG_{name.upper()}_HOME": str(tmp_path / name) for name in ("cache", "config")}
    environ["PIP_CONFIG_FILE"] = str(tmp_path / "pip.conf")
    environ.setdefault("UV_CACHE_DIR", str(Path(os.environ["HOME"], ".cache", "uv")))
    program = "import rclpy, lathe_rc_msgs.msg as m; m.BlockInfo.__import_type_support__(); print(m.__file__)"

    with subprocess.Popen([root / "lathe", "setup"], env=environ, stderr=subprocess.DEVNULL) as killed:
        until((root / ".lathe" / "venv" / "bin" / "python").exists)
        killed.kill()
    done = lathe("python", "-c", program, root=root, prefix=("sh", "-c", 'umask 077; exec "$0" "$@"'), **environ)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(str(tmp_path / "cache" / "lathe_rc-checkouts"))
    assert "setting up" not in lathe("python", "-c", program, root=root, **environ).stderr

    moved = root.rename(tmp_path / "moved é")
    (tmp_path / "bin").mkdir()
    for name in ("dirname", "readlink"):
        (tmp_path / "bin" / name).symlink_to(shutil.which(name))
    done = lathe(*RUN, root=moved, **environ | {"PATH": str(tmp_path / "bin")})
    assert (done.returncode, "no C++ compiler" in done.stderr) == (2, True), "the set-up of another path serves none"
    shutil.rmtree(tmp_path / "cache")  # a gigabyte
