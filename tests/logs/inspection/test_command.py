"""The command `usvlearn inspect`: what it writes and prints, and one sentence for each bad input."""

import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from hydra.core.override_parser.overrides_parser import OverridesParser

from tests.support import ROOT, few
from tests.support.commands import complaints
from tests.support.exported import write_alog, write_table
from tests.support.shapes import SHAPES
from tests.support.voyages import voyage
from usvlearn.cli.main import main
from usvlearn.composition.configuration import recordings_of
from usvlearn.composition.data_files import with_data_files
from usvlearn.logs.inspection.logfiles import boats_of

MINUTES = 2.0  # of a voyage: enough to be read, for what is said and written


@pytest.fixture
def log(tmp_path):
    return SHAPES["pwm"].write(tmp_path, voyage(minutes=MINUTES))


@pytest.fixture
def run(tmp_path, monkeypatch, capsys):
    """Runs the command in an empty folder; gives its code and what it printed."""
    folder = tmp_path / "here"
    folder.mkdir()
    monkeypatch.chdir(folder)
    monkeypatch.setenv("COLUMNS", "80")

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["usvlearn"])
        try:
            code = main(["inspect", *map(str, arguments)])
        except SystemExit as end:
            code = end.code
        return code, capsys.readouterr()

    return call


@pytest.mark.thorough
def test_it_writes_a_configuration_that_reads_the_log(run, log):
    code, printed = run(log, "--name", "my boat")
    assert code == 0
    assert "usvlearn train data=my_boat.yaml" in printed.out
    assert max(map(len, printed.out.splitlines())) <= 80
    written = Path("my_boat.yaml").read_text()
    assert written.startswith("# @package _global_\n")
    settings = yaml.safe_load(written)
    assert settings["data"]["boat"] == "my boat"
    recordings, _ = recordings_of("my_boat.yaml", {})  # as train.py composes it
    assert [one.boat for one in recordings] == ["my boat"]


@pytest.mark.parametrize(
    "folder", few(["my boats", "it's", "a=b,c(d)", "Müller", "do$llar"], ["it's", "do$llar"], "thorough")
)
def test_the_printed_line_reads_any_path(run, log, folder):
    Path(folder).mkdir()
    code, printed = run(log, "--output", f"{folder}/b.yaml")
    assert code == 0
    line = next(each for each in printed.out.splitlines() if "usvlearn train" in each)
    *_, given = shlex.split(line)  # as a POSIX shell does
    (override,) = with_data_files([given])
    value = OverridesParser.create().parse_override(override).value()
    assert getattr(value, "text", value) == str(Path(folder, "b.yaml").resolve())


def test_missing_channels_are_told_with_a_configuration_of_their_format(run, tmp_path):
    path = tmp_path / "a.alog"
    write_alog(path, {"NAV_HEADING": (np.arange(500) / 10, np.arange(500.0) % 360)})
    code, printed = run(path)
    assert code == 2
    assert f"copy {ROOT / 'configs' / 'data' / 'alog.yaml'} to my_boat.yaml" in " ".join(printed.err.split())


def test_it_does_not_replace_a_file_unless_asked(run, log):
    Path("my_boat.yaml").write_text("mine")
    code, printed = run(log)
    assert (code, Path("my_boat.yaml").read_text()) == (2, "mine")
    assert printed.err == "error: --output: my_boat.yaml exists: give another name, or --force to replace it\n"
    assert run(log, "--force")[0] == 0
    assert Path("my_boat.yaml").read_text() != "mine"
    Path("other.png").write_text("mine")
    code, printed = run(log, "--output", "other.yaml", "--plot")
    assert (code, Path("other.png").read_text(), Path("other.yaml").exists()) == (2, "mine", False)
    assert "other.png exists" in printed.err


