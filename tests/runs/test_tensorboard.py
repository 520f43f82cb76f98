"""What TensorBoard shows of a replay: runs, tags, units, steps, figures, text, and the row of the HPARAMS page."""

import time

import numpy as np
import pytest

from tests.support import few
from tests.support.boards import boards, steps, tags, texts, values
from tests.support.commands import hparams
from tests.support.configured import short_season
from tests.support.recordings import recording
from tests.support.runs import model
from usvlearn import AID, Ensemble, Persistence
from usvlearn.composition.configuration import ensemble_of, instantiate
from usvlearn.core.samples import PLAUSIBLE, masks
from usvlearn.display.figures import KNOWN, SEVEN
from usvlearn.errors import ConfigError
from usvlearn.estimators.planar.state import CONSTANT, DUE, ERROR, HEADING_ERROR, RADIUS
from usvlearn.logs.recordings import align_fleet
from usvlearn.runs.compared import label, result_tag, results_of, what_differs
from usvlearn.runs.figures import LEAST_FIGURES
from usvlearn.runs.replay import replay
from usvlearn.runs.run_folder import RunFolder
from usvlearn.runs.tensorboard import FAR, MAE, TensorBoardLogger
from usvlearn.simulate.truth import quantities_of

MOST_TAGS = 32  # of a boat, with the results and texts
HORIZONS = (2.0, 10.0)


def log(folder, fleet, ensemble, stop=None, resume=None, **more):
    """Replay into a run's folder, up to so many chunks; returns the results, or None if it was stopped."""
    run = RunFolder(folder, fleet, ensemble, short_season())
    start = run.begin(ensemble.init((len(fleet.boats),)), resume)
    logger = TensorBoardLogger(folder / "tensorboard", fleet, ensemble, start.position, **more)
    with run, logger:
        for k, chunk in enumerate(replay(ensemble, fleet, start.state, start.position, 50, 150)):
            if k == stop:
                return None
            run.save(chunk)
            logger.show(chunk)
        saved = run.finish(time.perf_counter() - 60.0)
        logger.finish(short_season(), saved, run.published, ["rnn: fine"])
    return saved


@pytest.fixture(scope="module")
def fleet():
    return align_fleet(instantiate(short_season()["data"]), **short_season()["align"])


@pytest.fixture(scope="module")
def whole(tmp_path_factory, fleet):
    """A replay of two simulated boats by the default ensemble, and its results."""
    folder = tmp_path_factory.mktemp("whole")
    truth = quantities_of([short_season()["data"]], short_season()["vehicle"]["mass"])
    differs = {"estimators.rnn.neurons": "4"}
    saved = log(
        folder, fleet, ensemble_of(short_season()), truth=truth, differs=differs, texts={"command": "python train.py"}
    )
    return boards(folder / "tensorboard" / "rnn.neurons=4"), saved, folder


@pytest.mark.thorough
def test_every_boat_has_a_run_per_estimator_and_the_seven_have_the_seven_colours(whole, fleet):
    read, saved, _ = whole
    estimators = set(saved["boats"]["heron1"])
    for boat in fleet.boats:
        names = {run.partition("/")[2] for run in read if run.startswith(f"{boat}/")}
        assert names == estimators | {"identified", "identified low", "identified high", "truth"}
    order = list(read)
    colours = list(SEVEN.values())
    for place, run in enumerate(order):
        name = run.rpartition("/")[2]
        if name in (each for names in SEVEN for each in names):
            assert colours[place % 7] == KNOWN[name], run
    assert {run.partition("/")[2] for run in order if run.startswith("fleet/")} == estimators
    assert order[-1] == "results"


def test_a_boat_has_few_tags_with_units_and_descriptions(whole, fleet):
    read, _, _ = whole
    for boat in fleet.boats:
        seen = {tag for run, events in read.items() if run.startswith(f"{boat}/") for tag in tags(events)}
        assert len(seen | tags(read["results"])) <= MOST_TAGS
        skills = {f"1 overview/skill, {ahead}" for ahead in ("next step", "2 s ahead", "10 s ahead", "30 s ahead")}
        assert seen - {tag for tag in seen if tag.startswith(("2 identified/", "7 figures/"))} == skills | {
            f"1 overview/{MAE}", "1 overview/coverage of 90 %, next step", "1 overview/thruster alarms so far",
            "3 weights/weight", "4 contraction/rate K (a step)",
        }  # fmt: skip
        assert "2 identified/thrust_full_left (N)" in seen and "2 identified/thrust_ratio (left/right)" not in seen
    about = read["heron1/aid"].SummaryMetadata(f"1 overview/{MAE}").summary_description
    assert "750 steps" in about


