# SPDX-License-Identifier: Apache-2.0
"""A kernel as a function of C: its head, its statements, its comments and its docstring."""

import ast
import io
import textwrap
import tokenize
from collections.abc import Iterator, Sequence

from lathe_export.c_library import c_types
from lathe_export.c_library.c_expressions import LEAST, OPERATORS, PREFIX, Expressions, Names, number, safe
from lathe_export.c_library.c_types import NONE, ArrayType, TupleType, Type
from lathe_export.c_library.kernel_types import MISSING, KernelTypes, names_in, operation
from lathe_rc.compiled.struct_view import StructView

_WIDTH = 112  # of a line


class CFunction:
    """Kernel for one combination of argument types as a function of C.

    Args:
        types: the kernel.
        names: names of the file.
    """

    def __init__(self, types: KernelTypes, names: Names) -> None:
        self.types, self._names, self._in_c = types, names, Expressions(types, names)
        self._comments = _comments(types.source)
        self._frees, self._line = False, 0

    def head(self) -> str:
        """Return the head of the function in C."""
        given = [name for name in self.types.given if self.types.kinds[name] != NONE]
        arguments = [
            f"{self._names.declared(self.types.kinds[name])} {safe(name)}".replace("* ", "*") for name in given
        ]
        every = [*(["lathe_room *room"] if self.types.takes_room else []), *arguments]
        result, name = self._names.declared(self.types.result), self._names.name(self.types)
        return f"static {result} {name}({', '.join(every) or 'void'})"

    def body(self) -> Iterator[str]:
        """Yield the lines of the function in C."""
        told = ast.get_docstring(self.types.tree)
        source = f"{self.types.function.__module__}.{self.types.tree.name}"
        yield from _comment(f"{source}: {told}" if told else source)
        yield self.head()
        yield "{"
        local = [name for name in self.types.kinds if name not in self.types.given and name != "_"]
        for kind in dict.fromkeys(self.types.kinds[name] for name in local):
            names = [safe(name) for name in local if self.types.kinds[name] == kind]
            if isinstance(kind, StructView):
                names = [f"*{name}" for name in names]
            spelled = self._names.declared(kind).removesuffix("*").strip()
            yield f"    {spelled} {', '.join(names)};"
        read = {each.id for each in ast.walk(self.types.tree) if isinstance(each, ast.Name)}
        yield from (
            f"    (void){safe(name)};"
            for name in self.types.given
            if name not in read and self.types.kinds[name] != NONE
        )
        keeps = not self.types.takes_room or isinstance(self.types.result, ArrayType)
        if not keeps:
            yield "    char *const before = room->next;"
        self._frees = not keeps
        self._line = self.types.tree.lineno
        body = self.types.tree.body[1:] if told else self.types.tree.body
        if told:
            self._line = self.types.tree.body[0].end_lineno or 0
        yield from self._block(body)
        if not keeps and not isinstance(body[-1], ast.Return):
            yield "    room->next = before;"
        yield "}"

    def _block(self, nodes: Sequence[ast.stmt]) -> Iterator[str]:
        """Yield the lines of some statements, indented, with the comments before and behind them."""
        for node in nodes:
            told = [self._comments[line] for line in range(self._line + 1, node.lineno) if line in self._comments]
            yield from (f"    {line}" for line in (_comment("\n".join(told)) if told else ()))
            self._line = (node.lineno if hasattr(node, "body") else node.end_lineno) or 0
            found = getattr(self, f"_do_{type(node).__name__.lower()}", None)
            if found is None:
                raise self.types.unknown(node, ast.unparse(node).partition("\n")[0])
            self._check_order(node)
            lines = list(found(node))
            if not hasattr(node, "body") and not isinstance(node, ast.Return) and self._may_fill(node):
                lines += ["if (room->full)", f"    return{self._nothing()};"]
            if lines and not hasattr(node, "body") and self._line in self._comments:
                lines[-1] += f" /* {self._comments[self._line]} */"
            yield from (f"    {line}" for line in lines)

    def _check_order(self, node: ast.stmt) -> None:
        """Refuse an expression in which C may call a kernel that writes before or after what it also reads."""
        own = [each for _, each in ast.iter_fields(node) if isinstance(each, ast.expr)]
        for expression in [part for each in own for part in (each.elts if isinstance(each, ast.Tuple) else [each])]:
            inside = [each for each in ast.walk(expression) if isinstance(each, ast.Call)]
            writing = [each for each in inside if (called := self.types.called(each)) is not None and called.writes]
            for call in writing:
                around = [each for each in ast.walk(expression) if call in ast.walk(each)]
                covered = [*ast.walk(call), *around, *_sequenced(expression, call)]
                beside = (each for each in ast.walk(expression) if each not in covered)
                if any(isinstance(each, ast.Call) or self._loads(each) for each in beside):
                    raise self.types.unknown(node, f"{ast.unparse(expression)}, whose order C leaves open,")

    def _loads(self, node: ast.AST) -> bool:
        """Return whether an expression is an element of an array; parts of arrays and tuples are no loads."""
        return isinstance(node, ast.Subscript) and isinstance(self.types.kind(node), str)

    def _may_fill(self, node: ast.stmt) -> bool:
        """Return whether a statement takes memory, which may be used up: nothing must be written to an array then.

        Raises:
            UnprintableError: it makes an array that has no name.
        """
        value = getattr(node, "value", None)
        named = [value.body, value.orelse] if isinstance(value, ast.IfExp) else [value]
        named += value.elts if isinstance(value, ast.Tuple) else []
        if isinstance(node, ast.Expr) and isinstance(value, ast.Call):
            named += value.args
        made = [each for each in ast.walk(node) if self.types.takes_memory(each)]
        parts = [each for sum_of in made if isinstance(sum_of, ast.BinOp) for each in (sum_of.left, sum_of.right)]
        for each in made:
            if each not in named and not (isinstance(each, ast.BinOp) and each in parts):
                raise self.types.unknown(node, f"{ast.unparse(each)}, an array without a name,")
        called = (self.types.called(each) for each in ast.walk(node) if isinstance(each, ast.Call))
        return bool(made) or any(each is not None and each.takes_room for each in called)

    def _nothing(self) -> str:
        """Return what the function returns when the memory is used up."""
        kind = self.types.result
        if kind == NONE:
            return ""
        return " 0" if isinstance(kind, str) else f" ({self._names.declared(kind)}){{0}}"

    def _do_pass(self, _node: ast.Pass) -> Iterator[str]:
        yield ";"

    def _do_break(self, _node: ast.Break) -> Iterator[str]:
        yield "break;"

    def _do_continue(self, _node: ast.Continue) -> Iterator[str]:
        yield "continue;"

    def _do_expr(self, node: ast.Expr) -> Iterator[str]:
        if isinstance(node.value, ast.Constant):
            return
        made = [each for each in getattr(node.value, "args", ()) if self.types.takes_memory(each)]
        if not made:
            unused = "" if self.types.kind(node.value) == NONE else "(void)"
            yield f"{unused}{self._in_c.text(node.value)};"
            return
        assert isinstance(node.value, ast.Call), "it has arguments"
        yield "{"
        for place, each in enumerate(made):
            name = f"made_{place}"
            yield f"    const {self._names.declared(self.types.kind(each))} {name} = {self._in_c.text(each)};"
            self.types.kinds[name] = self.types.kind(each)
            node.value.args[node.value.args.index(each)] = ast.copy_location(ast.Name(name, ast.Load()), each)
        yield "    if (room->full)"
        yield f"        return{self._nothing()};"
        yield f"    {self._in_c.text(node.value)};"
        yield "}"

    def _do_return(self, node: ast.Return) -> Iterator[str]:
        if node.value is None:
            if self._frees:
                yield "room->next = before;"
            yield "return;"
            return
        text = self._converted(node.value, self.types.result)
        if self._frees and not text.replace("_", "").isalnum():
            yield "{"
            yield f"    const {self._names.declared(self.types.result)} result = {text};"
            yield "    room->next = before;"
            yield "    return result;"
            yield "}"
            return
        if self._frees:
            yield "room->next = before;"
        yield f"return {text};"

    def _converted(self, node: ast.expr, kind: Type) -> str:
        """Return an expression as a value of a type; the parts of a tuple are converted one by one."""
        if isinstance(kind, TupleType) and isinstance(node, ast.Tuple):
            inner = ", ".join(self._converted(each, part) for each, part in zip(node.elts, kind.parts, strict=True))
            return f"({self._names.declared(kind)}){{{'{' + inner + '}' if kind.alike else inner}}}"
        if isinstance(kind, TupleType) and self.types.kind(node) != kind:
            raise self.types.unknown(node, f"{ast.unparse(node)} of other types")
        self._in_c.refuse_choice(node)
        return self._in_c.text(node)

    def _do_assign(self, node: ast.Assign) -> Iterator[str]:
        if len(node.targets) > 1:
            if isinstance(node.targets[0], ast.Tuple) or len({self.types.kind(each) for each in node.targets}) > 1:
                raise self.types.unknown(node, ast.unparse(node))
            if any(isinstance(self.types.kind(target), ArrayType) for target in node.targets):
                for target in node.targets:
                    yield from self._store(target, node.value)
                return
            yield f"{' = '.join([*map(self._in_c.text, node.targets), self._in_c.text(node.value)])};"
            return
        yield from self._store(node.targets[0], node.value)

    def _store(self, target: ast.expr, value: ast.expr) -> Iterator[str]:
        if isinstance(target, ast.Tuple):
            yield from self._store_parts(target, value)
            return
        if isinstance(target, ast.Name) and target.id == "_":
            yield f"(void){self._in_c.text(value, PREFIX)};"
            return
        kind = self.types.kind(target)
        if isinstance(target, ast.Subscript) and isinstance(kind, ArrayType):
            yield from self._store_array(target, None, value)
        elif isinstance(self.types.kind(value), ArrayType) and isinstance(value, ast.BinOp):
            yield from self._store_array(target, None, value, new=True)
        elif isinstance(kind, StructView) and not isinstance(value, ast.Name):
            yield f"{self._in_c.text(target)} = &{self._in_c.text(value)};"
        else:
            yield f"{self._in_c.text(target)} = {self._converted(value, kind)};"

    def _store_parts(self, target: ast.Tuple, value: ast.expr) -> Iterator[str]:
        if isinstance(value, ast.Tuple):
            written = {name for each in target.elts for name in names_in(each)}
            written |= {ast.unparse(each.value) for each in target.elts if isinstance(each, ast.Subscript)}
            later = [self._reads(each) for each in value.elts[1:]]
            if not any(written & names for names in later):
                for one, other in zip(target.elts, value.elts, strict=True):
                    yield from self._store(one, other)
                return
            yield "{"
            for place, (one, other) in enumerate(zip(target.elts, value.elts, strict=True)):
                yield f"    const {self._names.declared(self.types.kind(one))} new_{place} = {self._in_c.text(other)};"
            for place, one in enumerate(target.elts):
                yield f"    {self._in_c.text(one)} = new_{place};"
            yield "}"
            return
        kind = self.types.kind(value)
        if not isinstance(kind, TupleType):
            raise self.types.unknown(target, ast.unparse(value))
        name = self._free("found")
        yield "{"
        yield f"    const {self._names.declared(kind)} {name} = {self._in_c.text(value)};"
        for place, one in enumerate(target.elts):
            if not (isinstance(one, ast.Name) and one.id == "_"):
                yield f"    {self._in_c.text(one)} = {name}.{kind.part(place)};"
        yield "}"

    def _free(self, name: str) -> str:
        """Return a name that no local one hides."""
        while name in self.types.kinds:
            name += "_"
        return name

    def _reads(self, node: ast.expr) -> set[str]:
        read = {each.id for each in ast.walk(node) if isinstance(each, ast.Name)}
        return read | {ast.unparse(each) for each in ast.walk(node) if isinstance(each, ast.Attribute)}

    def _store_array(
        self, target: ast.expr, operator: ast.operator | None, value: ast.expr, *, new: bool = False
    ) -> Iterator[str]:
        """Store values in the elements of an array, one by one; in a ``new`` one, the target may be among them."""
        kind = self.types.kind(target)
        if kind.dimensions != 1:
            raise self.types.unknown(target, ast.unparse(target))
        short = c_types.SHORT[kind.element]
        if operator is None and isinstance(self.types.kind(value), ArrayType) and not isinstance(value, ast.BinOp):
            yield f"{short}_put({self._in_c.text(target)}, {self._in_c.text(value)});"
            return
        if operator is None and not isinstance(self.types.kind(value), ArrayType):
            yield f"{short}_fill({self._in_c.text(target)}, {self._in_c.text(value)});"
            return
        arrays: list[str] = []

        def element(node: ast.expr, least: int) -> str:
            if not isinstance(self.types.kind(node), ArrayType):
                return self._in_c.text(node, least)
            if isinstance(node, ast.BinOp):
                sign, binds = self._operator(node, node.op)
                text = f"{element(node.left, binds)} {sign} {element(node.right, binds + 1)}"
                return f"({text})" if binds < least else text
            arrays.append(self._in_c.text(node))
            return f"value_{len(arrays) - 1}.data[n]"

        text = element(value, LEAST)
        sign = "" if operator is None else self._operator(target, operator)[0]
        yield "{"
        for place, array in enumerate(arrays):
            yield f"    const {kind.name} value_{place} = {array};"
        yield f"    const {kind.name} into = {'real_empty(room, value_0.size)' if new else self._in_c.text(target)};"
        yield "    for (int64_t n = 0; n < into.size; n++)"
        yield f"        into.data[n] {sign}= {text};"
        if new:
            yield f"    {self._in_c.text(target)} = into;"
        yield "}"

    def _operator(self, node: ast.AST, operator: ast.operator) -> tuple[str, int]:
        if type(operator) not in OPERATORS:
            raise self.types.unknown(node, f"{type(operator).__name__} of arrays")
        return OPERATORS[type(operator)]

    def _do_augassign(self, node: ast.AugAssign) -> Iterator[str]:
        if isinstance(self.types.kind(node.target), ArrayType):
            yield from self._store_array(node.target, node.op, node.value)
            return
        target = self._in_c.text(node.target)
        if isinstance(node.op, ast.Div | ast.Mod | ast.FloorDiv | ast.Pow):
            yield f"{target} = {self._in_c.text(operation(node))};"
            return
        sign, _ = OPERATORS[type(node.op)]
        yield f"{target} {sign}= {self._in_c.text(node.value)};"

    def _do_if(self, node: ast.If, word: str = "if") -> Iterator[str]:
        test = self.types.constant(node.test)
        yield f"{word} ({self._in_c.text(node.test) if test is MISSING else number(bool(test))}) {{"
        yield from self._block(node.body)
        if len(node.orelse) == 1 and isinstance(node.orelse[0], ast.If):
            yield from self._do_if(node.orelse[0], "} else if")
            return
        if node.orelse:
            yield "} else {"
            yield from self._block(node.orelse)
        yield "}"

    def _do_while(self, node: ast.While) -> Iterator[str]:
        test = "true" if self.types.constant(node.test) is True else self._in_c.text(node.test)
        yield f"while ({test}) {{"
        yield from self._inner(node)
        yield "}"

    def _inner(self, node: ast.For | ast.While) -> Iterator[str]:
        """Yield the body of a loop, after which its temporary arrays are given back."""
        if node.orelse:
            raise self.types.unknown(node.orelse[0], "the else of a loop")
        takes = any(self._keeps_array(each) for each in ast.walk(node) if isinstance(each, ast.Call | ast.BinOp))
        if takes:
            self._check_kept(node)
            yield "    char *const within = room->next;"
        yield from self._block(node.body)
        if takes:
            yield "    room->next = within;"

    def _check_kept(self, node: ast.For | ast.While) -> None:
        """Refuse an array that is made in a loop and read after it, or in its next turn: its memory is given back."""
        stored = {name for inner in node.body for name in stored_in(inner)}
        inside = [each for inner in node.body for each in ast.walk(inner) if isinstance(each, ast.Name)]
        for each in ast.walk(self.types.tree):
            if not isinstance(each, ast.Name) or each.id not in stored or not isinstance(each.ctx, ast.Load):
                continue
            stores = (other for other in inside if other.id == each.id and isinstance(other.ctx, ast.Store))
            first = min(other.lineno for other in stores)
            kept = each.lineno <= first if each in inside else each.lineno > node.lineno
            if kept and isinstance(self.types.kinds[each.id], ArrayType):
                raise self.types.unknown(each, f"{each.id}, an array of a turn before,")

    def _keeps_array(self, node: ast.AST) -> bool:
        """Return whether an expression makes a temporary array, itself or by a kernel that returns it."""
        called = self.types.called(node) if isinstance(node, ast.Call) else None
        if called is not None:
            return called.takes_room and isinstance(called.result, ArrayType)
        return self.types.takes_memory(node)

    def _do_for(self, node: ast.For) -> Iterator[str]:
        value = node.iter
        if not (self.types.is_call(value, range) and isinstance(node.target, ast.Name)):
            yield from self._for_each(node)
            return
        name, arguments = safe(node.target.id), value.args
        begin, end = (arguments[0], arguments[1]) if len(arguments) > 1 else (ast.Constant(0), arguments[0])
        by = self.types.constant(arguments[2]) if len(arguments) == 3 else 1
        any_way = by is MISSING and not self.types.is_positive(arguments[2])
        start, stop = self._in_c.text(begin), self._in_c.text(end, 11)
        changed = {each for inner in node.body for each in stored_in(inner)}
        reads = {each.id for each in ast.walk(end) if isinstance(each, ast.Name)}
        if len(arguments) == 3 and changed & {each.id for each in ast.walk(arguments[2]) if isinstance(each, ast.Name)}:
            raise self.types.unknown(node, "a range by a step that the loop changes")
        simple = not reads & {*changed, node.target.id} and not any(
            isinstance(each, ast.Subscript | ast.Call) for each in ast.walk(end)
        )
        held = name != "_" and (node.target.id in changed or self._is_read_after(node))
        count = "again" if name == "_" else f"{name}_count" if held else name
        first = f"{count} = {start}" if count == name else f"int64_t {count} = {start}"
        if not simple:
            yield "{"
            yield f"    const int64_t {name}_end = {stop};"
            stop = f"{name}_end"
        down = by is not MISSING and by < 0
        step = f"{count}{'--' if down else '++'}" if by in (1, -1) else f"{count} += {self._in_c.text(arguments[2])}"
        test = f"{count} {'>' if down else '<'} {stop}"
        if any_way:
            test = f"{self._in_c.text(arguments[2], 11)} > 0 ? {test} : {count} > {stop}"
        lines = [f"for ({first}; {test}; {step}) {{"]
        if held:
            lines.append(f"    {name} = {count};")
        lines += self._inner(node)
        lines.append("}")
        yield from lines if simple else (f"    {line}" for line in lines)
        if not simple:
            yield "}"

    def _is_read_after(self, node: ast.For) -> bool:
        """Return whether the name of a loop is read outside of the loops over it."""
        (name,) = names_in(node.target)
        inside = {
            id(each)
            for loop in ast.walk(self.types.tree)
            if isinstance(loop, ast.For) and name in names_in(loop.target)
            for each in ast.walk(loop)
        }
        return any(
            isinstance(each, ast.Name) and each.id == name and isinstance(each.ctx, ast.Load) and id(each) not in inside
            for each in ast.walk(self.types.tree)
        )

    def _for_each(self, node: ast.For) -> Iterator[str]:
        value, target = node.iter, node.target
        count = "n"
        if isinstance(value, ast.Tuple):
            if any(isinstance(each, ast.Break | ast.Continue) for each in ast.walk(node)):
                raise self.types.unknown(node, "a loop over single values that is left early")
            for each in value.elts:
                yield from self._store(target, each)
                yield from self._inner(node)
            return
        if self.types.is_call(value, enumerate) and isinstance(target, ast.Tuple):
            assert isinstance(target.elts[0], ast.Name)
            count, value, target = safe(target.elts[0].id), value.args[0], target.elts[1]
        kind, name = self.types.kind(value), self._in_c.text(target)
        size = str(len(kind.parts)) if isinstance(kind, TupleType) else f"{self._in_c.text(value, 15)}.size"
        one = f"{self._in_c.text(value, 15)}.{'part' if isinstance(kind, TupleType) else 'data'}[{count}]"
        begin = f"{count} = 0" if count != "n" else "int64_t n = 0"
        yield f"for ({begin}; {count} < {size}; {count}++) {{"
        yield f"    {name} = {one};"
        yield from self._inner(node)
        yield "}"


