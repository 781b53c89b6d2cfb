# SPDX-License-Identifier: Apache-2.0
"""Process with one or several nodes: start, event loop, signals and exit code."""

import contextlib
import ctypes
import faulthandler
import gc
import importlib
import inspect
import os
import pkgutil
import signal
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from types import FrameType
from typing import Any, NoReturn, cast

import numpy as np
import rclpy
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.signals import SignalHandlerOptions
from rclpy.type_support import check_for_type_support

from lathe_rc import allowed_code
from lathe_rc.catalogue import DEVICES, PREPARE
from lathe_rc.cell import scenario as scenarios
from lathe_rc.cell.kinds import STAGES
from lathe_rc.cell.parameters import names_others
from lathe_rc.cell.recorder import KIND as RECORDER
from lathe_rc.cell.scenario import TABLES
from lathe_rc.cell.stage import compile_kernels
from lathe_rc.cell.time_master import TimeMasterParameters
from lathe_rc.errors import InputError, LatheError
from lathe_rc.nodes import arguments, chain, dds, declare
from lathe_rc.nodes.cell_node import CellNode, Role
from lathe_rc.nodes.executor import Events
from lathe_rc.nodes.recorder_role import RecorderRole
from lathe_rc.nodes.report import THROUGHPUT, Reporter
from lathe_rc.nodes.spindle_role import SpindleRole
from lathe_rc.nodes.stage_role import StageRole
from lathe_rc.protocol.exchange import Exchange

_MESSAGES = (  # message and service types of the nodes, rclpy's own services included
    *("lathe_rc_msgs.msg", "lathe_rc_msgs.srv", "rcl_interfaces.msg", "rcl_interfaces.srv", "lifecycle_msgs.msg"),
    *("lifecycle_msgs.srv", "diagnostic_msgs.msg", "rosgraph_msgs.msg", "type_description_interfaces.srv"),
)
_PR_SET_PDEATHSIG, _PR_SET_NAME, _PR_SET_TIMERSLACK = 1, 15, 29  # from <linux/prctl.h>
_ENDS_WITH_PARENT = "LATHE_ENDS_WITH_PARENT"  # set by cell.launch.py: a launch that SIGTERM ends leaves its nodes alone
_LONGEST_WAIT = 0.1  # [s] between checks of signals and the harness
_REPEATED = 1.0  # [s] within which a second signal belongs to the same request
_ENDED_BY_SIGNAL = 128  # exit code of a shell's command that a signal has ended, less the signal


def _make(name: str, kind: str, reporter: Reporter, exchange: Exchange) -> CellNode:
    if kind not in TABLES:
        raise InputError(f"{name}: no stage {kind!r}; {TABLES.instead(kind)}")
    role: Callable[[CellNode], Role] = StageRole
    if kind == RECORDER:
        role = RecorderRole
    elif kind in DEVICES:
        role = pkgutil.resolve_name(DEVICES[kind])
    elif issubclass(TABLES[kind], TimeMasterParameters):
        role = SpindleRole
    try:
        return CellNode(name, kind, role, reporter, exchange)
    except RuntimeError as error:
        raise LatheError(f"{name}: {_words(error)}") from None


def _prepare() -> None:
    """Prepare the machine, so that no import stalls a run."""
    for location in PREPARE:
        pkgutil.resolve_name(location)()


def _words(error: RuntimeError) -> str:
    """Return the message of an rcl error without the file and line of its source."""
    return str(error).splitlines()[0].partition(", at /")[0]


class _End:
    """Request to end the process, by SIGINT or SIGTERM; a second one, a second later, ends it at once.

    ``ros2 launch`` repeats the SIGINT of a Ctrl-C that has reached its processes already.

    Attributes:
        reason: name of the signal; empty: no request.
        new: the request has not been passed on to the nodes yet.
        at_once: the process ends without its nodes.
        exit_code: exit code of a process that was ended before its run, as shells have it.
    """

    def __init__(self) -> None:
        self.reason, self.new, self.at_once, self.exit_code = "", False, False, 0
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._signal)

    def _signal(self, number: int, _frame: FrameType | None) -> None:
        self.ask(signal.Signals(number).name, _ENDED_BY_SIGNAL + number)

    def ask(self, reason: str, exit_code: int) -> None:
        now = time.monotonic()
        if not self.reason:
            self.reason, self.new, self.exit_code, self._since = reason, True, exit_code, now
        elif now - self._since > _REPEATED:
            self.at_once = True