def test_steps_are_seconds_on_the_water_and_increase(whole, fleet):
    read, _, _ = whole
    for element, boat in enumerate(fleet.boats):
        total = sum(run.time[run.lengths[element] - 1, element] for run in fleet.runs if run.lengths[element])
        for run, events in read.items():
            if run.startswith(f"{boat}/"):
                for tag in events.Tags()["scalars"]:
                    at = steps(events, tag)
                    assert all(np.diff(at) > 0) and total - 15 <= at[-1] <= total + len(fleet.runs), (run, tag)
    assert len(steps(read["heron1/aid"], f"1 overview/{MAE}")) >= 3


@pytest.mark.thorough
def test_the_last_points_are_the_errors_of_the_last_steps(fleet, tmp_path):
    """Of fewer steps than the window: the rolling errors are those of the whole log."""
    short = fleet._replace(runs=fleet.runs[:2])
    ensemble = ensemble_of(short_season())
    saved = log(tmp_path, short, ensemble)
    read = boards(tmp_path / "tensorboard")
    for boat in fleet.boats:
        for name, row in saved["boats"][boat].items():
            events = read[f"{boat}/{name}"]
            assert values(events, f"1 overview/{MAE}")[-1] == pytest.approx(row["mae"], rel=1e-5)
            assert values(events, "1 overview/skill, next step")[-1] == pytest.approx(row["skill"], rel=1e-4, abs=1e-6)
        for name, rows in saved["forecast"][boat].items():
            if rows["10"]["mae"] is not None:
                last = values(read[f"{boat}/{name}"], "1 overview/skill, 10 s ahead")[-1]
                assert last == pytest.approx(rows["10"]["skill"], rel=1e-4, abs=1e-6)
        coverage = values(read[f"{boat}/ensemble"], "1 overview/coverage of 90 %, next step")
        assert coverage[-1] == pytest.approx(saved["boats"][boat]["ensemble"]["coverage"])
    means = [values(read[f"{boat}/aid"], f"1 overview/{MAE}")[-1] for boat in fleet.boats]
    assert values(read["fleet/aid"], f"1 overview/{MAE}")[-1] == pytest.approx(np.mean(means))


def test_data_and_rejected_messages_are_told(whole, fleet):
    text = texts(whole[0]["results"])["run/data"]
    for element, boat in enumerate(fleet.boats):
        steps_ = sum(run.lengths[element] for run in fleet.runs)
        measured = sum(run.samples.measured[: run.lengths[element], element].sum() for run in fleet.runs)
        assert f"| {steps_} | {measured / steps_:.1%} |" in text
        assert f"lost {fleet.rejected[boat]['surge']['lost']}" in text


def test_identified_quantities_have_bands_and_truth_beside_them(whole):
    read, saved, _ = whole
    row = saved["identified"]["heron2"]["steady_speed_full"]
    assert max(abs(row[end] - row["value"]) for end in ("low", "high")) <= FAR * row["value"]
    for run, key in {"identified": "value", "identified low": "low", "identified high": "high"}.items():
        assert values(read[f"heron2/{run}"], "2 identified/steady_speed_full (m/s)")[-1] == pytest.approx(row[key])
    assert len(set(values(read["heron2/truth"], "2 identified/steady_speed_full (m/s)"))) == 1


def test_figures_and_text(whole, fleet):
    read, _, _ = whole
    images = {(run, tag) for run, events in read.items() for tag in events.Tags()["images"]}
    assert {("heron1/ensemble", "7 figures/runs"), ("heron2/ensemble", "7 figures/runs")} <= images
    assert ("heron1/ensemble", "7 figures/identified curves") in images and len(images) == LEAST_FIGURES
    shown = texts(read["results"])
    assert shown["run/command"] == "python train.py" and "rnn: fine" in shown["run/networks"]


