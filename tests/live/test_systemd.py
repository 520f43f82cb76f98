"""The systemd unit of a node: what systemd itself reads in it."""

import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from usvlearn.errors import ConfigError
from usvlearn.live.systemd import main, unit

MANAGER = next((path for path in ("/lib/systemd/systemd", "/usr/lib/systemd/systemd") if Path(path).exists()), None)
NOBODY = 65534
WORDS = [
    "live",
    "moos",
    "my mission.moos",
    "50%",
    "$HOME",
    "${X}",
    'say "so"',
    "back\\slash",
    ";",
    "",
    "'",
    "ü #",
    "\\x41",
]


@pytest.fixture
def understood():
    """What systemd reads in a unit, as lines of its own dump."""
    if MANAGER is None:
        pytest.skip("systemd is not installed")

    def read(text: str) -> list[str]:
        with tempfile.TemporaryDirectory() as folder:
            os.chmod(folder, 0o777)  # the manager does not run as root
            (Path(folder) / "node.service").write_text(text)
            other = {"user": NOBODY, "group": NOBODY, "extra_groups": []} if os.getuid() == 0 else {}
            done = subprocess.run(
                [MANAGER, "--user", "--test", "--unit=node.service", "--no-pager"],
                env={"PATH": os.environ["PATH"], "HOME": folder, "XDG_RUNTIME_DIR": folder,
                     "SYSTEMD_UNIT_PATH": f"{folder}:/usr/lib/systemd/user:/lib/systemd/user"},
                cwd="/", capture_output=True, text=True, timeout=60, **other,
            )  # fmt: skip
        if "-> Unit node.service:" not in done.stdout:
            pytest.skip(f"systemd makes no dump here: {done.stderr[-200:]}")
        assert "node.service:" not in done.stderr, done.stderr
        own = done.stdout.partition("-> Unit node.service:")[2].partition("-> Unit ")[0]
        return [line.strip() for line in own.splitlines()]

    return read


def shown(word: str) -> str:
    """A word of a command as systemd's dump shows it."""
    for each in ("\\", '"', "$", "`"):
        word = word.replace(each, f"\\{each}")
    return word if re.fullmatch(r"[\w./%-]+", word, re.ASCII) else f'"{word}"'


def test_systemd_reads_the_words_and_paths_that_were_given(understood):
    folder = Path('/home/boat/my "100%" node\\1')
    found = understood(unit(["/usr/bin/env", *WORDS], folder, "boat", Path("/home/boat/at 5%"), Path("/var/c %n")))
    (line,) = (line for line in found if line.startswith("Command Line:"))
    told = [word.replace("$", "$$") for word in WORDS]  # $$ becomes $ when the command starts
    assert line == "Command Line: " + " ".join(map(shown, ["/usr/bin/env", *told]))
    for expected in (
        "WorkingDirectory: /home/boat/at 5%", "Environment: NUMBA_CACHE_DIR=/var/c %n", "Restart: always",
        "RestartSec: 5s", "KillSignal: SIGTERM", "TimeoutStopSec: 1min", "ProtectSystem: strict", "PrivateTmp: yes",
        f"ReadWritePaths: {folder} -/var/c %n/usvlearn", "MemoryMax: 629145600", "Nice: 5",
    ):  # fmt: skip
        assert expected in found, expected


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd-analyze is not installed")
def test_systemd_finds_nothing_wrong(tmp_path):
    path = tmp_path / "usvlearn.service"
    path.write_text(unit([sys.executable, "-m", "usvlearn", "live", "moos", "a b.moos"], tmp_path, "boat"))
    done = subprocess.run(["systemd-analyze", "verify", str(path)], capture_output=True, text=True, timeout=60)
    own = [line for line in (done.stdout + done.stderr).splitlines() if "usvlearn.service" in line]
    assert own == []
    path.write_text(path.read_text().replace("ProtectSystem=strict", "ProtectSystem=perhaps\nNoSuchKey=1"))
    done = subprocess.run(["systemd-analyze", "verify", str(path)], capture_output=True, text=True, timeout=60)
    assert "perhaps" in done.stderr and "NoSuchKey" in done.stderr


