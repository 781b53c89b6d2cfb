# SPDX-License-Identifier: Apache-2.0
"""Parameter files are read as rcl reads them, and hostile ones are refused in one line.

The two readers of ROS 2 disagree with each other: rcl (C, for --params-file) calls 1e-3 and 08 doubles, 0o17 and
1_000 texts, y a bool and null the text "null"; rclpy's parameter_dict_from_yaml_file (PyYAML, YAML 1.1, for
``ros2 param load``) calls 1e-3, 08 and y texts, 1_000 an integer, '5' in quotes too, 2020-01-01 a date and null
nothing. A scenario goes to --params-file, so rcl is the one to agree with.
"""

import math
import os

import pytest
import rclpy
from hypothesis import example, given, settings
from hypothesis import strategies as st
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import parameter_dict_from_yaml_file, parameter_value_to_python

from lathe_rc.cell import ros_yaml
from lathe_rc.errors import InputError


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder for parameter files, in a process that ROS nodes elsewhere do not see."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_DOMAIN_ID", "97")
        yield tmp_path_factory.mktemp("yaml")


def write(folder, text, name="some.yaml"):
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def file_of(folder, values):
    """A parameter file with the texts as the values of p0, p1, ..."""
    lines = "".join(f"    p{i}: {value}\n" for i, value in enumerate(values))
    return write(folder, f"n:\n  ros__parameters:\n{lines}")


def as_rcl_reads(path):
    """Types and values that a node gets; None if rcl refuses the file."""
    context = Context()
    try:
        rclpy.init(args=["--ros-args", "--params-file", str(path)], context=context)
    except Exception:  # noqa: BLE001  # rclpy has no error of its own for this
        return None
    try:
        node = Node(
            "n",
            context=context,
            automatically_declare_parameters_from_overrides=True,
            enable_rosout=False,
            start_parameter_services=False,
        )
        values = {name: part.value for name, part in node.get_parameters_by_prefix("").items() if name[0] == "p"}
        node.destroy_node()
    finally:
        rclpy.shutdown(context=context)
    return {name: list(part) if hasattr(part, "typecode") else part for name, part in values.items()}


def as_we_read(path):
    """The same by our reader."""
    try:
        return ros_yaml.read(path)["n"]
    except InputError:
        return None


def refusal_of(path):
    """Our reader's error for a file; empty if it reads it."""
    try:
        ros_yaml.read(path)
    except InputError as error:
        return str(error)
    return ""


def typed(values):
    """Values with their types, comparable: NaN is equal to itself, 0.0 differs from -0.0 and 1 from 1.0 and True."""
    return {name: repr(value) for name, value in values.items()}


PLAIN = """
1e-3 1E6 1e+5 .5 1. .5e1 +.5 5e-324 1e-400 1e400 0x10 0X1F -0x10 0x 0x1p3 010 08 0777 0b11 0o17 1_000 1d5 +5 -0 -0.0
9223372036854775807 9223372036854775808 -9223372036854775809 .inf -.inf +.inf .Inf .INF .iNF inf -inf infinity
.nan -.nan +.nan .NaN nan nan(5) yes no on off y n Y N true True TRUE tRUE false null ~ Null 2020-01-01 1:30 1:30:45
= << e5 1e 1f . + é ٣
""".split()  # noqa: SIM905  # three lines say it better than seventy
MARKED = ['""', "''", '"5"', "'1e3'", '"yes"', '"\\x41"']
MARKED += ["!!str 5", "!!str yes", '!!int "5"', "!!float 5", "!foo 5", "! 5"]
LISTS = ["[1, 2]", "[1.0, 1e3]", "[yes, off]", '["1", "2"]', "[a, b, null]", "[1e-3]", "[0x10, 010]", "[1,\n     2]"]
BLOCKS = ["|-\n      5", ">-\n      yes", "|\n      5", ">-\n      two\n      words", "two\n      words"]
REFUSED = ["", "|-", "[1, 2.5]", "[1e3, 2]", "[a, 1]", "[true, 1]"]
REFUSED += ["-", "@a", "`a", "%a", "[1", "a: b", "[a:=b]", "*a", '"\\ud800"']


@pytest.mark.parametrize("value", PLAIN + MARKED + LISTS + BLOCKS)
def test_value_is_read_as_rcl_reads_it(folder, value):
    path = file_of(folder, [value])
    assert typed(as_we_read(path)) == typed(as_rcl_reads(path))


@pytest.mark.parametrize("value", REFUSED)
def test_value_that_rcl_refuses_is_refused(folder, value):
    path = file_of(folder, [value])
    assert as_rcl_reads(path) is None
    assert as_we_read(path) is None


numbers = st.one_of(
    st.from_regex(r"[+-]?[0-9]{0,20}(\.[0-9]{0,20})?([eE][+-]?[0-9]{1,3})?", fullmatch=True),
    st.from_regex(r"[+-]?0[xXoObB]?[0-9a-fA-F_]{0,18}", fullmatch=True),
    st.from_regex(r"[+-]?\.?(inf|nan|infinity)", fullmatch=True).flatmap(
        lambda text: st.sampled_from([text, text.upper(), text.title()])
    ),
    st.floats().map(repr),
    st.integers(-(2**70), 2**70).map(str),
)
words = st.text(st.sampled_from("aefnostuyxNYT01.-+_ é/~:"), max_size=8)
quoted = st.text(st.characters(min_codepoint=32, exclude_categories=["Cs", "Cc", "Zl", "Zp"]), max_size=8).map(
    lambda text: "'" + text.replace("'", "''") + "'"
)
scalars = st.one_of(numbers, words, quoted)