def _sequenced(expression: ast.expr, call: ast.Call) -> Iterator[ast.AST]:
    """Yield the parts of an expression whose order beside a call C keeps: other operands of and, or and a choice."""
    for node in ast.walk(expression):
        if isinstance(node, ast.BoolOp | ast.IfExp) and call in ast.walk(node):
            operands = node.values if isinstance(node, ast.BoolOp) else [node.test, node.body, node.orelse]
            for operand in operands:
                inside = [*ast.walk(operand)]
                if call not in inside:
                    yield from inside


def wrapped(line: str) -> list[str]:
    """Return a line of C, without strings, as lines that are not too long."""
    text = line.lstrip()
    pad = line[: len(line) - len(text)]
    after = f"{pad}        " if not text.startswith(("/*", "*")) else f"{pad} * "
    return textwrap.wrap(
        text, _WIDTH, initial_indent=pad, subsequent_indent=after, break_long_words=False, break_on_hyphens=False
    ) or [""]


def stored_in(node: ast.stmt) -> set[str]:
    """Return the names that a statement assigns to."""
    return {each.id for each in ast.walk(node) if isinstance(each, ast.Name) and isinstance(each.ctx, ast.Store)}


def _comments(source: str) -> dict[int, str]:
    """Return the comments of a source by line."""
    found = {}
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT and not token.string.startswith(("# noqa", "# type", "# fmt")):
            found[token.start[0]] = token.string.lstrip("# ").replace("*/", "* /")
    return found


def _comment(text: str) -> Iterator[str]:
    lines = text.replace("*/", "* /").splitlines()
    yield f"/* {lines[0]}" + (" */" if len(lines) == 1 else "")
    for line in lines[1:]:
        yield f" * {line}".rstrip()
    if len(lines) > 1:
        yield " */"
