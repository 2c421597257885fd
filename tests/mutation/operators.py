"""Small changes to one module's source, each of which a test should notice."""

import ast
import copy
from collections.abc import Iterator
from dataclasses import dataclass

_BOUNDARY: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt,
}  # fmt: skip
_INVERSE: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.GtE, ast.LtE: ast.Gt, ast.Gt: ast.LtE, ast.GtE: ast.Lt, ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq, ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
}  # fmt: skip
_ARITHMETIC: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult, ast.Mod: ast.Mult, ast.Pow: ast.Mult, ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd, ast.BitXor: ast.BitAnd, ast.LShift: ast.RShift, ast.RShift: ast.LShift,
}  # fmt: skip
_CALLS = {"min": "max", "max": "min", "any": "all", "all": "any", "sin": "cos", "cos": "sin"}
_SMALL = 10
"""Integers from here on are taken for quantities, which change by a quarter."""


@dataclass(frozen=True, slots=True)
class Mutant:
    """One change of one module."""

    name: str
    """Function or constant, and the change: stays the same when lines move."""
    tree: ast.Module
    scope: str
    """Qualified name of the outermost function, or of the constant."""
    lines: range
    """Those of the changed node."""


def mutants_of(source: str) -> Iterator[Mutant]:
    """Every mutant of a module; trees share nothing, names are unique."""
    tree = ast.parse(source)
    seen: dict[str, int] = {}
    for scope, path, node in _walk(tree, (), "", is_inside=False):
        for changed in _changes(node):
            name = f"{scope}: {_difference(node, changed)}"
            seen[name] = seen.get(name, 0) + 1
            if seen[name] > 1:
                name = f"{name} #{seen[name]}"
            lines = range(node.lineno, (node.end_lineno or node.lineno) + 1)
            yield Mutant(name, _replaced(tree, path, changed), scope, lines)


_Path = tuple[tuple[str, int | None], ...]
_Node = ast.stmt | ast.expr


def _walk(
    node: ast.AST, path: _Path, scope: str, *, is_inside: bool
) -> Iterator[tuple[str, _Path, _Node]]:
    """Nodes whose code can be exchanged at run time, each with its scope and the way to it."""
    for field, value in ast.iter_fields(node):
        if field in ("annotation", "returns", "decorator_list", "args", "bases", "keywords") and (
            isinstance(node, ast.FunctionDef | ast.ClassDef | ast.AnnAssign | ast.Lambda)
        ):
            continue
        children = enumerate(value) if isinstance(value, list) else [(None, value)]
        for index, child in children:
            if not isinstance(child, ast.AST) or _is_text(child):
                continue
            if isinstance(child, ast.Assign) and isinstance(node, ast.ClassDef):
                continue  # the values of an enumeration
            if isinstance(child, ast.AnnAssign) and ast.unparse(child.annotation) == "TypeAlias":
                continue
            inner, inside = scope, is_inside
            if isinstance(child, ast.FunctionDef | ast.ClassDef) and not is_inside:
                inner = f"{scope}.{child.name}".lstrip(".")
                inside = isinstance(child, ast.FunctionDef)
            elif not is_inside and isinstance(child, ast.AnnAssign | ast.Assign | ast.AugAssign):
                target = child.targets[0] if isinstance(child, ast.Assign) else child.target
                inner = f"{scope}.{ast.unparse(target)}".lstrip(".")
            way = (*path, (field, index))
            if isinstance(child, ast.stmt | ast.expr) and (
                is_inside or isinstance(child, ast.expr)
            ):
                yield inner, way, child
            yield from _walk(child, way, inner, is_inside=inside)


def _is_text(node: ast.AST) -> bool:
    """A docstring, or words for the user: their wording is nothing to test."""
    if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
        return True
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return " " in node.value
    is_check = isinstance(node, ast.keyword) and node.arg == "strict"
    return is_check or isinstance(node, ast.Assert | ast.JoinedStr)


def _replaced(tree: ast.Module, path: _Path, changed: ast.AST) -> ast.Module:
    whole = copy.deepcopy(tree)
    node: ast.AST = whole
    for field, index in path[:-1]:
        value = getattr(node, field)
        node = value if index is None else value[index]
    field, index = path[-1]
    if index is None:
        setattr(node, field, changed)
    else:
        getattr(node, field)[index] = changed
    return ast.fix_missing_locations(whole)


