# SPDX-License-Identifier: Apache-2.0
"""Kernels printed as C: the bits of the engine where Python and C differ; the rest is refused by name."""

import ctypes
import subprocess
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from lathe_export.c_library import sources
from lathe_export.c_library.c_function import CFunction, wrapped
from lathe_export.c_library.c_types import FLOAT, ArrayType
from lathe_export.c_library.kernel_types import UnprintableError
from lathe_export.c_library.printer import Printer
from lathe_rc.arrays import put
from lathe_rc.jit import kernel

REAL = ArrayType(FLOAT, 1)
VALUES = np.array([-7.5, -3.0, -0.0, 0.0, 0.4, 2.0, 3.0, 7.5, 1e300, np.inf, -np.inf, np.nan])


class Pair(NamedTuple):
    """Two numbers by name."""

    low: float
    high: float


@kernel
def remainders(values, out):
    n = 0
    for one in range(-3, 4):
        for other in range(-3, 4):
            if other != 0:
                out[n], out[n + 1], out[n + 2] = one % other, one // other, one / other
                n += 3
    for k in range(values.size):
        for j in range(6):
            out[n], out[n + 1] = values[k] % values[j], values[k] // values[j]
            n += 2


@kernel
def choices(values, out):
    n = 0
    for k in range(values.size):
        for j in range(values.size):
            out[n], out[n + 1] = min(values[k], values[j]), max(values[k], values[j])
            n += 2
        out[n], out[n + 1], out[n + 2] = abs(values[k]), np.sign(values[k]), values[k] ** 3
        out[n + 3] = 1.0 if 0.0 <= values[k] < 3.0 and not np.isnan(values[k]) else -1.0
        out[n + 4] = np.searchsorted(values[:9], values[k], side="right") + 0.5 * np.searchsorted(values[:9], values[k])
        n += 5


@kernel
def places(values, out):
    for k in range(-3, 4):
        part = values[k : k + 5]
        out[k + 3] = part.size + (part[0] if part.size else 0.5)
        out[k + 10] = values[k - 1]
    out[-1] = values[-2]
    out[20:25] = values[:5]
    out[22:27] = out[20:25]
    out[27:] *= 3.0


@kernel
def rows(table, out):
    out[0] = table[0, 0] + table[0, 2] + table[1, 0] + table[1, out.size & 3]
    for k in range(8):
        out[k] = table[k & 1, k & 3]


@kernel
def loops(values, out):
    end, last = 3, 0
    for k in range(end):
        end = 9
        out[k] = end
        last = k
    for k in range(9, 3, -2):
        out[k] = k + last
    out[12] = k
    for k, value in enumerate(values[:4]):
        if k == 1:
            continue
        out[13 + k] = value
    a, b = 1.0, 2.0
    a, b = b, a + b
    out[17], out[18] = a, b
    while True:
        a += 1.0
        if a > 5.0:
            break
    out[19] = a


@kernel
def _made(values, scale):
    scaled = values[:8] * scale
    scaled[0] += 1.0
    return scaled


@kernel
def arrays(values, out):
    own = values
    for k in range(100):
        own = values.copy()
        own -= 2.0
        first = _made(own, 0.5)[0]
        own = own - first
        zeros, full = np.zeros(3), np.full(4, 2.5)
        out[k] = own[1] + zeros[1] + full[3]
    whole = values.copy()
    held = whole
    whole = whole + held * 2.0
    out[100 : 100 + whole.size] = whole
    both = np.concatenate((held, whole))
    out[120] = np.sum(both[:6])
    put(out[130:138], whole[:8].copy())


@kernel
def complexes(values, out):
    n = 0
    for k in range(8):
        one = complex(values[k], values[7 - k]) + 1.5
        other = complex(values[k] - 2.0, 0.25)
        for made in (one * other, one / other, one - 2.0 * other):
            out[n], out[n + 1] = made.real, made.imag
            n += 2


@kernel
def records(values, out):
    pair = Pair(values[0], values[1])
    out[0], out[1] = pair.high, pair.low
    both = (pair.low, 3)
    out[2] = both[0] * both[1]
    number = 2
    if values[0] > 0.0:
        number = 2.5
    out[3] = number / 2


KERNELS = [remainders, choices, places, loops, arrays, complexes, records]


