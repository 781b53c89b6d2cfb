# SPDX-License-Identifier: Apache-2.0
"""Compiled steps: layout of their memory, and the way one compiled loop calls them.

A cell computes in one loop that Numba has compiled once for all cells (`lathe_rc.cell.program`). The loop cannot know
the types of the steps that it calls, so a step is called by its address, with addresses:

    enter(memory, first, start, samples, fields, reached) -> reason

memory    address of the step's memory (`lathe_rc.cell.stage.Stage.memory`), laid out in words of 64 bits: a constant is
          its value, an array the address of its first element and its shape, a NamedTuple its members one after the
          other. The arrays stay where NumPy has them, so that Python and the step see the same numbers.
fields    address of a table with the addresses of the arrays of the step's ports, which the loop moves on chunk by
          chunk: the number of inputs of float64, inputs of uint8, outputs, inputs of float64 (`step.AddressTable`).
reached   address of the word in which the step writes the sample that it has come to.

`struct_view`   the layout, and what lets a kernel write ``memory.drive.state[0]`` for words at an address.
`step`          writes and compiles ``enter`` for each kind of step, memory and ports; `step.CompiledStep` is one with
                its memory, which Python can call as well.

In the cell, which knows stages: `lathe_rc.cell.program` has the loop and the tapes that the ports' arrays lie on,
`lathe_rc.cell.ahead` compiles steps before a run on all cores, and `lathe_rc.cell.stage_cache` sets stages back to
their start, so that memories stay at their addresses from cell to cell of a batch.
"""

__all__: list[str] = []  # all of it may change: see lathe_rc/__init__.pyi
