"""Results beside published numbers."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from results_for_tests import RAE, TASK, curve, write_cell, write_grid, write_two_arms

from sb3_cure.experiments import published
from sb3_cure.experiments.results import read_results


@pytest.fixture
def results(tmp_path: Path) -> Path:
    """The folder of two arms."""
    write_two_arms(tmp_path / "curves")
    return tmp_path / "curves"


@pytest.mark.parametrize(("final", "suspect"), [(233.0, True), (233.5, False)])
def test_suspicion_begins_below_three_quarters(tmp_path: Path, final: float, suspect: bool) -> None:
    """0.75 x 311 = 233.25."""
    folder = tmp_path / "curves"
    write_grid(folder)
    write_cell(folder, TASK, "sac_ae", 0, curve(0, final), arguments=RAE)
    (row,) = published.compare_with_published(read_results(folder))
    assert row.suspect is suspect and np.isnan(row.std)


def test_other_pixels_are_not_compared(tmp_path: Path) -> None:
    """The same curves in small grey images get neither a comparison nor a verdict; crops of 100 pixels do, for CURL."""
    crops = {"srl": "curl", "augmentation": "crop"}
    for name, arguments, env_kwargs, compared in (
        ("usual", {"srl": "rae"}, {"image_size": 84}, True),
        ("small", {"srl": "rae"}, {"image_size": 36, "grayscale": True}, False),
        ("fast", {"srl": "rae"}, {"renderer": "fast"}, False),
        ("crops", crops, {"image_size": 100}, True),
        ("whole", {"srl": "curl"}, {"image_size": 100}, False),
        ("shifts", {"srl": "curl"}, {}, True),
    ):
        folder = tmp_path / name
        write_grid(folder)
        write_cell(
            folder,
            TASK,
            "sac_ae",
            0,
            curve(0, 50, 100),
            arguments={**arguments, "curiosity": None},
            env_kwargs=env_kwargs,
        )
        (experiment,) = read_results(str(folder))
        rows = published.compare_with_published([experiment])
        assert bool(rows) == compared, name
        assert all(row.same_method == (name != "shifts") for row in rows), "shifts are DrQ's"


@pytest.mark.parametrize(
    ("arguments", "same"),
    [
        ({"gamma": 0.99, "policy_kwargs": {"net_arch": [1024, 1024]}, "buffer_size": 100}, True),
        ({"gamma": 0.98}, False),
        ({"learning_rate": 1e-6}, False),
        ({"policy_kwargs": {"net_arch": [8]}}, False),
        ({"augmentation": "shift"}, False),
        ({"train_freq": 4}, False),
        ({"learning_starts": 1000, "warmup_updates": 1000, "update": "joint"}, True),
        ({"learning_starts": 1_000_000}, False),
        ({"warmup_updates": 0}, False),
        ({"n_steps": 5}, False),
        ({"srl_kwargs": {"latent_penalty": 1.0}}, False),
        ({"env_wrapper": ["sb3_cure.envs.counting.CountReward"]}, False),
    ],
)
def test_other_settings_are_not_judged(tmp_path: Path, arguments: dict[str, Any], same: bool) -> None:
    """Such an arm is no evidence of a bug."""
    write_grid(tmp_path)
    write_cell(tmp_path, TASK, "sac_ae", 0, curve(0, 1), arguments={**RAE, **arguments})
    (row,) = published.compare_with_published(read_results(tmp_path))
    assert (row.same_method, row.suspect) == (same, same)
