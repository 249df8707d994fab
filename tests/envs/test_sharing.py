"""Environments that are, or hold, the same one are found."""

import gymnasium as gym
from envs_for_tests import VectorBox
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_cure.envs.sharing import share_environment
from sb3_cure.vec_env import check_environments


def test_shared_environments_are_found() -> None:
    env, other = VectorBox(), VectorBox()
    several = check_environments(VecNormalize(DummyVecEnv([lambda: Monitor(env)])))
    for same in (env, Monitor(env), gym.wrappers.TimeLimit(env, 3), DummyVecEnv([lambda: env]), several):
        assert share_environment(several, same) and share_environment(same, several)
    assert not share_environment(several, other) and not share_environment(several, DummyVecEnv([lambda: other]))
    assert not share_environment(several, None)


def test_shared_simulator_is_found() -> None:
    """Two adapters around one robot, under any name."""

    class Adapter(gym.Env):
        def __init__(self, robot: VectorBox) -> None:
            self.robot = robot

    robot = VectorBox()
    assert share_environment(Adapter(robot), Monitor(Adapter(robot)))
    assert not share_environment(Adapter(robot), Adapter(VectorBox()))
