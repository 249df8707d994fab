"""Wrap environments in the checks that every training needs."""

import numpy as np
from stable_baselines3.common.preprocessing import get_obs_shape
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize, unwrap_vec_wrapper

from sb3_cure.data.observations import by_key
from sb3_cure.envs.copy_observations import CopyObservations
from sb3_cure.vec_env.finite_check import FiniteCheck


def check_environments(venv: VecEnv) -> FiniteCheck:
    """Copy and check what environments return.

    Environments of this process are put into ``CopyObservations``, and ``venv`` into ``FiniteCheck``. For workers of
    SB3's ``SubprocVecEnv`` you have to do the former yourself, see :class:`~sb3_cure.envs.CopyObservations`.

    :param venv: Environments, wrapped as SB3 does
    :return: The environments in a ``FiniteCheck``
    :raises ValueError: If ``VecNormalize`` is used in a way that makes the replay buffer store something else
    """
    if isinstance(venv, FiniteCheck):
        return venv
    _check_normalizer(venv)
    base = venv.unwrapped
    if isinstance(base, DummyVecEnv):
        base.envs = [env if isinstance(env, CopyObservations) else CopyObservations(env) for env in base.envs]
    return FiniteCheck(venv)


def _check_normalizer(venv: VecEnv) -> None:
    normalizer = unwrap_vec_wrapper(venv, VecNormalize)
    if normalizer is not None and get_obs_shape(venv.observation_space) != get_obs_shape(normalizer.observation_space):
        raise ValueError(
            "VecNormalize is inside of a wrapper that changes the shape of observations, but the replay buffer stores "
            "what VecNormalize gets: put it outside, such as VecNormalize(VecTransposeImage(venv)) for images with the "
            "channels last."
        )
    if normalizer is not None and normalizer.norm_obs:
        parts = by_key(normalizer.observation_space)
        normalized = parts if normalizer.norm_obs_keys is None else normalizer.norm_obs_keys
        if any(np.issubdtype(parts[key].dtype, np.integer) for key in normalized):
            raise ValueError(
                "VecNormalize normalizes integers, but SB3 stores terminal observations that it has normalized as "
                "integers again: declare floats, or use norm_obs=False, as encoders standardise vectors themselves."
            )
