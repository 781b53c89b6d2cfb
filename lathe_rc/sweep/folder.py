# SPDX-License-Identifier: Apache-2.0
"""Folder of a sweep: the varied cell, the requested spaces, and the rows as a Parquet data set.

DIR/scenario.yaml    the cell, as given
DIR/sweep.json       identity of the cell, measures, and the spaces or the request of a tuning
DIR/rows/*.parquet   one row per cell, see `lathe_rc.sweep.row`

Each of these files has a checksum, which is verified on reading; files of older versions have none.
"""

import io
import json
import os
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, cast

import filelock
import pyarrow as pa
import pyarrow.compute
import pyarrow.parquet
import pydantic

from lathe_rc import files
from lathe_rc.cell import scenario as scenarios
from lathe_rc.cell.parameters import Value
from lathe_rc.cell.scenario import Scenario
from lathe_rc.errors import InputError, LatheError, shown
from lathe_rc.sweep import row
from lathe_rc.sweep.row import Measure
from lathe_rc.sweep.space import Space

_FORMAT = 1
_WRITING = "write.lock"  # held while one of the files is written
_MOST = 2**30  # largest size of a file of rows [B]


@dataclass(frozen=True)
class Request:
    """Request of a tuning (`lathe_rc.sweep.tune`); ``targets`` are the columns of its parameters."""

    targets: list[str]
    free: dict[str, str | list[Value]]
    goals: list[str]
    subjects: list[str]
    percentile: float
    over: Space
    sampler: str
    seed: int
    batch: int
    formulas: bool


@dataclass(frozen=True)
class _Contents:
    """Content of a sweep.json file, see `Folder`."""

    format: int
    name: str
    identity: str
    measures: list[Measure]
    spaces: list[Space]
    tuning: Request | None = None


