"""The leaderboard of a sweep: printed, and written as CSV, Markdown, figures and a page of TensorBoard.

leaderboard.csv   one row per setting, all digits      leaderboard.md    the same with four digits
settings.png      a row per setting, sorted: its jobs, its mean, its interval (extra plot)
leaderboard/      one row per setting, for TensorBoard
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any

from rich.console import Group
from rich.text import Text

from certify.proofs.rounding import above
from usvlearn.core.checkpoint import write_atomically
from usvlearn.core.unconfirmed import SECTION, unconfirmed
from usvlearn.display.figures import INK, attempted, colours, figure_of, rendered, themed
from usvlearn.display.terminal import Blocks, ResultTable, console, show
from usvlearn.errors import ConfigError, MissingExtraError, printable
from usvlearn.evaluation.comparison import Difference, SeedDifference, short_keys
from usvlearn.evaluation.metrics import mean, mean_mae
from usvlearn.evaluation.objective import SKILL, Measure, differing, measure_of, own_objective, ranked_by, scored
from usvlearn.report.tables import board_lines, from_here, short_settings
from usvlearn.runs.files import check_no_link
from usvlearn.sweeps.jobs import SWEEP, Job, jobs, noted_sweep
from usvlearn.sweeps.ranking import Standing, standings
from usvlearn.sweeps.seeds import SEED
from usvlearn.sweeps.tensorboard import write_board

DASH, LARGE = "–", 200.0  # percent, from which on a difference is not stated more exactly
CONTRACTION = "K: the largest rate of the networks, a step, certified as contracting; no: one of them is not."


def result_table(folder: Path, standings: Sequence[Standing], keys: Sequence[str]) -> ResultTable:
    """One row per setting, the best first, with all numbers."""
    names = list(dict.fromkeys(name for each in standings for job in each.jobs for name in _maes(job)))
    numbers = ("objective", "deviation", "seeds", "reference", "difference", "low", "high", "tie")
    by_seeds = ("seeds_difference", "seeds_low", "seeds_high", "seeds_tie")
    maes = (f"mae/{name}" for name in names)
    columns = ("rank", "job", *keys, "measure", "unit", *numbers, *by_seeds, "seconds", "contracting", "rate",
               *maes, "error")  # fmt: skip
    rows = []
    for rank, each in enumerate(standings, 1):
        done = [job for job in each.jobs if job.finished]
        measure = next((str(job.results.get("measure", "")) for job in done), "")
        diff = each.difference
        seeds = diff and diff.over_seeds
        rows.append((
            rank, " ".join(label(folder, job) for job in each.jobs), *(each.settings.get(key) for key in keys), measure,
            measure_of(measure or None, "output").unit, each.value, each.deviation, len(done), each.reference,
            *((None,) * 3 if diff is None else (diff.mean, diff.low, diff.high)), diff and diff.tie,
            *((None,) * 4 if seeds is None else (*seeds[:3], seeds.tie)), each.seconds, each.contracting,
            each.rate, *(mean(_maes(job).get(name) for job in done) for name in names),
            "; ".join(dict.fromkeys(job.failure for job in each.failed)),
        ))  # fmt: skip
    return ResultTable("leaderboard", columns, rows)


def printed(folder: Path, standings: Sequence[Standing], keys: Sequence[str], measure: Measure | None) -> Group:
    """The table for the terminal: settings, objective ± deviation, difference, seconds, contraction rate; failures."""
    shown = [each for each in standings if each.done]
    most = max((each.done for each in shown), default=0)
    heads, values = short_keys(keys), [_value(each, most) for each in shown]
    differ = any(each.difference is not None for each in shown)
    compared = [_difference(each, measure) for each in shown]
    paired = [_over_seeds(each, measure) for each in shown]
    by_seeds = any(paired)
    networks = _networks_differ(shown, measure)
    columns = [
        measure.kind if measure and not measure.unit else "MAE",
        *(["by runs" if by_seeds else "difference"] if differ else []),
    ]
    columns += [*(["by seeds"] if by_seeds else []), "s"]
    columns += ["K"] if networks else []
    table = Blocks(f"{_words(measure)}, mean over boats{_deviation(shown)}", ["job", *heads], columns, folded=heads)
    for each, value, difference, pair in zip(shown, values, compared, paired, strict=True):
        cells = [value, *([difference] if differ else []), *([pair] if by_seeds else [])]
        cells.append(DASH if each.seconds is None else f"{each.seconds:.1f}")
        cells += [_network(each)] if networks else []
        settings = [each.settings.get(key, DASH) for key in keys]
        table.add(_numbers(folder, each.jobs), *settings, *cells, style="bold" if each is shown[0] else "")
    lines = [*_sentences(shown, measure, keys), *([CONTRACTION] if networks else [])]
    for job in (job for each in standings for job in each.failed):
        what = "failed" if "error" in job.results else "not finished"
        lines.append(
            f"{what}: job {label(folder, job)}, {short_settings(job.settings, keys)}: {printable(job.failure)}"
        )
    return Group(*([table] if shown else []), *map(Text, lines))


def label(folder: Path, job: Job) -> str:
    """The path of a job below the sweep's folder, which is its number."""
    return job.folder.relative_to(folder).as_posix()


