# SPDX-License-Identifier: Apache-2.0
"""Sparse messages from what a stage computes; the same in every host. Blocks: see `lathe_rc.cell.wire`."""

from typing import Any

from lathe_rc import messages
from lathe_rc.cell.stage import Sparse


class Framer:
    """Makes the sparse messages of one node.

    Args:
        run_id: identity of the run.
        source: fully qualified name of the node.
        step_ns: sampling step [ns].

    Attributes:
        companions: messages made so far, which the node's next block reports.
    """

    def __init__(self, run_id: str, source: str, step_ns: int) -> None:
        self._run_id, self._source, self._step_ns = run_id, source, step_ns
        self.companions = 0

    def sparse(self, message: Sparse) -> Any:
        """A message at a chosen sample; counted, so that blocks can say how many came before."""
        self.companions += 1
        head = messages.header(message.index, self._step_ns)
        kind = messages.store().types[message.type]
        if message.type.startswith(messages.PACKAGE):
            return kind(
                header=head,
                run_id=self._run_id,
                source=self._source,
                sample_index=message.index,
                **message.values,
            )
        return kind(header=head, **message.values)
