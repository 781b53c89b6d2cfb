# SPDX-License-Identifier: Apache-2.0
"""Declaration of ROS parameters from parameter tables."""

import math
from collections.abc import Sequence
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, ParameterType
from rclpy.node import Node

from lathe_rc.cell import ros_yaml
from lathe_rc.cell.parameters import NodeParameters, Row
from lathe_rc.errors import InputError
from lathe_rc.nodes import arguments

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


def descriptor(row: Row) -> ParameterDescriptor:
    """Return the ROS descriptor of a parameter; all are read-only, since changes during a run are events."""
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
    given: dict[str, Any] = {}
    found: dict[str, Any] = node.get_parameters_by_prefix("")
    for name, parameter in found.items():
        if name.split(".")[0] not in _OWN_OF_RCLPY:
            value = parameter.value
            given[name] = list(value) if hasattr(value, "typecode") or isinstance(value, list | tuple) else value
    return given


def refuse_lost(node: Node, words: Sequence[str]) -> None:
    """Reject a ``-p`` for a node that another override has replaced, which ROS ignores silently.

    Args:
        node: node with automatically declared overrides (see `overrides`).
        words: command line of the node.

    Raises:
        InputError: the node has a different value.
    """
    given, name = overrides(node), node.get_name()
    own = [rule for rule in arguments.rules(words) if rule.node in ("", name)]
    for rule in own:
        if rule.parameter.split(".")[0] in _OWN_OF_RCLPY:
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


def declare(node: Node, table: type[NodeParameters]) -> NodeParameters:
    """Validate the overrides of a node and declare every parameter of its table, once.

    Raises:
        InputError: an unknown parameter, a wrong type or a value out of range.
    """
    given = overrides(node)
    values = table.read(node.get_name(), {name: value for name, value in given.items() if value is not None})
    for name in given:
        if not node.describe_parameter(name).read_only:  # given as an override, and not declared yet
            node.undeclare_parameter(name)
    for name, row in table.rows().items():
        if not node.has_parameter(name):
            node.declare_parameter(name, getattr(values, name), descriptor(row), ignore_override=True)
    return values
