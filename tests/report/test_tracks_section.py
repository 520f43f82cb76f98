"""The section on tracks: its table, the tracks on the map and in the viewer, and runs that have none of them."""

import json
import math
import shutil
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from PIL import Image

from tests.support.pages import BAD, Page
from tests.support.runs import SETTINGS
from usvlearn import Ensemble, ForecastSettings, JointEKF, Online, Persistence, Planar
from usvlearn.core.samples import Inputs, PlanarSample, Sample
from usvlearn.engine.validate import read_checkpoint
from usvlearn.evaluation.free_simulation import free_runs
from usvlearn.logs.recordings import align_fleet
from usvlearn.report.animation import write_animation
from usvlearn.report.page import write_report
from usvlearn.report.sections.tracks import RECKONED, _outline, chosen, tracks_section
from usvlearn.report.track_maps import Ahead, Ellipse, saved_tracks
from usvlearn.report.viewer import embedded, viewer_data
from usvlearn.runs.replay import replay
from usvlearn.runs.run_folder import RunFolder
from usvlearn.runs.saved import read_seasons, results
from usvlearn.simulate.planar_fleet import planar_fleet

BOAT, DT = "planar", 0.4


class Made(NamedTuple):
    """A run of one boat, two missions of four minutes."""

    folder: Path
    ensemble: Ensemble
    fleet: object
    seasons: list

    def tracks(self, folder=None, fleet=None):
        folder = folder or self.folder
        return saved_tracks([folder], [results(folder)], self.seasons, [fleet or self.fleet])


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Made:
    folder = tmp_path_factory.mktemp("tracked")
    fleet = align_fleet(list(planar_fleet(hours=8 / 60, mission_minutes=4.0)), dt=DT)
    ensemble = Ensemble(
        {"joint": JointEKF(surge_max=2.7), "persistence": Persistence()}, forecasts=ForecastSettings(horizons=[2.0])
    )
    planar = Planar(ensemble, surge_max=2.7, horizons=(2.0, 5.2, 30.0))
    run = RunFolder(folder, fleet, ensemble, SETTINGS["configuration"], planar)
    start = run.begin(ensemble.init((1,)), None)
    with run:
        for chunk in replay(ensemble, fleet, start.state, start.position, planar=planar):
            run.save(chunk)
        run.finish(time.perf_counter())
    return Made(folder, ensemble, fleet, read_seasons([folder], ensemble, [fleet]))


@pytest.mark.thorough
def test_the_table_has_the_scores_of_the_run(made):
    section = tracks_section(made.tracks())
    (sheet,) = section.sheets
    rows = [dict(zip(sheet.columns, row, strict=True)) for row in sheet.rows]
    scores = results(made.folder)["tracks"][BOAT]
    assert [row["horizon, s"] for row in rows] == [2.0, 5.2, 30.0]
    for row, expected in zip(rows, scores.values(), strict=True):
        assert row["position error, m"] == expected["position"] and row["constant turn, m"] > expected["position"]
        assert row["held yaw rate, m"] == expected["position_held_rate"]
        assert row["heading error, °"] == pytest.approx(math.degrees(expected["heading"]))
        assert row["inside the ellipses"] == expected["inside"] and row["tracks"] == expected["count"]
        assert (row["commands stay"], row["move"]) == (expected["inside_stay"], expected["inside_move"])
    assert f"{scores['2']['position']:.2f} m at 2 s (constant turn" in section.here[0]


@pytest.mark.thorough
def test_an_animation_has_a_frame_for_each_track(made, tmp_path):
    mission = made.tracks()[BOAT].mission
    path = write_animation(tmp_path / "a.gif", mission._replace(ahead=mission.ahead[:3]), "$5 boat")
    with Image.open(path) as picture:
        assert picture.n_frames == 3 and picture.size == (720, 368)
    assert list(tmp_path.iterdir()) == [path]


