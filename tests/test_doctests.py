"""The examples in docstrings run: by default all but those of two modules that take seconds."""

import importlib
import inspect
from doctest import DocTestFinder, DocTestRunner
from functools import cached_property

import pytest

from tests.support import ROOT

FOLDERS = "certify", "usvlearn", "tests/support", "benchmarks"
SOURCES = [path for folder in FOLDERS for path in sorted((ROOT / folder).rglob("*.py"))]
MODULES = [
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
    for path in SOURCES
    if ">>> " in path.read_text()
]
DEAR = ["usvlearn.api", "usvlearn.learned"]
QUICK = [name for name in MODULES if name not in DEAR]


def cached(value: object) -> list:
    """The functions behind the cached properties of a class, or of a module's classes, which doctest passes over."""
    named = vars(value).values() if inspect.ismodule(value) else [value]
    classes = [each for each in named if isinstance(each, type) and inspect.getmodule(each) is inspect.getmodule(value)]
    return [each.func for cls in classes for each in vars(cls).values() if isinstance(each, cached_property)]


def failures(value: object, name: str) -> str:
    """What the examples of a module, class or function print in place of what they show."""
    printed: list[str] = []
    examples = [
        test
        for each in (value, *cached(value))
        for test in DocTestFinder(exclude_empty=True).find(each, name, module=inspect.getmodule(value))
    ]
    assert any(test.examples for test in examples), f"{name} has no example"
    for test in examples:
        DocTestRunner().run(test, out=printed.append)
    return "".join(printed)


@pytest.mark.parametrize("names", [QUICK, pytest.param(DEAR, marks=pytest.mark.thorough)], ids=["quick", "dear"])
def test_examples_of_every_module(names):
    assert "".join(failures(importlib.import_module(name), name) for name in names) == ""


def test_a_wrong_example_is_reported():
    def wrong():
        """Is wrong.

        >>> 1 + 1
        3
        """

    assert "Expected:\n    3\nGot:\n    2" in failures(wrong, "wrong")
