"""A systemd unit that starts a node at boot and again whenever it ends, without the rights of root.

The command `usvlearn live systemd` prints it: see `USAGE`.
"""

from __future__ import annotations

import getpass
import os
import re
import sys
from collections.abc import Sequence
from pathlib import Path

from usvlearn.errors import ConfigError

USAGE = """usage: usvlearn live systemd --folder DIR [--user NAME] COMMAND ARGUMENTS…
Prints a systemd unit that runs `usvlearn live COMMAND ARGUMENTS…` in the current folder, as that user (by default you).
DIR is the folder of the node, the only one that it may write to. Both options may also stand among the ARGUMENTS.
    usvlearn live systemd --folder ~/usvlearn moos mission.moos | sudo tee /etc/systemd/system/usvlearn.service
    sudo systemctl daemon-reload && sudo systemctl enable --now usvlearn"""
USER = re.compile(r"[A-Za-z_][A-Za-z0-9_-]{0,31}")
ENVIRONMENT = "OMP_NUM_THREADS=1", "MALLOC_MMAP_THRESHOLD_=131072", "MALLOC_TRIM_THRESHOLD_=131072"  # save 10 MB
SHELLS = ("moos", "mavlink", "ros2")
MEMORY = 600  # MB; a node takes some 200, and 400 while it compiles


def unit(
    command: Sequence[str], folder: Path, user: str, directory: Path | None = None, cache: Path | None = None
) -> str:
    """The text of a unit.

    Args:
        command: with its arguments; the program is an absolute path, or one that systemd finds in /usr/local/bin,
            /usr/bin or /bin.
        folder: of the node, absolute. The node may write only there and to its compiled code.
        user: that runs it, not root.
        directory: in which the command starts, absolute; `folder` by default.
        cache: for `NUMBA_CACHE_DIR`, absolute; in `folder` by default.

    Raises:
        ConfigError: the user is root or no name, a path is not absolute, or a text has characters that a unit cannot
            contain.

    >>> text = unit(["usvlearn", "live", "moos", "my 50% mission.moos"], Path("/home/boat/usvlearn"), "boat")
    >>> print(text.splitlines()[7])
    ExecStart="usvlearn" "live" "moos" "my 50%% mission.moos"
    """
    if not USER.fullmatch(user) or user == "root":
        raise ConfigError(f"user: found {user!r}, expected the name of a user who is not root: give --user NAME")
    if not command or command[0][:1] in ("", *"@-:+!|"):
        raise ConfigError(f"command: found {' '.join(command)!r}, expected a program and its arguments")
    directory = folder if directory is None else directory
    cache = folder / "cache" if cache is None else cache
    for name, path in (("folder", folder), ("directory", directory), ("cache", cache)):
        if not path.is_absolute():
            raise ConfigError(f"{name}: found {str(path)!r}, expected an absolute path")
    program, *arguments = command
    return f"""# {_line(folder)} must exist and belong to {user}.
[Unit]
Description=usvlearn learns how this boat moves
After=network.target
StartLimitIntervalSec=0

[Service]
ExecStart={" ".join([_quoted(program), *(_quoted(each).replace("$", "$$") for each in arguments)])}
WorkingDirectory={_line(directory).replace("%", "%%")}
Environment={" ".join(_quoted(each) for each in (*ENVIRONMENT, f"NUMBA_CACHE_DIR={cache}"))}
User={user}
Restart=always
RestartSec=5
KillSignal=SIGTERM
TimeoutStopSec=60
Nice=5
MemoryMax={MEMORY}M
NoNewPrivileges=yes
PrivateTmp=yes
ProtectSystem=strict
ReadWritePaths={_quoted(str(folder))} {_quoted(f"-{cache}/usvlearn")}

[Install]
WantedBy=multi-user.target
"""


def _line(value: object) -> str:
    """A text that stands unquoted at the end of a line."""
    text = str(value)
    if not text.isprintable() or text.strip() != text or text.endswith("\\"):
        raise ConfigError(f"systemd: found {text!r}, expected printable characters, and no space or \\ at its end")
    return text


def _quoted(text: str) -> str:
    """A word in quotes, in which % stands for itself."""
    if not text.isprintable():
        raise ConfigError(f"systemd: found {text!r}, expected printable characters")
    escaped = text.replace("\\", "\\\\").replace('"', '\\"').replace("%", "%%")
    return f'"{escaped}"'


def main(arguments: Sequence[str]) -> int:
    """The command `usvlearn live systemd`; returns the exit code.

    Raises:
        ConfigError: there is no folder or no command, or as of `unit`.
    """
    if list(arguments) in ([], ["-h"], ["--help"]):
        print(USAGE)
        return 0
    given, command = {}, list(arguments)
    while command and command[0].partition("=")[0] in ("--folder", "--user"):
        name = command[0].partition("=")[0]
        given[name] = _taken(command, name)
    if (user := _taken(command, "--user")) is not None:  # no option of a node
        given["--user"] = user
    if not command or command[0] not in SHELLS:
        raise ConfigError(f"command: found {' '.join(command)!r}, expected {', '.join(SHELLS)} and its arguments")
    folder = given.get("--folder") or _option(command, "--folder")
    if not folder and command[0] == "ros2" and command[1:] and not command[1].startswith("-"):
        folder = command[1]
    if not folder:
        raise ConfigError("--folder: found none, expected the folder of the node, the only one that it may write to")
    user = given.get("--user") or getpass.getuser()
    place = Path(os.path.abspath(Path(folder).expanduser()))  # systemd refuses paths with ..
    if "--folder" in given:  # the node must be told, too
        command[1:1] = [str(place)] if command[0] == "ros2" else ["--folder", str(place)]
    started = [sys.executable, "-m", "usvlearn", "live", *command]
    print(unit(started, place, user, Path.cwd(), _cache(user)), end="")
    return 0


def _option(arguments: Sequence[str], name: str) -> str | None:
    """The value of an option, as `--name VALUE` or `--name=VALUE`."""
    for argument, value in zip(arguments, [*arguments[1:], ""], strict=True):
        if argument == name or argument.startswith(f"{name}="):
            return value if argument == name else argument.partition("=")[2]
    return None


def _taken(arguments: list[str], name: str) -> str | None:
    """As `_option`, of the arguments for usvlearn, which then lack the option: those after --ros-args are for ROS."""
    end = arguments.index("--ros-args") if "--ros-args" in arguments else len(arguments)
    for k, argument in enumerate(arguments[:end]):
        if argument != name and not argument.startswith(f"{name}="):
            continue
        words = arguments[k : min(k + 2, end)] if argument == name else argument.split("=", 1)
        if len(words) < 2:
            raise ConfigError(f"{name}: found no value: see usvlearn live systemd --help")
        del arguments[k : k + (2 if argument == name else 1)]
        return words[1]
    return None


def _cache(user: str) -> Path | None:
    """Where `usvlearn live warm` of that user keeps compiled code; None if the user has no home."""
    base = os.environ.get("NUMBA_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME")
    try:
        return Path(os.path.abspath(base)) if base else Path(f"~{user}").expanduser() / ".cache"
    except RuntimeError:
        return None
