"""Arrays in place of logs: the same samples as from a file, and one sentence for what is wrong, without numbers."""

import numpy as np
import pytest

import usvlearn
from tests.support import few
from tests.support.exported import write_table
from tests.support.files import refused
from usvlearn.core.samples import named_leaves
from usvlearn.errors import ConfigError, LogFormatError

T = np.arange(0, 120, 0.1)
WAVE = np.sin(T / 9)
SI = {"command_left": 0.5 + 0.4 * WAVE, "command_right": 0.5 - 0.3 * WAVE, "heading": 0.05 * T, "surge": 1 + 0.5 * WAVE}
ALL = {"time": T, **SI}


class Frame:
    """The part of a pandas.DataFrame that is used."""

    def __init__(self, columns):
        self._columns = columns

    columns = property(lambda self: list(self._columns))

    def __getitem__(self, name):
        return self._columns[name]


def same(one, other, error=0.0) -> bool:
    pairs = zip(named_leaves(one.runs[0].samples), named_leaves(other.runs[0].samples), strict=True)
    return all(np.allclose(a, b, rtol=0, atol=error, equal_nan=True) for (_, a), (_, b) in pairs)


@pytest.mark.thorough
def test_arrays_give_the_samples_of_a_file(tmp_path):
    holes = SI | {"surge": np.where(np.arange(len(T)) % 7, SI["surge"], np.nan)}
    cells = {name: ["" if np.isnan(x) else repr(float(x)) for x in values] for name, values in holes.items()}
    path = write_table(tmp_path / "a.csv", {"time": T, **cells})
    from_file = usvlearn.read(path, channels={"heading": {"unit": "rad"}})
    logs = usvlearn.read(time=T, **holes)
    assert same(from_file, logs) and logs.boats == ("boat",) and logs.runs[0].name == "arrays"
    assert logs.rejected["boat"]["surge"]["empty"] == from_file.rejected["a"]["surge"]["empty"]


@pytest.mark.thorough
def test_a_dictionary_and_a_table_with_units_give_the_same():
    logs = usvlearn.read(**ALL)
    assert same(logs, usvlearn.read(ALL))
    raw = {
        "stamp": T * 1e3, "L": 100 * SI["command_left"], "R": 1500 + 400 * SI["command_right"],
        "psi": np.degrees(SI["heading"]), "v": SI["surge"] * 3600 / 1852, "note": np.array(["x"] * len(T)),
    }  # fmt: skip
    channels = {
        "command_left": {"name": "L", "unit": "percent"}, "command_right": {"name": "R", "zero": 1500, "span": 400},
        "heading": {"name": "psi"}, "surge": {"name": "v"},
    }  # fmt: skip
    units = {"time": "ms", "heading": "deg", "surge": "knots"}
    table = usvlearn.read(Frame(raw), time="stamp", units=units, channels=channels, boat="otter")
    (left, right) = (each.runs[0].columns for each in (logs, table))
    assert table.boats == ("otter",) and all(
        left[name] == pytest.approx(right[name], abs=1e-9, nan_ok=True) for name in left
    )


def test_a_real_table_of_pandas():
    pandas = pytest.importorskip("pandas", reason="needs the package pandas")
    logs = usvlearn.read(**ALL)
    stamps = pandas.to_datetime(T, unit="s")
    frame = pandas.DataFrame(ALL | {"time": stamps, "surge": pandas.array(SI["surge"], "Float64")})
    assert same(logs, usvlearn.read(frame), 1e-9)
    for index in (pandas.Index(T), stamps, stamps.tz_localize("UTC")):
        assert same(logs, usvlearn.read(pandas.DataFrame(SI, index=index.rename("time"))), 1e-6)


