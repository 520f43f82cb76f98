"""A boat whose equations are not those of the product, with its logs: what `strangers.py` runs without other boats.

Its thrust falls with the inflow as a propeller's does, its drag has a hump, and the hull drifts outwards in turns.
"""

import math
from dataclasses import dataclass

import numpy as np

STEP = 0.05  # s


@dataclass(frozen=True)
class Boat:
    mx: float = 90.0  # kg
    full: float = 70.0  # N, of a side at standstill
    pitch: float = 5.0  # m/s of inflow at which a full propeller pushes no more
    dead: float = 0.04  # share of the command without thrust
    declination: float = 4.0  # deg
    current: float = 0.25  # m/s
    gyro: bool = True


BOATS = {"propellers": Boat(), "without_gyro": Boat(gyro=False, declination=0.0, dead=0.08)}


def thrust(boat: Boat, command: float, u: float) -> float:
    n = math.copysign(max(abs(command) - boat.dead, 0.0) / (1 - boat.dead), command)  # revolutions
    return boat.full * (n * abs(n) - abs(n) * u / boat.pitch)


def drag(u: float) -> float:
    return (1 + 0.3 * math.exp(-((abs(u) / 1.2 - 1) ** 2))) * (6 * u + 14 * u * abs(u))


def moved(boat: Boat, state: np.ndarray, left: float, right: float, force: float = 0.0) -> np.ndarray:
    """(u, v, r, both thrusts) a step later."""
    u, v, r, f, g = state
    ahead, turn = f + g - drag(u) + 25 * v * r + force, 0.5 * (f - g) - 18 * r - 22 * abs(r) * r - 7 * abs(u) * r
    lags = (thrust(boat, left, u) - f) / 0.2, (thrust(boat, right, u) - g) / 0.2
    return state + STEP * np.array([ahead / boat.mx, -0.3 * u * r - v, turn / 24, *lags])


def truth(boat: Boat) -> dict[str, float]:
    """The quantities in the words of the product, SI."""
    values = {"thrust_full_left": boat.full, "thrust_full_right": boat.full}
    for name, left, right in (("full", 1, 1), ("half", 0.5, 0.5), ("quarter", 0.25, 0.25), ("turn", 0.5, 0.25)):
        state = np.zeros(5)
        for _ in range(2000):
            state = moved(boat, state, left, right)
        values["yaw_rate_half" if name == "turn" else f"steady_speed_{name}"] = float(state[2 if name == "turn" else 0])
    return values | {"drag_half_speed": drag(values["steady_speed_full"] / 2)}


def mission(boat: Boat, seconds: float, rng: np.random.Generator) -> list[tuple[float, ...]]:
    """Time, commands, compass, gyro, speed, course and position of a helmsman who changes throttle and heading."""
    state, place, rows, psi, wave, throttle, want, change = np.zeros(5), np.zeros(2), [], 0.0, 0.0, 0.0, 0.0, 0.0
    drift = boat.current * np.array([math.cos(way := rng.uniform(0, 6)), math.sin(way)])
    for k in range(int(seconds / STEP)):
        if k * STEP >= change:
            throttle, want = rng.choice([0, 0.1, 0.2, 0.35, 0.5, 0.7, 1]), want + rng.uniform(-2, 2)
            change += rng.uniform(8, 40)
        steer = float(np.clip(0.8 * ((want - psi + math.pi) % (2 * math.pi) - math.pi) - 0.6 * state[2], -0.5, 0.5))
        left, right = np.clip([throttle + steer, throttle - steer], -1, 1)
        wave += STEP * (-wave / 3) + rng.normal(0, 0.6)
        state = moved(boat, state, left, right, wave)
        psi, c, s = psi + STEP * state[2], math.cos(psi), math.sin(psi)
        ground = np.array([state[0] * c - state[1] * s, state[0] * s + state[1] * c]) + drift
        place = place + STEP * ground
        if k % 4 == 0:
            v, fix = ground + rng.normal(0, 0.04, 2), 47 + (place + rng.normal(0, 0.4, 2)) / [111320, 75919]
            angles = np.degrees([psi, state[2] + rng.normal(0, 0.005), math.atan2(v[1], v[0])])
            compass = (angles[0] + boat.declination + rng.normal(0, 0.8)) % 360
            rows.append((k * STEP, left, right, compass, angles[1], math.hypot(*v), angles[2] % 360, *fix))
    return rows


def write(path, boat: Boat, rows: list[tuple[float, ...]]) -> None:
    head = "time [s],left,right,heading [deg],yaw rate [deg/s],sog [m/s],cog [deg],latitude,longitude".split(",")
    use = [k for k in range(len(head)) if boat.gyro or k != 4]
    lines = [",".join(head[k] for k in use), *(",".join(f"{row[k]:.8f}" for k in use) for row in rows)]
    path.write_text("\n".join(lines) + "\n")
