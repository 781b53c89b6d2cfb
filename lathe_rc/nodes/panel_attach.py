# SPDX-License-Identifier: Apache-2.0
"""The panel of a cell that runs in this ROS domain: it listens to the cell, and asks its nodes for events."""

import signal
import threading
from collections.abc import Callable

import rclpy
from lathe_rc_msgs.srv import Schedule
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from lathe_rc.cell.parameters import Table
from lathe_rc.cell.scenario import Scenario
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import InputError, LatheError
from lathe_rc.names import checked_namespace
from lathe_rc.nodes.listener import Listener
from lathe_rc.nodes.standalone_node import standalone_node
from lathe_rc.view import page_server, panel
from lathe_rc.view.panel_live import LivePanel
from lathe_rc.view.panel_outlook import outlook

_PATIENCE = 5.0  # [s] for a service to appear, and for its answer
_TURN = 0.05  # [s] between looks whether the panel has ended


class PanelParameters(Table):
    """Parameters of the panel's node: none."""


class _Asking:
    """Events by the services of the nodes of a cell; the answers arrive in a thread of their own."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(node)
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._spin)
        self._thread.start()

    def _spin(self) -> None:
        while not self._over.is_set():
            self._executor.spin_once(timeout_sec=_TURN)

    def act(self, name: str, action: str) -> str:
        """Ask a node for an event at the first sample that it has not computed, and return it as in a scenario.

        Raises:
            InputError: the node does not exist, or refuses.
            LatheError: it does not answer.
        """
        service = f"{self._node.get_namespace().rstrip('/')}/{name}/schedule"
        client = self._node.create_client(Schedule, service)
        try:
            if not client.wait_for_service(_PATIENCE):
                raise InputError(f"no service {service}; allowed: a node of the running cell")
            answered = threading.Event()
            future = client.call_async(Schedule.Request(action=action, not_before=0))
            future.add_done_callback(lambda _: answered.set())
            if not answered.wait(_PATIENCE):
                raise LatheError(f"{service} does not answer; has the cell ended?")
            answer = future.result()
            if not answer.accepted:
                raise InputError(str(answer.message))
            return f"sample {answer.sample_index}: {action}"
        finally:
            self._node.destroy_client(client)

    def close(self) -> None:
        """End the thread and the node, without which the process would hang as it ends."""
        self._over.set()
        self._thread.join()
        self._executor.shutdown()
        self._node.destroy_node()


def attach(scenario: Scenario, namespace: str, port: int, say: Callable[[str], object], *, browser: bool) -> None:
    """Show the cells of this ROS domain in the panel, one run after the other, until Ctrl-C or SIGTERM.

    Args:
        scenario: scenario of the cell, for tolerance, keyways and the choice of commands.
        namespace: namespace of the cell.
        port: TCP port of the page; 0: a free one.
        say: called with the line for the user.
        browser: whether to open the page in the browser.

    Raises:
        InputError: the port is in use, or the namespace is invalid.
        LatheError: a message is malformed.
    """
    words = ["--ros-args", "-r", f"__ns:={checked_namespace(namespace)}"]
    cell = Cell(scenario.nodes)
    with standalone_node("panel", PanelParameters, {}, words, signals=SignalHandlerOptions.NO) as (node, _):
        asking, live = _Asking(rclpy.create_node("panel_commands")), LivePanel()
        live.view.outlook = outlook(scenario)
        site = panel.attached_site(live.view, cell, asking.act)
        listener = Listener(node, live)
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, listener.stop)
        try:
            with page_server.serving(site, port) as address:
                page_server.announce(address, say, browser=browser)
                listener.run()
        finally:
            asking.close()