def test_the_tracks_are_those_that_the_boat_would_have_forecast_then(made):
    """Beside a boat that is stepped by hand, and beside the positions that came."""
    mission = made.tracks()[BOAT].mission
    run, poses = made.fleet.runs[-1], made.fleet.runs[-1].poses[:, 0]
    path = made.folder / "planar" / "checkpoints" / BOAT / "00000_0000601.safetensors"
    online, at, errors = Online.of(*read_checkpoint(path)), {each.step: each for each in mission.ahead}, []
    assert len(at) >= 20 and all(np.diff([run.time[k, 0] for k in at]) >= 10 - 1e-6)
    for k in range(max(at) + 1):
        inputs, *rest = (x[k, 0] if not isinstance(x, tuple) else Inputs(*(y[k, 0] for y in x)) for x in run.samples)
        online.step(PlanarSample(Sample(inputs, *rest), *poses[k]))
        if (each := at.get(k)) is not None:
            n = len(each.time)
            commands = np.stack([x[k + 1 : k + 1 + n, 0] for x in run.samples.inputs[:2]], -1)
            track = online.forecast(commands, dt=DT)
            assert np.array_equal(each.north, track.north) and np.array_equal(each.east, track.east)
            assert [e.horizon for e in each.ellipses] == [h for h in (2.0, 5.2, 30.0) if h <= n * DT + 1e-6]
            assert each.ellipses[1].major == track.ellipse(0.9)[0][12]  # the end of 13 steps of 0.4 s
            here = poses[k + 13, 3:] - poses[k, 3:]
            errors.append(math.hypot(here[0] - each.north[12], here[1] - each.east[12]))
    assert 0 < np.mean(errors) < 2 * results(made.folder)["tracks"][BOAT]["5.2"]["position"]
    assert not mission.learned and mission.logged and mission.run.name == run.names[0]


def test_a_checkpoint_that_has_learned_from_the_mission_is_used_where_there_is_no_other_and_it_is_said(made, tmp_path):
    assert "that had not learned from it" in tracks_section(made.tracks()).figures[1].caption
    folder = shutil.copytree(made.folder, tmp_path / "run")
    (folder / "planar" / "checkpoints" / BOAT / "00000_0000601.safetensors").unlink()
    tracks = made.tracks(folder)
    assert tracks[BOAT].mission.learned and tracks[BOAT].mission.ahead
    assert "That checkpoint has learned from this mission" in tracks_section(tracks).figures[1].caption


@pytest.mark.thorough
def test_the_page_shows_table_figures_and_map_and_every_name_is_escaped(made, tmp_path):
    track, name = made.tracks()[BOAT], BAD.replace("/", "_") + r"$\frac{$"
    mission = track.mission._replace(run=track.mission.run._replace(name=name))
    section = tracks_section({name: track._replace(mission=mission)})
    text = write_report(tmp_path / "report", [], [section]).read_text()
    page = Page(text)
    assert {path.stem for path in (tmp_path / "report" / "figures").glob("*.svg")} == {"tracks", f"tracks_{name}"}
    assert {tag for tag, _ in page.tags} & {"img", "script"} == set() and ("svg" in {tag for tag, _ in page.tags})
    assert [row[0] for row in page.rows[1:]] == [name] * 3 and '<div id="tracks">' in text
    assert "that had not learned from it" in text and RECKONED not in text


def test_positions_that_were_not_logged_are_said_to_be_reckoned(made):
    runs = tuple(run._replace(position=None) for run in made.fleet.runs)
    seasons = [s._replace(runs=tuple(run._replace(position=None) for run in s.runs)) for s in made.seasons]
    tracks = saved_tracks([made.folder], [results(made.folder)], seasons, [made.fleet._replace(runs=runs)])
    assert RECKONED in tracks_section(tracks).figures[1].caption


def test_runs_without_tracks_have_no_section(made, tmp_path):
    assert saved_tracks([tmp_path], [{}], made.seasons, [made.fleet]) == {}
    assert saved_tracks([made.folder], [{"boats": {}}], made.seasons, [made.fleet]) == {}
    nothing = {"tracks": {BOAT: {"2": {"count": 0}}}}
    assert saved_tracks([made.folder], [nothing], made.seasons, [made.fleet]) == {}
    assert tracks_section({}) is None
    without = made.fleet._replace(runs=tuple(run._replace(poses=None) for run in made.fleet.runs))
    section = tracks_section(made.tracks(fleet=without))
    assert len(section.figures) == 1 and len(section.sheets[0].rows) == 3


