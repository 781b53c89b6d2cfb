# SPDX-License-Identifier: Apache-2.0
"""Processes of a cell: ROS domain, start, events and termination."""

import contextlib
import itertools
import json
import os
import queue
import signal
import socket
import subprocess
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType, TracebackType

from lathe_rc import allowed_code, process_launcher
from lathe_rc.cell.scenario import Scenario
from lathe_rc.errors import InputError, LatheError, LossyRunError, PaceError
from lathe_rc.extensions import search_path
from lathe_rc.harness.result import Event
from lathe_rc.names import absolute
from lathe_rc.nodes.report import THROUGHPUT
from lathe_rc.process_launcher import Child, Start

_SILENCE_LIMIT = 120.0  # [s] without any event: the first start on a machine compiles kernels
_FAREWELL = 10.0  # [s] without any event once the run is complete and its bag closed
_GRACE = 2.5  # [s] for a process that ends anyway
_LONGEST_END = 5.0  # [s] for a cell to end after SIGTERM, before SIGKILL
_MOST_RESTARTS = 8  # maximum number of restarts of a process
_SETTLING = 30.0  # [s] without any event while a cell goes to its safe state
_NO_SIGN_OF_LIFE = {"stall", "foreign_message", "waits"}  # events of a stalled cell
_LAST_WORDS = {"done", "error", "abandoned", "masterless"}  # events of a node that has finished or given up
_LOOK = 0.05  # [s] between reads of a process's log
_DOMAINS = 100  # domain_coordinator reserves 1 to 100
# Each cell uses the next number, and each process starts at a different one, because a killed or orphaned process may
# still be in the domain of a cell that has just ended.
_numbers = itertools.count(os.getpid() * 37)


def how_it_ended(event: Event) -> str:
    """Describe the abnormal end of a process, from its ``exit`` event."""
    code = event["code"]
    return f"{event['node']} " + (
        f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
    )


@contextlib.contextmanager
def free_domain(number: int | None = None) -> Iterator[int]:
    """Reserve a ROS domain that no other program on this computer uses, or the given ``number``.

    A given domain is yielded even if it is in use, since several cells may share it.
    """
    from domain_coordinator import domain_id
    from domain_coordinator.impl import PORT_BASE

    if number is not None:
        with socket.socket() as reservation:
            with contextlib.suppress(OSError):  # several cells may share a given domain
                reservation.bind(("", PORT_BASE + number))
            yield number
        return
    with domain_id(lambda: next(_numbers) % _DOMAINS + 1) as free:
        yield int(free)


def with_recorder(scenario: Scenario, bag: Path, *, keep: bool, snapshots: Path | None = None) -> Scenario:
    """Return the scenario for its processes: with a recorder for ``bag``, and a spindle that waits for all members.

    With ``snapshots``, the recorder also writes snapshots to that folder. Without ``keep``, the bag is temporary: it is
    not compressed, and there are no snapshots.
    """
    nodes = dict(scenario.nodes)
    name, table = scenario.recorder
    changes: dict[str, object] = {"bag": str(bag.resolve())}
    if not keep:
        changes |= {"compression": "none", "mode": "continuous"}
    elif snapshots is not None:
        changes |= {"mode": "both", "snapshots": str(snapshots.resolve())}
    nodes[name] = table.model_copy(update=changes)
    for master in scenario.masters:
        others = [node for node in nodes if node != master]
        nodes[master] = nodes[master].model_copy(update={"members": others})
    return Scenario(scenario.name, nodes)


