# SPDX-License-Identifier: Apache-2.0
"""Compiled steps: the layout of their memory, and how one compiled loop calls them.

A cell runs in one loop, which Numba has compiled once for all cells (`lathe_rc.cell.program`). The loop cannot know the
types of the steps that it calls, so each step is called by its address, with addresses as arguments:

    enter(memory, first, start, samples, fields, reached) -> reason

memory    address of the step's memory (`lathe_rc.cell.stage.Stage.memory`), laid out in 64-bit words: a constant is
          stored as its value, an array as the address of its first element and its shape, and a NamedTuple as its
          members in sequence. The arrays remain in NumPy's memory, so that Python and the step share the values.
fields    address of a table with the addresses of the step's port arrays, which the loop advances chunk by chunk: the
          number of float64 inputs, uint8 inputs, outputs, float64 inputs (`step.AddressTable`).
reached   address of the word to which the step writes the sample that it has reached.

`struct_view`   the layout, and how kernels access words at an address, as in ``memory.drive.state[0]``.
`step`          generates and compiles ``enter`` for each kind of step, memory and ports; `step.CompiledStep` adds
                the memory, and is callable from Python.

Related modules for stages: `lathe_rc.cell.program` contains the loop and the tapes that hold the ports' arrays,
`lathe_rc.cell.ahead` compiles steps before a run on all cores, and `lathe_rc.cell.stage_cache` resets stages to their
initial state, so that their memory stays at the same addresses from cell to cell in a batch.
"""

__all__: list[str] = []  # everything here may change: see lathe_rc/__init__.pyi
