"""Wrong arguments of ``CuReSAC``, each in one sentence that names the value, what is expected and the fix."""

from typing import TYPE_CHECKING, Any

import numpy as np
import torch as th
from gymnasium import spaces

from sb3_cure.mixers import CuriousMixer
from sb3_cure.policies import CnnPolicy, CuRePolicy, MlpPolicy
from sb3_cure.precision import COMPILE, resolve_precision
from sb3_cure.srl import get_srl_class

if TYPE_CHECKING:
    from sb3_cure.cure_sac import CuReSAC


def check_action_space(action_space: spaces.Space) -> None:
    """
    :param action_space: Action space of the environment
    :raises ValueError: if it is no Box with finite bounds
    """
    if not isinstance(action_space, spaces.Box):
        raise ValueError(
            f"the action space is {action_space}, but SAC needs continuous actions (a Box): use another algorithm "
            "(DQN, PPO), or an environment with continuous actions."
        )
    if not (np.isfinite(action_space.low).all() and np.isfinite(action_space.high).all()):
        raise ValueError(
            f"the action space is {action_space}, but SAC needs finite bounds: wrap the environment so that its "
            "actions lie in, say, [-1, 1] (gymnasium's RescaleAction or ClipAction)."
        )


def check_arguments(model: "CuReSAC") -> None:
    """Everything that can be known to be wrong before anything is built.

    :param model: The model, its arguments set
    :raises ValueError: for the first argument that cannot work
    """
    if model.srl is not None:
        get_srl_class(model.srl)
    _check_choice("srl_schedule", model.srl_schedule, ("simultaneous", "alternating"))
    _check_choice("curiosity", model.curiosity, ("separate", "bonus", "random", None))
    _check_choice("curiosity_target", model.curiosity_target, ("observation", "next_observation"))
    _check_choice("update", model.update, ("sequential", "joint"))
    _check_choice("on_bad_transition", model.on_bad_transition, ("raise", "skip"))
    resolve_precision(model.precision, model.device)
    _check_choice("compile", model.compile, COMPILE)
    CuriousMixer(model.curiosity_prob)
    for name in ("gamma", "curiosity_gamma", "tau", "encoder_tau"):
        _check_range(name, getattr(model, name), 0.0, 1.0)
    for name in ("curiosity_beta", "ent_coef_lr_factor", "learning_starts"):
        _check_range(name, getattr(model, name), 0.0, np.inf)
    for name in ("task", "overlap", "normalize_curiosity", "curiosity_encoder_grad"):
        if not isinstance(getattr(model, name), bool):
            raise ValueError(f"{name} is {getattr(model, name)!r}, but it must be True or False: change {name}.")
    if model.warmup_updates is not None:
        _check_integer("warmup_updates", model.warmup_updates, 0)
    for name in ("batch_size", "buffer_size", "srl_period", "actor_update_interval", "target_update_interval"):
        _check_integer(name, getattr(model, name), 1)
    _check_ent_coef(model.ent_coef)
    if model.srl is None and model.srl_kwargs:
        raise ValueError(
            f"srl_kwargs={model.srl_kwargs!r} was given with srl=None, but these are the arguments of an SRL head: "
            "choose srl='rae', srl='curl' or a head of your own, or leave srl_kwargs out."
        )
    if model.curiosity is not None and model.srl is None:
        raise ValueError(
            f"curiosity={model.curiosity!r} was given with srl=None, but the curious reward is the SRL error: "
            "choose srl='rae', srl='curl' or a head of your own, or set curiosity=None."
        )
    if not model.task and model.curiosity != "separate":
        raise ValueError(
            f"task=False was given with curiosity={model.curiosity!r}, but an agent without task needs a curious "
            "policy: set curiosity='separate'."
        )
    if model.curiosity == "separate":
        check_curious_agent(model)
    if model.use_sde and not model.is_plain_sac:
        raise ValueError(
            f"use_sde=True was given with srl={model.srl!r} and curiosity={model.curiosity!r}, but gSDE's noise "
            "belongs to one actor on its own features: leave use_sde=False, or set srl=None and curiosity=None."
        )
    if model.n_steps > 1 and model.curiosity is not None:
        raise ValueError(
            f"n_steps={model.n_steps} was given with curiosity={model.curiosity!r}, but the curious reward is known "
            "for single transitions only: set n_steps=1, or curiosity=None."
        )
    check_skip(model)
    # Dictionaries, for which SB3 asks for 'MultiInputPolicy', are refused for themselves.
    is_dict = isinstance(model.observation_space, spaces.Dict)
    if not (model.is_plain_sac or is_dict or issubclass(model.policy_class, CuRePolicy)):
        policy = f"{model.policy_class.__module__}.{model.policy_class.__name__}"
        raise ValueError(
            f"the policy is {policy}, but SRL and curiosity need a subclass of sb3_cure.policies.CuRePolicy: use "
            "'CnnPolicy' or 'MlpPolicy'."
        )


