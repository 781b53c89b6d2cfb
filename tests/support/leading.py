# SPDX-License-Identifier: Apache-2.0
"""A node in the process of the tests; of a time master the tests play the one member."""

import contextlib
import json

import rclpy

from lathe_rc.harness import free_domain
from lathe_rc.nodes.cell_node import CellNode
from lathe_rc.nodes.report import Reporter
from lathe_rc.protocol.exchange import Exchange


def time_master(kind, role, **parameters):
    """A node that leads the member ``eager``; its run has not begun."""
    return configured(kind, role, members=["eager"], **parameters)


@contextlib.contextmanager
def configured(kind, role, **parameters):
    """A configured node in a domain of its own."""
    words = [word for name, value in parameters.items() for word in ("-p", f"{name}:={json.dumps(value)}")]
    with free_domain() as domain:
        rclpy.init(args=["test", "--ros-args", *words], domain_id=domain)
        try:
            node = CellNode(kind, kind, role, Reporter(), Exchange())
            node.trigger_configure()
            node.exchange.join(node.protocol.own.publishes)
            yield node
            # Left alive, it would hand its blocks to the next cell in this domain.
            node.destroy_node()
        finally:
            rclpy.shutdown()


def begin(node):
    """Let the run begin, as if the member were ready."""
    node.trigger_activate()
    node.protocol.begun(0.0)
    node.attempt(lambda: node.protocol.start(0.0))
