# SPDX-License-Identifier: Apache-2.0
"""ROS parameters from parameter tables."""

import math
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, ParameterType
from rclpy.node import Node

from lathe_rc.cell.parameters import NodeParameters, Row

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
    """What ROS tools show of a parameter; all are read-only: what changes while running is an event."""
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
    """What the node was given from outside; it must have declared its overrides automatically."""
    given: dict[str, Any] = {}
    found: dict[str, Any] = node.get_parameters_by_prefix("")
    for name, parameter in found.items():
        if name.split(".")[0] not in _OWN_OF_RCLPY:
            value = parameter.value
            given[name] = list(value) if hasattr(value, "typecode") or isinstance(value, list | tuple) else value
    return given


def declare(node: Node, table: type[NodeParameters]) -> NodeParameters:
    """Validate what the node was given and declare every parameter of its table; once declared, they stay.

    Raises:
        InputError: an unknown parameter, a wrong type or a value out of range.
    """
    given = overrides(node)
    values = table.read(node.get_name(), {name: value for name, value in given.items() if value is not None})
    for name in given:
        if not node.describe_parameter(name).read_only:  # it was given, and is not declared yet
            node.undeclare_parameter(name)
    for name, row in table.rows().items():
        if not node.has_parameter(name):
            node.declare_parameter(name, getattr(values, name), descriptor(row), ignore_override=True)
    return values