def test_any_name_is_quoted(run, tmp_path):
    time = np.arange(0, 300, 0.1)
    columns = {
        "time": time,
        "left thrust: #1 'x'": 0.5 + 0.4 * np.sin(time / 20 + 0.5),
        "right thrust: #1 'x'": 0.5 + 0.4 * np.sin(time / 20),
        'heading \\ "true"': 90 + 20 * np.sin(time / 30),
        "speed {m/s}": 1 + np.sin(time / 20),
    }
    code, _ = run(write_table(tmp_path / "odd.csv", columns))
    assert code == 0
    channels = yaml.safe_load(Path("my_boat.yaml").read_text())["data"]["channels"]
    assert channels["command_left"]["name"] == "left thrust: #1 'x'"
    assert channels["command_right"]["name"] == "right thrust: #1 'x'"
    assert channels["heading"]["name"] == 'heading \\ "true"'


@pytest.mark.thorough
def test_the_picture_is_drawn(run, log):
    assert run(log, "--plot")[0] == 0
    assert Path("my_boat.png").read_bytes()[:4] == b"\x89PNG"


def one_row(path):
    return write_table(
        path, {"time": [1.0], "left_thrust": [1.0], "right_thrust": [1.0], "heading": [3.0], "speed": [1.0]}
    )


def zeros(path):
    zero = np.zeros(500)
    names = ("left_thrust", "right_thrust", "heading", "speed")
    return write_table(path, {"time": np.arange(500) / 10, **dict.fromkeys(names, zero)})


BAD = {
    "empty.csv": lambda path: path.write_bytes(b""),
    "rubbish.bin": lambda path: path.write_bytes(np.random.default_rng(0).bytes(5000)),
    "rubbish.csv": lambda path: path.write_bytes(np.random.default_rng(0).bytes(5000)),
    "image.png": lambda path: path.write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(500)),
    "image.csv": lambda path: path.write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(500)),
    "text.txt": lambda path: path.write_text("Dear all,\nthe boat was lost.\n"),
    "header.csv": lambda path: path.write_text("time,speed,heading\n"),
    "half.alog": lambda path: path.write_text("%% LOG FILE\n%% LOGSTART 1\n"),
    "half.bag": lambda path: path.write_bytes(b"#ROSBAG V2.0\n" + bytes(50)),
    "half.mcap": lambda path: path.write_bytes(b"\x89MCAP0\r\n" + bytes(50)),
    "half.db3": lambda path: path.write_bytes(b"SQLite format 3\0" + bytes(50)),
    "half.BIN": lambda path: path.write_bytes(b"\xa3\x95\x80" + bytes(500)),
    "half.tlog": lambda path: path.write_bytes(bytes(8) + b"\xfe" + bytes(500)),
    "half.ulg": lambda path: path.write_bytes(b"ULog\x01\x12\x35\x01" + bytes(500)),
    "folder": lambda path: path.mkdir(),
    "one_row.csv": one_row,
    "zeros.csv": zeros,
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input_is_told_in_one_sentence(run, tmp_path, name):
    BAD[name](tmp_path / name)
    code, printed = run(tmp_path / name)
    text = complaints(printed.err)
    assert code == 2
    assert text.count("\n") == 1, text
    assert text.startswith("error: ")
    assert name in text


def test_a_missing_log_is_told(run, tmp_path):
    code, printed = run(tmp_path / "nowhere.csv")
    assert code == 2
    assert printed.err == f"error: {tmp_path / 'nowhere.csv'}: does not exist: give a log, or a folder of logs\n"


def test_logs_of_several_formats_are_refused(run, tmp_path):
    SHAPES["pwm"].write(tmp_path, voyage(minutes=MINUTES))
    SHAPES["moos"].write(tmp_path, voyage(minutes=MINUTES))
    code, printed = run(tmp_path)
    assert code == 2
    assert "expected logs of one format, found 1 of MOOS (moos.alog), 1 of tables (pwm.csv)" in printed.err


