# SPDX-License-Identifier: Apache-2.0
"""Kernels printed as C99: the subset of Python in which steps are written, with its names, comments and formulas.

Each kernel becomes one function for each combination of argument types. An operation of Python becomes the same one of
C, in the same order, so that a compiler that contracts and reorders nothing (``-ffp-contract=off``) gives the bits of
the engine. What differs between the languages is a function of ``kernels.h``: the sign of a remainder, an index below
0, a slice beyond the end.

`c_types`        types of C, from those of Numba and of constants
`kernel_types`   types of the names and expressions of a kernel
`c_expressions`  expressions
`c_function`     statements, comments, the function
`step_memory`    the memory: tables and state
"""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from lathe_export.c_library import c_types
from lathe_export.c_library.c_expressions import safe
from lathe_export.c_library.c_function import CFunction, wrapped
from lathe_export.c_library.c_types import FLOAT, INT, OCTET, ArrayType, PortsType, TupleType, Type
from lathe_export.c_library.kernel_types import KernelTypes, UnprintableError
from lathe_export.c_library.step_memory import Place, StepMemory
from lathe_export.c_library.templates import TEMPLATES
from lathe_rc.cell.stage import Stage
from lathe_rc.compiled.struct_view import StructView, address
from lathe_rc.extensions import is_ours
from lathe_rc.messages import MAX_BLOCK


class PrintedStep(NamedTuple):
    """Step of a stage in C.

    Attributes:
        code: the file.
        arrays: number of places in it that make a temporary array.
        memory: its memory.
    """

    code: str
    arrays: int
    memory: StepMemory


def printed(
    stage: Stage,
    symbol: str,
    tuned: Mapping[str, Sequence[Place]] | None = None,
    bytes_of_real: int = 8,
    block: int = MAX_BLOCK,
) -> PrintedStep:
    """Return the step of a stage in C.

    Args:
        stage: the stage.
        symbol: name of its ``lathe_code``.
        tuned: see `lathe_export.c_library.step_memory.StepMemory`.
        bytes_of_real: size of a real number in C [B].
        block: largest number of samples in a call.

    Raises:
        UnprintableError: the step uses something that the printer does not know.
    """
    native, printer = stage.native(), Printer()
    kernel = getattr(stage.step, "py_func", None)
    if kernel is None:
        raise UnprintableError(f"{stage.name}: a step that is no kernel cannot be printed as C")
    table, outputs = native.table, stage.field_types[1]
    real, octet = ArrayType(FLOAT, 1), ArrayType(OCTET, 1)
    flags = TupleType((octet,) * table.flags)
    written = TupleType(tuple(octet if kind.itemsize == 1 else real for kind in outputs))
    read: Type = PortsType() if is_ours(kernel.__module__) else TupleType((real,) * table.floats)
    step = printer.function(kernel, [native.view, INT, INT, read, flags, written])
    functions = [CFunction(each, printer) for each in printer.needed(step)]
    bodies = [line for each in functions for line in (*each.body(), "")]
    heads = [f"{each.head()};" for each in functions]
    arguments = {"inputs": (read, table.first - 1), "flags": (flags, 0), "outputs": (written, table.flags)}
    given = ["room" if step.takes_room else "(void)room;", "memory", "first", "start_at", *arguments]
    entry = [
        f"const {printer.declared(kind)} {name} = {_filled(kind, begin, table.floats)};"
        for name, (kind, begin) in arguments.items()
    ]
    entry += [] if step.takes_room else [given.pop(0)]
    entry.append(f"const {printer.declared(step.result)} found = {printer.name(step)}({', '.join(given)});")

    rows = {address(part): part.shape[-1] - MAX_BLOCK + block for part in stage.of_block if part.size}
    memory = StepMemory(native.view, stage.memory, tuned or {}, bytes_of_real, rows)
    text = TEMPLATES.get_template("c_library/NODE_step.c.j2").render(
        node=stage.name,
        declarations=_text(printer.declarations()),
        tables="".join(f"{line}\n" for line in memory.tables()),
        state=printer.unused("State"),
        members=_text(memory.state(), 1),
        size=max(memory.size, 8),
        functions=_text([*heads, "", *bodies]),
        starts=_text([*memory.start()] or ["(void)state;"], 1),
        memory=printer.declared(native.view).removeprefix("const ").removesuffix(" *"),
        initialiser=_text(memory.members(), 2),
        most=8 * max(native.view.size, 1),
        given=_text(entry, 1),
        symbol=symbol,
    )
    arrays = len(re.findall(r"\breal_(?:empty|full|copy|joined)\(room", text))
    return PrintedStep(text, arrays, memory)


