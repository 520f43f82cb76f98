"""Settings of a sweep: seeds are pooled, the default is found, ties are said to be ties, and the table fits."""

import re
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from scipy import stats

from usvlearn.evaluation.comparison import RunError, over_seeds
from usvlearn.evaluation.objective import Measure, differing, scored
from usvlearn.sweeps import ranking
from usvlearn.sweeps.jobs import Job
from usvlearn.sweeps.leaderboard import printed, write_leaderboard
from usvlearn.sweeps.ranking import same, standings

RNN = Measure("rnn")
SWEEP = Path("sweep")


@pytest.fixture(autouse=True)
def errors_at_hand(monkeypatch):
    """The errors of a job by run, which lie in its folder else."""
    monkeypatch.setattr(ranking, "errors_of", lambda job: job.results.get("by run", ()))


def job(k: int, mae: float | None, seconds: float = 2.0, network: dict | None = None, **settings: str) -> Job:
    """One job over eight runs of a boat, whose errors scatter by a thousandth about the MAE."""
    keys = {key if key == "seed" else f"estimators.rnn.{key}": x for key, x in settings.items()}
    if mae is None:
        return Job(SWEEP / f"{k}", keys, {"error": "bad: found -1"})
    rng = np.random.default_rng([7, k])
    maes = mae + 1e-3 * rng.normal(size=8)
    runs = tuple(
        RunError("heron", f"r{i}", "step", 100, {"rnn": float(e), "persistence": 0.2}) for i, e in enumerate(maes)
    )
    results = {"boats": {"heron": {"rnn": {"mae": float(maes.mean()), "skill": 0.1}}}, "output": "ensemble",
               "measure": "ensemble.mae", "objective": 0.5, "seconds": seconds}  # fmt: skip
    results |= {"network": {"heron": {"rnn": network}}} if network else {}
    return Job(SWEEP / f"{k}", keys, scored(results, RNN) | {"by run": runs})


def lines(jobs: list[Job], defaults: dict[str, str] | None = None, width: int = 80, measure=RNN) -> list[str]:
    keys = [key for key in differing([each.settings for each in jobs]) if key != "seed"]
    console = Console(width=width)
    with console.capture() as caught:
        console.print(printed(SWEEP, standings(jobs, measure, defaults or {}), keys, measure))
    return caught.get().splitlines()


SIZES = [job(0, 0.10, neurons="4"), job(1, 0.08, neurons="20"), job(2, 0.0801, neurons="40"), job(3, 0.05, neurons="9")]
DEFAULT = {"estimators.rnn.neurons": "20"}


def test_settings_are_compared_with_the_default():
    ranks = standings(SIZES, RNN, DEFAULT)
    assert [each.settings["estimators.rnn.neurons"] for each in ranks] == ["9", "20", "40", "4"]
    assert [each.reference for each in ranks] == [False, True, False, False]
    best, default, close, worst = ranks
    assert default.difference is None and close.difference.tie is True
    assert best.difference.high < 0 < worst.difference.low
    assert best.difference.mean == pytest.approx(best.value - default.value)
    text = "\n".join(lines(SIZES, DEFAULT))
    assert (
        "reference" in text
        and " no difference " in text
        and "no difference to it was found for 1 of 3 settings" in " ".join(text.split())
    )
    assert "Reference: the default, rnn.neurons=20." in text


@pytest.mark.parametrize("defaults", [{}, {"estimators.rnn.neurons": "8"}])
def test_without_the_default_they_are_compared_with_the_best(defaults):
    ranks = standings(SIZES, RNN, defaults)
    assert [each.reference for each in ranks] == [True, False, False, False]
    assert "Reference: the best, rnn.neurons=9." in "\n".join(lines(SIZES, defaults))
    best = {"estimators.rnn.neurons": "9"}
    assert "Reference: the default, rnn.neurons=9." in "\n".join(lines(SIZES, best))


def test_a_default_that_diverged_is_no_reference():
    diverged = SIZES[1]._replace(results=SIZES[1].results | {"objective": None})
    ranks = standings([SIZES[0], diverged, SIZES[3]], RNN, DEFAULT)
    assert ranks[0].reference and ranks[-1].value is None
    assert any("no value" in line for line in lines([SIZES[0], diverged, SIZES[3]], DEFAULT))


