"""For the reference pages: examples in docstrings become blocks of code, comments of fields their descriptions.

The examples stand in docstrings without a heading. The shape and unit of a field stand in a comment behind it.
"""

import io
import re
import tokenize
from functools import cache
from pathlib import Path
from typing import Any

import griffe


def fenced(text: str) -> str:
    """A docstring in which every doctest, with its output, is a fenced block."""
    lines: list[str] = []
    inside = False
    for line in text.splitlines():
        if not inside and line.startswith(">>> "):
            lines.append("```pycon")
            inside = True
        elif inside and not line:
            lines.append("```")
            inside = False
        lines.append(line)
    return "\n".join([*lines, "```"] if inside else lines)


@cache
def comments(path: Path) -> dict[int, str]:
    """The comments of a file by the number of their line."""
    tokens = tokenize.generate_tokens(io.StringIO(path.read_text()).readline)
    return {token.start[0]: token.string.lstrip("# ") for token in tokens if token.type == tokenize.COMMENT}


def starred(text: str) -> str:
    """A docstring in whose prose the star of an optimum, as in x*, begins no emphasis. Code is indented."""
    return re.sub(r"^(?!    ).*$", lambda line: re.sub(r"(?<![\w*])(\w)\*(?!\*)", r"\1\\*", line[0]), text, flags=re.M)


class Doctests(griffe.Extension):
    """Changes the docstring of every class, function and module when it has been read."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        if obj.docstring and ">>> " in obj.docstring.value:
            obj.docstring.value = fenced(obj.docstring.value)
        if obj.docstring and obj.is_module:
            obj.docstring.value = starred(obj.docstring.value)

    def on_attribute(self, *, attr: griffe.Attribute, **_: Any) -> None:
        """Only fields of classes, which are annotated and described on their line."""
        if attr.docstring is None and attr.annotation is not None and isinstance(attr.parent, griffe.Class):
            said = comments(Path(str(attr.filepath))).get(attr.endlineno or 0)
            if said:
                attr.docstring = griffe.Docstring(said, parent=attr, lineno=attr.lineno, endlineno=attr.endlineno)
