"""Shows what a node does: published values, the operator's page, the line in a terminal, `usvlearn live status`."""

from __future__ import annotations

import math
import re
import shutil
import sys
import textwrap
import time
from pathlib import Path
from typing import Any, NamedTuple, TextIO

from usvlearn.core import checkpoint
from usvlearn.core.events import BOTH
from usvlearn.core.lock import Lock
from usvlearn.errors import CheckpointError, ConfigError, printable
from usvlearn.live.health import Health, quantity, seconds
from usvlearn.live.missions import FIT, RESULT, read_refit
from usvlearn.live.node import Step
from usvlearn.live.node_folder import status_of

NUMBER, TEXT = "D", "S"


class Post(NamedTuple):
    """One published value."""

    name: str
    value: float | str


class Published(NamedTuple):
    """A line of the table."""

    name: str
    kind: str  # NUMBER or TEXT
    unit: str
    when: str
    meaning: str
    short: str = ""  # name of at most 10 characters, for MAVLink; "": not sent there


STEP, SECOND, SELDOM, RAISED, ASKED = "each step", "each second", "every 5 s", "when raised", "on a plan"
PLANNED, TRACK = "PLAN_FORECAST", "TRACK"  # the answer to a plan; where the boat will be
TABLE = (
    Published("SPEED_PRED", NUMBER, "m/s", STEP, "predicted speed of the sample that was just measured", "USV_PRED"),
    Published("SPEED_LOW", NUMBER, "m/s", STEP, "lower end of its 90 % interval", "USV_LOW"),
    Published("SPEED_HIGH", NUMBER, "m/s", STEP, "upper end of its 90 % interval", "USV_HIGH"),
    Published("SPEED_ERROR", NUMBER, "m/s", STEP, "measured minus predicted speed", "USV_ERR"),
    Published("SPEED_NEXT", NUMBER, "m/s", STEP, "predicted speed of the next step under the commands in force",
              "USV_NEXT"),
    Published("SPEED_NEXT_LOW", NUMBER, "m/s", STEP, "lower end of its 90 % interval", "USV_NLOW"),
    Published("SPEED_NEXT_HIGH", NUMBER, "m/s", STEP, "upper end of its 90 % interval", "USV_NHIGH"),
    Published("FORECAST", TEXT, "s: m/s", STEP,
              "speeds under the commands in force, intervals whatever is commanded: 10=1.23:1.10:1.36,…"),
    Published("FORECAST_IF_HELD", TEXT, "s: m/s", STEP, "the same, intervals where the commands stay"),
    Published(TRACK, TEXT, "s: m, deg", STEP,
              "places under the commands in force, ellipses whatever is commanded: north, east, heading and ellipse, "
              "10=9.80:1.20:8.5:1.10:0.60:95.0,…"),
    Published("TRACK_IF_HELD", TEXT, "s: m, deg", STEP, "the same, ellipses where the commands stay"),
    Published(PLANNED, TEXT, "s: m/s", ASKED,
              "speeds, or places as above, under a plan that was posted, or why there are none"),
    Published("MEMBERS", TEXT, "m/s", STEP, "prediction of each member and combiner, where members are asked for"),
    Published("ALARM", TEXT, "", RAISED, "a thruster, or the boat, has lost thrust, and how much of it is left"),
    Published("EVENT", TEXT, "", RAISED, "the same, what the filters got, a recovery, or another change of the boat"),
    Published("PARAMS", TEXT, "", SELDOM, "identified quantities, as drag_linear=-20.7,thrust_full_left=18.2,…"),
    Published("REFIT", TEXT, "", SELDOM,
              "batch fit of the missions, and which values to use: use=fit,missions=2,time_constant=1.63:1.46:1.83,…"),
    Published("CONTRACTING", TEXT, "", SELDOM, "verdict on each network, by which condition"),
    Published("CONTRACTION_RATE", NUMBER, "a step", SELDOM, "rate K of the first network; below 1: contracting",
              "USV_K"),
    Published("EQUILIBRIUM", NUMBER, "m/s", SELDOM, "speed at which the first network stays, without thrust", "USV_EQ"),
    Published("HEALTH", TEXT, "", SECOND, "state, what is missing, counts, time since the last save"),
)  # fmt: skip