def test_a_run_has_one_row_on_the_hparams_page_and_a_job_of_a_sweep_none(whole, tmp_path, fleet):
    _, saved, folder = whole
    rows = hparams(folder / "tensorboard" / "rnn.neurons=4")
    assert list(rows) == ["results"]
    settings, numbers = rows["results"]
    assert settings["estimators.rnn.neurons"] == 4.0 and settings["boats"] == 2.0
    mae = np.mean([row["ensemble"]["mae"] for row in saved["boats"].values()])
    assert (
        numbers["8 results/1 MAE (m/s)"] == pytest.approx(mae)
        and next(x for tag, x in numbers.items() if tag.endswith(" seconds")) >= 60
    )
    log(tmp_path, fleet, model(), alone=False)
    assert not (tmp_path / "tensorboard").exists()


@pytest.mark.thorough
def test_log_all_writes_every_number_and_figure(tmp_path, fleet):
    ensemble = ensemble_of(short_season())
    log(tmp_path, fleet, ensemble, log="all")
    read = boards(tmp_path / "tensorboard")
    assert "9 all/drag_quadratic" in tags(read["heron1/aid"]) and "9 all/covariance_trace" in tags(read["heron1/arx"])
    assert "9 all/drag_linear (kg/s)" in tags(read["heron1/identified"])
    every = tags(read["heron1/ensemble"])
    assert {"9 all/weight_joint_at_30", "9 all/whiteness_aid", "9 all/MAE, 10 s ahead (m/s)",
            "9 all/coverage of 90 %, 30 s ahead"} < every  # fmt: skip
    assert {"runs", "forecasts", "identified curves"} <= {
        tag.partition("/")[2] for tag in read["heron2/ensemble"].Tags()["images"]
    }
    with pytest.raises(ConfigError, match="log: found 'al', expected one of main, all"):
        TensorBoardLogger(tmp_path, fleet, ensemble, log="al")


@pytest.mark.thorough
@pytest.mark.parametrize("stop", few([2, 3, 5, 8], [3], "thorough"))  # the first before any checkpoint
def test_a_resumed_run_has_every_point_once(tmp_path, fleet, stop):
    """Points after the last checkpoint are written again; TensorBoard keeps those that were written last."""
    log(tmp_path / "whole", fleet, model())
    log(tmp_path / "run", fleet, model(), stop=stop)
    time.sleep(1.0)  # TensorBoard reads a run's files in the order of the seconds at which they began
    log(tmp_path / "run", fleet, model(), resume="latest")
    expected, found = (boards(tmp_path / name / "tensorboard") for name in ("whole", "run"))
    assert list(found) == list(expected)
    for run, events in expected.items():
        for tag in events.Tags()["scalars"]:
            at = steps(found[run], tag)
            assert at == sorted(set(at)), (run, tag)
            assert at[-1] == steps(events, tag)[-1]
        assert len(found[run].Tags()["tensors"]) == len(events.Tags()["tensors"])
    assert texts(found["results"])["run/data"] == texts(expected["results"])["run/data"]


@pytest.mark.thorough
def test_a_boat_without_measured_speed_is_drawn_without_errors(tmp_path, fleet):
    blind = list(fleet.runs)
    for k, run in enumerate(blind):
        samples = run.samples._replace(measured=run.samples.measured & np.array([True, False]))
        blind[k] = run._replace(samples=samples)
    assert not any(masks(run.samples, PLAUSIBLE).learns[:, 1].any() for run in blind)
    with np.errstate(all="raise"):
        log(tmp_path, fleet._replace(runs=tuple(blind)), ensemble_of(short_season()), log="all")
    read = boards(tmp_path / "tensorboard")
    assert f"1 overview/{MAE}" not in tags(read["heron2/aid"]) and f"1 overview/{MAE}" in tags(read["fleet/aid"])
    assert " 0.0% |" in texts(read["results"])["run/data"]


@pytest.mark.thorough
def test_awkward_names_have_folders_of_their_own(tmp_path):
    """A boat that is called like the means of the fleet."""
    boats = align_fleet([recording(name, "one", 30.0) for name in ("fleet", "a:b", "a?b")])
    members = {"aid": AID(28.0), "persistence": Persistence()}
    log(tmp_path, boats, Ensemble(members))
    read = boards(tmp_path / "tensorboard")
    assert {run.partition("/")[0] for run in read} == {"fleet", "fleet_", "a_b", "a_b_", "results"}
    assert {run.partition("/")[2] for run in read if run.startswith("a_b_/")} == {"aid", "persistence", "average"}


