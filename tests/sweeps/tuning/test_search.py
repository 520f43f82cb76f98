"""Searching with Optuna: it goes on where it broke off, and processes share a budget."""

import sys

import numpy as np
import pytest

from tests.support.configured import replayed, request
from usvlearn.errors import ConfigError, MissingExtraError
from usvlearn.sweeps.tuning import search
from usvlearn.sweeps.tuning.batches import Objective


def searched(fleet, folder, evaluations, asked=None, **options):
    asked = asked or request("search=aid")
    objective = Objective(asked.build, fleet)
    return search.search(objective, asked.parameters, evaluations, folder, {"ranges": asked.ranges}, **options)


@pytest.mark.thorough
def test_a_search_that_broke_off_goes_on_to_the_count(fleet, tmp_path):
    asked, work = request("search=aid"), []

    def breaks(done: float) -> None:
        work.append(done)
        if sum(work) > 6:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        search.search(Objective(asked.build, fleet, breaks), asked.parameters, 10, tmp_path,
                      {"ranges": asked.ranges}, batch=4)  # fmt: skip
    evaluated, used, _ = searched(fleet, tmp_path, 10, batch=4)
    assert used == 10 and len(evaluated) == 11 and evaluated[0].setting == {"gain": 1.0}
    again, used, _ = searched(fleet, tmp_path, 10)
    assert again == evaluated and used == 10
    more, used, _ = searched(fleet, tmp_path, 13)
    assert more[:11] == evaluated and used == 13
    assert all(0.01 <= each.setting["gain"] <= 100 for each in more)
    np.testing.assert_allclose(more[-1].maes, replayed(fleet, asked.build(more[-1].setting)), rtol=1e-12)
    with pytest.raises(ConfigError, match="another hydra"):
        searched(fleet, tmp_path, 13, request("search=aid", "tuning.ranges.aid.gain=[0.1,1]"))


@pytest.mark.thorough
def test_a_journal_that_names_code_is_refused(fleet, tmp_path):
    searched(fleet, tmp_path, 2, batch=2)
    journal = tmp_path / "optuna.log"
    text = journal.read_text()
    journal.write_text(text.replace('{"gain":', '{"_target_":'))
    assert journal.read_text() != text
    with pytest.raises(ConfigError, match=r"optuna\.log: found the setting '_target_'"):
        searched(fleet, tmp_path, 2)


def test_without_optuna_the_extra_is_named(fleet, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "optuna", None)
    with pytest.raises(MissingExtraError, match=r"usvlearn\[tune\]"):
        searched(fleet, tmp_path, 2)


def test_a_line_that_a_full_disk_left_unfinished_is_cut_off(fleet, tmp_path):
    evaluated = searched(fleet, tmp_path, 2, batch=2).evaluations
    journal = tmp_path / "optuna.log"
    journal.write_bytes(journal.read_bytes() + b'{"op_code":8,"worker_id":"')
    more, used, _ = searched(fleet, tmp_path, 4, batch=2)
    assert used == 4 and more[:3] == evaluated
