"""A line for each job of a sweep, from what the jobs write."""

import json
import re
import time
from pathlib import Path

from usvlearn.sweeps.jobs import SweepNote
from usvlearn.sweeps.progress import Progress

NOTE = SweepNote(("estimators.rnn.neurons",))
JOBS = [{"estimators.rnn.neurons": f"{k}", "data.hours": "1"} for k in (4, 9, 20, 40)]


def write(folder: Path, k: int, results: dict | str) -> None:
    (folder / f"{k}").mkdir(exist_ok=True)
    text = results if isinstance(results, str) else json.dumps(results)
    (folder / f"{k}" / "results.json").write_text(text)


def good(mae: float) -> dict:
    return {"boats": {"heron": {"rnn": {"mae": mae}}}, "output": "ensemble", "objective": 0.5, "seconds": 2.25}


def test_what_happens_is_told_once(tmp_path):
    write(tmp_path, 0, good(0.1))
    write(tmp_path, 1, {"error": "of an earlier time"})
    said: list[str] = []
    watched = Progress(tmp_path, JOBS, NOTE, said.append)
    watched.start()
    assert said == [f"4 jobs, 1 of them finished before: {tmp_path}"]
    time.sleep(0.05)  # so that files have other times
    (tmp_path / "1" / "results.json").unlink()
    for k in (1, 2):
        (tmp_path / f"{k}").mkdir(exist_ok=True)
        (tmp_path / f"{k}" / "job.json").write_text("{}")
    write(tmp_path, 1, good(0.03125))
    watched._look()
    watched._look()
    (line,) = said[1:]
    expected = r"job 1 \(rnn\.neurons=9\): 0\.0312 m/s, 2\.2 s; 2 of 4 done, 1 running, \d+ s left"
    assert re.fullmatch(expected, line), line
    write(tmp_path, 3, {"error": "estimators.rnn.neurons: found 40\x1b[31m"})
    write(tmp_path, 2, {"partial": {"steps": 3}})  # it was stopped
    watched.stop()
    assert len(said) == 3 and said[2].startswith("job 3 (rnn.neurons=40): failed: estimators.rnn.neurons: found 40")
    assert "\x1b" not in said[2] and "2 of 4 done, 1 failed" in said[2]


def test_a_job_is_named_by_its_own_note(tmp_path):
    """Hydra shuffles values anew when it starts the jobs."""
    write(tmp_path, 1, good(0.1))
    (tmp_path / "1" / "job.json").write_text('{"settings": "x", "overrides": ["estimators.rnn.neurons=77"]}')
    said: list[str] = []
    watched = Progress(tmp_path, JOBS, NOTE, said.append)
    watched._tell(1, good(0.1))
    assert said[0].startswith("job 1 (rnn.neurons=77): 0.1000 m/s")


def test_damaged_results_are_no_news(tmp_path):
    said: list[str] = []
    watched = Progress(tmp_path, JOBS, NOTE, said.append)
    for text in ("", "[1]", '{"boats"', "3"):
        write(tmp_path, 0, text)
        watched._look()
    assert said == []


def test_a_job_that_failed_before_and_succeeds_now_is_told(tmp_path):
    write(tmp_path, 2, {"error": "bad"})
    said: list[str] = []
    watched = Progress(tmp_path, JOBS, NOTE, said.append)
    watched._look()
    assert said == []
    time.sleep(0.05)
    write(tmp_path, 2, good(0.2))
    watched._look()
    assert len(said) == 1 and said[0].startswith("job 2 (rnn.neurons=20): 0.2000 m/s")
