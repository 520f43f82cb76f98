"""The words of a name in a log, and how well they fit each channel that is looked for.

A name says what its author meant, in one of a few languages and in abbreviations. It is a hint: the numbers decide
where they can.
"""

from __future__ import annotations

import re
import unicodedata
from functools import cache

from usvlearn.logs.formats.csv.dialect import UNIT_NAMES
from usvlearn.logs.inspection import languages

SPLIT = re.compile(r"[23][dD]\b|[A-Z]+(?=[A-Z][a-z])|[A-Z]?[a-z]+|[A-Z]+|\d+")

LEFT = {"left", "l", "port", "prt", "bb"} | languages.LEFT
RIGHT = {"right", "r", "starboard", "stbd", "sb", "stb"} | languages.RIGHT
SIDES = LEFT | RIGHT | languages.SHORT_LEFT | languages.SHORT_RIGHT
SETPOINT = {"desired", "des", "set", "setpoint", "sp", "ref", "reference", "target", "goal", "want", "wanted", "demand",
            "demanded", "planned", "commanded", "input"} | languages.SETPOINT  # fmt: skip
DERIVED = {"error", "err", "sigma", "gain", "bias", "var", "variance", "std", "accuracy", "acc", "accel",
           "acceleration", "cov", "covariance", "dot", "max", "min", "limit", "avg", "mean", "zero", "point",
           "offset", "upper", "lower", "status", "mode", "flag", "id", "seq", "count", "integral", "iter", "len",
           "gap", "age"}  # fmt: skip
FOREIGN = {"wind", "water", "solar", "sun", "battery", "batt", "bat", "vbat", "vbatt", "voltage", "volt", "current",
           "temp", "temperature", "depth", "pressure", "sway", "roll", "pitch", "heave", "wave", "altitude", "alt",
           "mag", "camera", "rssi", "cpu", "air", "wp", "waypoint", "rc", "vertical", "climb", "down", "lateral",
           "sideways", "transverse", "rollspeed", "pitchspeed"} | languages.FOREIGN | languages.SIDEWAYS  # fmt: skip

ENGLISH: dict[str, dict[str, float]] = {  # role -> word -> how strongly it names the role
    "heading": {"heading": 3, "hdg": 3, "hdt": 3, "yaw": 3, "psi": 2, "theta": 1.5, "compass": 2, "orientation": 2,
                "quaternion": 2, "head": 2, "attitude": 1},
    "course": {"course": 3, "cog": 3, "track": 2, "ground": 0.5, "gprmc": 1, "gcrs": 3, "gps": 0.5, "cap": 0.5,
               "hdg": 0.5},
    "yaw_rate": {"yawrate": 3, "rate": 1, "rot": 2, "r": 1, "gyroz": 2.5, "gyrz": 2.5, "wz": 2, "yawspeed": 3},
    "surge": {"surge": 3.5, "speed": 2.5, "spd": 2.5, "sog": 2.5, "velocity": 2, "vel": 2, "u": 1.5, "vx": 2,
              "stw": 2, "groundspeed": 2.5, "v": 1, "knots": 1.5, "kn": 1, "sow": 2},
    "sway": {"sway": 3.5, "lateral": 2, "sideways": 2, "transverse": 2, "vy": 1.5},
    "latitude": {"latitude": 3, "lat": 3},
    "longitude": {"longitude": 3, "lon": 3, "lng": 3, "long": 3},
    "north": {"north": 3, "northing": 3, "n": 1},
    "east": {"east": 3, "easting": 3, "e": 1},
    "velocity_north": {"vn": 3, "veln": 3, "vnorth": 3},
    "velocity_east": {"ve": 3, "vele": 3, "veast": 3},
    "command": {"thrust": 3, "thruster": 3, "thr": 3, "motor": 2.5, "pwm": 2.6, "esc": 2.6, "servo": 2, "throttle": 3,
                "prop": 2, "propeller": 2.5, "drive": 2, "cmd": 2, "command": 2.5, "power": 1.5, "actuator": 2,
                "output": 1, "rcou": 2, "engine": 2, "propulsion": 2, "m": 1, "t": 0.5, "c": 0.5, "ch": 0.5,
                "rpm": 1.8, "rps": 1.8, "rev": 1.8, "n": 1.5, "duty": 1.8},
    "rudder": {"rudder": 3, "steer": 3, "steering": 3, "rud": 3, "nozzle": 2, "helm": 2.5, "delta": 2},
}  # fmt: skip
WORDS = {role: languages.weights(role) | english for role, english in ENGLISH.items()}
PLURALS: dict[str, str] = {f"{word}s": word for word in ENGLISH["command"] if len(word) > 2}  # as in motors.port
TURNS = {"yaw", "heading", "turn", "psi", "hdg", "theta", "head"} | languages.TURNS
RATES = {"rate", "dot", "speed", "vel", "velocity", "rotation"} | languages.RATES
OVER_GROUND = {"ground", "gprmc", "gps"} | languages.OVER_GROUND
FORCES = {"tau", "force", "wrench", "kraft", "fx"}  # of the whole boat, beside an axis
MOMENTS = {"tau", "torque", "moment", "wrench", "mz"}
SYMBOLS = {"command": {"m", "t", "c", "ch", "n"}, "rudder": {"delta"}, "surge": {"u", "v"}}  # in names of their own
BESIDE = set("cmd command order measured meas actual act real ist out output hat boat ship usv main ekf est filtered "
             "body b m r x y z".split())  # fmt: skip
