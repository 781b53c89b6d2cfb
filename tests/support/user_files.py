# SPDX-License-Identifier: Apache-2.0
"""Files as people bring them: tables in dialects, encodings and heads of other programs, sound or with a fault.

A sound file has the numbers of the plain one for every reader of its kind. A faulty one is refused in one line, with
its path, the number of its line where one line is at fault, and a cure.
"""

import functools
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.testing import assert_allclose

from lathe_commission import drive_measurement, hysteresis_fit, ilc, part_record, reduced_order
from lathe_explore.sweep.space import Space
from lathe_machine.control.predistortion import Predistortion
from lathe_machine.signals import measured_profile
from lathe_machine.signals.counts import CsvReader
from lathe_machine.stages.feed.trajectory import Trajectory, TrajectoryParameters
from lathe_papers.formulas import step_fit
from lathe_rc.analysis import measured_drive
from lathe_rc.arrays import Array
from lathe_rc.cell import cells_file, scenario
from lathe_rc.cell.scenario import Scenario
from lathe_rc.commands import measured
from lathe_rc.errors import InputError
from lathe_rc.signals import tachogram

Rows = list[list[str]]
Reader = Callable[[Path], list[Array]]
_LONGEST = 700  # characters of a refusal
_ANGLE = 2.0 * np.pi * np.arange(120) / 120


@dataclass(frozen=True)
class Kind:
    """Kind of file: its plain header, heads of other programs, numbers as text, and its readers."""

    header: str
    heads: tuple[str, ...]
    rows: Callable[[], Array]
    readers: tuple[Reader, ...]
    rising: bool = False  # a first column that repeats a value is refused


def _response(frequency: Array) -> Array:
    return 1.0 / (1.0 + 2j * 0.7 * frequency / 165.0 - (frequency / 165.0) ** 2)


def _points(response: object) -> list[Array]:
    return [response.frequency, response.value.real, response.value.imag]  # type: ignore[attr-defined]


def _of_parts() -> Array:
    return np.stack([np.degrees(_ANGLE), 1.5 + 200.25 * np.cos(2 * _ANGLE)], axis=1)


def _ri() -> Array:
    frequency = np.linspace(5.25, 505.5, 60)
    value = _response(frequency)
    return np.stack([frequency, value.real, value.imag, np.full(60, 0.995)], axis=1)


def _md() -> Array:
    frequency, real, imaginary, _ = _ri().T
    value = real + 1j * imaginary
    return np.stack([frequency, 20 * np.log10(np.abs(value)), np.degrees(np.angle(value))], axis=1)


def _record() -> Array:
    command = 10.5 * np.random.default_rng(1).normal(size=64)
    return np.stack([0.25 * np.arange(64), command, 1000.5 + 0.75 * np.roll(command, 1)], axis=1)


def _recorded(path: Path) -> list[Array]:
    record = measured.opened(path, [])
    command, response = record.read("command", "response")
    return [np.array(record.clock(None, "command", "response")), command, response]


def _fitted(path: Path) -> list[Array]:
    found = drive_measurement.frequency_response(measured.opened(path, []))
    assert found is not None
    return _points(found)


def _state(path: Path) -> list[Array]:
    ((frequency, value),) = measured_drive.read_points(path)
    return [frequency, value.real, value.imag]


def _form(path: Path) -> list[Array]:
    form = measured_profile.read_csv(path)
    return [form.angle, form.radius[0]]


def _parts(path: Path) -> list[Array]:
    (found,) = part_record.read(path, {})
    return [found.angle, found.radius]


def _counts(path: Path) -> list[Array]:
    return list(np.array([*CsvReader(path).read()], float).T)


def _course(path: Path) -> list[Array]:
    course = Trajectory("axis", TrajectoryParameters(trajectory="csv", trajectory_file=str(path))).course
    return [course.times, course.values]


def _path(path: Path) -> list[Array]:
    found = Predistortion.load(path)
    return [found.heights, found.offsets]


@functools.cache
def _piston() -> Scenario:
    return scenario.load("piston")


