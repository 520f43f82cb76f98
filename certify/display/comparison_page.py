"""The page of a comparison: one HTML file that loads nothing, the same in Markdown, and its pictures.

FOLDER/index.html       the page; it follows the reader's light or dark theme
FOLDER/report.md        the same as Markdown
FOLDER/figures/NAME.svg, NAME.png
FOLDER/comparison.json  the result, all digits

It looks like the report of a run (`usvlearn.report`), which certify may not import: a test compares both styles.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from certify.display.comparison_figures import Picture
from certify.display.comparison_tables import TITLE, Part, Table, headline, highlights, parts, settings
from certify.display.figures import svg_of_page
from certify.errors import CertifyError
from certify.proofs.gauge import PROOF

INDEX, MARKDOWN, FIGURES, RESULT = "index.html", "report.md", "figures", "comparison.json"
STYLE = """\
:root { color-scheme: light dark; --ink: #1f2430; --soft: #5b6472; --line: #c8ccd4; --page: #ffffff; --card: #f5f6f8;
  --accent: #0072b2; --good: #1b7f4b; --bad: #b3441e; }
@media (prefers-color-scheme: dark) { :root { --ink: #e6e8ec; --soft: #a3abb8; --line: #3d4450; --page: #14171c;
  --card: #1d2128; --accent: #56b4e9; --good: #5fc48f; --bad: #f0986f; } }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 84rem; padding: .8rem 1.2rem; background: var(--page); color: var(--ink);
  font: 16px/1.5 system-ui, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; overflow-wrap: break-word; }
h1 { font-size: 1.6rem; line-height: 1.2; margin: .4rem 0; }
h2 { font-size: 1.25rem; margin: 1.6rem 0 .6rem; border-top: 1px solid var(--line); padding-top: .6rem; }
h3 { font-size: 1rem; margin: 1rem 0 .4rem; }
a { color: var(--accent); }
p { margin: .4rem 0; max-width: 60rem; }
nav ul { display: flex; flex-wrap: wrap; gap: .2rem 1.2rem; padding: 0; margin: .4rem 0; list-style: none;
  font-size: .9rem; }
.facts { color: var(--soft); font-size: .88rem; }
.note { border-left: .3rem solid var(--accent); padding: .2rem .8rem; font-size: 1.1rem; }
.card { background: var(--card); border-radius: .5rem; padding: .7rem 1rem; margin: 0 0 1rem; max-width: 62rem; }
.card ul { margin: 0; padding-left: 1.1rem; }
figure { margin: 1rem 0; } figcaption { color: var(--soft); font-size: .88rem; max-width: 60rem; }
.wide { overflow-x: auto; }
.wide svg { width: 100%; min-width: min(36rem, var(--own)); max-width: var(--own); height: auto; display: block; }
.wide svg text { fill: currentColor; font-family: system-ui, "Segoe UI", Roboto, Arial, sans-serif !important; }
details { margin: .6rem 0; } summary { cursor: pointer; color: var(--accent); }
table { border-collapse: collapse; font-size: .85rem; } th, td { padding: .2rem .6rem; text-align: left;
  border-bottom: 1px solid var(--line); white-space: nowrap; } .n { text-align: right;
  font-variant-numeric: tabular-nums; } thead th { position: sticky; top: 0; background: var(--page); }
tbody th { font-weight: 600; }
.beside { display: flex; flex-wrap: wrap; gap: 0 2.5rem; }
.beside > div { max-width: 100%; }
.rows { max-height: 30rem; overflow: auto; }
pre { background: var(--card); padding: .7rem 1rem; overflow-x: auto; border-radius: .5rem; font-size: .85rem; }
@media (max-width: 52rem) { body { padding: .6rem .8rem; } }
"""


def check_folder(folder: str | Path) -> None:
    """Check before the work that the page can be written.

    Raises:
        CertifyError: it is a file, it holds a link or something else than a page, or it cannot be made.
    """
    place = Path(folder)
    if not str(folder) or (place.exists() and not place.is_dir()):
        raise CertifyError(f"--page: found {str(folder)!r}, which is a file or empty, expected a folder")
    found = {path.name for path in place.iterdir()} if place.is_dir() else set()
    if found - {INDEX, MARKDOWN, FIGURES, RESULT} or (found - {FIGURES} and RESULT not in found):
        raise CertifyError(f"--page: {folder} holds something that is no page of a comparison: name another folder")
    for path in [place / name for name in (INDEX, MARKDOWN, FIGURES, RESULT)] + sorted((place / FIGURES).glob("*")):
        if path.is_symlink():
            raise CertifyError(f"--page: {path} is a link, through which nothing is written: name another folder")
    try:
        (place / FIGURES).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise CertifyError(f"--page: {folder} cannot be made ({error.strerror}): name another folder") from error


def write(folder: Path, result: Mapping[str, Any], drawn: Mapping[str, Picture], command: str) -> Path:
    """Write the page, its Markdown, pictures and data; returns the path of the page.

    Args:
        folder: of the page; a page of before is replaced.
        result: see `certify.command.compare.study`.
        drawn: see `certify.display.comparison_figures.pictures`.
        command: that makes the page again.
    """
    check_folder(folder)
    inline = {}
    for name, picture in drawn.items():
        inline[name], whole, png = svg_of_page(picture.figure, name)
        (folder / FIGURES / f"{name}.svg").write_bytes(whole)
        (folder / FIGURES / f"{name}.png").write_bytes(png)
    (folder / RESULT).write_text(json.dumps(result, indent=1, allow_nan=False), encoding="utf-8")
    (folder / MARKDOWN).write_text(markdown(result, drawn, command), encoding="utf-8")
    index = folder / INDEX
    index.write_text(html(result, drawn, inline, command), encoding="utf-8")
    return index


def markdown(
    result: Mapping[str, Any], drawn: Mapping[str, Picture], command: str, files: str = f"{FIGURES}/{{}}.svg"
) -> str:
    """The page as Markdown; `files` is the path of a picture, with {} for its name."""
    text = [f"# {TITLE}", headline(result), _bullets(highlights(result))]
    for part in parts(result):
        text += [f"## {part.title}", _bullets(part.said)]
        if part.key == "gauge":
            text += ["**Proof.** " + PROOF[0], *PROOF[1:]]
        shown = [name for name in part.pictures if name in drawn]
        text += [f"![{part.title}]({files.format(name)})\n\n*{drawn[name].caption}*" for name in shown]
        text += [f"{table.title}:\n\n{_markdown_table(table)}" for table in part.tables]
    text += ["## How it was made", _bullets(settings(result))]
    plain = re.sub("<(?=[a-zA-Z/!?])", "&lt;", "\n\n".join(text))  # no name becomes a tag
    return f"{plain}\n\n```sh\n{command}\n```\n"


def _bullets(sentences: Sequence[str]) -> str:
    return "\n".join(f"- {sentence}" for sentence in sentences)


def _markdown_table(table: Table) -> str:
    cells = [table.headings, *table.rows]
    lines = ["| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in cells]
    return "\n".join([lines[0], "|---|" + "---:|" * (len(table.headings) - 1), *lines[1:]])


def html(result: Mapping[str, Any], drawn: Mapping[str, Picture], inline: Mapping[str, str], command: str) -> str:
    """The page as HTML; `inline` holds the SVG of each picture. Every name is escaped."""
    found = parts(result)
    links = "".join(f'<li><a href="#{part.key}">{escape(part.title)}</a></li>' for part in found)
    body = [f"<h1>{escape(TITLE)}</h1>", f'<p class="note">{escape(headline(result))}</p>']
    body += [_list(highlights(result)), f"<nav><ul>{links}</ul></nav>"]
    body += [_section(part, drawn, inline) for part in found]
    body.append("<h2>How it was made</h2>")
    body += [f'<p class="facts">{escape(sentence)}</p>' for sentence in settings(result)]
    body.append(f"<pre>{escape(command)}</pre>")
    policy = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; base-uri 'none'; form-action 'none'"
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<link rel="icon" href="data:,">\n'  # none is asked for
        f"<title>{escape(TITLE)}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n"
        + "\n".join(body)
        + "\n</body>\n</html>\n"
    )


def _list(sentences: Sequence[str]) -> str:
    return f'<div class="card"><ul>{"".join(f"<li>{escape(sentence)}</li>" for sentence in sentences)}</ul></div>'


def _section(part: Part, drawn: Mapping[str, Picture], inline: Mapping[str, str]) -> str:
    body = [f'<section id="{part.key}"><h2>{escape(part.title)}</h2>', _list(part.said)]
    if part.key == "gauge":
        paragraphs = "".join(f"<p>{escape(each)}</p>" for each in PROOF)
        body.append(f"<details open><summary>The proof</summary>{paragraphs}</details>")
    for name in part.pictures:
        if name in drawn:
            caption = f"<figcaption>{escape(drawn[name].caption)}</figcaption>"
            body.append(f'<figure><div class="wide">{inline[name]}</div>{caption}</figure>')
    tables = "\n".join(
        f'<div><h3>{escape(table.title)}</h3><div class="rows">{_html_table(table)}</div></div>'
        for table in part.tables
    )
    return "\n".join([*body, f'<div class="beside">{tables}</div></section>'])


def _html_table(table: Table) -> str:
    first, *others = table.headings
    head = f"<th>{escape(first)}</th>" + "".join(f'<th class="n">{escape(each)}</th>' for each in others)
    rows = "".join(
        f'<tr><th scope="row">{escape(row[0])}</th>'
        + "".join(f'<td class="n">{escape(cell)}</td>' for cell in row[1:])
        + "</tr>\n"
        for row in table.rows
    )
    return f"<table>\n<thead><tr>{head}</tr></thead>\n<tbody>\n{rows}</tbody>\n</table>"
