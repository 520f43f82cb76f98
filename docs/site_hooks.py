r"""Hooks of the site: formulas, families of estimators, links to edit a page where `repo_url` names the repository.

MathJax is copied into the site, and a numbered equation can be linked to.

A display formula with `\tag{3}` below the heading `## Joint EKF {#joint-ekf}` gets the id `joint-ekf-3`.
MathJax comes from the package sphinx-mathjax-offline, as one file that contains its fonts. Only pages with formulas
load it.
"""

import re
from importlib import import_module
from importlib.metadata import files
from inspect import Signature, signature
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

    >>> numbered("## RLS {#rls}\n\n$$\ne = v \\tag{2}\n$$\n")[15:57]
    '<div id="rls-2" class="equation" markdown>'
    """
    section = ""

    def with_id(match: re.Match[str]) -> str:
        nonlocal section
        if match["formula"] is None:
            section = match["section"] or section
            return match[0]
        tag = TAG.search(match["formula"])
        if tag is None or not section:
            return match[0]
        return f'<div id="{section}-{tag[1]}" class="equation" markdown>\n\n{match[0]}\n\n</div>'

    return LINE.sub(with_id, text)


def with_families(text: str) -> str:
    """A page in which the line `<!-- families -->` is a section for each family of estimators.

    >>> "| `floor` | 0.001 | 0 … 1e+30 |" in with_families("<!-- families -->")
    True
    """
    names = [name for name in (*import_module("usvlearn.estimators").COMPILED, "wrappers.robust") if name != "external"]
    return re.sub("^<!-- families -->$", lambda _: "\n".join(map(family, names)), text, flags=re.M)


def family(name: str) -> str:
    """A section: the equations of a family, the numbers and choices that its `state.py` declares, and its classes."""
    usvlearn, state = import_module("usvlearn"), import_module(f"usvlearn.estimators.{name}.state")
    own = dict[str, Any]()
    for path in sorted(Path(state.__file__ or "").parent.glob("[a-z]*.py")):
        module = import_module(f"usvlearn.estimators.{name}.{path.stem}")
        for key, x in vars(module).items():
            if f"usvlearn.{usvlearn._HOME.get(key)}" == module.__name__:
                own[f"usvlearn.{key}"] = x
            elif isinstance(x, type) and issubclass(x, usvlearn.Estimator) and x.__module__ == module.__name__:
                own[f"{module.__name__}.{key}"] = x
    found = [(key, x.default) for each in own.values() for key, x in signature(each).parameters.items()]
    given, said = {key: default for key, default in found if default is not Signature.empty}, state.__doc__ or ""
    lines, link = [f"## {re.split('[:,.(]', said)[0].strip()}\n"], re.search(r"docs/(theory/[\w.#-]+)", said)
    lines += [f"Equations: [theory](../{link[1]}).\n"] if link else []
    lines += ["| number or choice | default | legal |\n|---|---|---|"] if len(state.FAMILY.numbers) else []
    for x in (*state.FAMILY.numbers, *state.FAMILY.vectors, *state.FAMILY.choices):
        legal = x.legal if hasattr(x, "legal") else x.whole or ", ".join(map(str, x.allowed))
        lines.append(f"| `{x.key}` | {given.get(x.key, '')} | {legal} |")
    shown = {True: "", False: "    options:\n      members: false\n"}  # of what is no estimator, its arguments alone
    return "\n".join(
        [*lines, "", *(f"::: {path}\n{shown[issubclass(x, usvlearn.Estimator)]}" for path, x in own.items())]
    )


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
    return numbered(with_families(markdown))


def on_page_content(html: str, page: Any, **_: Any) -> str:
    if 'class="arithmatex"' not in html:
        return html
    return html + LOAD.format(script="../" * page.url.count("/") + SCRIPT)


def on_post_build(config: Any, **_: Any) -> None:
    target = Path(config["site_dir"]) / SCRIPT
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_bytes(mathjax().read_bytes())
