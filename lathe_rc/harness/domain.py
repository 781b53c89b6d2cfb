# SPDX-License-Identifier: Apache-2.0
"""ROS domains: a cell that names none takes one that no other program on this machine uses."""

import contextlib
from collections.abc import Iterator


@contextlib.contextmanager
def free_domain(number: int | None = None) -> Iterator[int]:
    """A ROS domain that nobody else on this machine uses; ``number`` if one is given."""
    if number is not None:
        yield number
        return
    from domain_coordinator import domain_id

    with domain_id() as free:
        yield int(free)
