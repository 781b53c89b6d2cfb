# SPDX-License-Identifier: Apache-2.0
"""The panel of a cell that runs in this ROS domain: it listens to the cell, and asks its nodes for events."""

import signal
import subprocess
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import rclpy
from lathe_rc_msgs.srv import Schedule
from rcl_interfaces.srv import SetParameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions

from lathe_live import page_server, panel
from lathe_live.nodes.listener import Listener
from lathe_live.page_server import Site
from lathe_live.panel_live import LivePanel
from lathe_rc import allowed_code
from lathe_rc.bag.writing.writer import refuse_existing
from lathe_rc.cell.beside import PANEL, PANEL_COMMANDS
from lathe_rc.cell.parameters import Table
from lathe_rc.cell.scenario import Scenario
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import InputError, LatheError
from lathe_rc.names import checked_namespace
from lathe_rc.nodes.standalone_node import LISTENS, set_by_signal, standalone_node

_PATIENCE = 5.0  # [s] for a service to appear, and for its answer
_TURN = 0.05  # [s] between looks whether the panel has ended


class PanelParameters(Table):
    """Parameters of the panel's node: none."""


class _Asking:
    """Commands to a cell by the services of its nodes (implements `lathe_live.panel.Attached`).

    The answers arrive in a thread of their own.

    Args:
        node: node that asks.
        cell: the cell of the scenario.
        live: what is shown of the cell.
    """

    def __init__(self, node: Node, cell: Cell, live: LivePanel) -> None:
        self._node, self._live, self._master = node, live, cell.master.name
        self._recorder: subprocess.Popen[str] | None = None
        self._bag = ""
        self.cannot: Mapping[str, str] = {"step": "a cell of nodes steps by blocks: ros2 service call step_simulation"}
        if not cell.master.parameters.simulation_services:
            self.cannot |= {"go": f"the cell pauses only with {self._master}.simulation_services = playing or paused"}
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(node)
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._spin)
        self._thread.start()

    def _spin(self) -> None:
        while not self._over.is_set():
            self._executor.spin_once(timeout_sec=_TURN)

    def _ask(self, kind: Any, name: str, request: Any) -> Any:
        """Return the answer of a service, by its name in the cell's namespace.

        Raises:
            InputError: there is no such service.
            LatheError: it does not answer.
        """
        service = f"{self._node.get_namespace().rstrip('/')}/{name}"
        client = self._node.create_client(kind, service)
        try:
            if not client.wait_for_service(_PATIENCE):
                raise InputError(f"no service {service}; allowed: a node of the running cell")
            answered = threading.Event()
            future = client.call_async(request)
            future.add_done_callback(lambda _: answered.set())
            if not answered.wait(_PATIENCE):
                raise LatheError(f"{service} does not answer; has the cell ended?")
            return future.result()
        finally:
            self._node.destroy_client(client)

    def act(self, node: str, action: str) -> str:
        """Ask a node for an event at the first sample that it has not computed, and return it as in a scenario.

        Raises:
            InputError: the node does not exist, or refuses.
            LatheError: it does not answer.
        """
        answer = self._ask(Schedule, f"{node}/schedule", Schedule.Request(action=action, not_before=0))
        if not answer.accepted:
            raise InputError(str(answer.message))
        return f"sample {answer.sample_index}: {action}"

    def hold(self, *, held: bool) -> None:
        """Pause the run, or let it go on (errors as for `act`)."""
        from simulation_interfaces.msg import SimulationState
        from simulation_interfaces.srv import SetSimulationState

        state = SimulationState(state=SimulationState.STATE_PAUSED if held else SimulationState.STATE_PLAYING)
        answer = self._ask(SetSimulationState, "set_simulation_state", SetSimulationState.Request(state=state))
        if answer.result.result not in (answer.result.RESULT_OK, SetSimulationState.Response.ALREADY_IN_TARGET_STATE):
            raise InputError(str(answer.result.error_message))
        self._live.know(held=held)

    def pace(self, factor: float) -> None:
        """Set the time master's ``speed_factor`` (errors as for `act`)."""
        value = Parameter("speed_factor", value=factor).to_parameter_msg()
        answer = self._ask(SetParameters, f"{self._master}/set_parameters", SetParameters.Request(parameters=[value]))
        if not answer.results[0].successful:
            raise InputError(str(answer.results[0].reason))
        self._live.know(pace=factor)

    def record(self, bag: str) -> None:
        """Begin ``lathe record`` and wait until it listens; an empty text ends it.

        Raises:
            InputError: no name, one of something that exists, or a recording is on.
            LatheError: it has ended at once.
        """
        if bag and self._recorder:
            raise InputError(f"{self._bag} is being recorded; allowed: end it first")
        if bag:
            refuse_existing(Path(bag))
            words = [*allowed_code.interpreter("lathe_rc"), "record", bag]
            recorder, said = subprocess.Popen(words, stderr=subprocess.PIPE, text=True), ""
            assert recorder.stderr is not None, "it is a pipe"
            for said in recorder.stderr:
                if LISTENS in said:
                    break
            else:
                raise LatheError(said.strip() or f"lathe record {bag} has ended")
            self._recorder, self._bag = recorder, bag
            self._live.know(bag=bag)
        elif self._recorder is None:
            raise InputError("bag = ''; allowed: a name, for the folder of the bag")
        else:
            recorder, self._recorder = self._recorder, None
            recorder.send_signal(signal.SIGINT)
            _, said = recorder.communicate()
            told = said.strip().rpartition("\n")[2] if recorder.returncode else f"recorded {self._bag}"
            self._live.view.say(self._live.view.reached, "panel", told)
            self._live.know(bag="")

    def close(self) -> None:
        """End the recording, the thread and the node, without which the process would hang as it ends."""
        if self._recorder:
            self.record("")
        self._over.set()
        self._thread.join()
        self._executor.shutdown()
        self._node.destroy_node()


def attach(
    scenario: Scenario, namespace: str, port: int, say: Callable[[str], object], *, browser: bool, loop: Site
) -> None:
    """Show the cells of this ROS domain in the panel, one run after the other, until Ctrl-C or SIGTERM.

    Args:
        scenario: scenario of the cell, for tolerance, keyways and the choice of commands.
        namespace: namespace of the cell.
        port: TCP port of the page; 0: a free one.
        say: called with the line for the user.
        browser: whether to open the page in the browser.
        loop: the page of its loops.

    Raises:
        InputError: the port is in use, or the namespace is invalid.
        LatheError: a message is malformed.
    """
    words = ["--ros-args", "-r", f"__ns:={checked_namespace(namespace)}"]
    cell = Cell(scenario.nodes)
    with standalone_node(PANEL, PanelParameters, {}, words, signals=SignalHandlerOptions.NO) as (node, _):
        live = LivePanel()
        asking = _Asking(rclpy.create_node(PANEL_COMMANDS), cell, live)
        live.view.know(scenario, cell.stages.values())
        site = panel.with_loops(panel.attached_site(live.view, cell, asking), loop)
        listener = Listener(node, live)
        set_by_signal(listener.stopped)
        try:
            with page_server.serving(site, port) as address:
                page_server.announce(address, say, browser=browser)
                listener.run()
        finally:
            asking.close()
