"""Recognises files that are no logs which usvlearn reads: the bytes that tell it, what they are, and one way out."""

from __future__ import annotations

import re
from pathlib import Path

from usvlearn.errors import LogFormatError
from usvlearn.logs.formats.csv.packed import PACKED

HEAD, LINE = 4096, 300  # bytes of a file that are looked at, and of a line
MOST = 0.8  # share of the lines of a text that must be alike
OWN = "give the log that the boat's computer recorded, with the commands of its motors"
CSV = "export its series to a CSV file"
ARRAYS = "give its arrays to usvlearn.read"
UNPACK = "unpack it, and give the log in it"
TABLES = (  # with other suffixes than those of `PACKED`, which are read
    (rb"\x1f\x8b", "a file that gzip compressed", UNPACK),
    (rb"PK\x03\x04.*(xl/|\[Content_Types\](?!.*(word|ppt)/)|opendocument\.sp)|\xd0\xcf\x11\xe0", "a spreadsheet",
     "save it as a CSV file"),
    (rb"PAR1[\x15-\x2f]|ARROW1\0|FEA1\0", "a Parquet or Arrow table", CSV),
    (rb"MATLAB [57]\.\d MAT-file", "a MATLAB file", f"{ARRAYS} (scipy.io.loadmat; h5py)"),
)  # fmt: skip
STARTS = (
    *TABLES,
    (rb"version https://git-lfs", "a pointer of Git LFS, not the file itself", "run `git lfs pull` in its repository"),
    (rb"(?i)\s*<(!doctype\s+html|html|head|body)", "a web page", "download the file itself (Raw on GitHub)"),
    (rb"\s*(<\?xml.*?>\s*)?(<!--.*?-->\s*)?<(gpx|kml|Training)|PK\x03\x04.*doc\.kml", "a track (GPX, KML)", OWN),
    (rb"\s*<(\?xml|!--|\w+[\s>])", "XML", CSV),
    (rb'\s*(\{\s*["}\']|\[\s*[\[{"])', "JSON", CSV),
    (rb"rosbag2_bagfile_information:", "the metadata of a ROS 2 bag", "give the folder of the bag"),
    (rb"#ROSBAG V1|#ROSRECORD", "a ROS bag of before 2010", "convert it with `rosbag fix`"),
    (rb"SQLite format 3\0(?!.*CREATE TABLE.{1,2}messages)", "a database that is no ROS 2 bag", CSV),
    (rb"\s*FMT, ?128, ?89, ?FMT", "an ArduPilot log as text", "give the .bin file that it is from"),
    (rb"QGC WPL|#?Vehicle-Id Component-Id|# Onboard parameters", "a mission, or parameters", OWN),
    (rb"\s*(//[^\n]*\n\s*)*(ServerHost|ServerPort|Community|ProcessConfig)\s*=", "a MOOS mission", "give its .alog"),
    (rb"date \w+ \w+ \d+ .*\sbase (hex|dec)|LOGG\x90|;\$FILEVERSION", "a log of a CAN bus", f"decode it, and {CSV}"),
    (rb"PK\x03\x04.*\.npy|\x93NUMPY", "arrays of NumPy", f"{ARRAYS} (numpy.load)"),
    (rb"\x89HDF\r\n|CDF[\x01\x02\x05]", "an HDF5 or NetCDF file", f"{ARRAYS} (h5py; scipy.io.netcdf_file)"),
    (rb"\x80[\x02-\x05][\x95c}\]\x8a(]", "a pickle, which runs code", f"load it where it is from, and {CSV}"),
    (rb"WPILOG|RRF\d|TDSm|MDF  |UnFinMF|\xed\xa1\xda\x01", "a log of WPILib, Rerun, LabVIEW, MDF or LCM", CSV),
    (rb"\xd4\xc3\xb2\xa1|\xa1\xb2\xc3\xd4|\x0a\x0d\x0d\x0a", "network packets (PCAP)", f"decode them, and {CSV}"),
    (rb"PK\x03\x04.*(word/|ppt/)|%PDF|\{\\rtf", "a document", OWN),
    (rb"\x89PNG|\xff\xd8\xff|GIF8|II\*\0|MM\0\*|BM....\0\0\0\0|RIFF|....ftyp|\x1aE\xdf\xa3", "a picture or film", OWN),
    (rb"PK\x03\x04|PK\x05\x06|BZh\d|\xfd7zXZ\0|\x28\xb5\x2f\xfd|7z\xbc\xaf|Rar!|\x04\x22\x4d\x18|.{257}ustar",
     "an archive, or a compressed file", UNPACK),
    (rb"\xb5\x62[\x01-\x29]", "messages of a GNSS receiver", OWN),
    (rb"[\xfd\xfe][\x01-\xfe]", "MAVLink messages without times", "give the .tlog file"),
    (rb"ULog(?!\x01\x12\x35)", "a ULog with a damaged start", "copy it from the vehicle once more"),
    (rb"\0+\Z", "only zeros", "copy it from the boat once more, since its contents are lost"),
)  # fmt: skip
STAMPED = rb"(\\[^\\]{1,99}\\|[^,$!]{0,40},?\s*)"  # what may stand before a sentence
LINES = (
    (STAMPED + rb"\$[A-Z][A-Z\d]{2,6},", "NMEA 0183 (no commands)", "convert it to a table that has the commands, too"),
    (STAMPED + rb"!(AI|AB|BS)VD[MO],", "AIS messages", OWN),
    (rb"\s*(\(\d+\.\d+\)\s+)?\w+\s+([\dA-Fa-f]+#|[\dA-Fa-f]+\s+\[\d+\]\s)", "a log of a CAN bus (candump)",
     f"decode it with its DBC file (cantools), and {CSV}"),
    (rb"[\d:. -]+ [A-Z_\d]+ \{\w+ :", "MAVLink messages as text", "give the .tlog or .bin file"),
)  # fmt: skip
WEAK = (  # they may stand above a table, too, and only tell why it could not be read
    (rb"[\d:. T-]*\[?\S{0,40}?\]?\s*\[?(DEBUG|INFO|WARN|WARNING|ERROR|FATAL)\b", "a log of a program", OWN),
    (rb"\s*(- )*[\w./ -]+:( .*)?$|\s*- |---|\.\.\.", "YAML, or messages as text",
     f"{CSV}; of ROS, give the bag, or the output of `ros2 topic echo --csv`"),
)  # fmt: skip


def foreign(path: Path, head: bytes = b"", surely: bool = False) -> str:
    """What a file is, and the way out, if it is of a kind that is not read; else "". `surely` leaves out tables."""
    if not path.is_file():
        return ""
    if not head:
        with path.open("rb") as file:
            head = file.read(HEAD)
    if path.name.lower().endswith(PACKED) and min(head, default=9) < 9:
        return ""  # a table that is unpacked
    start = head.removeprefix(b"\xef\xbb\xbf")
    lines = [line[:LINE] for line in start.splitlines()[: -1 if len(head) == HEAD else None] if line.strip()]
    for kinds, texts in ((STARTS, [start]), (LINES if surely else LINES + WEAK, lines)):
        for sign, name, way in kinds:
            if 0 < len(texts) <= sum(bool(re.match(sign, text, re.DOTALL)) for text in texts) / MOST:
                return f"found {name}: {way}"
    return ""


def explained(path: Path, error: LogFormatError) -> LogFormatError:
    """The error of a reader, or a better one for a file of another kind."""
    kind = foreign(path)
    return LogFormatError(f"{path}: expected a log that a boat recorded, {kind}") if kind else error
