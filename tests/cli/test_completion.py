"""`usvlearn completion`: what each shell completes."""

import shutil
import subprocess
import sys

import pytest

from usvlearn.cli import completion
from usvlearn.cli.completion import SCRIPTS, words
from usvlearn.errors import ConfigError

LINES = {  # what stands before the cursor -> a word that completes it
    "usvlearn tra": "train",
    "usvlearn train data=blue": "blueboat",
    "usvlearn train data=my_": "my_boat.yaml",
    "usvlearn train estimators.rnn.neur": "estimators.rnn.neurons=",
    "usvlearn evaluate object": "objective=",
    "usvlearn plan --min": "--minutes",
    "usvlearn certify --verif": "--verify",
    "usvlearn live mav": "mavlink",
}


@pytest.fixture(scope="module")
def scripts(tmp_path_factory):
    folder, found = tmp_path_factory.mktemp("shells"), words()
    for shell, write in SCRIPTS.items():
        (folder / shell).write_text("\n".join(write(found)))
    (folder / "my_boat.yaml").touch()
    return folder


@pytest.mark.parametrize("shell", SCRIPTS)
def test_a_shell_reads_its_script(shell, scripts):
    if shutil.which(shell) is None:
        pytest.skip(f"{shell} is not installed")
    done = subprocess.run([shell, "-n", scripts / shell], capture_output=True, text=True)
    assert done.returncode == 0 and done.stderr == ""


@pytest.mark.parametrize("line", LINES)
def test_bash_completes_commands_keys_and_files(line, scripts):
    if shutil.which("bash") is None:
        pytest.skip("bash is not installed")
    code = (
        f"source ./bash; COMP_LINE='{line}'; COMP_POINT=${{#COMP_LINE}}; COMP_WORDS=({line}); "
        "COMP_CWORD=$((${#COMP_WORDS[@]} - 1)); _usvlearn; printf '%s\\n' \"${COMPREPLY[@]}\""
    )
    done = subprocess.run(["bash", "-c", code], cwd=scripts, capture_output=True, text=True)
    assert LINES[line] in [each.rpartition("data=")[2] for each in done.stdout.split()], done


@pytest.mark.parametrize("line", LINES)
def test_fish_completes_commands_keys_and_files(line, scripts):
    if shutil.which("fish") is None:
        pytest.skip("fish is not installed")
    code = f"source ./fish; complete -C '{line}'"
    done = subprocess.run(["fish", "-c", code], cwd=scripts, capture_output=True, text=True)
    found = [each.partition("\t")[0].rpartition("data=")[2] for each in done.stdout.splitlines()]
    assert LINES[line] in found, done


def test_another_shell_is_refused(monkeypatch):
    with pytest.raises(ConfigError, match="found 'bsh', expected one of bash, zsh, fish: did you mean bash"):
        completion.work(["bsh"])
    monkeypatch.setattr(sys, "argv", ["usvlearn completion"])
    assert completion.main() == 0
