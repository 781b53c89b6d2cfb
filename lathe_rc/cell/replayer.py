# SPDX-License-Identifier: Apache-2.0
"""Parameters of the replayer, which computes nothing: it sends again what a bag holds."""

from typing import Annotated

from annotated_types import Ge

from lathe_rc.cell.parameters import Table, parameter

KIND = "replayer"
FILES = "lathe-replay-"  #: begins the name of the temporary folder with the files of the bag


class ReplayerParameters(Table):
    """The messages to send again, and their pace."""

    bag: str = parameter("", "folder or file of the bag", path=True)
    rate: Annotated[float, Ge(0)] = parameter(1.0, "pace against the bag's time; 0: as fast as the readers follow")
    loop: bool = parameter(default=False, doc="begin again at the end")
    start: Annotated[float, Ge(0)] = parameter(0.0, "where to begin, counted from the bag's first message", "s")
    end: Annotated[float, Ge(0)] = parameter(0.0, "where to end, counted from the bag's first message; 0: its end", "s")
    topics: list[str] = parameter([], "fully qualified; none: all but /clock")
    wait: Annotated[int, Ge(0)] = parameter(0, "readers that each topic must have before the first message is sent")
    as_cell: bool = parameter(
        default=False,
        doc="send each topic from a node of its own name, as members of the cell, and wait for a recorder",
    )
