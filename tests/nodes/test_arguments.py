# SPDX-License-Identifier: Apache-2.0
"""The command line of a node's executable, as `ros2 run` calls it: help, what ROS passes over, parameters that lose."""

import importlib.util
import subprocess
import sys

import pytest
import rclpy
from click.testing import CliRunner
from rclpy.context import Context
from rclpy.node import Node

from lathe_rc.cell.scenario import TABLES
from lathe_rc.cli import main
from lathe_rc.errors import InputError
from lathe_rc.nodes import declare, executables

ALONE = [
    "machine_state",
    "replayer",
    "topic_recorder",
    *(["rerun_bridge"] if importlib.util.find_spec("rerun") else []),
]


def run(monkeypatch, capsys, executable, *words):
    """Exit code, stdout and stderr of an executable."""
    monkeypatch.setattr(sys, "argv", [executable, *words])
    monkeypatch.setenv("COLUMNS", "200")
    with pytest.raises(SystemExit) as end:
        getattr(executables, executable)()
    return end.value.code, *capsys.readouterr()


@pytest.mark.parametrize("name", TABLES.own)
def test_ros2_run_says_of_a_node_what_lathe_node_says(monkeypatch, capsys, name):
    code, said, _ = run(monkeypatch, capsys, name, "--help")
    assert code == 0
    assert said.startswith(f"usage: ros2 run lathe_rc {name} ")
    lathe = CliRunner(env={"COLUMNS": "200"}).invoke(main, ["node", name, "--help"]).stdout
    assert said.replace(f"ros2 run lathe_rc {name}", f"lathe node {name}") == lathe


@pytest.mark.parametrize("name", [*ALONE, "container"])
def test_executables_that_are_no_nodes_of_a_cell_have_help_too(monkeypatch, capsys, name):
    code, said, _ = run(monkeypatch, capsys, name, "-h")
    assert (code, said.startswith(f"usage: ros2 run lathe_rc {name} ")) == (0, True)