def _maes(job: Job) -> dict[str, float]:
    return mean_mae(job.results.get("boats", {}))


def _numbers(folder: Path, jobs: Sequence[Job]) -> str:
    """The jobs' numbers, ranges in short form."""
    names = [label(folder, job) for job in jobs]
    if not all(name.isdecimal() for name in names):
        return " ".join(names)
    numbers = sorted(map(int, names))
    runs = [[n for _, n in group] for _, group in groupby(enumerate(numbers), lambda pair: pair[1] - pair[0])]
    return ",".join(f"{run[0]}" if len(run) == 1 else f"{run[0]}-{run[-1]}" for run in runs)


def _value(each: Standing, most: int) -> str:
    """The objective ± deviation; if fewer seeds finished than of other settings, how many."""
    if each.value is None:
        return "no value"
    seeds = f" ({each.done} of {most} seeds)" if each.done < most else ""
    return f"{each.value:.5f}" + ("" if each.deviation is None else f" ± {each.deviation:.5f}") + seeds


def _difference(each: Standing, measure: Measure | None) -> str:
    """The interval over runs of the difference to the reference, in percent of it; of skill in hundredths."""
    if each.reference:
        return "reference"
    if (difference := each.difference) is None:
        return ""
    scale, sign = _scale(difference, measure)
    if difference.low is None or difference.high is None:
        return f"{scale * difference.mean:+.1f}{sign}"
    low, high = scale * difference.low, scale * difference.high
    if difference.tie:
        return "no difference" if difference.runs > 2 else "too few runs"
    if min(abs(low), abs(high)) > LARGE:
        return f"{'>' if low > 0 else '<'} {LARGE if low > 0 else -LARGE:+.0f}{sign}"
    return " … ".join(f"{x:+.1f}" if abs(x) < 100 else f"{x:+.0f}" for x in (low, high)) + sign


def _over_seeds(each: Standing, measure: Measure | None) -> str:
    """The mean difference over seeds ± half its interval, in the same unit; "" where there is no interval."""
    if each.difference is None or (interval := each.difference.over_seeds) is None or interval.high is None:
        return ""
    scale, sign = _scale(each.difference, measure)
    mean, half = scale * interval.mean, scale * (interval.high - interval.mean)
    digits = 1 if max(abs(mean), half) < 100 else 0
    return f"{mean:+.{digits}f} ± {half:.{digits}f}{sign}"


def _scale(difference: Difference, measure: Measure | None) -> tuple[float, str]:
    """What a difference is multiplied by to be shown, and the sign behind it."""
    if measure is not None and measure.kind == SKILL:
        return 100.0, ""
    return (100 * difference.share / difference.mean if difference.mean else 0.0), " %"


def _deviation(shown: Sequence[Standing]) -> str:
    seeds = {each.done for each in shown if each.deviation is not None}
    return f" and {max(seeds)} seeds, ± deviation over seeds" if seeds else ""


def _network(each: Standing) -> str:
    if each.contracting is None:
        return DASH
    return "no" if not each.contracting else "yes" if each.rate is None else above(each.rate, 4)


