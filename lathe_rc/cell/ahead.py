# SPDX-License-Identifier: Apache-2.0
"""Compilation of the steps of stages before a run, once per computer, on all cores.

Numba compiles one function at a time, so several processes are used: each is sent some of the stages, and reports each
one that it has compiled. The compiled code is cached on disk, where later runs find it.
"""

import contextlib
import json
import os
import queue
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Iterable, Iterator

from lathe_rc import allowed_code
from lathe_rc.cell.kinds import STAGES
from lathe_rc.cell.program import compile_loop
from lathe_rc.cell.scenario import TABLES, kind_of
from lathe_rc.cell.stage import Stage, compile_kernels
from lathe_rc.compiled.step import is_kept
from lathe_rc.errors import InputError, LatheError
from lathe_rc.extensions import search_path
from lathe_rc.jit import can_keep

_REFUSED = "refused: "  # prefix of the answer for a stage whose step cannot be compiled


def uncompiled(stages: Iterable[Stage]) -> list[Stage]:
    """Return the stages whose steps are not compiled on this computer; of stages with equal steps, only the first."""
    # Reversed, so that the first of the stages with equal steps stays in the dictionary.
    steps = {stage.native().name: stage for stage in reversed(list(stages)) if stage.is_compiled}
    return [stage for name, stage in reversed(steps.items()) if not is_kept(name)]


def compile_ahead(stages: Iterable[Stage]) -> Iterator[list[str]]:
    """Compile those steps of stages that are not yet compiled on this computer.

    Yields:
        The names of the remaining stages, before the first compilation and after each but the last.

    Raises:
        InputError: a step cannot be compiled.
        LatheError: a compiling process has exited.
    """
    # The longest steps come first, so that all processes end at about the same time; larger memory means a longer step.
    missing = sorted(uncompiled(stages), key=lambda stage: -stage.native().words.size)
    numbered = enumerate(missing if missing and can_keep() else [])
    waiting = deque(numbered)
    left = {number: stage.name for number, stage in waiting}
    done: queue.SimpleQueue[tuple[int, str]] = queue.SimpleQueue()
    processes = [_start() for _ in range(min(os.cpu_count() or 1, len(left)))]
    for process in processes:
        threading.Thread(target=_have_compiled, args=(process, waiting, done), daemon=True).start()
    try:
        if left:
            compile_loop()  # while the processes compile the steps
        while left:
            yield list(left.values())
            number, told = done.get()
            if told.startswith(_REFUSED):
                raise InputError(told.removeprefix(_REFUSED))
            if not told:
                raise LatheError("a process that compiles the steps of stages has ended: see what it has written")
            del left[number]
    finally:
        for process in processes:
            process.kill()
            process.wait()


def _start() -> "subprocess.Popen[str]":
    """Start a process that compiles the steps of the stages named on its standard input."""
    environment = os.environ | {"PYTHONPATH": search_path()}
    command = [*allowed_code.interpreter(__name__), *allowed_code.arguments()]
    return subprocess.Popen(command, stdin=-1, stdout=-1, text=True, env=environment)


def _have_compiled(
    process: "subprocess.Popen[str]", waiting: deque[tuple[int, Stage]], done: "queue.SimpleQueue[tuple[int, str]]"
) -> None:
    """Send stages to a process one by one; ``done`` receives the answers, or an empty one if the process has exited."""
    assert process.stdin is not None, "it is a pipe"
    assert process.stdout is not None, "the same"
    with contextlib.suppress(IndexError):  # no more stages are waiting
        while True:
            number, stage = waiting.popleft()
            asked = stage.name, kind_of(stage.name, stage.shared.stage), stage.shared.model_dump()
            told = ""
            with contextlib.suppress(BrokenPipeError):
                print(json.dumps(asked), file=process.stdin, flush=True)
                # Empty at the end of the stream: the process has ended.
                told = process.stdout.readline().rstrip()
            done.put((number, told))


def main() -> None:
    """Compile the stages named on standard input, one per line."""
    allowed_code.taken_from(sys.argv[1:])
    for line in sys.stdin:
        name, kind, values = json.loads(line)
        stage = STAGES[kind](name, TABLES[kind].read(name, values))
        try:
            with stage.named():
                compile_kernels(stage)
        except InputError as error:
            print(f"{_REFUSED}{error}", flush=True)
        else:
            print("compiled", flush=True)


if __name__ == "__main__":
    main()
