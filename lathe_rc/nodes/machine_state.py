# SPDX-License-Identifier: Apache-2.0
"""Executable: ``machine_state``, which publishes a cell as ROS's standard messages without taking part in it.

Like the ``rerun_bridge``, it is no member, and its subscriptions are best effort and volatile: no node waits for it.
"""

import threading
import time

from geometry_msgs.msg import Vector3, Wrench, WrenchStamped
from rclpy.node import Node
from rclpy.subscription import Subscription
from sensor_msgs.msg import JointState
from std_msgs.msg import Header

from lathe_rc import messages
from lathe_rc.blocks.wire import Decoder
from lathe_rc.cell.beside import MACHINE_STATE as KIND
from lathe_rc.cell.beside import MachineStateParameters
from lathe_rc.errors import LatheError
from lathe_rc.nodes import standalone_node
from lathe_rc.nodes.ports import overhear, taken
from lathe_rc.view.machine_state import BED, EDGE, JOINTS, Force, Joints, Machine, source

_DEPTH = 1024  # messages
_BURST = 16  # messages
_PERIOD = 0.01  # [s] between polls of messages
_LOOK = 0.2  # [s] between polls of the graph


class MachineState:
    """Publisher of ``joint_states`` and ``wrench``, from the signals of a cell.

    Args:
        node: node in the namespace of the cell.
        parameters: rate and names of frames.

    Attributes:
        joints, wrench: publishers.
        inlets: subscription, source of `Machine` and decoder, by topic.
        stopped: set from outside to end the work.
    """

    def __init__(self, node: Node, parameters: MachineStateParameters) -> None:
        self._node, self._prefix = node, parameters.frame_prefix
        self._machine = Machine(parameters.rate)
        self.inlets: dict[str, tuple[Subscription, str, Decoder]] = {}
        self.joints = node.create_publisher(JointState, "joint_states", 100)
        self.wrench = node.create_publisher(WrenchStamped, "wrench", 100)
        self.stopped = threading.Event()

    def run(self) -> None:
        """Publish until stopped.

        Raises:
            LatheError: a malformed block.
        """
        due = 0.0
        while not self.stopped.is_set():
            if (now := time.monotonic()) >= due:
                due = now + _LOOK
                self._look()
            self._hear()
            time.sleep(_PERIOD)  # not a wait for the event, whose lock the signal handler needs
        if self._machine.left_out:
            self._node.get_logger().warning(f"{self._machine.left_out} instants are left out: blocks did not arrive")

    def _look(self) -> None:
        """Subscribe to new topics of the cell."""
        namespace = self._node.get_namespace().rstrip("/") + "/"
        for topic, kinds in self._node.get_topic_names_and_types():
            origin = source(topic, kinds[0]) if topic.startswith(namespace) else None
            if origin is None or topic in self.inlets or not self._node.count_publishers(topic):
                continue
            self.inlets[topic] = overhear(self._node, topic, kinds[0], _DEPTH), origin, Decoder(kinds[0])
            if origin != "cut":
                self._machine.sources.add(origin)
            self._node.get_logger().info(f"listens to {topic}")

    def _hear(self) -> None:
        """Take the received blocks in turns, a few per topic, since instants wait only briefly for late topics."""
        busy = True
        while busy:
            busy = False
            for topic, (inlet, origin, decoder) in self.inlets.items():
                for data, _ in taken(inlet, _BURST):
                    busy = True
                    try:
                        block = decoder.decode(data)
                    except ValueError as error:
                        raise LatheError(f"{topic}: {error}") from None
                    for found in self._machine.take(origin, block):
                        self._publish(found)

    def _publish(self, found: Joints | Force) -> None:
        stamp = messages.header(found.sample, found.step_ns).stamp
        header = Header(frame_id=self._prefix + (BED if isinstance(found, Joints) else EDGE))
        header.stamp.sec, header.stamp.nanosec = stamp.sec, stamp.nanosec
        if isinstance(found, Joints):
            positions = {"position": list(found.position), "velocity": list(found.velocity)}
            self.joints.publish(JointState(header=header, name=list(JOINTS), **positions))
        else:
            self.wrench.publish(WrenchStamped(header=header, wrench=Wrench(force=Vector3(y=found.newton))))


def _work(node: Node, parameters: MachineStateParameters) -> None:
    state = MachineState(node, parameters)
    standalone_node.set_by_signal(state.stopped)
    state.run()


run, main = standalone_node.program(KIND, MachineStateParameters, _work)

if __name__ == "__main__":
    main()
