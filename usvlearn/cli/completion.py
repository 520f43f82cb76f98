"""The command `usvlearn completion SHELL`: prints the script by which a shell completes commands, options and keys.

What can be completed is written into the script, so that a shell needs no Python to complete.
"""

from __future__ import annotations

import argparse
import importlib
import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

from usvlearn.cli.beginning import COMMANDS
from usvlearn.cli.without_hydra import run_command
from usvlearn.errors import ConfigError, did_you_mean

USAGE = """usage: usvlearn completion bash|zsh|fish
bash   usvlearn completion bash >> ~/.bash_completion
zsh    usvlearn completion zsh > ~/.zsh/_usvlearn, a folder of $fpath
fish   usvlearn completion fish > ~/.config/fish/completions/usvlearn.fish"""
FLAGS = ("--help", "--help=all", "--hydra-help", "--multirun", "-m", "--cfg", "--config-dir", "--config-name")
LIVE = ("moos", "mavlink", "ros2", "status", "warm", "systemd")


class Words(NamedTuple):
    """What completes the arguments of a command, beside the names of files."""

    options: tuple[str, ...] = ()
    keys: tuple[str, ...] = ()  # of a configuration, each completed by =
    values: Mapping[str, Sequence[str]] = {}  # of a key, beside the names of files


def words() -> dict[str, Words]:
    """What completes each command's arguments.

    >>> words()["plan"].options[:2], "estimators.rnn.neurons" in words()["train"].keys
    (('--area', '--boat'), True)
    """
    found = {name: Words() for name in COMMANDS}
    for name, (module, _) in COMMANDS.items():
        if parser := getattr(importlib.import_module(module), "parser", None):
            found[name] = Words(tuple(_options(parser())))
    train, evaluate = _configured("train"), _configured("evaluate")
    return found | {
        "train": train,
        "delay": train._replace(options=("--help", "--config-dir")),
        "evaluate": evaluate,
        "live": Words(LIVE),
        "warm": Words(("float32", "readers")),
        "completion": Words(tuple(SCRIPTS)),
    }


def _options(parser: argparse.ArgumentParser) -> Iterator[str]:
    yield from sorted(each for action in parser._actions for each in action.option_strings if each.startswith("--"))


def _configured(name: str) -> Words:
    """The flags, keys, groups and their options of a command of Hydra."""
    from hydra import compose, initialize_config_dir
    from omegaconf import OmegaConf

    from usvlearn.cli.configs import configs_folder
    from usvlearn.cli.mistakes import dotted

    configs = configs_folder()
    with initialize_config_dir(str(configs), version_base="1.3"):
        cfg = compose(name, return_hydra_config=True)
    groups = [each for each in cfg.hydra.runtime.choices if not each.startswith("hydra/")]
    values = {each: sorted(path.stem for path in (configs / each.split("@")[0]).glob("*.yaml")) for each in groups}
    tree = OmegaConf.to_container(cfg)
    assert isinstance(tree, dict)
    tree.pop("hydra")
    keys = list(dotted({str(key): value for key, value in tree.items()}))
    branches = {key.rpartition(".")[0] for key in keys}
    leaves = [key for key in keys if key not in branches and not key.rpartition(".")[2].startswith("_")]
    folders = ["hydra.run.dir", "hydra.sweep.dir"] if name == "train" else []
    extra = ["seeds"] if name == "train" else []
    return Words(FLAGS, tuple(dict.fromkeys([*groups, *leaves, *folders, *extra])), values)