@settings(max_examples=15)  # of sixty each; rcl reads a refused one alone
@given(st.lists(scalars, min_size=1, max_size=60))
def test_scalars_are_read_as_rcl_reads_them(folder, texts):
    read = [text for text in texts if as_we_read(file_of(folder, [text])) is not None]
    for text in set(texts) - set(read):
        assert as_rcl_reads(file_of(folder, [text])) is None
    path = file_of(folder, read or ["1"])
    assert typed(as_we_read(path)) == typed(as_rcl_reads(path))


@given(st.lists(scalars, max_size=6))
def test_lists_are_read_as_rcl_reads_them(folder, texts):
    path = file_of(folder, [f"[{', '.join(texts)}]", "1"])
    ours = as_we_read(path)
    if ours is not None and ours["p0"] != []:  # rcl gives an empty list no type, and rclpy then refuses it
        assert typed(ours) == typed(as_rcl_reads(path))


YAML_1_1 = ["5", "-7", "1.5", "1.0e-3", "1.0e+6", "0x10", "010", "yes", "off", "true", "word", "[1, 2]"]


def test_value_that_yaml_1_1_means_too_is_read_as_rclpy_reads_it(folder):
    path = file_of(folder, YAML_1_1)
    theirs = {name: parameter_value_to_python(part.value) for name, part in parameter_dict_from_yaml_file(path).items()}
    assert typed(as_we_read(path)) == typed(theirs)


@given(st.one_of(st.floats(allow_subnormal=False), st.integers(-(2**63), 2**63 - 1), st.booleans()))
def test_value_on_the_command_line_is_read_as_in_a_file(value):
    read = ros_yaml.parse_value(repr(value).lower(), "--set x")
    assert repr(read) == repr(value)
    assert isinstance(read, type(value)) or math.isnan(value)


# --- the file around the values


def test_nodes_are_known_by_their_name(folder):
    text = "/**:\n  ros__parameters: {a: 1}\n/one: {ros__parameters: {b: 2}}\n/**/two: {ros__parameters: {c: {d: 3}}}\n"
    assert ros_yaml.read(write(folder, text)) == {"/**": {"a": 1}, "one": {"b": 2}, "two": {"c.d": 3}}


BOMB = "a: &a [x, x]\n" + "".join(f"{b}: &{b} [*{a}, *{a}]\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True))
NODE = "n:\n  ros__parameters:\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no nodes"),
        ("[1, 2]", "no nodes"),
        ("a: {ros__parameters: {b: 1}}\nn: {parameters: {a: 1}}", ":2: n does not hold ros__parameters alone"),
        ("n: {ros__parameters: {a: 1}, more: 1}", "ros__parameters alone"),
        ("n: {ros__parameters: 5}", "n: not a map of parameters"),
        ("n: {ros__parameters: }", "n: not a map of parameters"),
        (NODE + "    a: 1\n    a: 2\n", "n: a appears twice"),
        (NODE + "    a: {b: 1}\n    a.b: 2\n", "n: a.b appears twice"),
        (NODE + "    a: {}\n", "n.a: neither a value nor a list"),
        (NODE + "    a: [[1]]\n", "n.a: a list of mixed types"),
        (NODE + "    a: [{b: 1}]\n", "n.a: neither a value nor a list"),
        (NODE + '    a: "x\\0y"\n', "n.a: 'x\\x00y'; allowed: text without NUL"),
        (NODE + '    "a\\nb": 1\n', ": a key that is no name"),
        (NODE + "    ? [a]\n    : 1\n", ": a key that is no name"),
        ("? {a: b}\n: {ros__parameters: {a: 1}}\n", ": a key that is no name"),
        (NODE + "    a: &x 1\n    b: *x\n", "YAML aliases"),
        (BOMB, "YAML aliases"),
        (NODE + "    a: [1, 2\n", "not YAML"),
        (NODE + "\ta: 1\n", ":3: not YAML"),
        (NODE + "    a: 1\n   b: 2\n", ":4: not YAML"),
        (NODE + '    a: "\\U00110000"\n', "not YAML"),
        (NODE + '    a: "\\UFFFFFFFF"\n', "not YAML"),
        ("---\n" + NODE + "    a: 1\n---\n" + NODE, "not YAML"),
        (NODE + "    a: " + 200_000 * "[", "nested more than 32 deep"),
        (NODE + "    a: " + 200_000 * "{b: ", "nested more than 32 deep"),
        (200_000 * "- ", "nested more than 32 deep"),
        (b"\xff\xfe\x00\x01", "not a text file"),
        (b"\x00\x01\x02", "not YAML"),
        (b"#" * (2**20 + 1), "larger than 1 MiB"),
    ],
)
def test_hostile_file_is_refused_in_one_line(folder, text, message):
    path = write(folder, text)
    refusal = refusal_of(path)
    assert refusal.startswith(str(path))
    assert message in refusal
    assert len(refusal.splitlines()) == 1


@example("n: {ros__parameters: !!python/object/apply:os.system ['true']}")
@given(st.text(st.characters(exclude_categories=["Cs"])))
def test_junk_is_refused_in_one_line(folder, text):
    path = write(folder, text)
    assert "\n" not in refusal_of(path)


def test_missing_file_is_refused(folder):
    with pytest.raises(InputError, match=r"no\.yaml: cannot be read \(No such file or directory\)"):
        ros_yaml.read(folder / "no.yaml")


def test_what_is_no_file_is_refused_unread(folder):
    os.mkfifo(folder / "pipe")
    for path in (folder, folder / "pipe"):
        assert refusal_of(path) == f"{path}: cannot be read (not a file)"
