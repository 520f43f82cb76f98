"""What `usvlearn live status` says of a node's folder."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any

from usvlearn.core import checkpoint
from usvlearn.core.lock import Lock
from usvlearn.errors import CheckpointError, ConfigError, printable
from usvlearn.live.health import quantity, seconds
from usvlearn.live.missions import FIT, RESULT, read_refit
from usvlearn.live.node_folder import status_of


def status_lines(folder: Path) -> list[str]:
    """What a running or dead node last knew, as lines.

    Raises:
        ConfigError: there is no such folder.
        CheckpointError: its status is damaged.
    """
    if not folder.is_dir():
        raise ConfigError(f"status: found no folder {folder}, expected the one of a node: correct the path")
    found, saved = status_of(folder), checkpoint.checkpoints(folder)
    if not found and not saved:
        return [f"{folder}: no node has written here"]
    lines = [f"Node        {_state(folder, found)}"]
    titles = {"boat": "Boat", "middleware": "Middleware", "sentence": "State", "loss": "Alarm", "began_from": "Start"}
    for key, title in titles.items():
        if isinstance(found.get(key), str) and found[key]:
            lines.append(f"{title:<11} {printable(found[key])}")
    last: Any = found.get("last")
    if isinstance(last, dict) and _number(last.get("speed")):
        lines.append(f"Predicted   {last['speed']:.2f} m/s at its last step")
    lines += _networks(found) + _identified("Identified", found.get("identified"))
    if (folder / FIT / RESULT).exists():
        refit = read_refit(folder)
        lines += [f"Values      {refit.sentence}", *_identified("Fit", {k: [*x] for k, x in refit.quantities.items()})]
    for title, key in (("Note", "notes"), ("Warning", "warnings")):
        said = found.get(key)
        sentences = [each for each in said if isinstance(each, str)] if isinstance(said, list) else []
        lines += [f"{title:<11} {printable(each)}" for each in sentences]
    return [*lines, f"Checkpoints {_told(saved)}"]


def _state(folder: Path, found: dict[str, Any]) -> str:
    written = found.get("written")
    age = time.time() - written if written is not None and _number(written) else math.inf
    said = f"its status is {seconds(max(age, 0.0))} old" if math.isfinite(age) else "it has written no status"
    if _runs(folder):
        return f"running, {found.get('state', 'state unknown')}; {said}"
    ended = "ended" if found.get("state") == "ended" else "not running, it did not end in order"
    return f"{ended}; {said}"


def _number(value: Any) -> bool:
    """Whether it is a number that can be shown."""
    return isinstance(value, int | float) and abs(value) < 1e15


def _runs(folder: Path) -> bool:
    """Whether a process holds the folder."""
    if not (folder / ".lock").is_file():
        return False
    try:
        Lock(folder, "folder").release()
    except ConfigError:
        return True
    return False


def _networks(found: dict[str, Any]) -> list[str]:
    lines, networks = [], found.get("contraction")
    for name, each in networks.items() if isinstance(networks, dict) else ():
        if isinstance(each, dict):
            verdict = f"contracting by {each.get('condition')}" if each.get("contracting") else "not certified"
            rest = each.get("equilibrium")
            more = f", at rest {rest:.2f} m/s" if _number(rest) else ""
            lines.append(f"Network     {printable(str(name))}: {printable(verdict)}{more}")
    return lines


def _identified(title: str, quantities: Any) -> list[str]:
    lines = []
    for name, each in quantities.items() if isinstance(quantities, dict) else ():
        if isinstance(each, list) and len(each) == 4 and all(x is None or _number(x) for x in each[:3]):
            value, low, high = (math.nan if x is None else x for x in each[:3])
            lines.append(f"{title:<11} {printable(str(name))} {quantity(value, low, high, printable(str(each[3])))}")
    return lines


def _told(saved: list[Path]) -> str:
    if not saved:
        return "none"
    for path in reversed(saved):
        try:
            _, facts = checkpoint.load(path)
        except CheckpointError:
            continue
        age = seconds(max(time.time() - path.stat().st_mtime, 0.0))
        damaged = len(saved) - 1 - saved.index(path)
        more = f"; {damaged} newer cannot be read" if damaged else ""
        return f"{len(saved)}, the newest readable is {path.name}, {age} old, after step {facts.get('step')}{more}"
    return f"{len(saved)}, none of which can be read"