def of_step(step: Step, members: bool = False) -> list[Post]:
    """What is published of one step, with all members or not; numbers that are not known are left out."""
    numbers = {
        "SPEED_PRED": step.speed, "SPEED_LOW": step.low, "SPEED_HIGH": step.high,
        "SPEED_ERROR": step.measured - step.speed, "SPEED_NEXT": step.next, "SPEED_NEXT_LOW": step.next_low,
        "SPEED_NEXT_HIGH": step.next_high,
    }  # fmt: skip
    posts = [Post(name, value) for name, value in numbers.items() if math.isfinite(value)]
    for name, forecasts in (("FORECAST", step.forecasts), ("FORECAST_IF_HELD", step.if_held)):
        if forecasts:
            posts.append(Post(name, ",".join(f"{horizon:g}={_ends(each)}" for horizon, each in forecasts.items())))
    for name, every in ((TRACK, step.places), ("TRACK_IF_HELD", step.places_if_held)):
        places = {horizon: point for horizon, point in every.items() if all(map(math.isfinite, point[:3]))}
        if places:
            posts.append(Post(name, ",".join(f"{horizon:g}={point.text}" for horizon, point in places.items())))
    if members and step.members:
        posts.append(Post("MEMBERS", ",".join(f"{name}={value:.3f}" for name, value in step.members.items())))
    posts += [Post("ALARM", event.sentence) for event in step.events if event.is_alarm]
    return posts + [Post("EVENT", event.sentence) for event in step.events]


def of_last(step: Step) -> dict[str, Any]:
    """What a status file tells of the last step."""
    posts = {post.name: post.value for post in of_step(step) if post.name.startswith(("FORECAST", TRACK))}
    return {"time": step.time, "speed": step.speed, "next": step.next, "posts": posts}


def _ends(forecast: tuple[float, float, float]) -> str:
    """A speed with the ends of its interval, where these are known."""
    return ":".join(f"{x:.3f}" for x in (forecast if math.isfinite(forecast[1]) else forecast[:1]))


def of_health(health: Health) -> list[Post]:
    """What is published each second; the shell may send what changes seldom less often."""
    posts = [Post("HEALTH", summary_of(health))]
    known = {name: each[0] for name, each in health.identified.items() if math.isfinite(each[0])}
    if known:
        posts.append(Post("PARAMS", ",".join(f"{name}={value:.4g}" for name, value in known.items())))
    if health.refit is not None:
        use, fitted = "fit" if health.refit.use else "online", health.refit.quantities
        rows = [f"{name}={value:.4g}:{low:.4g}:{high:.4g}" for name, (value, low, high, _) in fitted.items()]
        posts.append(Post("REFIT", ",".join([f"use={use},missions={health.refit.missions}", *rows])))
    for name, network in list(health.contraction.items())[:1]:
        verdict = f"yes by {network['condition']}" if network["contracting"] else "not certified"
        posts.append(Post("CONTRACTING", f"{name}: {verdict}"))
        for post, value in (("CONTRACTION_RATE", network["rate"]), ("EQUILIBRIUM", network["equilibrium"])):
            if value is not None:
                posts.append(Post(post, float(value)))
    return posts


def summary_of(health: Health) -> str:
    """The health in one line."""
    saved = f"{health.saved:.0f}" if math.isfinite(health.saved) else "never"
    missing = [part for part, age in health.ages.items() if not math.isfinite(age)]
    facts = {
        "state": health.state, "steps": health.steps, "learned": health.learned, "alarms": health.alarms,
        "alarm": health.alarm or "none", "saved": saved, "rejected": health.rejected, "warnings": len(health.warnings),
    }  # fmt: skip
    line = ",".join(f"{key}={value}" for key, value in facts.items())
    return line + (f",missing={'+'.join(missing)}" if missing and health.state != "compiling" else "")


WIDTH = 78
QUANTITIES = ("steady_speed_full", "time_constant", "stopping_distance", "thrust_ratio")  # those that are shown
FAR = 10.0  # s: the place that is shown is that of the first horizon from there on
COUNTED = 6  # channels with rejected messages


