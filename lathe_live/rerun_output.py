# SPDX-License-Identifier: Apache-2.0
"""Destination of a view: a file, a window, a page for the browser, or a running viewer."""

import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote, urlsplit

from lathe_rc import allowed_code, extras
from lathe_rc.cell.beside import RerunOutput
from lathe_rc.errors import InputError, LatheError

if TYPE_CHECKING:
    import rerun as rr

_HOST = "127.0.0.1"
_START = 30.0  # [s] allowed for a viewer to start
_POLL = 0.05  # [s] between attempts to reach the viewer


def require() -> None:
    """Check that Rerun is installed.

    Raises:
        LatheError: Rerun is not installed.
    """
    extras.require("rerun_bindings")
    os.environ.setdefault("RUST_LOG", "off")  # the command reports errors itself


def _free_port() -> int:
    """Return a free port.

    If another program takes the port before the viewer does, the failure of the viewer to start is reported.
    """
    with socket.socket() as listener:
        listener.bind((_HOST, 0))
        return int(listener.getsockname()[1])


def _answers(host: str, port: int) -> bool:
    try:
        socket.create_connection((host, port), timeout=1.0).close()
    except OSError:
        return False
    return True


@dataclass(frozen=True)
class Viewer:
    """Command that starts a Rerun viewer.

    Attributes:
        options: command-line options.
        port: port that receives recordings.
        message: message for the user.
    """

    options: list[str]
    port: int
    message: str

    def start(self, *files: Path) -> "subprocess.Popen[bytes]":
        """Start the viewer with the files to show; the viewer does not receive Ctrl-C."""
        return subprocess.Popen(
            [*allowed_code.interpreter("rerun"), *self.options, *map(str, files)],
            env=os.environ | {"RUST_LOG": "error"},
            stdout=sys.stderr,
            start_new_session=True,
        )


def end_viewer(process: "subprocess.Popen[bytes]") -> None:
    """End a started viewer, including the child process that is the actual viewer."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGTERM)
    process.wait()


def viewer(kind: RerunOutput, port: int) -> Viewer:
    """Return the viewer command for ``spawn`` or ``serve``.

    Args:
        kind: ``spawn`` for a window, ``serve`` for a page.
        port: port of the page.

    Raises:
        InputError: there is no display for a window.
    """
    data = _free_port()
    options = ["--bind", _HOST, "--port", str(data)]  # by default, Rerun listens on all interfaces
    if kind == "serve":
        page = f"http://{_HOST}:{port}/?url={quote(f'rerun+http://{_HOST}:{data}/proxy', safe='')}"
        return Viewer([*options, "--serve-web", "--web-viewer-port", str(port)], data, f"{page}  (Ctrl-C ends it)")
    if os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
        return Viewer(options, data, "the view opens in a window; close it to go on")
    raise InputError("no display for a window; use -o FILE.rrd or --web")


class LiveOutput:
    """Output of a live view, with one recording per run; a context manager.

    Args:
        kind: destination: ``save``, ``spawn``, ``serve`` or ``connect``.
        file: file of the first recording, for ``save``; later files have a number in their names. No file is
            overwritten.
        url: URL of a viewer, for ``connect``, such as rerun+http://127.0.0.1:9876/proxy.
        port: port of the page, for ``serve``.

    Raises:
        InputError: the file cannot be created, the URL is invalid, or there is no display.
    """

    def __init__(self, kind: RerunOutput, *, file: Path, url: str, port: int) -> None:
        self._kind, self._file, self._url = kind, file, url
        self._viewer = viewer(kind, port) if kind in ("spawn", "serve") else None
        self._process: subprocess.Popen[bytes] | None = None
        self._recordings = 0
        if kind == "save":
            if file.suffix != ".rrd":
                raise InputError(f"{file}: a live view is saved to a file; allowed: a name that ends in .rrd")
            if not file.parent.is_dir():
                raise InputError(f"{file}: there is no folder {file.parent}")
            if file.exists():
                raise InputError(f"{file} exists; a live view is never overwritten")

    def __enter__(self) -> "LiveOutput":
        """Start the viewer and wait until it answers.

        Raises:
            LatheError: the viewer does not answer.
        """
        if self._kind == "connect":
            self._check_viewer(self._url)
        if self._viewer:
            self._process = self._viewer.start()
            due = time.monotonic() + _START
            while not _answers(_HOST, self._viewer.port):
                if self.ended or time.monotonic() > due:
                    self.__exit__()  # Python does not call it if __enter__ raises
                    raise LatheError("Rerun does not start")
                time.sleep(_POLL)
            self._url = f"rerun+http://{_HOST}:{self._viewer.port}/proxy"
            print(self._viewer.message, file=sys.stderr)
        return self

    @staticmethod
    def _check_viewer(url: str) -> None:
        """Check that the URL belongs to a viewer and that the viewer answers."""
        try:
            parts = urlsplit(url)
            host, port = parts.hostname, parts.port
        except ValueError:
            host = port = None
        if not host or not port or parts.scheme not in ("rerun", "rerun+http", "rerun+https") or parts.path != "/proxy":
            raise InputError(f"url = {url!r}; allowed: rerun+http://HOST:PORT/proxy")
        if not _answers(host, port):
            raise LatheError(f"no viewer answers at {url}; start one with: rerun")

    def __exit__(self, *exception: object) -> None:
        """End the viewer that was started."""
        if self._process:
            end_viewer(self._process)

    @property
    def ended(self) -> bool:
        """Return True if the viewer that was started has ended, for example because its window was closed."""
        return self._process is not None and self._process.poll() is not None

    def open(self, name: str) -> tuple["rr.RecordingStream", Path | None]:
        """Create the recording of the next run; return it with its file, if it has one.

        Raises:
            InputError: the file cannot be written.
        """
        import rerun as rr

        self._recordings += 1
        recording = rr.RecordingStream("lathe_rc")
        file = None
        if self._kind == "save":
            file = self._file if self._recordings == 1 else self._free_name()
            try:
                recording.save(file)
            except RuntimeError as error:
                raise InputError(f"{file}: cannot be written ({error})") from None
        else:
            recording.connect_grpc(self._url)
        recording.send_recording_name(name)
        return recording, file

    def _free_name(self) -> Path:
        while (file := self._file.with_stem(f"{self._file.stem}-{self._recordings}")).exists():
            self._recordings += 1
        return file
