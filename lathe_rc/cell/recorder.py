# SPDX-License-Identifier: Apache-2.0
"""Parameters of the recorder, which is no stage: it computes nothing and delays nobody's samples."""

from typing import Annotated, Literal

from annotated_types import Ge, Le

from lathe_rc.cell.parameters import NodeParameters, parameter

KIND = "recorder"


class RecorderParameters(NodeParameters):
    """Where and how to record."""

    bag: str = parameter("", "folder of the bag; must not exist; empty: bag_ and the run id", path=True)
    compression: Literal["zstd", "none"] = parameter("zstd", "compression of the bag's chunks")
    chunk_size: Annotated[int, Ge(4096), Le(2**28)] = parameter(
        2**18, "size of the bag's chunks: what a crash may lose", "B"
    )
