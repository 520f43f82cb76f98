"""A simulated voyage as tables and MOOS logs in many shapes: names, units, languages, senses."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from tests.support.voyages import EARTH, START, Voyage

KNOTS, KMH, DEG = 3600 / 1852, 3.6, 180 / math.pi
BEGIN = datetime(2025, 7, 24, 17, 18, 48, tzinfo=UTC)


def rows(voyage: Voyage, hz: float = 10.0) -> np.ndarray:
    """Stamps of a table, s."""
    return np.arange(0.5, voyage.surge[0].max() - 0.5, 1 / hz)


class At:
    """What a voyage has at the stamps of a table, such as `at.surge`; angles in rad, `lat` and `lon` in degrees."""

    def __init__(self, voyage: Voyage, hz: float = 10.0):
        self.voyage, self.time = voyage, rows(voyage, hz)

    def __getattr__(self, name: str) -> np.ndarray:
        return self.voyage.at(name, self.time)

    @property
    def lat(self) -> np.ndarray:
        return np.round(np.interp(self.time, *self.voyage.latitude), 7)

    @property
    def lon(self) -> np.ndarray:
        return np.round(np.interp(self.time, *self.voyage.longitude), 7)

    @property
    def left(self) -> np.ndarray:
        return self.voyage.at("command_left", self.time)

    @property
    def right(self) -> np.ndarray:
        return self.voyage.at("command_right", self.time)


Writer = Callable[[Path, Voyage], Path]  # into a folder


def table(name: str, columns: Callable[[At], Mapping[str, Sequence]], hz: float = 10.0, **how: Any) -> Writer:
    """Writes the columns of a voyage to a CSV file of this name; `how` as of `write_table`."""
    return lambda folder, voyage: write_table(folder / name, columns(At(voyage, hz)), **how)


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
    rows = [(t, name, v) for name, (time, value) in posts.items() for t, v in zip(time, value, strict=True)]
    lines += [f"{t:<12.3f} {name:<20} {app:<12} {v:.5f}" for t, name, v in sorted(rows)]
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


def on_change(folder: Path, voyage: Voyage) -> Path:
    return write_alog(folder / "on_change.alog", {
        "THRUST_LEFT": scaled(voyage.command_left, 100),
        "THRUST_RIGHT": scaled(voyage.command_right, 100),
        "GPS_SPEED": voyage.surge,
        "COMPASS_HEADING": scaled(voyage.heading, DEG),
        "LATITUDE": voyage.latitude,
        "LONGITUDE": voyage.longitude,
    })  # fmt: skip


pwm_table = table("pwm.csv", lambda at: {
    "time": at.time, "lat": at.lat, "lon": at.lon,
    "heading": np.round(DEG * at.heading, 2),
    "yaw_rate": np.round(DEG * at.yaw_rate, 3),
    "speed": np.round(at.surge, 3),
    "pwm_left": np.round(1500 + 400 * at.left),
    "pwm_right": np.round(1500 + 400 * at.right),
    "battery": 25 - at.time / 1000,
})  # fmt: skip
german_table = table("fahrt.csv", lambda at: {
    "Zeit": [(BEGIN + timedelta(seconds=float(each))).strftime("%d.%m.%Y %H:%M:%S,%f")[:-3] for each in at.time],
    "Breite": at.lat,
    "Länge": at.lon,
    "Steuerkurs (°)": np.round(DEG * at.heading, 1),
    "Kurs über Grund (°)": np.round(DEG * at.course, 1),
    "Geschwindigkeit (km/h)": np.round(KMH * at.surge, 2),
    "Schub links (%)": np.round(100 * at.left),
    "Schub rechts (%)": np.round(100 * at.right),
}, 5.0, delimiter=";", comma=True, encoding="cp1252")  # fmt: skip
knots_table = table("knots.csv", lambda at: {
    "timestamp": np.round(1e3 * (BEGIN.timestamp() + at.time)), "latitude": at.lat, "longitude": at.lon,
    "sog": np.round(KNOTS * at.surge, 2),
    "cog": np.round(at.course, 3),
    "hdg": np.round(at.heading, 4),
    "throttle_port": np.round(at.left, 3),
    "throttle_starboard": np.round(at.right, 3),
})  # fmt: skip
reversed_table = table("reversed.csv", lambda at: {
    "t_ms": 1000 * at.time, "x_ned": at.north, "y_ned": at.east,
    "yaw": DEG * at.heading,
    "yaw_rate": at.yaw_rate,
    "surge": at.surge,
    "thr_left": np.round(1511 - 400 * at.left),
    "thr_right": np.round(1511 + 400 * at.right),
    "thr_left_pwm_zero_point": 1511 + 0 * at.time,
    "thr_right_pwm_zero_point": 1511 + 0 * at.time,
})  # fmt: skip


def newtons(at: At) -> dict[str, np.ndarray]:
    trim = np.repeat(np.random.default_rng(3).uniform(0.8, 1.0, len(at.time) // 100 + 1), 100)[: len(at.time)]
    return {
        "time": at.time, "lat": at.lat, "lon": at.lon,
        "heading_deg": DEG * at.heading,
        "speed_mps": at.surge,
        "thruster_1 (N)": np.round(30 * at.left * trim, 2),
        "thruster_2 (N)": np.round(30 * at.right * trim, 2),
        "thruster_3 (N)": np.round(30 * at.left, 2),
        "thruster_4 (N)": np.round(30 * at.right, 2),
    }  # fmt: skip


newton_table = table("newton.csv", newtons)
rudder_table = table("rudder.csv", lambda at: {
    "time": at.time, "lat": at.lat, "lon": at.lon,
    "heading": DEG * at.heading,
    "speed": at.surge,
    "thrust": np.round(100 * (at.left + at.right) / 2, 1),
    "rudder": np.round(np.clip(60 * (at.left - at.right), -45, 45), 1),
})  # fmt: skip
positions_table = table("positions.csv", lambda at: {
    "time": at.time, "Latitude": at.lat, "Longitude": at.lon,
    "Heading": DEG * at.heading,
    "Motor_L": np.round(at.left, 3),
    "Motor_R": np.round(at.right, 3),
}, 5.0)  # fmt: skip
nameless_table = table("nameless.csv", lambda at: {
    "t": at.time,
    "c2": np.round(1500 + 400 * at.right),
    "c3": at.surge,
    "c4": at.lat,
    "c5": DEG * at.heading,
    "c6": at.yaw_rate,
    "c7": at.lon,
    "c8": np.round(1500 + 400 * at.left),
    "c9": 24 + np.sin(at.time / 300),
})  # fmt: skip


def crowded(at: At) -> dict[str, Any]:
    rng, time, speed, heading = np.random.default_rng(8), at.time, at.surge, at.heading
    gps = np.repeat(speed[::5], 5)[: len(time)]
    return {
        "time": time,
        "utc": [(BEGIN + timedelta(seconds=float(each))).isoformat() for each in time],
        "wind_speed": 4 + np.cumsum(rng.normal(0, 0.02, len(time))),
        "wind_direction": (200 + 0.1 * np.cumsum(rng.normal(0, 1, len(time)))) % 360,
        "battery_voltage": 25 - time / 2000,
        "battery_current": 2 + 10 * np.abs(at.left),
        "desired_speed": np.round(speed + 0.3, 1),
        "desired_heading": np.round(DEG * heading, -1) % 360,
        "roll": rng.normal(0, 2, len(time)),
        "pitch": rng.normal(0, 1, len(time)),
        "gps_lat": at.lat,
        "gps_lon": at.lon,
        "gps_speed_kn": np.round(KNOTS * np.abs(gps), 2),
        "gps_course": np.round(DEG * at.course, 1),
        "ekf_speed": speed,
        "log_speed_kmh": np.round(KMH * np.abs(speed) + rng.normal(0, 0.1, len(time)), 1),
        "compass_heading": DEG * heading,
        "gyro_x": rng.normal(0, 0.1, len(time)),
        "gyro_y": rng.normal(0, 0.1, len(time)),
        "gyro_z": at.yaw_rate,
        "cmd_left": at.left,
        "cmd_right": at.right,
    }


crowded_table = table("crowded.csv", crowded)
plain_table = table("plain.csv", lambda at: {
    "time": at.time, "command_left": at.left, "command_right": at.right, "heading": DEG * at.heading, "surge": at.surge,
})  # fmt: skip
east_table = table("east.csv", lambda at: {  # yaw from east, counter-clockwise; local coordinates x east, y north
    "stamp": at.time, "lat": at.lat, "lon": at.lon,
    "yaw": enu(at.heading),
    "yaw_rate": -at.yaw_rate,
    "vel": at.surge,
    "left_motor": np.round(255 * at.left),
    "right_motor": np.round(255 * at.right),
})  # fmt: skip
velocities_table = table("velocities.csv", lambda at: {
    "time": at.time,
    "vn": at.surge * np.cos(at.heading),
    "ve": at.surge * np.sin(at.heading),
    "lat": at.lat,
    "lon": at.lon,
    "heading": DEG * at.heading,
    "thrust_left": 100 * at.left,
    "thrust_right": 100 * at.right,
}, delimiter="\t")  # fmt: skip


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


def sways(at: At) -> dict[str, np.ndarray]:
    """A sway in knots, under a German name."""
    boat = adrift(at.voyage)
    return {
        "time": at.time,
        "Breite": boat["lat"],
        "Länge": boat["lon"],
        "Steuerkurs (°)": DEG * at.heading,
        "Geschwindigkeit (kn)": KNOTS * at.surge,
        "Quergeschwindigkeit (kn)": KNOTS * boat["sway"],
        "Schub links (%)": 100 * at.left,
        "Schub rechts (%)": 100 * at.right,
    }


def sways_to_port(at: At) -> dict[str, np.ndarray]:
    """A velocity in the axes of ROS: x ahead, y to port, beside a yaw from east."""
    boat = adrift(at.voyage)
    return {
        "time": at.time,
        "latitude": boat["lat"],
        "longitude": boat["lon"],
        "yaw": enu(at.heading),
        "twist.linear.x": at.surge,
        "twist.linear.y": -boat["sway"],
        "left_motor": at.left,
        "right_motor": at.right,
    }


sway_table, port_table = table("sway.csv", sways), table("port.csv", sways_to_port)
