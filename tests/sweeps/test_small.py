"""Small functions of sweeps and of the report's words, by hand."""

from pathlib import Path

import torch

from usvlearn import RNN, Ensemble
from usvlearn.report.sections.network import free_words, stability
from usvlearn.report.tables import event_lines, short_settings
from usvlearn.sweeps.jobs import noted_sweep
from usvlearn.sweeps.leaderboard import last_lines, shortened
from usvlearn.sweeps.progress import duration


def test_words_of_a_sweep():
    assert (duration(42.3), duration(125), duration(7300)) == ("42 s", "2 min", "2.0 h")
    assert (shortened("mean"), shortened("/a/long/path/of/a.log")) == ("mean", "…g/path/of/a.log")
    assert short_settings({"estimators.aid.gain": "3", "align.dt": "0.4"}, ["estimators.aid.gain"]) == "aid.gain=3"
    assert last_lines(Path("multirun/gain"), ["leaderboard.csv"])[0] == "files        multirun/gain: leaderboard.csv"
    assert noted_sweep(Path("nowhere")) == ((), {}, None)


def test_words_of_a_run():
    loss = {"run": "7", "time": 12.0, "kind": "loss", "side": "left", "effectiveness": 0.4, "low": 0.3, "high": 0.5}
    assert event_lines({"heron": [loss], "otter": []}) == [
        "", "ALARM: heron, run 7, 12 s: the left thruster gives 40 % of its thrust (30 ... 50 %)",
    ]  # fmt: skip
    assert free_words("rnn", {"rnn": 0.17, "all": 0.16}, "all") == "open-loop simulations err by 0.170 m/s (all 0.160)"
    far = free_words("rnn", {"rnn": 0.6, "all": 0.1, "persistence": 0.5}, "all")
    assert far.endswith("are far off: they err by 0.600 m/s (all 0.100, persistence 0.500)")
    ensemble = Ensemble({"rnn": RNN(surge_max=2.7)})
    with torch.no_grad():
        (line,) = stability(ensemble, ensemble.init((1,)), ["heron"])
    assert line.startswith("rnn of heron: certified contracting by exact, K")
