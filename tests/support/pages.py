"""The page of a report as its tests read it."""

import html.parser
import json

BAD = '</script><img src=x onerror="document.title=1">'  # a name that would do something where it is not escaped


class Page(html.parser.HTMLParser):
    """Tags with their attributes, the text of scripts, rows of tables, and ids."""

    def __init__(self, text: str):
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.scripts: list[str] = []
        self.rows: list[list[str]] = []
        self.in_cell = False
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag == "script":
            self.scripts.append("")
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")
            self.in_cell = True

    def handle_endtag(self, tag):
        self.in_cell = self.in_cell and tag not in ("td", "th")

    def handle_data(self, data):
        if self.cdata_elem == "script":
            self.scripts[-1] += data
        elif self.in_cell:
            self.rows[-1][-1] += data

    def data(self) -> dict:
        return json.loads(self.scripts[0])