def built(made, place):
    """A kernel of two arrays as a function of C, and the text of its file."""
    printer = Printer()
    root = printer.function(made.py_func, [REAL, REAL])
    functions = [CFunction(each, printer) for each in printer.needed(root)]
    bodies = [line for each in functions for line in (*each.body(), "")]
    heads = [f"{each.head()};" for each in functions]
    room = "room, " if root.takes_room else "(void)room, "
    call = f"void run(lathe_room *room, real_array one, real_array two) {{ {printer.name(root)}({room}one, two); }}"
    lines = ['#include "kernels.h"', *printer.declarations(), *heads, *bodies, call.replace("((void)room, ", "(")]
    text = "\n".join(part for line in lines for part in wrapped(line))
    templates = Path(sources.__file__).parents[1] / "templates" / "c_library"
    (place / "kernels.h").write_text((templates / "kernels.h").read_text())
    (place / "lathe.h").write_text("#include <stdint.h>\ntypedef struct { char *next, *end; int full; } lathe_room;\n")
    (place / "made.c").write_text(text)
    flags = ["-std=c99", "-O2", "-ffp-contract=off", "-Wall", "-Wextra", "-Werror", "-Wno-unused-parameter"]
    subprocess.run(["cc", *flags, "-shared", "-fPIC", "-o", "made.so", "made.c", "-lm"], cwd=place, check=True)
    return ctypes.CDLL(str(place / "made.so")).run, text


class _Array(ctypes.Structure):
    _fields_ = [("data", ctypes.c_void_p), ("size", ctypes.c_int64)]


@pytest.mark.parametrize("made", KERNELS, ids=lambda made: made.__name__)
def test_a_printed_kernel_has_the_bits_of_the_compiled_one(made, tmp_path):
    expected, found, room = np.arange(400.0), np.arange(400.0), np.zeros(400)
    made(VALUES, expected)
    run, text = built(made, tmp_path)
    begin = room.ctypes.data
    head = (ctypes.c_int64 * 3)(begin, begin + room.nbytes, 0)
    run(head, *(_Array(each.ctypes.data, each.size) for each in (VALUES, found)))
    assert found.tobytes() == expected.tobytes(), text
    assert head[0] == begin, "temporary arrays are given back"
    assert head[2] == 0


def test_an_index_of_a_row_binds_as_it_does_in_python():
    printer = Printer()
    text = "\n".join(CFunction(printer.function(rows.py_func, [ArrayType(FLOAT, 2), REAL]), printer).body())
    assert "table.data[0] + table.data[2] + table.data[table.columns] + table.data[table.columns + (" in text
    assert "table.data[(k & 1) * table.columns + (k & 3)]" in text


def test_nothing_is_written_once_the_memory_is_used_up(tmp_path):
    run, _ = built(arrays, tmp_path)
    out, room = np.arange(400.0), np.full(400, 7.0)
    begin = room.ctypes.data
    for size in range(0, 64, 8):
        head = (ctypes.c_int64 * 3)(begin, begin + 8 * size, 0)
        run(head, *(_Array(each.ctypes.data, each.size) for each in (VALUES, out)))
        assert head[2] & 1
        assert np.all(room[size:] == 7.0)


@kernel
def by_text(values, out):
    out[0] = len(f"{values[0]}")


@kernel
def by_unknown(values, out):
    out[0] = np.median(values)


@kernel
def _counted(out):
    out[0] += 1.0
    return out[0]


@kernel
def in_any_order(values, out):
    out[1] = _counted(out) - 2.0 * _counted(out)


@kernel
def one_of_two(values, out):
    number = values.size and out.size
    out[0] = number


@kernel
def by_else(values, out):
    for k in range(3):
        if values[k] > 0.0:
            break
    else:
        out[3] = 1.0


@kernel
def left_early(values, out):
    for value in (values[0], values[1]):
        if value > 0.0:
            break
        out[0] = value


@kernel
def by_inverse(values, out):
    out[0] = values[0] ** -1


@kernel
def called_twice(values, out):
    if 0.0 < _counted(out) < 2.0:
        out[2] = values[0]


@kernel
def from_a_loop(values, out):
    own = values
    for _ in range(3):
        put(out[:2], own)
        own = values.copy()
    put(out[:4], own)


@kernel
def of_two_types(values, out):
    one = 1.0
    if values[0] > 0.0:
        one = values
    put(out, one)


@pytest.mark.parametrize(
    ("made", "said"),
    [
        (by_text, r"^test_printer, line \d+: f'\{values\[0\]\}' cannot be printed as C$"),
        (by_unknown, r"^test_printer, line \d+: np.median\(values\) cannot be printed as C$"),
        (in_any_order, r"line \d+: _counted\(out\) - 2.0 \* _counted\(out\), whose order C leaves open, cannot be"),
        (one_of_two, r"line \d+: values.size and out.size as a value cannot be printed as C$"),
        (by_else, r"line \d+: the else of a loop cannot be printed as C$"),
        (left_early, r"line \d+: a loop over single values that is left early cannot be printed as C$"),
        (by_inverse, r"line \d+: values\[0\] \*\* \(-1\) cannot be printed as C$"),
        (called_twice, r"line \d+: 0.0 < _counted\(out\) < 2.0, which C would call twice, cannot be printed as C$"),
        (from_a_loop, r"line \d+: own, an array of a turn before, cannot be printed as C$"),
        (of_two_types, r"line \d+: one for values of types .* in one place cannot be printed as C$"),
    ],
)
def test_what_the_printer_does_not_know_is_refused_by_its_line(made, said, tmp_path):
    with pytest.raises(UnprintableError, match=said):
        built(made, tmp_path)
