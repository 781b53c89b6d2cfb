# SPDX-License-Identifier: Apache-2.0
# mypy: allow-untyped-calls
"""Object files of compiled steps, for programs without Python.

Numba keeps the optimised intermediate code of each step. From it LLVM emits an object file for any processor of its
own, with the arithmetic that the engine runs: no operation is reordered or contracted. Such a file needs the functions
of libm, and `take` and `release`, the memory of temporary arrays (see ``templates/c_library/lathe.c.j2``).

    int32_t SYMBOL(int64_t *reason, void **error, int64_t memory, int64_t first, int64_t start, int64_t samples,
                   int64_t fields, int64_t reached)

The arguments after ``error`` are those of ``enter`` in `lathe_rc.compiled`. A result other than 0 means that the step
could not get memory.
"""

import re
from typing import Any, NamedTuple

import llvmlite.binding as llvm

from lathe_rc.compiled.step import CompiledStep
from lathe_rc.errors import LatheError


class Target(NamedTuple):
    """Processor that an object file is for.

    Attributes:
        triple: name of the processor and operating system in LLVM.
        cpu: processor with the smallest set of instructions.
        compiler: prefix of the C compiler for it, as Debian names it.
    """

    triple: str
    cpu: str
    compiler: str


TARGETS = {
    "x86-64": Target("x86_64-unknown-linux-gnu", "x86-64-v2", "x86_64-linux-gnu-"),
    "aarch64": Target("aarch64-unknown-linux-gnu", "generic", "aarch64-linux-gnu-"),
}  #: processors, by name

_RUNTIME = {"NRT_MemInfo_alloc_aligned": "lathe_take", "NRT_MemInfo_call_dtor": "lathe_release"}
_LIBM = {
    "sin", "cos", "tan", "asin", "acos", "atan", "atan2", "exp", "expm1", "log", "log1p", "pow", "cbrt", "sqrt",
    "floor", "ceil", "rint", "trunc", "fmod", "fabs",
}  # fmt: skip
_LIBC = {"memcpy", "memset", "memmove"}
_COUNTING = re.compile(r"^define [^\n]*@NRT_(?:incref|decref)\(.*?^}\n", re.MULTILINE | re.DOTALL)
_HEAD = re.compile(r"^target (?:triple|datalayout) = .*\n", re.MULTILINE)
# One reference a count, without the atomic instructions of the processor on which Numba has compiled.
_REFERENCES = """
define internal void @NRT_incref(ptr %at) noinline {
  %none = icmp eq ptr %at, null
  br i1 %none, label %end, label %some
some:
  %count = load i64, ptr %at
  %more = add i64 %count, 1
  store i64 %more, ptr %at
  br label %end
end:
  ret void
}

define internal void @NRT_decref(ptr %at) noinline {
  %none = icmp eq ptr %at, null
  br i1 %none, label %end, label %some
some:
  %count = load i64, ptr %at
  %less = sub i64 %count, 1
  store i64 %less, ptr %at
  %last = icmp eq i64 %less, 0
  br i1 %last, label %free, label %end
free:
  call void @lathe_release(ptr %at)
  br label %end
end:
  ret void
}
"""


def object_code(step: CompiledStep, symbol: str, target: str) -> bytes:
    """Return the object file of a step, in ELF format.

    Args:
        step: the step, compiled if it is not yet.
        symbol: name of the function in the file.
        target: one of `TARGETS`.

    Raises:
        InputError: the step cannot be compiled.
        LatheError: its code needs a function that is not in libm, such as one of Python.
    """
    machine, module = _module(step, symbol, target)
    return bytes(machine.emit_object(module))


def assembly(step: CompiledStep, symbol: str, target: str) -> str:
    """Return the code of a step as assembly; arguments and errors as for `object_code`."""
    machine, module = _module(step, symbol, target)
    return str(machine.emit_assembly(module))


def _module(step: CompiledStep, symbol: str, target: str) -> tuple[Any, Any]:
    """Return LLVM's processor, and the step's intermediate code for it."""
    chosen = TARGETS[target]
    machine = _machine(chosen)
    inner, text = step.intermediate_code()
    text = _COUNTING.sub("", _HEAD.sub("", text))
    for name, ours in _RUNTIME.items():
        text = re.sub(rf"@{name}\b", f"@{ours}", text)
    if "@lathe_release(" not in text:
        text += "declare void @lathe_release(ptr)\n"
    head = f'target triple = "{chosen.triple}"\ntarget datalayout = "{machine.target_data}"\n'
    module = llvm.parse_assembly(head + text.replace(f"@{inner}(", f"@{symbol}(") + _REFERENCES)
    for each in module.functions:
        if not each.is_declaration:
            each.linkage = "external" if each.name == symbol else "internal"
    for variable in module.global_variables:
        if not variable.is_declaration:
            variable.linkage = "internal"
    # This removes the function for Python around the step, and all that only it needs.
    passes = llvm.create_new_module_pass_manager()
    passes.add_global_dead_code_eliminate_pass()
    passes.add_strip_dead_prototype_pass()
    passes.add_strip_symbols_pass()
    passes.run(module, llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options()))
    needed = {each.name for each in module.functions if each.is_declaration and not each.name.startswith("llvm.")}
    if foreign := needed - _LIBM - _LIBC - {*_RUNTIME.values()}:
        raise LatheError(f"its compiled step calls {', '.join(sorted(foreign))}; allowed: the functions of libm")
    return machine, module


def temporary_arrays(step: CompiledStep) -> int:
    """Return the number of places in a step's code that take memory for a temporary array."""
    return len(re.findall(r"call [^\n]*@NRT_MemInfo_alloc_aligned\(", step.intermediate_code()[1]))


def constant_bytes(content: bytes, symbol: str, target: str) -> bytes:
    """Return an object file with a constant array of bytes, in ELF format; arguments as for `object_code`."""
    machine = _machine(TARGETS[target])
    escaped = "".join(f"\\{byte:02x}" for byte in content)
    text = f'@{symbol} = constant [{len(content)} x i8] c"{escaped}", align 64\n'
    head = f'target triple = "{TARGETS[target].triple}"\ntarget datalayout = "{machine.target_data}"\n'
    return bytes(machine.emit_object(llvm.parse_assembly(head + text)))


def _machine(target: Target) -> Any:
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    found = llvm.Target.from_triple(target.triple)
    return found.create_target_machine(cpu=target.cpu, opt=3, reloc="pic", codemodel="default")
