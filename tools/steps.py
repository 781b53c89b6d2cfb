# SPDX-License-Identifier: Apache-2.0
"""Running the steps of the set-up: one at a time, visibly, each with a log, none left running."""

import fcntl
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from itertools import cycle
from pathlib import Path
from types import TracebackType

from workplace import HOME, LOG, ROOT, StepError, linked_home, say

TAIL = 15
TICK = 0.1


@contextmanager
def exclusive() -> Iterator[int]:
    """Hold the lock of .lathe/ and yield its descriptor.

    Each command of a step inherits it: if ./lathe is killed, the lock is held until that command has ended,
    and the next call does not tread on its feet.
    """
    link = ROOT / ".lathe"  # where ./lathe looks
    if linked_home(ROOT) not in (None, HOME):  # of another path, from which the checkout was moved or copied
        link.unlink()
    HOME.mkdir(parents=True, exist_ok=True)
    if not link.exists():
        link.symlink_to(HOME)
    with (HOME / "lock").open("a") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            say("another ./lathe is setting up here; waiting for it to end")
            fcntl.flock(lock, fcntl.LOCK_EX)
        yield lock.fileno()


def write_atomically(path: Path, text: str) -> None:
    """Write a file that is there either completely or not at all."""
    draft = path.with_name(path.name + ".draft")
    draft.write_text(text, encoding="utf-8")
    draft.replace(path)


def clear(*folders: Path) -> None:
    """Remove folders, whether they are there or not."""
    for folder in folders:
        if folder.exists():
            shutil.rmtree(folder)


class Step:
    """One step: used as a context, it shows its title, the time it takes and, when a command fails, why.

    Args:
        title: what the step makes, for the terminal.
        usual: how long it usually takes.
        advice: what to do if it fails.
        lock: descriptor of the lock, for the commands to inherit.
    """

    def __init__(self, title: str, usual: str, advice: str, lock: int) -> None:
        self.title = title
        self._usual = usual
        self._advice = advice
        self._lock = lock
        self._log = LOG / f"{title.replace(' ', '-')}.log"
        self._spinner = cycle("|/-\\")
        self._live = sys.stderr.isatty()

    def __enter__(self) -> "Step":
        self._start = time.monotonic()
        LOG.mkdir(parents=True, exist_ok=True)
        self._log.write_bytes(b"")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        verdict = "" if error is None else "  not finished"
        self._show(f"{verdict}\n")

    def run(self, *command: str | Path, environ: Mapping[str, str]) -> str:
        """Run a command, its output going to the log, and return that output.

        Raises:
            StepError: it failed.
        """
        with self._log.open("r+b") as log:
            start = log.seek(0, os.SEEK_END)
            process = subprocess.Popen(
                command,
                cwd=ROOT,
                env=environ,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                pass_fds=(self._lock,),
                start_new_session=True,
            )
            try:
                self._wait(process)
            except BaseException:
                with suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGTERM)
                process.wait()
                raise
            log.seek(start)
            output = log.read().decode(errors="replace")
        if process.returncode:
            raise StepError(self._failure(command[0], process.returncode, output))
        return output

    def _wait(self, process: "subprocess.Popen[bytes]") -> None:
        while process.poll() is None:
            if self._live:
                self._show(f"  {next(self._spinner)}")
            with suppress(subprocess.TimeoutExpired):
                process.wait(TICK)

    def _show(self, end: str) -> None:
        line = f"  {self.title:<20} (usually {f'{self._usual})':<14}{time.monotonic() - self._start:7.1f} s{end}"
        print(f"\r\x1b[K{line}" if self._live else line, end="", file=sys.stderr, flush=True)

    def _failure(self, program: str | Path, code: int, output: str) -> str:
        tail = "".join(f"  | {line}\n" for line in output.splitlines()[-TAIL:])
        return (
            f"{self.title}: {Path(program).name} failed with exit code {code}; its last lines:\n"
            f"{tail}  all of them: {self._log}\n  what to do: {self._advice}"
        )
