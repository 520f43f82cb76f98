"""A report: one HTML file without scripts or external links; figures and tables also as files and in TensorBoard."""

from __future__ import annotations

import io
import json
import re
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from usvlearn.checkpoint import write_atomically
from usvlearn.errors import ConfigError
from usvlearn.evaluation.crossval import FreeErrors
from usvlearn.figures import INK, LINE, themed
from usvlearn.lock import NAME as LOCK
from usvlearn.report.section import Drawn, Section
from usvlearn.tensorboard import TensorBoardWriter

STYLE = """
:root { color-scheme: light dark; --ink: #1f2430; --soft: #5b6472; --line: #c8ccd4; --page: #ffffff; --card: #f5f6f8;
  --accent: #0072b2; }
@media (prefers-color-scheme: dark) { :root { --ink: #e6e8ec; --soft: #a3abb8; --line: #3d4450; --page: #14171c;
  --card: #1d2128; --accent: #56b4e9; } }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 72rem; padding: 1.2rem; background: var(--page); color: var(--ink);
  font: 16px/1.5 system-ui, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; }
h1 { font-size: 1.6rem; line-height: 1.2; margin: .4rem 0; }
h2 { font-size: 1.25rem; margin: 2.6rem 0 .6rem; border-top: 1px solid var(--line); padding-top: 1.2rem; }
a { color: var(--accent); }
nav ul { display: flex; flex-wrap: wrap; gap: .3rem 1.2rem; padding: 0; list-style: none; }
.facts { color: var(--soft); }
.said { display: grid; grid-template-columns: repeat(auto-fit, minmax(17rem, 1fr)); gap: .8rem; margin: 0 0 1rem; }
.said > div { background: var(--card); border-radius: .5rem; padding: .7rem 1rem; }
.said h3 { margin: 0; font-size: .8rem; text-transform: uppercase; letter-spacing: .06em; color: var(--soft); }
.said p, .said ul { margin: .3rem 0 0; } .said ul { padding-left: 1.1rem; }
figure { margin: 1rem 0; } figcaption { color: var(--soft); font-size: .88rem; max-width: 60rem; }
.wide { overflow-x: auto; }
.wide svg { width: 100%; min-width: min(36rem, var(--own)); max-width: var(--own); height: auto; display: block; }
.wide svg text { fill: currentColor; font-family: system-ui, "Segoe UI", Roboto, Arial, sans-serif !important; }
details { margin: .6rem 0; } summary { cursor: pointer; color: var(--accent); }
table { border-collapse: collapse; font-size: .85rem; } th, td { padding: .2rem .6rem; text-align: left;
  border-bottom: 1px solid var(--line); white-space: nowrap; } .n { text-align: right;
  font-variant-numeric: tabular-nums; } thead th { position: sticky; top: 0; background: var(--page); }
.rows { max-height: 30rem; overflow: auto; }
pre { background: var(--card); padding: .7rem 1rem; overflow-x: auto; border-radius: .5rem; font-size: .85rem; }
"""
TITLE = "What was learned"
FOLDERS, FILES = ("figures", "tables", "tensorboard"), "files.json"  # a report's, and the list of its files in them
INLINE = 16  # most rows of a table that is shown without a click
LINKED = 40  # a table with more rows is a link in `report.md`


def write_report(
    folder: Path,
    facts: Sequence[str],
    sections: Sequence[Section],
    commands: Sequence[str] = (),
    errors: Mapping[str, FreeErrors] | None = None,
) -> Path:
    """Write `index.html`, `report.md`, `figures/*.png` and `*.svg`, `tables/*.csv` and `*.md`, `tensorboard/`.

    Args:
        folder: of the report; files of an earlier report are replaced.
        facts: the data on which it is based, one sentence each.
        sections: in their order.
        commands: that make the report again.
        errors: of each boat's cross-validation, for `crossval.npz`: BOAT_mae `(sets, runs, methods)` …

    Returns:
        The path of the page.
    """
    check_report_folder(folder)
    drawings = {drawn.name: _drawing(drawn) for section in sections for drawn in section.figures}
    for old in _written(folder):
        (folder / old).unlink(missing_ok=True)
    inline = {name: drawing for name, (drawing, _, _) in drawings.items()}
    images = {name: png for name, (_, _, png) in drawings.items()}
    for name, (_, whole, png) in drawings.items():
        write_atomically(folder / "figures" / f"{name}.svg", whole)
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
    page = folder / "index.html"
    names = sorted(f"{kind}/{path.name}" for kind in FOLDERS for path in (folder / kind).iterdir() if path.is_file())
    write_atomically(folder / FILES, json.dumps(names, indent=2).encode())
    write_atomically(page, _html(facts, sections, commands, inline).encode())
    return page


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


