"""Learning, not only running: the return rises on a tiny pixel task, and a curious policy finds the static."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from envs_for_tests import PixelBox, tiny_model

from sb3_cure import CuReSAC
from sb3_cure.evaluation.rollouts import run_episodes

SIZE = 24
#: What learns quickly here: short horizon, quick targets, an update of everything per step
QUICK: dict[str, Any] = dict(
    learning_starts=200,
    batch_size=32,
    tau=0.05,
    actor_update_interval=1,
    target_update_interval=1,
    buffer_size=2000,
    policy_kwargs=dict(net_arch=[64], features_extractor_kwargs=dict(n_filters=8, n_layers=3)),
)


class StaticScreen(PixelBox):
    """``PixelBox`` that shows new random pixels as long as the dot is near the right border: nobody can learn these."""

    def __init__(self) -> None:
        super().__init__(frame_stack=1, size=SIZE)
        self.noise = np.random.default_rng(0)
        self.static_steps = 0

    def observe(self, first: bool = False) -> np.ndarray:
        frame = super().observe(first)
        if self.position[1] > 0.75:
            self.static_steps += 1
            frame = frame.copy()
            frame[:, : SIZE // 2] = self.noise.integers(0, 256, frame[:, : SIZE // 2].shape, dtype=np.uint8)
        return frame


def mean_return(model: CuReSAC, env: gym.Env, actor: str, n_episodes: int = 30) -> float:
    return float(np.mean([episode.total_reward for episode in run_episodes(model, env, n_episodes, actor, seed=1)]))


@pytest.mark.parametrize(
    ("srl", "update"), [("rae", "joint"), pytest.param("curl", "sequential", marks=pytest.mark.long)]
)
def test_task_return_rises_well_above_random(srl: str, update: str) -> None:
    """Random earns about 7 of 20, the best possible is about 18; a policy that ignores what it sees stays below 10."""
    model = tiny_model(
        "CnnPolicy",
        PixelBox(frame_stack=1, size=SIZE),
        srl=srl,
        update=update,
        gamma=0.9,
        **QUICK,
    ).learn(800)
    env = PixelBox(frame_stack=1, size=SIZE)
    random = mean_return(model, env, "random")
    assert random < 9
    assert mean_return(model, env, "task") > 14


def test_curious_policy_visits_persistently_high_error_more_than_random() -> None:
    """A CuRe-only agent, whose sole reward is the SRL error, seeks the screen of static."""
    model = tiny_model(
        "CnnPolicy",
        StaticScreen(),
        srl="rae",
        task=False,
        curiosity_gamma=0.9,
        **QUICK,
    ).learn(800)
    visits, errors = {}, {}
    for actor in ("curious", "random"):
        env = StaticScreen()
        episodes = list(run_episodes(model, env, 30, actor, seed=1))
        visits[actor] = env.static_steps / sum(len(episode.rewards) for episode in episodes)
        errors[actor] = np.concatenate([episode.srl_errors for episode in episodes]).mean()
    assert visits["random"] < 0.4
    assert visits["curious"] > 0.7
    assert errors["curious"] > 1.5 * errors["random"]
