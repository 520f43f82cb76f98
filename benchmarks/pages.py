"""The pages of results: their folder, and how a script writes its page. `docs/benchmarks.md` lists them."""

from collections.abc import Sequence
from pathlib import Path

FOLDER = Path(__file__).parents[1] / "docs" / "benchmarks"


def publish(script: str, text: str | Sequence[str]) -> None:
    """Print a page and write it to the folder, under the name of its script."""
    whole = (text if isinstance(text, str) else "\n".join(text)).rstrip("\n") + "\n"
    print(whole, end="")
    (FOLDER / f"{Path(script).stem}.md").write_text(whole)
