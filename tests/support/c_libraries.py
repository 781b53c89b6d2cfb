# SPDX-License-Identifier: Apache-2.0
"""C libraries of stages, built with the compiler of this machine and called by ctypes."""

import ctypes
import subprocess
from pathlib import Path

import numpy as np

DONE, INPUT, STOPPED, REFUSED = range(4)


def built(place: Path, *flags: str, compiler: str = "cc", main: Path | None = None) -> Path:
    """The example of an exported library, built as its CMake file does; ``flags`` go to the compiler."""
    name = _name(place)
    example = place / f"{name}_main"
    if main is not None:
        example, flags = place / f"{name}_{main.stem}", (*flags, f"-DCELL={name}", "-include", f"{place}/{name}.h")
    strict = ["-std=c11", "-O2", "-ffp-contract=off", "-Wall", "-Wextra", "-Wpedantic", "-Werror"]
    subprocess.run(
        [compiler, *strict, *flags, "-o", example, *_parts(place, name), main or place / "main.c", "-lm"], check=True
    )
    return example


def hostile(place: Path, tries: int, flips: int, *flags: str) -> str:
    """Output of hostile.c after bad inputs and flipped bits; the first one that is accepted fails."""
    program = built(place, *flags, f"-I{place}", main=Path(__file__).parent / "hostile.c")
    done = subprocess.run(
        [program, place / "reference.bin", str(tries), str(flips)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, f"{done.returncode}: {done.stdout}{done.stderr}"
    return done.stdout


def _name(place: Path) -> str:
    return next(path.stem for path in place.glob("*.h") if path.stem not in ("lathe", "kernels"))


def _parts(place: Path, name: str) -> list[Path]:
    return [place / "lathe.c", place / f"{name}.c", *sorted(place.glob("*_step.c"))]


_WATCHED = """
#include <stdint.h>
#include <stdlib.h>
#include <unistd.h>

extern void *__libc_malloc(size_t), *__libc_calloc(size_t, size_t), *__libc_realloc(void *, size_t);
extern void *__libc_memalign(size_t, size_t);
int __real_lathe_step(void *, int32_t, const void *const *, void *const *);
static int in_step;

static void check(void)
{
    if (in_step)
        _exit(9);
}

void *malloc(size_t n) { check(); return __libc_malloc(n); }
void *calloc(size_t n, size_t m) { check(); return __libc_calloc(n, m); }
void *realloc(void *p, size_t n) { check(); return __libc_realloc(p, n); }
void *aligned_alloc(size_t a, size_t n) { check(); return __libc_memalign(a, n); }

int __wrap_lathe_step(void *block, int32_t samples, const void *const *inputs, void *const *outputs)
{
    in_step = 1;
    ALLOCATION
    int status = __real_lathe_step(block, samples, inputs, outputs);
    in_step = 0;
    return status;
}
"""


def watched(place: Path, allocation: str = "") -> Path:
    """The example, which exits with 9 if a step allocates memory, as the C statement ``allocation`` in it does."""
    source = place / "watched.c.inc"
    source.write_text(_WATCHED.replace("ALLOCATION", allocation))
    return built(place, "-Wl,--wrap=lathe_step", "-x", "c", str(source), "-x", "none")


class Loaded:
    """A shared library with one block of state."""

    def __init__(self, place: Path, size: int) -> None:
        name = _name(place)
        library = place / f"lib{name}.so"
        shared = ["-shared", "-fPIC", "-Wl,-Bsymbolic", "-ftls-model=initial-exec", "-O2", "-ffp-contract=off"]
        if not library.exists():  # a library that is in use must not change
            subprocess.run(["cc", *shared, "-o", library, *_parts(place, name), "-lm"], check=True)
        self.c = ctypes.CDLL(str(library))
        self.c.lathe_get.restype = ctypes.c_double
        self.c.lathe_sample.restype = ctypes.c_int64
        self.c.lathe_reason_text.restype = self.c.lathe_reason_name.restype = ctypes.c_char_p
        self.c.lathe_restore.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_size_t]
        self._room = np.zeros(size + 64, np.uint8)
        self.block = ctypes.c_void_p(-(-self._room.ctypes.data // 64) * 64)
        self.cell = ctypes.byref(ctypes.c_char.in_dll(self.c, name))
        assert self.c.lathe_init(self.cell, self.block) == DONE

    def parameter(self, name: str) -> int:
        return int(self.c.lathe_find_parameter(self.cell, name.encode()))

    def set(self, name: str, value: float) -> int:
        return int(self.c.lathe_set(self.block, self.parameter(name), ctypes.c_double(value)))

    def step(self, inputs: list[np.ndarray], outputs: list[np.ndarray], first: int, samples: int) -> int:
        """Compute some samples."""
        tables = [
            (ctypes.c_void_p * max(len(arrays), 1))(*(array[first:].ctypes.data for array in arrays))
            for arrays in (inputs, outputs)
        ]
        return int(self.c.lathe_step(self.block, samples, *tables))
