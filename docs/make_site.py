"""Build the site: execute the tutorials, let mkdocs make the pages, and check every link and picture in them.

python docs/make_site.py                    to site/; needs the extra docs
python docs/make_site.py --tutorials none   without executing the tutorials: their pages are made of the saved outputs
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

ROOT = Path(__file__).resolve().parent.parent
TUTORIALS = ROOT / "docs" / "tutorials"
LIMIT = 240  # s of one notebook


class Page(HTMLParser):
    """What a page points to, and what can be pointed to in it."""

    def __init__(self) -> None:
        super().__init__()
        self.links: list[str] = []  # of anchors
        self.loaded: list[str] = []  # with the page: pictures, scripts, styles
        self.places: set[str] = set()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        attributes = {name: value or "" for name, value in attrs}
        self.places |= {attributes[name] for name in ("id", "name") if name in attributes}
        if tag == "a" and "href" in attributes:
            self.links.append(attributes["href"])
        elif tag == "link" and attributes.get("rel") in ("stylesheet", "icon", "preload"):
            self.loaded.append(attributes["href"])
        elif "src" in attributes:
            self.loaded.append(attributes["src"])
        self.loaded += [each.split()[0] for each in attributes.get("srcset", "").split(",") if each.strip()]


def faults(site: Path) -> list[str]:
    """A sentence for each link, picture or anchor that is not in the site, and for all that is loaded from outside."""
    pages = {path: Page() for path in sorted(site.rglob("*.html")) if path.name != "404.html"}
    for path, page in pages.items():
        page.feed(path.read_text())
    sentences = []
    for path, page in pages.items():
        name = path.relative_to(site)
        for link in [*page.links, *page.loaded]:
            parts = urlsplit(link)
            if parts.scheme or parts.netloc:
                if link in page.loaded and parts.scheme != "data":
                    sentences.append(f"{name}: loads {link} from outside")
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            target = target / "index.html" if target.is_dir() else target
            if not target.is_file():
                sentences.append(f"{name}: links to {link}, which is not there")
            elif parts.fragment and target in pages and unquote(parts.fragment) not in pages[target].places:
                sentences.append(f"{name}: links to {link}, and there is no such place")
    return sentences


def execute(notebook: Path, again: bool) -> tuple[str, float, str]:
    """Make the page of a tutorial; returns its name, the seconds that it took, and what went wrong, else ""."""
    command = [sys.executable, "-m", "nbconvert", "--to", "markdown", "--log-level=ERROR", str(notebook)]
    if again:
        command += ["--execute", f"--ExecutePreprocessor.timeout={LIMIT}"]
    begin = time.monotonic()
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ | {"OMP_NUM_THREADS": "1"})
    return notebook.name, time.monotonic() - begin, done.stderr if done.returncode else ""


def main() -> int:
    asked = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    asked.add_argument("--tutorials", choices=("all", "none"), default="all", help="which are executed")
    asked.add_argument("--site", type=Path, default=ROOT / "site", help="folder of the pages (site)")
    given = asked.parse_args()
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        executed = pool.map(lambda path: execute(path, given.tutorials == "all"), sorted(TUTORIALS.glob("*.ipynb")))
        for name, seconds, wrong in executed:
            print(f"{name}: {wrong or f'{seconds:.0f} s'}", flush=True)
            if wrong:
                return 1
    build = [sys.executable, "-m", "mkdocs", "build", "--strict", "--clean", "--site-dir", str(given.site)]
    if code := subprocess.run(build, cwd=ROOT, env=os.environ | {"NO_MKDOCS_2_WARNING": "1"}).returncode:
        return code
    broken = faults(given.site)
    print(*broken, f"{given.site}: {len(broken)} faults", sep="\n")
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main())
