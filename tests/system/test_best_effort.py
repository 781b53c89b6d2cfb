# SPDX-License-Identifier: Apache-2.0
"""A device with sensor-data QoS in a free-running cell: its lost blocks are held, counted and named."""

import pytest
from cells import scenario, started

from lathe_rc import harness
from lathe_rc.bag.reading.source import BagSource
from lathe_rc.errors import LossyRunError

pytestmark = pytest.mark.system
TOPIC = "/coarse/state"

#: run in the drive's process: a publisher with sensor-data QoS that loses the first block, three more, and the last one
DEVICE = f"""
from rclpy.qos import qos_profile_sensor_data
from lathe_rc import messages
from lathe_rc.blocks.wire import Decoder
from lathe_rc.nodes import outputs


class Lossy:
    def __init__(self, publisher):
        self.publisher, self.decoder = publisher, Decoder(messages.STATE)

    def __getattr__(self, name):
        return getattr(self.publisher, name)

    def publish(self, data):
        block = self.decoder.decode(data)
        if not (block.last or block.first_index in (0, 640, 704, 1280)):
            self.publisher.publish(data)


def activate(self, before=outputs.Outputs.activate):
    before(self)
    node = self._node
    node.destroy_publisher(node.outlets["{TOPIC}"])
    kind = outputs.message_class(messages.STATE)
    node.outlets["{TOPIC}"] = Lossy(node.create_publisher(kind, "{TOPIC}", qos_profile_sensor_data))


outputs.Outputs.activate = activate
"""


def test_blocks_that_a_best_effort_device_loses_are_held_counted_and_named(domain, tmp_path):
    """Readers that name it subscribe with its quality of service, and end although they lose its last block."""
    reads = {"volatile_inputs": [TOPIC]}
    paced = {"revolutions": 3.0, "speed_factor": 0.2}
    nodes = {"spindle_encoder": paced, "learning_controller": reads, "tool": reads, "recorder": reads}
    cell = harness.with_recorder(scenario({"window": 0}, **nodes), tmp_path / "bag", keep=True)
    file = tmp_path / "cell.yaml"
    file.write_text(cell.to_yaml())
    drive = "electrodynamic_actuator"
    words = ("node", drive, "--ros-args", "--params-file", file)
    with (
        started(*words, first=f"exec({DEVICE!r})"),
        harness.Processes(cell, [[name] for name in cell.nodes if name != drive], domain=domain) as processes,
        pytest.raises(LossyRunError, match=rf"lost \d+ blocks of a free-running cell: \d+ of {TOPIC} from sample 0 on"),
    ):
        processes.wait_for_end()
    with BagSource(tmp_path / "bag") as bag:
        assert str(bag.loss) == f"not read from sample 0 on: {TOPIC} is held from sample 0 on, where blocks were lost"
