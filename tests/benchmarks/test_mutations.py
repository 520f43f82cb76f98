"""The benchmark of mutations: places are found again where files move, and a change is seen by a real test."""

import json

import mutations
import pytest
from mutation_places import Place, changed, places

SOURCE = 'def clipped(x, most):\n    """x, at most `most`."""\n    if x > most:\n        return most\n    return x\n'


@pytest.mark.slow
def test_the_places_of_the_table_are_in_the_sources():
    known = mutations.every_place(mutations.ROOT)
    rows = json.loads(mutations.TABLE.read_text())
    lost = [row for row in rows if Place(*(row[key] for key in Place._fields)) not in known]
    assert not lost, f"rename them in {mutations.TABLE.name}, or draw others: {lost}"
    once = mutations.drawn(known)
    assert once == mutations.drawn(known) and {Place(*each) for each in mutations.ALWAYS} <= set(once)


def test_a_change_is_seen_by_the_test_that_fails(tmp_path):
    source = tmp_path / "clip.py"
    source.write_text(SOURCE)
    (tmp_path / "pytest.ini").write_text("[pytest]\nmarkers =\n    thorough\n    slow\n    slurm\n    docs\n")
    test = "from clip import clipped\n\n\ndef test_clipped():\n    assert type(clipped(2.0, 2)) is float\n"
    (tmp_path / "test_clip.py").write_text(test)
    changes = {place.becomes: (node, other) for place, node, other in places("any", source)}
    text = changed(source, *changes["x >= most"])
    assert text == SOURCE.replace("x > most", "(x >= most)")
    group = mutations.Group(("*.py",), 1, ("test_clip.py",))
    row = mutations.tried(tmp_path, source, text, group, 60)
    assert (row["killed_by"], row["tier"]) == ("test_clip.py::test_clipped", "default")
    assert source.read_text() == SOURCE
