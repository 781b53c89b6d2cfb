# SPDX-License-Identifier: Apache-2.0
"""Declaration of ROS parameters from parameter tables."""

import math
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, ParameterType
from rclpy.node import Node
from rclpy.parameter import Parameter

from lathe_rc.cell import ros_yaml
from lathe_rc.cell.parameters import ParameterRow, SharedParameters, Table, Value
from lathe_rc.errors import InputError
from lathe_rc.names import instead
from lathe_rc.nodes import arguments

T = TypeVar("T", bound=Table)

_OWN_OF_RCLPY = ("use_sim_time", "start_type_description_service", "qos_overrides")

_TYPES = {
    (bool, False): ParameterType.PARAMETER_BOOL,
    (int, False): ParameterType.PARAMETER_INTEGER,
    (float, False): ParameterType.PARAMETER_DOUBLE,
    (str, False): ParameterType.PARAMETER_STRING,
    (bool, True): ParameterType.PARAMETER_BOOL_ARRAY,
    (int, True): ParameterType.PARAMETER_INTEGER_ARRAY,
    (float, True): ParameterType.PARAMETER_DOUBLE_ARRAY,
    (str, True): ParameterType.PARAMETER_STRING_ARRAY,
}


def descriptor(row: ParameterRow) -> ParameterDescriptor:
    """Return the ROS descriptor of a parameter; read-only, unless `release` says otherwise."""
    made = ParameterDescriptor(
        name=row.name,
        type=_TYPES[row.type, row.is_list],
        description=row.doc,
        additional_constraints=row.allowed(),
        read_only=True,
    )
    if not row.is_list and math.isfinite(row.low) and math.isfinite(row.high):
        if row.type is float:
            made.floating_point_range = [FloatingPointRange(from_value=row.low, to_value=row.high)]
        elif row.type is int:
            made.integer_range = [IntegerRange(from_value=int(row.low), to_value=int(row.high), step=1)]
    return made


def overrides(node: Node) -> dict[str, Any]:
    """Return the parameter overrides of a node, which must have declared them automatically."""
    found: dict[str, Any] = node.get_parameters_by_prefix("")
    return {name: _plain(parameter.value) for name, parameter in found.items() if not is_of_rclpy(name)}


def is_of_rclpy(name: str) -> bool:
    """Return True for a parameter that rclpy declares and handles itself."""
    return name.partition(".")[0] in _OWN_OF_RCLPY


def _plain(value: Any) -> Any:
    """Return a parameter's value with arrays of all kinds as lists."""
    return list(value) if hasattr(value, "typecode") or isinstance(value, list | tuple) else value


def checked(node: str, table: type[Table], parameter: Parameter) -> Parameter:
    """Return a parameter that a client sets, with the type of its table: an integer may stand for a double.

    Args:
        node: name of the node.
        table: parameter table of the node.
        parameter: name and value as received.

    Raises:
        InputError: there is no such parameter, or the value has another type or is out of range.
    """
    name, rows = parameter.name, table.rows()
    if parameter.type_ == Parameter.Type.NOT_SET and name in rows:
        raise InputError(f"{node}.{name} cannot be deleted; allowed: {rows[name].allowed()}")
    value = table.checked(node, name, _plain(parameter.value))
    return Parameter(name, Parameter.Type(_TYPES[rows[name].type, rows[name].is_list]), value)


