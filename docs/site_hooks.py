r"""Hooks of the site: its formulas, and links to edit a page where `repo_url` names the repository.

MathJax is copied into the site, and a numbered equation can be linked to.

A display formula with `\tag{3}` below the heading `## Joint EKF {#joint-ekf}` gets the id `joint-ekf-3`.
MathJax comes from the package sphinx-mathjax-offline, as one file that contains its fonts. Only pages with formulas
load it.
"""

import re
from importlib.metadata import files
from pathlib import Path
from typing import Any

SCRIPT = "assets/javascripts/mathjax.js"
LINE = re.compile(
    r"(?P<code>^(?P<fence> *```+).*?^(?P=fence)[ \t]*$)"
    r"|^#+ .*?(?:\{#(?P<section>[\w-]+)\})?[ \t]*$"
    r"|^\$\$\n(?P<formula>.*?)^\$\$[ \t]*$",
    re.M | re.S,
)
TAG = re.compile(r"\\tag\{(\w+)\}")
LOAD = """
<script>window.MathJax = {{
  tex: {{inlineMath: [["\\\\(", "\\\\)"]], displayMath: [["\\\\[", "\\\\]"]]}},
  options: {{ignoreHtmlClass: ".*", processHtmlClass: "arithmatex"}},
}}</script>
<script src="{script}" defer></script>
"""


def numbered(text: str) -> str:
    r"""A page in which each numbered equation has an id made of the section's id and its number.

    >>> print(numbered("## RLS {#rls}\n\n$$\ne = v \\tag{2}\n$$\n"))
    ## RLS {#rls}
    <BLANKLINE>
    <div id="rls-2" class="equation" markdown>
    <BLANKLINE>
    $$
    e = v \tag{2}
    $$
    <BLANKLINE>
    </div>
    <BLANKLINE>
    """
    section = ""

    def with_id(found: re.Match[str]) -> str:
        nonlocal section
        if found["formula"] is None:
            section = found["section"] or section
            return found[0]
        tag = TAG.search(found["formula"])
        if tag is None or not section:
            return found[0]
        return f'<div id="{section}-{tag[1]}" class="equation" markdown>\n\n{found[0]}\n\n</div>'

    return LINE.sub(with_id, text)


def mathjax() -> Path:
    """The file of MathJax that holds its fonts, too."""
    for path in files("sphinx-mathjax-offline") or ():
        if path.name == "tex-svg.js":
            return Path(str(path.locate()))
    raise FileNotFoundError("sphinx-mathjax-offline has no tex-svg.js: install the extra docs again")


def on_config(config: Any, **_: Any) -> None:
    if config["repo_url"]:
        config["edit_uri"] = "edit/main/docs/"


def on_page_markdown(markdown: str, **_: Any) -> str:
    return numbered(markdown)


def on_page_content(html: str, page: Any, **_: Any) -> str:
    if 'class="arithmatex"' not in html:
        return html
    return html + LOAD.format(script="../" * page.url.count("/") + SCRIPT)


def on_post_build(config: Any, **_: Any) -> None:
    target = Path(config["site_dir"]) / SCRIPT
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_bytes(mathjax().read_bytes())