def page(health: Health, step: Step | None = None) -> list[str]:
    """The page, lines of at most `WIDTH` characters."""
    lines = _wrapped("State", health.sentence if health.state == "ok" else f"{health.state}: {health.sentence}")
    saved = f"{seconds(health.saved)} ago" if math.isfinite(health.saved) else "not yet"
    lines.append(_line("Running", f"{seconds(health.uptime)}, last saved {saved}"))
    if step is not None:
        lines += _speeds(step)
    lines += _wrapped("Alarm", f"{health.loss or 'none'} ({health.alarms} so far)")
    for name, network in health.contraction.items():
        lines += _wrapped(f"Network {name}"[:11], _network(network))
    if health.refit is not None:
        lines += _wrapped("Values", health.refit.sentence)
    shown = [(name, health.known[name]) for name in QUANTITIES if name in health.known]
    for name, each in shown:
        lines.append(_line(name[:20].replace("_", " "), quantity(*each), 21))
    lines += [part for each in health.notes for part in _wrapped("Note", each)]
    heard = [
        f"{part} {seconds(age)} ago" if math.isfinite(age) else f"{part} never" for part, age in health.ages.items()
    ]
    lines += _wrapped("Received", ", ".join(heard) or "nothing yet")
    counts = [f"{name} {cause} {n}" for name, causes in health.counts.items() for cause, n in causes.items()]
    lines += _wrapped("Not used", ", ".join(counts[:COUNTED]) or "none")
    lines += [part for each in health.warnings for part in _wrapped("Warning", each)]
    return [line.encode("ascii", "replace").decode() for line in lines]


def _speeds(step: Step) -> list[str]:
    measured = f"{step.measured:.2f}" if math.isfinite(step.measured) else "unknown"
    lines = [_line("Speed", f"measured {measured}, predicted {_interval(step.speed, step.low, step.high)} m/s")]
    if math.isfinite(step.next):
        lines.append(_line("Next", f"{_interval(step.next, step.next_low, step.next_high)} m/s under these commands"))
    if step.forecasts:
        horizon, interval = list(step.forecasts.items())[-1]
        _, low, high = step.if_held[horizon]
        stays = f", ({low:.2f} ... {high:.2f}) if commands stay" if math.isfinite(low) else ""
        lines.append(_line(f"In {horizon:g} s", f"{_interval(*interval)} m/s{stays}"))
    if step.places:
        horizon, place = next((item for item in step.places.items() if item[0] >= FAR), [*step.places.items()][-1])
        size = f", within {place.major:.1f} x {place.minor:.1f} m" if math.isfinite(place.major) else ""
        where = f"{place.north:.1f} m north, {place.east:.1f} m east, heading {place.heading:.0f} deg"
        lines.append(_line(f"Track {horizon:g} s", where + size))
    return lines


def _interval(value: float, low: float, high: float) -> str:
    if not math.isfinite(value):
        return "unknown"
    return f"{value:.2f} ({low:.2f} ... {high:.2f})" if math.isfinite(low) else f"{value:.2f} (no interval yet)"


def _network(network: dict[str, Any]) -> str:
    if network["rate"] is None:
        return "its weights are not finite"
    verdict = f"contracting by {network['condition']}" if network["contracting"] else "not certified contracting"
    constant = "" if network["time_constant"] is None else f" ({network['time_constant']:.3g} s)"
    rest = "" if network["equilibrium"] is None else f", equilibrium at rest {network['equilibrium']:.2f} m/s"
    return f"{verdict}, K = {network['rate']:.4f} a step{constant}{rest}"


def _line(title: str, text: str, width: int = 11) -> str:
    return f"{title:<{width}} {text}"[:WIDTH]


def _wrapped(title: str, text: str) -> list[str]:
    return textwrap.wrap(f"{title:<11} {text}", WIDTH, subsequent_indent=" " * 12) or [title]


DURATION = re.compile(r" for \d[\d.]* \w+")
NAMES = re.compile(r" \([^()]*\)")  # of channels, in the middleware


def alike(sentence: str) -> str:
    """A sentence without its numbers: a warning whose figures change is the same."""
    return re.sub(r"\d[\d.,:]*", "#", sentence)


class StatusLine:
    """Writes sentences, and below them one line that is replaced each second."""

    def __init__(self, name: str, stream: TextIO | None = None):
        self._name, self._stream = name, sys.stdout if stream is None else stream
        self._terminal = self._stream.isatty()
        self._shown, self._told = 0, ""  # columns of the line; the last state
        self._warned: set[str] = set()

    def say(self, sentence: str) -> None:
        """Write a sentence that stays."""
        self._write(f"{self._erased()}{self._name}: {printable(sentence)}\n")
        self._shown = 0

    def show(self, health: Health, step: Step | None = None, link: str = "", warn: bool = True) -> None:
        """Replace the line, or without a terminal write a changed state; say warnings and notes once."""
        for kind, sentences in (("warning", health.warnings if warn else ()), ("note", health.notes)):
            for sentence in sentences:
                if alike(sentence) not in self._warned:
                    self.say(f"{kind}: {sentence}")
        self._warned = {alike(each) for each in (*health.warnings, *health.notes)}
        if self._terminal:
            columns = shutil.get_terminal_size().columns - 1
            text = printable(line(health, step, link))[:columns]
            self._write(f"{self._erased()}{text}")
            self._shown = len(text)
            return
        missing = DURATION.sub("", health.sentence.partition(";")[0])  # durations change
        sentence = f"{missing}{'; ' if link else ''}{link}"
        if sentence != self._told:
            self._told = sentence
            self.say(sentence)

    def close(self) -> None:
        """End the line."""
        if self._shown:
            self._write("\n")
            self._shown = 0

    def _erased(self) -> str:
        return f"\r{' ' * self._shown}\r" if self._shown else ""

    def _write(self, text: str) -> None:
        try:
            self._stream.write(text)
            self._stream.flush()
        except (OSError, ValueError):  # nobody reads it any more; the node goes on
            pass


