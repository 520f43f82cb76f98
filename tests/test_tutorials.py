"""The saved tutorials are executed, whole and small, and tell nothing of the machine on which they were executed."""

import base64
import json
import re
from pathlib import Path
from typing import Any

import pytest

from tests.support import ROOT

FOLDER = ROOT / "docs" / "tutorials"
NAMES = ("season_and_fault",)
LARGEST, PICTURE = 400_000, 60_000  # bytes of a notebook, and of a picture
PLACE = re.compile(r"(?<![\w/:.…)])(?:/|~/|[A-Z]:\\)[\w.-]+[/\\][\w./\\-]+")  # an absolute path
MAGICS = ("%%bash -e\n", "%%writefile ")  # a command that fails must end the notebook, which "!" would not do

each = pytest.mark.parametrize("name", NAMES)


def read(name: str) -> dict[str, Any]:
    return json.loads((FOLDER / f"{name}.ipynb").read_text())


def text(source: str | list[str]) -> str:
    return source if isinstance(source, str) else "".join(source)


def code(notebook: dict[str, Any]) -> list[dict[str, Any]]:
    return [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]


def printed(notebook: dict[str, Any]) -> list[str]:
    """What the cells print and show, without pictures."""
    found = []
    for output in (output for cell in code(notebook) for output in cell["outputs"]):
        found.append(text(output.get("text", "")))
        found += [text(data) for kind, data in output.get("data", {}).items() if kind.startswith("text/")]
    return found


def pictures(notebook: dict[str, Any]) -> list[bytes]:
    outputs = (output for cell in code(notebook) for output in cell["outputs"])
    return [
        base64.b64decode(text(output["data"]["image/png"]))
        for output in outputs
        if "image/png" in output.get("data", {})
    ]


def test_a_path_is_recognised():
    assert [
        found.group() for found in PLACE.finditer("files /home/anna/run: 2 m/s, left/right, outputs/run, a //x")
    ] == ["/home/anna/run"]
    assert PLACE.search(r"in C:\Users\anna") and not PLACE.search("http://localhost:6006/x/y 1/s 90 %/min ./a/b")


def test_every_notebook_of_the_folder_is_tested():
    assert sorted(path.stem for path in FOLDER.glob("*.ipynb")) == sorted(NAMES)


@each
def test_the_file_is_a_notebook_for_any_python_3(name):
    notebook = read(name)
    assert (notebook["nbformat"], notebook["nbformat_minor"]) == (4, 5)
    assert notebook["metadata"]["kernelspec"]["name"] == "python3"
    identifiers = [cell["id"] for cell in notebook["cells"]]
    assert len(set(identifiers)) == len(identifiers) > 10
    assert all(re.fullmatch(r"[\w-]{1,64}", identifier) for identifier in identifiers)
    assert Path(FOLDER / f"{name}.ipynb").stat().st_size < LARGEST


@each
def test_every_cell_was_executed_in_order_without_an_error(name):
    cells = code(read(name))
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1))
    for cell in cells:
        kinds = {output["output_type"] for output in cell["outputs"]}
        assert kinds <= {"stream", "display_data", "execute_result"}
        assert all(output.get("name") != "stderr" for output in cell["outputs"])


@each
def test_a_command_that_fails_ends_the_notebook(name):
    for cell in code(read(name)):
        source = text(cell["source"])
        assert source.startswith(MAGICS) or not re.search(r"^\s*[%!]", source, re.MULTILINE)


@each
def test_the_output_is_plain_and_names_no_place(name):
    for output in printed(read(name)):
        assert "\x1b" not in output and "\r" not in output and not PLACE.search(output), output


@each
def test_it_has_small_pictures(name):
    found = pictures(read(name))
    assert found and all(picture.startswith(b"\x89PNG") and len(picture) <= PICTURE for picture in found)


@each
def test_it_says_first_what_it_needs_and_last_where_to_go_next(name):
    notebook = read(name)
    first, *_, last = notebook["cells"]
    start, end = text(first["source"]), text(last["source"])
    assert first["cell_type"] == last["cell_type"] == "markdown"
    assert start.startswith("# ") and "You learn" in start and "**Time:**" in start and "**You need:**" in start
    assert "## Where to go next" in end
    words = "\n".join(text(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "markdown")
    links = re.findall(r"\]\(([^)]*)\)", words)
    assert len(links) >= 4 and all(re.fullmatch(r"(\.\./)?[\w/]+\.md(#[\w-]+)?", link) for link in links)
    assert not re.search(r"TODO|XXX", words)
