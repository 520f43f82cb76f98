"""The leaderboard of a sweep as a table: for the terminal, as CSV and as Markdown."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

from rich.console import Group
from rich.text import Text

from certify.proofs.rounding import above
from usvlearn.display.terminal import Blocks, ResultTable
from usvlearn.errors import printable
from usvlearn.evaluation.comparison import Difference, SeedDifference, short_keys
from usvlearn.evaluation.metrics import mean, mean_mae
from usvlearn.evaluation.objective import SKILL, Measure, measure_of
from usvlearn.report.tables import short_settings
from usvlearn.sweeps.jobs import Job
from usvlearn.sweeps.ranking import Standing

DASH, LARGE = "–", 200.0  # percent, from which on a difference is not stated more exactly
CONTRACTION = "K: the largest rate of the networks, a step, certified as contracting; no: one of them is not."


def result_table(folder: Path, found: Sequence[Standing], keys: Sequence[str]) -> ResultTable:
    """One row per setting, the best first, with all numbers."""
    names = list(dict.fromkeys(name for each in found for job in each.jobs for name in _maes(job)))
    numbers = ("objective", "deviation", "seeds", "reference", "difference", "low", "high", "tie")
    by_seeds = ("seeds_difference", "seeds_low", "seeds_high", "seeds_tie")
    maes = (f"mae/{name}" for name in names)
    columns = ("rank", "job", *keys, "measure", "unit", *numbers, *by_seeds, "seconds", "contracting", "rate",
               *maes, "error")  # fmt: skip
    rows = []
    for rank, each in enumerate(found, 1):
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


def printed(folder: Path, found: Sequence[Standing], keys: Sequence[str], measure: Measure | None) -> Group:
    """The table for the terminal: settings, objective ± deviation, difference, seconds, contraction rate; failures.

    Args:
        folder, found, keys: as of `result_table`.
        measure: what ranks them; None if each job's own output does.
    """
    shown = [each for each in found if each.done]
    most = max((each.done for each in shown), default=0)
    heads, values = short_keys(keys), [_value(each, most) for each in shown]
    differ = any(each.difference is not None for each in shown)
    compared = [_difference(each, measure) for each in shown]
    paired = [_over_seeds(each, measure) for each in shown]
    by_seeds = any(paired)
    networks = _networks_differ(shown, measure)
    what = measure.title() if measure else "MAE of each job's output"
    unit = f", {measure.unit}" if measure and measure.unit else "" if measure else ", m/s"
    columns = [
        measure.kind if measure and not measure.unit else "MAE",
        *(["by runs" if by_seeds else "difference"] if differ else []),
    ]
    columns += [*(["by seeds"] if by_seeds else []), "s"]
    columns += ["K"] if networks else []
    table = Blocks(f"{what}{unit}, mean over boats{_deviation(shown)}", ["job", *heads], columns, folded=heads)
    for each, value, difference, pair in zip(shown, values, compared, paired, strict=True):
        cells = [value, *([difference] if differ else []), *([pair] if by_seeds else [])]
        cells.append(DASH if each.seconds is None else f"{each.seconds:.1f}")
        cells += [_network(each)] if networks else []
        own = [each.settings.get(key, DASH) for key in keys]
        table.add(_numbers(folder, each.jobs), *own, *cells, style="bold" if each is shown[0] else "")
    lines = [*_sentences(shown, measure, keys), *([CONTRACTION] if networks else [])]
    for job in (job for each in found for job in each.failed):
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
    if (found := each.difference) is None:
        return ""
    scale, sign = _scale(found, measure)
    if found.low is None or found.high is None:
        return f"{scale * found.mean:+.1f}{sign}"
    low, high = scale * found.low, scale * found.high
    if found.tie:
        return "tie"
    if min(abs(low), abs(high)) > LARGE:
        return f"{'>' if low > 0 else '<'} {LARGE if low > 0 else -LARGE:+.0f}{sign}"
    return " … ".join(f"{x:+.1f}" if abs(x) < 100 else f"{x:+.0f}" for x in (low, high)) + sign


def _over_seeds(each: Standing, measure: Measure | None) -> str:
    """The mean difference over seeds ± half its interval, in the same unit; "" where there is no interval."""
    if each.difference is None or (found := each.difference.over_seeds) is None or found.high is None:
        return ""
    scale, sign = _scale(each.difference, measure)
    mean, half = scale * found.mean, scale * (found.high - found.mean)
    digits = 1 if max(abs(mean), half) < 100 else 0
    return f"{mean:+.{digits}f} ± {half:.{digits}f}{sign}"


def _scale(found: Difference, measure: Measure | None) -> tuple[float, str]:
    """What a difference is multiplied by to be shown, and the sign behind it."""
    if measure is not None and measure.kind == SKILL:
        return 100.0, ""
    return (100 * found.share / found.mean if found.mean else 0.0), " %"


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


def _ties(found: Sequence[Difference] | Sequence[SeedDifference]) -> str:
    ties = sum(bool(each.tie) for each in found)
    return f"{ties} of {len(found)} settings {'ties' if ties == 1 else 'tie'} with it (0 is in the interval)"


def _networks_differ(shown: Sequence[Standing], measure: Measure | None) -> bool:
    """Whether the networks are those of the ranking member, or are not the same in all settings."""
    own = any(
        measure.estimator in members
        for each in shown
        for job in each.jobs
        for members in (job.results.get("network") or {}).values()
        if measure
    )
    return own or len({(each.contracting, each.rate) for each in shown}) > 1
