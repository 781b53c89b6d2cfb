# SPDX-License-Identifier: Apache-2.0
"""Reports of a process to its harness as JSON lines over a socket, which also detects the end of the harness.

The harness passes one end of a socket pair and its number in ``LATHE_REPORT_FD``. When the other end closes, the
harness is gone, and so the process ends too.
"""

import json
import os
import select
import socket
import time

VARIABLE = "LATHE_REPORT_FD"
THROUGHPUT = "LATHE_THROUGHPUT"  #: set if the cell runs as fast as possible, without a pace


class Reporter:
    """Connection of a process to its harness; does nothing without a harness."""

    def __init__(self) -> None:
        number = os.environ.get(VARIABLE)
        self._socket = socket.socket(fileno=int(number)) if number else None

    @property
    def attached(self) -> bool:
        """Return True if a harness has started the process."""
        return self._socket is not None

    def __call__(self, event: str, node: str, **values: object) -> None:
        """Report an event with the monotonic time, which all processes of the machine share."""
        if self._socket is None:
            return
        line = json.dumps({"event": event, "node": node, "monotonic_ns": time.monotonic_ns(), **values})
        try:
            self._socket.sendall(line.encode() + b"\n")
        except OSError:
            # The harness is gone; the process ends in order because of `orphaned`.
            self._socket.close()

    @property
    def orphaned(self) -> bool:
        """Return True if the harness is gone."""
        if self._socket is None:
            return False
        if self._socket.fileno() < 0:
            return True
        readable, _, _ = select.select([self._socket], [], [], 0)
        return bool(readable) and not self._socket.recv(4096)
