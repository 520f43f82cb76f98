"""What a sweep composes before its first job, and what it refuses then."""

from itertools import product
from types import SimpleNamespace

import pytest
from hydra._internal.config_loader_impl import ConfigLoaderImpl

from tests.support.commands import run
from usvlearn.cli.sweep import compose_every_value


def test_every_value_is_composed_with_every_combination_of_files():
    composed = []
    loader = SimpleNamespace(
        repository=SimpleNamespace(group_exists=lambda key: key in ("data", "hydra/launcher")),
        load_sweep_config=lambda master_config, sweep_overrides: composed.append(tuple(sweep_overrides)),
    )
    sweeper = SimpleNamespace(hydra_context=SimpleNamespace(config_loader=loader), config={})
    values = ["data=a", "+data=b", "data@other=c"], ["n=1", "n=2", "n=3"], ["u=1", "u=2"]
    every = list(product(*values))
    compose_every_value(sweeper, every)
    assert set(composed) < set(every) and len(composed) == 3 * (3 + 2 - 1)
    for file, override in product(values[0], [*values[1], *values[2]]):
        assert any(file in job and override in job for job in composed)


@pytest.mark.thorough
def test_a_sweep_composes_each_value_before_and_each_job_where_it_runs(tmp_path, monkeypatch):
    real, composed = ConfigLoaderImpl.load_sweep_config, []
    monkeypatch.setattr(
        ConfigLoaderImpl, "load_sweep_config", lambda *given, **named: composed.append(1) or real(*given, **named)
    )
    sweep = ["data=csv", "data.path=none", "save_minutes=1,2", "threads=1,2", "hydra.sweep.dir=s"]
    assert run("-m", *sweep, folder=tmp_path).returncode == 2  # all four jobs fail: there is no such log
    assert len(composed) == 2 + 2 - 1 + 4


@pytest.mark.thorough
def test_no_job_starts_where_a_later_one_cannot_be_composed(tmp_path):
    done = run("-m", "data=simulated,csv", "data.hours=0.1,0.2", "hydra.sweep.dir=sweep", folder=tmp_path)
    assert done.returncode == 2 and "data.hours" in done.stderr and not list(tmp_path.glob("sweep/*/")), done.stderr
