# SPDX-License-Identifier: Apache-2.0
"""Compiling the steps of stages ahead of a run: once on a machine, on all cores.

Numba compiles one function at a time, so processes do it: each gets some stages and says when it is done with one.
What they have compiled is on the disk, where whoever runs the stages finds it.
"""

import contextlib
import json
import os
import queue
import subprocess
import sys
import threading
from collections.abc import Iterable, Iterator, Mapping

from lathe_rc.cell import native
from lathe_rc.cell.scenario import TABLES, kind_of
from lathe_rc.cell.stage import Stage, compile_kernels
from lathe_rc.cell.stages import STAGES
from lathe_rc.errors import InputError, LatheError
from lathe_rc.extensions import search_path

_REFUSED = "refused: "  # begins what a process says of a stage whose step cannot be compiled


def uncompiled(stages: Iterable[Stage]) -> list[Stage]:
    """Those whose steps nobody has compiled on this machine; of those that have the same one, the first."""
    known, found = native.compiled(), []
    for stage in stages:
        if stage.is_compiled and (name := stage.native().name) not in known:
            known.add(name)
            found.append(stage)
    return found


def compile_ahead(stages: Iterable[Stage]) -> Iterator[list[str]]:
    """Compile the steps that nobody has compiled.

    Yields:
        The names of the stages that are left, before the first and after each but the last.

    Raises:
        InputError: a step cannot be compiled.
        LatheError: a process that compiles has ended.
    """
    left = dict(enumerate(uncompiled(stages)))
    numbers, most = list(left), os.cpu_count() or 1
    done: queue.SimpleQueue[str] = queue.SimpleQueue()
    processes = [
        _start({number: left[number] for number in part}, done) for k in range(most) if (part := numbers[k::most])
    ]
    try:
        while left:
            yield [stage.name for stage in left.values()]
            told = done.get()
            if told.startswith(_REFUSED):
                raise InputError(told.removeprefix(_REFUSED))
            if not told:
                raise LatheError("a process that compiles the steps of stages has ended: see what it has written")
            del left[int(told)]
    finally:
        for process in processes:
            process.kill()
            process.wait()


def _start(stages: Mapping[int, Stage], done: "queue.SimpleQueue[str]") -> "subprocess.Popen[str]":
    """Start a process that compiles the steps of some stages; ``done`` gets their numbers, and nothing if it fails."""
    environment = os.environ | {"PYTHONPATH": search_path()}
    process = subprocess.Popen([sys.executable, "-m", __name__], stdin=-1, stdout=-1, text=True, env=environment)
    asked = [
        (number, stage.name, kind_of(stage.name, stage.shared.stage), stage.shared.model_dump())
        for number, stage in stages.items()
    ]

    def talk() -> None:
        assert process.stdin is not None, "it is a pipe"
        assert process.stdout is not None, "the same"
        with contextlib.suppress(BrokenPipeError), process.stdin as told:
            told.write(json.dumps(asked))
        for line in process.stdout:
            done.put(line.rstrip())
        if process.wait():
            done.put("")

    threading.Thread(target=talk, daemon=True).start()
    return process


def main() -> None:
    """Compile what the standard input names."""
    for number, name, kind, values in json.load(sys.stdin):
        stage = STAGES[kind](name, TABLES[kind].read(name, values))
        try:
            with stage.named():
                compile_kernels(stage)
        except InputError as error:
            print(f"{_REFUSED}{error}", flush=True)
        else:
            print(number, flush=True)


if __name__ == "__main__":
    main()
