"""The groups of sources that `mutations.py` changes, their tests, and the places that are always or never changed."""

from __future__ import annotations

from typing import NamedTuple

from mutation_places import Place


class Group(NamedTuple):
    """Sources, how many places are drawn from them, and the tests that ought to see a change."""

    sources: tuple[str, ...]  # patterns below the repository
    places: int
    tests: tuple[str, ...]
    compiled: bool = True  # whether the tests need numba; without it a change is not compiled first


def named(folder: str, names: str) -> tuple[str, ...]:
    """The test files of a folder by the middle of their names."""
    return tuple(f"tests/{folder}/test_{name}.py" for name in names.split())


EVERY = "tests/engine/test_kernels.py::test_every_estimator_and_setting"
GROUPS = {
    "certify": Group(
        (
            "certify/*/vector_*.py",
            "certify/networks/vector.py",
            "certify/*/recurrent.py",
        ),
        18,
        (
            *named("certify/proofs", "vector_exact vector_certificate"),
            *named("certify/command", "vector_certify"),
            *named("certify/search", "vector_scaling"),
            *named("certify/search", "vector_lmi"),
            *named("certify", "torch_rnn"),
        ),
    ),
    "live": Group(
        (
            "usvlearn/live/*.py",
            "usvlearn/live/ros2/*.py",
            "usvlearn/display/json_values.py",
        ),
        10,
        (
            *named("live", "arguments status prior"),
            *named("live/ros2", "ros2 ros2_node ros2_parameters"),
            *named("live", "session health replay node"),
        ),
    ),
    "export": Group(("usvlearn/model/export/*.py",), 7, named("model/export", "formats command")),
    "joint": Group(
        ("usvlearn/estimators/joint/*.py", "usvlearn/estimators/augmented_ekf/*.py"),
        6,
        named("estimators", "joint identified quantities refused"),
        False,
    ),
    "forecasts": Group(
        ("usvlearn/estimators/ensemble/forecasts/*.py",),
        4,
        (
            *named("estimators", "forecasts plans refused"),
            *named("engine", "descriptions"),
            *(f"{EVERY}[{name}]" for name in ("forecasts", "forecasts_wrapped")),
            "tests/engine/test_kernels.py::test_batches[(2, 3)-forecasts]",
        ),
        False,
    ),
    "logs": Group(
        tuple(f"usvlearn/logs/{room}*.py" for room in ("alignment/", "channels/", "formats/", "formats/*/", "")),
        7,
        (
            *named("logs", "survey values setup read"),
            *named("logs/formats/csv", "topics csv_dialects"),
            *named("logs/alignment", "mixing align"),
            *named("logs/channels", "correlations derived_surge repeated_values"),
            *named("logs/formats/ros", "limits"),
            *named("logs/formats", "readers"),
        ),
    ),
    "fit": Group(
        ("usvlearn/model/fit/*.py",),
        11,
        (
            *named("model/fit", "curves wear correlations choice diagnostics open_loop kernel boat"),
            *named("report", "fit_section"),
            *named("cli", "fit"),
        ),
    ),
    "trial": Group(
        ("usvlearn/estimators/joint/change_detection*.py",),
        6,
        (
            *named("estimators", "trial_equations trial refused"),
            f"{EVERY}[joint_trial]",
            *named("estimators", "accommodation"),
        ),
        False,
    ),
    "conditional": Group(
        ("usvlearn/estimators/ensemble/manoeuvre_intervals/*.py",),
        5,
        (*named("estimators", "conditional_equations conditional"), f"{EVERY}[forecasts]"),
        False,
    ),
    "axis": Group(
        ("usvlearn/estimators/axis/*.py",),
        4,
        (*named("estimators", "axis turning"), f"{EVERY}[yaw]", f"{EVERY}[sway]", *named("engine", "planar")),
        False,
    ),
    "accommodation": Group(
        ("usvlearn/estimators/ensemble/accommodation/*.py",),
        3,
        named("estimators", "accommodation_equations accommodation"),
        False,
    ),
    "plan_requests": Group(("usvlearn/live/plan_requests.py",), 3, named("live", "plan_requests node tracks")),
    "array_log": Group(
        ("usvlearn/logs/formats/array_log.py",), 3, (*named("logs/formats", "array_log"), "tests/test_api.py")
    ),
    "tensorboard": Group(
        ("usvlearn/runs/tensorboard.py",),
        3,
        named("runs", "tensorboard tensorboard_window"),
    ),
    "standings": Group(("usvlearn/sweeps/ranking.py",), 2, named("sweeps", "standings board jobs")),
}
MASKED = "np.ma.filled(given.astype(np.float64), np.nan) if np.ma.isMaskedArray(given) else np.asarray(given)"
FAR = "max(abs(left - path[LEFT]), abs(right - path[RIGHT]))"
MOVES = "inputs[0] ** 2 + inputs[1] ** 2 + inputs.yaw_rate ** 2 + y * y > "
ALWAYS = (  # what an adversary changed, and no test saw; a function "" is the module
    ("certify", "_claims", "2", "4", 0),
    ("conditional", "extend_path", f"max(path[FAR], {FAR})", FAR, 0),
    ("conditional", "", "(0.999, 6.0, 10.0, 1.0, 1e-20)", "(0.999, 12.0, 10.0, 1.0, 1e-20)", 0),
    ("axis", "AxisEKF._advanced", f"{MOVES}REST", f"{MOVES}-REST", 0),
    ("axis", "learn", "if x[DT] > LONGEST", "False", 0),
    ("plan_requests", "sampled", "np.diff(total) / length + waits * before", "np.diff(total) / length", 0),
    ("array_log", "_array", MASKED, "np.asarray(given)", 0),
    ("tensorboard", "", "750", "750000000", 0),
)
EQUIVALENT = {  # changes after which nothing can be different, and why
    Place("trial", "side_of", "E + 1", "E - 1", 1): "a filter without even terms ends at E, before the first of a side",
    Place("forecasts", "Choice", "Range(1, MOST_HORIZONS)", "Range(MOST_HORIZONS, 1)", 0): "check.py has the range",
}
