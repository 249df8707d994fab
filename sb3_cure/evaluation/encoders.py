"""Find the encoder in a policy of any SB3 algorithm."""

import functools
from collections.abc import Callable
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BaseModel, BasePolicy

from sb3_cure.cure.policies import CuRePolicy

#: Parts of a policy that may own the features extractor, starting with the part that trains it
_OWNERS = ("critic", "q_net", "quantile_net", "actor")


def encoder_of(policy: BasePolicy) -> Callable[[th.Tensor], th.Tensor] | None:
    """Find the encoder of a policy of any SB3 algorithm.

    In policies other than ``CuRePolicy`` it is the features extractor of the critic, else of DQN's networks, of the
    actor, or of the policy itself (PPO, A2C).

    :param policy: A policy
    :return: Function from observations as stored ([B, *shape], images in 0-255) to latents [B, features_dim], as when
        acting. None for dictionaries of other policies, and if the encoder has no parameters
    """
    if isinstance(policy, CuRePolicy):
        return policy.encode if any(True for _ in policy.encoder.parameters()) else None
    if isinstance(policy.observation_space, spaces.Dict):
        return None
    owners: list[Any] = [*(getattr(policy, name, None) for name in _OWNERS), policy]
    for owner in owners:
        extractor = getattr(owner, "features_extractor", None)
        if extractor is not None:
            # BaseModel's method: an actor-critic's own returns two sets of features where extractors are not shared.
            encode = functools.partial(BaseModel.extract_features, owner, features_extractor=extractor)
            return encode if any(True for _ in extractor.parameters()) else None
    return None
