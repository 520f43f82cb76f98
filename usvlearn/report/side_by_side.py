"""Runs side by side: what was identified of a boat in each, and the errors on the missions that they share."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from string import ascii_uppercase
from typing import Any, NamedTuple

from usvlearn.display.figures import INK, LINE, guarded, panels_of
from usvlearn.display.terminal import Cell, ResultTable
from usvlearn.errors import CheckpointError, ConfigError, did_you_mean
from usvlearn.estimators.axis.turning_quantities import OF_FIT
from usvlearn.estimators.axis.turning_quantities import QUANTITIES as TURNING
from usvlearn.estimators.joint.excitation_warnings import WIDE, Quantity
from usvlearn.estimators.joint.quantities import QUANTITIES
from usvlearn.evaluation.comparison import Difference, RunError, cells, compare, from_csv
from usvlearn.evaluation.objective import FORECAST, FREE, ONE_STEP, Measure
from usvlearn.report.sections.fit_file import SavedFit, saved_fits
from usvlearn.report.sections.section import WORSE, Drawn, Section
from usvlearn.runs.files import ERRORS
from usvlearn.runs.saved import results, run_folders

VERDICTS = CHANGED, SAME, VAGUE = "changed", "no change found", "not known well enough"
HORIZONS = (("next step", ONE_STEP, 0.0), ("10 s ahead", FORECAST, 10.0), ("open loop", FREE, 0.0))
CHANCE = "Intervals are 90 %: of 20 quantities that did not change, one or two are called changed."
DEPENDENT = "Both have learned from the same missions: their errors of quantities are not independent."
UNPAIRED = "they share no missions with equal samples, so their errors are not compared."


class KnownBoat(NamedTuple):
    """One boat of one run."""

    letter: str
    folder: Path
    boat: str
    basis: str  # of the quantities
    quantities: Mapping[str, Quantity]
    output: str  # the combiner that predicts
    errors: Sequence[RunError]

    @property
    def title(self) -> str:
        return f"{self.letter}: {self.boat} in {self.folder}, {self.basis}"


class Change(NamedTuple):
    """A quantity of one boat minus that of another, with the 90 % interval of the difference."""

    mean: float
    low: float
    high: float
    verdict: str


def change(first: Quantity, other: Quantity) -> Change:
    """The difference of two independent estimates, from their intervals (Zou and Donner, 2008)."""
    mean = other.value - first.value
    low = mean - math.hypot(other.value - other.low, first.high - first.value)
    high = mean + math.hypot(other.high - other.value, first.value - first.low)
    if low > 0 or high < 0:
        return Change(mean, low, high, CHANGED)
    sure = high - low <= 2 * WIDE * abs(first.value)
    return Change(mean, low, high, SAME if sure else VAGUE)


def read_boats(folders: Sequence[str], name: str | None = None) -> list[list[KnownBoat]]:
    """The boats to compare, or the one of a name, each as it is in every run: by name, or the only one of each run."""
    if not 2 <= len(folders) <= len(ascii_uppercase):
        raise ConfigError(f"compare: found {len(folders)} runs, expected 2 to {len(ascii_uppercase)}")
    runs = [_boats_of(folder, letter) for folder, letter in zip(folders, ascii_uppercase, strict=False)]
    if all(len(boats) == 1 for boats in runs) and name is None:
        return [[next(iter(boats.values())) for boats in runs]]
    shared = [boat for boat in runs[0] if all(boat in boats for boats in runs)]
    wanted = [boat for boat in shared if name in (None, boat)]
    if not wanted:
        have = "; ".join(f"{folder} has {', '.join(boats)}" for folder, boats in zip(folders, runs, strict=True))
        hint = did_you_mean(name, shared) if name else ""
        raise ConfigError(f"boats: found none that all runs have, {have}: expected a boat in each{hint}")
    return [[boats[boat] for boats in runs] for boat in wanted]


def _boats_of(given: str, letter: str) -> dict[str, KnownBoat]:
    folders = run_folders(given)
    if len(folders) > 1:
        raise ConfigError(f"compare: found {len(folders)} runs below {given}, expected one: name {folders[0]}, say")
    folder = folders[0]
    facts = results(folder)
    if not facts:
        raise CheckpointError(f"{folder}: is not finished: run train.py with resume={folder} hydra.run.dir={folder}")
    try:
        errors = from_csv((folder / ERRORS).read_text())
        boats, online, output = list(facts["boats"]), facts.get("identified") or {}, str(facts["output"])
        fits = saved_fits([folder], boats)
        return {
            boat: KnownBoat(
                letter, folder, boat, *_quantities(fits.get(boat), online.get(boat) or {}), output,
                [each for each in errors if each.boat == boat],
            )
            for boat in boats
        }  # fmt: skip
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise CheckpointError(f"{folder}: is damaged ({error}): make the run anew") from error


def _quantities(fit: SavedFit | str | None, online: Mapping[str, Any]) -> tuple[str, dict[str, Quantity]]:
    """What they rest on, and the quantities: of the fit, or else those that were learned online."""
    if isinstance(fit, SavedFit):
        return "by its fit", dict(fit.quantities)
    units = QUANTITIES | TURNING | OF_FIT
    quantities = {}
    for name, each in online.items():
        value, low, high = (math.nan if each[key] is None else float(each[key]) for key in ("value", "low", "high"))
        if unit := units.get(name):
            quantities[name] = Quantity(value, low, high, unit)
    return "as learned online", quantities


def errors_of(first: KnownBoat, other: KnownBoat) -> Iterator[tuple[str, float, float, Difference | None]]:
    """By horizon: the mean errors of both on the missions that they share, m/s, and the paired difference."""
    for words, kind, horizon in HORIZONS:
        pair = [
            {place[2]: cell for place, cell in cells({"": each.errors}, Measure(each.output, kind, horizon)).items()}
            for each in (first, other)
        ]
        same = [run for run in pair[0] if run in pair[1] and pair[0][run].steps == pair[1][run].steps]
        if same:
            places = [{("", "", run): each[run] for run in same} for each in pair]
            steps = sum(pair[0][run].steps for run in same)
            before, after = (sum(each[run].steps * each[run].error for run in same) / steps for each in pair)
            yield words, before, after, compare(places[1], places[0], Measure(first.output, kind, horizon))


def sections(boats: Sequence[Sequence[KnownBoat]]) -> list[Section]:
    """A section for each boat: a forest plot, the changes of its quantities, and its errors."""
    return [_section(k, runs) for k, runs in enumerate(boats)]


def _section(index: int, runs: Sequence[KnownBoat]) -> Section:
    first, here = runs[0], [each.title for each in runs]
    rows, errors = list[tuple[Cell, ...]](), list[tuple[Cell, ...]]()
    for other in runs[1:]:
        pair = f"{first.letter} → {other.letter}"
        for name, own in first.quantities.items():
            if name in other.quantities and math.isfinite(own.value) and math.isfinite(other.quantities[name].value):
                difference = change(own, other.quantities[name])
                rows.append((pair, name, own.unit, own.value, other.quantities[name].value, *difference))
        shared = list(errors_of(first, other))
        for words, before, after, paired in shared:
            ends = (None,) * 3 if paired is None else (paired.mean, paired.low, paired.high)
            verdict = VAGUE if paired is None or paired.tie is None else SAME if paired.tie else CHANGED
            errors.append((pair, words, before, after, *ends, verdict))
        here += [DEPENDENT if shared else f"{pair}: {UNPAIRED}"]
    columns = "pair", "quantity", "unit", "before", "after", "change", "from (90 %)", "to (90 %)", "verdict"
    heads = "pair", "error, m/s", "before", "after", "change", "from (95 %)", "to (95 %)", "verdict"
    names = [name for name in first.quantities if any(name == row[1] for row in rows)]
    name, caption = f"changes_{index + 1}", "Points: values. Lines: 90 % intervals. Red: changed."
    figures = [Drawn(name, forest(runs, names), caption)] if names else []
    here.append(CHANCE if names else "No quantity is known in both.")
    sheets = [ResultTable(name, columns, rows)] if rows else []
    sheets += [ResultTable(f"errors_{index + 1}", heads, errors)] if errors else []
    boats = " and ".join(dict.fromkeys(each.boat for each in runs))
    return Section(f"boat-{index + 1}", boats, "", here, figures, sheets)


@guarded
def forest(runs: Sequence[KnownBoat], names: Sequence[str]) -> Any:
    """A panel for each quantity, in which each run has a point with its interval."""
    figure, panels = panels_of(len(names), 3, (3.1, 0.55 + 0.22 * len(runs)), (0.2, 0.3), 9.5, shared=False)
    for panel, name in zip(panels, names, strict=True):
        first = runs[0].quantities[name]
        for row, each in enumerate(runs):
            if quantity := each.quantities.get(name):
                colour = WORSE if row and change(first, quantity).verdict == CHANGED else INK
                panel.plot([quantity.low, quantity.high], [row, row], color=colour, linewidth=1.6)
                panel.plot(quantity.value, row, "o", color=colour, markersize=4)
        panel.axvline(first.value, color=LINE, linewidth=1.0)
        panel.set_yticks(range(len(runs)), [each.letter for each in runs])
        panel.set(title=f"{name}, {first.unit}", ylim=(len(runs) - 0.5, -0.5))
        panel.grid(False)
    return figure
