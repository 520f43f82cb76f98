"""The benchmark of mutations: places are found again where files move, and a change is seen or not by real tests."""

import ast
import json

import mutations
import pytest
from mutation_places import Place, changed, places, written

SOURCE = """def clipped(x, most):
    \"\"\"x, at most `most`.\"\"\"
    if x > most:
        return most
    return x


class Sum:
    def add(self, x):
        self.total += x
        return self.total + 1
"""


@pytest.mark.slow
def test_the_places_of_the_table_are_in_the_sources():
    known = mutations.every_place(mutations.ROOT)
    rows = json.loads(mutations.TABLE.read_text())
    assert len({tuple(row[key] for key in Place._fields) for row in rows}) == len(rows) > 0
    lost = [row for row in rows if Place(*(row[key] for key in Place._fields)) not in known]
    assert not lost, f"rename them in {mutations.TABLE.name}, or draw others: {lost}"


def test_a_change_changes_its_place_alone(tmp_path):
    source = tmp_path / "clip.py"
    source.write_text(SOURCE)
    found = list(places("any", source))
    shown = [(place.function, place.expression, place.becomes) for place, *_ in found]
    assert ("clipped", "x > most", "x >= most") in shown and ("Sum.add", "self.total += x", "pass") in shown
    for _, node, other in found:
        text = changed(source, node, other)
        wrong = [k for k, (a, b) in enumerate(zip(SOURCE.split("\n"), text.split("\n"), strict=True)) if a != b]
        assert len(wrong) == 1 and ast.dump(ast.parse(text)) != ast.dump(ast.parse(SOURCE))
    lower = tmp_path / "lower.py"
    lower.write_text("import math\n\n\n" + SOURCE)
    assert [place for place, *_ in places("any", lower)] == [place for place, *_ in found]


@pytest.mark.slow
def test_the_draw_is_the_same_each_time():
    known = mutations.every_place(mutations.ROOT)
    once, again = mutations.drawn(known), mutations.drawn(known)
    assert once == again and len(set(once)) == len(once) == 100
    assert {Place(*each) for each in mutations.ALWAYS} <= set(once)


@pytest.mark.slow
def test_places_of_the_table_stay_and_missing_ones_are_drawn():
    known = mutations.every_place(mutations.ROOT)
    new = mutations.drawn(known)
    other = next(place for place in known if place.group == "export" and place not in new)
    gone = other._replace(function="gone")
    wanted = mutations.filled([other, gone], new, known)
    assert wanted[0] == other and gone not in wanted and len(wanted) == len(new)
    assert sum(place.group == "export" for place in wanted) == mutations.GROUPS["export"].places


def test_a_place_may_be_written_by_hand_and_lie_outside_of_a_function(tmp_path):
    source = tmp_path / "clip.py"
    source.write_text("LEAST, MOST = 2, 2  # of x\n\n\n" + SOURCE)
    wanted = {
        ("", "2", "MOST_OF_ALL", 1): "LEAST, MOST = 2, (MOST_OF_ALL)  # of x",
        ("clipped", "if x > most", "False", 0): "    if (False):",
    }
    for each, line in wanted.items():
        place = Place("any", *each)
        ((found, node, other),) = written(place, source)
        assert found == place and line in changed(source, node, other).splitlines()
        assert not list(written(place._replace(function="gone"), source))
    assert "" not in {place.function for place, *_ in places("any", source)}


DEFAULT = "[pytest]\naddopts = -m 'not thorough'\nmarkers =\n    thorough\n    slow\n    slurm\n    docs\n"


@pytest.mark.parametrize(
    ("check", "seconds", "seen", "tier"),
    [
        ("assert type(clipped(2.0, 2)) is float", 60, "test_clip.py::test_clipped", "default"),
        *(
            pytest.param(*each, marks=pytest.mark.thorough)
            for each in (
                ("assert clipped(3, 2) == 2 == clipped(2, 2)", 60, None, None),
                ("assert type(clipped(2.0, 2)) is float", 60, "test_clip.py::test_clipped", "thorough"),
                ("while type(clipped(2.0, 2)) is int: pass", 2, "longer than 2 s", "default"),
            )
        ),
    ],
)
def test_a_change_is_seen_by_the_test_that_fails(tmp_path, check, seconds, seen, tier):
    source = tmp_path / "clip.py"
    source.write_text(SOURCE)
    (tmp_path / "pytest.ini").write_text(DEFAULT)
    mark = "@pytest.mark.thorough\n" if tier == "thorough" else ""
    test = f"import pytest\nfrom clip import clipped\n\n\n{mark}def test_clipped():\n    {check}\n"
    (tmp_path / "test_clip.py").write_text(test)
    changes = {place.becomes: (node, other) for place, node, other in places("any", source)}
    group = mutations.Group(("*.py",), 1, ("test_clip.py",))
    text = changed(source, *changes["x >= most"])
    found = mutations.tried(tmp_path, source, text, group, seconds)
    assert (found["killed_by"], found["tier"]) == (seen, tier)
    assert source.read_text() == SOURCE
    row = found | {"about": mutations.about(text, tmp_path, mutations.deciding(found, group))}
    assert mutations.holds(row, text, tmp_path, group) and not mutations.holds(row, SOURCE, tmp_path, group)
    (tmp_path / "test_clip.py").write_text(test + "\n")  # a result rests on its tests
    assert mutations.holds(row, text, tmp_path, group) == (tier == "default" and str(seen).startswith("longer"))
