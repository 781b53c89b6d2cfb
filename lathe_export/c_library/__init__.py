# SPDX-License-Identifier: Apache-2.0
"""Stages as programs without Python: the steps that the engine runs, printed as C libraries.

`printer`        a step as C, from its kernels, with its memory.
`library`        `library.Library`: several stages wired together, with signals, parameters and the layout of their
                 state; any other wrapper of the same steps starts here.
`sources`        the files of a library: headers, tables, steps, example, CMake file and README.
`fmu`, `ssp`     the same steps as an FMU, and a cell as connected FMUs.
"""

__all__: list[str] = []  # everything here may change: see lathe_rc/__init__.pyi