NO_THRUST = set(
    "distance dist range bearing energy odometer fuel charge watts watt wh kwh mah strecke distanz peilung energie "
    "afstand distancia distanza avstand".split()
)
LATERAL = {"tunnel", "bowthruster", "sternthruster"} | languages.LATERAL
OTHER_UNITS = set("m km V mV A mA W kW Wh kWh Ah mAh J kJ Hz Pa hPa bar °C degC dB m/s/s".split())  # of neither
AZIMUTHS = {"azimuth", "azimuths", "azi", "azipod"}
AHEAD, ABOUT = {"x", "u", "surge", "ahead", "forward", "1", "fx"}, {"z", "n", "r", "psi", "yaw", "3", "6", "mz"}
SIDED = {"pwm", "thrust", "thruster", "motor", "cmd", "esc", "prop", "thr", "throttle", "drive"}
MIDDLE = {"mid", "middle", "center", "centre", "mitte", "milieu", "centro"}
SPEED_SETS = {"linear", "vel", "velocity"}  # names of commands that are no thrust, such as cmd_vel linear.x
GEARS = {"gear", "direction", "dir", "reverse", "rev", "astern", "ahead", "forward", "clutch"} | languages.GEARS
DRIVES = {"rpm", "thrust", "thruster", "motor", "pwm", "esc", "servo", "throttle", "prop", "propeller",
          "tau", "force", "wrench", "torque", "moment"} | languages.DRIVES  # fmt: skip
COMMANDED = {"cmd", "command", "commanded"}
NUMBER = {"value", "data", "field", "log"}  # names of the only column of a topic, or of a whole log
UNIT_WORDS = {  # words of a name that tell a unit
    **{word: unit for unit in ("deg", "knots", "percent") for x in UNIT_NAMES[unit] for word in languages.spelled(x)},
    "rad": "rad", "radian": "rad", "radians": "rad", "kmh": "km/h", "kph": "km/h", "mps": "m/s", "ms": "m/s",
    "newton": "N", "newtons": "N", "pwm": "us", "us": "us", "mm": "mm/s", "cm": "cm/s", "mph": "mph", "fps": "ft/s",
    "dpm": "deg/min",
}  # fmt: skip


@cache
def words(name: str) -> tuple[str, ...]:
    """The words of a name, in lower case, without accents; of a topic those of its last two parts."""
    text = "/".join(unicodedata.normalize("NFC", name).split("/")[-2:])
    text = re.sub("St[Bb](?![a-z])", " stb ", text)  # not st, b
    text = re.sub(r"[^\W\d_]+", lambda match: _ascii(match[0]), text)
    tokens: list[str] = []
    for each in map(str.lower, SPLIT.findall(text)):
        word = PLURALS.get(each, each)
        if word[0] in "lr" and word[1:] in SIDED:
            tokens += [word[0], word[1:]]
        elif word == "mps" or not (tokens and tokens[-1] == "m" and word == "s"):
            tokens.append(word)
        else:
            tokens[-1] = "mps"
    return tuple(tokens)


def _ascii(word: str) -> str:
    """A word in ASCII that keeps its capitals, which tell where the words of a name begin."""
    plain = [each if each.isascii() else languages.plain(each) for each in word]
    return "".join(new.capitalize() if old.isupper() else new for old, new in zip(word, plain, strict=True))


def names_azimuth(name: str) -> bool:
    """Whether a name tells the angle of a thruster that turns."""
    tokens = set(words(name))
    turned = AZIMUTHS & tokens or ({"angle", "alpha", "winkel", "azimuth"} & tokens and {"thruster", "pod"} & tokens)
    return bool(turned) and not FOREIGN & tokens


def names_force(name: str) -> bool:
    """Whether a name tells the force ahead of all thrusters together."""
    tokens = set(words(name))
    return bool(FORCES & tokens and AHEAD & tokens) and not {"torque", "moment", "y", "v"} & tokens


def names_moment(name: str) -> bool:
    """Whether a name tells the moment of all thrusters about the vertical axis."""
    tokens = set(words(name))
    return bool(MOMENTS & tokens and ABOUT & tokens) and not {"force", "kraft"} & tokens


