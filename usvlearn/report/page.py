"""The files of a report: one HTML page that needs nothing else, its figures and tables, and the same as Markdown."""

from __future__ import annotations

import base64
import hashlib
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
from usvlearn.display.figures import INK, LINE, attempted, themed
from usvlearn.display.terminal import ResultTable, shown
from usvlearn.errors import ConfigError
from usvlearn.evaluation.crossval import FreeErrors
from usvlearn.report.best_minutes import best_figure
from usvlearn.report.front import Front, first_page, title
from usvlearn.report.sections.section import Section

FOLDERS, FILES = ("figures", "tables"), "files.json"  # a report's, and the list of its files in them
LINKED = 40  # a table with more rows is a link in `report.md`
TITLE = "What was learned"
INLINE = 16  # most rows of a table that is shown without a click
OPEN = ("boat-1", "fit", "identified", "forecast", "tracks")  # sections that are shown without a click
STYLE = Path(__file__).with_name("page.css").read_text()
SCRIPT = "".join(Path(__file__).with_name(name).read_text() for name in ("viewer_plots.js", "viewer.js"))


def write_report(
    folder: Path,
    facts: Sequence[str],
    sections: Sequence[Section],
    commands: Sequence[str] = (),
    errors: Mapping[str, FreeErrors] | None = None,
    front: Front | None = None,
    heading: str = TITLE,
) -> Path:
    """Write the page, the Markdown, figures, tables and `crossval.npz`; those of an earlier report go."""
    check_report_folder(folder)
    figures = {drawn.name: drawn.figure for section in sections for drawn in section.figures}
    boats = front.boats if front else ()
    best = {boat.boat: f"best_minutes_{k + 1}" for k, boat in enumerate(boats) if boat.best is not None}
    figures |= {best[boat.boat]: best_figure(boat.best) for boat in boats if boat.best is not None}
    drawings = {name: attempted(partial(_drawing, name, each), name, partial(_drawing, name))
                for name, each in figures.items()}  # fmt: skip
    for old in _written(folder):
        (folder / old).unlink(missing_ok=True)
    tables = {f"tables/{each.name}.csv": each for section in sections for each in section.sheets}
    contents = {f"figures/{name}.svg": whole for name, (_, whole) in drawings.items()}
    contents |= {name: each.csv().encode() for name, each in tables.items()}
    for path, whole in contents.items():
        write_atomically(folder / path, whole)
    write_atomically(folder / "report.md", _markdown(heading, facts, sections, commands).encode())
    if errors:
        archive = io.BytesIO()
        named = {f"{boat}_{name}": x for boat, free in errors.items() for name, x in free._asdict().items()}
        np.savez_compressed(archive, **named)
        write_atomically(folder / "crossval.npz", archive.getvalue())
    index = folder / "index.html"
    write_atomically(folder / FILES, json.dumps(sorted(contents), indent=2).encode())
    inline = {name: inline for name, (inline, _) in drawings.items()}
    inline |= {boat: inline[name] for boat, name in best.items()}
    write_atomically(index, page(facts, sections, commands, inline, front, heading).encode())
    return index


def check_report_folder(folder: Path) -> None:
    """Make the folder of a report, which may contain only an earlier report, and check that figures can be drawn."""
    with themed():
        pass
    names = {path.name for path in folder.iterdir()} if folder.is_dir() else set()
    if names - {LOCK} and FILES not in names:
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


def _drawing(name: str, figure: Any) -> tuple[str, bytes]:
    """A figure as SVG for the page, whose theme it follows, and as a file of its own."""
    from matplotlib import rc_context

    figure.draw_without_rendering()  # once: each file would lay the figure out anew
    figure.set_layout_engine(None)  # with "none", each file would be drawn twice
    box, content = figure.get_tightbbox().padded(0.05), io.BytesIO()
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": name}):
        figure.savefig(content, bbox_inches=box, format="svg", transparent=True, metadata={"Date": None})
    inline = content.getvalue().decode()
    whole = re.sub("(<svg[^>]*>)", r'\1<rect width="100%" height="100%" fill="white"/>', inline, count=1).encode()
    inline = inline[inline.index("<svg") :]
    inline = re.sub(r'<metadata>.*?</metadata>| id="image\w+"', "", inline, flags=re.DOTALL)  # equal images, equal ids
    prefix = f"g{zlib.crc32(name.encode()):x}-"  # ids of one page differ; a name may hold any character
    inline = re.sub(r'(id="|href="#|url\(#)', rf"\g<1>{prefix}", inline)
    for colour, variable in {INK: "currentColor", "#222222": "currentColor", LINE: "var(--line)",
                             "#eeeeee": "var(--line)", "#000000": "currentColor"}.items():  # fmt: skip
        inline = re.sub(re.escape(colour), variable, inline, flags=re.IGNORECASE)
    width = figure.get_size_inches()[0]
    label = f'<svg style="--own: {1.3 * width:.1f}in" role="img" aria-label="{escape(name)}"'
    return inline.replace("<svg", label, 1), whole


