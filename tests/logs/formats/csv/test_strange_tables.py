"""Tables of strangers: their stamps, layouts, boats and packing are read rightly, or refused with a way out."""

import gzip
import sys
from datetime import datetime, timedelta

import numpy as np
import pytest

from usvlearn.errors import ConfigError, LogFormatError
from usvlearn.logs.channels.channel import Source, parse_numbers
from usvlearn.logs.formats.csv.table import Table
from usvlearn.logs.inspection.logfiles import open_logs
from usvlearn.logs.read import read_recordings

TIME = 0.25 * np.arange(600)
WHEN = [datetime(2024, 6, 3, 9, 58, 30) + timedelta(seconds=float(t)) for t in TIME]
SPEED = (1.5 + np.sin(TIME / 9)).round(3)


def split(*names):
    return lambda each: [getattr(each, name) for name in names]


def millis(form, each):
    return each.strftime(form) + f"{each.microsecond // 1000:03}"


CALENDAR = split("year", "month", "day", "hour", "minute")
DATES = {  # header -> cells of a date-time
    "time": lambda w: [millis("%Y%m%d_%H%M%S.", w)], "Stamp": lambda w: [millis("%Y%m%d%H%M%S", w)],
    "t": lambda w: [millis("%Y%m%d%H%M%S.", w)], "timestamp": lambda w: [millis("%Y_%m_%d_%H_%M_%S.", w)],
    "Zeit": lambda w: [millis("%Y/%-m/%-d %H:%M:%S.", w)], "utc": lambda w: [millis("3-Jun-2024 %H:%M:%S.", w)],
    "Time": lambda w: [millis("Mon Jun  3 %H:%M:%S.", w) + " 2024"],
    "Temps": lambda w: [millis("3 juin 2024 %H:%M:%S.", w)],
    "TIME": lambda w: [millis("%H:%M:%S:", w)], "Date,Time": lambda w: [f"{w:%d.%m.%Y}", millis("%H:%M:%S.", w)],
    "date,time,ms": lambda w: [w.date(), w.time().replace(microsecond=0), w.microsecond // 1000],
    "secs,nsecs": lambda w: [int(w.timestamp()), w.microsecond * 1000],
    "a.stamp.sec,a.stamp.nanosec": lambda w: [int(w.timestamp()), w.microsecond * 1000],
    "tv_sec,tv_usec": lambda w: [int(w.timestamp()), w.microsecond],
    "year,month,day,hour,minute,second": lambda w: [*CALENDAR(w), w.second + w.microsecond / 1e6],
    "JAHR,MONAT,TAG,STUNDE,MINUTE,SEKUNDE": lambda w: [*CALENDAR(w), w.second + w.microsecond / 1e6],
    "yyyy,mm,dd,hh,mi,ss,ms": lambda w: [*CALENDAR(w), w.second, w.microsecond // 1000],
    "Year,Mon,Day,Hour,Min,Sec": lambda w: [w.year, "Jun", *CALENDAR(w)[2:], w.second + w.microsecond / 1e6],
    "hour,minute,second": lambda w: [*CALENDAR(w)[3:], w.second + w.microsecond / 1e6],
}  # fmt: skip
ELAPSED = {  # header -> cells of seconds
    "elapsed": lambda t: f"{int(t // 60):02}:{t % 60:05.2f}",
    "time": lambda t: f"{int((t + 3540) // 60) % 60:02}:{t % 60:04.1f}",
    "Time": lambda t: f"{45446.385416666664 + t / 86400:.9f}",
    "datenum": lambda t: f"{739406.385416666664 + t / 86400:.9f}",
    "Time (h)": lambda t: f"{t / 3600:.8f}",
    "t_min": lambda t: f"{t / 60:.6f}",
    "millis": lambda t: round(t * 1000 + 2**32 - 60000) % 2**32,
    "time_us": lambda t: round(t * 1e6 + 2**32 - 6e7) % 2**32,
    "gps time": lambda t: f"{(t + 604700) % 604800:.2f}",
}


def write(path, header, cells, sep=","):
    rows = [sep.join(map(str, (*each, speed))) for each, speed in zip(cells, SPEED, strict=True)]
    path.write_text("\n".join([sep.join((header, "speed")), *rows]) + "\n")
    return path


@pytest.mark.parametrize("header", [*DATES, *ELAPSED])
def test_stamps_of_every_kind(tmp_path, header):
    cells = [DATES[header](w) for w in WHEN] if header in DATES else [[ELAPSED[header](t)] for t in TIME]
    path = write(tmp_path / "a.csv", header, cells)
    table, unsure = Table.of_file(path)
    channel = table.read(path, {"surge": Source("speed")})[0]["surge"]
    rounded = 0.06 if header == "time" and cells[0][0].count(":") else 1e-3
    assert np.abs(channel.time - TIME).max() < rounded and not [each for each in unsure if "unit" in each]


@pytest.mark.parametrize(("header", "cells"), [("time,ns", (0.25, "N")), ("time,ms", (1, 1.25)), ("secs,us", (2, ""))])
def test_only_integers_are_the_fraction_of_a_second(tmp_path, header, cells):
    path = write(tmp_path / "a.csv", header, [(round(cells[0] * k, 2), cells[1]) for k in range(600)])
    assert Table.of_file(path)[0].time == header.split(",")[0]


def test_an_underscore_is_no_part_of_a_number():
    assert np.isnan(parse_numbers(["20240603_0915", "1_0"])).all() and parse_numbers(["10"])[0] == 10


def test_minutes_without_a_unit_are_unsure(tmp_path):
    table, unsure = Table.of_file(write(tmp_path / "a.csv", "time", [[f"{t / 60:.7f}"] for t in TIME]))
    assert table.time_unit == "min" and "may be s or min" in unsure[0]


@pytest.mark.parametrize("header", ["index", "Sample_No", "frame", "x"])
def test_a_row_number_asks_for_the_rate(tmp_path, header):
    path = write(tmp_path / "a.csv", header, [[k] for k in range(len(TIME))])
    with pytest.raises(
        LogFormatError, match=f"{header}' counts rows and does not tell their rate.*10 rows a second: awk"
    ):
        Table.of_file(path)


def test_days_rounded_as_a_spreadsheet_does_are_spread_and_whole_minutes_refused(tmp_path):
    path = write(tmp_path / "a.csv", "Time", [[f"{45446.38542 + t / 86400:.5f}"] for t in TIME])
    with pytest.warns(UserWarning, match="rounded, with 3.45 rows"):
        time = Table.of_file(path)[0].read(path, {"surge": Source("speed")})[0]["surge"].time
    assert (np.diff(time) > 0).all() and np.abs(time - TIME).max() < 0.6
    path = write(tmp_path / "b.csv", "time", [[f"{w:%H:%M}"] for w in WHEN])
    with pytest.raises(LogFormatError, match="rows of each minute, expected seconds"):
        Table("time").read(path, {"surge": Source("speed")})


@pytest.mark.parametrize(
    ("header", "cell", "order"),
    [("time", str, "reverse"), ("Zeit", lambda t: str(WHEN[int(4 * t)]), "no"), ("t_s", str, "reverse"),
     ("Date,Time", lambda t: f"{WHEN[int(4 * t)]:%d.%m.%Y,%H:%M:%S.%f}", "reverse"), ("epoch", str, "no"),
     ("stamp", str, "some")],
)  # fmt: skip
def test_rows_in_no_order_of_time_are_to_be_sorted(tmp_path, header, cell, order):
    rng = np.random.default_rng(0)
    time = {"reverse": TIME[::-1], "no": rng.permutation(TIME), "some": TIME - 0.4 * (rng.random(600) < 0.1)}[order]
    path = write(tmp_path / "a.csv", header, [[cell(t)] for t in time])
    sort = r"reverse .*\.iloc\[::-1\]" if order == "reverse" else r"no .*\.sort_values\("
    for read in (Table.of_file, lambda each: Table("+".join(header.split(","))).read(each, {"surge": Source("speed")})):
        with pytest.raises(LogFormatError, match=rf"a\.csv: expected the stamps .* in {sort}"):
            read(path)


def test_a_campbell_table_and_a_synchronous_log_of_moos(tmp_path):
    rows = "".join(f'"2024-06-03 09:15:{k // 4:02}.{k % 4 * 25:02}",{k},{SPEED[k]}\n' for k in range(200))
    head = '"TOA5","CR6"\n"TIMESTAMP","RECORD","u"\n"TS","RN","Volts"\n"","","Smp"\n'
    (tmp_path / "a.dat").write_text(head + rows)
    (series,) = [each for each in Table("TIMESTAMP").survey(tmp_path / "a.dat") if each.name == "u"]
    assert series.unit == "Volts" and series.value.tolist() == SPEED[:200].tolist()
    line = "%% TIME   NAV_SPEED A\n%% TIME   [12.00] [12.00]\n"
    rows = "".join(
        f"{t:.2f}   {v} NaN\n" + line * (k % 30 == 29) for k, (t, v) in enumerate(zip(TIME, SPEED, strict=True))
    )
    (tmp_path / "a.slog").write_text(
        "%%%%\n%% LOGSTART   1.7e9\n%%   (1) TIME\n%%   (2) NAV_SPEED\n%%%%\n" + line + rows
    )
    (series,) = open_logs([str(tmp_path / "a.slog")]).surveyed[0]
    assert series.name == "NAV_SPEED" and series.value.tolist() == SPEED.tolist()


def fleet_table(path, column, *labels, stacked=False):
    """Rows of boats that sail alike, each half a minute after the one before."""
    rows = [
        (t, label, k, SPEED[(n + 120 * k) % 600], 120 * np.sin((t + 30 * k) / 7))
        for n, t in enumerate(TIME)
        for k, label in enumerate(labels)
    ]
    rows = sorted(rows, key=lambda row: row[2]) if stacked else rows
    path.write_text(
        f"time,{column},speed,heading,left\n" + "".join(f"{t},{a},{v},{psi:.1f},5\n" for t, a, _, v, psi in rows)
    )
    return path


CHANNELS = {name: {"name": "left"} for name in ("command_left", "command_right")} | {
    "surge": {"name": "speed"}, "heading": {"name": "heading", "unit": "deg"}}  # fmt: skip


@pytest.mark.parametrize(
    ("column", "labels", "stacked"),
    [
        ("vehicle", "ab", False),
        ("who", "ab", False),
        ("MMSI", "12", False),
        ("n", "123", False),
        ("ship_id", "12", True),
    ],
)
def test_a_table_of_several_boats_asks_which(tmp_path, column, labels, stacked):
    path = fleet_table(tmp_path / "a.csv", column, *labels, stacked=stacked)
    for read in (Table.of_file, lambda each: read_recordings(each, Table("time"), CHANNELS)):
        with pytest.raises(
            LogFormatError, match=f"several boats.*{column}'.*--name {labels[0]};.*boat_column={column}"
        ):
            read(path)
    assert Table.of_file(path, labels[1])[0].rows == f"{column}={labels[1]}"
    recordings = read_recordings(path, Table("time"), CHANNELS, boat_column=column)
    assert [each.boat for each in recordings] == [*labels]
    assert recordings[1].channels["surge"].value.tolist() == np.roll(SPEED, -120).tolist()
    (alone,) = read_recordings(path, Table("time"), CHANNELS, 2 if labels[1] == "2" else labels[1], column)
    assert alone.channels["surge"].time.tolist() == TIME.tolist()
    with pytest.raises(ConfigError, match=r"data\.boat: found 'z', expected one of "):
        read_recordings(path, Table("time"), CHANNELS, "z", column)


def of_boat(path, column, *labels, restart=False, gap=500):
    """Blocks of rows, one for each label in its column, with the clock going on or beginning anew."""
    rows = [f"{t + (0 if restart else gap * k)},{label},{v},{9 * t % 360},5\n"
            for k, label in enumerate(labels) for t, v in zip(TIME[:150], SPEED, strict=False)]  # fmt: skip
    path.parent.mkdir(exist_ok=True)
    path.write_text(f"time,{column},speed,heading,left\n" + "".join(rows))
    return path


@pytest.mark.parametrize(("column", "labels"), [("boat", "ab"), ("MMSI", ("211000001", "211000002")), ("Schiff", "xy")])
@pytest.mark.parametrize("places", ["{}.csv", "{}/run.csv"])
def test_tables_of_several_boats_are_refused_as_one_with_both_is(tmp_path, column, labels, places):
    for k, label in enumerate(labels):
        of_boat(tmp_path / places.format("pq"[k]), column, label)
    text = f"several boats.*{column}'.*--name {labels[0]};.*boat_column={column}"
    for read in (lambda: open_logs([str(tmp_path)]), lambda: read_recordings(tmp_path, Table("time"), CHANNELS)):
        with pytest.raises(LogFormatError, match=text):
            read()
    assert open_logs([str(tmp_path)], labels[1]).reader.rows == f"{column}={labels[1]}"
    recordings = read_recordings(tmp_path, Table("time"), CHANNELS, boat_column=column)
    assert [(each.boat, each.run[0]) for each in recordings] == [(labels[0], "p"), (labels[1], "q")]
    assert len(read_recordings(tmp_path, Table("time", rows="all"), CHANNELS)) == 2


@pytest.mark.parametrize("restart", [False, True])
@pytest.mark.parametrize(
    ("column", "labels"), [("node", ("n3", "n9")), ("platform", "xyz"), ("id", "12"), ("Serial No", ("7A", "8C"))]
)
def test_blocks_of_rows_of_what_may_be_boats_are_a_question(tmp_path, column, labels, restart):
    doubts = open_logs([str(of_boat(tmp_path / "a.csv", column, *labels, restart=restart))]).doubts
    assert len(doubts) == 1 and f"boat_column={column}" in doubts[0]


def test_tables_of_devices_are_a_question(tmp_path):
    for label in "12":
        of_boat(tmp_path / f"{label}.csv", "drone_id", label)
    assert "boat_column=drone_id" in open_logs([str(tmp_path)]).doubts[0]


@pytest.mark.parametrize("restart", [False, True])
@pytest.mark.parametrize(
    ("column", "labels"),
    [("mode", ("AUTO", "MANUAL")), ("waypoint", "34"), ("Zustand", "ab"), ("leg_id", "12"), ("nav_state", "123"),
     ("x", ("HOLD", "GUIDED")), ("k", "12"), ("id", [*range(21)]), ("boat", "aa")],
)  # fmt: skip
def test_modes_legs_and_row_numbers_are_no_question(tmp_path, column, labels, restart):
    assert not open_logs([str(of_boat(tmp_path / "a.csv", column, *labels, restart=restart))]).doubts


def test_modes_gears_and_commands_are_no_boats(tmp_path):
    label = {"mode": TIME // 9 % 3, "gear": SPEED > 1.6, "level": (SPEED * 4).round() * 25}
    for name, values in label.items():
        rows = (f"{t},{m},{v:.3f},{t % 360},{m}\n" for t, m, v in zip(TIME, values, SPEED, strict=True))
        (tmp_path / "a.csv").write_text(f"time,{name},speed,heading,left\n" + "".join(rows))
        table, unsure = Table.of_file(tmp_path / "a.csv")
        assert table.rows == "auto" and not unsure


def test_one_number_a_row_is_to_be_pivoted(tmp_path):
    rows = "".join(
        f"{t};{name};{x}\n" for t, v in zip(TIME, SPEED, strict=True) for name, x in (("u", v), ("psi", 9 * v))
    )
    (tmp_path / "a.csv").write_text("time;variable;value\n" + rows)
    with pytest.raises(
        LogFormatError, match=r"sep=';'.*pivot_table\(index='time', columns='variable', values='value'\)"
    ):
        Table.of_file(tmp_path / "a.csv")


def test_packed_tables(tmp_path):
    text = write(tmp_path / "a.csv", "time", [[t] for t in TIME]).read_bytes()
    (tmp_path / "a.csv.gz").write_bytes(gzip.compress(text))
    np.savez(tmp_path / "a.npz", time=TIME, speed=SPEED, note="x")
    savemat = pytest.importorskip("scipy.io").savemat
    savemat(tmp_path / "a.mat", {"log": {"time": TIME[:, None], "speed": SPEED[None]}})
    (tmp_path / "b.mat").write_bytes(b"MATLAB 7.3 MAT-file".ljust(124) + b"\0\2IM" + bytes(600))
    (tmp_path / "b.csv.gz").write_bytes(gzip.compress(text)[:99])
    for name in ("a.csv.gz", "a.npz", "a.mat"):
        series = open_logs([str(tmp_path / name)]).surveyed[0][-1]
        assert series.value.tolist() == SPEED.tolist() and series.time.tolist() == TIME.tolist()
    for name, words in (("b.mat", r"MATLAB 7\.3.*-v7"), ("b.csv.gz", "ended before.*save it as CSV")):
        with pytest.raises(LogFormatError, match=words):
            open_logs([str(tmp_path / name)])


def test_a_spreadsheet_needs_the_extra(tmp_path, monkeypatch):
    (tmp_path / "a.xlsx").write_bytes(b"PK\3\4")
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(LogFormatError, match=r'pip install "usvlearn\[tables\]"'):
        open_logs([str(tmp_path / "a.xlsx")])


@pytest.mark.parametrize("kind", ["xlsx", "parquet"])
def test_spreadsheets_and_parquet(tmp_path, kind):
    pandas = pytest.importorskip("pandas", reason="needs the package pandas")
    pytest.importorskip("openpyxl" if kind == "xlsx" else "pyarrow", reason="needs the extra tables")
    frame = pandas.DataFrame({"time": WHEN, "speed": SPEED})
    (frame.to_excel if kind == "xlsx" else frame.to_parquet)(tmp_path / f"a.{kind}", index=False)
    (series,) = open_logs([str(tmp_path / f"a.{kind}")]).surveyed[0]
    assert series.value.tolist() == SPEED.tolist() and np.abs(series.time - TIME).max() < 1e-6


def test_columns_that_are_left_out_are_named(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(
        "time,speed,mode,sonar\n" + "".join(f"{t},1,AUTO,{'3' if t % 3 == 0 else '-'}\n" for t in range(30))
    )
    assert "'mode' (0 of 30, as 'AUTO'), 'sonar' (10 of 30): name one" in open_logs([str(path)]).notes[0]


@pytest.mark.parametrize("ahead", [1.76e9, 2e6])
def test_a_clock_that_is_set_ahead_begins_a_run(tmp_path, ahead):
    path = write(tmp_path / "a.csv", "time", [[t + ahead * (t > 70)] for t in TIME])
    with pytest.warns(UserWarning, match=r"jump ahead.*set, by .* at 2\d\d .*so there are 2"):
        runs = read_recordings(path, Table("time"), {name: {"name": "speed"} for name in CHANNELS})
    assert [each.run for each in runs] == ["a", "a-part2"]


def test_a_logger_that_starts_anew_begins_a_run(tmp_path):
    path = write(tmp_path / "a.csv", "time", [[t % 75 + 9] for t in TIME])
    sources = {name: {"name": "speed"} for name in CHANNELS}
    with pytest.warns(UserWarning, match=r"jump back.*by 74\.75 s at 302 .*so there are 2"):
        runs = read_recordings(path, Table("time"), sources)
    assert [each.run for each in runs] == ["a", "a-part2"]
    for each, part in zip(runs, (SPEED[:300], SPEED[300:]), strict=True):
        assert each.channels["surge"].value.tolist() == part.tolist() and each.channels["surge"].time[0] == 0
    assert [each[0].time[-1] for each in open_logs([str(path)]).surveyed] == [74.75, 74.75]
    for stamps in ([*TIME[:300], 9e5, *TIME[301:]], [*TIME[:300], 0, *TIME[301:]]):  # one wrong stamp
        assert len(read_recordings(write(path, "time", [[t] for t in stamps]), Table("time"), sources)) == 1


@pytest.mark.parametrize("cell", ["{:.1f}°", "{:.2f} m/s", "1,{:05.1f}", "{:.1f} U/min"])
def test_a_column_without_plain_numbers_is_told_with_a_cell_and_what_to_write(tmp_path, cell):
    path = tmp_path / "a.csv"
    path.write_text("time;x;speed\n" + "".join(f"{t};{cell.format(v)};{v}\n" for t, v in zip(TIME, SPEED, strict=True)))
    with pytest.warns(UserWarning, match=r"'x' \(0 of 600, as '.*where there are none, write them without units"):
        Table.of_file(path)[0].survey(path)
