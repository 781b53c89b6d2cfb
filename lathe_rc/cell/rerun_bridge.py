# SPDX-License-Identifier: Apache-2.0
"""Parameters of the rerun_bridge, which shows what it hears of a cell and takes no part in it."""

from typing import Annotated, Literal

from annotated_types import Ge, Le

from lathe_rc.cell.parameters import Table, parameter

KIND = "rerun_bridge"
RATE = 2000.0  #: points of a curve in a second
PORT = 9090  #: of the web page

Kind = Literal["spawn", "serve", "connect", "save"]


class RerunBridgeParameters(Table):
    """The signals to show live in Rerun, and the place for them."""

    output: Kind = parameter("spawn", "a window, a page for the browser, a viewer that runs already, or files")
    file: str = parameter(
        "live.rrd", "to save to; must not exist. Further runs go to files with a number in their names", path=True
    )
    url: str = parameter("rerun+http://127.0.0.1:9876/proxy", "of the viewer to connect to")
    port: Annotated[int, Ge(1), Le(65535)] = parameter(PORT, "of the web page")
    rate: Annotated[float, Ge(1)] = parameter(RATE, "points of a curve, at most: smallest and largest values", "1/s")
    once: bool = parameter(default=False, doc="end when the first run is over")
