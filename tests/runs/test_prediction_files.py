"""The files of predictions: used alone, of older versions, and read stretch by stretch."""

import json

import numpy as np
import pytest

from usvlearn import AID, Ensemble, Persistence
from usvlearn.errors import CheckpointError
from usvlearn.evaluation import metrics
from usvlearn.runs.prediction_files import PUBLISHED
from usvlearn.runs.replay import replay
from usvlearn.runs.run_folder import RunFolder


def session(path, fleet, resume=None) -> tuple[RunFolder, dict]:
    ensemble = Ensemble({"aid": AID(28.0), "persistence": Persistence()})
    folder = RunFolder(path, fleet, ensemble, {"estimators": 1})
    start = folder.begin(ensemble.init((len(fleet.boats),)), resume)
    with folder:
        for chunk in replay(ensemble, fleet, start.state, start.position, every=7, save_every=10):
            folder.save(chunk)
        return folder, folder.finish(0.0)


def test_a_run_is_scored_from_its_predictions_alone(tmp_path, fleet):
    _, saved = session(tmp_path, fleet)
    files = [dict(np.load(path)) for path in sorted((tmp_path / "predictions").glob("*.npz"))]  # without pickle
    names, units = files[0]["estimators"].tolist(), dict(files[0]["units"])
    assert units["measured_surge"] == units["predictions"] == "m/s" and units["time"] == "s"
    assert set(units) <= set(files[0])
    for element, boat in enumerate(files[0]["boats"].tolist()):
        runs = [file["runs"][element] for file in files]
        assert sorted({str(name) for name in runs if name}) == sorted({r.names[element] for r in fleet.runs} - {""})
        columns = ("time", "measured_surge", "predictions", "halfwidths", "dt", "fresh", "measured")
        time, surge, predictions, widths, dt, fresh, measured = (
            np.concatenate([file[key][:, element] for file in files]) for key in columns
        )
        assert measured[np.isfinite(surge)].all() and np.isfinite(surge).sum() > 10
        scored = metrics.scores(predictions, surge, names, widths)
        assert json.loads(json.dumps(scored)) == json.loads(json.dumps(saved["boats"][boat]))
        assert np.allclose(np.diff(time)[fresh[1:] & (dt[1:] > 0)], dt[1:][fresh[1:] & (dt[1:] > 0)])


def test_a_folder_of_an_older_version_is_gone_on_from(tmp_path, fleet):
    _, saved = session(tmp_path / "whole", fleet)
    session(tmp_path / "run", fleet)
    for path in sorted((tmp_path / "run" / "predictions").glob("*.npz"))[:3]:
        with np.load(path) as archive:
            older = {name: archive[name] for name in PUBLISHED if name in archive}
        np.savez_compressed(path, **older)
    for path in sorted((tmp_path / "run" / "predictions").glob("*.npz"))[3:]:
        path.unlink()
    _, again = session(tmp_path / "run", fleet, "latest")
    assert again | {"seconds": 0.0} == saved | {"seconds": 0.0}


def test_scores_do_not_depend_on_how_many_boats_are_judged_at_a_time(tmp_path, fleet, monkeypatch):
    folder, saved = session(tmp_path, fleet)
    monkeypatch.setattr(metrics, "AT_ONCE", 1)
    read, published = [], folder.published
    read_one = published.read
    monkeypatch.setattr(published, "read", lambda *place: read.append(place) or read_one(*place))
    assert metrics.fleet_scores(fleet, published, folder.ensemble.names) == saved["boats"]
    assert len(read) == len(fleet.boats) * len(published.places())


def test_a_file_of_more_steps_than_its_name_says_is_refused(tmp_path, fleet):
    folder, _ = session(tmp_path, fleet)
    run, step, end = folder.published.places()[0]
    with pytest.raises(CheckpointError, match=rf"it contains {end - step} steps, expected {end - step - 1}"):
        folder.published.read(run, step + 1, end)
