# SPDX-License-Identifier: Apache-2.0
"""Two cells in one ROS domain, in two namespaces, never mix."""

import concurrent.futures
import itertools
import os
import signal

from cells import all_but, scenario
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from lathe_rc import harness, messages

LEFT = scenario({"run_id": "left"}, spindle_encoder={"revolutions": 10.0, "speed_factor": 0.2})  # there for 3 s
RIGHT = scenario(
    {"run_id": "right", "nominal_rpm": 1100.0, "block_size": 128},
    spindle_encoder={"revolutions": 6.0},
    learning_controller={"learning_gain": 0.5},
)


def alone(cell, namespace):
    """Digests of the offline run, by the names that topics have in a namespace."""
    return {f"{namespace}{topic}": digest for topic, digest in harness.run(cell).digest.items()}


def mixed(bag, namespace):
    """The foreign part of a bag: topics of another cell, and its nodes in the diagnostics."""
    with AnyReader([bag]) as found:
        topics = {c.topic for c in found.connections if c.topic != "/diagnostics"}
    with next(bag.glob("*.mcap")).open("rb") as stream:
        told = [message.data for _, _, message in make_reader(stream).iter_messages(topics=["/diagnostics"])]
    arrays = [messages.decode("diagnostic_msgs/msg/DiagnosticArray", data) for data in told]
    names = {status.name for array in arrays for status in array.status}
    return {name for name in topics | names if not name.startswith(f"{namespace}/")}


class Pause:
    """Stops a node at the first finished cycle."""

    def __init__(self, node):
        self.node, self.pids, self.stopped = node, {}, concurrent.futures.Future()

    def __call__(self, event):
        if event["event"] == "active":
            self.pids[event["node"]] = event["pid"]
        if event["event"] == "cycle" and not self.stopped.done():
            os.kill(self.pids[self.node], signal.SIGSTOP)
            self.stopped.set_result(self.pids[self.node])


def test_a_cell_lives_in_the_middle_of_another(domain, tmp_path):
    pause, options = Pause("tool"), {"mode": "processes", "domain": domain}
    with concurrent.futures.ThreadPoolExecutor() as pool:
        groups = all_but(LEFT, "tool")
        left = pool.submit(
            harness.run, LEFT, **options, namespace="/left", bag=tmp_path / "left", watch=pause, groups=groups
        )
        concurrent.futures.wait([left, pause.stopped], return_when=concurrent.futures.FIRST_COMPLETED)
        right = harness.run(RIGHT, **options, namespace="/shop/right", bag=tmp_path / "right", groups=[[*RIGHT.nodes]])
        assert not left.done()
        os.kill(pause.stopped.result(), signal.SIGCONT)
        assert left.result().digest == alone(LEFT, "/left")
    assert right.digest == alone(RIGHT, "/shop/right")
    assert mixed(tmp_path / "left", "/left") == set()
    assert mixed(tmp_path / "right", "/shop/right") == set()


def test_a_domain_that_a_cell_was_given_is_chosen_for_no_other(monkeypatch):
    """A harness that chooses a domain by itself leaves out those that other harnesses were given by --domain."""
    with harness.free_domain() as number:
        pass
    with harness.free_domain(number) as given:
        monkeypatch.setattr("lathe_rc.harness.processes._numbers", itertools.count(number - 1))  # the next one tried
        with harness.free_domain() as chosen, harness.free_domain(number) as shared:
            assert given == shared == number != chosen
