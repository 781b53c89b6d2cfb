# SPDX-License-Identifier: Apache-2.0
"""ROS domains: a cell that names none takes one that no other program on this machine uses."""

import contextlib
import itertools
import os
from collections.abc import Iterator

_DOMAINS = 100  # domain_coordinator reserves 1 to 100
# Each cell gets the next one, and each process begins elsewhere: in the domain of a cell that has just ended, a process
# that was killed or orphaned may not have left yet.
_numbers = itertools.count(os.getpid() * 37)


@contextlib.contextmanager
def free_domain(number: int | None = None) -> Iterator[int]:
    """A ROS domain that nobody else on this machine uses; ``number`` if one is given."""
    if number is not None:
        yield number
        return
    from domain_coordinator import domain_id

    with domain_id(lambda: next(_numbers) % _DOMAINS + 1) as free:
        yield int(free)
