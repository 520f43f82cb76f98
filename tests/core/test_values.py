"""What small functions of core, errors, runs and composition give."""

import io

import numpy as np
import pytest

from usvlearn.composition.errors import _dotted
from usvlearn.core.events import CHANGE, LOSS, RECOVERY, Event, EventWatch, event_of
from usvlearn.core.family import POSITIVE, UNIT, leaf
from usvlearn.core.hyperparameters import Positive, numbers
from usvlearn.core.samples import Inputs, Sample, check_inputs, check_sample, named_leaves, rebuild, sort_of, where
from usvlearn.core.unconfirmed import questions_of, unconfirmed
from usvlearn.errors import bad_input, check_not_negative, columns_of, did_you_mean, folded, printable
from usvlearn.runs.compared import number, result_tag, results_of

LOST = Event(12.0, LOSS, "left", 0.41, 0.3, 0.52, 10.0, ("joint",))
GUESSES = {"sides": {"certainty": "probable"}, "delay": {"certainty": "unsure"}}
RESULTS = {"boats": {"heron": {"rnn": {"mae": 0.1, "skill": 0.5}}}, "seconds": 3.0}
VALUES = [
    (list(_dotted({"align": {"dt": 0.4}})), ["align", "align.dt"]),
    (LOST.sentence, "the left thruster gives 41 % of its thrust (30 ... 52 %); joint got this after 10 s"),
    (Event(80.0, RECOVERY, "left").sentence, "the left thruster gives its full thrust again"),
    (Event(3.0, CHANGE, filters=("a", "b")).sentence, "the boat has changed: a and b have learned other parameters"),
    (event_of({"run": "7", "time": 1.0, "kind": RECOVERY, "side": "left"}), Event(1.0, RECOVERY, "left")),
    (POSITIVE.wrong(np.array([1.0, 0.0, -2.0])).tolist(), [0.0, -2.0]),
    ((str(POSITIVE), leaf(3, legal=UNIT).shape), ("1e-30 … 1e+30", (3,))),
    (numbers(gain=Positive([1.0, 2.0]), bound=3), {"gain": [1.0, 2.0], "bound": 3.0}),
    (dict(named_leaves({"aid": {"theta": 1}, "surge": 2})), {"aid.theta": 1, "surge": 2}),
    (rebuild({"aid": {"theta": 0}, "surge": 0}, {"aid.theta": 1, "surge": 2}), {"aid": {"theta": 1}, "surge": 2}),
    ((sort_of(np.dtype(np.float32)), sort_of(np.dtype(bool))), ("float", "bool")),
    (where(np.array([True, False]), np.ones((2, 1)), np.zeros((2, 1))).tolist(), [[1.0], [0.0]]),
    (questions_of({"delay": None}, "a.yaml")["delay"]["certainty"], "unsure"),
    (unconfirmed(GUESSES)[0].partition(". ")[0], "2 guesses unconfirmed: delay (unsure), sides (probable)"),
    (printable("found \x1b[2J, 3 °"), "found \\x1b[2J, 3 °"),
    (folded("files  run: results.json, errors.csv", 28), "files  run: results.json,\n       errors.csv"),
    (columns_of(io.StringIO()), None),
    (check_not_negative("patience", 0.0), 0.0),
    (did_you_mean("gain", ["aid.gain", "align"]), ": did you mean aid.gain?"),
    ((did_you_mean("aid.gian", ["aid.gain"]), did_you_mean("x", ["aid"])), (": did you mean aid.gain?", "")),
    (bad_input(RuntimeError("a bug")), None),
    (results_of(RESULTS, "rnn"), {"MAE (m/s)": 0.1, "skill": 0.5, "seconds": 3.0}),
    (result_tag("MAE 10 s ahead (m/s)"), "8 results/5 MAE 10 s ahead (m/s)"),
    ([number(each) for each in ("0.4", 2, "mean", "nan")], [0.4, 2.0, "mean", "nan"]),
]


@pytest.mark.parametrize(("found", "expected"), VALUES, ids=range(len(VALUES)))
def test_a_value_is_as_expected(found, expected):
    assert found == expected


def test_a_thruster_that_loses_thrust_is_an_event_at_its_first_row():
    watch = EventWatch(["joint"])
    assert watch.see(0.0, [1, 1, 0.3, 0.3, 0, 0, 0, 0, 0]) == []
    (event,) = watch.see(0.4, [0.4, 1, 0.1, 0.3, 1, 0, 0, 0, 0])
    assert event.is_alarm and event.sentence == "the left thruster gives 40 % of its thrust (24 ... 56 %)"


def test_fields_that_are_no_numbers_or_flags_are_refused():
    inputs = Inputs(0.5, 0.5, 0.0, 0.0, 0.4)
    with pytest.raises(TypeError, match=r"command_right: found '0\.5', expected a number"):
        check_inputs(inputs._replace(command_right="0.5"))
    with pytest.raises(TypeError, match="fresh: found 'false', expected True or False"):
        check_sample(Sample(inputs, 1.0, fresh="false", measured=True))
