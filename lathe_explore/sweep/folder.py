# SPDX-License-Identifier: Apache-2.0
"""Folder of a sweep: the varied cell, the requested spaces, and the rows as a Parquet data set.

DIR/scenario.yaml    the cell, as given
DIR/sweep.json       identity of the cell, measures, and the spaces or the request of a tuning
DIR/rows/*.parquet   one row per cell, see `lathe_explore.sweep.row`; all files have the same columns

Each of these files has a checksum, which is verified on reading; files of older versions have none.

A further varied parameter adds a column to all rows. Its request is written first; then all files of rows are written
anew beside the old ones, and replace them at once. A process that is killed in between leaves the old rows, and the
next command continues.
"""

import io
import json
import os
import shutil
from collections.abc import Collection, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, cast

import filelock
import pyarrow as pa
import pyarrow.compute
import pyarrow.parquet
import pydantic

from lathe_explore.sweep import NUMBERS, inputs, row
from lathe_explore.sweep.description import Description, describe
from lathe_explore.sweep.row import Measure
from lathe_explore.sweep.space import Space
from lathe_rc import files
from lathe_rc.cell import scenario as scenarios
from lathe_rc.cell.parameters import Value
from lathe_rc.cell.scenario import Scenario
from lathe_rc.errors import InputError, LatheError, shown

_FORMAT = 1
_WRITING = "write.lock"  # held while one of the files is written
_COMPUTING = "lock"  # held by a sweep that computes into the folder
_ROWS, _NEW, _OLD = "rows", "rows.new", "rows.old"
_MOST = 2**30  # largest size of a file of rows [B]


@dataclass(frozen=True)
class Request:
    """Request of a tuning (`lathe_explore.sweep.tune`); ``targets`` are the columns of its parameters."""

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
    description: Description | None = None  # files of older versions have none, nor inputs
    inputs: dict[str, str] = field(default_factory=dict)