class Folder:
    """Sweep on disk.

    Args:
        path: folder of the sweep.

    Attributes:
        path: see the argument.
        scenario: the varied cell.
        measures: further columns of the rows.
        spaces: requested spaces, in order.
        tuning: request of a tuning; None for a plain sweep.

    Raises:
        InputError: the folder is not a sweep folder.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        if not os.path.lexists(path / "sweep.json"):
            raise InputError(f"{path} holds no sweep; allowed: a folder that lathe sweep has written")
        told = _contents(path / "sweep.json")
        if told.format != _FORMAT:
            raise InputError(f"{path}: format {told.format} of another lathe_rc; allowed: {_FORMAT}")
        _read(path / "scenario.yaml")
        self.scenario = replace(scenarios.load(path / "scenario.yaml"), name=told.name)
        if self.scenario.identity != told.identity:
            raise InputError(
                f"{path}: its scenario has changed, or a file that it names; allowed: as it was, or a new folder"
            )
        self.measures, self.spaces, self.tuning = told.measures, told.spaces, told.tuning

    @staticmethod
    def begin(
        path: Path,
        scenario: Scenario,
        space: Space | None,
        measures: Sequence[Measure],
        tuning: Request | None = None,
    ) -> "Folder":
        """Open the sweep or tuning in a folder, and add a space; a missing folder is created.

        Raises:
            InputError: the folder has other contents.
            LatheError: the folder cannot be written.
        """
        if not (path / _WRITING).exists():  # otherwise another process has just created it
            _refuse_others(path)
        with writing(path):
            path.mkdir(parents=True, exist_ok=True)
        with locked(path / _WRITING):
            _refuse_others(path)
            return Folder._with(path, scenario, space, measures, tuning)

    @staticmethod
    def _with(
        path: Path, scenario: Scenario, space: Space | None, measures: Sequence[Measure], tuning: Request | None
    ) -> "Folder":
        new = not os.path.lexists(path / "sweep.json")
        spaces = []
        if not new:
            there = Folder(path)
            spaces = there.spaces
            if there.scenario.to_yaml(given=True) != scenario.to_yaml(given=True):
                raise InputError(f"{path} holds a sweep of another cell ({there.scenario.name}); allowed: a new folder")
            if there.measures != list(measures):
                named = ", ".join(each.name for each in there.measures) or "nothing"
                raise InputError(f"{path}: measures {named} beside the rest; allowed: the same, or a new folder")
            if there.tuning != tuning:
                raise InputError(f"{path} holds {_difference(there.tuning, tuning)}; allowed: a new folder")
        if space is not None and (space := Space(**space.to_json())) not in spaces:
            spaces.append(space)
        # scenario.yaml is written first: a folder with a sweep.json is complete.
        told = asdict(_Contents(_FORMAT, scenario.name, scenario.identity, list(measures), spaces, tuning))
        with writing(path):
            (path / "rows").mkdir(parents=True, exist_ok=True)
            if new:
                with files.replacing(path / "scenario.yaml") as stream:
                    stream.write(files.sealed(scenario.to_yaml(given=True).encode() + b"# " + files.ROOM + b"\n"))
            with files.replacing(path / "sweep.json") as stream:
                stream.write(files.sealed(json.dumps(told | {"checksum": files.ROOM.decode()}, indent=1).encode()))
        return Folder(path)

    def locked(self, *, wait: bool = False) -> AbstractContextManager[None]:
        """Lock the folder, so that no other process computes into it.

        Args:
            wait: whether to wait until another process releases the lock.

        Raises:
            InputError: another process holds the lock, and ``wait`` is false.
        """
        return locked(self.path / "lock", wait=wait)

    @property
    def targets(self) -> list[str]:
        """Parameters that differ between the cells."""
        tuned = self.tuning.targets if self.tuning else ()
        named = [*tuned, *(target for space in self.spaces for target in space.targets())]
        return [target for target in dict.fromkeys(named) if target != "seed"]

    @property
    def schema(self) -> pa.Schema:
        """Arrow schema of the rows."""
        return row.schema(self.scenario, self.targets, self.measures)

    def keys(self) -> set[str]:
        """Return the keys of all computed cells."""
        return set(self._read(["key"]).column("key").to_pylist())

    def table(self, columns: Sequence[str] | None = None) -> pa.Table:
        """Return the table of rows in cell order.

        Args:
            columns: columns to read; None: all columns.
        """
        found = self._read(None if columns is None else list(dict.fromkeys(["cell", *columns])))
        for target in self.targets:
            # Cells computed before a target was first varied have the scenario's value of that target.
            if target in found.column_names and found.column(target).null_count:
                field = found.schema.field(target)
                filled = pyarrow.compute.coalesce(
                    found.column(target), pa.scalar(self.scenario.value(target), field.type)
                )
                found = found.set_column(found.column_names.index(target), field, filled)
        found = found.sort_by("cell")
        return found if columns is None else found.select(list(columns))

    def _read(self, columns: Sequence[str] | None) -> pa.Table:
        place, whole = self.path / "rows", self.schema.empty_table()
        whole = whole if columns is None else whole.select(list(columns))
        with _reading(place):
            paths = sorted(path for path in place.iterdir() if path.suffix == ".parquet") if place.exists() else []
        return pa.concat_tables([whole, *(self._rows(path, columns) for path in paths)])

    def _rows(self, path: Path, columns: Sequence[str] | None) -> pa.Table:
        """Return the rows of one Parquet file."""
        content = pa.BufferReader(_read(path))
        try:
            names = pyarrow.parquet.read_schema(content).names
            if missing := [name for name in row.HEAD if name not in names]:
                raise InputError(f"{path}: no rows of a sweep: without the column {missing[0]}; allowed: without it")
            content.seek(0)
            return pyarrow.parquet.read_table(content, columns=columns and list(columns), schema=self.schema)
        except (pa.ArrowException, OSError) as error:
            raise InputError(f"{path}: no rows of a sweep ({shown(error)}); allowed: without it") from None

    def row(self, number: int) -> dict[str, Any]:
        """Return the row of a cell, by column.

        Raises:
            InputError: the cell does not exist, or is not computed yet.
        """
        found = self.table().filter(pyarrow.compute.field("cell") == number).to_pylist()
        if not found:
            last = max(self._read(["cell"]).column("cell").to_pylist(), default=None)
            known = f"0 to {last}, of those that are computed" if last is not None else "none: nothing is computed"
            raise InputError(f"cell {number} of {self.path}; allowed: {known}")
        return cast("dict[str, Any]", found[0])

    def values(self, number: int) -> dict[str, Value]:
        """Return the varied values of a cell, by target.

        Raises:
            InputError: the cell does not exist, or is not computed yet.
        """
        found = self.row(number)
        values = {target: found[target] for target in self.targets}
        return values if found["seed"] in (None, self.scenario.shared.seed) else {**values, "seed": found["seed"]}

    def write(self, rows: Sequence[pa.Table]) -> None:
        """Write rows as one additional Parquet file.

        Raises:
            LatheError: the file cannot be written; existing rows are preserved.
        """
        place = self.path / "rows"
        # Several processes may compute a tuning, so without the lock two files could get the same number.
        with locked(self.path / _WRITING), writing(self.path):
            taken = [int(path.stem) for path in place.glob("*.parquet") if path.stem.isdigit()]
            with files.replacing(place / f"{max(taken, default=-1) + 1:06d}.parquet") as stream:
                stream.write(_parquet(pa.concat_tables(rows)))


def _parquet(rows: pa.Table) -> bytes:
    """Return a Parquet file with a checksum of the complete file in its metadata.

    For other programs, the file's pages also have the standard checksums, which do not cover the rest of the file.
    """
    content = io.BytesIO()
    with pyarrow.parquet.ParquetWriter(content, rows.schema, compression="zstd", write_page_checksum=True) as writer:
        writer.write_table(rows)
        writer.add_key_value_metadata({"checksum": files.ROOM.decode()})
    return files.sealed(content.getvalue())


def _contents(path: Path) -> _Contents:
    try:
        return pydantic.TypeAdapter(_Contents).validate_json(_read(path))
    except pydantic.ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(each) for each in first["loc"])
        told = f"{where}: {first['msg']}" if where else first["msg"]
        raise InputError(f"{path}: not written by lathe sweep or lathe tune ({shown(told)})") from None


def _read(path: Path) -> bytes:
    """Return the content of a file of a sweep, after verifying its checksum.

    Raises:
        InputError: the file cannot be read, or is damaged.
    """
    try:
        with _reading(path):
            content = files.contents(path, _MOST)
        files.unsealed(content, needed=False)
    except files.DamagedError as error:
        cure = "; without it, a sweep computes its cells again" if path.suffix == ".parquet" else ""
        raise InputError(f"{path}: damaged ({error}); allowed: as it was written{cure}") from None
    return content


def _refuse_others(path: Path) -> None:
    """Reject an existing path that is not a sweep folder."""
    if not os.path.lexists(path):
        return
    with _reading(path):
        names = {each.name for each in path.iterdir()} if path.is_dir() else {""}
    if "sweep.json" not in names and not names <= {"lock", _WRITING}:
        raise InputError(f"{path} holds something else than a sweep; allowed: a new folder, or that of a sweep")


@contextmanager
def locked(path: Path, *, wait: bool = True) -> Iterator[None]:
    """Hold the lock of a file within the block.

    Raises:
        InputError: the file cannot be created, or, without ``wait``, another process holds the lock.
    """
    lock = filelock.FileLock(path)
    with _reading(path):
        try:
            lock.acquire(blocking=wait)
        except filelock.Timeout:
            raise InputError(f"{path.parent}: another sweep computes into it; allowed: one at a time") from None
    try:
        yield
    finally:
        lock.release()


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Convert a read error into a one-line error."""
    try:
        yield
    except OSError as error:
        raise InputError(f"{error.filename or path}: {error.strerror or shown(error)}") from None


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Convert an error in writing to a folder into a one-line error.

    Raises:
        LatheError: an operation in the block failed.
    """
    try:
        yield
    except OSError as error:
        raise LatheError(
            f"{path}: {error.strerror or shown(error)}; what was written before is kept: once there is room, the same "
            "command goes on from it"
        ) from None


def _difference(there: Request | None, asked: Request | None) -> str:
    """Describe the first difference between the content of a folder and a request."""
    if there is None or asked is None:
        return "a sweep" if there is None else "a tuning"
    one, other = asdict(there), asdict(asked)
    name = next(name for name in one if one[name] != other[name])
    return f"a tuning with {name} {shown(json.dumps(one[name]))}, not {shown(json.dumps(other[name]))}"
