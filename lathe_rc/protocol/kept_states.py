# SPDX-License-Identifier: Apache-2.0
"""States of a member that another process of it can resume from.

The newest blocks of a process may be lost when it dies, since DDS then repeats no message. No reader is more than one
window and its feedback delay behind, so the state that is written is at least that old, and the new process sends the
blocks since then again. The state is at most another window old: publishers, which may be one window ahead, keep a
little more than three.
"""

from collections import deque
from collections.abc import Iterable
from typing import Generic, TypeVar

S = TypeVar("S")


class KeptStates(Generic[S]):
    """Newest states of a member, down to one that no reader has passed.

    Args:
        window: largest number of blocks in flight.

    Attributes:
        keep_at: number of blocks after which the state is kept next.
    """

    def __init__(self, window: int) -> None:
        self._window = self._behind = window
        self._states: deque[tuple[int, S]] = deque()  # number of blocks, and state
        self.keep_at = 0

    def begin(self, delays: Iterable[int]) -> None:
        """Set the feedback delays [block] of the readers of the member's topics."""
        self._behind = self._window + max(delays, default=0)

    def keep(self, blocks: int, state: S) -> S:
        """Keep the state after a number of blocks; return the one to write."""
        self.keep_at = blocks + self._window
        self._states.append((blocks, state))
        while len(self._states) > 1 and self._states[1][0] <= blocks - self._behind:
            self._states.popleft()
        return self._states[0][1]

    @property
    def states(self) -> list[S]:
        """Return the kept states, oldest first."""
        return [state for _, state in self._states]