def _sentences(shown: Sequence[Standing], measure: Measure | None, keys: Sequence[str]) -> list[str]:
    """What the differences say, in words."""
    reference = next((each for each in shown if each.reference), None)
    if reference is None or len(shown) < 2:
        return []
    compared = [each for each in shown if each.difference is not None]
    if not compared:
        return ["No differences: no other setting has errors over the same samples."]
    kind = "the default" if reference.default else "the best"
    name = f"Reference: {kind}, {short_settings(reference.settings, keys)}."
    what = "in hundredths of skill" if measure and measure.kind == SKILL else "of its error"
    others = len(shown) - 1 - len(compared)
    alone = f" {others} not compared: other samples, or no value." if others else ""
    differences = [each.difference for each in compared if each.difference]
    paired = [each.over_seeds for each in differences if each.over_seeds is not None]
    by_seeds = any(each.low is not None for each in paired)
    if any(each.tie is None for each in differences):
        first = "One run: no interval over runs" + ("." if by_seeds else ", so that a difference may be chance.")
    else:
        runs = max(each.runs for each in differences)
        kind = f"95 % interval of a bootstrap over {runs} paired runs"
        first = f"{'By runs' if by_seeds else 'Differences'}: {what}, {kind}; {_ties(differences)}."
    said = [f"{name} {first}{alone}"]
    seeds = max((each.seeds for each in paired), default=0)
    if by_seeds:
        kind = f"mean over {seeds} seeds, each paired with itself on the same runs, ± 95 % interval (Student's t)"
        said.append(f"By seeds: {what}, {kind}; {_ties([each for each in paired if each.low is not None])}.")
    elif seeds == 1:
        said.append("One seed: no interval over seeds. seeds=5 gives one.")
    elif seeds:
        said.append(f"{seeds} seeds gave the same differences: no interval over seeds.")
    return said


def _ties(differences: Sequence[Difference] | Sequence[SeedDifference]) -> str:
    ties = sum(bool(each.tie) for each in differences)
    return f"no difference to it was found for {ties} of {len(differences)} settings (0 is in the interval)"


def _networks_differ(shown: Sequence[Standing], measure: Measure | None) -> bool:
    """Whether the networks are those of the ranking member, or are not the same in all settings."""
    of_ranked = any(
        measure.estimator in members
        for each in shown
        for job in each.jobs
        for members in (job.results.get("network") or {}).values()
        if measure
    )
    return of_ranked or len({(each.contracting, each.rate) for each in shown}) > 1


MOST_ROWS = 25  # settings


def settings_figure(ranks: Sequence[Standing], keys: Sequence[str], measure: Measure | None) -> bytes | None:
    """A PNG with a row per setting, the best above; None for less than two settings with a value.

    Small points are jobs, the large one is their mean. A bar is where the mean is by the paired difference to the
    reference, with its 95 % interval: over seeds, or over runs if there is none over seeds.
    """
    known = [each for each in ranks if each.value is not None]
    shown = known[:MOST_ROWS]
    if len(shown) < 2 or not keys:
        return None
    name = measure.estimator if measure else "ensemble"
    reference = next((each.value for each in known if each.reference), None)
    intervals, paired = [_interval(each) for each in shown], any(_interval(each, "seeds") for each in shown)
    with themed():
        figure = figure_of(7.4, 1.5 + 0.27 * len(shown), dpi=90)
        panel, colour = figure.subplots(), colours([name])[name]
        for k, (each, interval) in enumerate(zip(shown, intervals, strict=True)):
            values = list(each.by_seed.values())
            panel.plot(values, [k] * len(values), ".", color=INK, markersize=4, alpha=0.45)
            if interval and reference is not None:
                ends = [reference + x for x in interval]
                panel.plot(ends, [k, k], color=colour, linewidth=5, alpha=0.4, solid_capstyle="butt")
            panel.plot(each.value, k, "o", color=colour, markersize=7)
        if reference is not None:
            panel.axvline(reference, color=INK, linewidth=0.9, linestyle=":")
        names = [" ".join(f"{short}={each.settings[key]}" for short, key in zip(short_keys(keys), keys, strict=True)
                          if key in each.settings) for each in shown]  # fmt: skip
        panel.set_yticks(range(len(shown)), [shortened(name, 44) for name in names])
        panel.set(xlabel=_words(measure), ylim=(len(shown) - 0.5, -0.5))
        panel.grid(False, axis="y")
        over = "seeds" if paired else "runs"
        bars = f"; bar: 95 % of the paired difference, over {over}" if any(intervals) else ""
        more = f"; {len(known) - len(shown)} more settings" if len(known) > len(shown) else ""
        panel.set_title(f"point: job; disc: mean; dotted: reference{bars}{more}")
        return rendered(figure, facecolor="white")


def _interval(each: Standing, over: str = "") -> tuple[float, float] | None:
    """The interval of the difference to the reference: over seeds, else over runs unless seeds are asked for."""
    difference = each.difference
    for one in (difference and difference.over_seeds, None if over else difference):
        if one is not None and one.low is not None and one.high is not None:
            return one.low, one.high
    return None


