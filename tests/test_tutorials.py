"""The saved tutorials are executed, whole and small, and tell nothing of the machine on which they were executed."""

import base64
import json
import re
from collections.abc import Iterator
from typing import Any

from tests.support import ROOT

FOLDER = ROOT / "docs" / "tutorials"
NAME = "season_and_fault"
LARGEST, PICTURE = 400_000, 60_000  # bytes of a notebook, and of a picture
PLACE = re.compile(r"(?<![\w/:.…)])(?:/|~/|[A-Z]:\\)[\w.-]+[/\\][\w./\\-]+")  # an absolute path
MAGICS = ("%%bash -e\n", "%%writefile ")  # a command that fails must end the notebook, which "!" would not do

NOTEBOOK: dict[str, Any] = json.loads((FOLDER / f"{NAME}.ipynb").read_text())


def text(source: str | list[str]) -> str:
    return source if isinstance(source, str) else "".join(source)


def printed() -> Iterator[str]:
    """What the cells print and show, without pictures."""
    for output in OUTPUTS:
        yield text(output.get("text", ""))
        yield from (text(data) for kind, data in output.get("data", {}).items() if kind.startswith("text/"))


CODE = [cell for cell in NOTEBOOK["cells"] if cell["cell_type"] == "code"]
OUTPUTS = [output for cell in CODE for output in cell["outputs"]]


def test_a_path_is_recognised():
    assert [
        match.group() for match in PLACE.finditer("files /home/anna/run: 2 m/s, left/right, outputs/run, a //x")
    ] == ["/home/anna/run"]
    assert PLACE.search(r"in C:\Users\anna") and not PLACE.search("http://localhost:6006/x/y 1/s 90 %/min ./a/b")


def test_the_file_is_the_only_notebook_and_for_any_python_3():
    assert [path.stem for path in FOLDER.glob("*.ipynb")] == [NAME]
    assert (NOTEBOOK["nbformat"], NOTEBOOK["nbformat_minor"]) == (4, 5)
    assert NOTEBOOK["metadata"]["kernelspec"]["name"] == "python3"
    identifiers = [cell["id"] for cell in NOTEBOOK["cells"]]
    assert len(set(identifiers)) == len(identifiers) > 10
    assert all(re.fullmatch(r"[\w-]{1,64}", identifier) for identifier in identifiers)
    assert (FOLDER / f"{NAME}.ipynb").stat().st_size < LARGEST


def test_every_cell_was_executed_in_order_without_an_error():
    assert [cell["execution_count"] for cell in CODE] == list(range(1, len(CODE) + 1))
    assert {output["output_type"] for output in OUTPUTS} <= {"stream", "display_data", "execute_result"}
    assert all(output.get("name") != "stderr" for output in OUTPUTS)
    for source in (text(cell["source"]) for cell in CODE):
        assert source.startswith(MAGICS) or not re.search(r"^\s*[%!]", source, re.MULTILINE)


def test_the_output_is_plain_and_names_no_place():
    for output in printed():
        assert "\x1b" not in output and "\r" not in output and not PLACE.search(output), output


def test_it_has_small_pictures():
    shown = [output["data"]["image/png"] for output in OUTPUTS if "image/png" in output.get("data", {})]
    pictures = [base64.b64decode(text(picture)) for picture in shown]
    assert pictures and all(each.startswith(b"\x89PNG") and len(each) <= PICTURE for each in pictures)


def test_it_says_first_what_it_needs_and_last_where_to_go_next():
    first, *_, last = NOTEBOOK["cells"]
    start, end = text(first["source"]), text(last["source"])
    assert first["cell_type"] == last["cell_type"] == "markdown"
    assert start.startswith("# ") and "You learn" in start and "**Time:**" in start and "**You need:**" in start
    assert "## Where to go next" in end
    words = "\n".join(text(cell["source"]) for cell in NOTEBOOK["cells"] if cell["cell_type"] == "markdown")
    links = re.findall(r"\]\(([^)]*)\)", words)
    assert len(links) >= 4 and all(re.fullmatch(r"(\.\./)?[\w/]+\.md(#[\w-]+)?", link) for link in links)
    assert not re.search(r"TODO|XXX", words)
