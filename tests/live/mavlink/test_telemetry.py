"""What is sent fits the version of MAVLink that the vehicle speaks, is never too much, and never old."""

import math

import pytest

pytest.importorskip("pymavlink", reason="needs the package pymavlink")

from tests.support.mavboat import mavlink
from usvlearn.live.health import COMPILING
from usvlearn.live.mavlink.messages import BURST, INFO, ROOM, WRAP, Frames, Telemetry
from usvlearn.live.node import Step
from usvlearn.live.status import TABLE, Post, of_health, of_step


def sent(telemetry: Telemetry) -> list:
    content = b"".join(telemetry.queue)
    telemetry.queue.clear()
    return Frames(mavlink).take(content)


def test_every_number_that_is_published_has_a_name_of_ten_characters_or_none():
    names = [each.short for each in TABLE if each.short]
    assert len(names) == len(set(names)) == 9 and all(0 < len(name) <= 10 and name.isascii() for name in names)


def test_numbers_carry_the_time_of_the_vehicle_and_only_what_a_float_holds():
    telemetry = Telemetry(mavlink)
    telemetry.values(WRAP / 1000 + 1.5, [Post("SPEED_PRED", 1.25), Post("SPEED_LOW", math.nan), Post("ALARM", "text")])
    telemetry.values(math.nan, [Post("SPEED_HIGH", 1e300), Post("SPEED_HIGH", math.inf), Post("SPEED_NEXT", -2.0)])
    assert [(m.time_boot_ms, m.name, m.value) for m in sent(telemetry)] == [
        (1500, "USV_PRED", 1.25),
        (0, "USV_NEXT", -2.0),
    ]


def test_a_step_and_a_health_are_sent_as_numbers():
    telemetry, nan = Telemetry(mavlink), math.nan
    for step in (
        Step(10.0, 1.5, 1.25, 1.0, 1.5, 1.375, 1.0, 1.75, {0.4: (1.0, 0.5, 1.5)}, {}, {"aid": 1.0}, ()),
        Step(10.4, nan, nan, nan, nan, 1.5, nan, nan, {}, {}, {}, ()),
    ):
        telemetry.values(step.time, of_step(step))
    network = {"contracting": True, "condition": "l2", "rate": 0.75, "time_constant": 1.0, "equilibrium": -0.5}
    telemetry.values(10.5, of_health(COMPILING._replace(contraction={"rnn": network})))
    values = [(m.time_boot_ms, m.name, m.value) for m in sent(telemetry)]
    assert values[:7] == [
        (10_000, "USV_PRED", 1.25), (10_000, "USV_LOW", 1.0), (10_000, "USV_HIGH", 1.5), (10_000, "USV_ERR", 0.25),
        (10_000, "USV_NEXT", 1.375), (10_000, "USV_NLOW", 1.0), (10_000, "USV_NHIGH", 1.75),
    ]  # fmt: skip
    assert values[7:] == [(10_400, "USV_NEXT", 1.5), (10_500, "USV_K", 0.75), (10_500, "USV_EQ", -0.5)]


@pytest.mark.parametrize("length", [1, 49, 50, 51, 99, 100, 149, 200, 500])
def test_a_long_text_is_sent_in_parts_that_end(length):
    telemetry = Telemetry(mavlink)
    text = ("0123456789" * 50)[:length]
    assert telemetry.say(text, INFO, 0.0)
    parts = sent(telemetry)
    assert "".join(part.text for part in parts) == (text if length <= 200 else text[:196] + " ...")
    if length <= 50:
        assert [part.id for part in parts] == [0]
    else:
        assert len({part.id for part in parts}) == 1 and parts[0].id
        assert [part.chunk_seq for part in parts] == list(range(len(parts)))
        assert len(parts[-1].text) < 50 and all(len(part.text) == 50 for part in parts[:-1])


def test_a_text_in_mavlink_1_is_cut_and_what_is_not_ascii_replaced():
    telemetry = Telemetry(mavlink)
    telemetry.old = True
    telemetry.say("é" + 60 * "x", INFO, 0.0)
    assert telemetry.queue[0][0] == 0xFE
    (only,) = sent(telemetry)
    assert only.text == "?" + 45 * "x" + " ..."


def test_no_word_of_a_text_is_cut():
    telemetry = Telemetry(mavlink)
    telemetry.say("usvlearn: the left thruster gives 40 % of its thrust (20 ... 60 %), since 12 s", INFO, 0.0)
    assert [part.text.strip() for part in sent(telemetry)] == [
        "usvlearn: the left thruster gives 40 % of its", "thrust (20 ... 60 %), since 12 s",
    ]  # fmt: skip


def test_texts_are_sent_seldom_and_the_same_one_not_again():
    telemetry = Telemetry(mavlink)
    assert sum(telemetry.say(f"text {k}", INFO, 0.0) for k in range(100)) == BURST
    assert sum(telemetry.say(f"later {now}", INFO, float(now)) for now in range(1, 101)) == 50
    assert not telemetry.say("later 100", INFO, 120.0) and telemetry.say("later 100", INFO, 200.0)
    assert telemetry.left_out == 100 - BURST + 50 + 1


def test_what_nobody_takes_gives_way_to_what_is_new():
    telemetry = Telemetry(mavlink)
    for k in range(ROOM + 10):
        telemetry.values(float(k), [Post("SPEED_PRED", float(k))])
    values = sent(telemetry)
    assert [m.value for m in values] == [float(k) for k in range(10, ROOM + 10)]
    assert [m.get_seq() for m in values[:3]] == [10, 11, 12]  # so a receiver sees that some were lost
