"""A file that is no log of a known format is named, with one way out; a table is never taken for one of these."""

import gzip
import io
import json
import pickle
import sqlite3
import zipfile

import numpy as np
import pytest

from tests.support.files import refused
from usvlearn.errors import LogFormatError
from usvlearn.logs.formats.csv.table import Table
from usvlearn.logs.formats.foreign import foreign
from usvlearn.logs.inspection.logfiles import find_format, open_logs
from usvlearn.logs.read import read_recordings

NMEA = "$GPRMC,091500.00,A,4218.0000,N,07106.0000,W,2.1,084.4,030624,,,A*6C"
CHANNELS = {name: {"name": name} for name in ("command_left", "command_right", "heading", "surge")}


def zipped(*names: str) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name in names:
            archive.writestr(name, "<x/>" * 9)
    return file.getvalue()


def saved(function, *args) -> bytes:
    file = io.BytesIO()
    function(file, *args)
    return file.getvalue()


FILES = {  # name -> content, what it is, the way out
    "lfs.csv": (
        b"version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 1\n",
        "Git LFS",
        "git lfs pull",
    ),
    "page.bag": (b"\n<!doctype html>\n<html><head>", "web page", "download the file itself"),
    "gps.txt": (f"{NMEA}\r\n".encode() * 40, "NMEA 0183", "convert it to a table"),
    "logged.csv": (f"2024-06-03T09:15:00Z,{NMEA}\r\n".encode() * 40, "NMEA 0183", "convert it to a table"),
    "tags.log": (f"\\s:GP1,c:17174000*5C\\{NMEA}\n".encode() * 40, "NMEA 0183", "convert it to a table"),
    "ais.nmea": (b"!AIVDM,1,1,,B,15M67FC000G?ufbE`FepT@3n00Sa,0*5C\n" * 9, "AIS", "give the log"),
    "a.jsonl": (b'{"t": 1, "left": 0.5}\n' * 500, "JSON", "CSV"),
    "a.json": (json.dumps({"t": list(range(9))}).encode(), "JSON", "CSV"),
    "dump.log": (b"(1436509052.249713) vcan0 044#2A366C2BBA\n" * 9, "candump", "DBC"),
    "can.txt": (b"  can0  1F4   [8]  00 11 22 33 44 55 66 77\n" * 9, "candump", "DBC"),
    "v.asc": (b"date Mon Jun 3 09:15:00.000 am 2024\nbase hex  timestamps absolute\n", "CAN", "decode"),
    "boat.yaml": (b"boat:\n  name: anna\n  left:\n    - 1\nrate: 10\n", "YAML", "CSV"),
    "echo.txt": (b"header:\n  stamp:\n    sec: 1\ndata: 0.5\n---\n" * 9, "messages as text", "ros2 topic echo --csv"),
    "metadata.txt": (b"rosbag2_bagfile_information:\n  version: 5\n", "ROS 2 bag", "folder"),
    "ros.log": (b"[INFO] [1717400001.5] [node]: hello\n" * 9, "log of a program", "give the log"),
    "a.xml": (b'<?xml version="1.0"?>\n<log><t>1</t></log>', "XML", "CSV"),
    "a.gpx": (b'<?xml version="1.0"?>\n<gpx version="1.1"></gpx>', "track", "give the log"),
    "pilot.log": (b"FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns\n", "ArduPilot log as text", ".bin"),
    "text.txt": (b"2024-06-03 09:15:00.01 ATTITUDE {time_boot_ms : 1, roll : 0.1}\n" * 9, "MAVLink", ".tlog"),
    "raw.bin": (b"\xfe\x09\x01\x01\x01\0" + bytes(11), "MAVLink messages without times", ".tlog"),
    "a.moos": (b"// a\n\nServerHost = localhost\n", "MOOS mission", ".alog"),
    "a.mat5": (b"MATLAB 5.0 MAT-file, Platform" + bytes(99), "MATLAB", "usvlearn.read"),
    "b.mat7": (b"MATLAB 7.3 MAT-file, Platform" + bytes(99), "MATLAB", "h5py"),
    "a.xlsm": (zipped("[Content_Types].xml", "_rels/.rels", "xl/workbook.xml"), "spreadsheet", "CSV"),
    "a.docx": (zipped("[Content_Types].xml", "_rels/.rels", "word/document.xml"), "document", "give the log"),
    "a.zip": (zipped("run.csv"), "archive", "unpack"),
    "a.gz": (gzip.compress(b"t,l\n"), "gzip", "unpack"),
    "a.xz": (b"\xfd7zXZ\0" + bytes(9), "compressed", "unpack"),
    "a.7z": (b"7z\xbc\xaf\x27\x1c" + bytes(9), "archive", "unpack"),
    "a.pq": (b"PAR1\x15\4" + bytes(9), "Parquet", "CSV"),
    "a.h5": (b"\x89HDF\r\n\x1a\n" + bytes(9), "HDF5", "usvlearn.read"),
    "a.npz.part": (saved(np.savez, np.ones(3)), "NumPy", "usvlearn.read"),
    "a.npy": (saved(np.save, np.ones(3)), "NumPy", "usvlearn.read"),
    "a.pkl": (pickle.dumps({"a": 1}), "pickle", "load it where it is from"),
    "a.wpilog": (b"WPILOG\0\1" + bytes(9), "WPILib", "CSV"),
    "a.rrd": (b"RRF2" + bytes(9), "Rerun", "CSV"),
    "a.lcm": (b"\xed\xa1\xda\1" + bytes(9), "LCM", "CSV"),
    "a.pcap": (b"\xd4\xc3\xb2\xa1" + bytes(9), "PCAP", "decode"),
    "a.mp4": (b"\0\0\0\x20ftypisom" + bytes(9), "picture or film", "give the log"),
    "a.pdf": (b"%PDF-1.7\n", "document", "give the log"),
    "a.ulg": (b"ULog\2\x12\x35" + bytes(9), "ULog", "copy it from the vehicle"),
    "old.bag": (b"#ROSBAG V1.2\n", "before 2010", "rosbag fix"),
    "a.ubx": (b"\xb5\x62\1\7" + bytes(9), "GNSS", "give the log"),
    "zeros.csv": (bytes(9000), "only zeros", "copy it from the boat"),
}


