"""The pages of docs/ and the README: every block of code runs, as it stands there, or says why it does not.

Blocks of a page run one after the other in a folder of their own, in which there are logs, their configuration and a
finished run: `logs/`, `my_boat.yaml`, `outputs/RUN`. Pages that show how to start begin with an empty folder. `sh` runs
in bash, `python` in one namespace, and `yaml` is parsed.
The runs take minutes, so they are marked `docs`: `pytest -m docs`.
"""

import contextlib
import io
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest
import yaml

from tests.support import ROOT
from usvlearn.logs.channels.channel import AUXILIARY, CHANNELS, Source

PAGES = sorted(
    path
    for path in [*(ROOT / "docs").rglob("*.md"), ROOT / "README.md"]
    if path.parent.name != "tutorials"
    or path.name == "index.md"  # the others are made of notebooks, which run elsewhere
)
NAMES = [path.relative_to(ROOT).as_posix() for path in PAGES]
FROM_NOTHING = ("README.md", "docs/start.md")  # they make the logs themselves
RUN, PARSED, SHOWN = ("sh", "python"), ("yaml",), ("text", "c", "matlab", "ini", "xml", "html", "json")
REASON = re.compile(r"<!-- not run: (?P<reason>[^>]{8,}) -->\s*$")
BLOCK = re.compile(r"^(?P<indent> *)```(?P<language>\S*)[^\n]*\n(?P<text>.*?)^(?P=indent)```\s*$", re.M | re.S)
COMMAND = re.compile(r"^ {4,}(.*(&&|\|) )?(usvlearn|python3?|pip|pytest|tensorboard|ros2|git|mkdir|pUSVLearn) ", re.M)


class Block(NamedTuple):
    line: int
    language: str
    text: str
    reason: str | None  # why it does not run


def blocks(text: str) -> list[Block]:
    """The fenced blocks of a page.

    >>> blocks("a\\n\\n```sh\\nls\\n```\\n")
    [Block(line=3, language='sh', text='ls\\n', reason=None)]
    """
    found = []
    for block in BLOCK.finditer(text):
        before = text[: block.start()]
        reason = REASON.search(before)
        body = re.sub(rf"^{block['indent']}", "", block["text"], flags=re.M)
        found.append(Block(before.count("\n") + 1, block["language"], body, reason and reason["reason"]))
    return found


@pytest.mark.parametrize("name", NAMES)
def test_every_block_says_what_it_is(name):
    """So that none escapes: each has a language that runs, is parsed or is only shown, and no command is bare."""
    text = (ROOT / name).read_text()
    for block in blocks(text):
        assert block.language in (*RUN, *PARSED, *SHOWN), f"{name}:{block.line}: language {block.language!r}"
        assert block.reason is None or block.language in RUN, f"{name}:{block.line}: does not run in any case"
    assert text.count("```") == 2 * len(blocks(text)), f"{name}: a fence is not closed"
    outside = BLOCK.sub("", text)
    bare = COMMAND.search(outside)
    assert bare is None, f"{name}: a command outside of a block: {bare.group().strip()}"
    assert not re.search(r"^\s*~~~|<pre", text, re.M), f"{name}: a block that is not fenced by ```"


@pytest.fixture(scope="session")
def prepared(tmp_path_factory) -> Path:
    """The folder in which a page's blocks run, before the first of them."""
    folder = tmp_path_factory.mktemp("pages") / "prepared"
    folder.mkdir()
    for script in ("train.py", "evaluate.py"):
        shutil.copy(ROOT / script, folder)
    commands = (
        "usvlearn example logs",
        "usvlearn inspect logs --name heron",
        "usvlearn train data=my_boat.yaml hydra.run.dir=outputs/RUN",
    )
    shell("\n".join(commands), folder, "before all pages")
    return folder


def shell(commands: str, folder: Path, where: str) -> None:
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    environment = os.environ | {"PATH": path, "PYTHONPATH": str(ROOT), "COLUMNS": "120"}
    command = ["bash", "-euo", "pipefail", "-c", commands]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=280)
    assert done.returncode == 0, (
        f"{where}: code {done.returncode}\n{commands}\n{done.stdout[-3000:]}{done.stderr[-3000:]}"
    )


def check_channels(node, where: str) -> None:
    """That the channels in a configuration, or in a part of one, are legal."""
    assert isinstance(node, dict) and node, where
    channels = node.get("data", node).get("channels", node)
    for name, options in channels.items():
        if name in (*CHANNELS, *AUXILIARY) and isinstance(options.get("name"), str):
            Source(**options)


@pytest.mark.docs
@pytest.mark.parametrize("name", NAMES)
def test_every_block_runs(name, prepared, tmp_path, monkeypatch):
    folder = tmp_path / "page"
    if name in FROM_NOTHING:
        folder.mkdir()
    else:
        shutil.copytree(prepared, folder)
        setup = folder / "my_boat.yaml"  # which names the folder in which it was made
        setup.write_text(setup.read_text().replace(str(prepared), str(folder)))
    monkeypatch.chdir(folder)
    names: dict = {"__name__": "page"}
    for block in blocks((ROOT / name).read_text()):
        where = f"{name}:{block.line}"
        if block.reason:
            continue
        if block.language == "sh":
            shell(block.text, folder, where)
        elif block.language == "python":
            with contextlib.redirect_stdout(io.StringIO()):
                exec(compile("\n" * block.line + block.text, where, "exec"), names)
        elif block.language == "yaml":
            check_channels(yaml.safe_load(block.text), where)


def test_every_public_name_has_a_place_in_the_reference():
    import usvlearn

    pages = "".join(path.read_text() for path in (ROOT / "docs" / "reference").glob("*.md"))
    listed = set(re.findall(r"^::: usvlearn\.(\w+)$", pages, re.M))
    assert set(usvlearn.__all__) <= listed


def test_every_command_has_a_row_in_the_reference():
    from usvlearn.cli.beginning import COMMANDS

    page = (ROOT / "docs" / "reference" / "index.md").read_text()
    rows = set(re.findall(r"^\| `usvlearn (\w+)", page, re.M))
    assert rows == set(COMMANDS)
