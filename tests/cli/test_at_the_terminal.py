"""Commands at a terminal: no word is broken, first words come at once, a reader of a pipe may go, files need no key."""

import fcntl
import io
import os
import pty
import re
import shutil
import struct
import subprocess
import sys
import termios
import time

import pytest

from tests.support import ROOT, few
from tests.support.commands import ENVIRONMENT, QUICK, ran, run, sentence
from usvlearn.__main__ import main
from usvlearn.cli import evaluate, train
from usvlearn.cli.main import HELP
from usvlearn.core import jit

USVLEARN, SCRIPT = [sys.executable, "-m", "usvlearn"], "usvlearn/__main__.py"
LINES, COLUMNS = 24, 80
RULE = "─━"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Logs, their configuration, and a run."""
    place = tmp_path_factory.mktemp("terminal")
    for arguments in (
        ["example", "logs", "--minutes", "4"],
        ["inspect", "logs", "--name", "heron"],
        ["train", "my_boat.yaml", "hydra.run.dir=run", "estimators.rnn.neurons=4"],
    ):
        ran(*arguments, folder=place, script=SCRIPT)
    return place


def words(text: str) -> set[str]:
    """The words of an output, in which all numbers are equal: times differ from call to call."""
    return {re.sub(r"[\d.]+", "0", word) for word in text.split() if not set(word) <= set(RULE)}


PRINTED = {
    "inspect": ["inspect", "logs", "--output", "again.yaml", "--force"],
    "train": ["train", "my_boat.yaml", "hydra.run.dir=again", *QUICK[2:-1]],
    "plan": ["plan", "run", "--minutes", "1"],
    "controller": ["controller", "run", "--boats", "20", "--out", "gains"],
    "export": ["export", "run", "--to", "c,json"],
    "certify": ["certify", "run", "--box", "--seconds", "0.1"],
    "help": ["--help"],
    "help of live": ["live", "--help"],
    **{f"help of {name}": [name, "--help"] for name in ("train", "evaluate")},
    **{f"usage of {name}": [name] for name in ("inspect", "plan", "controller")},
}


SLOW, THOROUGH = ["inspect", "controller"], ["train", "plan", "certify"]
QUICK_ONES = [name for name in PRINTED if name not in SLOW + THOROUGH]


@pytest.mark.parametrize("name", [*QUICK_ONES, *few(THOROUGH, (), "thorough"), *few(SLOW, ())])
def test_no_line_is_broken_within_a_word(name, folder, monkeypatch, capsys):
    """At 80 and 60 columns are the words that are printed without a limit, and no line is longer but by one word."""
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, "argv", ["usvlearn"])
    said = {}
    for columns in (None, 80, 60):
        monkeypatch.delenv("COLUMNS", raising=False) if columns is None else monkeypatch.setenv("COLUMNS", str(columns))
        shutil.rmtree("again", ignore_errors=True)
        try:
            main(PRINTED[name])
        except SystemExit as end:
            assert not end.code
        printed = capsys.readouterr()
        said[columns] = printed.err if "usage" in name else printed.out
    for columns in (80, 60):
        assert words(said[columns]) <= words(said[None]), words(said[columns]) - words(said[None])
        if "help" in name or "usage" in name:
            continue  # a fixed text for 80 columns
        long = [line for line in said[columns].splitlines() if len(line) > columns and len(line.split()) > 1]
        assert [line for line in long if not FILE.match(line)] == []
    assert max(map(len, said[80].splitlines())) <= 80 or "usage" in name


FILE = re.compile(r"\S+,[-\d.]+  # |  \S+ = \S+ +// |  +// |-- |\s+then http")  # lines of files, which are copied whole


def at_a_terminal(*arguments: str, folder) -> str:
    """What a command writes to a terminal of 80 columns."""
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", LINES, COLUMNS, 0, 0))
    environment = {name: value for name, value in os.environ.items() if name != "COLUMNS"} | {"PYTHONPATH": str(ROOT)}
    process = subprocess.Popen(arguments, cwd=folder, env=environment, stdin=theirs, stdout=theirs, stderr=theirs)
    os.close(theirs)
    said = b""
    try:
        while part := os.read(ours, 65536):
            said += part
    except OSError:  # the end
        pass
    process.wait()
    return said.decode().replace("\r\n", "\n")


@pytest.mark.parametrize(
    "program",
    [[*USVLEARN, "train"], pytest.param([sys.executable, str(ROOT / "train.py")], marks=pytest.mark.thorough)],
)
def test_first_words_and_errors_fit_a_terminal_and_a_pipe_is_clean(program, tmp_path):
    arguments = [*program, "a_boat_that_nobody_knows.yaml"]
    first, *error = at_a_terminal(*arguments, folder=tmp_path).splitlines()
    assert first == "usvlearn train: loading …" and len(error) == 2 and max(map(len, error)) <= COLUMNS
    done = subprocess.run(
        arguments, cwd=tmp_path, env=ENVIRONMENT | {"PYTHONPATH": str(ROOT)}, capture_output=True, text=True
    )
    assert done.stdout == "" and done.stderr == f"{' '.join(error)}\n"


@pytest.mark.thorough
@pytest.mark.parametrize("name", few(HELP, ["evaluate"], "thorough"))
def test_help_fits_a_screen_and_the_rest_is_asked_for(name, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", [])
    with pytest.raises(SystemExit):
        main([name, "--help"])
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) < LINES and max(map(len, lines)) <= COLUMNS
    done = run(name, "--help=all", folder=tmp_path, script=SCRIPT)
    assert done.returncode == 0 and len(done.stdout.splitlines()) > LINES and "objective:" in done.stdout


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.thorough
def test_a_compilation_counts_its_seconds_at_a_terminal(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "stderr", Terminal())
    monkeypatch.setattr(jit, "folder", lambda source: tmp_path)
    with jit.announce(jit.__file__, "trial"):
        for _ in range(600):  # a minute at most
            time.sleep(0.1)
            if " s" in sys.stderr.getvalue():
                break
    text = "usvlearn: compiling the trial, only once …"
    lines = rf"{text}(\r{text} [1-9]\d* s)+\r{text} [1-9]\d* s\033\[K\n  kept in {re.escape(str(tmp_path))}\n"
    assert re.fullmatch(lines, sys.stderr.getvalue())


@pytest.mark.parametrize(
    ("arguments", "written"),
    [
        (["--help"], ""),
        *(
            pytest.param(*each, marks=pytest.mark.thorough)
            for each in (
                (["plan", "run", "--minutes", "1", "--out", "{}/plan"], "plan/heron.csv"),
                (["inspect", "logs", "--output", "{}/boat.yaml"], "boat.yaml"),
            )
        ),
    ],
)
def test_a_reader_who_goes_early_stops_nothing(arguments, written, folder, tmp_path):
    with subprocess.Popen(
        [*USVLEARN, *(each.format(tmp_path) for each in arguments)], cwd=folder,
        env=ENVIRONMENT | {"PYTHONPATH": str(ROOT)}, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    ) as process:  # fmt: skip
        process.stdout.close()
        error = process.stderr.read()
    assert "Traceback" not in error and "BrokenPipe" not in error
    assert process.returncode == 0 and (tmp_path / written).exists()


def test_a_picture_that_cannot_be_drawn_is_told_before_anything_is_written(folder, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, "argv", [])
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(SystemExit):
        main(["inspect", "logs", "--plot", "--output", str(tmp_path / "boat.yaml")])
    assert "usvlearn[plot]" in capsys.readouterr().err and not list(tmp_path.iterdir())


FORGIVEN = {
    "no file": (train, ["nofile.yaml"], "data: found 'nofile.yaml', but there is no such file"),
    "no file behind data=": (train, ["data=nofile.yaml"], "data: found 'nofile.yaml', but there is no such file"),
    "no file in a folder": (train, ["x/nofile.yaml"], "data: found 'x/nofile.yaml', but there is no such file"),
    "no log": (train, ["x/nolog.csv"], "data: found 'x/nolog.csv', but there is no such file"),
    "logs": (train, ["logs"], "first run usvlearn inspect logs, which writes my_boat.yaml"),
    "logs behind data=": (train, ["data=./logs"], "data: found './logs', expected the configuration of logs"),
    "a log": (train, ["-m", "logs/heron_1.alog", "seeds=2"], "first run usvlearn inspect logs/heron_1.alog"),
    "a run": (train, ["run"], "data: found 'run', the folder of a run: to judge it: usvlearn evaluate run"),
    "a run behind data=": (train, ["data=run"], "data: found 'run', the folder of a run"),
    "runs": (train, ["."], "data: found '.', a folder of runs: to judge them: usvlearn evaluate ."),
    "a checkpoint": (train, ["run/results.json"], "data: found 'run/results.json', a file of a run"),
    "a known configuration": (train, ["simulatd"], "did you mean data=simulated?"),
    "no run": (evaluate, ["norun"], "runs: found 'norun', but there is no such folder"),
    "a file in a run": (evaluate, ["run/results.json"], "runs: found the file 'run/results.json', expected a folder"),
    "two runs": (evaluate, ["run", "logs"], "runs: found 2 folders, expected one"),
    "only logs": (evaluate, ["my_boat.yaml"], "runs is not set"),
    "logs in place of a run": (evaluate, ["logs"], "runs: found no run below 'logs'"),
}


@pytest.mark.parametrize("case", FORGIVEN)
def test_a_path_without_its_key_is_told_what_it_is(case, folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    job, arguments, said = FORGIVEN[case]
    assert said in (error := sentence(job.main, arguments, monkeypatch, capsys)), error


@pytest.mark.parametrize("program", ["train", "evaluate"])
def test_a_path_without_its_key_is_understood(program, folder):
    done = run(program, *["run"][program == "train" :], "my_boat.yaml", "--cfg", "job", folder=folder, script=SCRIPT)
    assert f"path: {folder}/logs" in done.stdout and ("runs: run\n" in done.stdout) == (program == "evaluate")