def _cells(path: Path) -> list[Array]:
    space = Space(given=cells_file.read(path))
    space.check(_piston())
    return [np.array([cell[name] for cell in space.given], float) for name in sorted(space.given[0])]


def _loop() -> Array:
    phase = 0.25 * np.arange(64)
    return np.stack([7.5 * np.sin(phase), 6.5 * np.sin(phase - 0.125)], axis=1)


def _wave(scale: float, middle: float = 0.0) -> Array:
    return np.stack([0.125 * np.arange(40), middle + scale * np.sin(np.arange(40))], axis=1)


def _even(step: float, count: int, first: float, rise: float) -> Array:
    return np.stack([step * np.arange(count), first + rise * np.arange(count)], axis=1)


def _rise() -> Array:
    return np.stack([0.25 * np.arange(64), 1 - np.exp(-0.125 * np.arange(64))], axis=1)


def _step(path: Path) -> list[Array]:
    found = drive_measurement.step_response(measured.opened(path, []))
    return [found.time, found.response]


def _channel(path: Path) -> list[Array]:
    found = reduced_order.of_measurement(measured.opened(path, []))
    return [found.time, found.response]


def _of_paper(path: Path) -> list[Array]:
    found = step_fit.read_csv(path)
    return [found.time, found.response]


def _hysteresis(path: Path) -> list[Array]:
    found = hysteresis_fit.of_measurement(measured.opened(path, []))
    return [found.command, found.displacement]


def _speed(path: Path) -> list[Array]:
    return [*tachogram.read(path)]


_RESPONSES: tuple[Reader, ...] = (_fitted, lambda path: _points(ilc.frequency_response(path).points), _state)
_RI = (
    "f,Re,Im,coh",
    "Frequency [Hz],Real,Imag,gamma^2",
    "f / Hz,Re(H),Im(H),γ²",
    "Frequenz (Hz),Realteil,Imaginärteil,Kohärenz",
)
_MD = ("f [Hz],|H| [dB],Phase [°]", "Frequency Hz,Magnitude dB,Phase deg", "freq (Hz),mag (dB),phase (deg)")
_RECORDS = (
    "t [ms],Command [µm],Response [µm]",
    "Time (ms),command um,response um",
    "time / ms,command / um,response / um",
)
_ANGLES = ("Winkel [°],radius [µm]", "angle (deg),radius (um)", "angle deg,radius um")
_SPEEDS = ("t [s],n [1/min]", "Time (s),Speed (rpm)", "time s,speed rpm")
_COUNTS = ("t [s],counts", "Time (s),Counts")
_CELLS = "tool.tolerance,learning_controller.lead_time"

KINDS = {
    "response": Kind("frequency_hz,real,imaginary,coherence", _RI, _ri, _RESPONSES),
    "magnitude": Kind("frequency_hz,magnitude_db,phase_deg", _MD, _md, _RESPONSES),
    "record": Kind("time_ms,command_um,response_um", _RECORDS, _record, (_recorded,)),
    "step": Kind("time_ms,response", ("t [ms],Response", "Zeit (ms),response"), _rise, (_step, _channel, _of_paper)),
    "loop": Kind("command_um,displacement_um", ("cmd [µm],Displacement [µm]",), _loop, (_hysteresis,)),
    "form": Kind("angle_deg,radius_um", _ANGLES, _of_parts, (_parts, _form)),
    "tachogram": Kind("time_s,rpm", _SPEEDS, lambda: _wave(10.25, 1000.5), (_speed,), rising=True),
    "counts": Kind("time_s,counts", _COUNTS, lambda: _even(0.125, 40, 0.0, 17.0), (_counts,)),
    "trajectory": Kind("time_s,position_um", ("t [s],Position [µm]",), lambda: _wave(10.25), (_course,), rising=True),
    "predistortion": Kind(
        "height_mm,offset_um", ("z [mm],offset (um)",), lambda: _even(0.5, 20, 0.25, 0.125), (_path,), rising=True
    ),
    "cells": Kind(_CELLS, (), lambda: np.stack([2e-6 + 1e-7 * np.arange(5), 1e-3 + 1e-4 * np.arange(5)], 1), (_cells,)),
}