@pytest.mark.parametrize("name", FILES)
def test_it_is_named_with_a_way_out_wherever_it_is_given(tmp_path, name):
    content, what, way = FILES[name]
    (tmp_path / name).write_bytes(content)
    for message in (
        refused(LogFormatError, open_logs, [str(tmp_path / name)]),
        refused(LogFormatError, read_recordings, tmp_path / name, Table("time"), CHANNELS),
    ):
        assert name in message and what in message.partition("found ")[2] and way in message.rpartition(": ")[2]


def test_a_database_that_is_no_bag_is_named(tmp_path):
    base = sqlite3.connect(tmp_path / "app.db")
    base.execute("CREATE TABLE gps(t, lat, lon)")
    base.commit()
    base.close()
    assert "a database that is no ROS 2 bag" in refused(LogFormatError, open_logs, [str(tmp_path / "app.db")])


ROWS = "".join(f"{0.1 * k:.1f},{k % 7},{k % 5},{k % 3}\n" for k in range(60))
TABLES = {  # what stands above a table, and one that begins as another file does
    "remarks": "# boat: anna\n# rate: 10 Hz\n" * 60 + "time,l,r,v\n" + ROWS,
    "described": "Device: logger\nSerial: 12\nRate: 10\n\ntime,l,r,v\n" + ROWS,
    "long": "Device: logger\n" * 400 + "time,l,r,v\n" + ROWS,
    "names": "par1,riff,bm,mdf\n" + ROWS,
    "sentences": "time,l,r,sentence\n" + "".join(f"{0.1 * k:.1f},{k},{k},$GPRMC {k}\n" for k in range(60)),
    "levels": "time,l,r,level\n" + "".join(f"{0.1 * k:.1f},{k},{k},INFO\n" for k in range(60)),
    "text": "stamp;l;r;v\n" + "".join(f"2024-06-03 09:15:{k:02d};{k};{k};{k}\n" for k in range(60)),
}


@pytest.mark.parametrize("name", TABLES)
def test_a_table_is_none_of_them(tmp_path, name):
    path = tmp_path / "a.csv"
    path.write_text(TABLES[name])
    assert find_format(path).name == "tables" and foreign(path, surely=True) == ""


def test_a_telemetry_log_of_another_suffix_and_a_synchronous_log_are_read(tmp_path):
    (tmp_path / "a.bin").write_bytes((1_717_400_000_000_000).to_bytes(8) + b"\xfe" + bytes(30))
    assert find_format(tmp_path / "a.bin").name == "MAVLink telemetry"
    head = "%% LOG FILE: a.slog\n%% LOGSTART 1.5e9\n%%   TIME NAV_SPEED NAV_HEADING\n"
    (tmp_path / "a.slog").write_text(head + "".join(f"{k / 4:.3f}   NaN   {-0.5 * k}\n" for k in range(60)))
    (series,) = open_logs([str(tmp_path / "a.slog")]).surveyed
    assert [each.name for each in series] == ["NAV_HEADING"] and series[0].value[2] == -1
    (tmp_path / "a.alog").write_text("%% LOG FILE: a.alog\n" + "1.5 NAV_X pX 1\n" * 9)
    assert find_format(tmp_path / "a.alog").name == "MOOS"


def test_what_is_left_out_of_a_folder_is_named(tmp_path):
    lines = "time,l,r,v\n" + ROWS
    for name in ("run_1.csv", "run_2.csv"):
        (tmp_path / name).write_text(lines)
    for k in range(5):
        (tmp_path / f"lost_{k}.csv").write_bytes(FILES["lfs.csv"][0])
    notes = open_logs([str(tmp_path)]).notes
    assert sum("Git LFS" in each and "lost_" in each for each in notes) == 3 and "2 more files" in notes[-1]
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty" / "a.xlsm").write_bytes(FILES["a.xlsm"][0])
    with pytest.raises(Exception, match=r"found a\.xlsm, a spreadsheet: save it as a CSV file"):
        open_logs([str(tmp_path / "empty")])


@pytest.mark.parametrize("text", ["\n\n\n", "\r\r", " \t\n"])
def test_a_file_of_blank_lines_is_empty(tmp_path, text):
    (tmp_path / "a.csv").write_text(text, newline="")
    with pytest.raises(LogFormatError, match="found an empty file"):
        find_format(tmp_path / "a.csv")
