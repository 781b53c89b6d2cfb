# SPDX-License-Identifier: Apache-2.0
"""Set-up behind ./lathe: its refusals, the steps that it repeats, and its reports of failed steps."""

import fcntl
import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
from cells import until

import bootstrap
import check
import environment
import installer
import preconditions
import recipe
import ros
import ros_wheels
import steps
import system
import workplace
from lathe_rc.nodes import dds

CHECKOUT = Path(__file__).resolve().parents[2]
# files from which ./lathe computes the keys of its steps
INPUTS = [
    "lathe",
    "tools",
    "requirements",
    "msg_defs",
    "third_party",
    "setup.py",
    "setup.cfg",
    "package.xml",
    "lathe_rc/nodes/dds.py",
]
LINES_SHOWN = 15


@pytest.fixture
def copy(tmp_path):
    """A separate checkout without a set-up."""
    return copy_to(tmp_path / "checkout")


def copy_to(target: Path) -> Path:
    for name in INPUTS:
        source = CHECKOUT / name
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        (shutil.copytree if source.is_dir() else shutil.copy)(source, target / name)
    return target


def lathe(copy: Path, *arguments: str, **environ: str) -> subprocess.CompletedProcess[str]:
    """Call ./lathe as a user would, in an environment that inherits nothing of the tests' own."""
    clean = {"PATH": os.environ["PATH"], "HOME": os.environ["HOME"], "LATHE_PYTHON": workplace.BASE_PYTHON}
    command = [copy / "lathe", *arguments]
    return subprocess.run(command, env=clean | environ, capture_output=True, text=True, check=False)


def fake_python(folder: Path, body: str) -> str:
    """Return an interpreter that runs the shell commands ``body``."""
    python = folder / "fake-python"
    python.write_text(f"#!/bin/sh\n{body}\n")
    python.chmod(0o755)
    return str(python)


def assert_refused(result: subprocess.CompletedProcess[str], copy: Path, *words: str) -> None:
    """Check for one clear line, exit code 2, and nothing made."""
    assert result.returncode == 2, result.stderr
    assert result.stdout == ""
    assert result.stderr.count("\n") == 1
    assert result.stderr.startswith("lathe: ")
    assert [word for word in words if word not in result.stderr] == []
    assert not (copy / ".lathe").exists()


# --- refusals


def test_python_missing(copy):
    assert_refused(lathe(copy, LATHE_PYTHON="no-such-python"), copy, "no-such-python", "sudo apt install python3")


def test_python_unsupported(copy, tmp_path):
    pretend = "import runpy, sys; sys.version_info = (3, 9, 2); runpy.run_path(sys.argv[-1])"
    old = fake_python(tmp_path, f"exec {workplace.BASE_PYTHON} -c '{pretend}' \"$@\"")
    assert_refused(lathe(copy, LATHE_PYTHON=old), copy, "Python 3.9", "3.10 to 3.14", "LATHE_PYTHON=")


def test_entry_has_nothing_that_an_old_python_cannot_parse():
    compile_old = "import ast, sys; ast.parse(open(sys.argv[1]).read(), feature_version=(3, 6))"
    entry = CHECKOUT / "tools" / "__main__.py"
    subprocess.run([sys.executable, "-c", compile_old, entry], check=True)
    assert 'f"' not in entry.read_text()


def test_path_that_lists_of_paths_cannot_carry(tmp_path):
    copy = copy_to(tmp_path / "my$lathe")
    assert_refused(lathe(copy, "setup"), copy, "my$lathe", "'$'")


