"""The burst of updates after the warm-up, as SAC-AE's public code makes it: its step counter stands still meanwhile."""

import itertools
from typing import Any

import pytest
import torch as th
from agents_for_tests import actor_critic, steps_of
from envs_for_tests import VectorBox, tiny_model
from stable_baselines3.common.vec_env import SubprocVecEnv

from sb3_cure import CuReSAC
from sb3_cure.cure.cure import CuRe


def numbers_of_steps(model: CuReSAC) -> dict[str, int]:
    """How often the optimiser of each part has stepped."""
    steps = {}
    for name in ("task", "curious"):
        agent: Any = actor_critic(model, name)
        steps[f"{name} critic"] = steps_of(agent.critic.optimizer)
        steps[f"{name} actor"] = steps_of(agent.actor.optimizer)
    steps["task temperature"] = steps_of(model.ent_coef_optimizer)
    return steps


@pytest.mark.parametrize("update", ["sequential", "joint"])
def test_burst_updates_actors_in_every_update(update: str) -> None:
    """Beyond the burst, only in every second one."""
    model = tiny_model("MlpPolicy", VectorBox(), update=update, warmup_updates=9)
    model.learn(11)  # the burst of 9, and one more
    assert numbers_of_steps(model) == {
        "task critic": 10, "curious critic": 10, "task actor": 9, "curious actor": 9, "task temperature": 9,
    }  # fmt: skip
    model.learn(10, reset_num_timesteps=False)
    assert numbers_of_steps(model) == {
        "task critic": 20, "curious critic": 20, "task actor": 14, "curious actor": 14, "task temperature": 14,
    }  # fmt: skip


def test_interrupted_burst_is_made_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """By Ctrl-C, as training seems to stand still meanwhile."""
    model, calls = tiny_model("MlpPolicy", VectorBox(), warmup_updates=9), itertools.count(1)
    step = model._gradient_step

    def interrupted(*args: Any) -> None:
        if next(calls) == 5:
            raise KeyboardInterrupt
        step(*args)

    monkeypatch.setattr(model, "_gradient_step", interrupted)
    with pytest.raises(KeyboardInterrupt):
        model.learn(20)
    assert (model.num_timesteps, model._n_updates) == (11, 4)
    model.learn(1, reset_num_timesteps=False)
    assert model._n_updates == 4 + 9 + 1


@pytest.mark.parametrize("burst", [4, 5])
def test_burst_moves_targets_in_every_update(burst: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """With rates of 1 they are what they follow after each update of the burst, however many these are."""
    model = tiny_model("MlpPolicy", VectorBox(), warmup_updates=burst, tau=1.0, encoder_tau=1.0)
    distances: list[float] = []
    train = CuRe.train

    def measuring(self: CuRe, gradient_steps: int, batch_size: int = 64) -> None:
        train(self, gradient_steps, batch_size)
        pairs = [(model.policy.encoder, model.policy.encoder_target)]
        pairs += [
            (agent.critic, agent.critic_target) for agent in (actor_critic(model, n) for n in ("task", "curious"))
        ]
        with th.no_grad():
            distances.append(
                max(
                    float((p - q).abs().max())
                    for source, target in pairs
                    for p, q in zip(source.parameters(), target.parameters(), strict=True)
                )
            )

    monkeypatch.setattr(CuRe, "train", measuring)
    model.learn(13)
    assert distances[0] == 0
    assert max(distances[1:]) > 0


def test_burst_while_environments_step() -> None:
    """With overlap the burst is made during the next step, and is the same."""
    env = SubprocVecEnv([VectorBox])
    model = tiny_model("MlpPolicy", env, warmup_updates=9, overlap=True).learn(11)
    env.close()
    assert numbers_of_steps(model)["task actor"] == 9
