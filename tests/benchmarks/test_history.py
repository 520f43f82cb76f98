"""The history of the benchmarks: what is read and appended, and when a figure is worse."""

import doctest

import history
import numpy as np
import pytest
from history import COLUMNS, Entry, Figure, Run

from usvlearn.errors import UsvlearnError

RUN = Run("2026-01-02T03:04:05+00:00", "1.0", "whole", "a machine, 2 cores", "3.11.7", "2.13.0", "0.68.1", "2.4.6")
ROUNDS = 15


def entries(*values: float, spread: float | None = 0.02, run: Run = RUN, **more: str) -> list[Entry]:
    return [Entry(run, Figure("step", value, "C", spread=spread, **more)) for value in values]


def compare(before: list[Entry], now: list[Entry]):
    return history.compare(before, now[0])


def measured(rng: np.random.Generator, true: float, spread: float, between: float = 0.0) -> Entry:
    """A ratio of `true` as a run of ROUNDS rounds finds it; `between`: what all rounds of a run have in common."""
    common = true * (1 + between * rng.standard_normal())
    return Entry(RUN, history.timed("step", common * (1 + spread * rng.standard_normal(ROUNDS)), "C"))


def shares(spread: float, between: float, slower: float, runs: int = 400) -> float:
    """How often a run is worse whose time is `slower` times that of five before."""
    rng = np.random.default_rng(0)
    found = [
        compare([measured(rng, 2.0, spread, between) for _ in range(5)], [measured(rng, 2.0 * slower, spread, between)])
        for _ in range(runs)
    ]
    return sum(each.worse for each in found) / runs


def test_examples():
    assert doctest.testmod(history).failed == 0 < doctest.testmod(history).attempted


def test_a_spread_is_the_standard_deviation_of_normal_values():
    values = 3 + 0.2 * np.random.default_rng(0).standard_normal(20_000)
    assert history.spread(values) == pytest.approx(0.2 / 3, rel=0.03)


def test_a_slowdown_of_a_fifth_is_seen_at_a_spread_of_five_percent():
    assert shares(0.05, 0.0, 1.2) > 0.95
    assert shares(0.02, 0.02, 1.2) > 0.95


@pytest.mark.parametrize("spread, between", [(0.05, 0.0), (0.05, 0.02), (0.02, 0.02), (0.15, 0.05)])
def test_noise_is_no_slowdown(spread, between):
    assert shares(spread, between, 1.0) < 0.01


def test_a_smaller_slowdown_than_the_floor_is_none():
    assert not compare(entries(*[2.0] * 5, spread=0.0), entries(2.19, spread=0.0)).worse
    assert compare(entries(*[2.0] * 5, spread=0.0), entries(2.21, spread=0.0)).worse


def test_changes_are_since_the_last_and_since_the_median_of_five():
    found = compare(entries(9.0, 1.0, 1.1, 1.2, 1.3, 1.4), entries(1.5))
    assert found.entries == 6
    assert found.last == pytest.approx(1.5 / 1.4 - 1) and found.median == pytest.approx(1.5 / 1.2 - 1)


def test_what_was_won_and_is_lost_again_is_seen():
    """The median still is the old time, and the last entry the new one."""
    found = compare(entries(2.0, 2.0, 2.0, 2.0, 1.5), entries(2.0))
    assert found.median == 0 and found.last == pytest.approx(1 / 3) and found.worse
    assert not compare(entries(2.0, 2.0, 2.0, 2.0, 1.8), entries(2.0)).worse  # 11 % < √2 · 10 %


def test_slow_steps_that_each_are_small_are_seen_together():
    assert compare(entries(2.0, 2.0, 2.0, 2.16), entries(2.3)).worse


def test_the_noisier_of_this_run_and_the_earlier_ones_counts():
    calm, noisy = entries(*[2.0] * 5), entries(*[2.0] * 5, spread=0.2)
    assert compare(calm, entries(2.6)).worse
    assert not compare(noisy, entries(2.6)).worse and not compare(calm, entries(2.6, spread=0.2)).worse
    assert not compare(entries(1.7, 2.0, 2.4, 1.8, 2.2), entries(2.6)).worse  # the values themselves spread


