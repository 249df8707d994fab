"""Find what makes latents of observations in a policy of any SB3 algorithm."""

import functools
from collections.abc import Callable
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BaseModel, BasePolicy
from torch import nn

from sb3_cure.cure.policies import CuRePolicy


def encoder_of(policy: BasePolicy) -> tuple[nn.Module, Callable[[th.Tensor], th.Tensor]] | None:
    """Find the encoder of a policy of any SB3 algorithm.

    Of other policies than ``CuRePolicy`` it is the features extractor of the critic, else of DQN's networks, of the
    actor, or of the policy itself (PPO, A2C).

    :param policy: A policy
    :return: The encoder, and a function from observations as stored ([B, *shape], images in 0-255) to latents
        [B, features_dim], as when acting. None for dictionaries of other policies, and if the encoder has no parameters
    """
    encoder: Any
    encode: Callable[[th.Tensor], th.Tensor]
    if isinstance(policy, CuRePolicy):
        encoder, encode = policy.encoder, policy.encode
    else:
        networks = [*(getattr(policy, name, None) for name in ("critic", "q_net", "quantile_net", "actor")), policy]
        owner: Any = next((each for each in networks if getattr(each, "features_extractor", None) is not None), None)
        if owner is None:
            return None
        encoder = owner.features_extractor
        # BaseModel's, as an actor-critic's own returns features of both where these are not shared.
        encode = functools.partial(BaseModel.extract_features, owner, features_extractor=encoder)
    learned = any(True for _ in encoder.parameters())
    known = isinstance(policy, CuRePolicy) or not isinstance(policy.observation_space, spaces.Dict)
    return (encoder, encode) if learned and known else None