@pytest.mark.parametrize("name", ["Müller", "日本", "my lathe", "it's", "a[1]"])
def test_a_strange_path_is_set_up_in_the_cache(name, tmp_path, monkeypatch):
    """The folder is that of the path, and the link in the checkout keeps it if the cache is another one later."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    root = tmp_path / name
    home = workplace.home_of(root)
    preconditions.check_path(root, home)
    assert (home.parents[2], home.name) == (tmp_path / "cache", ".lathe")
    assert workplace.home_of(tmp_path / "other é") != home
    root.mkdir()
    (root / ".lathe").symlink_to(home)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "é"))
    assert workplace.home_of(root) == home
    (tmp_path / "moved é").mkdir()
    (tmp_path / "moved é" / ".lathe").mkdir()
    with pytest.raises(workplace.RefusalError, match=r"moved é/.lathe is in the way of a link .* remove it"):
        preconditions.check_path(tmp_path / "moved é", home)
    with pytest.raises(workplace.RefusalError, match="XDG_CACHE_HOME=/path"):
        preconditions.check_path(root, workplace.home_of(tmp_path / "é"))


def test_library_that_would_be_loaded_in_place_of_the_machines(tmp_path):
    """A broken one, and one that loads but has other symbols; the message names it and its folder."""
    library, environ = tmp_path / "libstdc++.so.6", {"LD_LIBRARY_PATH": f"/nowhere:{tmp_path}"}
    preconditions.check_libraries(environ)
    other = Path(importlib.util.find_spec("_ctypes").origin)
    for content, said in ((b"", "file too short"), (other.read_bytes(), "lacks GLIBCXX_3.4.24")):
        library.write_bytes(content)
        with pytest.raises(workplace.RefusalError, match=rf"libstdc.*{said}: take {tmp_path} out of LD_LIBRARY_PATH"):
            preconditions.check_libraries(environ)


@pytest.mark.parametrize("module", ["yaml.py", "numpy/", "random.py"])
def test_python_path_that_hides_a_module(module, tmp_path):
    """Other modules and packages in it stay importable."""
    (tmp_path / "mine.py").touch()
    preconditions.check_python_path({"PYTHONPATH": f"/nowhere:{tmp_path}:{workplace.ROOT}"})
    (tmp_path / module).mkdir() if module.endswith("/") else (tmp_path / module).touch()
    with pytest.raises(workplace.RefusalError, match=f"{module.strip('/')} hides the .* out of PYTHONPATH"):
        preconditions.check_python_path({"PYTHONPATH": str(tmp_path)})


def test_compiler_missing(copy, tmp_path):
    tools = tmp_path / "bin"
    tools.mkdir()
    for name in ("dirname", "readlink"):
        (tools / name).symlink_to(shutil.which(name))
    assert_refused(lathe(copy, "setup", PATH=str(tools)), copy, "C++ compiler", "sudo apt install g++")


def test_venv_module_and_headers_missing(monkeypatch, tmp_path):
    monkeypatch.setattr(preconditions.importlib.util, "find_spec", lambda _name: None)
    monkeypatch.setattr(preconditions.sysconfig, "get_path", lambda _name: str(tmp_path))
    monkeypatch.setattr(preconditions, "has_compilers", lambda: True)
    version = f"python3.{sys.version_info.minor}"
    with pytest.raises(workplace.RefusalError, match=f"sudo apt install {version}-venv {version}-dev$"):
        preconditions.check_packages()


def test_machine_without_wheels(monkeypatch):
    monkeypatch.setattr(preconditions.platform, "machine", lambda: "aarch64")
    with pytest.raises(workplace.RefusalError, match=r"no ROS 2 wheels .*aarch64"):
        preconditions.check(None)


@pytest.mark.parametrize(
    ("words", "shown"),
    [
        (["run", "-h"], "Usage: ./lathe COMMAND"),
        (["test", "--help"], "--system"),
        (["setup", "--help"], "[sweep]"),
        (["docs", "--help"], "--archive"),
    ],
)
def test_help_sets_nothing_up(copy, words, shown):
    shutil.rmtree(copy / "lathe_rc")
    (copy / "lathe_rc").symlink_to(CHECKOUT / "lathe_rc")
    result = lathe(copy, *words)
    assert (result.returncode, result.stderr) == (0, "")
    assert shown in result.stdout
    assert not (copy / ".lathe").exists()


# --- a sourced ROS 2


def sourced(prefix: Path, python: str) -> dict[str, str]:
    (prefix / "lib" / python / "site-packages" / "rclpy").mkdir(parents=True)
    return {"ROS_DISTRO": "jazzy", "AMENT_PREFIX_PATH": str(prefix)}


def test_sourced_ros_is_used_and_our_own_environment_is_not_one(tmp_path):
    ours, other = str(tmp_path / ".lathe" / "install"), "/opt/ros/jazzy"
    jazzy = {"ROS_DISTRO": "jazzy"}
    assert ros.sourced_ros({**jazzy, "AMENT_PREFIX_PATH": f"{ours}:{other}"}) == ("jazzy", (other,))
    assert ros.sourced_ros({**jazzy, "AMENT_PREFIX_PATH": ours}) is None
    assert ros.sourced_ros({"AMENT_PREFIX_PATH": other}) is None


def test_sourced_ros_for_another_python(copy, tmp_path):
    result = lathe(copy, **sourced(tmp_path / "ros", "python3.99"))
    assert_refused(result, copy, "jazzy", "Python 3.99", "LATHE_PYTHON=")


def test_sourced_ros_keeps_its_packages():
    locked = ["# made by uv", "numpy==2.4.6", "scipy==1.17.1", "pyyaml==6.0.3", "ruamel-yaml==0.19.1"]
    found = ["numpy==1.26.4", "PyYAML==6.0.1", "ruamel.yaml==0.18.0"]
    assert recipe.constrain(locked, found) == ["scipy==1.17.1", "numpy==1.26.4"]


# --- keys and stamps


def keys(monkeypatch, copy: Path, chosen: ros.SourcedRos | None = None) -> tuple[str, str, str]:
    monkeypatch.setattr(recipe, "ROOT", copy)
    monkeypatch.setattr(recipe, "REQUIREMENTS", copy / "requirements")
    made = recipe.Recipe(chosen)
    return made._packages_key, made._messages_key, made._package_key


@pytest.mark.parametrize(
    ("changed", "kept"),
    [
        ("requirements/ros.lock", 0),
        ("requirements/python.lock", 0),
        ("msg_defs/msg/BlockInfo.msg", 1),
        ("third_party/simulation_interfaces/msg/Result.msg", 1),
        ("setup.py", 2),
        ("config/new.yaml", 2),
        ("lathe_rc/new_module.py", 3),
        ("README.md", 3),
    ],
)
def test_a_change_remakes_what_depends_on_it_and_no_more(monkeypatch, copy, changed, kept):
    before = keys(monkeypatch, copy)
    (copy / changed).parent.mkdir(exist_ok=True)
    with (copy / changed).open("a") as file:
        file.write("# changed\n")
    after = keys(monkeypatch, copy)
    assert [one == other for one, other in zip(before, after, strict=True)] == [n < kept for n in range(3)]


def test_a_moved_or_copied_checkout_remakes_all(monkeypatch, copy, tmp_path):
    before = keys(monkeypatch, copy)
    assert not set(before) & set(keys(monkeypatch, copy_to(tmp_path / "copied")))
    assert not set(before) & set(keys(monkeypatch, copy.rename(tmp_path / "moved")))


def test_another_source_of_ros_remakes_all(monkeypatch, copy):
    jazzy = keys(monkeypatch, copy, ros.SourcedRos("jazzy", ("/opt/ros/jazzy",)))
    assert not set(jazzy) & set(keys(monkeypatch, copy))


@pytest.fixture
def workshop(monkeypatch, tmp_path):
    """A recipe whose steps only record their names; the step ``broken`` is interrupted."""
    venv, install = tmp_path / "venv", tmp_path / "install"
    for name, path in {
        "VENV": venv,
        "INSTALL": install,
        "BUILD": tmp_path / "build",
        "PACKAGES_STAMP": venv / "packages.stamp",
        "MESSAGES_STAMP": install / "messages.stamp",
        "ENVIRONMENT": install / "environment.json",
    }.items():
        monkeypatch.setattr(recipe, name, path)
    made = recipe.Recipe(None)
    made.taken, made.broken = [], None

    def take(name: str, folder: Path, _lock: int) -> environment.Changes:
        made.taken.append(name)
        folder.mkdir(exist_ok=True)
        (folder / name).touch()
        if made.broken == name:
            raise KeyboardInterrupt
        return environment.Changes(prepend={}, assign={"MADE": "yes"})

    for method, name, folder in [
        ("_make_virtual_environment", "venv", venv),
        ("_install_packages", "packages", venv),
        ("_build_messages", "messages", install),
        ("_install_lathe_rc", "lathe_rc", install),
    ]:
        monkeypatch.setattr(made, method, partial(take, name, folder))
    monkeypatch.setattr(made, "_install_group", lambda name, lock: take(name, venv, lock))
    return made


ALL_STEPS = ["venv", "packages", "messages", "lathe_rc"]
WITH_TESTS = [*ALL_STEPS[:2], "test", *ALL_STEPS[2:]]


@pytest.mark.parametrize(
    ("broken", "first"), [("venv", 0), ("packages", 0), ("test", 2), ("messages", 3), ("lathe_rc", 4)]
)
def test_interrupted_step_is_taken_again_from_nothing(workshop, broken, first):
    workshop.broken = broken
    with pytest.raises(KeyboardInterrupt):
        workshop.make(0, ["test"])
    assert workshop.ready() is None
    workshop.broken = None
    workshop.taken.clear()
    (recipe.VENV / "half-made").touch()
    workshop.make(0, ["test"])
    assert workshop.taken == WITH_TESTS[first:]
    assert (recipe.VENV / "half-made").exists() == (first > 0)
    assert workshop.ready(["test"]) == {"prepend": {}, "assign": {"MADE": "yes"}}


@pytest.mark.parametrize(("deleted", "again"), [("VENV", ALL_STEPS), ("INSTALL", ALL_STEPS[2:])])
def test_deleted_folder_is_made_anew(workshop, deleted, again):
    workshop.make(0)
    workshop.taken.clear()
    shutil.rmtree(getattr(recipe, deleted))
    assert workshop.ready() is None
    workshop.make(0)
    assert workshop.taken == again


def test_a_group_of_packages_is_installed_once_and_when_a_command_needs_it(workshop):
    assert workshop.ready() is None
    workshop.make(0)
    assert workshop.ready(["view"]) is None
    workshop.broken = "view"
    with pytest.raises(KeyboardInterrupt):
        workshop.make(0, ["view"])
    assert workshop.ready(), "without the group all is as it was"
    workshop.broken = None
    workshop.make(0, ["view"])
    assert workshop.ready(["view"])
    assert workshop.ready(["view", "test"]) is None
    workshop.make(0, ["view", "test"])
    assert workshop.taken == [*ALL_STEPS, "view", "view", "test"]


def test_the_viewer_stays_away_from_a_sourced_ros():
    beside = recipe.Recipe(ros.SourcedRos("jazzy", ("/opt/ros/jazzy",)))
    assert beside._missing(["view"]) == []
    assert beside._missing(["test"]) == ["test"]


@pytest.mark.parametrize(
    ("arguments", "groups"),
    [
        (["test", "-k", "view"], ["docs", "fmu", "formats", "panel", "sweep", "test", "view"]),
        (["docs", "--build"], ["docs"]),
        (["sweep", "piston"], ["sweep"]),
        (["tune", "piston"], ["sweep"]),
        (["view", "bag"], ["view"]),
        (["setup", "view"], ["view"]),
        (["run", "view"], []),
        ([], []),
    ],
)
def test_a_command_says_what_it_needs(arguments, groups):
    assert bootstrap.needed(arguments) == groups


def test_setup_of_an_unknown_group_is_refused(copy):
    allowed = "docs, fmu, formats, notebook, panel, sweep, test, view, or nothing more"
    assert_refused(lathe(copy, "setup", "viewer"), copy, f"setup viewer; allowed: {allowed}")


CONFIG = """\
:env:.timeout='180'
:env:.user='1'
global.find-links='/opt/wheels'
global.constraint='/etc/constraints.txt'
install.target='/elsewhere'
install.index-url='https://mirror.invalid/simple'
global.index-url='https://other.invalid/simple'
global.extra-index-url='\\nhttps://a.invalid\\nhttps://b.invalid'
"""


def test_settings_of_pip_turn_no_installation():
    """Those of indexes and of the network hold; places and constraints, of a file or the environment, do not."""
    environ = {"PIP_USER": "1", "PIP_TIMEOUT": "180", "PIP_CONFIG_FILE": "/mine", "HOME": "/root"}
    assert installer.pip_environment(installer.pip_settings(CONFIG), environ) == {
        "HOME": "/root",
        "PIP_CONFIG_FILE": os.devnull,
        "PIP_TIMEOUT": "180",
        "PIP_FIND_LINKS": "/opt/wheels",
        "PIP_INDEX_URL": "https://mirror.invalid/simple",
        "PIP_EXTRA_INDEX_URL": "https://a.invalid https://b.invalid",
    }


def test_what_is_set_for_pip_holds_for_uv_and_the_environment_comes_first():
    """Of the variables of uv, too, those of indexes and of the network hold, and a uv.toml with a target does not."""
    environ = {"UV_FIND_LINKS": "/mine", "UV_CONSTRAINT": "/c.txt", "UV_CONFIG_FILE": "/uv.toml", "HOME": "/root"}
    found = installer.uv_environment(installer.pip_settings(CONFIG), environ)
    assert found["UV_DEFAULT_INDEX"] == "https://mirror.invalid/simple"
    assert found["UV_INDEX"] == "https://a.invalid https://b.invalid"
    assert found["UV_FIND_LINKS"] == "/mine"
    assert found["HOME"] == "/root"
    assert found["UV_NO_CONFIG"] == "1"
    assert not {"UV_CONSTRAINT", "UV_CONFIG_FILE"} & found.keys()


def test_every_package_of_every_list_is_in_a_lock():
    locked = {
        recipe.normal(line)
        for name in ("ros.lock", "python.lock")
        for line in (workplace.REQUIREMENTS / name).read_text().splitlines()
    }
    groups = [group.list for group in recipe.GROUPS.values()]
    for name in ["ros.in", recipe.MESSAGES_LIST, "runtime.in", "build.in", *groups]:
        wanted = (workplace.REQUIREMENTS / name).read_text().splitlines()
        assert {recipe.normal(line) for line in wanted if line and not line.startswith("#")} <= locked, name


@pytest.mark.parametrize("name", ["ros.lock", "python.lock"])
def test_a_lock_has_hashes_of_every_package(name):
    text = (workplace.REQUIREMENTS / name).read_text()
    packages = [line.partition("==")[0] for line in text.splitlines() if line[0].isalnum()]
    assert packages
    for package in packages:
        assert "--hash=sha256:" in recipe.pinned(package, text), package


# --- steps


@pytest.fixture
def step(monkeypatch, tmp_path):
    monkeypatch.setattr(steps, "LOG", tmp_path / "log")
    with (tmp_path / "lock").open("w") as lock:
        yield steps.Step("the messages", "a minute", "look at the sky", lock.fileno())


def test_failed_step_shows_the_end_of_its_log_and_what_to_do(step, tmp_path, capfd):
    with pytest.raises(steps.StepError) as failure, step:
        step.run("sh", "-c", "seq 1 40; exit 7", environ=os.environ)
    shown = str(failure.value)
    assert "the messages: sh failed with exit code 7" in shown
    lines = [line for line in shown.splitlines() if line.startswith("  | ")]
    assert lines == [f"  | {n}" for n in range(41 - LINES_SHOWN, 41)]
    log = tmp_path / "log" / "the-messages.log"
    assert str(log) in shown
    assert log.read_text().splitlines() == [str(n) for n in range(1, 41)]
    assert "look at the sky" in shown
    out, err = capfd.readouterr()
    assert (out, "not finished" in err) == ("", True)


def test_step_reports_its_time_on_stderr_only(step, capfd):
    with step:
        assert step.run("echo", "one", environ=os.environ) == "one\n"
        assert step.run("echo", "two", environ=os.environ) == "two\n"
    out, err = capfd.readouterr()
    assert (out, err.count("\n"), err.split()[:2]) == ("", 1, ["the", "messages"])


def test_interrupted_step_leaves_no_process_behind(step, monkeypatch, tmp_path):
    pid_file = tmp_path / "pid"

    def interrupt_when_started(_process) -> None:
        until(lambda: pid_file.exists() and pid_file.read_text().endswith("\n"))
        raise KeyboardInterrupt

    monkeypatch.setattr(step, "_wait", interrupt_when_started)
    with pytest.raises(KeyboardInterrupt), step:
        step.run("sh", "-c", f"echo $$ > {pid_file}; exec sleep 60", environ=os.environ)
    with pytest.raises(ProcessLookupError):
        os.kill(int(pid_file.read_text()), 0)


@pytest.mark.parametrize(
    ("raised", "code", "line"),
    [
        (workplace.RefusalError("no compiler"), 2, "lathe: no compiler\n"),
        (workplace.StepError("messages: failed"), 1, "lathe: messages: failed\n"),
        (OSError("disk full"), 1, "lathe: disk full\n"),
        (KeyboardInterrupt(), 130, "lathe: interrupted; the next call takes the set-up up again\n"),
    ],
)
def test_failed_set_up_ends_with_a_line_and_a_code(monkeypatch, capsys, raised, code, line):
    def fail(_ros, _groups):
        raise raised

    monkeypatch.setattr(bootstrap, "set_up", fail)
    monkeypatch.setattr(bootstrap.signal, "signal", lambda _number, _handler: None)
    assert bootstrap.main(["setup"]) == code
    assert capsys.readouterr() == ("", line)


def test_second_call_waits_for_the_first(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(steps, "HOME", tmp_path)
    asked = []

    def flock(file, operation):
        asked.append(operation)
        if operation & fcntl.LOCK_NB:
            raise BlockingIOError

    monkeypatch.setattr(steps.fcntl, "flock", flock)
    with steps.exclusive():
        pass
    assert asked == [fcntl.LOCK_EX | fcntl.LOCK_NB, fcntl.LOCK_EX]
    assert "waiting" in capsys.readouterr().err


# --- the environment to run in


def test_run_environment_adds_to_the_users_own():
    ours = {"AMENT_PREFIX_PATH": "/home/x/.lathe/install", "GUARD": "1"}
    wanted = environment.changes({"PATH": f"/home/x/.lathe/venv/bin:{os.defpath}", **ours})
    user = {"EDITOR": "vi", "PYTHONPATH": "/mine"}
    result = environment.run_environment(wanted, {"PATH": "/y/.lathe/venv/bin:/usr/bin", **user})
    assert result == {"PATH": "/home/x/.lathe/venv/bin:/usr/bin", **ours, **user, **dds.settings({})}


@pytest.mark.parametrize("shell", ["sh", "bash"])
def test_lines_for_a_shell_make_the_same_changes_and_once(shell, tmp_path):
    wanted = environment.Changes(prepend={"PATH": ["/a b/bin", "/c"], "NEW_PATH": ["/d*"]}, assign={"GUARD": "it's"})
    script = tmp_path / "lines"
    script.write_text(environment.shell_lines(wanted) * 2)
    said = subprocess.run(
        [shell, "-euc", '. "$0"; printf "%s\\n" "$PATH" "$NEW_PATH" "$GUARD"', script],
        env={"PATH": "/usr/bin:/bin"}, capture_output=True, text=True, check=True,
    ).stdout.splitlines()  # fmt: skip
    assert said == ["/a b/bin:/c:/usr/bin:/bin", "/d*", "it's"]


def test_a_clean_shell_that_sources_setup_bash_can_do_what_lathe_can(tmp_path):
    """The ament index has the packages of the wheels, nodes start, programs import lathe_rc, and lathe runs."""
    program = """
