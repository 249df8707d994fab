"""Defaults of heads, rewards and augmentations, that are those of papers or that results were made with."""

import inspect
from typing import Any

import pytest

from sb3_cure.intrinsic import INTRINSIC_REWARDS, RewardScale
from sb3_cure.networks.augmentations import RandomShift
from sb3_cure.srl import SRL_HEADS


@pytest.mark.parametrize(
    ("part", "defaults"),
    [
        (SRL_HEADS["rae"], dict(latent_penalty=1e-6, decoder_weight_decay=1e-7)),  # SAC-AE
        (SRL_HEADS["curl"], dict(bank_size=64)),
        (SRL_HEADS["spr"], dict(tau=0.05)),
        (SRL_HEADS["vae"], dict(beta=1e-6)),
        (INTRINSIC_REWARDS["srl_error"], dict(per_pixel=False, decay=0.99)),
        (INTRINSIC_REWARDS["disagreement"], dict(n_members=5, share=0.5)),
        (INTRINSIC_REWARDS["particle"], dict(n_neighbours=12, memory=512)),
        (RewardScale, dict(decay=0.99, clip=5.0)),
        (RandomShift, dict(pad=4)),  # DrQ
    ],
)
def test_defaults(part: type, defaults: dict[str, Any]) -> None:
    parameters = inspect.signature(part).parameters
    assert {name: parameters[name].default for name in defaults} == defaults
