"""Log files that tests write, one channel of a log, and the message with which a call refuses one."""

from pathlib import Path

import numpy as np
import pytest
from hydra.utils import instantiate
from omegaconf import OmegaConf

from tests.support import ROOT
from usvlearn.logs.channels.channel import Source


def write(path: Path, text: str, encoding: str = "utf-8") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(text.encode(encoding, "surrogateescape"))
    return path


def refused(error, function, *args, **kwargs) -> str:
    """The one-line message with which a call fails."""
    with pytest.raises(error) as caught:
        function(*args, **kwargs)
    message = str(caught.value)
    assert "\n" not in message and len(message) < 600
    return message


def one(reader, path, name, field=None, **how):
    """The channel `surge` of a log, and what was dropped of it."""
    channels, dropped = reader.read(path, {"surge": Source(name, field, **how)})
    return channels["surge"], dropped["surge"]


def assert_same_as_read(reader, path: Path, series, parts=("time", "value")) -> None:
    """Every series is that channel which its name and field declare."""
    assert series
    for each in series:
        channel, _ = one(reader, path, each.name, each.field)
        usable = np.isfinite(each.value)
        assert each.time.dtype == each.value.dtype == np.float64 and each.order.dtype == np.int64
        for part in parts:
            np.testing.assert_array_equal(getattr(channel, part), getattr(each, part)[usable])


def configured(name: str, path: Path) -> list:
    """The recordings that `data=NAME data.path=PATH` reads."""
    config = OmegaConf.load(ROOT / "configs" / "data" / f"{name}.yaml").data
    config.path = str(path)
    return instantiate(config)
