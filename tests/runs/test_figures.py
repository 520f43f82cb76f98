"""The figure of an event."""

import numpy as np

from usvlearn.runs.figures import Course, event_figure


def test_the_figure_shows_the_time_about_the_first_event_and_marks_it_and_the_fault():
    time = np.arange(0.0, 3600.0)
    two, share = np.ones((len(time), 2)), np.ones((len(time), 2))
    share[1800:, 0] = 0.4
    course = Course(time, two, time, {"aid": time}, time, share, 0.1 * two, 0 * two)
    figure = event_figure(course, 20.0, [(1806.0, "loss"), (1900.0, "recovery"), (3500.0, "loss")], 1800.0, "a boat")
    for panel in figure.axes:
        marks = [line.get_xdata()[0] for line in panel.get_lines() if list(line.get_ydata()) == [0, 1]]
        np.testing.assert_allclose(marks, [30.0, 30.1, 1900 / 60])
        low, high = panel.get_xlim()
        assert low == (1806 - 120) / 60 and high == (1806 + 300) / 60
    assert [text.get_text().strip() for text in figure.axes[0].texts] == ["fault", "loss 6 s after"]


def test_a_band_is_drawn_only_where_there_is_evidence():
    time, two = np.arange(10.0), np.ones((10, 2))
    share = two.copy()
    share[5:, 0] = 0.4
    figure = event_figure(Course(time, two, time, {}, time, share, 0.1 * two, 0 * two), 20.0)
    left, right = (each.get_paths() for each in figure.axes[3].collections)
    assert len(left) == 1 and left[0].vertices[:, 0].min() == 5 / 60
    assert sum(len(path.vertices) for path in right) == 0
