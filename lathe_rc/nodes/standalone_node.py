# SPDX-License-Identifier: Apache-2.0
"""Start, parameters, signals and exit code of nodes that are not members of a cell."""

import contextlib
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, NoReturn, TypeVar

import rclpy
from rcl_interfaces.msg import SetParametersResult
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions, uninstall_signal_handlers

from lathe_rc.cell.parameters import Table
from lathe_rc.errors import InputError, LatheError
from lathe_rc.nodes import arguments, dds, declare

T = TypeVar("T", bound=Table)

LISTENS = "recording"  #: begin of the line that the topic recorder logs once it hears every publisher


class StandaloneNode(Node):
    """Node whose parameters are those of a table.

    Args:
        kind: name of the node.
        table: parameter table of the node.
        rosout: publish log messages on /rosout as well.

    Attributes:
        tuners: function that takes up a new value, by parameter; all other parameters are read-only.
    """

    def __init__(self, kind: str, table: type[Table], *, rosout: bool = True) -> None:
        super().__init__(
            kind,
            automatically_declare_parameters_from_overrides=True,
            allow_undeclared_parameters=True,
            enable_rosout=rosout,
        )
        self._table = table
        self.tuners: dict[str, Callable[[Any], None]] = {}

    def tunes(self, name: str, tuner: Callable[[Any], None]) -> None:
        """Let clients change a parameter, whose new values a function takes up."""
        self.tuners[name] = tuner
        declare.release(self, [name])

    def set_parameters_atomically(self, parameter_list: list[Parameter]) -> SetParametersResult:
        """Change parameters that can be tuned (extends `rclpy.node.Node`)."""
        try:
            parameters = [each if declare.is_of_rclpy(each.name) else self._checked(each) for each in parameter_list]
        except InputError as error:
            return SetParametersResult(successful=False, reason=str(error))
        result = super().set_parameters_atomically(parameters)
        for each in parameters:
            if result.successful and each.name in self.tuners:
                self.tuners[each.name](each.value)
        return result

    def _checked(self, parameter: Parameter) -> Parameter:
        name, checked = self.get_name(), declare.checked(self.get_name(), self._table, parameter)
        if checked.name not in self.tuners:
            tunable = f"; allowed now: {', '.join(self.tuners)}" if self.tuners else ""
            raise InputError(
                f"{name}.{checked.name} is read-only: the node is made with it{tunable}; start it again with "
                f"-p {name}:{checked.name}:=VALUE"
            )
        return checked


@contextlib.contextmanager
def standalone_node(
    kind: str,
    table: type[T],
    values: Mapping[str, object],
    args: Sequence[str],
    *,
    signals: SignalHandlerOptions | None = None,
    rosout: bool = True,
) -> Iterator[tuple[StandaloneNode, T]]:
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
    arguments.check_namespaces(args)
    dds.settle()
    rclpy.init(args=["lathe", *args], signal_handler_options=signals)
    try:
        node = StandaloneNode(kind, table, rosout=rosout)
        declare.refuse_lost(node, args)
        if warning := declare.missing_entry(node, args):
            node.get_logger().warning(warning)
        yield node, declare.declare(node, table, values)
    finally:
        with contextlib.suppress(Exception):
            rclpy.try_shutdown()


def set_by_signal(stopped: threading.Event) -> None:
    """Let SIGINT and SIGTERM set an event; ROS would end its context at once, before remaining messages are taken."""
    uninstall_signal_handlers()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stopped.set())


def program(
    kind: str, table: type[T], work: Callable[[StandaloneNode, T], None]
) -> tuple[Callable[[Mapping[str, object], Sequence[str]], int], Callable[[], NoReturn]]:
    """Return the functions ``run`` and ``main`` of a node's module.

    ``run`` takes parameter values and the ROS command line, starting at ``--ros-args``; it runs the node until its work
    ends or fails, or until Ctrl-C, and returns the exit code. ``main`` is the executable.

    Args:
        kind: name of the node.
        table: parameter table of the node.
        work: function that does the work of the node.
    """

    def run(values: Mapping[str, object], args: Sequence[str]) -> int:
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

    return run, lambda: arguments.executable(kind, table, partial(run, {}))
