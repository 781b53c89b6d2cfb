# SPDX-License-Identifier: Apache-2.0
"""Executable: the ``rerun_bridge``, which shows a running cell in Rerun without taking part in it (see `Listener`)."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NoReturn

from rclpy.signals import SignalHandlerOptions

from lathe_live.live_runs import ShownRun
from lathe_live.nodes.listener import Listener
from lathe_live.rerun_live import Live
from lathe_live.rerun_output import LiveOutput, require
from lathe_rc.cell import scenario
from lathe_rc.cell.beside import RERUN_BRIDGE as KIND
from lathe_rc.cell.beside import RerunBridgeParameters
from lathe_rc.nodes import arguments
from lathe_rc.nodes.standalone_node import set_by_signal, standalone_node


def run(values: Mapping[str, object], args: Sequence[str]) -> list[ShownRun]:
    """Show running cells until Ctrl-C or the end of the viewer; if so configured, only the first run.

    Args:
        values: parameter values; values on the ROS command line are in ``args``.
        args: ROS command line, starting at ``--ros-args``.

    Returns:
        The runs shown.

    Raises:
        LatheError: an invalid parameter, an error of Rerun, or a malformed message.
    """
    require()
    signals = SignalHandlerOptions.NO
    with standalone_node(KIND, RerunBridgeParameters, values, args, signals=signals) as (node, parameters):
        known = scenario.load(parameters.scenario) if parameters.scenario else None
        output = LiveOutput(parameters.output, file=Path(parameters.file), url=parameters.url, port=parameters.port)
        with output:
            live = Live(output.open, rate=parameters.rate, say=node.get_logger().info, scenario=known)
            bridge = Listener(node, live, lambda: output.ended or bool(parameters.once and live.shown))
            set_by_signal(bridge.stopped)
            return bridge.run()


def main() -> NoReturn:
    """Run the bridge, and exit."""

    def bridge(words: Sequence[str]) -> int:
        run({}, words)
        return 0

    arguments.executable(KIND, RerunBridgeParameters, bridge)


if __name__ == "__main__":
    main()
