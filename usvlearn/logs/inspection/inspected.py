"""From logs to a configuration that reads them: everything that `usvlearn inspect` does, without printing."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from usvlearn.core.samples import Fleet, speed_limit
from usvlearn.core.unconfirmed import SECTION, WRITTEN, confirmation
from usvlearn.errors import LogFormatError
from usvlearn.logs.channels.channel import COMMANDS, Recording
from usvlearn.logs.checks.data_check import check_data
from usvlearn.logs.checks.finding import Finding
from usvlearn.logs.inspection.candidate import Candidate, candidates
from usvlearn.logs.inspection.config_writer import MASS, read_settings, settings_of, shell_override, write_text
from usvlearn.logs.inspection.decision import PROBABLE, UNSURE, Decision, least
from usvlearn.logs.inspection.lag import DELAYS, LONG_DELAYS, Lag, find_lag
from usvlearn.logs.inspection.logfiles import Logs, boats_of, joined, open_logs
from usvlearn.logs.inspection.proposal import Proposal, propose
from usvlearn.logs.inspection.questions import questions
from usvlearn.logs.inspection.vehicles import check_boat, told_apart
from usvlearn.logs.recordings import align_fleet, delayed

USUAL, MARGIN = 3.0, 1.1  # m/s, the top speed where no speed is known; of the greatest one that is logged
SPEED_CHANNELS = ("surge", "velocity_north", "ground_speed")
MEANING = "certain: proved by numbers; probable: by name or convention; unsure: please check."


class Inspected(NamedTuple):
    """What `usvlearn inspect` found."""

    logs: Logs
    series: list[Candidate]
    proposal: Proposal
    decisions: list[Decision]  # all
    settings: dict[str, Any]  # {} if a required channel is missing
    text: str  # of the file; "" likewise
    recordings: list[Recording]  # that the settings read
    lag: Lag | None
    notes: list[str]  # what the readers warned of
    findings: list[Finding]  # of the data check, about what the settings read


def inspect_logs(
    given: Sequence[str], name: str | None = None, output: str = "my_boat.yaml", any_vehicle: bool = False
) -> Inspected:
    """Look at logs, folders or patterns, decide, and read them as decided.

    `output` is the name of the file that will hold the text. Without `any_vehicle`, logs that say that they are of no
    boat are a LogFormatError, as those are that cannot be read; no log at all is a ConfigError.
    """
    logs = open_logs(given, name)
    series = candidates(joined(logs.surveyed))
    proposal = propose(series, logs.format.name)
    decisions = [] if any_vehicle else check_boat(logs.files, series, logs.format.name)
    notes = list(logs.notes)
    for doubt in logs.doubts:
        option, _, reason = doubt.partition(": ")
        decisions.append(Decision("reader", option, str(getattr(logs.reader, option, "")), UNSURE, reason))
    if boats := told_apart(logs.surveyed) or boats_of(logs.files):
        paths = ", ".join(f"{boat}: {pattern!r}" for boat, pattern in boats.items())
        why = f"the logs tell {' and '.join(boats)}, but all are taken as one boat; of several boats, inspect those "
        why += f"of each, or set data.path={{{paths}}} and data.boat=null"
        decisions.append(Decision("boat", "path", name or logs.name, UNSURE, why))
    decisions += proposal.decisions
    if proposal.missing:
        clocks = next((each for each in notes if "time zones differ" in each), "")
        proposal = proposal._replace(unfit=proposal.unfit or clocks)
        return Inspected(logs, series, proposal, decisions, {}, "", [], None, notes, [])
    settings = settings_of(logs.path, name or logs.name, logs.reader, proposal.channels, USUAL)
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        recordings = read_settings(settings)
    sentences = [str(each.message).replace(f"{Path.cwd()}/", "") for each in warned]  # with paths as from here
    notes += [each for each in sentences if each not in notes]
    lag = None
    if recordings:
        top = _report_top_speed(settings, recordings, decisions)
        lag = find_lag(recordings, speed_limit(top))
        _report_delay(settings, lag, decisions)
        recordings = delayed(recordings, lag.delay)
    why = "not in the logs; forces scale with it"
    decisions.append(Decision("vehicle", "mass", f"{MASS:g} kg", UNSURE, why))
    settings[SECTION] = questions(decisions, settings)
    count = len(logs.files)
    origin = f"{count} log{'s' * (count > 1)} ({logs.format.name})"
    vehicle, channels = settings["vehicle"], settings["data"]["channels"]
    findings = check_data(recordings, _aligned(recordings, vehicle["surge_max"]), {}, vehicle["surge_max"], channels)
    head = [f"{settings['data']['boat']}: {WRITTEN} from {origin}."]
    head += [f"To use it: usvlearn train {shell_override(output)}", MEANING]
    ask = f"not proved: correct it above, or confirm it: {confirmation(output)}"
    text = write_text(settings, decisions, head, ask, [each.sentence() for each in findings])
    back = yaml.safe_load(text)
    if back != settings:
        raise AssertionError(f"the file does not read back as it was written: {back} != {settings}")
    return Inspected(logs, series, proposal, decisions, settings, text, recordings, lag, notes, findings)


def _aligned(recordings: Sequence[Recording], top: float) -> Fleet | None:
    """The recordings on the grid; None where they give too few steps, which the check tells."""
    try:
        with warnings.catch_warnings(action="ignore"):
            return align_fleet(recordings, surge_max=speed_limit(top))
    except LogFormatError:
        return None


def _report_top_speed(settings: dict[str, Any], recordings: Sequence[Recording], decisions: list[Decision]) -> float:
    speed = np.concatenate([np.abs(one.channels["surge"].value) for one in recordings])
    greatest = float(np.quantile(speed, 0.998)) if len(speed) else math.nan
    if not 0.05 < greatest < 100:
        sentence = "no plausible speed was found; please set it"
        decisions.append(Decision("vehicle", "surge_max", f"{USUAL:g} m/s", UNSURE, sentence))
        return USUAL
    top = math.ceil(MARGIN * greatest * 10) / 10
    settings["vehicle"]["surge_max"] = top
    units = [each for each in decisions if each.what == "unit" and each.channel in SPEED_CHANNELS]
    sure, sentence = least(PROBABLE, *(each.certainty for each in units)), f"the greatest speed is {greatest:.2f} m/s"
    sentence += f", if {units[0].value} is the unit of the speed" if sure == UNSURE else ""
    decisions.append(Decision("vehicle", "surge_max", f"{top:g} m/s", sure, sentence))
    return top


def _report_delay(settings: dict[str, Any], lag: Lag, decisions: list[Decision]) -> None:
    if not len(lag.errors):
        why = "too few steps to tell a delay: give longer logs"
        decisions.append(Decision(COMMANDS[0], "delay", "0 s", UNSURE, why))
        return
    for side in COMMANDS:
        settings["data"]["channels"][side]["delay"] = lag.delay
    between = [each for each in DELAYS if min(lag.equal) <= each <= max(lag.equal)]
    whole = len(lag.equal) > 2 and len(between) == len(lag.equal)
    shown = " … ".join(f"{lag.equal[k]:g}" for k in (0, -1)) if whole else ", ".join(f"{each:g}" for each in lag.equal)
    sentence = f"as good: {shown} s" if len(lag.equal) > 1 else "one regression for each delay"
    if lag.delay:
        sentence = f"surely better than none; {sentence}"
        if lag.delay > 1:
            sentence += (
                "; in steps of 0.25 s. Clocks that differ look the same: correct stamps then (see the data check)"
            )
        if lag.delay == LONG_DELAYS[-1]:
            sentence = f"{lag.delay:g} s or more: it is the longest that is tried"
    elif lag.best:
        sentence = f"{lag.best:g} s fits best, but not surely; {sentence}"
    sure = PROBABLE if lag.sure and lag.delay <= 1 else UNSURE
    others = (f"{lag.best:g}",) if lag.best != lag.delay else ()
    decisions += [Decision(side, "delay", f"{lag.delay:g} s", sure, sentence, others) for side in COMMANDS]
