"""The YAML files hold the paper's settings and can be trained by rl-zoo3."""

from pathlib import Path

import gymnasium as gym
import pytest
import rl_zoo3.utils
import yaml
from rl_zoo3.exp_manager import ExperimentManager

import sb3_cure  # noqa: F401  (registers the ids)
from sb3_cure import CuReSAC
from sb3_cure.envs import make_dmc_env

CONFIG = Path(__file__).parent.parent / "zoo_configs" / "cure_sac.yml"
ENTRIES = yaml.safe_load(CONFIG.read_text())
SIX_TASKS = {
    "dmc_pixels/cartpole-swingup-v0",
    "dmc_pixels/finger-spin-v0",
    "dmc_pixels/finger-turn_easy-v0",
    "dmc_pixels/reacher-easy-v0",
    "dmc_pixels/reacher-hard-v0",
    "dmc_pixels/ball_in_cup-catch-v0",
}


def test_the_papers_six_tasks_and_a_default() -> None:
    """All six tasks are there, as registered ids, and a default for any other."""
    assert ENTRIES.keys() == SIX_TASKS | {"default"}
    assert SIX_TASKS <= gym.registry.keys()


@pytest.mark.parametrize("name", ENTRIES)
def test_entries_hold_the_papers_table(name: str) -> None:
    """Batch 128, capacity 80 000, p_c 0.2, ... and 500k environment steps in agent steps."""
    entry = ENTRIES[name]
    table = dict(
        batch_size=128, buffer_size=80_000, gamma=0.99, curiosity_prob=0.2, learning_rate=1e-3, tau=0.01,
        target_update_interval=2, actor_update_interval=2, ent_coef="auto_0.1", learning_starts=1000,
        policy_kwargs="dict(net_arch=[1024, 1024])",
    )  # fmt: skip
    assert {key: entry[key] for key in table} == table
    domain = name.removeprefix("dmc_pixels/").split("-")[0]
    repeat = {"cartpole": 8, "finger": 2}.get(domain, 4)
    assert entry["n_timesteps"] * repeat == 500_000


def test_rl_zoo_builds_and_trains_the_agent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """rl-zoo3 reads the file, passes every setting to CuReSAC and trains it on the real environment."""
    monkeypatch.setitem(rl_zoo3.utils.ALGOS, "cure_sac", CuReSAC)
    monkeypatch.setitem(rl_zoo3.exp_manager.ALGOS, "cure_sac", CuReSAC)
    manager = ExperimentManager(
        type("Arguments", (), {"conf_file": str(CONFIG)})(),
        "cure_sac",
        "dmc_pixels/cartpole-swingup-v0",
        str(tmp_path),
        n_timesteps=3,
        config=str(CONFIG),
        # The paper's sizes would take minutes here.
        hyperparams=dict(
            learning_starts=2, warmup_updates=1, batch_size=2, buffer_size=100,
            policy_kwargs="dict(net_arch=[16], features_extractor_kwargs=dict(n_filters=4))",
        ),
    )  # fmt: skip
    model, _ = manager.setup_experiment()
    assert isinstance(model, CuReSAC)
    assert (model.srl, model.curiosity, model.curiosity_prob) == ("rae", "separate", 0.2)
    assert model.observation_space == make_dmc_env("cartpole", "swingup").observation_space
    model.learn(3)
    # One burst, then one update for the step after the warm-up.
    assert model._n_updates == 2