class Folder:
    """Sweep on disk.

    Args:
        path: folder of the sweep.

    Attributes:
        path: see the argument.
        name: name of the varied cell.
        measures: further columns of the rows.
        spaces: requested spaces, in order.
        tuning: request of a tuning; None for a plain sweep.
        inputs: third-party classes and files that the rows were computed with, see `lathe_explore.sweep.inputs`.

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
        self._told, self.name, self.inputs = told, told.name, told.inputs
        self.measures, self.spaces, self.tuning = told.measures, told.spaces, told.tuning

    @cached_property
    def scenario(self) -> Scenario:
        """The varied cell; in contrast to the rest it needs the files and the code that the cell names.

        Raises:
            InputError: the cell is not the one that the rows were computed with, or its code or files are missing.
        """
        found = replace(scenarios.load(self.path / "scenario.yaml"), name=self.name)
        if changed := self.changes(found):
            raise InputError(f"{self.path}: {changed[0]}; allowed: as it was, or a new folder")
        if found.identity != self._told.identity:
            raise InputError(
                f"{self.path}: its scenario has changed, or a file that it names; allowed: as it was, or a new folder"
            )
        return found

    @cached_property
    def description(self) -> Description:
        """Description of the varied cell."""
        return self._told.description or describe(self.scenario, self.targets, self.measures)

    def changes(self, scenario: Scenario) -> list[str]:
        """Return the third-party classes and files of a cell that have changed since the rows were computed."""
        return inputs.changes(self.inputs, inputs.of_cell(scenario))

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
        # A sweep that computes into the folder has a fixed set of columns; that of a tuning never changes.
        with locked(path / _WRITING), nullcontext() if tuning else locked(path / _COMPUTING, wait=False):
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
            if changed := scenarios.differences(there.scenario, scenario):
                more = f", and {len(changed) - 1} more" if len(changed) > 1 else ""
                raise InputError(f"{path} holds a sweep of another cell: {changed[0]}{more}; allowed: a new folder")
            if there.measures != list(measures):
                named = ", ".join(each.name for each in there.measures) or "nothing"
                raise InputError(f"{path}: measures {named} beside the rest; allowed: the same, or a new folder")
            if there.tuning != tuning:
                raise InputError(f"{path} holds {_difference(there.tuning, tuning)}; allowed: a new folder")
        if space is not None and (space := Space(**space.to_json())) not in spaces:
            spaces.append(space)
        used = inputs.of_cell(scenario, measures)
        used |= inputs.of_spaces(scenario, [*spaces, *([tuning.over] if tuning else [])], tuning.free if tuning else {})
        if not new and (differing := inputs.changes(there.inputs, used)):
            raise InputError(f"{path}: {differing[0]}; allowed: as it was, or a new folder")
        # scenario.yaml is written first: a folder with a sweep.json is complete.
        contents = _Contents(_FORMAT, scenario.name, scenario.identity, list(measures), spaces, tuning)
        about = describe(scenario, _targets(spaces, tuning), measures)
        row.schema(about.targets, _carried(spaces), measures)  # rejects a carried column of that name
        told = asdict(replace(contents, description=about, inputs=used))
        with writing(path):
            if new:
                with files.replacing(path / "scenario.yaml") as stream:
                    stream.write(files.sealed(scenario.to_yaml(given=True).encode() + b"# " + files.ROOM + b"\n"))
            with files.replacing(path / "sweep.json") as stream:
                stream.write(files.sealed(json.dumps(told | {"checksum": files.ROOM.decode()}, indent=1).encode()))
            found = Folder(path)
            found._conform()
        return found

    def locked(self, *, wait: bool = False) -> AbstractContextManager[None]:
        """Lock the folder, so that no other process computes into it.

        Args:
            wait: whether to wait until another process releases the lock.

        Raises:
            InputError: another process holds the lock, and ``wait`` is false.
        """
        return locked(self.path / _COMPUTING, wait=wait)

    @property
    def targets(self) -> list[str]:
        """Parameters that differ between the cells."""
        return _targets(self.spaces, self.tuning)

    @property
    def numbers(self) -> list[str]:
        """Columns of numbers that a goal can have."""
        targets = (name for name, target in self.description.targets.items() if target.is_number)
        return [*NUMBERS, *(each.name for each in self.measures), *targets]

    @property
    def carried(self) -> list[str]:
        """Columns of given cells that are no parameters."""
        return _carried(self.spaces)

    @cached_property
    def schema(self) -> pa.Schema:
        """Arrow schema of the rows."""
        return row.schema(self.description.targets, self.carried, self.measures)

    def versions(self) -> dict[str, str]:
        """Return the version of lathe_rc that computed each cell, by key."""
        found = self._read(["key", "version"])
        return dict(zip(found.column("key").to_pylist(), found.column("version").to_pylist(), strict=True))

    def table(self, columns: Sequence[str] | None = None) -> pa.Table:
        """Return the table of rows in cell order.

        Args:
            columns: columns to read; None: all columns.
        """
        found = self._read(None if columns is None else list(dict.fromkeys(["cell", *columns]))).sort_by("cell")
        return found if columns is None else found.select(list(columns))

    def _read(self, columns: Sequence[str] | None) -> pa.Table:
        whole = self.schema.empty_table()
        whole = whole if columns is None else whole.select(list(columns))
        return pa.concat_tables([whole, *(self._rows(path, columns) for path in self._paths())])

    def _paths(self) -> list[Path]:
        """Return the files of rows; a process killed between the two renames of `_conform` leaves only the new ones."""
        place = next((path for name in (_ROWS, _NEW) if (path := self.path / name).exists()), None)
        with _reading(self.path):
            return sorted(path for path in place.iterdir() if path.suffix == ".parquet") if place else []

    def _rows(self, path: Path, columns: Sequence[str] | None) -> pa.Table:
        """Return the rows of one Parquet file."""
        content = pa.BufferReader(_read(path))
        try:
            names = pyarrow.parquet.read_schema(content).names
            if missing := [name for name in row.HEAD if name not in names]:
                raise InputError(f"{path}: no rows of a sweep: without the column {missing[0]}; allowed: without it")
            content.seek(0)
            if set(names) >= set(self.schema.names):
                names = columns and list(columns)
                return pyarrow.parquet.read_table(content, columns=names, schema=self.schema)
            found = self._completed(pyarrow.parquet.read_table(content, schema=self.schema))
        except (pa.ArrowException, OSError) as error:
            raise InputError(f"{path}: no rows of a sweep ({shown(error)}); allowed: without it") from None
        return found if columns is None else found.select(list(columns))

    def _completed(self, found: pa.Table) -> pa.Table:
        """Return rows with the values of the parameters that were not varied when these cells were computed."""
        if not self.targets:
            return found
        rows = []
        for each in found.select([*self.targets, "seed"]).to_pylist():
            known = each
            with suppress(InputError):  # a cell that the scenario does not accept has only the values of its request
                known = each | row.effective(self.scenario.varied(_given(each)), self.targets)
            rows.append(known)
        values = pa.Table.from_pylist(rows, pa.schema([self.schema.field(name) for name in (*self.targets, "seed")]))
        for name in self.targets:
            found = found.set_column(self.schema.names.index(name), self.schema.field(name), values.column(name))
        return found

    def forget(self, keys: Collection[str]) -> None:
        """Remove the rows with these keys.

        Raises:
            LatheError: the files cannot be written; existing rows are preserved.
        """
        if keys:
            with locked(self.path / _WRITING), writing(self.path):
                self._conform(keys)

    def _conform(self, without: Collection[str] = ()) -> None:
        """Write all rows anew if some have not all columns, or some are to be left out; call it with the lock held."""
        place, new, old = (self.path / name for name in (_ROWS, _NEW, _OLD))
        if not place.exists() and new.exists():  # between the two renames below
            new.rename(place)
        place.mkdir(exist_ok=True)
        for left in (new, old):
            shutil.rmtree(left, ignore_errors=True)
        if not without and all(_columns(path) == self.schema.names for path in self._paths()):
            return
        kept = ~pyarrow.compute.field("key").isin(pa.array(list(without), pa.string()))
        try:
            new.mkdir()
            for path in self._paths():
                with files.replacing(new / path.name) as stream:
                    stream.write(_parquet(self._rows(path, None).filter(kept)))
        except BaseException:
            shutil.rmtree(new, ignore_errors=True)  # a full disk gets its room back
            raise
        place.rename(old)
        new.rename(place)
        shutil.rmtree(old, ignore_errors=True)

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
        return _given({name: found[name] for name in [*self.targets, "seed"]})

    def write(self, rows: Sequence[pa.Table]) -> None:
        """Write rows as one additional Parquet file.

        Raises:
            LatheError: the file cannot be written; existing rows are preserved.
        """
        place = self.path / _ROWS
        with locked(self.path / _WRITING), writing(self.path):
            taken = [int(path.stem) for path in place.glob("*.parquet") if path.stem.isdigit()]
            with files.replacing(place / f"{max(taken, default=-1) + 1:06d}.parquet") as stream:
                stream.write(_parquet(pa.concat_tables(rows)))


def _targets(spaces: Sequence[Space], tuning: Request | None) -> list[str]:
    tuned = tuning.targets if tuning else ()
    named = [*tuned, *(target for space in spaces for target in space.targets())]
    return [target for target in dict.fromkeys(named) if target != "seed"]


def _carried(spaces: Sequence[Space]) -> list[str]:
    return list(dict.fromkeys(name for space in spaces for name in space.carried))


def _given(values: dict[str, Any]) -> dict[str, Value]:
    """Return the values that a row has."""
    return {name: value for name, value in values.items() if value is not None}


def _columns(path: Path) -> list[str]:
    try:
        with _reading(path):
            return list(pyarrow.parquet.read_schema(path).names)
    except pa.ArrowException as error:
        raise InputError(f"{path}: no rows of a sweep ({shown(error)}); allowed: without it") from None


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
            raise InputError(f"{path.parent}: another program computes into it; allowed: one at a time") from None
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