def test_several_logs_are_one_boat(run, tmp_path):
    for seed in (0, 1):
        (tmp_path / "logs").mkdir(exist_ok=True)
        SHAPES["moos"].write(tmp_path / "logs", voyage(seed, minutes=MINUTES)).rename(
            tmp_path / "logs" / f"run_{seed}.alog"
        )
    code, printed = run(tmp_path / "logs" / "run_0.alog", tmp_path / "logs" / "run_1.alog")
    assert code == 0
    assert "Read back: 2 runs" in printed.out
    assert yaml.safe_load(Path("my_boat.yaml").read_text())["data"]["path"] == str(tmp_path / "logs" / "run_*.alog")


@pytest.mark.thorough
def test_logs_of_several_boats_are_told_and_what_is_told_works(run, tmp_path):
    folder = tmp_path / "logs"
    folder.mkdir()
    for name in ("heron_1", "heron_2", "otter_1", "otter_2"):
        SHAPES["plain"].write(folder, voyage(minutes=MINUTES)).rename(folder / f"{name}.csv")
    code, printed = run(folder)
    assert code == 0
    assert "heron and otter" in " ".join(printed.out.split())
    settings = yaml.safe_load(Path("my_boat.yaml").read_text())
    settings["data"] |= {"boat": None, "path": boats_of(sorted(folder.iterdir()))}
    Path("boats.yaml").write_text(f"# @package _global_\n{yaml.safe_dump(settings)}")
    assert [one.boat for one in recordings_of("boats.yaml", {})[0]] == ["heron", "heron", "otter", "otter"]


def test_notes_and_hidden_files_are_no_logs(run, tmp_path, log):
    for name in (".hidden.csv", "README.txt"):
        (tmp_path / name).write_text("some text\nand more\n")
    code, printed = run(tmp_path)
    assert (code, printed.err) == (0, "")
    assert printed.out.startswith("1 log of tables")


def test_a_note_is_told_once(run):
    lines = SHAPES["pwm"].write(Path(), voyage(minutes=MINUTES)).read_text().splitlines()
    rows = [each.partition(",") for each in lines[1:]]
    text = [lines[0], *(f"{int(float(stamp))},{cells}" for stamp, _, cells in rows)]
    Path("whole.csv").write_text("\n".join(text))
    code, printed = run("whole.csv")
    assert code == 0 and printed.out.count("whole seconds") == 1


def test_columns_of_one_name_are_told(run, log):
    lines = log.read_text().splitlines()
    Path("twice.csv").write_text("\n".join([f"{lines[0]},speed,speed", *(f"{each},1,2" for each in lines[1:])]))
    _, printed = run("twice.csv")
    text = " ".join(printed.out.split())
    assert text.count("several columns are called 'speed', and none of them is taken") == 1


def test_a_folder_of_tables_with_the_suffix_of_text(run, tmp_path, log):
    log.rename(tmp_path / "log.txt")
    code, printed = run(tmp_path)
    assert (code, printed.err) == (0, "")
    assert "Read back: 1 run" in printed.out


@pytest.mark.parametrize(
    ("option", "value", "words"),
    [
        ("--output", "a.txt", ""),
        ("--output", "no/a.yaml", ""),
        ("--name", "a/b", ""),
        ("--name", "${vehicle.mass}", "'${vehicle.mass}', which a configuration takes for a reference"),
    ],
)
def test_options_are_checked(run, log, option, value, words):
    code, printed = run(log, option, value)
    assert (code, printed.err.count("\n")) == (2, 1)
    assert printed.err.startswith(f"error: {option}: found {words}")


@pytest.mark.thorough
def test_it_needs_no_torch(log, tmp_path):
    code = (
        "import sys; sys.argv = ['usvlearn', 'inspect', *sys.argv[1:]]\n"
        "from usvlearn.__main__ import main\nmain()\nprint('torch' in sys.modules, 'hydra' in sys.modules)"
    )
    command = [sys.executable, "-c", code, str(log), "--output", str(tmp_path / "boat.yaml")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "False False"