def line(health: Health, step: Step | None = None, link: str = "") -> str:
    """The line."""
    state = NAMES.sub("", health.sentence.partition(";")[0]) if health.state != "ok" else f"ok, {health.steps} steps"
    parts = [link, state] if link else [state]
    if step is not None and health.state == "ok":
        parts.append(_brief(step))
    if health.alarm:
        parts.append(f"ALARM {health.alarm} thruster{'s' * (health.alarm == BOTH)}")
    if health.rejected:
        parts.append(f"{health.rejected} not used")
    if health.warnings:
        parts.append(f"{len(health.warnings)} warning{'s' * (len(health.warnings) > 1)}")
    parts.append(f"saved {seconds(health.saved)} ago" if math.isfinite(health.saved) else "not saved yet")
    return " | ".join(parts)


def _brief(step: Step) -> str:
    measured = f"{step.measured:.2f}" if math.isfinite(step.measured) else "unknown"
    width = f" +- {step.high - step.speed:.2f}" if math.isfinite(step.high) else ""
    predicted = f"{step.speed:.2f}{width}" if math.isfinite(step.speed) else "none"
    after = f", next {step.next:.2f}" if math.isfinite(step.next) else ""
    return f"speed {measured}, predicted {predicted}{after} m/s"


def status_lines(folder: Path) -> list[str]:
    """What a running or dead node last knew, as lines."""
    if not folder.is_dir():
        raise ConfigError(f"status: found no folder {folder}, expected the one of a node: correct the path")
    status, saved = status_of(folder), checkpoint.checkpoints(folder)
    if not status and not saved:
        return [f"{folder}: no node has written here"]
    lines = [f"Node        {_state(folder, status)}"]
    titles = {"boat": "Boat", "middleware": "Middleware", "sentence": "State", "loss": "Alarm", "began_from": "Start"}
    for key, title in titles.items():
        if isinstance(status.get(key), str) and status[key]:
            lines.append(f"{title:<11} {printable(status[key])}")
    last: Any = status.get("last")
    if isinstance(last, dict) and _number(last.get("speed")):
        lines.append(f"Predicted   {last['speed']:.2f} m/s at its last step")
        posts: Any = last.get("posts")
        for name, text in posts.items() if isinstance(posts, dict) else ():
            lines.append(printable(f"{name.replace('_', ' ').capitalize():<11} {text}"))
    lines += _networks(status) + _identified("Identified", status.get("identified"))
    if (folder / FIT / RESULT).exists():
        refit = read_refit(folder)
        lines += [f"Values      {refit.sentence}", *_identified("Fit", {k: [*x] for k, x in refit.quantities.items()})]
    for title, key in (("Note", "notes"), ("Warning", "warnings")):
        said = status.get(key)
        sentences = [each for each in said if isinstance(each, str)] if isinstance(said, list) else []
        lines += [f"{title:<11} {printable(each)}" for each in sentences]
    return [*lines, f"Checkpoints {_checkpoints(saved)}"]


def _state(folder: Path, status: dict[str, Any]) -> str:
    written = status.get("written")
    age = time.time() - written if written is not None and _number(written) else math.inf
    said = f"its status is {seconds(max(age, 0.0))} old" if math.isfinite(age) else "it has written no status"
    if _runs(folder):
        return f"running, {status.get('state', 'state unknown')}; {said}"
    ended = "ended" if status.get("state") == "ended" else "not running, it did not end in order"
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


def _networks(status: dict[str, Any]) -> list[str]:
    lines, networks = [], status.get("contraction")
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


def _checkpoints(saved: list[Path]) -> str:
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
