"""The linear probe of pretrained encoders, ``benchmarks/pretrained_states.py``."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from grids_for_tests import DMC_TASK, method, write_grid

from benchmarks import pretrained_states
from sb3_cure.experiments.cells import run_cell
from sb3_cure.experiments.grid import load_grid

PRETRAINED = {**method(), "pretrain": {"collector": "curious", "budget": 1200}}


def test_arms_are_probed_on_the_same_episodes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pretrained_states, "EPISODES", 2)
    evaluation = dict(every=1000, episodes=1)
    arms = {"one": PRETRAINED, "other": PRETRAINED}
    grid = load_grid(write_grid(tmp_path, tasks=[DMC_TASK], budget=1000, evaluation=evaluation, methods=arms))
    one, other = (tmp_path / cell.folder for cell in grid.cells)
    run_cell(grid.cells[0], tmp_path, pictures=False)
    shutil.copytree(one, other)

    def probed() -> dict[tuple[object, ...], float]:
        rows = pretrained_states.probe_seed(grid.cells, tmp_path)
        return {(row["method"], row["episodes"], row["coordinate"]): row["r2"] for row in rows}

    before = probed()
    kinds = {key[1:] for key in before}
    assert {kind for kind, _ in kinds} == {"random", "task"}
    # One encoder has one result, whoever has trained on from it
    assert all(np.array_equal(before["one", *key], before["other", *key], equal_nan=True) for key in kinds)
    assert np.isfinite([before["one", kind, "slider"] for kind in ("random", "task")]).all()
    # It is the pretrained encoder that is probed
    shutil.copy(one / "model.zip", one / "pretrained.zip")
    after = probed()
    assert after["one", "random", "slider"] != before["one", "random", "slider"]
    assert after["other", "random", "slider"] == before["other", "random", "slider"]
