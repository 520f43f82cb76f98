"""The page of a report: one HTML file that needs nothing else. Its only script is the viewer, named by its hash."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path

from usvlearn.display.result_table import ResultTable
from usvlearn.report.front import Front, first_page, title
from usvlearn.report.sections.section import Section

TITLE = "What was learned"
INLINE = 16  # most rows of a table that is shown without a click
OPEN = ("fit", "identified", "forecast", "tracks")  # sections that are shown without a click
STYLE = Path(__file__).with_name("page.css").read_text()
SCRIPT = "".join(Path(__file__).with_name(name).read_text() for name in ("viewer_plots.js", "viewer.js"))


def page(
    facts: Sequence[str],
    sections: Sequence[Section],
    commands: Sequence[str],
    drawings: Mapping[str, str],
    front: Front | None = None,
    images: Mapping[str, bytes] | None = None,
) -> str:
    """The page.

    Args:
        facts: the data on which it is based, one sentence each.
        sections: in their order. A section that states the paper's result is open, as are those of OPEN.
        commands: that make the report again.
        drawings: SVG of each figure.
        front: what stands before the sections.
        images: PNG of its pictures.
    """
    heading, script = (title(front) if front else TITLE), SCRIPT if front else ""
    links = "".join(f'<li><a href="#{s.key}">{escape(s.title)}</a></li>' for s in sections)
    runs = '<li><a href="#runs">Run by run</a></li>' if front else ""
    nav = f"<nav><ul>{runs}{links}</ul></nav>"
    body = [f"<h1>{escape(heading)}</h1>", first_page(front, nav, images or {}) if front else nav]
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
        f'<div class="rows">{each.html()}</div></details>'
    )