@pytest.mark.parametrize("damage", ["none", "cut"])
def test_without_a_readable_checkpoint_there_is_no_map_and_it_says_why(made, tmp_path, damage):
    folder = shutil.copytree(made.folder, tmp_path / "run")
    for path in (folder / "planar" / "checkpoints" / BOAT).iterdir():
        path.unlink() if damage == "none" else path.write_bytes(path.read_bytes()[:1000])
    section = tracks_section(made.tracks(folder))
    assert [drawn.name for drawn in section.figures] == ["tracks"]
    (said,) = (each for each in section.here if "there is no map" in each)
    assert said.startswith(f"{BOAT}: ") and ("no checkpoint of planar" in said or "damaged" in said or "read" in said)


def test_the_viewer_has_the_tracks_of_the_last_mission_at_its_positions(made):
    (season,) = made.seasons
    free = {BOAT: list(free_runs(made.ensemble, season))}
    tracks = made.tracks()
    first, last = viewer_data(made.ensemble, made.seasons, free, tracks)["runs"]
    assert "ahead" not in first and len(last["ahead"]) == len(tracks[BOAT].mission.ahead)
    assert all("ahead" not in run for run in viewer_data(made.ensemble, made.seasons, free)["runs"])
    for shown, each in zip(last["ahead"], tracks[BOAT].mission.ahead, strict=True):
        origin = season.runs[-1].position[each.step]
        assert (shown["north"][0], shown["east"][0]) == pytest.approx(tuple(origin), abs=0.006)
        assert shown["north"][-1] - origin[0] == pytest.approx(each.north[-1], abs=0.006)
        for (horizon, k, major, minor, _), ellipse in zip(shown["ellipses"], each.drawn, strict=True):
            assert horizon == ellipse.horizon and (major, minor) == pytest.approx(ellipse[2:4], abs=0.006)
            assert shown["east"][k] - origin[1] == pytest.approx(each.east[ellipse.step], abs=0.006)
    assert len(json.loads(embedded(last["ahead"]))) == len(last["ahead"])  # an infinite number would raise an error


def ahead(step: int, turn: float, known: int = 1) -> Ahead:
    straight = np.arange(1.0, 6.0)
    ellipses = (Ellipse(5.0, 4, 2.0 if known else math.inf, 1.0, 0.3),)
    return Ahead(step, straight, straight, 0 * straight, turn, ellipses)


def test_the_tracks_of_a_map_are_spread_and_turn():
    turns = np.random.default_rng(0).permutation(60) / 60
    every = [ahead(k, turns[k]) for k in range(60)]
    some = chosen(every, 6)
    assert [each.step // 10 for each in some] == list(range(6))
    assert [each.turn for each in some[::2]] == [max(turns[a : a + 10]) for a in (0, 20, 40)]
    assert all(each.step >= 30 for each in chosen([ahead(k, 0.0, k >= 30) for k in range(60)], 6))
    assert len(chosen(every[:2], 6)) == 2


def test_an_outline_is_that_of_its_ellipse():
    """Along the bearing it reaches the major semi-axis, and across it the minor; all points solve its equation."""
    one = ahead(0, 0.0)
    (ellipse,) = one.ellipses
    away = _outline(one, ellipse) - [5.0, 0.0]
    turned = away @ [[math.cos(0.3), -math.sin(0.3)], [math.sin(0.3), math.cos(0.3)]]
    assert turned.max(0) == pytest.approx([2.0, 1.0])
    assert ((turned / [2.0, 1.0]) ** 2).sum(-1) == pytest.approx(1.0)
    assert one.drawn == [ellipse] and one._replace(ellipses=(ellipse._replace(major=5.1),)).drawn == []


def test_a_run_that_is_not_finished_has_a_map_without_scores(made):
    tracks = saved_tracks([made.folder], [{}], made.seasons, [made.fleet])
    section = tracks_section(tracks)
    assert [drawn.name for drawn in section.figures] == [f"tracks_{BOAT}"] and section.sheets == []
    assert f"{BOAT}: its run is not finished, so that its tracks have no scores yet." in section.here