@dataclass(frozen=True)
class UserFile:
    """File of a kind with a sound or faulty variation; ``line``: number of the line at fault, 0: none alone."""

    kind: str
    name: str
    content: bytes
    sound: bool
    line: int = 0


def _text(header: str, rows: Rows, mark: str = ",", decimal: str = ".") -> str:
    lines = [header.split(","), *rows]
    return "".join(
        mark.join(each.replace(".", decimal) if n else each for each in line) + "\n" for n, line in enumerate(lines)
    )


def _grouped(text: str, group: str, decimal: str) -> str:
    whole, point, rest = text.partition(".")
    return re.sub(r"(?<=\d)(?=(\d{3})+$)", group, whole) + (decimal + rest if point else "")


def _sound(kind: str, header: str, rows: Rows) -> Iterator[tuple[str, bytes]]:
    plain = _text(header, rows)
    german = _text(header, rows, ";", ",")
    yield "plain", plain.encode()
    yield "decimal comma", german.encode()
    yield "decimal comma, CP1252, CRLF", ("# 20 °C\n" + german).replace("\n", "\r\n").encode("cp1252")
    yield "tabulator, UTF-16", _text(header, rows, "\t").encode("utf-16")
    yield "UTF-8 with mark", plain.encode("utf-8-sig")
    yield "no last line end", plain.rstrip("\n").encode()
    yield "empty lines", plain.replace("\n", "\n\n").encode()
    yield (
        "quoted",
        "".join(",".join(f'"{each}"' for each in line.split(",")) + "\n" for line in plain.splitlines()).encode(),
    )
    yield "trailing mark", german.replace("\n", ";\n").encode()
    yield "trailing mark of rows", german.replace("\n", ";\n").replace(";\n", "\n", 1).encode()
    yield "plus and exponent", _text(header, [[f"{float(each):+.17E}" for each in row] for row in rows]).encode()
    if kind != "cells":
        yield "spaces", _text(header, rows, " ").encode()
        yield "savetxt", ("# " + plain).encode()
        yield (
            "preamble",
            ("Analyser 35670A;S/N 4711\nDate;2026-11-29 12:00\nRange;0 Hz;1600 Hz\n\n[Data]\n" + german).encode(),
        )
        yield "preamble, comma", ("Instrument: X200\nTime: 12:00:01, Date: 1/2/2026\nAverages,64\n" + plain).encode()
        if max(len(each.lstrip("-").partition(".")[0]) for row in rows for each in row) > 3 and kind != "counts":
            yield (
                "thousands",
                "\n".join(
                    ";".join(_grouped(each, ".", ",") if n else each for each in line.split(","))
                    for n, line in enumerate(plain.splitlines())
                ).encode(),
            )
        split = [re.fullmatch(r"(.*?)_(\w+)", each) for each in header.split(",")]
        if any(split):
            names = ",".join(m[1] if m else each for m, each in zip(split, header.split(","), strict=True))
            units = ",".join(m[2] if m else "" for m in split)
            yield "row of units", _text(f"{names}\n{units}", rows).encode()
            yield (
                "row of units in brackets",
                _text(f"{names}\n{','.join(f'[{u}]' if u else '[-]' for u in units.split(','))}", rows).encode(),
            )
        reverse = _text(",".join(header.split(",")[::-1]), [row[::-1] for row in rows])
        yield "columns in another order", reverse.encode()
        yield (
            "another column",
            "".join(f"{line},{'remark' if not n else 'x'}\n" for n, line in enumerate(plain.splitlines())).encode(),
        )