class Processes:
    """Processes of a cell from start to end, as a context manager that terminates all of them.

    Args:
        scenario: scenario with a recorder, as returned by `with_recorder`.
        groups: names of the nodes in each process.
        domain: ROS domain; None: a free one.
        namespace: ROS namespace of all nodes.
        start: see `run`.
        prefix: command prefix, such as ``ip netns exec NAME``, by the first node of a process; a process with a prefix
            is spawned as a new interpreter.

    Attributes:
        pids: process ID by node.
        domain: the ROS domain in use.
        refused: number of messages from outside the cell that the nodes rejected, by sender; complete when the nodes
            have ended.
        not_reached: events scheduled after the end of the run, by node; complete when the nodes have ended.
    """

    def __init__(
        self,
        scenario: Scenario,
        groups: Sequence[Sequence[str]],
        *,
        domain: int | None = None,
        namespace: str = "/",
        start: Start = "fork",
        prefix: Mapping[str, Sequence[str]] = MappingProxyType({}),
    ) -> None:
        self._scenario, self._groups, self._wanted_domain = scenario, groups, domain
        self._namespace, self._fresh, self._prefix = namespace, start == "spawn", prefix
        self._events: queue.SimpleQueue[Event] = queue.SimpleQueue()
        self._stack = contextlib.ExitStack()
        self._children: dict[str, Child] = {}
        self._threads: list[threading.Thread] = []
        self._abandoned: set[str] = set()
        self._ended: set[str] = set()
        self._left: set[str] = set()  # nodes that have finished or given up
        self._newest: dict[str, Event] = {}
        self._lost: list[tuple[str, str]] = []  # nodes lost before the safe state, and the reasons
        self._dead: set[str] = set()  # members whose end the time master has reported
        self._restarts: Counter[str] = Counter()
        self.pids: dict[str, int] = {}
        self.refused: Counter[str] = Counter()
        self.not_reached: dict[str, list[str]] = {}
        self.domain = -1

    def __enter__(self) -> "Processes":
        """Start the processes."""
        try:
            self.domain = self._stack.enter_context(free_domain(self._wanted_domain))
            self._folder = Path(self._stack.enter_context(tempfile.TemporaryDirectory(prefix="lathe-log-")))
            self._file = self._folder / "scenario.yaml"
            self._file.write_text(self._scenario.to_yaml(), encoding="utf-8")
            for group in self._groups:
                self._start(group)
        except BaseException:
            self.stop()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Terminate the processes."""
        self.stop()

    def _start(self, group: Sequence[str]) -> None:
        environment = os.environ | {"ROS_DOMAIN_ID": str(self.domain), "ROS_LOG_DIR": str(self._folder)}
        environment["PYTHONPATH"] = search_path()
        if all(getattr(table, "speed_factor", 0.0) == 0.0 for table in self._scenario.nodes.values()):
            environment[THROUGHPUT] = "1"
        name = "+".join(group)
        arguments = [
            *allowed_code.arguments(),
            *(f"{node}:{self._scenario.kind(node)}" for node in group),
            *("--ros-args", "--params-file", str(self._file), "-r", f"__ns:={self._namespace}"),
            *("--enclave", absolute(self._namespace, group[0])),
        ]
        ours, theirs = socket.socketpair()
        with theirs, (self._folder / f"{group[0]}.log").open("ab") as log:
            child = process_launcher.server().start(
                arguments,
                environment=environment,
                report=theirs,
                log=log.fileno(),
                command=self._command(group[0], arguments),
            )
        self._children[name] = child
        for node in group:
            self.pids[node] = child.pid
        listener = threading.Thread(target=self._listen, args=(name, ours, child), daemon=True)
        listener.start()
        self._threads.append(listener)

    def _command(self, first: str, arguments: Sequence[str]) -> list[str]:
        """Return the command that spawns a process as a new interpreter; empty if the process is forked."""
        prefix = self._prefix.get(first, ())
        words = [*prefix, *allowed_code.interpreter("lathe_rc.nodes.container"), *arguments]
        return words if prefix or self._fresh else []

    def _listen(self, name: str, line: socket.socket, child: Child) -> None:
        """Convert the reports and the exit of a process into events."""
        with line, line.makefile("r", encoding="utf-8") as reports:
            with contextlib.suppress(OSError):
                for report in reports:
                    self._events.put(json.loads(report))
            code = child.wait()
        self._say("exit", name, code=code)

    def _say(self, event: str, name: str, **values: object) -> None:
        """Queue an event of the harness, in the format of the nodes' events."""
        self._events.put({"event": event, "node": name, "monotonic_ns": time.monotonic_ns(), **values})

    def events(self, silence: float) -> Iterator[Event]:
        """Yield the events of the cell as they arrive.

        Raises:
            LatheError: no event arrived for ``silence`` seconds.
        """
        heard = time.monotonic()
        while True:
            leaves = self._complete or self._all_leave
            wait = _FAREWELL if leaves else min(silence, self._settling) if self._lost else silence
            left = heard + wait - time.monotonic()
            try:
                event = self._events.get(timeout=max(left, 0.0))
            except queue.Empty:
                if leaves and self._running:
                    self._end_the_silent()
                    continue
                tails = self._tails()  # read before the processes append their stack traces
                running = ", ".join(f"{name}{self._place(name)}" for name in self._running)
                raise LatheError(
                    self._with_the_lost(
                        f"no node has reported anything for {wait:.0f} s; still running: {running}{tails}"
                    )
                ) from None
            self._newest[event["event"]] = event
            if event["event"] not in _NO_SIGN_OF_LIFE:
                heard = time.monotonic()
            if event["event"] in _LAST_WORDS:
                self._left.add(event["node"])
            if event["event"] == "dead":
                self._dead.add(event["member"])
            if event["event"] == "refused":
                self.refused.update(event["senders"])
            if event["event"] == "not_reached":
                self.not_reached[event["node"]] = event["events"]
            if event["event"] == "exit" and not self._restarted(event):
                self._ended.add(event["node"])
            yield event

    @property
    def _settling(self) -> float:
        """Longest time without an event while the cell reaches its safe state [s]."""
        return _SETTLING + max(getattr(table, "restart_time", 0.0) for table in self._scenario.nodes.values())

    def _restarted(self, event: Event) -> bool:
        """Restart a killed process if all its nodes have a restart file, and return whether it was restarted."""
        name = event["node"]
        group = name.split("+")
        kept = all(getattr(self._scenario.nodes.get(node), "restart_file", "") for node in group)
        if event["code"] >= 0 or not kept or not self._goes_on(name):
            return False
        self._restarts[name] += 1
        if self._restarts[name] > _MOST_RESTARTS:
            return False
        self._left.difference_update(group)
        self._start(group)
        self._say("restarted", name, pid=self._children[name].pid)
        return True

    def _goes_on(self, name: str) -> bool:
        """Return whether the cell handles the end of a node or process: its members wait, then reach the safe state."""
        masters = set(self._scenario.masters)
        waits = all(self._scenario.nodes[master].window for master in masters)
        return waits and "block0" in self._newest and not self._complete and not masters & set(name.split("+"))

    @property
    def _running(self) -> list[str]:
        return [name for name in self._children if name not in self._ended]

    @property
    def _complete(self) -> bool:
        """Whether all samples are in a closed bag, so that no data can be lost any more."""
        return bool(self._newest.get("closed", {}).get("complete"))

    @property
    def _all_leave(self) -> bool:
        """Whether every node of the running processes has finished or given up."""
        return bool(self._running) and all(node in self._left for name in self._running for node in name.split("+"))

    def _end_the_silent(self) -> None:
        """Kill and report the processes that do not end although the run no longer needs them."""
        for name in self._running:
            self._abandoned.add(name)
            self._say("stuck", name, place=self._place(name))
            self._children[name].kill()

    def wait_for(self, kind: str, node: str | None = None, **values: object) -> Event:
        """Wait for an event with a given kind, node and values.

        Raises:
            LatheError: a process failed before the event.
        """
        for event in self.events(_SILENCE_LIMIT):
            wanted = {"event": kind, **values} | ({"node": node} if node else {})
            if wanted.items() <= event.items():
                return event
            self._raise_failure(event)
        raise AssertionError

    def wait_for_end(self, watch: Callable[[Event], None] = lambda _event: None) -> dict[str, Event]:
        """Wait until every process has ended.

        Returns:
            The last event of each kind.

        Raises:
            LatheError: a node failed or was killed; the message names it.
        """
        for event in self.events(_SILENCE_LIMIT):
            watch(event)
            self._raise_failure(event)
            if self._ended == set(self._children):
                break
        if "safe" in self._newest or (self._lost and not self._complete):
            raise LatheError(self._with_the_lost(f"the run did not come to its end{self._tails()}"))
        if not {"block0", "complete", "closed"} <= set(self._newest):
            raise LatheError(f"the nodes ended before the run did{self._tails()}")
        return self._newest

    def _raise_failure(self, event: Event) -> None:
        """Raise the error for the first failure; ignore nodes that gave up because of another node ("abandoned")."""
        node = event["node"]
        if event["event"] == "abandoned":
            self._is_no_cause(node)
        if event["event"] in ("masterless", "interrupted"):
            raise LatheError(self._with_the_lost(event["message"]))
        if event["event"] == "error":
            kinds = {kind.exit_code: kind for kind in (InputError, LossyRunError, PaceError)}
            self._lose(node, event["message"], kinds.get(event["exit_code"], LatheError))
            self._is_no_cause(node)
        if event["event"] == "exit" and event["code"] < 0 and self._complete:
            return  # a library crashed at exit, after the run; `watch` has received the event
        if event["event"] == "exit" and event["code"] > 0 and "safe" in self._newest:
            return  # all nodes of a cell in its safe state exit with an error
        if event["event"] == "exit" and event["code"] and node in self._ended - self._abandoned:
            self._lose(node, self._end_of(node, event["code"]))
        if event["event"] == "exit" and "block0" not in self._newest and not self._left.issuperset(node.split("+")):
            raise LatheError(f"{node} has ended before the run began{self._tail(node)}")

    def _is_no_cause(self, node: str) -> None:
        """Mark the end of a node's process as explained, so that it is not reported as a failure."""
        self._abandoned.update(name for name in self._children if node in name.split("+"))

    def _lose(self, name: str, why: str, error: type[LatheError] = LatheError) -> None:
        """Raise the error that says why a node or process ended, or store it until the cell's reaction is reported."""
        if not self._goes_on(name):
            self._hear_of_the_dead()
            raise error(self._with_the_lost(why))
        self._lost.append((name, why))

    def _hear_of_the_dead(self) -> None:
        """Collect the exit reasons of processes that the time master has reported dead before their ``exit`` event."""
        for name in self._running:
            if self._restarts[name] or not self._dead & {absolute(self._namespace, node) for node in name.split("+")}:
                continue
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._lost.append((name, self._end_of(name, self._children[name].wait(timeout=_GRACE))))

    def _end_of(self, name: str, code: int) -> str:
        """Describe the end of a process, with the location of a crash or the last line of the log."""
        return f"{how_it_ended({'node': name, 'code': code})}{self._crash(name) if code < 0 else self._tail(name)}"

    def _with_the_lost(self, message: str) -> str:
        """Prepend the reasons for lost nodes to a message, unless the message already contains them."""
        further = [why for name, why in self._lost if why.removeprefix(f"{name}: ") not in message]
        return "; ".join([*further, message])

    def _log(self, name: str) -> list[str]:
        """Return the lines of a process's log."""
        log = self._folder / f"{name.split('+', maxsplit=1)[0]}.log"
        return log.read_text(encoding="utf-8", errors="replace").strip().splitlines() if log.exists() else []

    def _tail(self, name: str) -> str:
        """Return the last line of a process's log."""
        lines = self._log(name)
        return f": {lines[-1].strip()}" if lines else ""

    def _crash(self, name: str) -> str:
        """Return the innermost call of a crash in a library, as written by `faulthandler`; empty if there was none."""
        lines = self._log(name)
        start = next((place for place, line in enumerate(lines) if line.startswith("Current thread")), len(lines))
        return f" in {lines[start + 1].strip()}" if start + 1 < len(lines) else ""

    def _place(self, name: str) -> str:
        """Return the innermost call of an unresponsive process."""
        child, before = self._children[name], len(self._log(name))
        with contextlib.suppress(ProcessLookupError):
            child.send_signal(signal.SIGUSR1)
        deadline = time.monotonic() + _GRACE
        while time.monotonic() < deadline and child.poll() is None:
            said = [line.strip() for line in self._log(name)[before:]]
            if place := next((line for line in said if line.startswith("File ")), ""):
                return f" in {place}"
            time.sleep(_LOOK)
        return ""

    def _tails(self) -> str:
        return "".join(f"; {name}{self._tail(name)}" for name in self._children)

    def stop(self) -> None:
        """Stop every process: by SIGTERM, or by SIGKILL if it does not end in time."""
        for number in (signal.SIGCONT, signal.SIGTERM):
            for child in self._children.values():
                if child.poll() is None:
                    with contextlib.suppress(ProcessLookupError):
                        child.send_signal(number)
        deadline = time.monotonic() + _LONGEST_END
        for child in self._children.values():
            try:
                child.wait(timeout=max(deadline - time.monotonic(), 0.0))
            except subprocess.TimeoutExpired:
                child.kill()
                child.wait()
        for thread in self._threads:
            thread.join()
        self._stack.close()