@pytest.mark.thorough
def test_date_times_lists_forces_and_derived_speeds():
    logs = usvlearn.read(**ALL)
    stamps = np.datetime64("2025-07-24") + (T * 1e9).round().astype("timedelta64[ns]")
    assert same(logs, usvlearn.read(**ALL | {"time": stamps, "heading": list(SI["heading"])}), 1e-9)
    wrench = {"X": 100 * WAVE, "N": 20 * WAVE, **{k: ALL[k] for k in ("time", "heading")}}
    mixed = {"name": ["X", "N"], "unit": ["N", "N·m"], "span": [400, 80]}
    sides = {f"command_{side}": mixed | {"weight": [1, way]} for side, way in (("left", 1), ("right", -1))}
    turned = {"velocity_north": np.cos(0.05 * T), "velocity_east": np.sin(0.05 * T)}
    columns = usvlearn.read(wrench | turned, channels=sides).runs[0].columns
    assert np.abs(columns["command_right"]).max() < 1e-9 < np.abs(columns["command_left"]).max() < 0.51
    assert np.nanmedian(columns["surge"]) == pytest.approx(1)


@pytest.mark.thorough
def test_windows_follow_the_times_and_whole_seconds_are_spread():
    slow = {name: values[::5] for name, values in ALL.items()}
    with pytest.warns(UserWarning, match="whole seconds, with 2 values each"):
        logs = usvlearn.read(**slow | {"time": np.floor(slow["time"])})
    assert same(logs, usvlearn.read(**slow)) and logs.setups["boat"].channels["surge"].window == "auto"


def test_arrays_as_programs_give_them():
    holes = np.arange(len(T)) % 7 == 0
    late = np.datetime64("2300-01-01", "us") + (T * 1e6).round().astype("m8[us]")
    column = {name: values[:, None] for name, values in ALL.items()}  # as of MATLAB
    logs = usvlearn.read(**ALL)
    for changes in (column, {"time": late}, {"time": np.round(1000 * T - 50e3) % 2**32, "units": {"time": "ms"}}):
        assert same(logs, usvlearn.read(**ALL | changes), 1e-9)
    logs = usvlearn.read(**ALL | {"surge": np.where(holes, np.nan, SI["surge"])})
    gaps = [None if hole else float(x) for hole, x in zip(holes, SI["surge"], strict=True)]
    for surge in (gaps, np.ma.masked_array(SI["surge"], holes)):
        assert same(logs, usvlearn.read(**ALL | {"surge": surge}), 1e-12)
    logs = usvlearn.read(**ALL | {"time": np.where(holes, np.nan, T)})
    for time in (
        np.ma.masked_array(late, holes),
        [None if hole else each for hole, each in zip(holes, late.tolist(), strict=True)],
    ):
        assert same(logs, usvlearn.read(**ALL | {"time": time}), 1e-6)
    with pytest.raises(ConfigError, match="mode: found text, expected numbers"):
        usvlearn.read(ALL | {"mode": ["x"] * len(T)}, channels={"surge": {"name": "mode"}})


