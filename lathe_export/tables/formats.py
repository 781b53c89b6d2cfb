# SPDX-License-Identifier: Apache-2.0
"""File formats for exported tables, written in chunks."""

import json
import shutil
import zipfile
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO, Protocol

import numpy as np
import pyarrow as pa
from pyarrow import csv, parquet

from lathe_rc.blocks.columns import TEXT, Column
from lathe_rc.cell.frames import arrow_schema
from lathe_rc.errors import LatheError
from lathe_rc.messages import Samples

_MOST_TEXT = 4096  # longest string in an NPZ file [characters]; every element takes as much space as the longest one


class Rows(Protocol):
    """Table that is open for writing."""

    def write(self, rows: Mapping[str, Samples], /) -> None:
        """Append rows, given as arrays of shape (rows,) by column name."""

    def close(self) -> None:
        """Finish the table."""


class Format(ABC):
    """Base class of the export formats; all tables of a bag go to the same file or folder.

    Args:
        place: file or folder to create; must not exist yet.
    """

    folder = True  #: whether the output is a folder with one file per topic

    def __init__(self, place: Path) -> None:
        self.place = place

    @abstractmethod
    def table(self, topic: str, columns: Sequence[Column]) -> Rows:
        """Create the table of a topic."""

    def finish(self) -> None:  # noqa: B027 - most formats share no data between tables
        """Complete the data shared by the tables, after all tables are closed."""


class _ArrowRows:
    """Table written by a pyarrow writer."""

    def __init__(self, writer: Any, schema: Any) -> None:
        self._writer, self._schema = writer, schema

    def write(self, rows: Mapping[str, Samples]) -> None:
        """Append rows to the table."""
        arrays = [pa.array(array, field.type) for array, field in zip(rows.values(), self._schema, strict=True)]
        self._writer.write_batch(pa.RecordBatch.from_arrays(arrays, schema=self._schema))

    def close(self) -> None:
        """Finish the table."""
        self._writer.close()


def file_name(topic: str) -> str:
    """Return a topic as part of a file name; ROS topics have no dots."""
    return topic.strip("/").replace("/", ".")


class Csv(Format):
    """CSV format: one file per topic, units in the header, and enough digits to read back bit-identical values."""

    def table(self, topic: str, columns: Sequence[Column]) -> Rows:
        """Create the table of a topic."""
        schema = arrow_schema(columns, lambda column: column.label)
        path = self.place / f"{file_name(topic)}.csv"
        options = csv.WriteOptions(quoting_style="needed")
        return _ArrowRows(csv.CSVWriter(path, schema, write_options=options), schema)


class Parquet(Format):
    """Parquet format: one file per topic, with units in the metadata of the fields."""

    def table(self, topic: str, columns: Sequence[Column]) -> Rows:
        """Create the table of a topic."""
        schema = arrow_schema(columns, lambda column: column.name)
        path = self.place / f"{file_name(topic)}.parquet"
        return _ArrowRows(parquet.ParquetWriter(path, schema, compression="zstd"), schema)


class _Spool:
    """Temporary file for a column until all rows are known, since an archive member begins with its length."""

    def __init__(self, path: Path, column: Column) -> None:
        self._path, self._column = path, column
        self._rows, self._width = 0, 1
        path.touch(exist_ok=False)

    def add(self, values: Samples) -> None:
        """Append values, opening the file only briefly: a bag may have more columns than files may be open at once."""
        self._rows += values.size
        with self._path.open("ab") as file:
            if self._column.dtype != TEXT:
                file.write(np.ascontiguousarray(values, self._column.dtype.newbyteorder("<")).data)
                return
            for text in values:
                self._width = max(self._width, len(text))
                if self._width > _MOST_TEXT:
                    raise LatheError(
                        f"{self._column.name}: a text of {len(text)} characters; allowed in NPZ: up to {_MOST_TEXT} "
                        "(use --csv or --parquet)"
                    )
                file.write(json.dumps(text).encode() + b"\n")

    def copy_to(self, member: BinaryIO) -> None:
        """Write the column as a .npy file and remove the temporary file."""
        text = self._column.dtype == TEXT
        dtype = np.dtype(f"<U{self._width}") if text else self._column.dtype.newbyteorder("<")
        np.lib.format.write_array_header_1_0(
            member, {"descr": dtype.str, "fortran_order": False, "shape": (self._rows,)}
        )
        with self._path.open("rb") as file:
            if text:
                member.writelines(np.array(json.loads(line), dtype).tobytes() for line in file)
            else:
                shutil.copyfileobj(file, member, 2**20)
        self._path.unlink()


class _NpzRows:
    """Table of a topic whose columns are collected in temporary files for the archive."""

    def __init__(self, spools: Mapping[str, _Spool]) -> None:
        self._spools = spools

    def write(self, rows: Mapping[str, Samples]) -> None:
        """Append rows to the temporary files."""
        for name, values in rows.items():
            self._spools[name].add(values)

    def close(self) -> None:
        """Finish the table; nothing is left to do."""


class Npz(Format):
    """NumPy archive with one array per column, such as ``tool/error``; ``units`` lists pairs of name and unit."""

    folder = False

    def __init__(self, place: Path) -> None:
        super().__init__(place)
        self._spools: dict[str, _Spool] = {}
        self._units: list[tuple[str, str]] = []

    def table(self, topic: str, columns: Sequence[Column]) -> Rows:
        """Create the table of a topic."""
        spools = {}
        for column in columns:
            name = f"{topic.strip('/')}/{column.name}"
            spool = _Spool(self.place.with_name(f"column-{len(self._spools)}"), column)
            self._spools[name] = spools[column.name] = spool
            self._units.append((name, column.unit))
        return _NpzRows(spools)

    def finish(self) -> None:
        """Write the archive from the temporary files of the columns."""
        with zipfile.ZipFile(self.place, "x") as archive:
            # The ZipInfo object is created without a date, so that the same bag always gives an identical file.
            with archive.open(zipfile.ZipInfo("units.npy"), "w") as member:
                np.lib.format.write_array(member, np.array(self._units).reshape(-1, 2), allow_pickle=False)
            for name, spool in self._spools.items():
                with archive.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True) as member:
                    spool.copy_to(member)  # type: ignore[arg-type]  # typeshed: only IO[bytes]


FORMATS: Mapping[str, type[Format]] = {"csv": Csv, "parquet": Parquet, "npz": Npz}
