"""The command `usvlearn delay data=… data.path=…`: which delay of the commands predicts best, from one's own logs.

For each delay, equal on both sides, the surge dynamics are learned online by SIFt-RLS from the start of the logs, and
predict one step ahead. The delay is chosen on the first half of each boat's runs (of a single run, on its first half).
The second half is stated apart. All delays are compared on the same steps. The model has no memory of earlier commands:
an estimator that has it makes up for a wrong delay, and hides a delay of one step altogether.

The skill of a delay is the mean of 1 − |e|/MAE of persistence over boats and steps. The standard error of a difference
of two skills is that of the means of blocks of 25 steps, since neighbouring errors depend on each other.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from usvlearn.cli.without_hydra import run_command
from usvlearn.errors import ConfigError, LogFormatError
from usvlearn.logs.channels.channel import COMMANDS as SIDES
from usvlearn.logs.inspection.lag import BLOCK, DELAYS, EQUAL, LEAST_BLOCKS, SURE

if TYPE_CHECKING:
    from usvlearn.core.protocol import Estimator
    from usvlearn.core.samples import Fleet
    from usvlearn.logs.channels.channel import Recording

USAGE = "usage: usvlearn delay my_boat.yaml [KEY=VALUE …], or data=NAME data.path=LOGS; keys: usvlearn train --help=all"
MODEL = "+estimator@model=dynamic_rls"  # of configs/estimator

Errors = dict[tuple[str, str], np.ndarray]  # boat, run -> (steps,) of |e|, m/s; NaN where none is counted


class Half(NamedTuple):
    """The errors of all delays on one half of the logs."""

    skills: np.ndarray  # (delays,)
    blocks: np.ndarray  # (blocks, delays), mean skill in each

    def gain(self, delay: int, over: int) -> tuple[float, float]:
        """By how much one delay is better than another, and the standard error."""
        gains = self.blocks[:, delay] - self.blocks[:, over]
        return float(self.skills[delay] - self.skills[over]), float(gains.std(ddof=1) / np.sqrt(len(gains)))


def find_halves(recordings: Sequence[Recording], model: Estimator, align: Mapping[str, Any]) -> tuple[Half, Half]:
    """Learn a model from recordings at each of `DELAYS`; the first and the second half.

    Raises:
        LogFormatError: the commands never change, a half is too short, or the speed does not change in it.
    """
    if not any(np.ptp(one.channels[side].value) > 0 for one in recordings for side in SIDES):
        raise LogFormatError(
            "data.path: no command ever changes: give logs in which the thrusters are used, or check data.channels"
        )
    found: list[tuple[Errors, Errors]] = []
    for delay in DELAYS:
        with warnings.catch_warnings(action="ignore" if found else "default"):  # a short run is told once
            found.append(_errors(_aligned(recordings, delay, align), model))
    runs: dict[str, list[np.ndarray]] = {}  # by boat, (delays and persistence, steps)
    for key in found[0][0]:
        if all(key in errors for errors, _ in found):
            rows = np.stack([*(errors[key] for errors, _ in found), found[0][1][key]])
            runs.setdefault(key[0], []).append(rows[:, np.isfinite(rows).all(0)])
    parts = [_split(rows) for rows in runs.values()]
    return _half("first", [part[0] for part in parts]), _half("second", [part[1] for part in parts])


def _aligned(recordings: Sequence[Recording], delay: float, align: Mapping[str, Any]) -> Fleet:
    from usvlearn.logs.recordings import align_fleet, delayed

    return align_fleet(delayed(recordings, delay), **align)


def _errors(fleet: Fleet, model: Estimator) -> tuple[Errors, Errors]:
    """The errors of the model, which learns from run to run, and those of persistence."""
    import torch

    from usvlearn.core.samples import masks
    from usvlearn.engine.rollouts import rollout, tensors

    own: Errors = {}
    persistence: Errors = {}
    state = model.init((len(fleet.boats),))
    for run in fleet.runs:
        with torch.no_grad():
            state, predicted, _ = rollout(model, state, tensors(run.samples, torch.float64))
        made = masks(run.samples, model.surge_limit)
        learns, known = np.asarray(made.learns), np.asarray(made.learns | made.starts)
        for element, boat in enumerate(fleet.boats):
            if run.names[element]:
                surge = np.where(known, run.samples.surge, np.nan)[:, element]
                counted, key = np.where(learns[:, element], surge, np.nan), (boat, run.names[element])
                own[key] = np.abs(predicted[:, element].numpy() - counted)
                persistence[key] = np.abs(_before(surge) - counted)
    return own, persistence


def _before(surge: np.ndarray) -> np.ndarray:
    """The last known speed before each step.

    >>> _before(np.array([1.0, np.nan, 2.0]))
    array([nan,  1.,  1.])
    """
    last = np.maximum.accumulate(np.where(np.isfinite(surge), np.arange(len(surge)), 0))
    return np.append(np.nan, surge[last][:-1])


def _split(runs: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """The first and the second half of a boat's runs, or of its only one, in time."""
    if len(runs) == 1:
        middle = runs[0].shape[1] // 2
        return runs[0][:, :middle], runs[0][:, middle:]
    return np.concatenate(runs[: len(runs) // 2], 1), np.concatenate(runs[len(runs) // 2 :], 1)


def _half(name: str, boats: Sequence[np.ndarray]) -> Half:
    skills, blocks = [], []
    for rows in boats:
        count = rows.shape[1] // BLOCK
        if count < LEAST_BLOCKS:
            raise LogFormatError(
                f"data.path: found {rows.shape[1]} steps to compare in the {name} half of a boat's runs, expected "
                f"{BLOCK * LEAST_BLOCKS}: give longer logs, or a smaller align.dt"
            )
        if not (scale := rows[-1].mean()) > 0:
            raise LogFormatError(f"data.path: the speed never changes in the {name} half: give logs of a moving boat")
        each = 1 - rows[:-1] / scale
        skills.append(each.mean(1))
        blocks.append(each[:, : count * BLOCK].reshape(len(each), count, BLOCK).mean(2).T)
    return Half(np.mean(skills, 0), np.concatenate(blocks))


def choose(first: Half) -> tuple[int, list[int], str]:
    """The best delay if it is surely better than none, else none.

    Returns:
        The place of the delay in `DELAYS`, the places of those that are as good as the best, and how sure it is.

    >>> rng = np.random.default_rng(0)
    >>> blocks = 0.2 - np.abs(np.array(DELAYS) - 0.2) + 0.02 * rng.normal(size=(30, len(DELAYS)))
    >>> choose(Half(blocks.mean(0), blocks))
    (4, [4], 'better than 0 s by 0.206 ± 0.004: sure')
    """
    best = int(first.skills.argmax())
    (gain, error), behind = first.gain(best, 0), [first.gain(best, k) for k in range(len(DELAYS))]
    equal = [k for k, (less, spread) in enumerate(behind) if less <= EQUAL * spread]
    if best == 0:
        return 0, equal, "the best one"
    if gain > SURE * error:
        return best, equal, f"better than 0 s by {gain:.3f} ± {error:.3f}: sure"
    told = f"{DELAYS[best]:g} s is better by {gain:.3f} ± {error:.3f}, which is too little to be sure"
    return 0, equal, f"since no delay is surely better: {told}"


def work(arguments: Sequence[str]) -> None:
    """Compose, read, compare, and print.

    Raises:
        ConfigError: an argument is no legal override, or the data have no channels to configure.
        LogFormatError: the logs cannot be read, or are too short.
    """
    from usvlearn.display import terminal
    from usvlearn.display.activity_bar import Activity

    with Activity(console := terminal.console(), "loading"):
        from usvlearn.cli.command import parse
        from usvlearn.cli.composition import compose_train
        from usvlearn.cli.forgiving import with_keys
        from usvlearn.cli.settings import as_written, instantiate
        from usvlearn.sweeps.launchers import set_threads

    arguments = with_keys("delay", arguments, parse(arguments).overrides)
    flags = vars(parse(arguments))
    overrides, added = flags.pop("overrides"), flags.pop("config_dir")
    if wrong := [f"--{name.replace('_', '-')}" for name, value in flags.items() if value]:
        raise ConfigError(f"{wrong[0]}: found a flag of usvlearn train, expected --config-dir or none: {USAGE}")
    search = [f"hydra.searchpath=[file://{Path(added).resolve()}]"] if added else []
    with Activity(console, "reading the configuration"):
        cfg = compose_train([*search, *overrides, MODEL])
    if not (channels := cfg.data.get("channels")):
        raise ConfigError("data: found no channels, expected logs with commands: set data=csv, alog, rosbag or ulog")
    with Activity(console, "reading, and learning with each delay"):
        set_threads(cfg.threads)  # imports torch
        with as_written(cfg):
            halves = find_halves(list(instantiate(cfg.data)), instantiate(cfg.model), cfg.align)
    place, equal, how = choose(halves[0])
    title = "Skill of the surge dynamics one step ahead, by the delay of the commands"
    table = terminal.Blocks(title, ["delay, s"], ["first half", "second half"])
    for k, skills in enumerate(zip(*(half.skills for half in halves), strict=True)):
        table.add(f"{DELAYS[k]:.2f}", *(f"{skill:.3f}" for skill in skills), style="bold" if k == place else "")
    console.print(table)
    terminal.show(*_conclusion(place, equal, how, halves[1], channels))


def _conclusion(place: int, equal: list[int], how: str, second: Half, channels: Mapping[str, Mapping]) -> Iterator[str]:
    """What the table means, and what to do."""
    yield f"Chosen on the first half: {DELAYS[place]:g} s, {how} (skill ± standard error)."
    if len(equal) > 1:
        yield f"As good there, within {EQUAL:g} standard errors: {', '.join(f'{DELAYS[k]:g}' for k in equal)} s."
    if place:
        gain, error = second.gain(place, 0)
        yield f"On the second half {DELAYS[place]:g} s is better than 0 s by {gain:.3f} ± {error:.3f}."
    present = sorted({float(channels[side].get("delay", 0.0)) for side in SIDES})
    if len(present) == 1 and any(math.isclose(DELAYS[k], present[0]) for k in {place, *equal}):
        yield f"Configured: {present[0]:g} s, which can stay."
        return
    keys = [f"{'' if 'delay' in channels[side] else '+'}data.channels.{side}.delay={DELAYS[place]:g}" for side in SIDES]
    yield f"Configured: {' and '.join(f'{each:g}' for each in present)} s. To change it: {' '.join(keys)}"
    yield f"or write delay: {DELAYS[place]:g} under command_left and command_right in the file of configs/data."


def main() -> int:
    """The command; returns the exit code."""
    return run_command(work, USAGE, ("-h", "--help"))
