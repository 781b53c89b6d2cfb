# SPDX-License-Identifier: Apache-2.0
"""Parameters of nodes outside the cell, which compute no samples and for which no member waits."""

from typing import Annotated, Literal

from annotated_types import Ge, Gt, Le

from lathe_rc.cell.parameters import NonNegative, Table, parameter

REPLAYER, RERUN_BRIDGE, TOPIC_RECORDER = "replayer", "rerun_bridge", "topic_recorder"  #: kinds of node
MACHINE_STATE = "machine_state"  #: kind of node
PANEL, PANEL_COMMANDS = "panel", "panel_commands"  #: nodes of a panel that is attached to a cell
REPLAYED_FILES = "lathe-replay-"  #: prefix of the temporary folder that contains the files of a replayed bag
RERUN_RATE = 2000.0  #: points of a curve per second
RERUN_PORT = 9090  #: port of the web page

RerunOutput = Literal["spawn", "serve", "connect", "save"]


class ReplayerParameters(Table):
    """Messages to be replayed, and their pace."""

    bag: str = parameter("", "folder or file of the bag", path=True)
    rate: NonNegative = parameter(1.0, "pace against the bag's time; 0: as fast as the readers follow")
    loop: bool = parameter(default=False, doc="begin again at the end")
    start: NonNegative = parameter(0.0, "where to begin, counted from the bag's first message", "s")
    end: NonNegative = parameter(0.0, "where to end, counted from the bag's first message; 0: its end", "s")
    topics: list[str] = parameter([], "fully qualified; none: all but /clock")
    remap: list[str] = parameter([], "other names of topics: /topic:=/other")
    delay: NonNegative = parameter(0.0, "wait before the first message, in each round", "s")
    start_paused: bool = parameter(
        default=False, doc="wait for ~/resume, ~/play_next or a key before the first message"
    )
    qos_overrides: str = parameter(
        "", "YAML file of topics with the history, depth, reliability and durability to offer", path=True
    )
    wait: Annotated[int, Ge(0)] = parameter(0, "readers that each topic must have before the first message is sent")
    as_cell: bool = parameter(
        default=False,
        doc="send each topic from a node of its own name, as members of the cell, and wait for a recorder",
    )


class RerunBridgeParameters(Table):
    """Signals to be shown live in Rerun, and their output: viewer, web page or files."""

    output: RerunOutput = parameter("spawn", "a window, a page for the browser, a viewer that runs already, or files")
    file: str = parameter(
        "live.rrd", "to save to; must not exist. Further runs go to files with a number in their names", path=True
    )
    url: str = parameter("rerun+http://127.0.0.1:9876/proxy", "of the viewer to connect to")
    port: Annotated[int, Ge(1), Le(65535)] = parameter(RERUN_PORT, "of the web page")
    rate: Annotated[float, Ge(1)] = parameter(
        RERUN_RATE, "points of a curve, at most: smallest and largest values", "1/s"
    )
    scenario: str = parameter(
        "", "of the cell, a file or a name: its length and feed scale the part; empty: revolutions lie 0.5 mm apart"
    )
    once: bool = parameter(default=False, doc="end when the first run is over")


class MachineStateParameters(Table):
    """Standard messages of a cell: `joint_states` of the machine and `wrench`, the force on its edge."""

    rate: Annotated[float, Gt(0), Le(1e5)] = parameter(50.0, "messages per second of simulated time, at most", "1/s")
    frame_prefix: str = parameter("", "in front of the frames, as that of robot_state_publisher; for several cells")


class TopicRecorderParameters(Table):
    """Topics to be recorded in any ROS system, and the clock for them."""

    bag: str = parameter("", "folder of the bag; must not exist", path=True)
    topics: list[str] = parameter([], "fully qualified; none: all but hidden ones, /rosout and /parameter_events")
    all: bool = parameter(default=False, doc="hidden topics, /rosout and /parameter_events as well")
    sim_time: bool = parameter(
        default=False, doc="log times are those that /clock told last before; otherwise the wall time of publication"
    )
    once: bool = parameter(default=False, doc="end when all publishers are gone")
    hold: Annotated[float, Gt(0), Le(60)] = parameter(
        0.5, "how much later than a message one that was published before it may come", "s"
    )


#: tables by kind of node
BESIDE: dict[str, type[Table]] = {
    REPLAYER: ReplayerParameters,
    RERUN_BRIDGE: RerunBridgeParameters,
    TOPIC_RECORDER: TopicRecorderParameters,
    MACHINE_STATE: MachineStateParameters,
}