def refuse_lost(node: Node, words: Sequence[str]) -> None:
    """Reject parameters for a node that another override has replaced, which ROS ignores silently.

    Args:
        node: node with automatically declared overrides (see `overrides`).
        words: command line of the node.

    Raises:
        InputError: the node has another value than a ``-p``, or than the last parameter file that has one for it.
    """
    files = arguments.parameter_files(words)
    if len(files) > 1:
        _refuse_lost_of_files(node, files, {rule.parameter for rule in arguments.rules(words)})
    given, name = overrides(node), node.get_name()
    own = [rule for rule in arguments.rules(words) if rule.node in ("", name)]
    for rule in own:
        if is_of_rclpy(rule.parameter):
            continue
        wanted = [ros_yaml.parse_value(each.value, name) for each in own if each.parameter == rule.parameter]
        if repr(given.get(rule.parameter)) not in map(repr, wanted):
            has = repr(given[rule.parameter]) if rule.parameter in given else "its default"
            raise InputError(
                f"-p {rule.text} does not reach {node.get_fully_qualified_name()}, which has {has}; "
                + (
                    f"write -p {name}:{rule.parameter}:=VALUE behind every --params-file"
                    if node.get_namespace() == "/"
                    else f"ROS has no -p {name}:PARAM in a namespace: write -p PARAM:=VALUE, or set it in the file"
                )
            )


def _refuse_lost_of_files(node: Node, files: Sequence[Path], on_command_line: Collection[str]) -> None:
    given, full_name, last = overrides(node), node.get_fully_qualified_name(), dict[str, tuple[Path, list[Value]]]()
    for path in files:
        own: dict[str, list[Value]] = {}
        for values in (values for entry, values in ros_yaml.entries(path).items() if ros_yaml.is_for(entry, full_name)):
            for parameter, value in values.items():
                own.setdefault(parameter, []).append(value)
        last |= {parameter: (path, wanted) for parameter, wanted in own.items()}
    for parameter, (path, wanted) in last.items():
        if parameter in on_command_line or is_of_rclpy(parameter):
            continue
        if repr(given.get(parameter)) not in map(repr, wanted):
            raise InputError(
                f"{parameter} = {wanted[-1]!r} of {path} does not reach {full_name}, which has {given[parameter]!r} of "
                f"an earlier file; write it under {full_name}: instead of /**: (in a launch file: give the Node "
                "name and namespace)"
            )


def missing_entry(node: Node, words: Sequence[str]) -> str:
    """Return a warning if the parameter files of a command line have entries, but none for a node; otherwise nothing.

    Args:
        node: node with automatically declared overrides (see `overrides`).
        words: command line of the node.
    """
    full_name, name = node.get_fully_qualified_name(), node.get_name()
    if overrides(node).keys() - SharedParameters.model_fields.keys():
        return ""  # it has got values of its own, so the files need not be read again
    files = arguments.parameter_files(words)
    known = [entry for path in files for entry in ros_yaml.entries(path) if entry.rpartition("/")[2] != "**"]
    if not known or any(ros_yaml.is_for(entry, full_name) for entry in known):
        return ""
    here = [entry for entry in known if entry.rpartition("/")[2] == name]
    cure = f"{here[0]}: is another node; write /**/{name}: or {full_name}:" if here else instead(f"/{name}", known)
    where = ", ".join(map(str, files))
    return f"{where}: no entry for {full_name}, which keeps its defaults; {cure}"


def declare(node: Node, table: type[T], values: Mapping[str, object] = MappingProxyType({})) -> T:
    """Validate the overrides of a node and declare every parameter of its table.

    Args:
        node: node with automatically declared overrides (see `overrides`).
        table: parameter table of the node.
        values: values that replace overrides.

    Raises:
        InputError: an unknown parameter, a wrong type or a value out of range.
    """
    given = overrides(node)
    told = {name: value for name, value in given.items() if value is not None}
    parameters = table.read(node.get_name(), {**told, **values})
    for name in given:
        if not node.describe_parameter(name).read_only:  # given as an override, and not declared yet
            node.undeclare_parameter(name)
    for name, row in table.rows().items():
        if not node.has_parameter(name):
            node.declare_parameter(name, getattr(parameters, name), descriptor(row), ignore_override=True)
    return parameters


def release(node: Node, names: Collection[str]) -> None:
    """Let declared parameters be set again."""
    for name in names:
        if node.has_parameter(name):
            node.describe_parameter(name).read_only = False
