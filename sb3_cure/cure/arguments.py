"""CuRe's own arguments: types, ranges and choices as one table, and what does not go together.

SB3's own arguments are SB3's to check.
"""

from collections.abc import Callable
from typing import Annotated, Any, Literal

import numpy as np
from gymnasium import spaces
from pydantic import BaseModel, ConfigDict, Field, StrictBool, ValidationError
from stable_baselines3.common.buffers import NStepReplayBuffer
from stable_baselines3.common.preprocessing import is_image_space

from sb3_cure.cure.policies import CuRePolicy
from sb3_cure.intrinsic import IntrinsicReward, get_intrinsic_class
from sb3_cure.srl import SRLHead, get_srl_class

Rate = Annotated[float, Field(ge=0, le=1)]
Factor = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Count = Annotated[int, Field(ge=1)]
# A schedule of the remaining progress
Schedule = Callable[[float], float]


class CuReArguments(BaseModel):
    """Types, ranges and choices; defaults are the constructor's."""

    model_config = ConfigDict(from_attributes=True, arbitrary_types_allowed=True, extra="forbid")

    srl: str | type[SRLHead] | None
    srl_kwargs: dict[str, Any]
    srl_schedule: Literal["simultaneous", "alternating"]
    srl_period: Count
    intrinsic: str | type[IntrinsicReward]
    intrinsic_kwargs: dict[str, Any]
    curiosity: Literal["separate", "bonus", "random"] | None
    curiosity_prob: Rate | Schedule
    curiosity_bout: Annotated[float, Field(ge=1)] | Literal["episode"]
    curiosity_beta: Factor
    curiosity_gamma: Rate
    curiosity_ent_coef: str | Factor | None
    curiosity_episodic: StrictBool
    normalize_curiosity: StrictBool
    curiosity_target: Literal["observation", "next_observation"]
    curiosity_encoder_grad: StrictBool
    task: StrictBool
    augmentation: Literal["auto", "shift", "crop"] | None
    augmentation_kwargs: dict[str, Any]
    warmup_updates: Annotated[int, Field(ge=0)] | None
    actor_update_interval: Count
    encoder_tau: Rate
    ent_coef_lr_factor: Factor
    update: Literal["joint", "sequential"]
    precision: Literal["auto", "fp32", "bf16"]
    overlap: StrictBool
    on_bad_transition: Literal["raise", "skip"]


def check_arguments(model: Any) -> None:
    """
    :param model: A CuRe model, its arguments set
    :raises ValueError: for the first that cannot work, in one sentence
    """
    try:
        CuReArguments.model_validate(model)
    except ValidationError as error:
        first = error.errors()[0]
        raise ValueError(f"{first['loc'][0]} is {first['input']!r}: {first['msg'].lower()}.") from None
    _check_combinations(model)


def _check_combinations(model: Any) -> None:
    """What would train something else than what was asked for, without a word."""
    reward = get_intrinsic_class(model.intrinsic).configured(**model.intrinsic_kwargs)
    curious = model.curiosity in ("separate", "bonus")
    if model.srl is None and model.srl_kwargs:
        raise ValueError(f"srl_kwargs is {model.srl_kwargs!r}, but srl=None has no arguments: choose a head.")
    if model.srl is not None:
        get_srl_class(model.srl)
    if curious and reward.needs_srl and model.srl is None:
        raise ValueError(
            f"curiosity={model.curiosity!r} is rewarded by intrinsic={model.intrinsic!r}, which is the error of an SRL "
            "head, but srl is None: choose srl='rae', srl='curl' or a head of your own, or set curiosity=None."
        )
    if not model.task and model.curiosity not in ("separate", "random"):
        raise ValueError(f"task=False leaves nothing to learn with curiosity={model.curiosity!r}: use 'separate'.")
    if model.curiosity == "separate" and model.curiosity_gamma == 0 and model.curiosity_target == "observation":
        raise ValueError(
            "with curiosity_gamma=0 the curious agent learns nothing from the error of the observation itself, which "
            "does not depend on the action: set curiosity_target='next_observation', or a curiosity_gamma > 0."
        )
    if model.n_steps > 1 and model.curiosity == "bonus":
        raise ValueError(
            f"n_steps={model.n_steps} sums the task's rewards over steps, but curiosity='bonus' is a reward of single "
            "ones: set n_steps=1, or curiosity='separate'."
        )
    if issubclass(model.replay_buffer_class or object, NStepReplayBuffer) and not model.everything_off:
        raise ValueError(
            "SB3's NStepReplayBuffer returns observations of n steps later, which heads and rewards would take for the "
            "next ones: leave replay_buffer_class out and give n_steps."
        )
    if not model.everything_off and not issubclass(model.policy_class, CuRePolicy):
        raise ValueError(
            f"the policy is {model.policy_class.__name__}, but SRL and curiosity need a kind of CuRePolicy: use "
            "'CnnPolicy', 'MlpPolicy' or 'MultiInputPolicy', or set srl=None and curiosity=None, which is the base "
            "class."
        )
    if model.use_sde and not model.everything_off:
        raise ValueError("use_sde=True explores by noise of one actor's own features: it needs srl=curiosity=None.")
    space = model.observation_space
    for part in space.spaces.values() if isinstance(space, spaces.Dict) else [space]:
        if len(part.shape or ()) == 3 and not is_image_space(part) and not model.everything_off:
            raise ValueError(
                f"images arrive as {part.dtype}, but the encoder and the replay buffer take uint8 in [0, 255]: return "
                f"(255 * image).astype({np.uint8.__name__}), and use VecNormalize with norm_obs=False (or with "
                "norm_obs_keys)."
            )