def _words(measure: Measure | None) -> str:
    """What the axis of the objective shows."""
    if measure is None:
        return "MAE of each job's output, m/s"
    return f"{measure.title()}, {measure.unit}".removesuffix(", ")


def shortened(text: str, most: int = 16) -> str:
    """A text that fits an axis; its end distinguishes values such as paths."""
    return text if len(text) <= most else f"…{text[1 - most :]}"


FOLDER, TABLE, TEXT, FIGURE = "leaderboard", "leaderboard.csv", "leaderboard.md", "settings.png"


def leaderboard(folder: Path, load: Callable[[Path], Any], objective: Any = None) -> bool:
    """Print and write the leaderboard of the runs below a folder; returns whether all are finished."""
    all_jobs, note = jobs(folder, load), noted_sweep(folder)
    keys = differing([job.settings for job in all_jobs])
    done = [job.results for job in all_jobs if job.finished]
    by = ranked_by(objective or note.objective or own_objective(done), note.swept or keys, done)
    if objective is not None and by is not None and not any(map(by.known, done)):
        raise ConfigError(
            f"objective: found {objective}, which no finished job of {folder} has measured: see boats, forecast and "
            "free in their results.json"
        )
    all_jobs = [job._replace(results=scored(job.results, by)) for job in all_jobs]
    ranks = standings(all_jobs, by, note.defaults)
    keys = [key for key in keys if key != SEED]
    asked = {each["key"]: each for one in done for each in one.get(SECTION, ())}
    console().print(printed(folder, ranks, keys, by))
    show(*unconfirmed(asked))
    if files := write_leaderboard(folder, all_jobs, ranks, by):
        console().print("", *last_lines(folder, files), sep="\n", soft_wrap=True)
    return all(job.finished for job in all_jobs)


def write_leaderboard(
    folder: Path, jobs: Sequence[Job], ranks: Sequence[Standing] | None = None, measure: Measure | None = None
) -> list[str]:
    """Write all files into a folder, and return their names without the page of TensorBoard; earlier ones are replaced.

    Nothing is written if the folder is itself a run. The results are those of `usvlearn.evaluation.objective.scored`.
    """
    if any(job.folder == folder for job in jobs):
        return []
    check_own_board(folder, "folder")
    keys = [key for key in differing([job.settings for job in jobs]) if key != SEED]
    ranks = standings(jobs, measure, {}) if ranks is None else ranks
    table = result_table(folder, ranks, keys)
    try:
        write_atomically(folder / TABLE, table.csv().encode())
        (folder / FIGURE).unlink(missing_ok=True)
        if (png := _figure(ranks, keys, measure)) is not None:
            write_atomically(folder / FIGURE, png)
        picture = f"![jobs, mean and interval of each setting]({FIGURE})\n\n" if png else ""
        write_atomically(folder / TEXT, f"{picture}{table.markdown()}".encode())
        write_board(folder / FOLDER, ranks, {} if png is None else {"settings": png})
    except OSError as cause:
        raise ConfigError(f"{folder}: cannot hold the leaderboard ({cause}): make it writable") from cause
    return [*([FIGURE] if png else []), TABLE, TEXT]


def check_own_board(folder: Path, option: str) -> None:
    """Raise a ConfigError if a leaderboard's file is a link here, or exists without a leaderboard or a sweep."""
    files = [folder / name for name in (TABLE, TEXT, FIGURE)]
    for path in files:
        check_no_link(path, option)
    if (folder / SWEEP).is_file() or (files[0].is_file() and files[0].read_bytes().startswith(b"rank,job,")):
        return
    for path in files:
        if path.is_file():
            raise ConfigError(
                f"{path}: found a file of no leaderboard, where one is written: move it, or choose another {option}"
            )


def last_lines(folder: Path, files: Sequence[str]) -> list[str]:
    """The last lines of a sweep: its files, and the command that shows more."""
    return [f"files        {from_here(folder)}: {', '.join(files)}", *board_lines(folder / FOLDER, "#hparams")]


def _figure(ranks: Sequence[Standing], keys: Sequence[str], measure: Measure | None) -> bytes | None:
    """The figure as PNG, if it shows something; None, with a warning, without matplotlib."""
    try:
        return attempted(partial(settings_figure, ranks, keys, measure), "settings", rendered)
    except MissingExtraError as cause:
        warnings.warn(f"no figure of the sweep: {cause}", stacklevel=2)
        return None
