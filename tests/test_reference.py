"""Everything that the pages of docs/reference list tells its arguments, units, results, errors, source and an example.

`lacking` counts what is missing, by kind. Public are the objects behind `:::` and the methods that they add, but for
those that the option `members` leaves out of the page. A method that overrides one of its base class inherits the
description. A comment behind a field of a NamedTuple or of a dataclass describes the field, as it does on the site.
"""

from __future__ import annotations

import ast
import dataclasses
import functools
import inspect
import io
import re
import textwrap
import tokenize
from collections import Counter
from collections.abc import Iterator
from typing import Any, ForwardRef, NamedTuple

import numpy as np

import usvlearn
from tests.support.reference import blocks, listed
from usvlearn.errors import ConfigError

EQUATIONS = ("estimators", "ensembles")  # pages whose classes have equations, and hence a source
NO_EQUATION = {"usvlearn.Estimator", "usvlearn.Positive", "usvlearn.UnitInterval", "usvlearn.ForecastSettings"}

NUMERIC = re.compile(r"\b(float|int|Tensor|ndarray|Array|ArrayLike|Hyper|Fraction)\b")
UNITS = (
    "m/s²", "m/s", "s/m", "m²/s²", "s²/m²", "rad/s", "rad", "kg/m", "kg/s", "kg/rad", "kg", "N s/m", "N/kg", "N·m", "N",
    "Hz", "1/s", "1/rad", "1/h", "s", "min", "h", "m", "mm", "°", "%", "bytes", "share", "shares", "no unit",
    "without a unit", "count", "number of", "index", "seed", "bool", "SI units",
)  # fmt: skip
UNIT = re.compile(r"(?<![\w'’*/^])(?:" + "|".join(re.escape(unit) for unit in UNITS) + r")(?![\w'’*/²(])")
SHAPE = re.compile(r"\(\d+,\)|\((?=[^()]*[a-z…])(?=[^()]*,)\*?[\w…]+(?: \+ \w+)?(?:, ?\*?[\w…]*(?: \+ \w+)?)*\)")
AUTHORS = r"[A-Z][\w-]+(?: et al\.| (?:and|&) [A-Z][\w-]+)?,? (?:19|20)\d\d"
SOURCE = re.compile(rf"docs/(?:theory|certification)|\b[Pp]aper, section|{AUTHORS}")
CHECKS = re.compile(r"_?check(?:ed|_\w+)?")  # functions of these names raise


class Lack(NamedTuple):
    kind: str  # "args", "units", "returns", "raises", "sources", "examples" or "docstrings"
    name: str
    what: str


def sections(docstring: str) -> dict[str, dict[str, str]]:
    """The sections of a Google docstring: title -> name -> description; a text without a name is called by "".

    >>> sections("Sum.\\n\\nArgs:\\n    x: a number\\n        of N.\\n\\nReturns:\\n    m/s.\\n")
    {'Args': {'x': 'a number of N.'}, 'Returns': {'': 'm/s.'}}
    """
    parts: dict[str, dict[str, str]] = {}
    title = name = ""
    for line in docstring.splitlines():
        if heading := re.fullmatch(r"(Args|Attributes|Returns|Yields|Raises):", line):
            title, name = heading[1], ""
            parts[title] = {}
        elif line and not line.startswith(" "):
            title = ""
        elif title and line:
            item = re.match(r"    (\*{0,2}[\w., ]+?)(?: \([^)]*\))?: (.*)", line)
            if item and title not in ("Returns", "Yields"):
                name = item[1].lstrip("*")
                parts[title][name] = item[2]
            else:
                parts[title][name] = f"{parts[title].get(name, '')} {line.strip()}".strip()
    return parts


def fields(cls: type) -> tuple[str, ...]:
    """Of a NamedTuple or dataclass, in the order in which its constructor takes them."""
    if issubclass(cls, tuple):
        return getattr(cls, "_fields", ())
    return tuple(field.name for field in dataclasses.fields(cls) if field.init) if dataclasses.is_dataclass(cls) else ()


