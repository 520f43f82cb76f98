"""The pages of results: their folder, how a script writes its page, and the table of all."""

import ast
import re
from collections.abc import Sequence
from pathlib import Path

HERE = Path(__file__).parent
FOLDER = HERE.parent / "docs" / "benchmarks"
OTHERS = {  # pages without a script of their name: what makes them, and what they have
    "live_moosdb": ("python benchmarks/live_moos.py PORT", "The same through a real MOOSDB, with a boat and a viewer."),
    "study": ("python evaluate.py experiment=paper", "The paper's study: tuned on one season, judged on the next."),
}


def publish(script: str, text: str | Sequence[str], name: str | None = None) -> None:
    """Print a page and write it to the folder; by default it has the name of its script.

    Args:
        script: `__file__` of the script.
        text: Markdown, whole or in lines.
        name: of the page, without `.md`.
    """
    whole = (text if isinstance(text, str) else "\n".join(text)).rstrip("\n") + "\n"
    print(whole, end="")
    (FOLDER / f"{name or Path(script).stem}.md").write_text(whole)


def listing() -> list[str]:
    """Which command makes which page, as a table in Markdown: all pages of the folder but its index."""
    rows = []
    for path in sorted(FOLDER.glob("*.md")):
        if path.stem == "index":
            continue
        title = path.read_text().partition("\n")[0].removeprefix("# ")
        command, what = OTHERS.get(path.stem) or _told(path.stem)
        rows.append(f"| [{title}]({path.name}) | `{command}` | {what} |")
    return ["| page | made by | content |", "|---|---|---|", *rows]


def _told(name: str) -> tuple[str, str]:
    """How the script of a page is called, and what it measures, by its docstring."""
    first, _, rest = (ast.get_docstring(ast.parse((HERE / f"{name}.py").read_text())) or "").partition("\n")
    command = f"python benchmarks/{name}.py"
    usage = re.search(rf"^{re.escape(command)}[^\n]*?(?=  |$)", rest, re.MULTILINE)
    return (usage[0] if usage else command), first