def _drawing(drawn: Drawn) -> tuple[str, bytes, bytes]:
    """A figure as SVG for the page, whose theme it follows, and as separate SVG and PNG files."""
    from matplotlib import rc_context

    drawn.figure.draw_without_rendering()  # once: "tight" would lay the figure out anew for each file
    box = drawn.figure.get_tightbbox().padded(0.05)

    def saved(**options: Any) -> bytes:
        content = io.BytesIO()
        drawn.figure.savefig(content, bbox_inches=box, **options)
        return content.getvalue()

    with rc_context({"svg.fonttype": "none", "svg.hashsalt": drawn.name}):
        inline = saved(format="svg", transparent=True, metadata={"Date": None}).decode()
    whole = re.sub("(<svg[^>]*>)", r'\1<rect width="100%" height="100%" fill="white"/>', inline, count=1).encode()
    png = saved(format="png", dpi=150, facecolor="white")
    inline = inline[inline.index("<svg") :]
    inline = re.sub(r'<metadata>.*?</metadata>| id="image\w+"', "", inline, flags=re.DOTALL)  # equal images, equal ids
    inline = re.sub(r'(id="|href="#|url\(#)', rf"\g<1>{drawn.name}-", inline)  # ids of one page differ
    for colour, variable in {INK: "currentColor", "#222222": "currentColor", LINE: "var(--line)",
                             "#eeeeee": "var(--line)", "#000000": "currentColor"}.items():  # fmt: skip
        inline = re.sub(re.escape(colour), variable, inline, flags=re.IGNORECASE)
    width = drawn.figure.get_size_inches()[0]
    label = f'<svg style="--own: {1.3 * width:.1f}in" role="img" aria-label="{escape(drawn.name)}"'
    return inline.replace("<svg", label, 1), whole, png


def _html(
    facts: Sequence[str],
    sections: Sequence[Section],
    commands: Sequence[str],
    drawings: Mapping[str, str],
) -> str:
    links = "".join(f'<li><a href="#{s.key}">{escape(s.title)}</a></li>' for s in sections)
    body = [f"<h1>{TITLE}</h1>", *(f'<p class="facts">{escape(fact)}</p>' for fact in facts)]
    body.append(f"<nav><ul>{links}</ul></nav>")
    for section in sections:
        body += [f'<section id="{section.key}">', f"<h2>{escape(section.title)}</h2>", '<div class="said">']
        if section.paper:
            body.append(f"<div><h3>The paper found</h3><p>{escape(section.paper)}</p></div>")
        here = "".join(f"<li>{escape(sentence)}</li>" for sentence in section.here)
        body += [f"<div><h3>Found here</h3><ul>{here}</ul></div>", "</div>"]
        for drawn in section.figures:
            caption = f"<figcaption>{escape(drawn.caption)}</figcaption>" if drawn.caption else ""
            body.append(f'<figure><div class="wide">{drawings[drawn.name]}</div>{caption}</figure>')
        for each in section.sheets:
            opened = " open" if len(each.rows) <= INLINE else ""
            body.append(
                f'<details{opened}><summary>{escape(each.name)}: table of {len(each.rows)} rows</summary>'
                f'<div class="rows">{each.html()}</div></details>'
            )  # fmt: skip
        body.append("</section>")
    if commands:
        body += ["<h2>To make this again</h2>", f"<pre>{escape(chr(10).join(commands))}</pre>"]
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<link rel="icon" href="data:,">\n'  # none is asked for
        f"<title>{TITLE}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n" + "\n".join(body) + "\n</body>\n</html>\n"
    )


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
