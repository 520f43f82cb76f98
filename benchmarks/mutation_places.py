"""The places of a source file that `mutations.py` changes, and the text with one of them changed."""

from __future__ import annotations

import ast
import copy
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

NUMBERS = (0, 1)  # constants that are exchanged; others are doubled
COMPARED: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
}  # fmt: skip
COMPUTED: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.FloorDiv: ast.Mult, ast.Mod: ast.Mult,
    ast.LShift: ast.RShift, ast.RShift: ast.LShift, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd,
}  # fmt: skip
NAMES = {"min": "max", "max": "min", "minimum": "maximum", "maximum": "minimum", "any": "all", "all": "any"}


class Place(NamedTuple):
    """One change of one expression."""

    group: str
    function: str  # with its class
    expression: str
    becomes: str
    count: int  # of the same change in the same function before it


class Visitor(ast.NodeVisitor):
    """Every change of a module: its function, the node, and the node that takes its place."""

    def __init__(self) -> None:
        self.scope: list[str] = []
        self.nodes: list[tuple[str, ast.AST]] = []  # all, with their function; "" is the module
        self.found: list[tuple[str, ast.AST, ast.AST]] = []

    def _scoped(self, node: ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef) -> None:
        self.scope.append(node.name)
        for child in node.body:
            self.visit(child)
        self.scope.pop()

    visit_ClassDef = visit_FunctionDef = visit_AsyncFunctionDef = _scoped

    def visit(self, node: ast.AST) -> None:
        if isinstance(node, (ast.Raise, ast.Assert)) or _is_text(node):
            return  # messages and docstrings
        if isinstance(node, ast.AnnAssign):  # its annotation is none of the places
            return self.visit(node.value) if node.value else None
        self.nodes.append((".".join(self.scope), node))
        if self.scope:
            others = (other for other in changes(node) if shown(other) != shown(node))
            self.found += [(".".join(self.scope), node, other) for other in others]
        super().visit(node)


def _is_text(node: ast.AST) -> bool:
    return isinstance(node, ast.JoinedStr) or (isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant))


def changes(node: ast.AST) -> Iterator[ast.AST]:
    """What may take the place of a node.

    >>> [ast.unparse(other) for other in changes(ast.parse("a < b", mode="eval").body)]
    ['a <= b']
    """
    other: Any = copy.deepcopy(node)
    if isinstance(node, ast.Compare) and type(node.ops[0]) in COMPARED:
        other.ops[0] = COMPARED[type(node.ops[0])]()
    elif isinstance(node, (ast.BinOp, ast.AugAssign)) and type(node.op) in COMPUTED:
        other.op = COMPUTED[type(node.op)]()
        if isinstance(node, ast.AugAssign):
            yield ast.Pass()
    elif isinstance(node, ast.BoolOp):
        other.op = ast.Or() if isinstance(node.op, ast.And) else ast.And()
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, (ast.Not, ast.USub)):
        other = other.operand
    elif isinstance(node, ast.IfExp):
        other.body, other.orelse = other.orelse, other.body
    elif isinstance(node, ast.If):
        other.test = ast.UnaryOp(ast.Not(), other.test)
    elif isinstance(node, ast.Constant) and type(node.value) in (int, float):
        other.value = 1 - node.value if node.value in NUMBERS else 2 * node.value
    elif isinstance(node, ast.Call) and (name := getattr(node.func, "id", getattr(node.func, "attr", ""))) in NAMES:
        setattr(other.func, "id" if isinstance(node.func, ast.Name) else "attr", NAMES[name])
    elif isinstance(node, ast.Call) and len(node.args) == 2 and not any(isinstance(x, ast.Starred) for x in node.args):
        other.args.reverse()
    else:
        return
    yield other


def shown(node: ast.AST) -> str:
    """The node as text, in one line; of a branch the condition."""
    text = ast.unparse(node.test) if isinstance(node, ast.If) else ast.unparse(node)
    return f"if {text}" if isinstance(node, ast.If) else " ".join(text.split())


def places(group: str, source: Path) -> Iterator[tuple[Place, ast.AST, ast.AST]]:
    """The places of a source file, and both nodes of each."""
    visitor, seen = Visitor(), Counter[tuple[str, str, str]]()
    visitor.visit(ast.parse(source.read_text()))
    for function, node, other in visitor.found:
        key = function, shown(node), shown(other)
        yield Place(group, *key, seen[key]), node, other
        seen[key] += 1


def written(place: Place, source: Path) -> Iterator[tuple[Place, ast.AST, ast.AST]]:
    """A place that is no change of `changes`, where a source file contains it."""
    visitor = Visitor()
    visitor.visit(ast.parse(source.read_text()))
    nodes = [x for function, x in visitor.nodes if function == place.function and shown(x) == place.expression]
    for node in nodes[place.count : place.count + 1]:
        yield place, node, ast.parse(place.becomes, mode="eval").body


def changed(source: Path, node: ast.AST, other: ast.AST) -> str:
    """The text of a source file with another node in the place of one."""
    lines = source.read_bytes().splitlines(keepends=True)
    target: Any = node.test if isinstance(node, ast.If) else node
    new: Any = other.test if isinstance(other, ast.If) else other
    text = ast.unparse(new) if isinstance(new, ast.stmt) else f"({ast.unparse(new)})"
    first, last = target.lineno - 1, target.end_lineno - 1
    head, tail = lines[first][: target.col_offset], lines[last][target.end_col_offset :]
    joined = head + text.encode() + b"\n" * (last - first) * isinstance(new, ast.stmt) + tail
    return b"".join([*lines[:first], joined, *lines[last + 1 :]]).decode()
