"""python -m certify, as it is typed: JSON, exit codes, tables, certificates and pictures."""

import itertools
import os
import re
import subprocess
import sys
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from certify.__main__ import main
from certify.command.compare import RANDOM, examine, random_networks, table
from certify.display.tables import show
from certify.networks.shallow import ShallowWeights
from certify.proofs.rounding import above, below
from tests.support import ROOT, few
from tests.support.certify_command import told
from usvlearn.core.checkpoint import save

KEYS = {"path", "n", "margins", "rate", "certified", "equilibria"}
CONDITIONS = {"simple", "gershgorin", "lmi", "exact"}


def test_json_of_one_network(files, capsys):
    code, rows = told(capsys, files / "good.npz")
    assert code == 0 and len(rows) == 1 and KEYS <= set(rows[0])
    (row,) = rows
    assert row["path"] == str(files / "good.npz") and row["n"] == 1
    assert row["rate"] == pytest.approx(0.3) and set(row["margins"]) == set(row["certified"]) == CONDITIONS
    assert row["margins"] == pytest.approx({"simple": -0.7, "gershgorin": 0.4, "lmi": 0.4, "exact": 0.7})
    assert row["certified"] == {"simple": False, "gershgorin": True, "lmi": True, "exact": True}
    assert [(each["x"], each["class"]) for each in row["equilibria"]] == [(0.0, "half-stable")] or row["equilibria"]


@pytest.mark.parametrize(
    ("names", "condition", "code"),
    [
        (["good"], "exact", 0),
        (["good"], "simple", 1),
        (["good", "identity"], "exact", 1),
        (["identity"], "lmi", 1),
        (["off"], "exact", 1),
        (["off"], "interval", 0),
        (["off", "good"], "box", 0),
        (["tooth"], "box", 1),
    ],
)
def test_the_condition_decides_the_exit_code(files, capsys, names, condition, code):
    status, rows = told(capsys, *(files / f"{name}.npz" for name in names), "--condition", condition)
    assert status == code and len(rows) == len(names)


def test_equilibria_are_those_of_the_paper_and_its_errata(files, capsys):
    _, rows = told(capsys, files / "tooth.npz", files / "identity.npz")
    assert [(each["x"], each["class"]) for each in rows[0]["equilibria"]] == [(0.0, "deadbeat"), (0.5, "unstable")]
    (line,) = rows[1]["equilibria"]
    assert line["class"] == "continuum" and line["interval"] == [0.0, 1.0]
    _, rows = told(capsys, files / "tooth.npz", "--input", "0.3")
    assert rows[0]["input"] == [0.3]


def test_rates_of_any_size_have_a_time_constant(files, capsys):
    rest = {"w1": np.ones(2), "W2": np.zeros((2, 1)), "b": np.zeros(2)}
    np.savez(files / "tiny.npz", **{**rest, "a": [5e-324, 0.0]})
    np.savez(files / "edge.npz", **{**rest, "a": [1 - 2.0**-53, 2.0**-60]})
    code, rows = told(capsys, files / "tiny.npz", files / "edge.npz")
    assert code == 0 and rows[0]["time_constant"] >= 0
    assert rows[1]["rate"] == 1 and rows[1]["time_constant"] == pytest.approx(2**53, rel=0.01)


def test_a_runs_folder_and_a_pattern(files, capsys):
    code, rows = told(capsys, files / "run")
    assert code == 0 and [Path(row["path"]).parent.name for row in rows] == ["anna", "bert"]
    assert all(row["m"] == 4 and row["at_rest"]["equilibria"] == [1, 1] for row in rows)
    assert told(capsys, files / "run/checkpoints/*/*")[1] == rows


def test_the_table_and_its_summary(files, capsys):
    assert main([str(files / "run"), str(files / "identity.npz"), "--dt", "0.4"]) == 1
    text = capsys.readouterr().out
    assert "2 of 3 certified contracting by exact, in rational arithmetic" in text
    assert "continuum 0…1" in text and "τ, s" in text and "anna" in text and "at rest" in text


@pytest.mark.thorough
def test_no_number_and_no_name_of_the_table_is_cut(files, capsys, monkeypatch):
    """At any width, and without a limit where the output is no terminal."""
    folder = files / "a_folder_of_a_season_with_a_long_name"
    (files / "run").rename(folder)
    for paths in ([folder], [folder / "checkpoints/anna/00000_0000010.safetensors"], [folder, files / "tooth.npz"]):
        _, rows = told(capsys, *paths, "--box", "--lmi", "--seconds", "0.2")
        for columns in (60, 80, 100, 160, None):
            monkeypatch.setenv("COLUMNS", str(columns)) if columns else monkeypatch.delenv("COLUMNS")
            show([{**row, "judged": "exact"} for row in rows], "exact", [], 0.4)
            text = capsys.readouterr().out
            head, blocks = text[: text.index(f"\n\n{len(rows)} of")].split("\n\n", 1)
            words = blocks.split()
            assert head.startswith("Margins") and max(map(len, blocks.splitlines())) <= (columns or 10_000)
            assert columns or len(re.findall("─+", blocks)) == 1
            for row in rows:
                assert {below(x, 3) for x in row["margins"].values()} | {above(row["rate"])} <= set(words)
                assert {f"{each['x']:.3g}" for each in row["equilibria"]} <= {word.strip(",;") for word in words}
            assert {"simple", "gershgorin", "K", "τ,", "equilibria", "LMI", "box"} <= set(words)
            assert ("00000_0000010.safetensors" if len(rows) == 1 else "0000010") in "".join(words)