def _difference(node: ast.AST, changed: ast.AST) -> str:
    if isinstance(node, ast.Call) and isinstance(changed, ast.Call):
        kept = {keyword.arg for keyword in changed.keywords}
        for keyword in node.keywords:
            if keyword.arg not in kept:
                return f"{ast.unparse(node.func)}(...) without {ast.unparse(keyword)}"
    return f"{_shown(node)} -> {_shown(changed)}"


def _shown(node: ast.AST) -> str:
    lines = ast.unparse(node).splitlines()
    return lines[0] if len(lines) == 1 else f"{lines[0]} ..."


def _changes(node: _Node) -> Iterator[ast.AST]:
    """The node with one change, for each that its kind allows."""
    for changed in _of_expression(node) if isinstance(node, ast.expr) else _of_statement(node):
        yield ast.copy_location(changed, node)


def _with(node: ast.AST, **fields: object) -> ast.AST:
    """A copy with other fields."""
    made = copy.deepcopy(node)
    for name, value in fields.items():
        setattr(made, name, value)
    return made


def _of_statement(node: ast.stmt) -> Iterator[ast.AST]:
    match node:
        case ast.If() | ast.While():
            yield _with(node, test=ast.Constant(False))
            if isinstance(node, ast.If):
                yield _with(node, test=ast.Constant(True))
        case ast.For():
            yield _with(node, iter=ast.Tuple(elts=[], ctx=ast.Load()))
        case ast.Match(cases=cases):
            for k, case in enumerate(cases):
                never = _with(case, guard=ast.Constant(False))
                yield _with(node, cases=[*cases[:k], never, *cases[k + 1 :]])
                if case.guard is not None:
                    always = _with(case, guard=None)
                    yield _with(node, cases=[*cases[:k], always, *cases[k + 1 :]])
        case ast.Return(value=value) if value is not None and ast.unparse(value) != "None":
            yield ast.Return(value=None)
        case (
            ast.Expr() | ast.Assign() | ast.AugAssign() | ast.Continue() | ast.Break() | ast.Raise()
        ):
            yield ast.Pass()


def _of_expression(node: ast.expr) -> Iterator[ast.AST]:
    match node:
        case ast.Compare(ops=ops):
            for table in (_BOUNDARY, _INVERSE):
                for k, op in enumerate(ops):
                    if type(op) in table:
                        yield _with(node, ops=[*ops[:k], table[type(op)](), *ops[k + 1 :]])
        case ast.BinOp(op=op) if type(op) in _ARITHMETIC:
            yield _with(node, op=_ARITHMETIC[type(op)]())
        case ast.BoolOp() | ast.IfExp() | ast.UnaryOp():
            yield from _of_condition(node)
        case ast.Call():
            yield from _of_call(node)
        case ast.Constant(value=value):
            yield from _of_constant(value)


def _of_condition(node: ast.expr) -> Iterator[ast.AST]:
    match node:
        case ast.BoolOp(values=values):
            for k in range(len(values)):
                rest = [*values[:k], *values[k + 1 :]]
                yield rest[0] if len(rest) == 1 else _with(node, values=rest)
        case ast.IfExp(body=body, orelse=orelse):
            yield from (body, orelse)
        case ast.UnaryOp(op=ast.Not() | ast.USub(), operand=operand):
            yield operand


def _of_call(node: ast.Call) -> Iterator[ast.AST]:
    match node.func:
        case ast.Name(id=name) if name in _CALLS:
            yield _with(node, func=ast.Name(id=_CALLS[name], ctx=ast.Load()))
        case ast.Attribute(attr=name) if name in _CALLS:
            yield _with(node, func=_with(node.func, attr=_CALLS[name]))
        case ast.Name(id="abs"):
            yield node.args[0]
    for k, keyword in enumerate(node.keywords):
        if keyword.arg != "strict":  # a check of lengths that are equal
            yield _with(node, keywords=[*node.keywords[:k], *node.keywords[k + 1 :]])


def _of_constant(value: object) -> Iterator[ast.AST]:
    match value:
        case bool():
            yield ast.Constant(not value)
        case int() if abs(value) >= _SMALL:
            yield ast.Constant(round(value * 1.25))
        case int():
            yield ast.Constant(value + 1)
        case float():
            yield ast.Constant(value * 1.25 if value else 1.0)
        case str() | bytes() if value:
            yield ast.Constant(value[:-1])
