"""A boat that cannot exist is red on the first page of a report and in the terminal, and nothing there is green."""

import dataclasses

from rich.console import Console

from tests.support.known_boats import known_boat
from usvlearn.report.front import Front, Overview, first_page
from usvlearn.report.tables import identified_table

WRONG = "The identified boat is not physical: <it> goes astern."


def boat(name: str, wrong: str, findings=()) -> Overview:
    lacks = (wrong,) if wrong else ()
    identified = dataclasses.replace(known_boat(lacks=lacks).identified, unphysical=wrong)
    return Overview(name, 0.1, (), identified, (), None, None, None, None, findings)


def page(*boats: Overview) -> str:
    viewer = {"runs": [], "colours": {}, "shown": [], "sides": {}}
    return first_page(Front(boats, viewer), "")


def test_the_first_page_is_red_and_not_green():
    right, wrong = page(boat("a", "")), page(boat("a", WRONG))
    assert 'class="good">Nothing suspicious' in right and "not physical" not in right
    assert "Nothing suspicious" not in wrong
    assert wrong.count('<p class="bad">') == 2 and "&lt;it&gt;" in wrong and "<it>" not in wrong
    assert wrong.count("goes astern") == 2  # once in each card, and not again among the notes


def test_nothing_is_green_while_a_question_is_open_or_a_finding_stands():
    def shown(findings=(), **more) -> str:
        viewer = {"runs": [], "colours": {}, "shown": [], "sides": {}}
        return first_page(Front([boat("a", "", findings)._replace(events=[])], viewer, **more), "")

    sentence = "1 guess unconfirmed: <mass> (unsure)."
    guessed, warned = shown(unconfirmed=[sentence]), shown([{"about": "surge", "found": "x", "severity": "warning"}])
    assert shown().count('class="good"') == 2 and "guess" not in shown()
    assert 'class="good"' not in guessed + warned and "does not prove what was guessed" in guessed
    assert guessed.index("1 guess unconfirmed: &lt;mass&gt; (unsure).") < guessed.index("Data check")


def test_the_table_of_a_fleet_names_it():
    text = page(boat("a", ""), boat("b", WRONG, [{"about": "surge", "found": "x", "severity": "note"}]))
    assert "<td>no findings</td>" in text and "<td>not a physical boat</td>" in text


def test_the_terminal_warns_once():
    console = Console(width=200, record=True, file=None, quiet=False)
    with console.capture() as shown:
        console.print(identified_table({"a": boat("a", WRONG).identified, "b": boat("b", "").identified}))
    assert shown.get().count("goes astern") == 1
    assert f"WARNING: a: {WRONG}" in shown.get()