def field_comments(cls: type) -> dict[str, str]:
    """What stands in a comment behind each annotated field."""
    source = textwrap.dedent(inspect.getsource(cls))
    comments = {
        token.start[0]: token.string.lstrip("# ")
        for token in tokenize.generate_tokens(io.StringIO(source).readline)
        if token.type == tokenize.COMMENT
    }
    (body,) = ast.parse(source).body
    assert isinstance(body, ast.ClassDef)
    return {
        node.target.id: comments[node.end_lineno or 0]
        for node in body.body
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) and node.end_lineno in comments
    }


def examples(docstring: str | None) -> str:
    """The lines of code of the doctests."""
    return "\n".join(re.findall(r"^\s*(?:>>>|\.\.\.) (.*)$", docstring or "", re.MULTILINE))


def annotation_of(value: Any) -> str:
    if isinstance(value, ForwardRef):
        return value.__forward_arg__
    return "" if value is inspect.Parameter.empty else inspect.formatannotation(value)


def raised(function: Any) -> set[str]:
    """The names of what a function raises in its own code; "checks" where it calls a function that checks."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
    guarded = {
        id(below) for node in ast.walk(tree) if isinstance(node, ast.Try) for x in node.body for below in ast.walk(x)
    }
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call) and id(node) not in guarded:
            name = ast.unparse(node.exc.func).rsplit(".", 1)[-1]
            names.add(name if name[:1].isupper() else "checks")
        elif isinstance(node, ast.Call) and id(node) not in guarded:
            if CHECKS.fullmatch(ast.unparse(node.func).rsplit(".", 1)[-1]):
                names.add("checks")
    return names


def parameters_lack(name: str, parameters: dict[str, str], said: dict[str, str]) -> Iterator[Lack]:
    """Of parameters by their annotation, and of what is said of them."""
    for parameter, annotation in parameters.items():
        if parameter not in said:
            yield Lack("args", name, parameter)
        if NUMERIC.search(annotation) and not has_unit(said.get(parameter, "")):
            yield Lack("units", name, f"{parameter}: {annotation}")


def has_unit(text: str) -> bool:
    return bool(UNIT.search(text) or SHAPE.search(text))


def errors_lack(name: str, function: Any, said: dict[str, str]) -> Iterator[Lack]:
    missing = {error for error in raised(function) if not (said if error == "checks" else error in said)}
    if missing:
        yield Lack("raises", name, ", ".join(sorted(missing)))


def function_lacks(name: str, function: Any, shown: str = "") -> Iterator[Lack]:
    """Of a function or method; `shown` are the examples of its class."""
    docstring = inspect.getdoc(function) or ""
    if not docstring:
        yield Lack("docstrings", name, "")
    said, signature = sections(docstring), inspect.signature(function)
    parameters = {
        each.name: annotation_of(each.annotation)
        for each in signature.parameters.values()
        if each.name not in ("self", "cls")
    }
    yield from parameters_lack(name, parameters, said.get("Args", {}))
    returns = annotation_of(signature.return_annotation)
    if returns.strip("'\"") not in ("", "None", "NoReturn", "Self"):
        text = " ".join([*said.get("Returns", {}).values(), *said.get("Yields", {}).values()])
        if not text:
            yield Lack("returns", name, returns)
        elif NUMERIC.search(returns) and not has_unit(text):
            yield Lack("units", name, f"returns {returns}")
    yield from errors_lack(name, function, said.get("Raises", {}))
    if not (examples(docstring) or re.search(rf"\.{function.__name__}\b", shown)):
        yield Lack("examples", name, "")


def property_lacks(name: str, value: property | functools.cached_property) -> Iterator[Lack]:
    getter = value.fget if isinstance(value, property) else value.func
    docstring, returns = inspect.getdoc(getter) or "", annotation_of(inspect.signature(getter).return_annotation)
    if not docstring:
        yield Lack("docstrings", name, "")
    if NUMERIC.search(returns) and not has_unit(docstring):
        yield Lack("units", name, f"returns {returns}")
    yield from errors_lack(name, getter, sections(docstring).get("Raises", {}))


def class_lacks(name: str, cls: type, page: str, shown_members: Any) -> Iterator[Lack]:
    docstring = inspect.cleandoc(cls.__doc__ or "")
    if not docstring:
        yield Lack("docstrings", name, "")
    members = fields(cls)
    constructor = next((vars(base)["__init__"] for base in cls.__mro__ if "__init__" in vars(base)), None)
    ours = inspect.isfunction(constructor) and constructor.__module__.split(".")[0] in ("usvlearn", "certify")
    said = sections(docstring)
    for title, entries in sections(inspect.getdoc(constructor) or "" if ours else "").items():
        said.setdefault(title, {}).update(entries)
    arguments = said.get("Attributes", {}) | said.get("Args", {})
    if members:
        yield from parameters_lack(
            name, {each: annotation_of(field_type(cls, each)) for each in members}, field_comments(cls) | arguments
        )
    elif ours:
        signature = inspect.signature(cls)
        parameters = {each.name: annotation_of(each.annotation) for each in signature.parameters.values()}
        yield from parameters_lack(name, parameters, said.get("Args", {}))
    for checks in ("__init__", "__post_init__", "__new__"):
        if inspect.isfunction(vars(cls).get(checks)) and inspect.getsourcefile(
            vars(cls)[checks]
        ) == inspect.getsourcefile(cls):
            yield from errors_lack(name, vars(cls)[checks], said.get("Raises", {}))
    if page in EQUATIONS and name not in NO_EQUATION and not SOURCE.search(docstring):
        yield Lack("sources", name, "")
    shown = "\n".join(examples(inspect.getdoc(value)) for value in (cls, *vars(cls).values()) if value.__doc__)
    if not examples(docstring):
        yield Lack("examples", name, "")
    for key, value in vars(cls).items():
        if key.startswith("_") or key in members or inherits(cls, key):
            continue
        if shown_members is False or (isinstance(shown_members, list) and key not in shown_members):
            continue
        path = f"{name}.{key}"
        if isinstance(value, property | functools.cached_property):
            yield from property_lacks(path, value)
        elif isinstance(value, staticmethod | classmethod):
            yield from function_lacks(path, value.__func__, shown)
        elif inspect.isfunction(value):
            yield from function_lacks(path, value, shown)


def field_type(cls: type, name: str) -> Any:
    return next(vars(base)["__annotations__"][name] for base in cls.__mro__ if name in inspect.get_annotations(base))


def inherits(cls: type, key: str) -> bool:
    """Whether a class that the method or attribute comes from describes it."""
    return any(
        (key in vars(base) and inspect.isroutine(vars(base)[key]) and inspect.getdoc(vars(base)[key]))
        or key in sections(inspect.cleandoc(base.__doc__ or "")).get("Attributes", {})
        for base in cls.__mro__[1:]
    )


def lacking() -> list[Lack]:
    lacks: list[Lack] = []
    for name, (value, page, members) in listed().items():
        if inspect.isclass(value):
            lacks += class_lacks(name, value, page, members)
        else:
            lacks += function_lacks(name, value)
    return lacks


def test_everything_public_is_described():
    lacks = lacking()
    print(*(f"{lack.kind:10} {lack.name}: {lack.what}" for lack in sorted(lacks)), sep="\n")
    assert Counter(lack.kind for lack in lacks) == {}


def test_the_pages_list_all_that_they_did():
    assert len(listed()) >= 114


def bare(mass: float, names: list[str]) -> np.ndarray:
    """Without anything."""
    raise ConfigError("mass: found nothing")


class Unit(NamedTuple):
    """Two fields.

    >>> Unit(1.0, 2.0).known
    1.0
    """

    known: float  # m/s
    unknown: float  # of it


def test_what_is_missing_is_counted():
    kinds = Counter(lack.kind for lack in function_lacks("bare", bare))
    assert kinds == {"args": 2, "units": 1, "returns": 1, "raises": 1, "examples": 1}
    assert [lack.what for lack in class_lacks("Unit", Unit, "model", True)] == ["unknown: float"]


def test_every_public_name_is_on_a_page():
    assert not {f"usvlearn.{name}" for name in (*usvlearn._HOME, *usvlearn.__all__)} - blocks().keys()
