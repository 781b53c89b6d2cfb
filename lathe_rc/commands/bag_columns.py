# SPDX-License-Identifier: Apache-2.0
"""Signals of a bag as columns of a measurement: ``TOPIC.FIELD``."""

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

from lathe_rc import messages
from lathe_rc.bag.reading.recorded import Recorded
from lathe_rc.bag.reading.source import BagSource
from lathe_rc.blocks import columns
from lathe_rc.errors import InputError
from lathe_rc.messages import Samples
from lathe_rc.signals import measurement_source
from lathe_rc.signals.measurement_file import MeasuredQuantities
from lathe_rc.signals.measurement_source import Clock
from lathe_rc.signals.quantities import Mapped

_DRIVE = {"command": "coarse/command.position", "response": "coarse/state.measured_position"}


class BagColumns(measurement_source.MeasurementSource):
    """Columns of a bag, for `lathe_rc.signals.measurement_file.MeasuredQuantities`.

    Args:
        path: path of the bag.

    Raises:
        InputError: the path is not a bag.
    """

    has_header = False

    def __init__(self, path: Path) -> None:
        self._path = path
        self.units: dict[str, str] = {}
        self._steps: dict[str, int] = {}
        with BagSource(path) as source:
            self.namespace = Recorded(source, {}).namespace
            for topic, about in sorted(source.topics.items()):
                if about.type in messages.block_types() and about.count:
                    self._steps[topic] = source.step_ns(topic)
                    for field in messages.allocate(about.type, 0):
                        # Without a word of its sender a command is one of a position.
                        unit = columns.units(about.type).get(field, "").partition(" or ")[0]
                        self.units[f"{topic}.{field}"] = unit

    def read(self, names: Sequence[str], gaps: Collection[str] = ()) -> Mapping[str, Samples]:
        """Return signals by column, shape (n,) each; none has ``gaps``.

        Raises:
            LatheError: samples are missing or not finite.
        """
        with BagSource(self._path) as source:
            places = [name.rpartition(".") for name in names]
            found = Recorded(source, {}).whole([(topic, field) for topic, _, field in places])
        return dict(zip(names, found, strict=True))

    def clock(self, name: str) -> Clock | None:
        """Return the sampling of the topic of a column."""
        return Clock(0.0, self._steps[name.rpartition(".")[0]] * 1e-9)


def measurement(path: Path, mapping: Mapping[str, Mapped]) -> MeasuredQuantities:
    """Open a bag as a measurement; without a mapping command and response are those of the coarse drive.

    A mapping of topics that have no blocks reads the messages of any type, resampled; with ``time=log`` by their log
    times.

    Raises:
        InputError: the path is not a bag, or lacks a column of the mapping.
    """
    source = BagColumns(path)
    by_log = mapping.get("time", Mapped("")).column == "log"
    wanted = {quantity: found for quantity, found in mapping.items() if quantity != "time" or not by_log}
    asked = [found.column for found in wanted.values()]
    if source.units and source.units.keys() >= set(asked) and not by_log:
        own = {quantity: Mapped(f"{source.namespace}/{column}") for quantity, column in _DRIVE.items()}
        own = {quantity: found for quantity, found in own.items() if found.column in source.units}
        return MeasuredQuantities(str(path), source, {**own, **mapping})

    from lathe_rc.commands.message_columns import MessageColumns

    others = MessageColumns(path, asked, by_log=by_log)
    blocks = [column for column in asked if column in source.units]
    if blocks and (by_log or others.units.keys() & set(asked)):
        raise InputError(f"{path}: {blocks[0]} is a signal of blocks; allowed: none beside messages or log times")
    others.units = source.units | others.units
    return MeasuredQuantities(str(path), others, wanted)