def test_higher_may_be_better():
    higher = entries(*[0.5] * 3, spread=None, better="higher")
    assert compare(higher, entries(0.48, spread=None, better="higher")).worse
    assert not compare(higher, entries(0.6, spread=None, better="higher")).worse


def test_a_base_of_zero():
    assert compare(entries(0.0, spread=None), entries(1.0, spread=None)).worse
    assert not compare(entries(0.0, spread=None), entries(0.0, spread=None)).worse


def test_only_equal_circumstances_are_compared():
    before = entries(1.0)
    assert compare(before, entries(2.0)).worse
    for other in (RUN._replace(machine="another"), RUN._replace(effort="quick")):
        found = compare(before, entries(2.0, run=other))
        assert found.entries == 0 and found.last is None and found.median is None and not found.worse
    assert not compare(before, [Entry(RUN, Figure("step", 2.0, "plain RLS", spread=0.02))]).worse
    other = RUN._replace(machine="another", python="3.14.0", version="9")  # repeats of what is not timed are equal
    assert compare(entries(1.0, spread=None), entries(1.1, spread=None, run=other)).worse


def test_what_was_appended_is_read(tmp_path):
    file = tmp_path / "history.csv"
    assert history.read(file) == []
    first = [Entry(RUN, Figure("step, streamed", 1.25, "C", spread=0.015)), Entry(RUN, Figure('a "rate"', 0.5, "all"))]
    history.append(file, first)
    file.write_text(file.read_text().rstrip("\n"))  # an editor that writes no last newline
    history.append(file, entries(3.0, spread=0.0))
    assert history.read(file) == [*first, *entries(3.0, spread=0.0)]
    assert file.read_text().splitlines()[0] == ",".join(COLUMNS)


GOOD = '2026-01-02,1.0,whole,"m, 2 cores",3.11,2.13,0.68,2.4,step,1.5,ratio,lower,C,0.02'


@pytest.mark.parametrize(
    "line, said",
    [
        ("no row at all", "1 columns, expected 14"),
        ("<<<<<<< HEAD", "1 columns"),
        ("", "0 columns"),
        (GOOD + ",more", "15 columns"),
        (GOOD.replace("1.5,", "fast,"), "value: 'fast', expected a finite number"),
        (GOOD.replace("1.5,", "nan,"), "value: 'nan'"),
        (GOOD.replace("0.02", "-0.02"), "spread: '-0.02'"),
        (GOOD.replace("lower", "smaller"), "'smaller', expected 'lower' or 'higher'"),
        (GOOD.replace("2026-01-02", "yesterday"), "the date 'yesterday', expected an ISO date"),
        (GOOD.replace("cores", 'cores" "'), "no row of CSV"),
    ],
)
def test_a_damaged_line_is_named(tmp_path, line, said):
    file = tmp_path / "history.csv"
    file.write_text(f"{','.join(COLUMNS)}\n{GOOD}\n{line}\n{GOOD}\n")
    with pytest.raises(UsvlearnError) as error:
        history.read(file)
    assert f"{file}, line 3: found " in str(error.value) and said in str(error.value)
    assert str(error.value).count("\n") == 0


def test_a_foreign_file_is_named(tmp_path):
    file = tmp_path / "history.csv"
    file.write_text("time,speed\n0,1\n")
    with pytest.raises(UsvlearnError, match="line 1: found the columns 'time,speed', expected date,version"):
        history.read(file)
    file.write_bytes(f"{','.join(COLUMNS)}\n{GOOD}\n".encode() + b"\xff\xfe")
    with pytest.raises(UsvlearnError, match="line 3: found bytes that are not UTF-8"):
        history.read(file)
    file.write_bytes(b"")
    with pytest.raises(UsvlearnError, match="line 1: found no columns, expected date,version"):
        history.read(file)
