# SPDX-License-Identifier: Apache-2.0
"""Parameters of the recorder, which is not a stage: it does not compute or delay any samples."""

from pathlib import Path
from typing import Annotated, Any, Literal

from annotated_types import Ge, Le

from lathe_rc.cell.parameters import NodeParameters, parameter
from lathe_rc.errors import InputError

KIND = "recorder"


class RecorderParameters(NodeParameters):
    """Destination, time and manner of the recording."""

    bag: str = parameter("", "folder of the bag; must not exist; empty: bag_ and the run id", path=True)
    compression: Literal["zstd", "none"] = parameter("zstd", "compression of the bag's chunks")
    chunk_size: Annotated[int, Ge(4096), Le(2**26)] = parameter(
        2**20, "size of the bag's chunks; a crash may lose four", "B"
    )
    split_duration: Annotated[float, Ge(0), Le(1e9)] = parameter(
        0.0, "simulated time after which the bag goes on in another file; 0: one file", "s"
    )
    mode: Literal["continuous", "snapshot", "both"] = parameter(
        "continuous", "what is recorded: the whole run in one bag, snapshots around triggers, or both"
    )
    snapshots: str = parameter(
        "", "folder of the snapshots, each a bag; must not exist; empty: that of the bag and _snapshots", path=True
    )
    pre: Annotated[float, Ge(0), Le(3600)] = parameter(5.0, "simulated time that a snapshot has before a trigger", "s")
    post: Annotated[float, Ge(0), Le(3600)] = parameter(1.0, "simulated time that a snapshot has after a trigger", "s")
    triggers: list[str] = parameter(
        [],
        "events and alarms that trigger a snapshot, as patterns of NODE: ACTION or NODE: MONITOR SUBJECT, like "
        "'*: fault *', 'fine_controller: joined' or 'supervisor: error tool'",
    )
    memory: Annotated[int, Ge(2**16), Le(2**38)] = parameter(
        2**29, "memory that the time before a trigger may take", "B"
    )

    def model_post_init(self, context: Any, /) -> None:
        """Reject a trigger that cannot match any event, and events of the recorder itself."""
        super().model_post_init(context)
        for name in ("events", "faults"):
            if asked := getattr(self, name):
                raise InputError(f"{name} = {asked}: a recorder has none; allowed: none (see triggers, mode and pre)")
        for pattern in self.triggers:
            if ": " not in pattern and "*" not in pattern:
                raise InputError(f"triggers = {pattern!r}; allowed: a pattern of NODE: ACTION, like '*: {pattern}'")

    @property
    def folder(self) -> Path:
        """Folder of the bag."""
        return Path(self.bag or f"bag_{self.run_id or 'cell'}")

    def snapshots_of(self, bag: Path) -> Path:
        """Return the folder of the snapshots that belong to a bag at ``bag``."""
        return Path(self.snapshots) if self.snapshots else bag.with_name(f"{bag.name}_snapshots")
