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


GROUPS = {
    "certify": Group(
        ("certify/*/vector_*.py", "certify/networks/vector.py", "certify/*/recurrent.py"),
        13,
        (
            *named("certify/proofs", "vector_exact vector_certificate"),
            *named("certify/command", "vector_certify"),
            *named("certify/search", "vector_scaling vector_lmi"),
            *named("certify", "torch_rnn"),
        ),
    ),
    "live": Group(
        ("usvlearn/live/*.py", "usvlearn/live/ros2/*.py", "usvlearn/display/json_values.py"),
        10,
        (
            *named("live", "arguments status prior"),
            *named("live/ros2", "ros2 ros2_node ros2_parameters"),
            *named("live", "session health replay node"),
        ),
    ),
    "export": Group(("usvlearn/model/export/*.py",), 7, named("model/export", "formats command")),
    "joint": Group(
        (
            *(f"usvlearn/estimators/joint/{name}.py" for name in "factored_kernel curves quantities state".split()),
            *(f"usvlearn/estimators/{name}kernel.py" for name in ("joint/", "joint/accommodation_", "augmented_ekf/")),
        ),
        6,
        named("estimators", "joint identified quantities refused"),
        False,
    ),
    "forecasts": Group(
        ("usvlearn/estimators/ensemble/forecasts/*kernel.py", "usvlearn/estimators/ensemble/forecasts/state.py"),
        4,
        (
            *named("estimators", "forecasts plans refused"),
            *named("engine", "descriptions"),
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
            *named(
                "model/fit",
                "curves wear correlations choice diagnostics open_loop kernel pieces logs ground turning boat",
            ),
            *named("report", "fit_section"),
            *named("cli", "fit"),
        ),
    ),
    "trial": Group(
        ("usvlearn/estimators/joint/change_detection_kernel.py",),
        6,
        (
            *named("estimators", "trial_equations trial refused"),
            *named("estimators", "accommodation"),
        ),
        False,
    ),
    "conditional": Group(
        ("usvlearn/estimators/ensemble/manoeuvre_intervals/[ks]*.py",),
        5,
        named("estimators", "conditional_equations conditional"),
        False,
    ),
    "axis": Group(
        ("usvlearn/estimators/axis/[!l]*.py",),
        4,
        (*named("estimators", "axis turning"), *named("engine", "planar")),
        False,
    ),
    "accommodation": Group(
        ("usvlearn/estimators/ensemble/accommodation/[ks]*.py",),
        3,
        named("estimators", "accommodation_equations accommodation"),
        False,
    ),
    "plan_requests": Group(("usvlearn/live/plan_requests.py",), 3, named("live", "plan_requests node tracks")),
    "array_log": Group(
        ("usvlearn/logs/formats/array_log.py",), 3, (*named("logs/formats", "array_log"), "tests/test_api.py")
    ),
    "tensorboard": Group(
        ("usvlearn/runs/tensorboard.py", "usvlearn/runs/compared.py"),
        3,
        named("runs", "tensorboard tensorboard_window"),
    ),
    "checks": Group(("usvlearn/logs/checks/*.py",), 8, named("logs/checks", "track strangers data_check remedies")),
    "lanes": Group(
        ("usvlearn/core/on_device.py", "usvlearn/engine/lanes.py"),
        5,
        (*named("engine", "lanes"), *named("sweeps/tuning", "tuning_devices")),
    ),
    "fit_member": Group(
        ("usvlearn/engine/fit_member.py", "usvlearn/model/fit/hand_over.py"),
        5,
        (*named("engine", "fit_member"), *named("model/fit", "boat")),
    ),
    "standings": Group(("usvlearn/sweeps/ranking.py",), 2, named("sweeps", "ranking jobs")),
}
FAR = "max(abs(left - path[LEFT]), abs(right - path[RIGHT]))"
MOVES = "x[LEFT] * x[LEFT] + x[RIGHT] * x[RIGHT] + x[YAW_RATE] * x[YAW_RATE] + mean[Y] * mean[Y] <= "
ALWAYS = (  # what an adversary changed, and no test saw; a function "" is the module
    ("certify", "_claims", "2", "4", 0),
    ("conditional", "extend_path", f"max(path[FAR], {FAR})", FAR, 0),
    ("conditional", "", "(0.999, 6.0, 10.0, 1.0, 1e-20)", "(0.999, 12.0, 10.0, 1.0, 1e-20)", 0),
    ("axis", "advance", f"{MOVES}REST", f"{MOVES}-REST", 0),
    ("axis", "learn", "if x[DT] > LONGEST", "False", 0),
    ("plan_requests", "sampled", "np.diff(total) / length + waits * before", "np.diff(total) / length", 0),
    ("array_log", "_array", "if np.ma.isMaskedArray(given)", "False", 0),
    ("tensorboard", "", "750", "750000000", 0),
)
EQUIVALENT = {  # changes after which nothing can be different, and why
    Place("trial", "side_of", "E + 1", "E - 1", 1): "a filter without even terms ends at E, before the first of a side",
    Place("checks", "compass", "off > max(OFF, CLEAR * doubt)", "off >= max(OFF, CLEAR * doubt)", 0): "never equal",
}
# Of the first 100 places 23 are gone: 16 of boxes, which are searched by halving alone; 5 of torch layers of families
# whose kernel remains; one each of a module that judges all kinds of networks, and of a range that is checked once.
