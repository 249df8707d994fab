"""Put environments into the checks that every training needs."""

from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_cure.envs.copy_observations import CopyObservations
from sb3_cure.vec_env.finite_check import FiniteCheck


def check_environments(venv: VecEnv) -> FiniteCheck:
    """Copy and check what environments return.

    Environments of this process are put into ``CopyObservations``, and ``venv`` into ``FiniteCheck``. In workers of
    SB3's ``SubprocVecEnv`` only you can do the former, see :class:`~sb3_cure.envs.CopyObservations`.

    :param venv: Environments, wrapped as SB3 does
    :return: The environments in a ``FiniteCheck``
    """
    if isinstance(venv, FiniteCheck):
        return venv
    base = venv.unwrapped
    if isinstance(base, DummyVecEnv):
        base.envs = [env if isinstance(env, CopyObservations) else CopyObservations(env) for env in base.envs]
    return FiniteCheck(venv)