def _start(nodes: Sequence[CellNode], exchange: Exchange) -> None:
    """Configure and activate the nodes that start automatically; a node's error is stored in its ``failure``.

    All nodes are configured before any is activated, so that the topics inside the process are known.
    """
    ready = [node for node in nodes if node.autostart and node.trigger_configure() == TransitionCallbackReturn.SUCCESS]
    for node in ready:
        exchange.join(node.protocol.own.publishes)
    for node in ready:
        node.trigger_activate()


def _due(nodes: Sequence[CellNode], now: float) -> float:
    """Return the earliest monotonic time of a next tick [s]; now if all nodes are done."""
    return min((node.next_tick for node in nodes if not node.protocol.done), default=now)


def _leaves(node: CellNode) -> bool:
    """Return True if a node has failed and no other member goes on."""
    return node.protocol.failure is not None and not node.protocol.others_go_on


def _tick(nodes: Sequence[CellNode], now: float) -> None:
    """Call the ticks of the nodes that are due; a failed node without others to wait for gets none."""
    for node in nodes:
        if now >= node.next_tick and not (node.protocol.done or _leaves(node)):
            node.tick(now)
        if node.protocol.failure:
            node.finish()


def _work(nodes: Sequence[CellNode], end: _End, until: float) -> None:
    """Let the nodes compute until no node has new input, at most until a time [s], so that services get their turn."""
    while (waiting := [node for node in nodes if node.due]) and not (end.new or end.at_once):
        for node in waiting:
            node.due = False
            node.work()
        if time.monotonic() >= until:
            return


def _loop(nodes: Sequence[CellNode], reporter: Reporter, end: _End) -> None:
    events = Events(nodes)
    look = 0.0
    while not end.at_once:
        if end.new:
            end.new = False
            for node in nodes:
                node.end_by(end.reason)
        now = time.monotonic()
        if _due(nodes, now) <= now:
            _tick(nodes, now)
            if all(node.protocol.done for node in nodes):
                return
            if any(_leaves(node) for node in nodes):
                return
            if now >= look:
                look = now + _LONGEST_WAIT
                if reporter.orphaned and not end.reason:
                    end.ask("the end of its harness", LatheError.exit_code)
        due = _due(nodes, now)
        wait = 0.0 if any(node.due for node in nodes) else due - now
        # All messages that have arrived are taken before computing: a burst of inputs becomes a burst of outputs, and
        # neighbours wake up once for all of it. The wake-up is the most expensive part of a hop.
        events.spin(min(max(wait, 0.0), _LONGEST_WAIT))
        _work(nodes, end, due)


def _tune(name: str) -> None:
    """Set name, timer slack and scheduling of the process, without privileges, and the signal if its parent ends."""
    ctypes.CDLL(None).prctl(_PR_SET_NAME, name.encode(), 0, 0, 0)
    # Waits end on time, not up to 50 µs later: the executor's polls are waits as well.
    ctypes.CDLL(None).prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)
    if _ENDS_WITH_PARENT in os.environ:
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)
    if THROUGHPUT in os.environ:
        # A woken process does not preempt the process that woke it, so bursts get longer.
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))