def test_lmi_and_box(files, capsys):
    code, rows = told(capsys, files / "good.npz", files / "identity.npz", "--lmi", "--box")
    assert code == 1
    good, identity = rows
    assert good["lmi"]["exact"]["verdict"] == good["lmi"]["lmi"]["verdict"] == "certified"
    assert good["lmi"]["lmi"]["rate"] == pytest.approx(0.6, rel=5e-6)
    assert identity["lmi"]["exact"]["verdict"] != "certified"
    assert good["box"]["verdict"] == "certified" and good["box"]["forward_invariant"] == "yes"
    assert identity["box"]["verdict"] == "refuted" and abs(identity["box"]["witness"]["slope"]) >= 1
    assert main([str(files / "identity.npz"), "--box"]) == 1
    assert "witness" in capsys.readouterr().out
    _, rows = told(capsys, files / "tooth.npz", "--box=0:0.2,0:0")
    assert rows[0]["box"]["verdict"] == "certified" and rows[0]["box"]["intervals"] == [[0.0, 0.2], [0.0, 0.0]]
    _, rows = told(capsys, files / "good.npz", "--box", "-1:1,-1:1", "--input", "-0.5")
    assert rows[0]["box"]["intervals"][0] == [-1.0, 1.0] and rows[0]["input"] == [-0.5]
    code, rows = told(capsys, "--box", files / "good.npz")  # a path behind --box is a path
    assert code == 0 and rows[0]["box"]["bracket"][1] == pytest.approx(0.3)


@pytest.mark.parametrize("condition", ["lmi", "exact", "interval", "box"])
def test_certificates_are_written_and_verified(files, capsys, condition, monkeypatch):
    monkeypatch.chdir(files)
    options = ["--condition", condition, "--certificate", "proofs"]
    assert main(["good.npz", "identity.npz", "run", *options]) in (0, 1)
    proofs = sorted(Path("proofs").iterdir())
    assert len(proofs) == 3 and not any("identity" in path.name for path in proofs)
    capsys.readouterr()
    assert main(["--verify", *map(str, proofs)]) == 0
    assert capsys.readouterr().out.count(": valid: ") == len(proofs)
    assert main(["identity.npz", "--verify", str(proofs[0])]) == 1
    text = proofs[0].read_text()
    proofs[0].write_text(text.replace('"margin": 0.', '"margin": 0.9'))
    capsys.readouterr()
    code, results = told(capsys, "--verify", *proofs)
    assert code == 1 and [result["valid"] for result in results] == [False] + [True] * (len(proofs) - 1)


@pytest.mark.thorough
def test_pictures(files, capsys):
    pytest.importorskip("matplotlib")
    assert main([str(files / "good.npz"), str(files / "tooth.npz"), "--plot", str(files / "out/map.png")]) == 1
    assert (files / "out/map.png").stat().st_size > 10_000 and (files / "out/map-2.png").exists()
    assert main([str(files / "run"), "--headings", "--plot", str(files / "map.svg")]) == 0
    assert "heading" in (files / "map.svg").read_text()


