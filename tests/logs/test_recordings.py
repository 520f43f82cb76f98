"""Recordings to batch elements: seams, padding, counts; and a replay of a batch of boats equals single replays."""

import numpy as np
import pytest
import torch

from tests.support.recordings import recording
from usvlearn import AID, RLS, RNN, Average, Ensemble, Persistence, RecursiveWeights, SurgeDynamics
from usvlearn.core.samples import named_leaves, tree_map
from usvlearn.errors import ConfigError, LogFormatError
from usvlearn.logs.recordings import align_fleet
from usvlearn.runs.replay import Position, replay
from usvlearn.simulate.fleet import fleet as simulated


def ensemble():
    members = {"aid": AID(28.0), "rls": RLS(), "dynamic_rls": RLS(SurgeDynamics(28.0)), "rnn": RNN()}
    members |= {"persistence": Persistence()}
    return Ensemble(members, {"average": Average(), "weighted": RecursiveWeights()})


def test_boats_are_elements_and_shorter_runs_are_padded():
    fleet = align_fleet([recording("a", "one", 4.0), recording("b", "first", 8.0), recording("a", "two", 6.0)])
    assert fleet.boats == ("a", "b")
    first, second = fleet.runs
    assert (first.names, first.lengths) == (("one", "first"), (11, 21))
    assert (second.names, second.lengths) == (("two", ""), (16, 0))
    assert first.samples.surge.shape == (21, 2) == first.time.shape and (first.time[0] == 0.0).all()
    assert first.time[10, 0] == pytest.approx(4.0) and np.isnan(first.time[11:, 0]).all()
    assert not first.samples.fresh[11:, 0].any() and not second.samples.fresh[:, 1].any()
    assert np.isnan(first.samples.surge[11:, 0]).all() and (first.samples.inputs.dt[11:, 0] > 0).all()
    assert fleet.rejected["a"]["surge"]["empty"] == 4
    assert fleet.steps == 21 + 16 and fleet.steps_before(1, 5) == 26


def test_the_seam_between_runs_is_no_transition():
    """The second run starts 1 m/s faster; persistence does not see the jump, since no step crosses the seam."""
    fleet = align_fleet([recording("a", "one", 4.0), recording("a", "two", 4.0, speed=1.1)])
    model = Ensemble({"persistence": Persistence()})
    chunks = list(replay(model, fleet, model.init((1,))))
    errors = [c.published["predictions"][1:, 0, 0] - fleet.runs[c.end.run].samples.surge[1:, 0] for c in chunks]
    np.testing.assert_allclose(errors, -0.04, atol=1e-9)
    assert all(np.isnan(c.published["predictions"][0]).all() for c in chunks)


def test_three_measured_steps_make_a_run_and_shorter_ones_are_left_out_or_refused():
    with pytest.warns(UserWarning, match="two"):
        fleet = align_fleet([recording("a", "one", 1.2), recording("a", "two", 0.5)])
    assert len(fleet.runs) == 1 and fleet.runs[0].samples.measured.sum() == 3
    with pytest.raises(LogFormatError, match=r"at least 3 in a run, found a, run one: 2 "):
        align_fleet([recording("a", "one", 0.8)])


@pytest.mark.parametrize("boat", ["", "..", "a/b", "../../zz", "a\\b"])
def test_a_boat_whose_name_cannot_be_a_folder_is_refused(boat):
    with pytest.raises(ConfigError, match=r"data\.boat"):
        align_fleet([recording(boat, "one", 4.0)])


def test_eight_boats_as_elements_equal_eight_single_runs():
    recordings = simulated(n=8, hours=0.1, mission_minutes=3.0, seed=3)
    together, model = align_fleet(recordings), ensemble()
    elements = list(replay(model, together, model.init((8,))))
    for element, boat in enumerate(together.boats):
        alone = align_fleet([r for r in recordings if r.boat == boat])
        single = list(replay(model, alone, model.init((1,))))
        for ours, theirs in zip(elements, single, strict=True):
            n = len(theirs.published["predictions"])
            one, other = ours.published["predictions"][:n, element], theirs.published["predictions"][:, 0]
            np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-12)
        state = tree_map(lambda x, i=element: x[i], elements[-1].state)
        for (name, x), (_, y) in zip(named_leaves(state), named_leaves(single[-1].state), strict=True):
            torch.testing.assert_close(x, y[0], rtol=1e-11, atol=1e-11, msg=lambda m, n=name: f"{n}: {m}")


def test_chunks_cover_every_run_and_say_when_to_save():
    fleet, model = align_fleet([recording("a", "one", 8.0), recording("a", "two", 4.0)]), ensemble()
    chunks = list(replay(model, fleet, model.init((1,)), every=6, save_every=10))
    ends = [(*c.end, c.save) for c in chunks]
    assert ends == [(0, 6, False), (0, 10, True), (0, 12, False), (0, 18, False), (0, 20, True), (0, 21, True),
                    (1, 6, False), (1, 10, True), (1, 11, True)]  # fmt: skip
    whole = list(replay(model, fleet, model.init((1,))))
    np.testing.assert_array_equal(
        np.concatenate([c.published["predictions"] for c in chunks if c.end.run == 0]),
        whole[0].published["predictions"],
    )
    rest = list(replay(model, fleet, chunks[4].state, begin=Position(0, 20), every=6, save_every=10))
    assert [c.end for c in rest] == [c.end for c in chunks[5:]]
    np.testing.assert_array_equal(rest[-1].published["predictions"], chunks[-1].published["predictions"])


@pytest.mark.parametrize("backs", [[3600.0], [604_800.0], [20.0], [3600.0, 60.0]], ids=str)
def test_a_clock_that_is_set_back_lets_the_time_of_a_run_go_on(backs):
    """The end of summer time, a week rollover, a counter that wraps, and two of them."""
    whole = recording("heron", "a", 60.0)
    ends = np.linspace(0, 60, len(backs) + 2)[1:-1]

    def back(time: np.ndarray) -> np.ndarray:
        return time - sum(np.where(time > end, by, 0.0) for end, by in zip(ends, backs, strict=True))

    channels = {name: each._replace(time=back(each.time)) for name, each in whole.channels.items()}
    (run,) = align_fleet([whole._replace(channels=channels)]).runs
    (plain,) = align_fleet([whole]).runs
    time = run.time[:, 0]
    assert (np.diff(time) > 0).all() and time[0] == 0 and abs(time[-1] - plain.time[-1, 0]) < 2.0 * len(backs)
    assert run.samples.measured.sum() > 0.9 * plain.samples.measured.sum()
