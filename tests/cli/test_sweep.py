"""What a sweep composes before its first job, and what it refuses then."""

import subprocess
import sys
from itertools import product
from types import SimpleNamespace

from tests.support import ROOT
from tests.support.commands import ENVIRONMENT, run
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


COUNT = """
import sys
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from usvlearn.cli.train import main
real, composed = ConfigLoaderImpl.load_sweep_config, []
def counted(self, *arguments, **options):
    composed.append(1)
    return real(self, *arguments, **options)
ConfigLoaderImpl.load_sweep_config = counted
sys.argv = ["train.py", "-m", "data=csv", "data.path=none", "save_minutes=1,2", "threads=1,2,3", "hydra.sweep.dir=s"]
try:
    main()
finally:
    print("composed", len(composed))
"""


def test_a_sweep_composes_each_value_before_and_each_job_where_it_runs(tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", COUNT],
        cwd=tmp_path,
        env={**ENVIRONMENT, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )  # all six jobs fail: there is no such log
    assert done.stdout.endswith(f"composed {2 + 3 - 1 + 6}\n"), done.stdout + done.stderr


def test_no_job_starts_where_a_later_one_cannot_be_composed(tmp_path):
    done = run("-m", "data=simulated,csv", "data.hours=0.1,0.2", "hydra.sweep.dir=sweep", folder=tmp_path)
    assert done.returncode == 2 and "data.hours" in done.stderr and not list(tmp_path.glob("sweep/*/")), done.stderr