def check_curious_agent(model: "CuReSAC") -> None:
    """What a second actor-critic cannot learn from.

    :param model: The model, its arguments set
    :raises ValueError: if the curious reward would not depend on the action, or is unknown
    """
    if model.curiosity_gamma == 0 and model.curiosity_target == "observation":
        raise ValueError(
            "curiosity_gamma=0 was given with curiosity_target='observation', but the error of the observation "
            "itself does not depend on the action, so that there is nothing to learn: set "
            "curiosity_target='next_observation', or a curiosity_gamma > 0."
        )
    if model.n_steps > 1:
        raise ValueError(
            f"n_steps={model.n_steps} was given with a curious policy to train, but the curious reward is known "
            "for single transitions only: set n_steps=1."
        )


def check_skip(model: "CuReSAC") -> None:
    """
    :param model: The model, its arguments and environments set
    :raises ValueError: if bad transitions are to be left out, but something takes them before
    """
    if model.on_bad_transition == "skip" and model.get_vec_normalize_env() is not None:
        raise ValueError(
            "on_bad_transition='skip' was given with VecNormalize, but its running averages take a bad value before it "
            "can be left out: leave on_bad_transition='raise', or use environments without VecNormalize."
        )


def check_shared_encoder_space(observation_space: spaces.Space, policy_class: type) -> None:
    """Whether the shared encoder can read these observations.

    :param observation_space: Observation space of the environment
    :param policy_class: The policy that is to read it
    :raises ValueError: if it cannot
    """
    if isinstance(observation_space, spaces.Dict | spaces.Tuple):
        raise ValueError(
            f"observations are {observation_space}, but the shared encoder reads one image or one vector: pick one "
            "entry with a wrapper (gymnasium's FilterObservation and FlattenObservation), or use srl=None and "
            "curiosity=None, which is SB3's own SAC."
        )
    image_like = isinstance(observation_space, spaces.Box) and len(observation_space.shape) == 3
    if image_like and (
        observation_space.dtype != np.uint8
        or np.any(observation_space.low != 0)  # type: ignore[attr-defined]
        or np.any(observation_space.high != 255)  # type: ignore[attr-defined]
    ):
        raise ValueError(
            f"images arrive as {observation_space.dtype} in [{observation_space.low.min()}, "  # type: ignore[attr-defined]
            f"{observation_space.high.max()}], but the encoder and the replay buffer take uint8 in [0, 255]: give "  # type: ignore[attr-defined]
            "the environment's images as they are rendered, and VecNormalize with norm_obs=False."
        )
    if issubclass(policy_class, MlpPolicy) and image_like:
        raise ValueError(
            f"'MlpPolicy' got images of shape {observation_space.shape}, but it reads vectors: use 'CnnPolicy'."
        )
    if issubclass(policy_class, CnnPolicy) and not image_like:
        raise ValueError(
            f"'CnnPolicy' got observations of shape {observation_space.shape}, but it reads images (channels, height, "
            "width): use 'MlpPolicy' for vectors, or make_dmc_env / make_pixel_env for pixels."
        )


def check_srl_error(error: th.Tensor, batch_size: int, look: bool) -> None:
    """
    :param error: ``SRLOutput.error`` of a head
    :param batch_size: Number of samples it was computed for
    :param look: Whether to look at the values too, for which a GPU has to stop
    :raises ValueError: if it is not one finite number >= 0 per sample
    """
    if error.shape != (batch_size,) or error.requires_grad:
        kind = f"of shape {tuple(error.shape)}" + (" with a gradient" if error.requires_grad else "")
        raise ValueError(
            f"the SRL head returned an error {kind} for {batch_size} samples, but SRLOutput.error is one detached "
            f"number per sample, shape ({batch_size},): average over all other dimensions, and detach()."
        )
    if look and not (th.isfinite(error).all() and (error >= 0).all()):
        raise ValueError(
            f"the SRL head returned errors from {float(error.min())} to {float(error.max())}, but SRLOutput.error must "
            "be finite and >= 0: fix the head's loss()."
        )


def _check_choice(name: str, value: object, choices: tuple[object, ...]) -> None:
    if value not in choices:
        raise ValueError(f"{name} is {value!r}, but it must be one of {', '.join(map(repr, choices))}: choose one.")


def _check_range(name: str, value: Any, low: float, high: float) -> None:
    is_number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
    if not (is_number and low <= value <= high and np.isfinite(value)):
        bounds = f"within [{low:g}, {high:g}]" if np.isfinite(high) else f"of at least {low:g}"
        raise ValueError(f"{name} is {value!r}, but it must be a number {bounds}: change {name}.")


def _check_integer(name: str, value: Any, low: int) -> None:
    if not isinstance(value, int | np.integer) or isinstance(value, bool) or value < low:
        raise ValueError(f"{name} is {value!r}, but it must be a whole number of at least {low}: change {name}.")


def _check_ent_coef(ent_coef: Any) -> None:
    initial: Any = ent_coef
    if ent_coef == "auto":
        initial = 1.0
    elif isinstance(ent_coef, str) and ent_coef.startswith("auto_"):
        initial = ent_coef.removeprefix("auto_")
    try:
        works = float(initial) > 0 or (not isinstance(ent_coef, str) and float(initial) == 0)
    except (TypeError, ValueError):
        works = False
    if not works:
        raise ValueError(
            f"ent_coef is {ent_coef!r}, but it must be 'auto', 'auto_<initial temperature > 0>' (say 'auto_0.1'), or a "
            "fixed number >= 0: change ent_coef."
        )
