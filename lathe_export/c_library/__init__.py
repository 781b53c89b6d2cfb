# SPDX-License-Identifier: Apache-2.0
"""Stages as programs without Python: the compiled steps that the engine runs, in C libraries.

`object_code`    the object file of a step, for a processor of choice.
`memory_image`   the memory of a step as one relocatable block.
`library`        `library.Library`: several stages wired together, with signals, parameters and the layout of their
                 state; any other wrapper of the same objects starts here.
`sources`        the files of a library: header, tables, objects, example, CMake file and README.
"""

__all__: list[str] = []  # everything here may change: see lathe_rc/__init__.pyi