def _faulty(kind: str, header: str, rows: Rows) -> Iterator[tuple[str, str, int]]:
    middle, last = len(rows) // 2, len(rows) - 1

    def changed(row: int, column: int, to: str) -> str:
        return _text(
            header,
            [[to if (m, n) == (row, column) else each for n, each in enumerate(line)] for m, line in enumerate(rows)],
        )

    for name, to in {"empty cell": "", "NaN": "NaN", "infinite": "inf", "a word": "overload", "#NUM!": "#NUM!"}.items():
        gap = kind == "form" and name in ("empty cell", "NaN")  # of a record, not of a form
        if not gap and (kind, name) not in (("cells", "NaN"), ("cells", "infinite")):  # of a cell that fails
            yield name, changed(middle, 1, to), middle + 2
    yield "first row is no number", changed(0, 1, "x"), 2
    yield "torn last line", _text(header, rows).rsplit(",", 1)[0], last + 2
    yield "columns of unequal length", changed(last, 0, ""), last + 2
    yield "one value more", changed(middle, 1, "1,2"), middle + 2
    yield "no rows", _text(header, []), 0
    yield "no header", _text(header, rows).partition("\n")[2], 0
    if kind != "cells":
        few = 2 if kind == "response" else 1
        yield "a column is missing", _text(",".join(header.split(",")[:few]), [row[:few] for row in rows]), 0
    yield "empty", "", 0
    if kind != "cells":
        yield "names alone differ", _text(",".join(f"channel {n}" for n, _ in enumerate(header.split(","))), rows), 0
    yield "bytes after a loss of power", _text(header, rows) + "\0" * 4096, 0
    if kind != "cells":
        yield (
            "two decimal marks",
            _text(header, rows, ";", ",").replace(
                rows[middle][1].replace(".", ","), f"{float(rows[middle][1]):.3f}", 1
            ),
            0,
        )
    doubled = header.split(",")
    yield (
        "a name twice",
        _text(
            ",".join([doubled[0], *[doubled[1]] * (len(doubled) - 1)] if len(doubled) > 2 else [doubled[1]] * 2), rows
        ),
        0,
    )
    if KINDS[kind].rising:
        yield "a repeated value", changed(middle, 0, rows[middle - 1][0]), 0


def files(only: str = "") -> Iterator[UserFile]:
    """Yield the files of a kind or, without one, of all kinds; the first of a kind is plain."""
    for kind, about in KINDS.items():
        if only not in ("", kind):
            continue
        whole = kind == "counts"
        rows = [[f"{each:.0f}" if whole and n else f"{each:.9g}" for n, each in enumerate(row)] for row in about.rows()]
        for name, content in _sound(kind, about.header, rows):
            yield UserFile(kind, name, content, sound=True)
        for head in about.heads:
            heads = {
                "plain": _text(head, rows).encode(),
                "decimal comma, UTF-16": _text(head, rows, ";", ",").encode("utf-16"),
                "CP1252": _text(head.replace("γ²", "coh"), rows, "\t").encode("cp1252"),
            }
            for name, content in heads.items():
                yield UserFile(kind, f"{head} ({name})", content, sound=True)
        for name, text, line in _faulty(kind, about.header, rows):
            yield UserFile(kind, name, text.encode(), sound=False, line=line)


def _fault(path: Path, file: UserFile, plain: Path, read: Reader) -> str:
    """Return why a reader takes a file wrongly; empty if it does not."""
    try:
        found = read(path)
    except InputError as error:
        said = str(error)
        if said.startswith("row"):  # of --cells
            said = f"{path}:{int(said.split()[1]) + 1}: {said}"
        place = rf"{path.name}:{file.line}: " if file.line else path.name
        cured = re.search(rf"{place}.*\b(allowed|give|keep|check|name|remove|needs)\b", said)
        refused = len(said.splitlines()) == 1 and len(said) < _LONGEST and cured is not None
        return f"refused: {said}" if file.sound or not refused else ""
    except Exception as error:  # noqa: BLE001 - the find
        return repr(error)
    if not file.sound:
        return "read"
    try:
        for one, same in zip(found, read(plain), strict=True):
            assert_allclose(one, same, rtol=1e-12)
    except (AssertionError, ValueError) as error:
        return f"other numbers: {error}"
    return ""


def verdict(folder: Path, file: UserFile) -> str:
    """Return why a reader of its kind takes a file wrongly; empty if all take it rightly."""
    plain, path = folder / "plain.csv", folder / "given.csv"
    plain.write_bytes(next(files(file.kind)).content)
    path.write_bytes(file.content)
    return "; ".join(filter(None, (_fault(path, file, plain, read) for read in KINDS[file.kind].readers)))
