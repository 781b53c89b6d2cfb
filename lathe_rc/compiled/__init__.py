# SPDX-License-Identifier: Apache-2.0
"""Compiled steps: layout of their memory, and the way one compiled loop calls them.

A cell computes in one loop that Numba has compiled once for all cells (`lathe_rc.cell.program`). The loop cannot know
the types of the steps that it calls, so a step is called by its address, with addresses:

    enter(memory, first, start, samples, fields, reached) -> reason

memory    address of the step's memory (`lathe_rc.cell.stage.Stage.memory`), laid out in words of 64 bits: a constant is
          its value, an array the address of its first element and its shape, a NamedTuple its members one after the
          other. The arrays remain NumPy's memory, so that Python and the step share the values.
fields    address of a table with the addresses of the arrays of the step's ports, which the loop moves on chunk by
          chunk: the number of inputs of float64, inputs of uint8, outputs, inputs of float64 (`step.AddressTable`).
reached   address of the word in which the step writes the sample that it has reached.

`struct_view`   the layout, and the access of kernels to words at an address, as in ``memory.drive.state[0]``.
`step`          generates and compiles ``enter`` for each kind of step, memory and ports; `step.CompiledStep` adds
                its memory, and is callable from Python.

Related modules for stages: `lathe_rc.cell.program` has the loop and the tapes that hold the ports' arrays,
`lathe_rc.cell.ahead` compiles steps before a run on all cores, and `lathe_rc.cell.stage_cache` resets stages to
their start, so that memories stay at their addresses from cell to cell of a batch.
"""

__all__: list[str] = []  # all of it may change: see lathe_rc/__init__.pyi