def _text(lines: Iterable[str], depth: int = 0) -> str:
    return "\n".join(part for line in lines for part in wrapped(f"{'    ' * depth}{line}"))


def _filled(kind: Type, begin: int, floats: int) -> str:
    """Return the arrays whose addresses begin at a place of the table."""
    if isinstance(kind, PortsType):
        return f"{{table + {begin}, {floats}, samples}}"
    names = ", ".join(f"{{table[{begin + k}], samples}}" for k in range(len(kind.parts)))
    return f"{{{{{names}}}}}" if kind.alike else f"{{{names}}}"


class Printer:
    """Names and types that the functions of a file share.

    Attributes:
        functions: kernels by function and argument types, each after those that it calls.
    """

    def __init__(self) -> None:
        self.functions: dict[tuple[Any, ...], KernelTypes] = {}
        self._taken: set[str] = set()
        self._names: dict[KernelTypes, str] = {}
        self._structs: dict[StructView, str] = {}
        self._tuples: dict[TupleType, str] = {}
        self._constants: dict[str, str] = {}

    def function(self, function: Callable[..., Any], given: Sequence[Type]) -> KernelTypes:
        """Return a kernel for some types of its arguments."""
        key = function, tuple(given)
        if key not in self.functions:
            self.functions[key] = KernelTypes(self, function, given)
        return self.functions[key]

    def needed(self, root: KernelTypes) -> list[KernelTypes]:
        """Return the kernels that one calls, and it, in the order in which C needs them.

        Others have types that the names in a kernel had only while its types were sought.
        """
        found, left = {root}, [root]
        while left:
            new = set(left.pop().calls()) - found
            found |= new
            left += new
        return [each for each in self.functions.values() if each in found]

    def unused(self, stem: str) -> str:
        """Return a name that no other function or type of the file has."""
        name, count = stem, 2
        while name in self._taken:
            name, count = f"{stem}_{count}", count + 1
        self._taken.add(name)
        return name

    def name(self, types: KernelTypes) -> str:
        """Return the name of a kernel: that of its module, and its own."""
        if types not in self._names:
            module, own = types.function.__module__.rpartition(".")[2], types.function.__name__.strip("_")
            self._names[types] = self.unused(f"{module}_{own}")
        return self._names[types]

    def declared(self, kind: Type) -> str:
        """Return how a type is spelled; a struct or tuple is declared."""
        if isinstance(kind, StructView):
            return f"const {self._struct(kind)} *"
        if not isinstance(kind, TupleType):
            return str(kind if isinstance(kind, str) else kind.name)
        if kind not in self._tuples:
            for part in kind.parts:
                self.declared(part)
            self._tuples[kind] = self.unused(kind.name)
        return self._tuples[kind]

    def _struct(self, kind: StructView) -> str:
        if kind not in self._structs:
            for member, _ in kind.members.values():
                if isinstance(member, StructView):
                    self._struct(member)
            self._structs[kind] = self.unused(kind.name.partition("(")[0].rpartition(".")[2])
        return self._structs[kind]

    def named(self, name: str, text: str) -> str:
        """Return the name of a constant with a value."""
        known, count = name, 2
        while self._constants.get(known, text) != text:
            known, count = f"{name}_{count}", count + 1
        self._constants[known] = text
        return known

    def declarations(self) -> Iterator[str]:
        """Yield the lines that declare constants, structs and tuples."""
        for name, text in self._constants.items():
            whole = text.lstrip("-").isdigit() or text in ("true", "false")
            kind = "uint64_t" if text.startswith("U") else "int64_t" if text.startswith("INT64") else "double"
            yield f"enum {{ {name} = {text} }};" if whole else f"static const {kind} {name} = {text};"
        for struct, name in self._structs.items():
            members = ((safe(member), c_types.of_numba(kind)) for member, (kind, _) in struct.members.items())
            # A struct within another is no address.
            fields = [f"{self._structs.get(kind) or self.declared(kind)} {member}" for member, kind in members]
            yield from _declared(name, fields or ["int64_t none"])
        for made, name in self._tuples.items():
            parts = [f"{self.declared(part)} {made.part(place)}" for place, part in enumerate(made.parts)]
            if made.alike:
                parts = [f"{self.declared(made.parts[0])} part[{len(made.parts)}]"]
            yield from _declared(name, parts)
        yield ""


def _declared(name: str, fields: Sequence[str]) -> Iterator[str]:
    yield from ("", "typedef struct {", *(f"    {field};" for field in fields), f"}} {name};")