@pytest.mark.parametrize("name", ["tool", "container"])
def test_without_ros_an_executable_says_how_to_get_it(name):
    program = "import sys; sys.modules['rclpy'] = None; from lathe_rc.nodes import executables; "
    command = [sys.executable, "-c", f"{program}executables.{name}()"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr.startswith("lathe: no module rclpy here: ")
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize("name", ["tool", "replayer", "topic_recorder"])
def test_a_namespace_without_its_slash_is_refused(monkeypatch, capsys, name):
    """The message of rcl is about lexemes."""
    code, _, said = run(monkeypatch, capsys, name, "--ros-args", "-r", "__ns:=left")
    assert (code, said) == (2, "lathe: -r __ns:=left: no absolute namespace; write -r __ns:=/left\n")


@pytest.mark.parametrize("name", ["tool", *ALONE])
@pytest.mark.parametrize("words", [["-p", "feed:=1.0"], ["feed:=1.0"], ["recorder", "--ros-args", "-p", "feed:=1.0"]])
def test_what_ros_would_pass_over_is_refused(monkeypatch, capsys, name, words):
    code, _, said = run(monkeypatch, capsys, name, *words)
    assert code == 2
    assert said.startswith(f"lathe: {name}: {words[0]!r}; allowed: --help, or --ros-args and what ROS takes: ")
    assert said.count("\n") == 1


@pytest.mark.parametrize(
    ("words", "named"), [([], ""), (["--ros-args"], ""), (["tool", "-p"], "-p"), (["a:=b"], "a:=b")]
)
def test_a_container_without_nodes_is_refused(monkeypatch, capsys, words, named):
    code, _, said = run(monkeypatch, capsys, "container", *words)
    assert code == 2
    assert said.startswith(f"lathe: no node {named!r}; allowed: spindle_encoder, ")


# --- parameters that lose

OWN, SHARED = "/tool: {ros__parameters: {feed: 1.0}}\n", "/**: {ros__parameters: {feed: 3.0}}\n"


def feed_of(folder, words, file):
    """The feed of the node ``tool``, and whether parameters that it does not get are refused."""
    return with_tool(folder, words, file, lambda node, _: declare.overrides(node).get("feed"))


def warning_of(folder, words, file):
    return with_tool(folder, ["--params-file", "FILE", *words], file, declare.missing_entry)


def with_tool(folder, words, file, ask):
    path = folder / "some.yaml"
    path.write_text(file)
    given = ["--ros-args", *(str(path) if word == "FILE" else word for word in words)]
    context = Context()
    rclpy.init(args=given, context=context)
    try:
        node = Node(
            "tool",
            context=context,
            automatically_declare_parameters_from_overrides=True,
            allow_undeclared_parameters=True,
            enable_rosout=False,
            start_parameter_services=False,
        )
        declare.refuse_lost(node, given)
        return ask(node, given)
    finally:
        context.try_shutdown()


@pytest.mark.parametrize(
    ("file", "words", "feed"),
    [
        (OWN, ["--params-file", "FILE", "-p", "feed:=2.0"], 2.0),
        (SHARED + OWN, ["--params-file", "FILE", "-p", "tool:feed:=2.0"], 2.0),
        (OWN + SHARED, ["--params-file", "FILE", "-p", "feed:=2.0"], 2.0),
        (SHARED, ["--params-file", "FILE", "--param", "feed:=2.0", "-r", "__ns:=/left"], 2.0),
        (SHARED + OWN, ["--params-file", "FILE", "-p", "recorder:feed:=2.0"], 1.0),
        (OWN, ["--params-file", "FILE", "-p", "use_sim_time:=true", "--", "-p", "feed:=2.0"], 1.0),
        (OWN, ["--params-file", "FILE", "-p", "tool:feed:=2.0", "-p", "tool:feed:=4.0"], 4.0),
    ],
)
def test_a_parameter_on_the_command_line_reaches_its_node(domain, tmp_path, file, words, feed):
    assert feed_of(tmp_path, words, file) == feed


@pytest.mark.parametrize(
    ("file", "words", "said"),
    [
        (SHARED + OWN, ["--params-file", "FILE", "-p", "feed:=2.0"], r"has 1\.0; write -p tool:feed:=VALUE behind "),
        (OWN, ["-p", "tool:feed:=2.0", "--params-file", "FILE"], r"has 1\.0; write -p tool:feed:=VALUE behind every "),
        (SHARED, ["-p", "feed:=2.0", "--params-file", "FILE"], r"has 3\.0; write -p tool:feed:=VALUE behind "),
        (OWN, ["--params-file", "FILE", "-p", "tool:feed:=2.0", "-r", "__ns:=/left"], r"has its default; ROS has no "),
    ],
)
def test_a_parameter_that_something_else_overrules_is_refused(domain, tmp_path, file, words, said):
    """ROS keeps quiet about it."""
    with pytest.raises(InputError, match=r"^-p (tool:)?feed:=2\.0 does not reach (/left)?/tool, which " + said):
        feed_of(tmp_path, words, file)


@pytest.mark.parametrize("shared", ["", SHARED])
@pytest.mark.parametrize("place", ["-r __ns:=/left", ""])
def test_the_values_of_a_later_file_win_or_are_refused(domain, tmp_path, shared, place):
    """`Node(parameters=[FILE, {...}])` writes the dictionary under /**, which loses to an entry behind a /** above."""
    later = tmp_path / "launch_params.yaml"
    own = "/left/tool" if place else "/tool"
    for entry, reaches in (("/**", not shared), (own, True)):
        later.write_text(f"{entry}: {{ros__parameters: {{feed: 2.0}}}}\n")
        words = ["--params-file", "FILE", "--params-file", str(later), *place.split()]
        file = shared + OWN.replace("/tool", own)
        if reaches:
            assert feed_of(tmp_path, words, file) == 2.0
        else:
            said = rf"^feed = 2\.0 of {later} does not reach {own}, which has 1\.0 of an earlier file; write it under"
            with pytest.raises(InputError, match=said):
                feed_of(tmp_path, words, file)


@pytest.mark.parametrize(
    ("file", "words", "said"),
    [
        (OWN, ["-r", "__ns:=/left"], "no entry for /left/tool, which keeps its defaults; /tool: is another node; "),
        (OWN.replace("tool", "tol"), [], "no entry for /tool, which keeps its defaults; did you mean /tol?"),
        (OWN.replace("/tool", "/**/tool"), ["-r", "__ns:=/left"], ""),
        (OWN.replace("/tool", "/*/tool"), ["-r", "__ns:=/left"], ""),
        (SHARED.replace("feed: 3.0", "seed: 3"), [], ""),
        ("/tool: {ros__parameters: {seed: 3}}", [], ""),
    ],
)
def test_a_node_without_an_entry_in_its_file_is_named(domain, tmp_path, file, words, said):
    """ROS keeps quiet about that as well: the node would have its defaults."""
    assert said in (warning := warning_of(tmp_path, words, file))
    assert bool(warning) == bool(said)


def test_a_process_whose_exit_hangs_ends_with_its_code():
    program = (
        "import ctypes\n"
        "from lathe_rc.nodes import arguments\n"
        "class Hanging:\n"
        "    def __del__(self, pause=ctypes.PyDLL(None).pause):\n"
        "        pause()  # holds the interpreter, as a destructor of DDS does\n"
        "hanging = Hanging()\n"
        "arguments._LONGEST_END = 1\n"
        "arguments.exit_with(lambda: print('said') or 3)\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (3, "said\n")
