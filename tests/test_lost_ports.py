# SPDX-License-Identifier: Apache-2.0
"""A port that has lost its name is made anew; a healthy one is left alone. A whole cell: tests/test_restart.py."""

import time

import pytest
import rclpy

from lathe_rc.errors import LatheError
from lathe_rc.nodes import lost_ports
from lathe_rc.nodes.stale_shared_memory import FOLDER


@pytest.fixture
def ports(domain):
    """Those of a node of this process; nodes of other tests may listen, too."""
    before = lost_ports._listened()
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain)
    node = rclpy.create_node("listener", context=context)
    yield sorted(lost_ports._listened() - before)
    node.destroy_node()
    context.shutdown()


def test_a_lost_port_is_marked_as_broken_and_others_are_left_alone(ports):
    said = []
    watch = lost_ports.LostPorts(said.append)
    for now in range(10):
        watch.look(float(now))
    lost = ports[0]
    old = [number for number, _, _ in lost_ports._mapped(lost)]
    (FOLDER / lost).unlink()
    watch.look(10.0)
    watch.look(10.4)
    assert said == []  # DDS might be making it anew
    watch.look(10.5)
    assert said == [f"no other process finds {lost} any more; DDS makes it anew"]
    while [number for number, _, _ in lost_ports._mapped(lost)] in (old, []):  # DDS looks at the mark
        time.sleep(0.01)
    assert (FOLDER / lost).exists()


def test_memory_that_is_laid_out_otherwise_is_not_written(ports, monkeypatch):
    monkeypatch.setattr(lost_ports._Head, "plausible", property(lambda _: False))
    watch = lost_ports.LostPorts(print)
    (FOLDER / ports[0]).unlink()
    watch.look(0.0)
    with pytest.raises(LatheError, match=f"^{FOLDER}/{ports[0]} has no file any more, and is not laid out as Fast DDS"):
        watch.look(1.0)


def test_a_process_that_may_not_look_says_so_and_goes_on(ports, monkeypatch, tmp_path):
    said = []
    watch = lost_ports.LostPorts(said.append)
    (FOLDER / ports[0]).unlink()
    monkeypatch.setattr(lost_ports, "_OWN", tmp_path)
    watch.look(0.0)
    watch.look(1.0)
    assert said == [
        f"this process cannot see whether others still find it: [Errno 2] No such file or directory: '{tmp_path}/mem'"
    ]
