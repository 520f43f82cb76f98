"""A run's logs as missions to fit: what is refused."""

import warnings

import numpy as np
import pytest

from tests.support.fitted_boats import log
from tests.support.strangers import sail
from usvlearn.core.prepared_samples import HOLD, LEARN, MODE
from usvlearn.errors import ConfigError
from usvlearn.logs.channels.channel import Channel, Recording
from usvlearn.logs.recordings import align_fleet
from usvlearn.model.fit.logs import fine, missions_of, without_losses


def missions(speed: str):
    boat = sail(6)
    named = {"command_left": boat["l"], "command_right": boat["r"], "heading": boat["psi"], "surge": boat[speed]}
    order = np.arange(len(boat["time"]))
    channels = {name: Channel(boat["time"], value, order, window=1.0) for name, value in named.items()}
    with warnings.catch_warnings(action="ignore"):
        return missions_of(align_fleet([Recording("a", "1", channels, {})], **fine({})), "a")


def test_minutes_astern_whose_speed_has_no_sign_are_refused():
    with pytest.raises(ConfigError, match=r"a: found 0\.\d min in which both commands push astern"):
        missions("sog")
    assert missions("u")


def event(kind: str, time: float, run: str, side: str = "left") -> dict:
    return {"kind": kind, "time": time, "run": run, "side": side}


def test_what_a_run_has_found_of_lost_thrust_is_left_out(capsys):
    logs = {name: log(3000, k) for k, name in enumerate("abc")}
    cut = without_losses("heron", logs, [event("loss", 100.0, "a"), event("recovery", 200.0, "b")])
    assert (cut["b"][:2000, MODE] == HOLD).all() and (cut["b"][2000:] == logs["b"][2000:]).all()
    assert (cut["a"][:400] == logs["a"][:400]).all() and (cut["a"][400:, MODE] == HOLD).all()
    assert (cut["c"] == logs["c"]).all() and (logs["a"][2000:, MODE] == LEARN).all()
    assert "heron: the left thruster lost thrust at 100 s of a" in " ".join(capsys.readouterr().err.split())
    same = without_losses("heron", logs, [event("change", 5.0, "a", ""), event("recovery", 5.0, "a")])
    assert capsys.readouterr().err == "" and all((same[name] == logs[name]).all() for name in logs)
    split = [event("loss", 100.0, "a", "both"), *(event("recovery", 200.0, "b", side) for side in ("right", "left"))]
    both = without_losses("heron", logs, split)
    assert all((both[name] == cut[name]).all() for name in logs) and "the boat lost thrust" in capsys.readouterr().err
    with pytest.raises(ConfigError, match=r"found 389 measured steps with both thrusters whole, expected at least 600"):
        without_losses("heron", {"a": logs["a"]}, [event("loss", 99.0, "a")])
