"""A simulated voyage as tables and MOOS logs in many shapes: names, units, languages, senses."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from tests.support.voyages import EARTH, START, Voyage

KNOTS, KMH, DEG = 3600 / 1852, 3.6, 180 / math.pi
BEGIN = datetime(2025, 7, 24, 17, 18, 48, tzinfo=UTC)


def rows(voyage: Voyage, hz: float = 10.0) -> np.ndarray:
    """Stamps of a table, s."""
    return np.arange(0.5, voyage.surge[0].max() - 0.5, 1 / hz)


def write_table(path: Path, columns: Mapping[str, Sequence], delimiter: str = ",", comma: bool = False,
                encoding: str = "utf-8") -> Path:  # fmt: skip
    """A CSV file; numbers with a decimal comma if asked for."""
    with path.open("w", newline="", encoding=encoding) as file:
        writer = csv.writer(file, delimiter=delimiter)
        writer.writerow(columns)
        for row in zip(*columns.values(), strict=True):
            cells = [each if isinstance(each, str) else repr(float(each)).removesuffix(".0") for each in row]
            writer.writerow([cell.replace(".", ",") if comma and not isinstance(each, str) else cell
                             for cell, each in zip(cells, row, strict=True)])  # fmt: skip
    return path


def write_alog(path: Path, posts: Mapping[str, tuple[np.ndarray, np.ndarray]], app: str = "pNav") -> Path:
    """A MOOS log of variables with their stamps and values."""
    lines = ["%" * 80, "%% LOG FILE: ./LOG_BOAT", "%% LOGSTART 1721841528.2", "%" * 80]
    found = [(t, name, v) for name, (time, value) in posts.items() for t, v in zip(time, value, strict=True)]
    lines += [f"{t:<12.3f} {name:<20} {app:<12} {v:.5f}" for t, name, v in sorted(found)]
    path.write_text("\n".join(lines) + "\n")
    return path


def scaled(pair: tuple[np.ndarray, np.ndarray], factor: float, offset: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    return pair[0], factor * pair[1] + offset


def enu(heading: np.ndarray) -> np.ndarray:
    """The yaw from east, counter-clockwise, within ±π."""
    return (math.pi / 2 - heading + math.pi) % (2 * math.pi) - math.pi


def moos(folder: Path, voyage: Voyage) -> Path:
    rng = np.random.default_rng(5)
    slow = np.arange(0.0, voyage.surge[0].max(), 1.0)
    return write_alog(folder / "moos.alog", {
        "DESIRED_THRUST_L": scaled(voyage.command_left, 100),
        "DESIRED_THRUST_R": scaled(voyage.command_right, 100),
        "NAV_HEADING": scaled(voyage.heading, DEG),
        "NAV_SPEED": voyage.surge,
        "NAV_X": voyage.east,
        "NAV_Y": voyage.north,
        "DESIRED_SPEED": (slow, np.round(voyage.at("surge", slow + 3), 0)),
        "DESIRED_HEADING": (slow, np.round(DEG * voyage.at("heading", slow + 3), -1)),
        "NAV_ROLL": (slow, rng.normal(0, 3, len(slow))),
        "IVPHELM_ITER": (slow, np.arange(len(slow))),
    })  # fmt: skip


def pwm_table(folder: Path, voyage: Voyage) -> Path:
    time = rows(voyage)
    return write_table(folder / "pwm.csv", {
        "time": time,
        "lat": voyage_latitude(voyage, time),
        "lon": voyage_longitude(voyage, time),
        "heading": np.round(DEG * voyage.at("heading", time), 2),
        "yaw_rate": np.round(DEG * voyage.at("yaw_rate", time), 3),
        "speed": np.round(voyage.at("surge", time), 3),
        "pwm_left": np.round(1500 + 400 * voyage.at("command_left", time)),
        "pwm_right": np.round(1500 + 400 * voyage.at("command_right", time)),
        "battery": 25 - time / 1000,
    })  # fmt: skip


def voyage_latitude(voyage: Voyage, time: np.ndarray) -> np.ndarray:
    return np.round(np.interp(time, *voyage.latitude), 7)


def voyage_longitude(voyage: Voyage, time: np.ndarray) -> np.ndarray:
    return np.round(np.interp(time, *voyage.longitude), 7)


def german_table(folder: Path, voyage: Voyage) -> Path:
    time = rows(voyage, 5.0)
    stamps = [(BEGIN + timedelta(seconds=float(each))).strftime("%d.%m.%Y %H:%M:%S,%f")[:-3] for each in time]
    return write_table(folder / "fahrt.csv", {
        "Zeit": stamps,
        "Breite": voyage_latitude(voyage, time),
        "Länge": voyage_longitude(voyage, time),
        "Steuerkurs (°)": np.round(DEG * voyage.at("heading", time), 1),
        "Kurs über Grund (°)": np.round(DEG * voyage.at("course", time), 1),
        "Geschwindigkeit (km/h)": np.round(KMH * voyage.at("surge", time), 2),
        "Schub links (%)": np.round(100 * voyage.at("command_left", time)),
        "Schub rechts (%)": np.round(100 * voyage.at("command_right", time)),
    }, delimiter=";", comma=True, encoding="cp1252")  # fmt: skip


def knots_table(folder: Path, voyage: Voyage) -> Path:
    time = rows(voyage)
    return write_table(folder / "knots.csv", {
        "timestamp": np.round(1e3 * (BEGIN.timestamp() + time)),
        "latitude": voyage_latitude(voyage, time),
        "longitude": voyage_longitude(voyage, time),
        "sog": np.round(KNOTS * voyage.at("surge", time), 2),
        "cog": np.round(voyage.at("course", time), 3),
        "hdg": np.round(voyage.at("heading", time), 4),
        "throttle_port": np.round(voyage.at("command_left", time), 3),
        "throttle_starboard": np.round(voyage.at("command_right", time), 3),
    })  # fmt: skip


def reversed_table(folder: Path, voyage: Voyage) -> Path:
    time = rows(voyage)
    return write_table(folder / "reversed.csv", {
        "t_ms": 1000 * time,
        "x_ned": np.interp(time, *voyage.north),
        "y_ned": np.interp(time, *voyage.east),
        "yaw": DEG * voyage.at("heading", time),
        "yaw_rate": voyage.at("yaw_rate", time),
        "surge": voyage.at("surge", time),
        "thr_left": np.round(1511 - 400 * voyage.at("command_left", time)),
        "thr_right": np.round(1511 + 400 * voyage.at("command_right", time)),
        "thr_left_pwm_zero_point": 1511 + 0 * time,
        "thr_right_pwm_zero_point": 1511 + 0 * time,
    })  # fmt: skip


def newton_table(folder: Path, voyage: Voyage) -> Path:
    time = rows(voyage)
    left, right = voyage.at("command_left", time), voyage.at("command_right", time)
    rng = np.random.default_rng(3)
    trim = np.repeat(rng.uniform(0.8, 1.0, len(time) // 100 + 1), 100)[: len(time)]
    return write_table(folder / "newton.csv", {
        "time": time,
        "lat": voyage_latitude(voyage, time),
        "lon": voyage_longitude(voyage, time),
        "heading_deg": DEG * voyage.at("heading", time),
        "speed_mps": voyage.at("surge", time),
        "thruster_1 (N)": np.round(30 * left * trim, 2),
        "thruster_2 (N)": np.round(30 * right * trim, 2),
        "thruster_3 (N)": np.round(30 * left, 2),
        "thruster_4 (N)": np.round(30 * right, 2),
    })  # fmt: skip


def rudder_table(folder: Path, voyage: Voyage) -> Path:
    time = rows(voyage)
    left, right = voyage.at("command_left", time), voyage.at("command_right", time)
    return write_table(folder / "rudder.csv", {
        "time": time,
        "lat": voyage_latitude(voyage, time),
        "lon": voyage_longitude(voyage, time),
        "heading": DEG * voyage.at("heading", time),
        "speed": voyage.at("surge", time),
        "thrust": np.round(100 * (left + right) / 2, 1),
        "rudder": np.round(np.clip(60 * (left - right), -45, 45), 1),
    })  # fmt: skip


def positions_table(folder: Path, voyage: Voyage) -> Path:
    time = rows(voyage, 5.0)
    return write_table(folder / "positions.csv", {
        "time": time,
        "Latitude": voyage_latitude(voyage, time),
        "Longitude": voyage_longitude(voyage, time),
        "Heading": DEG * voyage.at("heading", time),
        "Motor_L": np.round(voyage.at("command_left", time), 3),
        "Motor_R": np.round(voyage.at("command_right", time), 3),
    })  # fmt: skip


def nameless_table(folder: Path, voyage: Voyage) -> Path:
    time = rows(voyage)
    return write_table(folder / "nameless.csv", {
        "t": time,
        "c2": np.round(1500 + 400 * voyage.at("command_right", time)),
        "c3": voyage.at("surge", time),
        "c4": voyage_latitude(voyage, time),
        "c5": DEG * voyage.at("heading", time),
        "c6": voyage.at("yaw_rate", time),
        "c7": voyage_longitude(voyage, time),
        "c8": np.round(1500 + 400 * voyage.at("command_left", time)),
        "c9": 24 + np.sin(time / 300),
    })  # fmt: skip


def crowded_table(folder: Path, voyage: Voyage) -> Path:
    time = rows(voyage)
    rng = np.random.default_rng(8)
    speed, heading = voyage.at("surge", time), voyage.at("heading", time)
    gps = np.repeat(speed[::5], 5)[: len(time)]
    return write_table(folder / "crowded.csv", {
        "time": time,
        "utc": [(BEGIN + timedelta(seconds=float(each))).isoformat() for each in time],
        "wind_speed": 4 + np.cumsum(rng.normal(0, 0.02, len(time))),
        "wind_direction": (200 + 0.1 * np.cumsum(rng.normal(0, 1, len(time)))) % 360,
        "battery_voltage": 25 - time / 2000,
        "battery_current": 2 + 10 * np.abs(voyage.at("command_left", time)),
        "desired_speed": np.round(speed + 0.3, 1),
        "desired_heading": np.round(DEG * heading, -1) % 360,
        "roll": rng.normal(0, 2, len(time)),
        "pitch": rng.normal(0, 1, len(time)),
        "gps_lat": voyage_latitude(voyage, time),
        "gps_lon": voyage_longitude(voyage, time),
        "gps_speed_kn": np.round(KNOTS * np.abs(gps), 2),
        "gps_course": np.round(DEG * voyage.at("course", time), 1),
        "ekf_speed": speed,
        "log_speed_kmh": np.round(KMH * np.abs(speed) + rng.normal(0, 0.1, len(time)), 1),
        "compass_heading": DEG * heading,
        "gyro_x": rng.normal(0, 0.1, len(time)),
        "gyro_y": rng.normal(0, 0.1, len(time)),
        "gyro_z": voyage.at("yaw_rate", time),
        "cmd_left": voyage.at("command_left", time),
        "cmd_right": voyage.at("command_right", time),
    })  # fmt: skip


def plain_table(folder: Path, voyage: Voyage) -> Path:
    time = rows(voyage)
    return write_table(folder / "plain.csv", {
        "time": time,
        "command_left": voyage.at("command_left", time),
        "command_right": voyage.at("command_right", time),
        "heading": DEG * voyage.at("heading", time),
        "surge": voyage.at("surge", time),
    })  # fmt: skip


def east_table(folder: Path, voyage: Voyage) -> Path:
    """Yaw from east, counter-clockwise; local coordinates x east, y north."""
    time = rows(voyage)
    return write_table(folder / "east.csv", {
        "stamp": time,
        "lat": voyage_latitude(voyage, time),
        "lon": voyage_longitude(voyage, time),
        "yaw": enu(voyage.at("heading", time)),
        "yaw_rate": -voyage.at("yaw_rate", time),
        "vel": voyage.at("surge", time),
        "left_motor": np.round(255 * voyage.at("command_left", time)),
        "right_motor": np.round(255 * voyage.at("command_right", time)),
    })  # fmt: skip


def velocities_table(folder: Path, voyage: Voyage) -> Path:
    time = rows(voyage)
    speed, heading = voyage.at("surge", time), voyage.at("heading", time)
    return write_table(folder / "velocities.csv", {
        "time": time,
        "vn": speed * np.cos(heading),
        "ve": speed * np.sin(heading),
        "lat": voyage_latitude(voyage, time),
        "lon": voyage_longitude(voyage, time),
        "heading": DEG * heading,
        "thrust_left": 100 * voyage.at("command_left", time),
        "thrust_right": 100 * voyage.at("command_right", time),
    }, delimiter="\t")  # fmt: skip


def on_change(folder: Path, voyage: Voyage) -> Path:
    return write_alog(folder / "on_change.alog", {
        "THRUST_LEFT": scaled(voyage.command_left, 100),
        "THRUST_RIGHT": scaled(voyage.command_right, 100),
        "GPS_SPEED": voyage.surge,
        "COMPASS_HEADING": scaled(voyage.heading, DEG),
        "LATITUDE": voyage.latitude,
        "LONGITUDE": voyage.longitude,
    })  # fmt: skip


def adrift(voyage: Voyage) -> dict[str, np.ndarray]:
    """A voyage with a sway, to starboard: stamps, sway, and the position that it makes, m and degrees."""
    time = rows(voyage)
    slow = np.convolve(np.random.default_rng(7).normal(0, 1, len(time) + 99), np.ones(100) / 10, "valid")
    sway = -0.3 * np.interp(time, *voyage.yaw_rate) * voyage.at("surge", time) + 0.1 * slow
    heading = voyage.at("heading", time)
    moved = (voyage.at("surge", time) + 1j * sway) * np.exp(1j * heading)
    place = np.cumsum(moved) * 0.1 + np.random.default_rng(8).normal(0, 0.02, (2, len(time))).T @ [1, 1j]
    return {
        "time": time,
        "sway": sway,
        "north": place.real,
        "east": place.imag,
        "lat": np.round(START[0] + np.degrees(place.real / EARTH), 8),
        "lon": np.round(START[1] + np.degrees(place.imag / EARTH / math.cos(math.radians(START[0]))), 8),
    }


def sway_table(folder: Path, voyage: Voyage) -> Path:
    """A sway in knots, under a German name."""
    own = adrift(voyage)
    time = own["time"]
    return write_table(folder / "sway.csv", {
        "time": time,
        "Breite": own["lat"],
        "Länge": own["lon"],
        "Steuerkurs (°)": DEG * voyage.at("heading", time),
        "Geschwindigkeit (kn)": KNOTS * voyage.at("surge", time),
        "Quergeschwindigkeit (kn)": KNOTS * own["sway"],
        "Schub links (%)": 100 * voyage.at("command_left", time),
        "Schub rechts (%)": 100 * voyage.at("command_right", time),
    })  # fmt: skip


def port_table(folder: Path, voyage: Voyage) -> Path:
    """A velocity in the axes of ROS: x ahead, y to port, beside a yaw from east."""
    own = adrift(voyage)
    time = own["time"]
    return write_table(folder / "port.csv", {
        "time": time,
        "latitude": own["lat"],
        "longitude": own["lon"],
        "yaw": enu(voyage.at("heading", time)),
        "twist.linear.x": voyage.at("surge", time),
        "twist.linear.y": -own["sway"],
        "left_motor": voyage.at("command_left", time),
        "right_motor": voyage.at("command_right", time),
    })  # fmt: skip
