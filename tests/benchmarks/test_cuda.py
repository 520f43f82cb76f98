"""The measurement of batch elements on a GPU: its works compute what they say. Only its part of the CPU runs here."""

import cuda
import cuda_ways
import pytest
import torch

from usvlearn import AID, BOA, RLS, RNN, Ensemble, ForecastSettings, JointEKF

KNOWN = {
    "aid": lambda: AID(28.0),
    "rls": RLS,
    "rnn": lambda: RNN(6, unroll=2, replay_size=7),
    "joint": lambda: JointEKF(2.74, 28.0),
    "ensemble": lambda: Ensemble(
        {"aid": AID(28.0), "rnn": RNN(6)}, {"boa": BOA()}, forecasts=ForecastSettings((0.4, 2.0))
    ),
}
each_estimator = pytest.mark.parametrize("name", KNOWN)


def test_without_a_gpu_it_says_so_and_measures_nothing(monkeypatch, capsys):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(cuda, "estimators", lambda: pytest.fail("measured"))
    cuda.main([])
    assert capsys.readouterr().out == f"{cuda.NONE}\n"


@pytest.mark.thorough
def test_the_part_of_the_cpu_is_printed_and_not_saved(monkeypatch, capsys):
    monkeypatch.setattr(cuda, "publish", lambda *given: pytest.fail("saved"))
    monkeypatch.setattr(cuda, "estimators", lambda: {"aid": KNOWN["aid"](), "rnn": KNOWN["rnn"]()})
    cuda.main(["--cpu", "--quick"])
    out = capsys.readouterr().out
    assert "CUDA 1" not in out and out.count("## A ") == 3
    for row in ("| aid, CPU, compiled |", "| rnn, CPU, torch |"):
        cells = next(line for line in out.splitlines() if line.startswith(row)).split("|")[2:-1]
        assert all(float(cell) > 0 for cell in cells[:2])


@each_estimator
def test_replays_of_one_step_are_the_run(name):
    """Not captured here; a captured step makes the same operations in the same memory."""
    estimator, run = KNOWN[name](), cuda.elements_of(12, 3)
    graphed, expected = cuda_ways.Graphed(estimator, run), cuda_ways.eager(estimator, run)()
    torch.testing.assert_close(graphed(), expected, rtol=0, atol=0)
    torch.testing.assert_close(graphed(), expected, rtol=0, atol=0)  # it starts anew


@each_estimator
def test_the_gradient_of_all_elements_is_the_mean_of_those_of_each(name):
    estimator, run = KNOWN[name](), cuda.elements_of(4, 3)
    found, expected = cuda_ways.mapped(estimator, run)(), cuda_ways.backward(estimator, run)()
    for key, value in expected.items():
        each = found[f"estimator.{key}"]
        assert each.shape == (3, *value.shape)
        torch.testing.assert_close(each.mean(0), value, rtol=1e-9, atol=1e-12)


def test_elements_differ():
    run = cuda.elements_of(5, 3)
    assert all(len({tuple(x) for x in leaf.T.tolist()}) == 3 for leaf in (*run.inputs[:2], run.surge))
    assert run.inputs.command_left.abs().min() > 0


def test_a_difference_ends_the_measurement():
    aid = AID(28.0)

    def wrong(estimator, run):
        return lambda: cuda_ways.eager(estimator, run)() + 1e-5

    kind = cuda.Kind("A step", {}, cuda_ways.eager, False)
    assert float(cuda.compared(kind, cuda.Way("cpu", cuda_ways.compiled), aid, cuda.QUICK)) < 1e-9
    with pytest.raises(SystemExit, match="differs by 1e-05 from torch on the CPU"):
        cuda.compared(kind, cuda.Way("cpu", wrong), aid, cuda.QUICK)


def test_what_a_gradient_keeps_is_counted():
    bytes_of = {name: cuda.needed(KNOWN[name](), keeps=True) for name in ("aid", "joint")}
    assert 50 < bytes_of["aid"] < 5000 < bytes_of["joint"]


def test_what_takes_too_long_is_left_out(monkeypatch):
    monkeypatch.setattr(cuda, "seconds", lambda work, device, repeats: 100.0)
    kind, way = cuda.Kind("A step", {}, cuda_ways.eager, False), cuda.Way("cpu", cuda_ways.eager)
    assert cuda.rates(kind, way, AID(28.0), cuda.QUICK)[1] == "–"


def test_with_a_gpu_every_kind_has_a_way_there():
    kinds = cuda.kinds(cuda=True, compile_steps=True)
    assert [kind.keeps for kind in kinds] == [False, True, True, False]
    assert all(any(way.device == "cuda" for way in kind.ways.values()) for kind in kinds)
    assert {way.make for kind in kinds for way in kind.ways.values()} >= {cuda_ways.Graphed, cuda_ways.stepped}