def _markdown(heading: str, facts: Sequence[str], sections: Sequence[Section], commands: Sequence[str]) -> str:
    parts = [f"# {heading}", *facts, *(_section_markdown(section) for section in sections)]
    if commands:
        parts.append("## To make this again\n\n" + "\n".join(f"    {command}" for command in commands))
    return "\n\n".join(parts) + "\n"


def _section_markdown(section: Section) -> str:
    """A section as Markdown; figures and long tables are links."""
    parts = [f"## {section.title}"]
    if section.paper:
        parts.append(f"**The paper found.** {section.paper}")
    parts.append("**Found here.**\n\n" + "\n".join(f"- {sentence}" for sentence in section.here))
    parts += [f"![{drawn.caption or drawn.name}](figures/{drawn.name}.svg)" for drawn in section.figures]
    for each in section.sheets:
        link = f"[{each.name}: {len(each.rows)} rows](tables/{each.name}.csv)"
        parts.append(link if len(each.rows) > LINKED else each.markdown())
    return "\n\n".join(parts)


def page(
    facts: Sequence[str],
    sections: Sequence[Section],
    commands: Sequence[str],
    drawings: Mapping[str, str],
    front: Front | None = None,
    heading: str = TITLE,
) -> str:
    """The page, with the SVG of each figure. Open are sections with the paper's result, and those of OPEN."""
    heading, script = (title(front) if front else heading), SCRIPT if front else ""
    links = "".join(f'<li><a href="#{s.key}">{escape(s.title)}</a></li>' for s in sections)
    runs = '<li><a href="#runs">Run by run</a></li>' if front else ""
    nav = f"<nav><ul>{runs}{links}</ul></nav>"
    body = [f"<h1>{escape(heading)}</h1>", first_page(front, nav, drawings) if front else nav]
    body += [_section(section, drawings) for section in sections]
    body.append("<h2>About this report</h2>")
    body += [f'<p class="facts">{escape(fact)}</p>' for fact in facts]
    if commands:
        body += ["<h2>To make this again</h2>", f"<pre>{escape(chr(10).join(commands))}</pre>"]
    if script:
        body.append(f"<script>{script}</script>")
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{_policy(script)}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<link rel="icon" href="data:,">\n'  # none is asked for
        f"<title>{escape(heading)}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n"
        + "\n".join(body)
        + "\n</body>\n</html>\n"
    )


def _policy(script: str) -> str:
    """What the page may load: nothing but what is in it, and no other script than this one."""
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    allowed = f"'sha256-{digest}'" if script else "'none'"
    rest = "style-src 'unsafe-inline'; img-src data:; base-uri 'none'; form-action 'none'"
    return f"default-src 'none'; script-src {allowed}; {rest}"


def _section(section: Section, drawings: Mapping[str, str]) -> str:
    opened = " open" if section.paper or section.key in OPEN else ""
    body = [f'<section><details class="part"{opened}><summary><h2>{escape(section.title)}</h2></summary>']
    body.append(f'<div id="{section.key}"><div class="said">')
    if section.paper:
        body.append(f"<div><h3>The paper found</h3><p>{escape(section.paper)}</p></div>")
    here = "".join(f"<li>{escape(sentence)}</li>" for sentence in section.here)
    body.append(f"<div><h3>Found here</h3><ul>{here}</ul></div></div>")
    body += [_table(each, True) for each in section.sheets[: section.first]]
    for drawn in section.figures:
        caption = f"<figcaption>{escape(drawn.caption)}</figcaption>" if drawn.caption else ""
        body.append(f'<figure><div class="wide">{drawings[drawn.name]}</div>{caption}</figure>')
    body += [_table(each, len(each.rows) <= INLINE) for each in section.sheets[section.first :]]
    return "\n".join([*body, "</div></details></section>"])


def _table(each: ResultTable, opened: bool) -> str:
    return (
        f"<details{' open' if opened else ''}><summary>{escape(each.name)}: table of {len(each.rows)} rows</summary>"
        f'<div class="rows">{html_of(each)}</div></details>'
    )


def html_of(table: ResultTable) -> str:
    """A `<table>`; four digits."""
    right = [' class="n"' if each else "" for each in table.numeric]
    head = "".join(f"<th{r}>{escape(name)}</th>" for name, r in zip(table.columns, right, strict=True))
    rows = ("".join(f"<td{r}>{escape(shown(x))}</td>" for x, r in zip(row, right, strict=True)) for row in table.rows)
    body = "".join(f"<tr>{row}</tr>\n" for row in rows)
    return f"<table>\n<thead><tr>{head}</tr></thead>\n<tbody>\n{body}</tbody>\n</table>"
