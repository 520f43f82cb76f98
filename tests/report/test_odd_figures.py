"""No figure ends a command: odd numbers, clocks that go back and odd names are drawn, or their place says why not."""

from html import escape
from types import SimpleNamespace

import numpy as np
import pytest

from tests.support import few
from usvlearn.display.figures import attempted, rendered
from usvlearn.estimators.joint.curves import Curve
from usvlearn.report.page import _drawing
from usvlearn.report.sections import cross, network, tracks
from usvlearn.report.sections import fit as fit_section
from usvlearn.report.sections.errors import Autocorrelation, box, boxes_figure, residual_figure
from usvlearn.report.sections.fit_file import Course as Minute
from usvlearn.report.sections.fit_file import Curve as FitCurve
from usvlearn.report.sections.fit_file import Lags, Sailed
from usvlearn.runs.figures import Course, Traces, event_figure, forecast_figure, identified_figure, runs_figure

NAMES = ["a$b$c", "a$\\frac{$_^", "run_{1}^2_$", "艇 №1", "\\", "<&>%", "x" * 300]
STEPS = 700


def series(kind: str, count: int = STEPS) -> np.ndarray:
    """A speed that is odd in one way."""
    speed = 1 + np.sin(np.arange(float(count)) / 9)
    match kind:
        case "nan":
            speed[:] = np.nan
        case "gaps":
            speed[::3] = np.nan
        case "infinite":
            speed[5::7], speed[6::7] = np.inf, -np.inf
        case "huge":
            speed *= 1e300
    return speed


def drawn(kind: str, name: str) -> dict:
    """Every figure of a run and of a report."""
    count = {"empty": 0, "single": 1}.get(kind, STEPS)
    time, v = 0.4 * np.arange(count), series(kind, count)
    if kind == "backwards":
        time[count // 2 :] -= 3600.0
    two = np.stack([v, v], -1)
    curve = Curve(*(series(kind, max(count, 1))[:41] for _ in range(4)))
    curves = dict.fromkeys(("drag", "thrust_left", "thrust_right", "steady_speed"), curve)
    sailed, fit = Sailed(np.arange(5.0), np.array([9.0, 0.0, 0.0, 1.0])), FitCurve(*curve)
    lags = Lags(*(series(kind, 9) for _ in range(3)))
    fitted = SimpleNamespace(
        curves=dict.fromkeys(curves, fit), sailed=dict.fromkeys(("left", "right", "speed"), sailed),
        autocorrelation=lags, cross_correlation={"mean": lags, "difference": lags},
    )  # fmt: skip
    last = float(v[-1]) if count and np.isfinite(v[-1]) else None
    skill = {name: {"persistence": {"2": {"skill": 0.0}}, "ensemble": {"2": {"skill": last}}}}
    errors = {name: {"2": dict.fromkeys(tracks.LINES, last)}}
    quantities = {"steady_speed_full": SimpleNamespace(value=float(v[-1]) if count else np.nan)}
    course = Course(time, two, v, {name: v}, v, two, two, two)
    pairs = Autocorrelation(series(kind, 9), np.ones(9))
    return {
        "runs": lambda: runs_figure([Traces(name, time, v, v)] * 2, name, name),
        "identified": lambda: identified_figure([curves, curves], quantities, {}, name),
        "event": lambda: event_figure(course, 20.0, [(70.0, name)], None, name),
        "residual": lambda: residual_figure({name: pairs}, name),
        "boxes": lambda: boxes_figure({name: {name: box(v)}}, {name: name}, name),
        "matrix": lambda: cross.matrix_figure({name: series(kind, 9).reshape(3, 3)}, [name] * 3),
        "certificates": lambda: network.rates_figure({name: time}, {name: v}),
        "fit curves": lambda: fit_section.curves_figure(fitted, name, {}),
        "fit residuals": lambda: fit_section.residuals_figure(fitted, name),
        "worst": lambda: fit_section.worst_figure([Minute(name, 0.0, time, v, v, v, v)], name),
        "skill": lambda: forecast_figure(skill),
        "tracks": lambda: tracks.errors_figure(errors),
    }  # fmt: skip


FIGURES = list(drawn("plain", ""))
ODD = [(kind, what) for kind in ("nan", "gaps", "infinite", "huge", "backwards", "single") for what in FIGURES]
FIRST = [("nan", "identified"), ("backwards", "event"), ("nan", "fit curves")]  # a real run ended at these


@pytest.mark.parametrize("kind, what", few(ODD, FIRST, "thorough"))
@pytest.mark.filterwarnings("ignore:(Glyph|constrained)")  # the font lacks characters; a name is long
@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # of matplotlib, of numbers beyond 1e300
def test_odd_numbers_are_drawn(kind, what):
    name = NAMES[FIGURES.index(what) % len(NAMES)]
    assert rendered(attempted(drawn(kind, name)[what], what), dpi=30).startswith(b"\x89PNG")


@pytest.mark.parametrize("what", few(FIGURES, ["runs"], "thorough"))
def test_a_name_is_no_formula(what):
    for name in NAMES[:2]:
        figure = drawn("plain", name)[what]()
        assert escape(name).encode() in attempted(lambda name=name, figure=figure: _drawing(name, figure), what)[1]


@pytest.mark.filterwarnings("default:.*could not be drawn")
def test_what_cannot_be_drawn_says_why_in_its_place():
    with pytest.warns(UserWarning, match=r"could not be drawn \(IndexError: .*, in \w+\.py:\d+\): the numbers are not"):
        figure = attempted(drawn("empty", "heron")["event"], "event")
    assert "could not be drawn (IndexError" in figure.texts[0].get_text() and rendered(figure, dpi=30)


def test_what_cannot_be_rendered_says_why_in_its_place():
    figure = drawn("plain", "heron")["runs"]()
    figure.savefig = lambda *given, **options: {}["renderer"]
    with pytest.warns(UserWarning, match=r"a figure could not be drawn \(KeyError: 'renderer'"):
        assert rendered(figure, dpi=30).startswith(b"\x89PNG")
