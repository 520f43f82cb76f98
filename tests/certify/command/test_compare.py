"""The comparison: what it counts, its table, its figure, and what it refuses."""

import numpy as np
import pytest

from certify.__main__ import main
from certify.command.compare import RANDOM, examine, random_networks, table
from tests.support.certify_command import told


def networks(count: int, n: int) -> list:
    """Of which some are beyond each condition."""
    drawn = random_networks(count, n, np.random.default_rng(1))
    return [w._replace(a=w.a * 16.0 * (k + 1) / count) for k, w in enumerate(drawn)]


def test_the_table_counts_what_was_examined():
    pytest.importorskip("cvxpy")
    rows = [examine(w, 2.0, "CLARABEL") for w in networks(12, 4)]
    made = {row["condition"]: row for row in table({RANDOM: rows})}
    counts = [made[name]["certified"] for name in ("simple", "gershgorin", "lmi", "exact", "box")]
    assert counts == sorted(counts) and counts[2] < counts[3] == sum(row["rates"]["exact"] < 1 for row in rows)
    assert made["lmi"]["over_K"] == pytest.approx(2) and made["exact"]["over_K"] == 1 > made["box"]["over_K"] - 1e-9
    assert made["lmi"]["disagreements"] == made["exact"]["disagreements"] == 0
    low, high = made["exact"]["interval"]
    assert low < counts[3] / 12 < high and made["lmi"]["largest"] < 0.5
    assert table({"own": rows})[0]["interval"] is None  # no draws
    rows[0]["solved"]["exact"] = "unknown" if rows[0]["certified"]["exact"] else "certified"
    assert {row["condition"]: row["disagreements"] for row in table({RANDOM: rows})}["exact"] == 1


def test_checkpoints_and_random_networks_are_printed_and_drawn(files, capsys):
    pytest.importorskip("matplotlib")
    own = [str(files / "run"), str(files / "good.npz")]
    assert main(["compare", *own, "--plot", str(files / "c.png")]) == 0
    text = capsys.readouterr().out
    assert "2 of 2" in text and "1 of 1" in text and "gershgorin" in text and (files / "c.png").stat().st_size > 5000
    code, rows = told(capsys, "compare", "--networks", "4", "--neurons", "4")
    assert code == 0 and {(row["networks"], row["of"]) for row in rows} == {(RANDOM, 4)}
