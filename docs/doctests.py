"""For the reference pages: the examples of docstrings, which stand there without a heading, become blocks of code."""

from typing import Any

import griffe


def fenced(text: str) -> str:
    """A docstring in which every doctest, with its output, is a fenced block.

    >>> print(fenced("Sums.\\n\\n>>> 1 + 1\\n2"))
    Sums.
    <BLANKLINE>
    ```pycon
    >>> 1 + 1
    2
    ```
    """
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


class Doctests(griffe.Extension):
    """Changes the docstring of every class, function and module when it has been read."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        if obj.docstring and ">>> " in obj.docstring.value:
            obj.docstring.value = fenced(obj.docstring.value)
