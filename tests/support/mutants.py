# SPDX-License-Identifier: Apache-2.0
"""Mutants of the protocol: one comparison, constant, condition, operand or call is changed; a schedule has to find it.

python mutants.py SEED COUNT SCHEDULES prints the drawn mutants, each with the schedule that has found it; mutants.txt
judges those that none has found.
"""

import ast
import importlib.abc
import importlib.util
import signal
import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from hashlib import sha256
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import pytest

PROTOCOL = Path(__file__).parents[2] / "lathe_rc" / "protocol"
LONGEST = 2.0  # [s] of computing time for one schedule, after which it hangs
_OTHER = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
}  # fmt: skip


class Mutant(NamedTuple):
    """A change of a module: its place among all changes of it; and module, function, and the code before and after."""

    module: str
    number: int
    name: str


def _changes(node: Any) -> Iterator[tuple[ast.AST, ast.AST]]:
    """Yield what may be changed in a node: a part of it, and what replaces it."""
    match node:
        case ast.Compare(ops=[op]) if type(op) in _OTHER:
            yield node, ast.Compare(node.left, [_OTHER[type(op)]()], node.comparators)  # ops are shared
        case ast.Constant(value=bool(value)):
            yield node, ast.Constant(not value)
        case ast.Constant(value=int() | float()):
            yield node, ast.Constant(node.value + 1)
        case ast.If(test=test) | ast.While(test=test) | ast.IfExp(test=test):
            yield test, ast.UnaryOp(ast.Not(), test)
            yield test, ast.Constant(value=isinstance(node, ast.If))
        case ast.BoolOp(values=values):
            for value in values:
                yield value, ast.Constant(isinstance(node.op, ast.And))
        case ast.BinOp(left=left, op=ast.Add() | ast.Sub() | ast.BitOr()):
            yield node, left
        case ast.Name(id="min" | "max" as name):
            yield node, ast.Name("min" if name == "max" else "max", ast.Load())
        case ast.Expr(value=ast.Call(func=ast.Attribute(attr=called))) if called != "_log":
            yield node, ast.Pass()


class _Swap(ast.NodeTransformer):
    """Replaces a part of a tree."""

    def __init__(self, old: ast.AST, new: ast.AST) -> None:
        self._old, self._new = old, new

    def visit(self, node: ast.AST) -> ast.AST:
        return self._new if node is self._old else self.generic_visit(node)


def _sites(module: str) -> tuple[ast.Module, list[tuple[str, ast.AST, ast.AST]]]:
    """Return a module's tree, and what may be changed in it, with a name: not annotations, nor the words of errors."""
    tree = ast.parse((PROTOCOL / f"{module}.py").read_text(encoding="utf-8"))
    skipped = set[int]()
    for node in ast.walk(tree):
        wordy = isinstance(node, ast.Raise | ast.Assert | ast.JoinedStr) or (
            isinstance(node, ast.Call) and ast.unparse(node.func) in ("self._log", "do.Log")
        )
        skip = node if wordy else node.annotation if isinstance(node, ast.AnnAssign) else None
        skipped |= {id(part) for part in ast.walk(skip)} if skip else set()
    bodies = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    within = {  # the innermost statement of each part
        part: f"{module}.{body.name}, {ast.unparse(each).splitlines()[0].rstrip(':')}"
        for body in bodies
        for each in ast.walk(body)
        if isinstance(each, ast.stmt) and not isinstance(each, ast.FunctionDef)
        for part in ast.walk(each)
    }
    parts = [(name, part) for part, name in within.items() if id(part) not in skipped]
    changes = [(name, old, new) for name, part in parts for old, new in _changes(part)]
    return tree, [(f"{name}: {ast.unparse(old)} -> {ast.unparse(new)}", old, new) for name, old, new in changes]


def mutated(module: str, number: int) -> ast.Module:
    """Return the tree of a module with one change."""
    tree, sites = _sites(module)
    _, old, new = sites[number]
    return ast.fix_missing_locations(_Swap(old, new).visit(tree))


def drawn(seed: int, count: int) -> list[Mutant]:
    """Draw mutants of all modules of the protocol; fewer are the first of more."""
    modules = sorted(path.stem for path in PROTOCOL.glob("*.py"))
    found = [Mutant(module, place, name) for module in modules for place, (name, *_) in enumerate(_sites(module)[1])]
    found.sort(key=lambda each: sha256(f"{seed} {each.name}".encode()).digest())  # a changed line changes no other
    return found[:count]


class _Finder(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Imports one module of the protocol as a mutant."""

    def __init__(self, mutant: Mutant) -> None:
        self._mutant, self._name = mutant, f"lathe_rc.protocol.{mutant.module}".removesuffix(".__init__")

    def find_spec(self, name: str, path: object, target: object = None) -> Any:
        return importlib.util.spec_from_loader(name, self) if name == self._name else None

    def exec_module(self, module: Any) -> None:
        tree = mutated(self._mutant.module, self._mutant.number)
        exec(compile(tree, str(PROTOCOL / f"{self._mutant.module}.py"), "exec"), vars(module))  # noqa: S102 - our own


def _hangs(*_: object) -> None:
    raise TimeoutError("it hangs")


def find(mutant: Mutant, schedules: int) -> str:
    """Return what finds a mutant: the first schedule, with the broken promise, or else a rule; empty if none does."""
    ours = ("schedules", "simulation", "test_protocol", "lathe_rc.protocol")
    for name in [name for name in sys.modules if name.startswith(ours)]:
        del sys.modules[name]
    sys.meta_path.insert(0, finder := _Finder(mutant))
    signal.signal(signal.SIGVTALRM, _hangs)
    try:
        fresh = importlib.import_module("schedules")
        for seed in range(schedules):
            signal.setitimer(signal.ITIMER_VIRTUAL, LONGEST)
            if broken := fresh.play(seed)[1]:
                return f"schedule {seed}: {broken[0]}"
        signal.setitimer(signal.ITIMER_VIRTUAL, 30.0 * LONGEST)
        rules = str(Path(__file__).parents[1] / "nodes" / "test_protocol.py")
        told = pytest.main(["-qx", "-n0", "-pno:cacheprovider", "-knot random_schedules", rules])
    except Exception as error:  # noqa: BLE001 - that is found as well
        return repr(error)
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        sys.meta_path.remove(finder)
    return "" if told != pytest.ExitCode.TESTS_FAILED else "a rule of test_protocol.py"


def tried(seed: int, count: int, schedules: int, processes: int = 1) -> Iterator[tuple[str, str]]:
    """Yield the name of each drawn mutant, and how it was found (see `find`)."""
    mutants = drawn(seed, count)
    with ProcessPoolExecutor(processes, get_context("spawn")) as pool:  # a child of pytest cannot run it again
        found = pool.map(partial(find, schedules=schedules), mutants)
        yield from zip((mutant.name for mutant in mutants), found, strict=True)


if __name__ == "__main__":
    for name, found in tried(*map(int, sys.argv[1:])):
        print(f"{name}: {found or 'NOT FOUND'}", flush=True)