def test_seeds_are_pooled():
    jobs = [job(k, 0.1 + 0.01 * (k % 3) + 0.1 * (k // 3), neurons=f"{4 + k // 3}", seed=f"{k % 3}") for k in range(6)]
    ranks = standings(jobs, RNN, {})
    assert [len(each.jobs) for each in ranks] == [3, 3]
    values = [each.results["objective"] for each in jobs[:3]]
    assert ranks[0].value == pytest.approx(np.mean(values)) and ranks[0].deviation == pytest.approx(
        np.std(values, ddof=1)
    )
    text = "\n".join(lines(jobs))
    assert "0-2" in text and "3-5" in text and "±" in text and "3 seeds" in text
    only = standings(jobs[:3], RNN, {})
    assert len(only) == 1 and len(only[0].jobs) == 3
    assert len(standings([job(0, 0.1, neurons="4"), job(1, 0.2, neurons="4")], RNN, {})) == 2  # equal ones


@pytest.mark.parametrize("seeds", [2, 5])
def test_the_interval_over_seeds_holds_the_truth(seeds):
    """The logs of a seed are as hard for both settings; what its weights add is drawn for each. Truth: a difference."""
    rng, truth, repeated = np.random.default_rng(11), 0.002, 4000
    hard = rng.normal(0.1, 0.02, (repeated, 1, seeds))
    drawn = hard + rng.normal(0, 0.001, (repeated, 2, seeds)) + np.array([truth, 0.0])[:, None]
    intervals = [over_seeds(*({str(k): x for k, x in enumerate(row)} for row in each)) for each in drawn]
    held = np.mean([each.low <= truth <= each.high for each in intervals])
    assert abs(held - 0.95) < 3 * np.sqrt(0.95 * 0.05 / repeated)
    paired = stats.ttest_rel(*drawn[0]).confidence_interval()
    assert (intervals[0].low, intervals[0].high) == pytest.approx((paired.low, paired.high), rel=1e-9)
    unpaired = stats.ttest_ind(*drawn[0]).confidence_interval()
    assert seeds == 2 or paired.high - paired.low < 0.3 * (unpaired.high - unpaired.low)


def of_seeds(mae: float, first: int, scatter: float, count: int = 5, **settings: str) -> list[Job]:
    """Jobs that differ in the seed, over one run, the same for all seeds."""
    several = []
    for seed, add in enumerate(scatter * np.random.default_rng(first).normal(size=count)):
        errors = (RunError("heron", "r", "step", 100, {"rnn": mae + add, "persistence": 0.2}),)
        each = job(first + seed, mae + add, seed=f"{seed}", **settings)
        rows = {"heron": {"rnn": {"mae": mae + add}}}
        results = scored(each.results | {"boats": rows}, RNN) | {"by run": errors}
        several.append(each._replace(results=results))
    return several


def test_seeds_on_one_log_have_an_interval_and_one_seed_has_none():
    jobs = [*of_seeds(0.10, 0, 1e-4, neurons="4"), *of_seeds(0.11, 5, 1e-4, neurons="9")]
    first, last = standings(jobs, RNN, {})
    assert last.difference.tie is None and last.difference.over_seeds.tie is False  # one run; five seeds
    assert last.difference.over_seeds.mean == pytest.approx(last.value - first.value, rel=1e-12)
    text = " ".join(" ".join(lines(jobs)).split())
    assert "One run: no interval over runs." in text and "may be chance" not in text
    assert "mean over 5 seeds, each paired with itself" in text and re.search(r" \+\d+\.\d ± 0\.\d % ", text)
    (one,) = standings([jobs[0], jobs[5]], RNN, {})[1:]
    assert one.difference.over_seeds.low is None
    text = " ".join(" ".join(lines([jobs[0], jobs[5]])).split())
    assert "One seed: no interval over seeds." in text and "by seeds" not in text


def test_seeds_that_draw_nothing_are_no_evidence():
    jobs = [*of_seeds(0.10, 0, 0.0, neurons="4"), *of_seeds(0.11, 5, 0.0, neurons="9")]
    assert standings(jobs, RNN, {})[1].difference.over_seeds.low is None
    assert "5 seeds gave the same differences: no interval over seeds." in " ".join(" ".join(lines(jobs)).split())


def test_a_setting_with_fewer_seeds_is_named_and_ranked_last():
    """Its season may be an easier one."""
    jobs = [job(0, 0.1, neurons="4", seed="0"), job(1, None, neurons="4", seed="1"), job(2, 0.2, neurons="9", seed="0"),
            job(3, 0.2, neurons="9", seed="1")]  # fmt: skip
    first, last = standings(jobs, RNN, {"estimators.rnn.neurons": "4"})
    assert first.settings["estimators.rnn.neurons"] == "9" and first.reference and first.done == 2
    assert last.value == jobs[0].results["objective"] and last.deviation is None and last.failed == [jobs[1]]
    text = lines(jobs)
    assert any("(1 of 2 seeds)" in line for line in text)
    assert any(line.startswith("failed: job 1, rnn.neurons=4: bad: found -1") for line in text)
    jobs[1] = jobs[1]._replace(results={})
    assert any(line.startswith("not finished: job 1, rnn.neurons=4: did not finish") for line in lines(jobs))


def test_large_differences_are_short_and_skill_is_better_where_it_is_greater(tmp_path):
    jobs = [job(0, 0.02, neurons="4"), job(1, 0.2, neurons="9"), job(2, 0.03, neurons="20")]
    text = "\n".join(lines(jobs))
    assert "> +200 %" in text
    skill = Measure("rnn", "skill")
    jobs = [each._replace(results=scored(each.results, skill)) for each in jobs]
    for each, value in zip(jobs, (0.9, 0.0, 0.85), strict=True):
        each.results["objective"] = value
    ranks = standings(jobs, skill, {"estimators.rnn.neurons": "20"})
    assert [each.settings["estimators.rnn.neurons"] for each in ranks] == ["4", "20", "9"]
    best, _, worst = ranks
    assert best.difference.low > 0 > worst.difference.high  # as the objective
    assert "+" in next(
        line for line in lines(jobs, {"estimators.rnn.neurons": "20"}, measure=skill) if line[:2] == "0 "
    )


def test_the_verdict_of_the_networks_is_shown():
    yes, no = ({"contracting": held, "condition": "exact" if held else None, "rate": rate} for held, rate in
               ((True, 0.93125), (False, 1.5)))  # fmt: skip
    jobs = [job(0, 0.1, network=yes, neurons="4"), job(1, 0.2, network=no, neurons="9"), job(2, 0.3, neurons="20")]
    text = lines(jobs)
    assert text[2].split()[-1] == "K" and [line.split()[-1] for line in text[4:7]] == [
        "0.9313",
        "no",
        "–",
    ]  # rounded up
    assert not any(line.startswith("K:") for line in lines([job(0, 0.1, neurons="4"), job(1, 0.2, neurons="9")]))


@pytest.mark.parametrize("width", [80, 60])
def test_the_table_fits(width):
    network = {"contracting": True, "condition": "exact", "rate": 0.93125}
    jobs = [
        job(k, 0.1 + 0.001 * k, network=network, neurons=f"{k}", initial=("persistence", "random")[k % 2], unroll="1",
            seed=f"{s}")
        for k in range(4) for s in range(3)
    ]  # fmt: skip
    printed = lines(jobs, width=width)
    assert max(map(len, printed)) <= width and "…" not in "".join(printed[:2])
    assert sum(line.startswith("job ") for line in printed) == 1 or width < 80  # one block


def test_the_files_say_what_the_terminal_says(tmp_path):
    jobs = [each._replace(folder=tmp_path / each.folder.name) for each in SIZES]
    write_leaderboard(tmp_path, jobs, standings(jobs, RNN, DEFAULT), RNN)
    rows = [line.split(",") for line in (tmp_path / "leaderboard.csv").read_text().splitlines()]
    table = [dict(zip(rows[0], row, strict=True)) for row in rows[1:]]
    assert [row["job"] for row in table] == ["3", "1", "2", "0"] and [row["rank"] for row in table] == list("1234")
    assert [row["tie"] for row in table] == ["False", "", "True", "False"] and table[1]["reference"] == "True"
    assert float(table[0]["low"]) < float(table[0]["difference"]) < float(table[0]["high"]) < 0
    picture, table = (tmp_path / "leaderboard.md").read_text().split("\n\n")
    assert picture.endswith("(settings.png)") and table.startswith("| rank | job | estimators.rnn.neurons |")
    assert (tmp_path / "settings.png").read_bytes().startswith(b"\x89PNG")


def test_values_of_a_command_are_the_same_as_numbers_or_as_words():
    rates = [job(0, 0.1, rate="1e-3"), job(1, 0.2, rate="0.01")]
    assert standings(rates, RNN, {"estimators.rnn.rate": "0.001"})[0].reference
    ranks = standings([job(0, 0.10, rule="mean"), job(1, 0.08, rule="last")], RNN, {"estimators.rnn.rule": "mean"})
    assert [each.reference for each in ranks] == [each.default for each in ranks] == [False, True]
    for one, other in (("1e-3", "0.001"), ("mean", "mean"), ("null", "null"), ("20", "20.0")):
        assert same(one, other) and same(other, one)
    for one, other in (("1e-3", "0.002"), ("mean", "last"), ("mean", None), (None, "1"), (None, None), ("mean", "1")):
        assert not same(one, other) and not same(other, one)


def test_jobs_that_failed_are_counted_and_the_others_time_is_the_mean():
    jobs = [job(0, 0.1, 2.0, neurons="4", seed="0"), job(1, 0.12, 4.0, neurons="4", seed="1"),
            job(2, None, neurons="4", seed="2"), job(3, 0.2, neurons="9", seed="0")]  # fmt: skip
    old = jobs[1]._replace(results={key: x for key, x in jobs[1].results.items() if key != "seconds"})
    first, last = standings(jobs, RNN, {})
    assert (first.done, len(first.failed), first.seconds) == (
        2,
        1,
        3.0,
    ) and first.settings.keys() == last.settings.keys()
    assert first.by_seed == {"0": jobs[0].results["objective"], "1": jobs[1].results["objective"]}
    assert standings([jobs[0], old, *jobs[2:]], RNN, {})[0].seconds == 2.0 and (last.done, last.seconds) == (1, 2.0)
    assert "seed" not in first.settings and first.value == pytest.approx(np.mean(list(first.by_seed.values())))
