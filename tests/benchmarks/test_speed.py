"""The measurements of speed: works in turn, every way of a step, memory, the page and its figures."""

import doctest
import subprocess
import sys
from pathlib import Path

import pytest
import speed
import speed_jobs
import speed_steps
import timing
import torch
from reference import compiler

TINY = timing.Effort(2, 40, 5, 20, (1, 3), 120, (0.05, 0.1), 3, 2)


@pytest.fixture(autouse=True)
def without_gradients():
    """As the benchmark runs."""
    with torch.no_grad():
        yield


def test_works_are_timed_in_turn():
    done = []
    spent = timing.in_turn({name: lambda name=name: done.append(name) for name in "ab"}, repeats=3)
    assert done == list("ab" * 4)  # the first round is not measured
    assert {name: len(seconds) for name, seconds in spent.items()} == {"a": 3, "b": 3}


def test_a_ratio_is_of_works_of_one_round():
    assert timing.ratio([1.0, 10.0, 300.0], [1.0, 5.0, 100.0]) == 2.0


def test_examples_of_timing():
    assert doctest.testmod(timing) == (0, 4)


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["aid", "sway, n = 14", "projected sift", "default ensemble"])
def test_every_way_of_a_step_is_measured(name):
    estimator = speed_steps.estimators()[name]
    found = speed_steps.costs(estimator, TINY, list(speed_steps.WAYS))
    twin = {"C"} if name in ("aid", "sway, n = 14") and compiler() else set()
    assert set(found) == {"streamed", "call", "torch"} | twin
    assert all(len(each) == TINY.repeats and min(each) > 0 for each in found.values())


def test_the_samples_are_learned_from_every_one():
    from usvlearn.core.protocol import clean

    run = speed_steps.samples(9000)  # more than the log has: it begins again
    assert len(run.surge) == 9000 and bool(clean(run).learns.all())


@pytest.mark.thorough
def test_the_axes_see_one_another_a_step_late():
    yaw, sway = (speed_steps.samples(200, kind) for kind in ("yaw", "sway"))
    assert torch.equal(sway.inputs.heading[1:], yaw.surge[:-1])
    assert torch.equal(yaw.inputs.heading[1:], sway.surge[:-1])
    assert torch.equal(yaw.inputs.yaw_rate, sway.inputs.yaw_rate) and float(yaw.inputs.yaw_rate.max()) > 1
    assert float(yaw.surge.std()) > 0.05 and float(sway.surge.std()) > 0.05


@pytest.mark.thorough
def test_the_peak_of_memory_is_that_since_it_was_reset():
    if not speed_jobs.RESET.exists():
        pytest.skip("the peak can be reset on Linux alone")
    code = (
        "import sys, mmap; sys.path.insert(0, sys.argv[1]); import speed_jobs\n"
        "def fill(size):\n"
        "    with mmap.mmap(-1, size) as pages: pages.write(bytes(1) * size)\n"
        "fill(2**26); speed_jobs.RESET.write_text('5'); before = speed_jobs.peak()\n"
        "fill(2**25); print((speed_jobs.peak() - before) / 2**20)"
    )
    folder = str(Path(speed_jobs.__file__).parent)
    done = subprocess.run([sys.executable, "-c", code, folder], capture_output=True, text=True, check=True)
    assert 30 < float(done.stdout) < 70  # 32 MiB of pages, and as many that are written to them


@pytest.mark.thorough
def test_the_page_has_its_sections_and_their_figures(tmp_path):
    pytest.importorskip("matplotlib")
    text = speed.page(tmp_path, TINY, ["elements"])
    assert "## Batch elements" in text and "| ensemble |" in text and "(speed_elements.svg)" in text
    assert (tmp_path / "speed_elements.svg").read_text().count("µs an element-step") == 1
