"""Tracks in TensorBoard: curves over the last steps, scores of the whole run, and neither where there are none."""

import numpy as np
import pytest

from tests.support.boards import boards, tags, values
from tests.support.configured import short_season
from tests.support.runs import model
from usvlearn import AID, Ensemble
from usvlearn.cli.settings import instantiate
from usvlearn.estimators.planar.state import CONSTANT, DUE, ERROR, HEADING_ERROR, HELD_RATE, RADIUS, RHO
from usvlearn.evaluation.tracks import track_scores
from usvlearn.logs.recordings import align_fleet
from usvlearn.runs.published import Published, widths_of
from usvlearn.runs.replay import replay
from usvlearn.runs.tensorboard.logger import TensorBoardLogger

HORIZONS = (2.0, 5.2)
NEAR, FAR = "position error, 2 s ahead (m)", "position error, 5.2 s ahead (m)"
INSIDE = "coverage of the ellipses of 90 %, 2 s ahead"


@pytest.fixture(scope="module")
def fleet():
    return align_fleet(instantiate(short_season()["data"]), **short_season()["align"])


def drawn(steps: int, boats: int, rng: np.random.Generator) -> np.ndarray:
    """Tracks that became due in a third of the steps, `(steps, boats, 16)`; nothing of the second boat to 5.2 s."""
    due = np.abs(rng.standard_normal((steps, boats, len(HORIZONS), DUE)))
    due[rng.random((steps, boats, len(HORIZONS))) > 1 / 3] = np.nan
    due[:, 1, 1] = np.nan
    return due.reshape(steps, boats, -1)


def log(folder, fleet, ensemble, tracked: bool, horizons=HORIZONS, **more):
    """Replay with published tracks that are drawn; returns them."""
    rng, parts = np.random.default_rng(0), []
    logger = TensorBoardLogger(folder, fleet, ensemble, tracks=horizons, **more)
    logger._draw = lambda *_: None  # figures, which need what was published
    with logger:
        for chunk in replay(ensemble, fleet, ensemble.init((len(fleet.boats),)), every=50):
            if tracked:
                parts.append(drawn(chunk.end.step - chunk.begin.step, len(fleet.boats), rng))
                chunk.published["tracks"] = parts[-1]
            logger.show(chunk)
        scores = track_scores(parts, HORIZONS, fleet.boats) if tracked else None
        none = Published(folder, [len(run.time) for run in fleet.runs], 2, widths_of(ensemble.names, None, ()))
        logger.finish(short_season(), {"boats": {}, "events": {}, "tracks": scores, "output": "average"}, none)
    return np.concatenate(parts) if parts else np.empty(0), scores


def test_curves_are_means_over_the_last_steps(fleet, tmp_path):
    rows, scores = log(tmp_path, fleet, model(), True)
    read = boards(tmp_path)
    last = rows[-750:].reshape(-1, 2, 2, DUE)
    assert len(rows) < 1.25 * 750  # so that the window is the whole run, or all but its first chunks
    whole = rows.reshape(-1, 2, 2, DUE)
    for element, boat in enumerate(fleet.boats):
        own, baseline = read[f"{boat}/average"], read[f"{boat}/persistence"]
        low, high = sorted([np.nanmean(part[:, element, 0, ERROR]) for part in (last, whole)])
        assert low - 1e-6 <= values(own, f"1 tracks/{NEAR}")[-1] <= high + 1e-6
        low, high = sorted([np.nanmean(part[:, element, 0, CONSTANT]) for part in (last, whole)])
        assert low - 1e-6 <= values(baseline, f"1 tracks/{NEAR}")[-1] <= high + 1e-6
        assert 0.3 < values(own, f"1 tracks/{INSIDE}")[-1] < 0.7  # both numbers are drawn alike
        assert values(own, f"8 results/{NEAR}") == pytest.approx([scores[boat]["2"]["position"]])
        assert values(own, f"8 results/{INSIDE}") == pytest.approx([scores[boat]["2"]["inside"]])
        assert (f"1 tracks/{FAR}" in tags(own)) == (element == 0) == (f"8 results/{FAR}" in tags(own))
    both = [values(read[f"{boat}/average"], f"1 tracks/{NEAR}")[-1] for boat in fleet.boats]
    assert values(read["fleet/average"], f"1 tracks/{NEAR}")[-1] == pytest.approx(np.mean(both))
    assert "measured position" in own.SummaryMetadata(f"1 tracks/{NEAR}").summary_description
    shown = {tag for events in read.values() for tag in tags(events) if "ahead" in tag}
    assert len(shown) == 8 and not any(tag.startswith("9 all/") for tag in shown)


def test_everything_has_heading_and_baselines_without_a_member_that_persists(fleet, tmp_path):
    rows, scores = log(tmp_path, fleet, Ensemble({"aid": AID(28.0)}), True, log="all", alone=False)
    own = boards(tmp_path)[f"{fleet.boats[0]}/average"]
    whole = rows.reshape(-1, 2, 2, DUE)[:, 0, 0]
    for name, unit, column in (
        ("position error of a constant turn", " (m)", CONSTANT),
        ("position error with held yaw rate", " (m)", HELD_RATE),
        ("heading error", " (rad)", HEADING_ERROR),
    ):
        assert values(own, f"9 all/{name}, 2 s ahead{unit}")[-1] == pytest.approx(np.nanmean(whole[:, column]), rel=0.1)
        assert values(own, f"8 results/{name}, 2 s ahead{unit}") == pytest.approx([np.nanmean(whole[:, column])])
    assert values(own, "8 results/tracks, 2 s ahead") == [scores[fleet.boats[0]]["2"]["count"]]


def test_few_tracks_and_unknown_ellipses_make_no_point(fleet, tmp_path):
    logger = TensorBoardLogger(tmp_path, fleet, model(), tracks=HORIZONS)
    due = np.full((100, 2, 2, DUE), np.nan)
    due[:9, 0, 0] = 1.0  # too few
    due[:50, 1, 0] = 1.0
    due[:50, 1, 0, RADIUS] = np.inf  # not known yet
    due[:50, 1, 0, RHO] = np.nan
    with logger:
        for chunk in replay(logger.ensemble, fleet, logger.ensemble.init((2,)), every=100):
            part = due[: chunk.end.step - chunk.begin.step].reshape(-1, 2, 16)
            logger.show(chunk._replace(published=chunk.published | {"tracks": part}))
            break
        logger._write()
    read = boards(tmp_path)
    assert f"1 tracks/{NEAR}" not in tags(read[f"{fleet.boats[0]}/average"])
    assert INSIDE not in {tag.partition("/")[2] for tag in tags(read[f"{fleet.boats[1]}/average"])}


def test_a_run_without_tracks_has_no_tags_of_them(fleet, tmp_path):
    log(tmp_path, fleet, model(), False, horizons=())
    assert not {tag for events in boards(tmp_path).values() for tag in tags(events) if "ahead" in tag}
