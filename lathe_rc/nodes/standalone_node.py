# SPDX-License-Identifier: Apache-2.0
"""Start, parameters, signals and exit code of nodes that are not members of a cell."""

import contextlib
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TypeVar

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from lathe_rc.cell.parameters import Table
from lathe_rc.errors import LatheError
from lathe_rc.nodes import dds, declare

T = TypeVar("T", bound=Table)


@contextlib.contextmanager
def standalone_node(
    kind: str,
    table: type[T],
    values: Mapping[str, object],
    args: Sequence[str],
    *,
    signals: SignalHandlerOptions | None = None,
    rosout: bool = True,
) -> Iterator[tuple[Node, T]]:
    """Provide a node and its parameters as a context manager.

    Args:
        kind: name of the node.
        table: parameter table of the node.
        values: parameter values; values on the ROS command line are in ``args``.
        args: ROS command line, starting at ``--ros-args``.
        signals: signals that ROS handles; default: all.
        rosout: publish log messages on /rosout as well.

    Raises:
        InputError: a parameter is invalid.
    """
    dds.settle()
    rclpy.init(args=["lathe", *args], signal_handler_options=signals)
    try:
        node = Node(
            kind,
            automatically_declare_parameters_from_overrides=True,
            allow_undeclared_parameters=True,
            enable_rosout=rosout,
        )
        declare.refuse_lost(node, args)
        given = {name: value for name, value in declare.overrides(node).items() if value is not None}
        yield node, table.read(kind, {**given, **values})
    finally:
        with contextlib.suppress(Exception):
            rclpy.try_shutdown()


def run(
    kind: str,
    table: type[T],
    work: Callable[[Node, T], None],
    values: Mapping[str, object],
    args: Sequence[str],
) -> int:
    """Run a node until its work ends or fails, or until Ctrl-C.

    Args:
        kind: name of the node.
        table: parameter table of the node.
        work: function that does the work of the node.
        values: parameter values; values on the ROS command line are in ``args``.
        args: ROS command line, starting at ``--ros-args``.

    Returns:
        The exit code.
    """
    try:
        # Replayed messages on /rosout must not be mixed with this node's own.
        with standalone_node(kind, table, values, args, rosout=False) as (node, parameters):
            work(node, parameters)
    except LatheError as error:
        print(f"lathe: {error}", file=sys.stderr)
        return error.exit_code
    except (KeyboardInterrupt, ExternalShutdownException):
        return LatheError.exit_code
    return 0
