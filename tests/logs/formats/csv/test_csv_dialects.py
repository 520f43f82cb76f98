"""A table is read alike however a program wrote it, or refused in one sentence that names the option to set."""

import math
import subprocess
from contextlib import nullcontext

import numpy as np
import pytest

from tests.support.files import write
from usvlearn.errors import ConfigError, LogFormatError
from usvlearn.logs.channels.channel import Source
from usvlearn.logs.formats.csv.table import Table

TIME = 0.25 * np.arange(40)
SPEED = (1.5 + np.sin(TIME)).round(3)
YAW = (30 * TIME).round(2) - 90


def rows(form="{t:.2f}{d}{v:.3f}{d}{psi:.2f}", delimiter=",", comma=False) -> str:
    text = "".join(form.format(t=t, v=v, psi=psi, d="\0") + "\n" for t, v, psi in zip(TIME, SPEED, YAW, strict=True))
    return (text.replace(".", ",") if comma else text).replace("\0", delimiter)


def clock(t: float, form: str, sign: str) -> str:
    """A date and time of 24 July 2025, 17:18:48.25, or some seconds later."""
    seconds = 48.25 + t
    hour, minute, second = 17, 18 + int(seconds // 60), seconds % 60
    half = f"{hour - 12}:{minute:02}:{second:05.2f} PM"
    return form.format(time=f"{hour}:{minute:02}:{second:05.2f}".replace(".", sign), half=half)


def dated(form: str, delimiter: str, comma=False) -> str:
    numbers = rows("{v:.3f}{d}{psi:.2f}", delimiter, comma).splitlines()
    stamps = [clock(t, form, "," if comma else ".") for t in TIME]
    return "".join(f"{stamp}{delimiter}{each}\n" for stamp, each in zip(stamps, numbers, strict=True))


HEADER = "time,speed,yaw\n"
SHAPES = {  # text, encoding, delimiter, decimal
    "commas": (HEADER + rows(), "utf-8", ",", "."),
    "semicolons": (HEADER.replace(",", ";") + rows(delimiter=";"), "utf-8", ";", "."),
    "semicolons, decimal comma": (HEADER.replace(",", ";") + rows(delimiter=";", comma=True), "utf-8", ";", ","),
    "tabs, decimal comma": (HEADER.replace(",", "\t") + rows(delimiter="\t", comma=True), "utf-8", "\t", ","),
    "bars": (HEADER.replace(",", " | ") + rows(delimiter=" | "), "utf-8", "|", "."),
    "spaces": ("  time   speed yaw\n" + rows("  {t:.2f}{d}{v:8.3f}{d} {psi:.2f}", " "), "utf-8", " ", "."),
    "spaces, decimal comma": ("time speed yaw\n" + rows(delimiter=" ", comma=True), "utf-8", " ", ","),
    "quoted decimal comma": (
        HEADER + '"' + rows(delimiter='","', comma=True).replace("\n", '"\n"').removesuffix('"'), "utf-8", ",", ","),
    "byte order mark": ("\ufeff" + HEADER + rows(), "utf-8", ",", "."),
    "UTF-16": ("\ufeff" + HEADER.replace(",", "\t") + rows(delimiter="\t", comma=True), "utf-16-le", "\t", ","),
    "lines of Windows": ((HEADER + rows()).replace("\n", "\r\n"), "utf-8", ",", "."),
    "comments": ("# boat, 3\n% x\n// y\n" + HEADER + rows().replace("\n", "\n# note, 1, 2\n", 3), "utf-8", ",", "."),
    "header in a comment": ("# " + HEADER + rows(), "utf-8", ",", "."),
    "lines above": ("Logger 3.1\nBoat: heron, hull 2\n\nDate;24.07.2025\n" + HEADER + rows(), "utf-8", ",", "."),
    "line of units": (HEADER + "s,m/s,deg\n" + rows(), "utf-8", ",", "."),
    "line of units in brackets": (HEADER + "[s],(m/s),[°]\n" + rows(), "utf-8", ",", "."),
    "line of units and one of types": (HEADER + "s,m/s,deg\nfloat,float,float\n" + rows(), "utf-8", ",", "."),
    "units": ("time [s],speed (m/s),yaw_deg\n" + rows(), "utf-8", ",", "."),
    "units in cp1252": (
        "time;speed (m/s);yaw (°);Höhe\n" + rows(delimiter=";", comma=True).replace("\n", ";1\n"), "cp1252", ";", ","),
    "text": ('time,speed,yaw,mode,note,by\n' + rows().replace("\n", ',AUTO,"calm, sunny",me\n'), "utf-8", ",", "."),
    "delimiters at the end": (HEADER.replace("\n", ",\n") + rows(), "utf-8", ",", "."),
    "header in a comment of spaces": ("%% run 3\n%  time speed  yaw\n" + rows(delimiter=" "), "utf-8", " ", "."),
    "short years": (HEADER.replace(",", ";") + dated("24.07.25 {time}", ";", True), "utf-8", ";", ","),
    "ISO 8601": (HEADER + dated("2025-07-24T{time}", ","), "utf-8", ",", "."),
    "day first": (HEADER.replace(",", ";") + dated("24.07.2025 {time}", ";", True), "utf-8", ";", ","),
    "day first, slashes": (HEADER + dated("24/07/2025 {time}", ","), "utf-8", ",", "."),
    "month first": (HEADER + dated("7/24/2025 {half}", ","), "utf-8", ",", "."),
    "time of day": (HEADER + dated("{time}", ","), "utf-8", ",", "."),
}  # fmt: skip
SOURCES = {"surge": Source("speed"), "heading": Source("yaw", unit="deg")}


@pytest.mark.parametrize("name", SHAPES)
def test_a_table_is_read_alike_however_it_is_written(tmp_path, name):
    text, encoding, delimiter, decimal = SHAPES[name]
    path = tmp_path / "a.csv"
    path.write_bytes(text.encode(encoding))
    table, unsure = Table.of_file(path)
    assert (table.delimiter, table.decimal, table.time_unit, unsure) == (delimiter, decimal, "s", [])
    explicit = Table("time", delimiter=delimiter, decimal=decimal)
    for reader in (Table("time"), table, explicit):
        channels, dropped = reader.read(path, SOURCES)
        np.testing.assert_allclose(channels["surge"].time, TIME, atol=1e-6)
        np.testing.assert_array_equal(channels["surge"].value, SPEED)
        np.testing.assert_allclose(channels["heading"].value, np.radians(YAW), rtol=1e-14)
        assert dropped == {"surge": {}, "heading": {}}
    with nullcontext() if name != "text" else pytest.warns(UserWarning, match="left out .*'mode' .*'by'"):
        series = {each.name: each for each in table.survey(path)}
    speed = next(each for name, each in series.items() if name.startswith("speed"))
    np.testing.assert_array_equal(speed.value, SPEED)
    np.testing.assert_array_equal(speed.order, channels["surge"].order)
    assert speed.unit == ("m/s" if "unit" in name else "") and "mode" not in series
    assert (table.dates != "auto") == (name.startswith(("ISO", "day", "month", "short")))


def test_a_column_is_named_with_its_unit_or_without_where_that_is_unambiguous(tmp_path):
    path = write(tmp_path / "a.csv", "Time (ms),Speed (m/s),Speed (kn),yaw_deg,Heading [deg]\n0,1,2,3,4\n100,1,2,3,5\n")
    table = Table("Time", time_unit="ms")
    for name, value in {"Speed (kn)": 2, "yaw": 3, "yaw_deg": 3, "Heading": 4, "Heading [deg]": 4}.items():
        channels, _ = table.read(path, {"surge": Source(name)})
        assert channels["surge"].value[0] == value and channels["surge"].time.tolist() == [0, 0.1]
    with pytest.warns(UserWarning, match=r"declares 'Time \(ms\)' in ms.*set data.reader.time_unit=ms"):
        Table("Time").read(path, {"surge": Source("yaw")})
    with pytest.raises(LogFormatError, match=r"no channel 'Speed'.*Speed \(kn\), Speed \(m/s\)"):
        table.read(path, {"surge": Source("Speed")})


def test_a_date_and_a_time_in_two_columns_and_past_midnight(tmp_path):
    path = tmp_path / "a.csv"
    stamps = ["31.12.2025;23:59:59,5", "31.12.2025;23:59:59,9", "01.01.2026;00:00:00,3"]
    path.write_text("Date;Time;v\n" + "".join(f"{stamp};{k}\n" for k, stamp in enumerate(stamps)))
    table, unsure = Table.of_file(path)
    assert (table.time, table.dates, unsure) == ("Date+Time", "day_first", [])
    for reader in (table, Table("Time")):
        channels, _ = reader.read(path, {"surge": Source("v")})
        np.testing.assert_allclose(channels["surge"].time, [0, 0.4, 0.8], atol=1e-6)


@pytest.mark.parametrize("order", ["day_first", "month_first"])
def test_the_order_of_a_date_is_found_from_the_whole_column_or_asked_for(tmp_path, order):
    path = tmp_path / "a.csv"
    form = "{day}/{month}/2025 0:00" if order == "day_first" else "{month}/{day}/2025 0:00"
    body = [f"{form.format(day=day, month=7)},1\n" for day in range(10, 14)]
    path.write_text("t,v\n" + "".join(body))
    channels, _ = Table("t").read(path, {"surge": Source("v")})
    np.testing.assert_array_equal(channels["surge"].time, 86400 * np.arange(4))
    path.write_text("t,v\n" + "".join(body[:3]))
    with pytest.raises(LogFormatError, match=r"set data.reader.dates to one of"):
        Table("t").read(path, {"surge": Source("v")})
    channels, _ = Table("t", dates=order).read(path, {"surge": Source("v")})
    np.testing.assert_array_equal(channels["surge"].time, 86400 * np.arange(3))
    assert any(each.startswith("dates: ") for each in Table.of_file(path)[1])


@pytest.mark.parametrize("form", ["06/03/2025 09:0{} AM", "6/3/25 9:0{}:00 p.m.", "06-03-2025, 09:0{}:00.5 pm"])
def test_an_ambiguous_date_with_am_or_pm_is_asked_for(tmp_path, form):
    path = write(tmp_path / "a.csv", "t;v\n" + "".join(f"{form.format(minute)};{minute}\n" for minute in range(9)))
    table, unsure = Table.of_file(path)
    assert table.dates == "month_first" and [each[:7] for each in unsure] == ["dates: "]
    with pytest.raises(LogFormatError, match=r"set data.reader.dates to one of"):
        Table("t").read(path, {"surge": Source("v")})
    path.write_text(path.read_text().replace("06/03", "13/03").replace("6/3", "13/3").replace("06-03", "13-03"))
    assert (Table.of_file(path)[0].dates, Table.of_file(path)[1]) == ("day_first", [])


def test_separators_of_thousands_are_counted_or_refused(tmp_path):
    path = write(tmp_path / "a.csv", 't,v\n0,"1,234.5"\n1,"1,234"\n2,7.5\n')
    channels, dropped = Table("t").read(path, {"surge": Source("v")})
    assert channels["surge"].value.tolist() == [7.5] and dropped["surge"] == {"not_a_number": 2}
    path.write_text("t;v\n0;1.234,5\n1;1.234\n2;7,5\n")
    channels, dropped = Table("t").read(path, {"surge": Source("v")})
    assert channels["surge"].value.tolist() == [7.5] and dropped["surge"] == {"not_a_number": 2}
    for text in ("t;v\n0;1,234\n1;2,345\n", "t;v;w\n0;1,5;1\n1;2;2.5\n"):
        path.write_text(text)
        with pytest.raises(LogFormatError, match=r"set data.reader.decimal"):
            Table("t").read(path, {"surge": Source("v")})
    path.write_text("t;v\n0;1,234\n1;2,345\n")
    channels, _ = Table("t", decimal=",").read(path, {"surge": Source("v")})
    assert channels["surge"].value.tolist() == [1.234, 2.345]


def test_options_that_are_given_win(tmp_path):
    path = tmp_path / "a.csv"
    path.write_bytes("t;v (m/s);Höhe\n0;1;2\n;;\n# 1;2;3\n".encode("cp850"))
    channels, dropped = Table("t", encoding="cp850", comment=None).read(path, {"surge": Source("Höhe")})
    assert channels["surge"].value.tolist() == [2] and dropped["surge"] == {"empty": 1, "no_time": 1}
    with pytest.raises(LogFormatError, match="'t'"):
        Table("t", delimiter=",").read(path, {"surge": Source("v")})
    for option, value in {
        "encoding": "utf-5",
        "dates": "dd.mm",
        "decimal": ";",
        "delimiter": "",
        "time_unit": "week",
    }.items():
        with pytest.raises(ConfigError, match=f"data.reader.{option}"):
            Table("t", **{option: value})


EPOCH = 1_760_000_000
STAMPS = [  # header, stamps -> unit, beginnings of the doubts
    ("index,time", [0, 100, 200], "ms", []),
    ("index,time", [0, 0.1, 0.2], "s", []),
    ("index,time", [EPOCH, EPOCH + 1, EPOCH + 2], "s", []),
    ("index,time", [1000 * EPOCH, 1000 * EPOCH + 100, 1000 * EPOCH + 200], "ms", []),
    ("index,time", [0, 20000, 40000], "us", []),
    ("index,time", [0, 5, 10], "s", ["time_unit: found steps of 5"]),
    ("x,time", range(30), "s", ["time_unit: found 0, 1, …: seconds, or rows"]),  # may number the rows
    ("x,time", range(1, 31), "s", ["time_unit: found 1, 2, …"]),
    ("x,time", np.arange(30) / 2, "s", []),
    ("x,time", range(EPOCH, EPOCH + 30), "s", []),
    ("x,ticks", range(0, 5000, 100), "ms",
     ["time: found no column that is called so; 'ticks' is the first one that rises evenly"]),
    ("x,time", [f"{h:02d}{m:02d}{s:02d}.5" for h, m in ((9, 58), (9, 59), (10, 0)) for s in range(60)], "hhmmss", []),
]  # fmt: skip


@pytest.mark.parametrize(("header", "values", "unit", "doubts"), STAMPS)
def test_the_column_of_stamps_and_its_unit(tmp_path, header, values, unit, doubts):
    first = range(len(values)) if "index" in header else [k % 7 for k in range(len(values))]
    path = write(
        tmp_path / "a.csv",
        f"{header},v\n" + "".join(f"{k},{value},{math.pi}\n" for k, value in zip(first, values, strict=True)),
    )
    table, unsure = Table.of_file(path)
    assert (table.time, table.time_unit) == (header.split(",")[1], unit) and len(unsure) == len(doubts)
    assert all(each.startswith(doubt) for each, doubt in zip(unsure, doubts, strict=True))
    if unit == "hhmmss":  # past a minute and an hour; read as seconds they would jump by 40 and 4040
        assert table.read(path, {"surge": Source("v")})[0]["surge"].time.tolist() == list(range(180))
        with pytest.warns(UserWarning, match="set data.reader.time_unit=hhmmss"):
            Table("time").read(path, {"surge": Source("v")})


def test_a_table_without_stamps_or_without_a_header_is_refused(tmp_path):
    path = tmp_path / "a.csv"
    for text in ("v,w\n1,2\n0,3\n", "0,1,2\n1,2,3\n", "", "some text\nand more\n"):
        path.write_text(text)
        with pytest.raises(LogFormatError, match=r"column of stamps|none above the first numbers '0,1,2'"):
            Table.of_file(path)


def test_repeated_whole_seconds_are_spread(tmp_path):
    path = write(
        tmp_path / "a.csv", "time,speed\n" + "".join(f"2025-07-24T17:18:{k // 10:02d},{k % 7}\n" for k in range(300))
    )
    table, unsure = Table.of_file(path)
    assert (table.time, unsure) == ("time", [])
    with pytest.warns(UserWarning, match="whole seconds, with 10 rows each: the rows of a second are spread evenly"):
        channels, dropped = table.read(path, {"surge": Source("speed")})
    assert channels["surge"].time == pytest.approx(np.arange(300) / 10) and dropped == {"surge": {}}


def test_whole_seconds_that_hardly_repeat_are_left_as_they_are(tmp_path):
    path = tmp_path / "a.csv"
    for stamps in ([0, 1, 2, 2, 3, 4, 5], [0, 0.5, 0.5, 1, 1, 2, 2], [3, 3, 3]):
        path.write_text("time,speed\n" + "".join(f"{stamp},1\n" for stamp in stamps))
        channels, _ = Table("time").read(path, {"surge": Source("speed")})
        assert channels["surge"].time.tolist() == [stamp - stamps[0] for stamp in stamps]


@pytest.mark.parametrize(("rows", "found"), [("", "a header and no rows"), ("1,2\n", "a header and a single row")])
def test_a_table_of_too_few_rows_is_told(tmp_path, rows, found):
    path = write(tmp_path / "a.csv", "time,speed\n" + rows)
    with pytest.raises(LogFormatError, match=f"two rows or more, found {found}"):
        Table.of_file(path)


@pytest.mark.parametrize("line", ["t={}.5 L=0.2 R=-0.1 HDG=74.3", "t: {}, L: .2, R: 0.1, HDG: 7", "t:{};L:2;R:1;HDG:1"])
def test_a_name_beside_each_number_is_told_with_what_makes_it_a_table(tmp_path, line):
    path = write(tmp_path / "a.csv", "".join(line.format(k) + "\n" for k in range(30)))
    with pytest.raises(LogFormatError, match="found one beside each number") as refusal:
        Table.of_file(path)
    subprocess.run(str(refusal.value).partition("as by ")[2], shell=True, cwd=tmp_path, check=True)
    assert Table.of_file(tmp_path / "named.csv")[0].time == "t"


@pytest.mark.parametrize("delimiter", [",", ";"])
def test_a_table_that_lies_on_its_side_is_told_with_what_turns_it(tmp_path, delimiter):
    rows = [["time", *range(50)], ["left", *([0.5] * 50)], ["speed", *([1.5] * 50)]]
    path = write(tmp_path / "a.csv", "".join(delimiter.join(map(str, row)) + "\n" for row in rows))
    with pytest.raises(LogFormatError, match="found one at the begin of each row") as refusal:
        Table.of_file(path)
    if delimiter == ",":
        subprocess.run(str(refusal.value).partition("as by ")[2], shell=True, cwd=tmp_path, check=True)
        assert Table.of_file(tmp_path / "named.csv")[0].time == "time"
