"""The files of a report: one page, its figures and tables, and the same for TensorBoard."""

from __future__ import annotations

import io
import json
import re
import zlib
from collections.abc import Mapping, Sequence
from functools import partial
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from usvlearn.core.checkpoint import write_atomically
from usvlearn.core.lock import NAME as LOCK
from usvlearn.display.figures import INK, LINE, attempted, rendered, themed
from usvlearn.display.tensorboard import TensorBoardWriter
from usvlearn.errors import ConfigError
from usvlearn.evaluation.crossval import FreeErrors
from usvlearn.report.document import TITLE, page
from usvlearn.report.front import Front
from usvlearn.report.sections.section import Section

FOLDERS, FILES = ("figures", "tables", "tensorboard"), "files.json"  # a report's, and the list of its files in them
LINKED = 40  # a table with more rows is a link in `report.md`


def write_report(
    folder: Path,
    facts: Sequence[str],
    sections: Sequence[Section],
    commands: Sequence[str] = (),
    errors: Mapping[str, FreeErrors] | None = None,
    front: Front | None = None,
) -> Path:
    """Write `index.html`, `report.md`, `figures/*.png` and `*.svg`, `tables/*.csv` and `*.md`, `tensorboard/`.

    Args:
        folder: of the report; files of an earlier report are replaced.
        facts: the data on which it is based, one sentence each.
        sections: in their order.
        commands: that make the report again.
        errors: of each boat's cross-validation, for `crossval.npz`: BOAT_mae `(sets, runs, methods)` …
        front: what stands before the sections on the page.

    Returns:
        The path of the page.
    """
    check_report_folder(folder)
    figures = {drawn.name: drawn.figure for section in sections for drawn in section.figures}
    drawings = {name: attempted(partial(_drawing, name, each), name, partial(_drawing, name))
                for name, each in figures.items()}  # fmt: skip
    for old in _written(folder):
        (folder / old).unlink(missing_ok=True)
    foreign = _present(folder)  # what is left was written by somebody else, or by a report that was cut short
    inline = {name: drawing for name, (drawing, _, _) in drawings.items()}
    images = {name: png for name, (_, _, png) in drawings.items()}
    images |= {drawn.name: rendered(drawn.figure, facecolor="white") for drawn in (front.pictures if front else ())}
    for name, (_, whole, _) in drawings.items():
        write_atomically(folder / "figures" / f"{name}.svg", whole)
    for name, png in images.items():
        write_atomically(folder / "figures" / f"{name}.png", png)
    for section in sections:
        for each in section.sheets:
            write_atomically(folder / "tables" / f"{each.name}.csv", each.csv().encode())
            write_atomically(folder / "tables" / f"{each.name}.md", (each.markdown() + "\n").encode())
    write_atomically(folder / "report.md", _markdown(facts, sections, commands).encode())
    with TensorBoardWriter(folder / "tensorboard") as board:
        for section in sections:
            board.text(f"report/{section.key}", _section_markdown(section, files=False))
            for drawn in section.figures:
                board.image(f"report/{drawn.name}", images[drawn.name])
    if errors:
        content = io.BytesIO()
        named = {f"{boat}_{name}": x for boat, found in errors.items() for name, x in found._asdict().items()}
        np.savez_compressed(content, **named)
        write_atomically(folder / "crossval.npz", content.getvalue())
    index = folder / "index.html"
    own = {f"figures/{name}.svg" for name in drawings} | {f"figures/{name}.png" for name in images}
    own |= {f"tables/{each.name}.{kind}" for section in sections for each in section.sheets for kind in ("csv", "md")}
    names = sorted(path for path in _present(folder) if path in own or path not in foreign)
    write_atomically(folder / FILES, json.dumps(names, indent=2).encode())
    write_atomically(index, page(facts, sections, commands, inline, front, images).encode())
    return index