import ament_index_python.packages as found, sensor_msgs.msg, lathe_rc_msgs.msg, lathe_rc, numpy
for name in ("lathe_rc", "lathe_rc_msgs", "std_msgs", "builtin_interfaces"):
    print(found.get_package_prefix(name))
print(lathe_rc.__file__)
"""
    commands = [
        f'. "{workplace.INSTALL}/setup.bash"',
        f"python -c '{program}'",
        "lathe --version",
        f'"{workplace.INSTALL}/lib/lathe_rc/tool" --help',
    ]
    clean = {"PATH": os.defpath, "HOME": os.environ["HOME"], "COLUMNS": "120"}
    command = ["bash", "--norc", "-c", " && ".join(commands)]
    done = subprocess.run(command, env=clean, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert lines[0] == lines[1] == str(workplace.INSTALL)
    assert lines[2] == lines[3] != str(workplace.INSTALL)
    # One path of a module means one cache of its kernels.
    assert lines[4] == str(workplace.ROOT / "lathe_rc" / "__init__.py")
    assert re.fullmatch(r"\S+, version \d+\.\d+\.\d+", lines[5])
    assert lines[6].startswith("usage: ros2 run lathe_rc tool ")


def test_wheels_paths_are_mended(monkeypatch, tmp_path):
    """Paths are mended in this environment, not in the cache of uv, which links its files."""
    monkeypatch.setattr(ros_wheels.sysconfig, "get_path", lambda _name: "/here/include")
    export = tmp_path / "share" / "x" / "cmake" / "export.cmake"
    export.parent.mkdir(parents=True)
    old = "/opt/python/cp311-cp311"
    export.write_text(f'"{old}/include/python3.11;{old}/lib/python3.11/site-packages/numpy/_core/include"')
    cached = tmp_path / "cached"
    cached.hardlink_to(export)
    before = export.read_text()
    ros_wheels.mend_cmake_paths(tmp_path, ros.site_packages())
    assert cached.read_text() == before
    assert export.read_text() == f'"/here/include;{ros.site_packages()}/numpy/_core/include"'


def test_command_gets_the_users_arguments_and_directory(copy, tmp_path):
    """The set-up is complete, but its interpreter is a fake that prints how it was called."""
    venv = copy / ".lathe" / "venv" / "bin"
    venv.mkdir(parents=True)
    Path(fake_python(venv, 'pwd; printf "%s\\n" "$@" "$MADE"')).rename(venv / "python")
    key = subprocess.run(
        [workplace.BASE_PYTHON, "-c", "import recipe; print(recipe.Recipe(None)._package_key)"],
        env={"PYTHONPATH": f"{copy / 'tools'}:{copy / 'msg_defs'}"}, capture_output=True, text=True, check=True,
    ).stdout.strip()  # fmt: skip
    (copy / ".lathe" / "venv" / "packages.stamp").touch()
    (copy / ".lathe" / "install").mkdir()
    kept = {"key": key, "changes": {"prepend": {}, "assign": {"MADE": "yes"}}}
    (copy / ".lathe" / "install" / "environment.json").write_text(json.dumps(kept))
    program = str(copy / "lathe_rc" / "__main__.py")
    clean = {"PATH": os.environ["PATH"], "LATHE_PYTHON": workplace.BASE_PYTHON}
    for words, passed in [
        (["run", "a b", "--json"], [program, "run", "a b", "--json"]),
        (["python", "my program.py", "--help"], ["my program.py", "--help"]),
    ]:
        command = [copy / "lathe", *words]
        result = subprocess.run(command, env=clean, cwd=tmp_path, capture_output=True, text=True, check=True)
        assert (result.stdout.splitlines(), result.stderr) == ([str(tmp_path), *passed, "yes"], "")


def test_another_python_in_the_path_leaves_what_is_set_up_as_it_is(monkeypatch, tmp_path):
    venv, other = tmp_path / "venv", tmp_path / "other-python"
    (venv / "bin").mkdir(parents=True)
    other.touch()
    (venv / "bin" / "python").symlink_to(other)
    for name, path in {"VENV": venv, "PYTHON": venv / "bin" / "python", "PACKAGES_STAMP": venv / "stamp"}.items():
        monkeypatch.setattr(bootstrap, name, path)
    assert bootstrap.settled({}) is None, "nothing is set up yet"
    (venv / "stamp").touch()
    assert bootstrap.settled({}) == other
    assert bootstrap.settled({"LATHE_PYTHON": "another"}) is None, "LATHE_PYTHON takes precedence"
    other.unlink()
    assert bootstrap.settled({}) is None, "it is gone"


# --- ./lathe test


@pytest.fixture
def checkers(monkeypatch):
    """Checkers that only record their runs; those in ``failing`` report a failure."""
    seen = SimpleNamespace(ran=[], failing=set(), pytest=None, verdicts=None)

    def lint(name, _command):
        seen.ran.append(name)
        return name not in seen.failing

    def run_pytest(arguments, plugins=()):
        seen.pytest, seen.verdicts = arguments, plugins[0]._lines if plugins else None
        return pytest.ExitCode.TESTS_FAILED if "pytest" in seen.failing else pytest.ExitCode.OK

    monkeypatch.setattr(check, "lint", lint)
    monkeypatch.setattr(check.pytest, "main", run_pytest)
    monkeypatch.setattr(check, "version", lambda _name: check.locked_numpy())
    monkeypatch.setattr(check.os, "chdir", lambda _path: None)
    return seen


@pytest.mark.parametrize("failing", [set(), {"ruff check"}, {"mypy", "ruff format"}, {"docs"}, {"kernels"}, {"pytest"}])
def test_all_checkers_run_and_any_failure_counts(checkers, failing):
    checkers.failing = failing
    assert (check.main([]) != 0) == bool(failing)
    for beside in ("docs", "kernels"):
        checkers.ran.remove(beside)
    assert checkers.ran == list(check.LINTERS)
    for name in failing - {"pytest"}:
        assert f"{name} FAILED: see above" in checkers.verdicts


def test_system_tests_run_only_when_asked_for(checkers, monkeypatch):
    monkeypatch.setattr(system, "provide", lambda: "")
    check.main(["-k", "cell"])
    assert checkers.pytest == ["-m", "not system", *check.AT_ONCE, *check.REPORTED, "-k", "cell"]
    assert "kernels" not in checkers.ran, "some tests need some kernels only"
    assert any("--system" in line for line in checkers.verdicts)
    checkers.ran.clear()
    assert check.main(["--system", "-k", "cell"]) == 0
    assert checkers.pytest == ["-m", "system", "--numprocesses=2", *check.BY_FILE, "tests", "-k", "cell"]
    assert checkers.ran == []


@pytest.mark.parametrize(
    ("root", "installed", "exit_code", "said"),
    [(False, True, 0, "must be root"), (True, True, 0, ""), (True, False, 0, ""), (True, False, 100, "exit code 100")],
)
def test_what_the_machine_lacks_is_installed_or_said(monkeypatch, root, installed, exit_code, said):
    ran = []

    def run(command, **_options):
        ran.append(command[0])
        if command[0] == "dpkg-query":
            return SimpleNamespace(stdout="installed" if installed else "")
        return SimpleNamespace(returncode=exit_code)

    monkeypatch.setattr(system.os, "geteuid", lambda: 0 if root else 1000)
    monkeypatch.setattr(system.shutil, "which", lambda name: f"/usr/bin/{name}")
    monkeypatch.setattr(system, "subprocess", SimpleNamespace(run=run))
    against = system.provide()
    assert said in against
    assert bool(said) == bool(against)
    assert ("apt-get" in ran) == (root and not installed)


def test_mypy_judges_only_the_locked_numpy(checkers, monkeypatch):
    monkeypatch.setattr(check, "version", lambda _name: "1.26.4")
    assert check.main([]) == 0
    assert set(checkers.ran) == {"docs", "kernels", *check.LINTERS} - {"mypy"}
    assert any("1.26.4" in line for line in checkers.verdicts)
