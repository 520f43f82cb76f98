"""The pages of docs/ and the README: every block of code runs, as it stands there, or says why it does not.

Blocks of a page run one after the other in a folder of their own, in which there are logs, their configuration and a
finished run: `logs/`, `my_boat.yaml`, `outputs/heron`. Pages that show how to start begin with an empty folder. `sh`
runs in bash, `python` in one namespace, and `yaml` is parsed. A `text` block directly behind one that runs is compared
with what that one printed. The runs take minutes, so they are marked `docs`: `pytest -m docs`.
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

from tests.support import ROOT, made_once, over
from usvlearn.logs.channels.channel import AUXILIARY, CHANNELS, Source

PAGES = sorted(
    path
    for path in [*(ROOT / "docs").rglob("*.md"), ROOT / "README.md"]
    if path.parent.name not in ("tutorials", "adr")  # made of notebooks, which run elsewhere; without code
)
NAMES = [path.relative_to(ROOT).as_posix() for path in PAGES]
FROM_NOTHING = ("README.md", "docs/start.md")  # they make the logs themselves
RUN, PARSED, SHOWN = ("sh", "python"), ("yaml",), ("text", "c", "matlab", "ini", "xml", "html", "json")
REASON = re.compile(r"<!-- (not run|shown): (?P<reason>[^>]{8,}) -->\s*$")
NUMBER = re.compile(r"[-+−]?\d[\d.,]*(?:e[-+]?\d+)?")
BLOCK = re.compile(r"^(?P<indent> *)```(?P<language>\S*)[^\n]*\n(?P<text>.*?)^(?P=indent)```\s*$", re.M | re.S)
COMMAND = re.compile(r"^ {4,}(.*(&&|\|) )?(usvlearn|python3?|pip|pytest|tensorboard|ros2|git|mkdir|pUSVLearn) ", re.M)


class Block(NamedTuple):
    line: int
    language: str
    text: str
    reason: str | None  # why it does not run, or is not compared


def blocks(text: str) -> list[Block]:
    """The fenced blocks of a page.

    >>> blocks("a\\n\\n```sh\\nls\\n```\\n")
    [Block(line=3, language='sh', text='ls\\n', reason=None)]
    """
    fenced = []
    for block in BLOCK.finditer(text):
        before = text[: block.start()]
        reason = REASON.search(before)
        body = re.sub(rf"^{block['indent']}", "", block["text"], flags=re.M)
        fenced.append(Block(before.count("\n") + 1, block["language"], body, reason and reason["reason"]))
    return fenced


@over("name", NAMES)
def test_every_block_says_what_it_is(name):
    """So that none escapes: each has a language that runs, is parsed or is only shown, and no command is bare."""
    text = (ROOT / name).read_text()
    for block in blocks(text):
        assert block.language in (*RUN, *PARSED, *SHOWN), f"{name}:{block.line}: language {block.language!r}"
        assert block.reason is None or block.language in (*RUN, "text"), (
            f"{name}:{block.line}: does not run in any case"
        )
    assert text.count("```") == 2 * len(blocks(text)), f"{name}: a fence is not closed"
    outside = BLOCK.sub("", text)
    bare = COMMAND.search(outside)
    assert bare is None, f"{name}: a command outside of a block: {bare.group().strip()}"
    assert not re.search(r"^\s*~~~|<pre", text, re.M), f"{name}: a block that is not fenced by ```"


def normal(text: str) -> str:
    """A text whose numbers, blanks and rules are all alike.

    >>> normal("MAE   0.0243 m/s; 3.4 s\\n────────")
    'MAE # m/s; # s ─'
    """
    text = re.sub(r"[─━═]+", "─", NUMBER.sub("#", text))
    return " ".join(text.split())


def shows(block: str, printed: str) -> bool:
    """Whether a block shows what was printed; in its place, a line `…` stands for any lines.

    >>> shows("a 1\\n…\\nc 3", "a 2\\nb\\nc  5"), shows("a 1\\nc 3", "a 2\\nb\\nc 5")
    (True, False)
    """
    parts = re.split(r"^\s*…\s*$", block, flags=re.M)
    return re.fullmatch(".*".join(re.escape(normal(part)) for part in parts), normal(printed)) is not None


@pytest.fixture(scope="session")
def prepared(tmp_path_factory) -> Path:
    """The folder in which a page's blocks run, before the first of them."""

    def make(folder: Path) -> None:
        for script in ("train.py", "evaluate.py"):
            shutil.copy(ROOT / script, folder)
        commands = (
            "usvlearn example logs",
            "usvlearn inspect logs --name heron",
            "usvlearn train my_boat.yaml hydra.run.dir=outputs/heron",
        )
        shell("\n".join(commands), folder, "before all pages")

    return made_once(tmp_path_factory, "prepared", make)


def shell(commands: str, folder: Path, where: str) -> str:
    """What the commands printed, without their messages on stderr."""
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    environment = os.environ | {"PATH": path, "PYTHONPATH": str(ROOT), "COLUMNS": "96"}
    command = ["bash", "-euo", "pipefail", "-c", commands]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=280)
    assert done.returncode == 0, (
        f"{where}: code {done.returncode}\n{commands}\n{done.stdout[-3000:]}{done.stderr[-3000:]}"
    )
    return done.stdout


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
    monkeypatch.setenv("COLUMNS", "96")
    names: dict = {"__name__": "page"}
    printed = None  # by the block before
    for block in blocks((ROOT / name).read_text()):
        where = f"{name}:{block.line}"
        before, printed = printed, None
        if block.language == "yaml":
            check_channels(yaml.safe_load(block.text), where)
        elif block.reason:
            continue
        elif block.language == "sh":
            printed = shell(block.text, folder, where)
        elif block.language == "python":
            with contextlib.redirect_stdout(io.StringIO()) as out:
                exec(compile("\n" * block.line + block.text, where, "exec"), names)
            printed = out.getvalue()
        elif block.language == "text" and before is not None:
            assert shows(block.text, before), f"{where}: shows\n{block.text}\nand this was printed:\n{before}"


def test_every_command_has_a_row_in_the_reference():
    from usvlearn.cli.main import COMMANDS

    page = (ROOT / "docs" / "reference" / "index.md").read_text()
    rows = set(re.findall(r"^\| `usvlearn (\w+)", page, re.M))
    assert rows == set(COMMANDS)