def fit(role: str, name: str) -> float:
    """How well a name fits a role: 3 names it plainly, 1 is a hint, 0 says nothing, less speaks against it."""
    spoken = words(name)
    tokens = set(spoken)
    if len(spoken) > 1 and spoken[-1] == "d" and not spoken[-2].isdigit():
        tokens.add("desired")  # as in psi_d
    plain = [word for word in tokens - UNIT_WORDS.keys() - NUMBER - SIDES - BESIDE if not word.isdigit()]
    symbols = SYMBOLS.get(role, set()) if len(plain) > 1 else set()
    score = max((WORDS[role].get(word, 0) for word in tokens - symbols), default=0)
    rate = bool(TURNS & tokens and RATES & tokens) or (
        "z" in tokens and bool({"angular", "gyro", "gyr", "omega"} & tokens) and "accel" not in tokens
    )
    over_ground = bool(OVER_GROUND & tokens)
    if role == "yaw_rate":
        score = 3 if rate else 0.5 if {"z"} & tokens and {"vel", "velocity", "twist"} & tokens else score
        score -= 4 * bool({"x", "y", "roll", "pitch", "p", "q", "climb"} & tokens and not rate)
        score -= 4 * bool({"linear"} & tokens)
    elif role == "heading":
        score -= 4 * rate + 2 * (over_ground and score > 0) + 2 * bool({"course", "cog"} & tokens)
    elif role == "course":
        turned = bool({"heading", "hdg", "kurs", "kog", "course", "cog", "koers", "cap", "rumbo", "rumo"} & tokens)
        score = 3 if over_ground and turned else score if score >= 2 else 0
        score -= 4 * rate
    elif role.startswith("velocity"):
        axis = {"north", "n", "nord"} if role == "velocity_north" else {"east", "e", "ost"}
        score = 3 if axis & tokens and ({"v"} | RATES) & tokens else score
    elif role in ("north", "east"):
        score -= 4 * bool(({"v"} | RATES) & tokens)
    elif role == "sway":
        score -= 5 * bool({"angle", "error", "x", "z", "angular"} & tokens) + 4 * rate
    elif role == "surge":
        score -= 4 * rate + 4 * bool({"angular", "gyro", "gyr", "omega"} & tokens)
        across = {"y", "z", "d", "vy", "vz", "vd", "east", "north", "ost", "nord", "delta", "imu"}
        across -= {"y"} if "x" in tokens else set()
        score -= 3 * bool(across & tokens)
        if {"linear", "x"} <= tokens and not (SETPOINT | COMMANDED) & set(words(name.replace("/", "."))):
            score = max(score, 1) + 0.5  # of a twist, which is in the axes of the boat
    elif role == "command":
        score = min(score, 3) + 0.5 * bool(score and (LEFT | RIGHT) & tokens)
        score -= 4 * bool({"w", "kw", "wh", "watt", "watts"} & tokens)  # electrical power
        score -= 1 * bool({"force", "feedback", "kraft", "newton"} & tokens)
        score = 2.5 if names_force(name) else score - 4 * names_moment(name)
        sideways = LATERAL & tokens or ({"bow", "stern"} & tokens and not SIDES & tokens)
        score -= 4 * bool(NO_THRUST & tokens) + 4 * bool(sideways)
    elif role == "rudder" and names_moment(name):
        score = 2.5
    if role not in ("command", "rudder"):
        score -= 4 * bool(DRIVES & tokens)
        score -= 6 * bool(SETPOINT & tokens) + 3 * bool(COMMANDED & tokens)
    allowed = {"max", "min"} & WORDS[role].keys() | ({"dot"} if role == "yaw_rate" else set())
    allowed |= {"min"} if "/min" in name or {"deg", "degrees"} & tokens else set()  # a minute
    derived = DERIVED - allowed
    foreign = FOREIGN - WORDS["sway"].keys() if role == "sway" else FOREIGN
    return score - 5 * bool(derived & tokens and not (role == "yaw_rate" and rate)) - 4 * bool(foreign & tokens)


def side(name: str) -> str:
    """The side that a name tells, "left", "right" or "" (none, or both)."""
    tokens = set(words(name))
    left, right = bool(tokens & LEFT), bool(tokens & RIGHT)
    if tokens & WORDS["command"].keys():
        left, right = left or bool(tokens & languages.SHORT_LEFT), right or bool(tokens & languages.SHORT_RIGHT)
    return "" if left == right else "left" if left else "right"


def names_side_alone(name: str) -> bool:
    """Whether a name tells a side and, at most, a unit or the number of a table for each topic."""
    return bool(side(name)) and all(word in UNIT_WORDS or word in NUMBER for word in without_side(name))


def without_side(name: str) -> tuple[str, ...]:
    """The words of a name without those of a side: equal for the two channels of a pair."""
    return tuple(word for word in words(name) if word not in SIDES)


def unit_word(name: str) -> str:
    """A unit that stands in a name, or ""."""
    return next((UNIT_WORDS[word] for word in words(name) if word in UNIT_WORDS), "")