def test_the_command_prints_it(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("NUMBA_CACHE_DIR", "code")
    assert main(["--folder", "a/../node", "--user", "boat", "moos", "a b.moos", "--verbose"]) == 0
    text = capsys.readouterr().out
    node = str(tmp_path / "node")
    words = [sys.executable, "-m", "usvlearn", "live", "moos", "--folder", node, "a b.moos", "--verbose"]
    assert text == unit(words, tmp_path / "node", "boat", tmp_path, tmp_path / "code")
    assert main(["--user", "boat", "ros2", node, "--ros-args"]) == 0
    assert f'"ros2" "{node}" "--ros-args"' in capsys.readouterr().out
    for given in (["--folder", "/n/x"], ["--folder=/n/x"]):
        assert main(["--user", "boat", "mavlink", "udpin:127.0.0.1:14550", *given]) == 0
        assert '\nReadWritePaths="/n/x" ' in capsys.readouterr().out
    for given in (["moos", "a.moos", "--user", "boat"], ["moos", "--user=boat", "a.moos"]):
        assert main(["--folder", "/n/x", *given]) == 0
        text = capsys.readouterr().out
        assert "\nUser=boat\n" in text and '"live" "moos" "--folder" "/n/x" "a.moos"\n' in text
    assert main(["--folder=/n/x", "--user=c", "ros2", "--ros-args", "--user", "boat", "--user=a"]) == 0
    assert '"--ros-args" "--user" "boat" "--user=a"\n' in capsys.readouterr().out
    assert main([]) == main(["--help"]) == 0
    assert capsys.readouterr().out.startswith("usage: usvlearn live systemd")


def test_the_code_that_the_user_warmed_is_used(tmp_path, monkeypatch, capsys):
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    name = "daemon"
    main(["--folder", "/n", "--user", name, "moos"])
    assert f'NUMBA_CACHE_DIR={Path("~daemon").expanduser()}/.cache"' in capsys.readouterr().out
    main(["--folder", "/n", "--user", "nobody_of_this_name", "moos"])
    assert 'NUMBA_CACHE_DIR=/n/cache"' in capsys.readouterr().out


@pytest.mark.parametrize("arguments, sentence", [
    (["--user", "boat", "moos"], "--folder: found none"), (["--folder"], "--folder: found no value"),
    (["--folder", "/n", "--user", "boat"], "command: found ''"),
    (["--folder", "/n", "moos", "a.moos", "--user"], "--user: found no value"),
    (["--folder", "/n", "ros2", "--user", "--ros-args"], "--user: found no value"),
    (["--folder", "/n", "--fodler", "x"], "command: found '--fodler x'"),
    (["--folder", "/n", "foo"], "command: found 'foo', expected moos, mavlink, ros2"),
    (["--folder", "/n", "--user", "root", "moos"], "user: found 'root'"),
    (["--folder", "/n", "--user", "a\nExecStartPre=/bin/rm", "moos"], "user: found"),
    (["--folder", "/n", "--user", "boat", "moos", "a\nExecStartPre=/bin/rm"], "systemd: found 'a"),
    (["--folder", "/n\n", "--user", "boat", "moos"], "systemd: found '/n"),
    (["--folder", "/n ", "--user", "boat", "moos"], "systemd: found '/n '"),
    (["--folder", "/n\udc80", "--user", "boat", "moos"], "systemd: found '/n"),
])  # fmt: skip
def test_what_a_unit_cannot_contain_is_refused(arguments, sentence):
    with pytest.raises(ConfigError, match=re.escape(sentence)):
        main(arguments)


@pytest.mark.parametrize("command, folder", [
    ([], "/n"), (["@program"], "/n"), ([""], "/n"), (["program"], "n"), (["program"], "/n\\"),
])  # fmt: skip
def test_an_illegal_unit_is_refused(command, folder):
    with pytest.raises(ConfigError):
        unit(command, Path(folder), "boat")
