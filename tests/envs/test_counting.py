"""Visits of the true state's cells: in the info, and as a reward that exact resume keeps."""

from collections import Counter
from typing import Any

import numpy as np
import pytest
from envs_for_tests import PixelBox
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_cure import make_dmc_env
from sb3_cure.envs import physics_state, physics_state_names
from sb3_cure.envs.counting import CellInfo, CountReward
from sb3_cure.persistence.env_state import load_vec_env_state, vec_env_state

WIDTHS = {"slider": 0.05, "hinge_1": 0.3}


def cartpole() -> Any:
    return make_dmc_env("cartpole", "swingup", image_size=16, frame_stack=1, renderer="fast", seed=0)


def actions(n: int) -> np.ndarray:
    return np.random.default_rng(0).uniform(-1, 1, (n, 1)).astype(np.float32)


def test_reward_is_one_by_the_root_of_visits() -> None:
    """Of the state that the step leads to, over episodes; nothing else differs from the environment itself."""
    env, plain, counts = CellInfo(CountReward(cartpole(), WIDTHS), WIDTHS), cartpole(), Counter[tuple[int, ...]]()
    for _ in range(2):
        np.testing.assert_array_equal(env.reset()[0], plain.reset()[0])
        for action in actions(60):
            obs, reward, *_, info = env.step(action)
            np.testing.assert_array_equal(obs, plain.step(action)[0])
            state = dict(zip(physics_state_names(plain), physics_state(plain), strict=True))
            cell = tuple(int(np.floor(state[name] / width)) for name, width in WIDTHS.items())
            counts[cell] += 1
            assert info["cell"] == cell and reward == pytest.approx(1 / counts[cell] ** 0.5)
    assert env.get_wrapper_attr("visits") == counts and max(counts.values()) > 3 and len(counts) > 10


def test_counts_are_resumed() -> None:
    first, second = (DummyVecEnv([lambda: CellInfo(CountReward(cartpole(), WIDTHS), WIDTHS)]) for _ in range(2))
    first.reset()
    for action in actions(30):
        first.step(action[None])
    load_vec_env_state(second, vec_env_state(first))
    for action in actions(20):
        one, other = first.step(action[None]), second.step(action[None])
        assert one[1] == other[1] and one[3][0]["cell"] == other[3][0]["cell"]
    assert first.get_attr("visits") == second.get_attr("visits")


@pytest.mark.parametrize("widths", [{}, {"elbow": 1.0}, {"slider": 0.0}])
def test_grids_that_cannot_be_are_refused(widths: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="widths must be > 0, for some of slider"):
        CellInfo(cartpole(), widths)
    with pytest.raises(ValueError, match="has no physics of dm_control"):
        CountReward(PixelBox(), WIDTHS)
