"""Paired differences: the interval holds as often as it says, ties are ties, and the objective is the fleet's."""

import numpy as np
import pytest

from usvlearn.evaluation.comparison import RunError, as_csv, cells, compare, from_csv
from usvlearn.evaluation.objective import Measure, measure_of

RNN = Measure("rnn")


def errors(maes: dict[tuple[str, str], float], ahead: str = "step", base: float = 0.2) -> list[RunError]:
    return [RunError(boat, run, ahead, 100, {"rnn": e, "persistence": base}) for (boat, run), e in maes.items()]


def season(rng, boats: int, runs: int, shift: float, spread: float = 0.02):
    """Errors of two settings; a run's own difficulty is common, and the first is better by `shift` on average."""
    own = {(f"b{i}", f"r{j}"): float(0.1 + 0.05 * rng.random()) for i in range(boats) for j in range(runs)}
    other = {cell: float(e + shift + spread * rng.normal()) for cell, e in own.items()}
    return cells({"": errors(own)}, RNN), cells({"": errors(other)}, RNN)


def test_the_difference_is_that_of_the_objective():
    """Mean over boats of the error over all steps, whatever the lengths of the runs."""
    one = [RunError("a", "1", "step", 10, {"rnn": 0.1}), RunError("a", "2", "step", 30, {"rnn": 0.3}),
           RunError("b", "1", "step", 5, {"rnn": 0.5})]  # fmt: skip
    other = [each._replace(mae={"rnn": 0.2}) for each in one]
    result = compare(cells({"": one}, RNN), cells({"": other}, RNN), RNN)
    assert result.mean == pytest.approx(((10 * 0.1 + 30 * 0.3) / 40 + 0.5) / 2 - 0.2)
    assert result.share == pytest.approx(result.mean / 0.2) and result.runs == 3


def test_other_samples_are_not_compared():
    """Runs of the same names may be others: of other hours, of another step, of other logs."""
    maes = {("a", "1"): 0.1, ("a", "2"): 0.1}
    one = cells({"": errors(maes)}, RNN)
    others = [errors(maes, base=0.21), errors({**maes, ("a", "3"): 0.1}), errors({("a", "1"): 0.1}), []]
    others.append([each._replace(steps=95) for each in errors(maes)])
    for other in others:
        assert compare(one, cells({"": other}, RNN), RNN) is None
    assert compare(one, cells({"0": errors(maes)}, RNN), RNN) is None  # no seed in common
    fewer = {"0": errors(maes), "1": errors(maes, base=0.3)}
    assert compare(cells(fewer, RNN), cells({"1": errors(maes, base=0.3)}, RNN), RNN).runs == 2


@pytest.mark.parametrize(("boats", "runs"), [(1, 2), (1, 3), (1, 6), (1, 20), (2, 4)])
def test_the_interval_contains_the_truth_about_as_often_as_it_says(boats, runs):
    """95 % of 200 seasons: mean 190, deviation 3."""
    held = 0
    for seed in range(200):
        result = compare(*season(np.random.default_rng([seed, runs]), boats, runs, 0.01), RNN)
        held += result.low <= -0.01 <= result.high
    assert 178 <= held <= 199


def test_boats_that_differ_are_drawn_too():
    held = 0
    for seed in range(100):
        rng = np.random.default_rng(seed)
        parts = [season(rng, 1, 9, shift, 0.001) for shift in 0.02 * rng.normal(size=5)]
        one, other = (
            {(s, f"{k}", r): cell for k, part in enumerate(parts) for (s, _, r), cell in part[side].items()}
            for side in (0, 1)
        )
        held += bool(compare(one, other, RNN).tie)
    assert held >= 88


def test_small_differences_are_ties_and_large_ones_are_not():
    rng = np.random.default_rng(1)
    small, large = (compare(*season(rng, 8, 8, shift), RNN) for shift in (0.0005, 0.02))
    assert small.tie is True and large.tie is False and large.high < 0


def test_one_run_has_no_interval_also_if_seeds_repeat_it():
    """Seeds of a recorded log are the same samples again."""
    one, other = ({f"{k}": errors({("a", "1"): e + 0.001 * k}) for k in range(3)} for e in (0.1, 0.2))
    for count in (1, 3):
        few = [{seed: each[seed] for seed in list(each)[:count]} for each in (one, other)]
        result = compare(*(cells(each, RNN) for each in few), RNN)
        assert result.mean == pytest.approx(-0.1) and result.low is None and result.tie is None and result.runs == 1


def test_seeds_of_other_samples_are_other_runs():
    seeds = [{f"{k}": errors({("a", "1"): e + 1e-4 * k * k * e}, base=0.2 + k) for k in range(4)} for e in (0.1, 0.2)]
    result = compare(*(cells(each, RNN) for each in seeds), RNN)
    assert result.tie is False and result.runs == 4 and result.low < -0.1 < result.high


@pytest.mark.parametrize(
    ("objective", "ahead"), [("rnn.forecast.10", "10"), ("rnn.free", "free"), ("rnn.skill", "step")]
)
def test_each_objective_has_its_own_errors(objective, ahead):
    measure = measure_of(objective, "")
    some = {("a", f"{k}"): 0.1 for k in range(3)}
    noise = errors({("a", "0"): 9.0}, "other")
    one, other = ({"": [*errors(some, ahead), *noise]}, {"": errors(dict.fromkeys(some, 0.15), ahead)})
    result = compare(cells(one, measure), cells(other, measure), measure)
    assert result.mean == pytest.approx(0.25 if objective == "rnn.skill" else -0.05)  # persistence errs by 0.2


def test_coverage_has_no_errors_by_run():
    assert cells({"": errors({("a", "1"): 0.1})}, Measure("rnn", "coverage")) == {}


DAMAGED = ["", "a,b\n", "boat,run,ahead,steps,x\nh,r,step,0,0.1\n", "boat,run,ahead,steps,x\nh,r,step,9,nan\n",
           "boat,run,ahead,steps,x\nh,r,step,9\n", "boat,run,ahead,steps,x\nh,r,step,x,1\n"]  # fmt: skip


@pytest.mark.parametrize("text", DAMAGED)
def test_a_damaged_table_of_errors_is_refused(text):
    with pytest.raises(ValueError):
        from_csv(text)


def test_errors_survive_being_written():
    rows = [RunError("a, b", 'x"y\nz', "0.4", 3, {"rnn": 1 / 3}), RunError("é", "2", "free", 1, {})]
    assert from_csv(as_csv(rows, ["aid", "rnn"])) == rows