def run(members: Sequence[tuple[str, str]], args: Sequence[str]) -> int:
    """Run nodes in this process until they are done, fail or are stopped.

    Args:
        members: name and kind of each node.
        args: ROS command line, starting at ``--ros-args``.

    Returns:
        Exit code: 0; or the code of the first node that failed or whose cell went to its safe state; or 128 and the
            number of the signal that has ended the process before the run.

    Raises:
        InputError: a namespace is not absolute, or a parameter file in a bag names code that is not allowed, or files
            outside the bag.
    """
    end = _End()
    arguments.check_namespaces(args)
    for file in arguments.parameter_files(args):
        if allowed_code.bag_around(file.parent) is not None:
            scenarios.load(file)  # bag data, rejected if it names code or files elsewhere
    allowed_code.user_names(cache(partial(arguments.texts, args)))
    faulthandler.enable()  # a crash in a library leaves a traceback in the log
    faulthandler.register(signal.SIGUSR1)  # and the harness can request a traceback of a silent process
    _tune(members[0][0])
    reporter = Reporter()
    dds.settle()
    _prepare()
    np.seterr(over="ignore", invalid="ignore")  # each node names its own numbers that are not finite
    try:
        rclpy.init(args=["lathe", *args], signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:
        print(f"lathe: --ros-args: {_words(error)}", file=sys.stderr)
        return InputError.exit_code
    nodes: list[CellNode] = []
    exchange = Exchange(chain.form)
    try:
        for name, kind in members:
            nodes.append(_make(name, kind, reporter, exchange))
            declare.refuse_lost(nodes[-1], args)
            if warning := declare.missing_entry(nodes[-1], args):
                nodes[-1].get_logger().warning(warning)
        if not end.new:
            _start(nodes, exchange)
        gc.collect()
        gc.freeze()  # the collector skips existing objects: it would traverse them repeatedly between blocks
        gc.enable()  # the fork server has disabled it
        _loop(nodes, reporter, end)
        for node in nodes if end.at_once else ():
            node.interrupt(end.reason)
        early = end.exit_code if any(node.protocol.left_early for node in nodes) else 0
        return next((node.protocol.exit_code for node in nodes if node.protocol.exit_code), early)
    except LatheError as error:
        print(f"lathe: {error}", file=sys.stderr)
        reporter("error", members[0][0], message=str(error), exit_code=error.exit_code)
        return error.exit_code
    finally:
        for node in nodes:
            node.finish()
            if node.refused_messages.senders:
                reporter("refused", node.get_name(), senders=node.refused_messages.senders)
        # The nodes are not destroyed: Fast DDS may deadlock while other participants are leaving, too.
        rclpy.try_shutdown()
        if not reporter.attached:  # a harness stores them itself
            _store_digests(nodes)


def _store_digests(nodes: Sequence[CellNode]) -> None:
    """Store the digests of the bags of complete runs, after the cell has ended and nobody waits."""
    from lathe_rc.bag.check import check, write_digests

    for bag in (node.role.whole for node in nodes if isinstance(node.role, RecorderRole)):
        try:
            if bag is not None and (found := check(bag)).digests:
                write_digests(bag, found.digests)
        except LatheError as error:
            print(f"lathe: {bag}: no digests: {error}", file=sys.stderr)


def preload(nodes: Mapping[str, tuple[str, Mapping[str, Any]]]) -> None:
    """Preload the resources of nodes, mainly compiled kernels, so that forked processes share them.

    Args:
        nodes: kind and parameters of each node; nodes with third-party classes load these themselves, since they may
            have changed.
    """
    _prepare()
    inspect.getframeinfo(cast("FrameType", inspect.currentframe()))  # rclpy's first log message reads all modules
    for package in _MESSAGES:
        for found in vars(importlib.import_module(package)).values():
            if isinstance(found, type):
                check_for_type_support(found)
    for name, (kind, values) in nodes.items():
        with contextlib.suppress(Exception):  # the node itself reports the error
            if kind in STAGES.own and not names_others(STAGES[kind].Parameters, values):
                compile_kernels(STAGES[kind](name, TABLES[kind].read(name, values)))
                for row in TABLES[kind].rows().values():
                    row.allowed()  # scans the plug-ins of installed packages once


def split(words: Sequence[str]) -> tuple[list[tuple[str, str]], list[str]]:
    """Split a command line into the NAME[:STAGE] nodes (names and kinds) and the arguments starting at ``--ros-args``.

    Raises:
        InputError: no node is named, or other arguments precede ``--ros-args``.
    """
    named, rest = arguments.split(allowed_code.taken_from(words))
    for text in named or [""]:
        if not text or text.startswith("-") or ":=" in text:
            raise InputError(f"no node {text!r}; allowed: {TABLES.allowed()}, or NAME:STAGE; then {arguments.ROS} ...")
    parts = [text.partition(":") for text in named]
    return [(name, kind or name) for name, _, kind in parts], rest


def run_and_exit(words: Sequence[str]) -> NoReturn:
    """Run the nodes of a command line (see `split`), and exit."""
    arguments.exit_with(lambda: run(*split(words)))


def main(kind: str) -> NoReturn:
    """Run the executable of one kind of node, and exit."""
    arguments.executable(kind, TABLES[kind], lambda words: run([(kind, kind)], words))
