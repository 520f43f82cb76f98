"""A boat that is stepped one sample at a time: its copies, its process's children, and what asks it while it learns."""

import copy
import os
import pickle
import threading

import numpy as np
import pytest
import torch

from tests.support.commands import python
from tests.support.kernel_cases import mission
from usvlearn import Inputs, Online, Sample, SIFtRLS, SurgeDynamics


def copies(online: Online) -> list[Online]:
    return [copy.copy(online), copy.deepcopy(online), pickle.loads(pickle.dumps(online))]


def test_a_copy_of_a_boat_goes_its_own_way():
    sample = Sample(Inputs(0.5, 0.5, 0.0, 0.0, 0.4), 1.0, True, True)
    boat, whole = (Online(SIFtRLS(SurgeDynamics(28.0))) for _ in range(2))
    boat.step(sample), whole.step(sample)
    before = boat.state
    for other in copies(boat):
        expected = [whole.step(sample._replace(surge=x)) for x in (1.1, 1.3)]
        assert [other.step(sample._replace(surge=x)) for x in (1.1, 1.3)] == expected
        assert torch.equal(other.state.theta, whole.state.theta) and torch.equal(boat.state.theta, before.theta)
        whole.state = before


FORKS = """
import os, signal, sys, threading
from usvlearn import AID, BOA, Ensemble, Inputs, Online, Persistence, Sample
boat = Online(Ensemble({"aid": AID(28.0), "persistence": Persistence()}, {"boa": BOA()}))
sample, done = Sample(Inputs(0.5, 0.5, 0.0, 0.0, 0.4), 1.0, True, True), False
def learn():
    while not done:
        boat.step(sample)
thread = threading.Thread(target=learn)
thread.start()
for _ in range(40):
    child = os.fork()
    if child == 0:
        signal.alarm(20)  # ends a child that hangs
        boat.step(sample), Online(AID(28.0)).step(sample)
        os._exit(0)
    if os.waitpid(child, 0)[1]:
        done = True
        sys.exit("a child did not get through")
done = True
thread.join()
print("40 children went on")
"""


@pytest.mark.thorough
@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system has no fork")
def test_a_fork_while_a_thread_learns_leaves_the_child_free_to_learn():
    assert python(FORKS).stdout == "40 children went on\n"


def test_a_boat_that_is_asked_while_it_learns():
    """The kernels hold no GIL: what they work in is one thread's at a time."""
    samples = mission(1500, seed=3, faults=False)
    numbers = zip(*(x.tolist() for x in (*samples.inputs, *samples[1:])), strict=True)
    rows = [Sample(Inputs(*row[:5]), *row[5:]) for row in numbers]
    asked, alone = (Online(SIFtRLS(SurgeDynamics(28.0))) for _ in range(2))
    done = threading.Event()

    def ask() -> None:
        while not done.is_set():
            asked.predict(rows[5].inputs)

    thread = threading.Thread(target=ask)
    thread.start()
    try:
        predicted = [asked.step(row) for row in rows]
    finally:
        done.set()
        thread.join()
    np.testing.assert_array_equal(predicted, [alone.step(row) for row in rows])