def _bash(found: Mapping[str, Words]) -> Iterator[str]:
    yield """_usvlearn() {
    local command="${COMP_WORDS[1]}" line="${COMP_LINE:0:COMP_POINT}" options="" keys="" values="" word key
    word="${line##*[[:space:]]}"
    COMPREPLY=()
    if [ "$COMP_CWORD" -eq 1 ]; then"""
    yield f'        COMPREPLY=($(compgen -W {shlex.quote(" ".join([*found, "--help", "--version"]))} -- "$word"))'
    yield """        return
    fi
    case "$command" in"""
    for name, each in found.items():
        yield f"    {name})"
        yield f"        options={shlex.quote(' '.join(each.options))}"
        if each.keys:
            yield f"        keys={shlex.quote(' '.join(f'{key}=' for key in each.keys))}"
            yield '        case "$word" in'
            for key, values in each.values.items():
                yield f"        {shlex.quote(key)}=*) values={shlex.quote(' '.join(values))} ;;"
            yield "        esac"
        yield "        ;;"
    yield """    esac
    if [[ "$word" == *=* && "$word" != -* ]]; then
        key="${word%%=*}="
        word="${word#*=}"
        COMPREPLY=($(compgen -W "$values" -- "$word") $(compgen -f -- "$word"))
        [[ "$COMP_WORDBREAKS" == *=* ]] || COMPREPLY=("${COMPREPLY[@]/#/$key}")
        compopt -o filenames
    else
        COMPREPLY=($(compgen -W "$options $keys" -- "$word"))
        [[ ${#COMPREPLY[@]} -gt 0 && "${COMPREPLY[0]}" == *= ]] && compopt -o nospace
    fi
}
complete -o default -F _usvlearn usvlearn"""


def _zsh(found: Mapping[str, Words]) -> Iterator[str]:
    yield "#compdef usvlearn"
    yield "_usvlearn() {"
    yield "    local -a options keys values"
    yield "    if (( CURRENT == 2 )); then"
    yield f"        compadd -- {shlex.join([*found, '--help', '--version'])}"
    yield "        return"
    yield "    fi"
    yield '    case "$words[2]" in'
    for name, each in found.items():
        yield f"    {name})"
        yield f"        options=({shlex.join(each.options)})"
        if each.keys:
            yield f"        keys=({shlex.join(each.keys)})"
            yield '        case "$PREFIX" in'
            for key, values in each.values.items():
                yield f"        {shlex.quote(key)}=*) values=({shlex.join(values)}) ;;"
            yield "        esac"
        yield "        ;;"
    yield """    esac
    if [[ "$PREFIX" == [^-]*=* ]]; then
        compset -P '*='
        compadd -- $values
        _files
    else
        [[ "$PREFIX" == -* ]] || { compadd -S '=' -- $keys; _files }
        compadd -- $options
    fi
}
if [ "$funcstack[1]" = _usvlearn ]; then _usvlearn "$@"; else compdef _usvlearn usvlearn; fi"""


def _fish(found: Mapping[str, Words]) -> Iterator[str]:
    yield "complete -c usvlearn -n __fish_use_subcommand -f"
    for name, each in found.items():
        about = shlex.quote(COMMANDS[name][1])
        yield f"complete -c usvlearn -n __fish_use_subcommand -a {name} -d {about}"
        when = f"complete -c usvlearn -n '__fish_seen_subcommand_from {name}'"
        for option in each.options:
            if option.startswith("--") and "=" not in option:
                yield f"{when} -l {option[2:]}"
            else:
                yield f"{when} -a {shlex.quote(option)}"
        given = [f"{key}={value}" for key, values in each.values.items() for value in values]
        for word in [*(f"{key}=" for key in each.keys), *given]:
            yield f"{when} -a {shlex.quote(word)}"


SCRIPTS: dict[str, Callable[[Mapping[str, Words]], Iterator[str]]] = {"bash": _bash, "zsh": _zsh, "fish": _fish}


def work(arguments: Sequence[str]) -> None:
    """Print the script.

    Raises:
        ConfigError: the shell is none of the three.
    """
    shell, *more = arguments
    if shell not in SCRIPTS or more:
        found = " ".join(arguments)
        raise ConfigError(
            f"completion: found {found!r}, expected one of {', '.join(SCRIPTS)}{did_you_mean(shell, SCRIPTS)}"
        )
    print(*SCRIPTS[shell](words()), sep="\n")


def main() -> int:
    """The command; returns the exit code."""
    return run_command(work, USAGE, ("-h", "--help"))