def test_ctrl_c_is_one_line_and_code_130(files, capsys, monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("certify.__main__.find", interrupted)
    assert main([str(files)]) == 130
    assert capsys.readouterr().err == "stopped: the certificates written so far are complete\n"


def test_closed_forms_import_no_solver(files):
    code = (
        "import sys\nfrom certify.__main__ import main\n"
        f"rc = main([{str(files / 'run')!r}, {str(files / 'good.npz')!r}])\n"
        "sys.exit(rc or any(name in sys.modules for name in ('cvxpy', 'torch', 'scipy', 'matplotlib')))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr + done.stdout


def test_what_is_printed_is_never_below_the_rate_or_above_a_margin(files, capsys, monkeypatch):
    monkeypatch.chdir(files)
    np.savez("edge.npz", **{**np.load("identity.npz"), "a": [1 - 4e-8]})
    assert main(["edge.npz", "--box", "--certificate", "proofs"]) == 0
    assert capsys.readouterr().out.count("0.99999997") == 2  # the rate, and that on the box
    assert "≤ 0.99999997 " in Path("proofs/edge.exact.json").read_text(encoding="utf-8")
    assert told(capsys, "edge.npz")[1][0]["margins"]["exact"] <= 1 - Fraction(1 - 4e-8)


def test_a_file_whose_name_is_no_text_is_certified(files, capsys, monkeypatch):
    monkeypatch.chdir(files)
    np.savez(os.fsdecode(b"bad\xff.npz"), **np.load("good.npz"))
    assert told(capsys, os.fsdecode(b"bad\xff.npz"), "--certificate", "proofs")[0] == 0
    (proof,) = Path("proofs").iterdir()
    assert main(["good.npz", "--verify", str(proof)]) == 0 and ": valid" in capsys.readouterr().out


def test_any_locale_will_do(files):
    """Certificates are UTF-8 wherever they are made; a terminal that cannot show a sign shows another."""
    plain = {**os.environ, "LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0", "PYTHONPATH": str(ROOT)}
    calls = ["good.npz", "--certificate", "proofs"], ["--verify", "proofs/good.exact.json"], ["good.npz", "--json"]
    code = f"from certify.__main__ import main\nassert [main(each) for each in {calls}] == [0, 0, 0]"
    done = subprocess.run([sys.executable, "-c", code], cwd=files, env=plain, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


CALLS = list(itertools.product((("good", 0), ("identity", 1)), ([], ["--json"])))


@pytest.mark.parametrize(("network", "output"), few(CALLS, [CALLS[0], CALLS[3]], "thorough"))
def test_a_reader_that_has_seen_enough_changes_no_verdict(files, network, output):
    name, code = network
    command = [sys.executable, "-m", "certify", str(files / f"{name}.npz"), *output]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    process.stdout.close()
    assert process.wait() == code and process.stderr.read() == b""
    process.stderr.close()


def test_certificates_of_like_names_are_all_kept(files, monkeypatch, capsys):
    monkeypatch.chdir(files)
    arrays = dict(np.load("good.npz"))
    for k, name in enumerate(("a.npz", "a_1.npz", "a.1.npz")):
        np.savez(name, **{**arrays, "b": [float(k)]})
    save(Path("a.safetensors"), ShallowWeights(*arrays.values()))
    assert main(["a.npz", "a_1.npz", "a.1.npz", "a.safetensors", "--certificate", "proofs"]) == 0
    assert len(list(Path("proofs").iterdir())) == 4
    Path("elsewhere").mkdir()
    monkeypatch.chdir("elsewhere")  # other weights of the same name here, the right ones beside the certificate
    np.savez("a_1.npz", **{**arrays, "b": [9.0]})
    capsys.readouterr()
    assert main(["--verify", *map(str, Path("../proofs").glob("a_1.*"))]) in (0, 1)


def networks(count: int, n: int) -> list:
    """Of which some are beyond each condition."""
    drawn = random_networks(count, n, np.random.default_rng(1))
    return [w._replace(a=w.a * 16.0 * (k + 1) / count) for k, w in enumerate(drawn)]


def test_the_table_counts_what_was_examined():
    pytest.importorskip("cvxpy")
    rows = [examine(w, 2.0, "CLARABEL") for w in networks(12, 4)]
    named = {row["condition"]: row for row in table({RANDOM: rows})}
    counts = [named[name]["certified"] for name in ("simple", "gershgorin", "lmi", "exact", "box")]
    assert counts == sorted(counts) and counts[2] < counts[3] == sum(row["rates"]["exact"] < 1 for row in rows)
    assert named["lmi"]["over_K"] == pytest.approx(2) and named["exact"]["over_K"] == 1 > named["box"]["over_K"] - 1e-9
    assert named["lmi"]["disagreements"] == named["exact"]["disagreements"] == 0
    low, high = named["exact"]["interval"]
    assert low < counts[3] / 12 < high and named["lmi"]["largest"] < 0.5
    assert table({"own": rows})[0]["interval"] is None  # no draws
    rows[0]["solved"]["exact"] = "unknown" if rows[0]["certified"]["exact"] else "certified"
    assert {row["condition"]: row["disagreements"] for row in table({RANDOM: rows})}["exact"] == 1


def test_checkpoints_and_random_networks_are_printed_and_drawn(files, capsys):
    pytest.importorskip("matplotlib")
    paths = [str(files / "run"), str(files / "good.npz")]
    assert main(["compare", *paths, "--plot", str(files / "c.png")]) == 0
    text = capsys.readouterr().out
    assert "2 of 2" in text and "1 of 1" in text and "gershgorin" in text and (files / "c.png").stat().st_size > 5000
    code, rows = told(capsys, "compare", "--networks", "4", "--neurons", "4")
    assert code == 0 and {(row["networks"], row["of"]) for row in rows} == {(RANDOM, 4)}
