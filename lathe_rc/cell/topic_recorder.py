# SPDX-License-Identifier: Apache-2.0
"""Parameters of the recorder of any topics, which knows nothing of the cell."""

from typing import Annotated

from annotated_types import Gt, Le

from lathe_rc.cell.parameters import Table, parameter

KIND = "topic_recorder"


class TopicRecorderParameters(Table):
    """The topics to record of any ROS system, and the clock for them."""

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
