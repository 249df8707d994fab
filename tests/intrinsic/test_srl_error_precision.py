"""SRL errors keep their digits where the rest computes in bf16: they are what the curious agent is rewarded with."""

from typing import Any

import pytest
import torch as th
from agents_for_tests import one_update
from envs_for_tests import VectorBox, tiny_model
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from torch import nn

from sb3_cure.srl import SRLHead, SRLOutput


class Twins(SRLHead):
    """A user's head of a linear map: its error is how far its output is from that of next to the same inputs."""

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.map = nn.Linear(self.encoder.features_dim, 32)
        self.formats: list[th.dtype] = []

    def loss(self, batch: ReplayBufferSamples, latents: th.Tensor) -> SRLOutput:
        drawn = self.map(latents)
        self.formats.append(drawn.dtype)
        error = (drawn - self.map(latents + 1e-3)).square().mean(dim=1)
        return SRLOutput(error.mean(), error.detach())


@pytest.mark.parametrize("target", ["observation", "next_observation"])
def test_users_heads_compute_in_fp32(target: str) -> None:
    """Whatever the precision: a difference of bf16 would be rounding, and nothing in its format could tell."""
    logged = {}
    for precision in ("fp32", "bf16"):
        model = tiny_model(
            "MlpPolicy", VectorBox(), srl=Twins, learning_starts=40, precision=precision, curiosity_target=target
        ).learn(40)
        logged[precision] = one_update(model)
        assert set(model.policy.srl.formats) == {th.float32}
    for name in ("srl_loss", "curious_reward_raw_mean", "curious_reward_raw_max"):
        assert logged["bf16"][name] == pytest.approx(logged["fp32"][name], rel=1e-3)