BAD = {
    "length": ({"surge": T[:5]}, "surge: found 5 values, expected 1200, one for each of time"),
    "text": ({"surge": np.array(["1"] * len(T))}, "surge: found text, expected numbers"),
    "object": ({"surge": np.array([object()] * len(T))}, "surge: found objects, expected numbers"),
    "shape": ({"surge": np.c_[T, T]}, r"surge: found an array of shape \(1200, 2\)"),
    "scalar": ({"surge": 1.0}, r"surge: found an array of shape \(\)"),
    "falling": ({"time": T[::-1]}, "time: found stamps that fall"),
    "nanoseconds": ({"time": (1e9 * T).astype(np.int64)}, r"stamps 1e\+08 s apart.*give units=\{'time': 'ns'\}"),
    "days": ({"time": np.datetime64("2025-01-01") + np.arange(len(T))}, r"stamps 8.64e\+04 s apart"),
    "days as seconds": ({"time": 45446 + T / 86400}, r"stamps 1.16e-06 s apart.*give units=\{'time': 'days'\}"),
    "no time": ({"time": T * np.nan}, "time: found 1200 values and no finite one"),
    "absent": ({"heading": None}, "heading: found no such array among time, command_left"),
    "unknown": ({"speed": T}, r"speed: found ndarray of shape \(1200,\)"),
    "unit": ({"units": {"surge": "Mach"}}, "surge.unit: found 'Mach', expected one of 1, m/s"),
    "time unit": ({"units": {"time": "week"}}, "units.time: found 'week', expected one of s, ms"),
    "unit of none": ({"units": {"speed": "m/s"}}, "units: found 'speed'"),
    "data": ({"data": "alog"}, "data: found 'alog' beside arrays"),
    "path": ({"path": "a.csv"}, "found values beside a path"),
    "array as path": ({"path": T}, r"path: found ndarray of shape \(1200,\)"),
    "channel": ({"channels": {"sugre": {"unit": "m/s"}}}, "found 'sugre'"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_what_is_wrong_is_one_sentence_without_numbers(name):
    changes, text = BAD[name]
    message = refused(ConfigError, lambda: usvlearn.read(**{**ALL, **changes}))
    assert np.array([0.5]).__repr__() not in message and "array([" not in message
    with pytest.raises(ConfigError, match=text):
        usvlearn.read(**{**ALL, **changes})


@pytest.mark.thorough
def test_no_number_at_all_and_too_few():
    message = refused(LogFormatError, lambda: usvlearn.read(**ALL | {"surge": T * np.nan}))
    assert message.startswith("surge: expected numbers in 'surge', found none among its 1200 values (1200 empty")
    assert "measured steps" in refused(LogFormatError, lambda: usvlearn.read(**{k: v[:2] for k, v in ALL.items()}))


def test_some_stamps_that_go_back_are_masked_and_counted():
    time = T.copy()
    time[600:605] -= 0.25
    assert usvlearn.read(**ALL | {"time": time}).rejected["boat"]["surge"]["backwards"] == 2


class Column:
    """The part of a pandas.Series that is used: an array, and its numbers where it is one of objects."""

    def __init__(self, values, numbers=None):
        self.values, self.numbers = np.asarray(values), numbers

    def __array__(self, dtype=None, copy=None):
        return self.values

    def to_numpy(self, dtype, na_value):
        if self.numbers is None:
            return self.values.astype(dtype)
        return np.where(self.values == None, na_value, self.numbers).astype(dtype)  # noqa: E711


HOLES = np.arange(len(T)) % 7 == 0


@pytest.mark.parametrize("kind", few(["masked", "whole numbers", "nullable"], ["masked"], "thorough"))
def test_what_is_masked_is_no_value(kind):
    """Whatever lies below the mask: it is counted as empty, as NaN is."""
    surge = np.round(SI["surge"], 0 if kind == "whole numbers" else 3)
    junk = np.where(HOLES, 77, surge)
    given = {
        "masked": lambda: np.ma.masked_array(junk, HOLES),
        "whole numbers": lambda: np.ma.masked_array(junk.astype(int), HOLES),
        "nullable": lambda: Column(np.where(HOLES, None, surge), junk),
    }[kind]()
    expected = usvlearn.read(**ALL | {"surge": np.where(HOLES, np.nan, surge)})
    log = usvlearn.read(**ALL | {"surge": given})
    assert same(expected, log) and log.rejected["boat"]["surge"]["empty"] == HOLES.sum()


@pytest.mark.parametrize("values", [SI["surge"] > 1, SI["surge"].astype(str)], ids=["booleans", "text"])
def test_a_column_of_a_table_is_refused_as_its_array_is(values):
    """Only a column of objects may hold numbers beside what is missing."""
    for given in (values, Column(values)):
        with pytest.raises(ConfigError, match=r"surge: found (booleans|text), expected numbers"):
            usvlearn.read(**ALL | {"surge": given})


def test_what_is_missing_is_named_with_what_may_take_its_place():
    """Speeds may come from a pair of velocities; commands and headings may not."""
    for name in ("surge", "command_left", "heading"):
        with pytest.raises(ConfigError, match=f"^{name}: found no such array") as caught:
            usvlearn.read(**{key: x for key, x in ALL.items() if key != name})
        assert ("velocity_north" in str(caught.value)) == (name == "surge")