def test_a_run_is_named_after_how_it_learns_not_after_its_data():
    channels = ["surge.name=speed", "command_left.name=pwm_l", "command_left.zero=1500", "command_right.span=-400"]
    csv = ["data=csv", "data.path=log.csv", "data.reader.time=t", *(f"data.channels.{each}" for each in channels)]
    beside = [
        "vehicle.mass=20",
        "vehicle.surge_max=3",
        "data.n=8",
        "data.hours=1",
        "+data.extra=1",
        "hydra/launcher=slurm",
    ]
    neurons = "estimators.rnn.neurons=20"
    assert label(what_differs([*csv, *beside, "sweep=rnn_size", "sweep.lanes=auto", neurons])) == "rnn.neurons=20"
    assert label(what_differs(["data.path={anna: logs/anna, bert: logs/bert}", neurons])) == "rnn.neurons=20"
    tree = "estimators.mine={_target_: a/b, gain: [1/2, 3]}"
    assert what_differs([tree, "database=x", "data.seed=3"]) == {
        "estimators.mine": "{_target_: a/b, gain: [1/2, 3]}",
        "database": "x",
        "data.seed": "3",
    }


def test_figures_rise_in_steps_and_every_boat_has_one(whole):
    """Their steps are distinct within a tag, after all points of the boat."""
    read, _, _ = whole
    for run, events in read.items():
        for tag in events.Tags()["images"]:
            places = [image.step for image in events.Images(tag)]
            points = [point.step for each in events.Tags()["scalars"] for point in events.Scalars(each)]
            assert places == sorted(set(places)) and places[0] > max(points), (run, tag)


def test_results_of_several_runs_have_one_column_each():
    without = {"boats": {"heron": {"rnn": {"mae": 0.1, "skill": 0.5}}}, "seconds": 3.0}
    whole = without | {"free": {"heron": {"rnn": 0.2}}, "network": {"heron": {"rnn": {"rate": 0.9}}}}
    tags = [{result_tag(title) for title in results_of(each, "rnn")} for each in (without, whole)]
    assert tags[0] < tags[1] and len({tag.split()[1] for tag in tags[1]}) == len(tags[1])


def test_tracks_have_the_error_of_their_last_steps_and_all_of_it_with_log_all(fleet, tmp_path):
    """Beside it that of a constant turn; nothing where too few became due, or no ellipse is known."""
    rng, parts, ensemble = np.random.default_rng(0), [], model()
    with TensorBoardLogger(tmp_path, fleet, ensemble, tracks=HORIZONS, log="all") as logger:
        for chunk in replay(ensemble, fleet, ensemble.init((2,)), every=50):
            due = np.abs(rng.standard_normal((chunk.end.step - chunk.begin.step, 2, len(HORIZONS), DUE)))
            due[rng.random(due.shape[:3]) > 1 / 3] = np.nan
            due[:, 1, 1] = np.nan
            due[:, 1, 0, RADIUS] = np.inf
            parts.append(due)
            logger.show(chunk._replace(published=chunk.published | {"tracks": due.reshape(len(due), 2, -1)}))
    read, whole = boards(tmp_path), np.concatenate(parts)
    assert len(whole) < 1.25 * 750  # so that the window is the whole run, or all but its first chunks
    for run, tag, column in (
        ("average", "1 overview/position error, 10 s ahead (m)", ERROR),
        ("persistence", "1 overview/position error, 10 s ahead (m)", CONSTANT),
        ("average", "9 all/heading error, 2 s ahead (rad)", HEADING_ERROR),
    ):
        k = HORIZONS.index(2.0 if "2 s" in tag else 10.0)
        low, high = sorted(np.nanmean(part[:, 0, k, column]) for part in (whole[-750:], whole))
        assert low - 1e-6 <= values(read[f"heron1/{run}"], tag)[-1] <= high + 1e-6
    inside = "9 all/coverage of the ellipses of 90 %, 2 s ahead"
    assert 0.3 < values(read["heron1/average"], inside)[-1] < 0.7  # both numbers are drawn alike
    other = tags(read["heron2/average"])
    assert inside not in other and "1 overview/position error, 10 s ahead (m)" not in other
    assert "9 all/position error, 2 s ahead (m)" in other
