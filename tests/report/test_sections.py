"""The sections of a report, their tables and the truth, by hand."""

import numpy as np
import pytest
import torch

from tests.support.seasons import boats
from usvlearn import AID, ARX, RLS, RNN, Ensemble, JointEKF, Robust, SIFtRLS, SurgeDynamics
from usvlearn.display.terminal import ResultTable
from usvlearn.report.page import html_of
from usvlearn.report.sections.errors import box, online_section
from usvlearn.report.sections.parameters import cost_section
from usvlearn.simulate.fleet import fleet_vessels
from usvlearn.simulate.truth import true_parameters, truth_of
from usvlearn.simulate.vessel import static_thrust


def test_boxes_by_hand():
    values = np.concatenate([np.arange(100.0), np.full(20, 1000.0)])
    assert box(values).outliers == 20 and box(np.arange(100.0)).outliers == 0  # also beyond 5 % of them
    found = box(np.array([np.nan, 3.0, 1.0, 2.0, 4.0, 100.0]), 2)
    assert (found.median, found.lower, found.upper, found.number, found.diverged) == (3.0, 2.0, 4.0, 5, 2)
    assert found.mean == 22.0 and found.beyond.tolist() == [1.0, 100.0]
    assert box(np.array([np.nan])) is None


def test_online_section_by_hand():
    _, seasons = boats(np.ones((2, 9)))
    published = []
    for season, offset in zip(seasons, (0.1, 0.3), strict=True):
        runs = []
        for each in season.runs:
            made = np.where(each.samples.inputs.dt > 0, each.samples.surge, np.nan)
            predictions = np.stack([made + offset, made + 0.2], -1)
            runs.append(each._replace(published={"predictions": predictions}))
        published.append(season._replace(runs=tuple(runs)))
    section = online_section(published, ["aid", "persistence"])
    maes = {(row[0], row[1]): row[2] for row in section.sheets[1].rows}
    assert maes == pytest.approx({
        ("boat0", "aid"): 0.1, ("boat0", "persistence"): 0.2, ("boat1", "aid"): 0.3, ("boat1", "persistence"): 0.2,
    })  # fmt: skip
    assert "The lowest of all: aid on 1 of 2 boats, persistence on 1 of 2 boats." in section.here
    methods = [row[1] for row in section.sheets[1].rows]
    assert methods == ["aid", "persistence", "persistence", "aid"]  # each boat's by its own errors


def test_sheets_escape_and_keep_digits():
    result_table = ResultTable("a", ("name", "x, m"), [("<b>", 1 / 3), ("c,d", None)])
    assert "&lt;b&gt;" in html_of(result_table) and "<b>" not in html_of(result_table)
    assert result_table.csv() == 'name,"x, m"\n<b>,0.3333333333333333\n"c,d",\n'


def test_cost_counts_the_papers_parameters():
    members = {"aid": AID(), "rls": RLS(), "rnn": RNN(), "robust": Robust(SIFtRLS(SurgeDynamics()))}
    members |= {"joint": JointEKF(3.0), "arx": Robust(ARX())}
    result_table = cost_section(Ensemble(members)).sheets[0]
    counts = {"aid": 9, "rls": 9, "rnn": 140, "robust": 9, "joint": 19, "arx": 27}
    assert {row[0]: row[2] for row in result_table.rows[:6]} == counts
    assert [row[3:5] for row in result_table.rows[4:6]] == [("O(p)", "O(p²)")] * 2
    assert all(row[5] > 0 and row[6] > 0 for row in result_table.rows)


@pytest.mark.parametrize("plant", ["heron", "otter", "vtec"])
def test_the_truth_is_the_plants(plant):
    """On its own grid the fitted force is near the plant's; scaled by declared over true mass."""
    found = true_parameters(30.0, 2, plant, hours=1.0, mission_minutes=20.0, seed=3)
    vessel = fleet_vessels(2, 1.0, plant, 3, missions=3)
    for k, theta in enumerate(found.values()):
        scale = 30.0 / float(vessel.mass[2, k])
        for x in (0.4, 0.8, 1.0):
            thrust = static_thrust(vessel, torch.tensor([x, x]).double())[2, k] * scale
            for side, force in zip(("left", "right"), thrust.tolist(), strict=True):
                fitted = theta[f"thrust_linear_{side}"][2] * x + theta[f"thrust_quadratic_{side}"][2] * x * x
                assert fitted == pytest.approx(force, abs=0.15 * abs(force) + 0.5), (side, x)
    assert truth_of([{"_target_": "usvlearn.simulate.fleet.fleet", "fault": {"side": "left"}}], 30.0) == {}
