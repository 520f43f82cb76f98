"""The parameters of a PX4 tell which motors and servos drive a boat, as those of an ArduPilot do."""

import numpy as np
import pytest

from tests.support.strangers import sail, told
from tests.support.ulogs import header, message, parameters, subscribe
from usvlearn.logs.channels.channel import Source
from usvlearn.logs.formats.px4.ulog import Ulog
from usvlearn.logs.inspection.candidate import candidates
from usvlearn.logs.inspection.proposal import propose

FORMATS = {
    "actuator_motors": "uint64_t timestamp;float[4] control;",
    "actuator_servos": "uint64_t timestamp;float[4] control;",
    "actuator_outputs": "uint64_t timestamp;float[4] output;",
    "vehicle_local_position": "uint64_t timestamp;float heading;float vx;float vy;",
}
NAN = float("nan")
PWM = {f"PWM_{bank}_{name}": value for bank in ("MAIN", "AUX") for k in range(1, 5)
       for name, value in ((f"MIN{k}", 1100), (f"MAX{k}", 1900), (f"DIS{k}", 1000))}  # fmt: skip
SIDES = {"CA_ROTOR0_PY": 0.3, "CA_ROTOR1_PY": -0.3}  # motor 1 is to starboard


def written(path, stated, **rows):
    """A log with some rows of 4 numbers of each topic, `topic__1` for its second instance."""
    data = [header(FORMATS), parameters(**stated)]
    for number, (name, values) in enumerate(rows.items()):
        topic, _, instance = name.partition("__")
        data.append(subscribe(number, topic, int(instance or 0)))
        data += [message(number, 250_000 * k, f"{len(row)}f", *row) for k, row in enumerate(values)]
    path.write_bytes(b"".join(data))
    return path


@pytest.mark.parametrize(
    ("stated", "logged", "expected"),
    [
        (SIDES, {"actuator_motors": [0.5, -1, NAN, NAN]}, {"motors throttle_left": -1, "motors throttle_right": 0.5}),
        (
            {f"CA_ROTOR{k}_PY": -0.2 + 0.4 * (k % 2) for k in range(4)} | {"CA_AIRFRAME": 9},
            {"actuator_motors": [0.5, -1, 0.3, NAN]},  # two of each side; the last is not there
            {"motors throttle_left": 0.4, "motors throttle_right": -1},
        ),
        (
            SIDES | PWM | {"PWM_MAIN_FUNC4": 101, "PWM_MAIN_FUNC1": 102, "PWM_MAIN_REV": 8, "CA_R_REV": 3},
            {"actuator_outputs": [1700, 1500, 1500, 1600]},
            {"outputs throttle_left": 0.5, "outputs throttle_right": -0.25},
        ),
        (
            SIDES | PWM | {"PWM_AUX_FUNC2": 101, "PWM_AUX_FUNC3": 102, "PWM_AUX_REV": 0, "CA_R_REV": 0},
            {"actuator_outputs": [0, 0, 0, 0], "actuator_outputs__1": [1500, 1300, 1000, 0]},
            {"outputs[1] throttle_left": 0, "outputs[1] throttle_right": 0.25},  # never astern; disarmed
        ),
        (
            SIDES | {"PWM_MAIN_FUNC1": 102, "PWM_MAIN_FUNC2": 101},
            {"actuator_outputs": [1600, 1400, 0, 0]},
            {"outputs throttle_left": 1600, "outputs throttle_right": 1400},  # without limits: pulses
        ),
        (
            {"CA_AIRFRAME": 5},
            {"actuator_motors": [0.5, NAN, NAN, NAN], "actuator_servos": [-0.4, NAN, NAN, NAN]},
            {"motors throttle": 0.5, "servos steering": -0.4},
        ),
        ({"CA_AIRFRAME": 6}, {"actuator_motors": [1, 0.5, NAN, 0]}, {"motors motor_1": 1, "motors motor_2": 0.5}),
        ({"CA_AIRFRAME": NAN, "CA_ROTOR0_PY": NAN, "CA_ROTOR1_PY": 0.0}, {"actuator_motors": [1, 0.5, 0, 0]}, {}),
    ],
)  # fmt: skip
def test_what_parameters_tell_of_each_actuator(stated, logged, expected, tmp_path):
    path = written(tmp_path / "a.ulg", stated, **{name: [row] * 2 for name, row in logged.items()})
    series = {f"{each.name} {each.field}": each for each in Ulog().survey(path)}
    assert {name for name in series if not name.endswith("]")} == {f"actuator_{name}" for name in expected}
    for name, value in expected.items():
        each = series[f"actuator_{name}"]
        np.testing.assert_allclose(each.value, value, atol=1e-6)
        assert each.unit == "1"
        channel = Ulog().read(path, {"surge": Source(each.name, field=each.field)})[0]["surge"]
        np.testing.assert_array_equal(channel.value, each.value)


@pytest.mark.parametrize(
    ("stated", "shown", "left", "sure"),
    [
        (SIDES, "motors", "motors throttle_left", "certain"),
        ({name: -y for name, y in SIDES.items()}, "motors", "motors throttle_right", "unsure"),  # contradicted
        ({"CA_AIRFRAME": 6}, "motors", "motors motor_2", "probable"),
        (
            SIDES | PWM | {"PWM_MAIN_FUNC4": 101, "PWM_MAIN_FUNC1": 102, "PWM_MAIN_REV": 0, "CA_R_REV": 3},
            "outputs",
            "outputs throttle_left",
            "certain",
        ),
        ({"CA_AIRFRAME": 6} | PWM | {"PWM_MAIN_FUNC4": 101, "PWM_MAIN_FUNC1": 102}, "outputs", "outputs motor_2",
         "probable"),
    ],
)  # fmt: skip
def test_a_boat_whose_first_motor_is_to_starboard(stated, shown, left, sure, tmp_path):
    boat = sail(6.0, lowest=0.0)
    l, r = boat["l"], boat["r"]  # noqa: E741
    heading, u, v = np.angle(np.exp(1j * boat["psi"])), boat["u"], boat["v"]
    north, east = u * np.cos(heading) - v * np.sin(heading), u * np.sin(heading) + v * np.cos(heading)
    pulse, other = (np.round(1500 + 400 * each) for each in (l, r))
    rows = {"motors": (r, l, r * NAN, r * NAN), "outputs": (pulse, 1400 + 200 * np.sin(boat["time"]), pulse * 0, other)}
    logged = {f"actuator_{shown}": np.transpose(rows[shown]).tolist()}
    motion = np.transpose([heading, north, east]).tolist()
    path = written(tmp_path / "a.ulg", stated, **logged, vehicle_local_position=motion)
    decided = told(propose(candidates(Ulog().survey(path)), "PX4 ULog"))
    assert decided["command_left", "series"] == (f"actuator_{left}", sure)