def check_report_folder(folder: Path) -> None:
    """Make the folder of a report, which may contain only an earlier report, and check that figures can be drawn.

    Raises:
        ConfigError: it contains something else.
        MissingExtraError: matplotlib is not installed.
    """
    with themed():
        pass
    found = {path.name for path in folder.iterdir()} if folder.is_dir() else set()
    if found - {LOCK} and FILES not in found:
        raise ConfigError(f"report: {folder} holds something that is no report: name another folder")
    for kind in FOLDERS:
        if (folder / kind).is_symlink():
            raise ConfigError(f"report: {folder / kind} is a link to another folder: remove it")
        (folder / kind).mkdir(parents=True, exist_ok=True)
    if not (folder / FILES).exists():
        write_atomically(folder / FILES, b"[]")


def _written(folder: Path) -> list[str]:
    """The files that an earlier report has written into its folders; a list that names other files is ignored."""
    try:
        names = [Path(name) for name in json.loads((folder / FILES).read_text())]
    except (OSError, ValueError, TypeError):
        return []
    return [str(name) for name in names if len(name.parts) == 2 and name.parts[0] in FOLDERS and name.name != ".."]


def _present(folder: Path) -> set[str]:
    """The files in a report's folders, as `FILES` names them."""
    return {f"{kind}/{path.name}" for kind in FOLDERS for path in (folder / kind).iterdir() if path.is_file()}


def _drawing(name: str, figure: Any) -> tuple[str, bytes, bytes]:
    """A figure as SVG for the page, whose theme it follows, and as separate SVG and PNG files."""
    from matplotlib import rc_context

    figure.draw_without_rendering()  # once: each file would lay the figure out anew
    figure.set_layout_engine(None)  # with "none", each file would be drawn twice
    box = figure.get_tightbbox().padded(0.05)

    def saved(**options: Any) -> bytes:
        content = io.BytesIO()
        figure.savefig(content, bbox_inches=box, **options)
        return content.getvalue()

    with rc_context({"svg.fonttype": "none", "svg.hashsalt": name}):
        inline = saved(format="svg", transparent=True, metadata={"Date": None}).decode()
    whole = re.sub("(<svg[^>]*>)", r'\1<rect width="100%" height="100%" fill="white"/>', inline, count=1).encode()
    png = saved(format="png", dpi=150, facecolor="white")
    inline = inline[inline.index("<svg") :]
    inline = re.sub(r'<metadata>.*?</metadata>| id="image\w+"', "", inline, flags=re.DOTALL)  # equal images, equal ids
    own = f"g{zlib.crc32(name.encode()):x}-"  # ids of one page differ; a name may hold any character
    inline = re.sub(r'(id="|href="#|url\(#)', rf"\g<1>{own}", inline)
    for colour, variable in {INK: "currentColor", "#222222": "currentColor", LINE: "var(--line)",
                             "#eeeeee": "var(--line)", "#000000": "currentColor"}.items():  # fmt: skip
        inline = re.sub(re.escape(colour), variable, inline, flags=re.IGNORECASE)
    width = figure.get_size_inches()[0]
    label = f'<svg style="--own: {1.3 * width:.1f}in" role="img" aria-label="{escape(name)}"'
    return inline.replace("<svg", label, 1), whole, png


def _markdown(facts: Sequence[str], sections: Sequence[Section], commands: Sequence[str]) -> str:
    parts = [f"# {TITLE}", *facts, *(_section_markdown(section) for section in sections)]
    if commands:
        parts.append("## To make this again\n\n" + "\n".join(f"    {command}" for command in commands))
    return "\n\n".join(parts) + "\n"


def _section_markdown(section: Section, files: bool = True) -> str:
    """A section as Markdown; with `files`, figures and long tables are links."""
    parts = [f"## {section.title}"]
    if section.paper:
        parts.append(f"**The paper found.** {section.paper}")
    parts.append("**Found here.**\n\n" + "\n".join(f"- {sentence}" for sentence in section.here))
    if files:
        parts += [f"![{drawn.caption or drawn.name}](figures/{drawn.name}.svg)" for drawn in section.figures]
    for each in section.sheets:
        linked = files and len(each.rows) > LINKED
        parts.append(f"[{each.name}: {len(each.rows)} rows](tables/{each.name}.md)" if linked else each.markdown())
    return "\n\n".join(parts)
