"""Logs in many shapes, exported by the simulator: what `usvlearn inspect` concludes, against the truth."""

import functools
from pathlib import Path

import numpy as np
import pytest

from tests.support import few
from tests.support.exported import write_table
from tests.support.shapes import SHAPES, Score, Shape, certainties, score
from tests.support.traps import TRAPS, columns
from tests.support.voyages import voyage
from usvlearn.logs.inspection.inspected import Inspected, inspect_logs
from usvlearn.logs.inspection.lag import DELAYS, choose


def inspected(folder: Path, shape: Shape, seed: int = 0, minutes: float = 6.0, **options) -> tuple[Inspected, Score]:
    result = inspect_logs([str(shape.write(folder, voyage(seed, minutes=minutes, **{**shape.options, **options})))])
    return result, score(result.proposal.channels, certainties(result.decisions), shape.truth)


@pytest.fixture(scope="module")
def scored(tmp_path_factory):
    """The score of a shape or a trap, each of which is inspected once."""
    return functools.cache(lambda name: inspected(tmp_path_factory.mktemp(name), (SHAPES | TRAPS)[name]))


@pytest.mark.parametrize("name", few(SHAPES, [*SHAPES][1::2], "thorough"))
def test_a_shape_is_read_as_it_was_written(scored, name):
    read, result = scored(name)
    assert result.wrong == []
    assert len(result.right) >= 0.9 * sum(map(len, result)), result.unsure
    assert len(read.recordings) == 1


@pytest.mark.thorough
def test_channels_and_units_are_right_in_95_percent(scored):
    results = [scored(name)[1] for name in SHAPES]
    right = sum(len(each.right) for each in results)
    assert right >= 0.95 * sum(sum(map(len, each)) for each in results), [each.unsure for each in results]


@pytest.mark.parametrize("name", few(TRAPS, [*TRAPS][::2], "thorough"))
def test_it_is_never_sure_of_what_is_wrong(scored, name):
    assert scored(name)[1].wrong == []


@pytest.mark.parametrize("name", ["tenths", "hundredths", "gradians"])
def test_a_heading_beyond_degrees_is_read_with_a_span(scored, name):
    read, result = scored(name)
    assert {"heading unit", "heading span"} <= set(result.right)
    heading = read.recordings[0].channels["heading"]
    assert np.abs(np.sin((heading.value - voyage(0, minutes=6.0).at("heading", heading.time + 0.5)) / 2)).max() < 0.01


def test_a_twist_that_follows_the_position_is_the_speed(scored):
    read, result = scored("odometry")
    assert {"surge name", "surge unit"} <= set(result.right)
    assert "unsure" not in [each.certainty for each in read.decisions if each.channel == "surge"]
    assert {"north", "east"} <= set(read.proposal.channels)


def test_a_top_speed_is_as_sure_as_the_unit_of_the_speed(scored):
    read, _ = scored("feet")
    sure = {each[:2]: each.certainty for each in read.decisions}
    assert sure["vehicle", "surge_max"] == sure["surge", "unit"] == "unsure"


@pytest.mark.thorough
def test_a_long_delay_is_found_and_one_at_the_end_of_the_search_is_unsure(tmp_path):
    table = columns(voyage(0))
    for side in ("thrust_left", "thrust_right"):
        table[side] = np.interp(table["time"] + 3, table["time"], table[side])
    result = inspect_logs([str(write_table(tmp_path / "a.csv", table))])
    assert 2.75 <= result.lag.delay <= 3.25
    falling = 2 - np.array(DELAYS)[:, None] + np.random.default_rng(0).uniform(0, 0.1, (1, 500))
    assert choose(falling)[:4] == (1.0, (1.0,), 1.0, False)


def test_the_recordings_have_the_simulated_values(scored):
    """Read back through the proposed units, zeros and spans, a log has the values that were exported."""
    read, _ = scored("reversed")
    channels, true = read.recordings[0].channels, voyage(0, minutes=6.0)
    for name, tolerance in (("command_left", 0.002), ("command_right", 0.002), ("surge", 1e-6), ("yaw_rate", 1e-6)):
        time = channels[name].time + 0.5  # the table begins there
        assert np.abs(channels[name].value - true.at(name, time)).max() <= tolerance, name
    turned = channels["heading"].value - true.at("heading", channels["heading"].time + 0.5)
    assert np.abs(np.sin(turned)).max() < 1e-6


def is_trap(name: str, seed: int, **options) -> bool:
    """Whether the log differs from a plain one: gradians look like degrees until a heading passes 360 of 400."""
    return name != "gradians" or bool((voyage(seed, **options).heading[1] > 0.902 * 2 * np.pi).any())


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["patrol", "station_keeping", "convoy"])
def test_short_logs(tmp_path, kind):
    """Two minutes tell less, so that more is unsure."""
    for name, shape in (SHAPES | TRAPS).items():
        folder = tmp_path / name
        folder.mkdir()
        if is_trap(name, 5, kind=kind, minutes=2.0):
            assert inspected(folder, shape, 5, kind=kind, minutes=2.0)[1].wrong == [], name


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["patrol", "lawn_mower", "station_keeping", "convoy"])
@pytest.mark.parametrize("plant", ["kingfisher", "vtec", "otter", "wamv"])
def test_other_boats_and_missions(tmp_path, kind, plant):
    results = []
    for seed in (1, 2):
        for name, shape in (SHAPES | TRAPS).items():
            folder = tmp_path / f"{name}{seed}"
            folder.mkdir()
            _, result = inspected(folder, shape, seed, kind=kind, plant=plant)
            assert result.wrong == [] or not is_trap(name, seed, kind=kind, plant=plant), name
            if name in SHAPES:
                results.append(result)
    right = sum(len(each.right) for each in results)
    assert right >= 0.95 * sum(sum(map(len, each)) for each in results)
