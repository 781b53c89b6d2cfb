# SPDX-License-Identifier: Apache-2.0
"""Parquet, MATLAB, TDMS and MDF files as sources of a measurement (`lathe_rc.signals.measurement_file`)."""

from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy

from lathe_rc import extras
from lathe_rc.arrays import Array
from lathe_rc.errors import InputError
from lathe_rc.signals.measurement_source import Clock, MeasurementSource, even_clock
from lathe_rc.signals.quantities import factor, rank, unit_of


class _Parquet(MeasurementSource):
    """Parquet file; the metadata ``unit`` of a field is the unit of the column."""

    def __init__(self, path: Path) -> None:
        from pyarrow import parquet

        self._file = parquet.ParquetFile(path)
        schema = self._file.schema_arrow
        self.units = {field.name: (field.metadata or {}).get(b"unit", b"").decode() for field in schema}

    def read(self, names: Sequence[str], gaps: Collection[str] = ()) -> Mapping[str, npt.NDArray[Any]]:
        table = self._file.read(columns=list(names))
        return {name: table.column(name).to_numpy() for name in names}


class _Mat(MeasurementSource):
    """MATLAB file; a field of a structure is ``NAME.FIELD``; a field ``time`` states the sampling of its structure."""

    def __init__(self, path: Path) -> None:
        try:
            variables = scipy.io.loadmat(path, squeeze_me=True, struct_as_record=False)
        except NotImplementedError:
            raise InputError(f"{path}: MATLAB 7.3; allowed: up to 7 (save it with '-v7' in MATLAB)") from None
        self._arrays: dict[str, npt.NDArray[Any]] = {}
        for name, value in variables.items():
            if not name.startswith("__"):
                self._collect(name, value)
        self.units = dict.fromkeys(self._arrays, "")

    def _collect(self, name: str, value: Any) -> None:
        if hasattr(value, "_fieldnames"):
            for field in value._fieldnames:  # noqa: SLF001 - the documented way to list the fields
                self._collect(f"{name}.{field}", getattr(value, field))
        elif isinstance(value, np.ndarray) and value.ndim == 1 and value.dtype.kind in "fiuc":
            self._arrays[name] = value

    def read(self, names: Sequence[str], gaps: Collection[str] = ()) -> Mapping[str, npt.NDArray[Any]]:
        return {name: self._arrays[name] for name in names}

    def _time(self, name: str) -> Array | None:
        """Return the times beside a field [s]; None if there are none."""
        structure = name
        while structure := structure.rpartition(".")[0]:
            for field, time in self._arrays.items():
                place, _, last = field.rpartition(".")
                if place == structure and rank("time", last) and time.size == self._arrays[name].size:
                    return time * (factor("time", unit_of("time", last) or "") or 1.0)
        return None

    def clock(self, name: str) -> Clock | None:
        time = self._time(name)
        return None if time is None else even_clock(time, f"the time beside {name}")

    def start(self, name: str) -> float | None:
        time = self._time(name)
        return None if time is None or not time.size else float(time[0])


def _since(start: Any, seconds: int) -> float:
    """Return the time of a TDMS time stamp after whole seconds since 1904 [s]; of none: that of 1904."""
    return float(start.seconds - seconds + start.second_fractions / 2**64) if start else float(-seconds)


class _Tdms(MeasurementSource):
    """TDMS file: ``CHANNEL``, or ``GROUP/CHANNEL`` where the name of the channel alone is not unique."""

    def __init__(self, path: Path) -> None:
        with extras.named():
            import nptdms

        self._path = path
        with nptdms.TdmsFile.read_metadata(path, raw_timestamps=True) as file:
            channels = [channel for group in file.groups() for channel in group.channels()]
            names = [channel.name for channel in channels]
            self._places = {
                channel.name if names.count(channel.name) == 1 else f"{channel.group_name}/{channel.name}": (
                    channel.group_name,
                    channel.name,
                )
                for channel in channels
            }
            about = dict(zip(self._places, (channel.properties for channel in channels), strict=True))
        self.units = {name: str(found.get("unit_string", "")) for name, found in about.items()}
        starts = {name: found["wf_start_time"] for name, found in about.items() if "wf_start_time" in found}
        newest = max((start.seconds for start in starts.values()), default=0)  # a double resolves times since it
        self._clocks = {
            name: Clock(
                float(found.get("wf_start_offset", 0.0)) + _since(starts.get(name), newest),
                float(found["wf_increment"]),
            )
            for name, found in about.items()
            if found.get("wf_increment")
        }

    def read(self, names: Sequence[str], gaps: Collection[str] = ()) -> Mapping[str, npt.NDArray[Any]]:
        import nptdms

        with nptdms.TdmsFile.open(self._path) as file:
            return {name: file[group][channel][:] for name in names for group, channel in [self._places[name]]}

    def clock(self, name: str) -> Clock | None:
        return self._clocks.get(name)


class _Mdf(MeasurementSource):
    """MDF file (versions 2 to 4): channels by name, the first of each."""

    def __init__(self, path: Path) -> None:
        with extras.named():
            import asammdf

        self._file = asammdf.MDF(path)
        self._places = {
            name: places[0]
            for name, places in self._file.channels_db.items()
            if self._file.masters_db.get(places[0][0]) != places[0][1]
        }
        self.units = {name: self._file.get_channel_unit(name, *place) for name, place in self._places.items()}

    def read(self, names: Sequence[str], gaps: Collection[str] = ()) -> Mapping[str, npt.NDArray[Any]]:
        return {name: self._file.get(name, *self._places[name], samples_only=True)[0] for name in names}

    def clock(self, name: str) -> Clock | None:
        time = self._file.get_master(self._places[name][0])
        return even_clock(np.asarray(time, np.float64), name)

    def start(self, name: str) -> float | None:
        time = self._file.get_master(self._places[name][0])
        return float(time[0]) if time.size else None


#: Readers by the name of their format.
FORMATS: Mapping[str, Callable[[Path], MeasurementSource]] = {
    "Parquet": _Parquet,
    "MATLAB": _Mat,
    "TDMS": _Tdms,
    "MDF": _Mdf,
}
