"""Frames that cannot be right are noticed, and those that can be are left alone."""

from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from envs_for_tests import PixelBox, VectorBox

from sb3_cure.envs import make_dmc_env
from sb3_cure.vec_env.frame_watch import FrameFaultError, FrameWatch


class Broken(gym.Wrapper):
    """Its newest frame is black, or stays the same."""

    def __init__(self, env: gym.Env, kind: str) -> None:
        super().__init__(env)
        self.kind, self.frozen = kind, None

    def broken(self, observation: np.ndarray) -> np.ndarray:
        stack = np.moveaxis(observation, np.argmin(observation.shape), 0)
        if self.kind == "black":
            stack[-3:] = 0
        if self.kind == "frozen":
            self.frozen = stack[-3:].copy() if self.frozen is None else self.frozen
            stack[-3:] = self.frozen
        return observation

    def reset(self, **kwargs: Any) -> Any:
        observation, info = self.env.reset(**kwargs)
        return observation if self.frozen is None else self.broken(observation), info

    def step(self, action: Any) -> Any:
        observation, *rest = self.env.step(action)
        return self.broken(observation), *rest


def position(env: gym.Env) -> np.ndarray:
    return env.unwrapped.position


def watched(kind: str, episode_length: int = 20, channels_last: bool = False, **arguments: Any) -> FrameWatch:
    return FrameWatch(
        Broken(PixelBox(size=12, episode_length=episode_length, channels_last=channels_last), kind), **arguments
    )


def steps_until_fault(env: gym.Env, speed: float = 0.5, most: int = 30) -> tuple[int, int]:
    """How many steps were good, and how many frozen frames the last of these told of."""
    env.reset(seed=0)
    n_good = told = 0
    try:
        while n_good < most:
            _, _, terminated, truncated, info = env.step(np.full(2, speed if n_good % 2 else -speed, np.float32))
            n_good, told = n_good + 1, info.get("frozen_frames", 0)
            if terminated or truncated:
                env.reset()
    except FrameFaultError:
        pass
    return n_good, told


@pytest.mark.parametrize("channels_last", [False, True])
def test_black_and_frozen_frames_are_noticed(channels_last: bool) -> None:
    assert steps_until_fault(watched("black", channels_last=channels_last)) == (0, 0)
    # 20 environment steps are 5 agent steps; the first frozen picture is a new one.
    frozen = watched("frozen", channels_last=channels_last, state=position, frozen_steps=20)
    assert steps_until_fault(frozen) == (5, 4)


def test_frozen_pixels_are_noticed_across_short_episodes() -> None:
    """What resets return is no step."""
    n_good, told = steps_until_fault(watched("frozen", episode_length=2, state=position, frozen_steps=20), speed=1)
    assert n_good < 20 and told == n_good - 1


def test_harmless_frames_are_no_fault() -> None:
    """Dark frames where they are allowed; the same pixels at rest, without a state, or for a short time."""
    cases: list[tuple[str, dict[str, Any], float]] = [
        ("black", {"allow_black_frames": True}, 0.5),
        ("frozen", {"state": position, "frozen_steps": 8}, 0.0),
        ("frozen", {"state": position, "frozen_steps": 8, "frozen_motion": 0.4}, 0.5),
        ("frozen", {"state": position, "frozen_steps": None}, 0.5),
        ("frozen", {"frozen_steps": 8}, 0.5),
        ("frozen", {"state": position, "frozen_steps": 64}, 0.5),
    ]
    for kind, arguments, speed in cases:
        assert steps_until_fault(watched(kind, **arguments), speed, most=12)[0] == 12, arguments


def test_cartpole_that_leaves_its_picture_is_no_fault() -> None:
    """The only domain of the suite that leaves the view for long: the pole swings where the camera does not see it."""
    env = FrameWatch(make_dmc_env("cartpole", "swingup", image_size=36, renderer="fast"))
    env.reset(seed=1)
    told = [env.step(np.ones(1, np.float32))[4].get("frozen_frames", 0) for _ in range(60)]
    assert max(told) > 5
    env.close()


def test_frozen_pixels_of_dm_control_are_noticed() -> None:
    """It knows the positions of the joints by itself."""
    env = FrameWatch(Broken(make_dmc_env("ball_in_cup", "catch", image_size=24, renderer="fast"), "frozen"))
    assert steps_until_fault(env, most=60)[0] < 60
    env.close()


class OtherShape(VectorBox):
    """Its third observation has three numbers."""

    frame_stack, action_repeat = "of three", None  # names that may mean something else

    def observe(self, first: bool = False) -> np.ndarray:
        return np.zeros(3 if self.n_steps == 2 else 2, np.float32)


def test_observation_of_another_shape_is_noticed() -> None:
    """As of a camera that changes its resolution."""
    env = FrameWatch(OtherShape())
    env.reset()
    env.step(np.zeros(2, np.float32))
    with pytest.raises(FrameFaultError, match=r"observation of shape \(3,\), but its space is of shape \(2,\)"):
        env.step(np.zeros(2, np.float32))


def test_watch_changes_nothing() -> None:
    envs = [partial(PixelBox, size=12)(), FrameWatch(PixelBox(size=12))]
    results = [[env.reset(seed=3), *(env.step(np.full(2, 0.3, np.float32)) for _ in range(4))] for env in envs]
    for plain, seen in zip(*results, strict=True):
        np.testing.assert_array_equal(plain[0], seen[0])
        assert plain[1:] == seen[1:]
    envs[1].set_env_attr("size", 5)
    assert envs[1].unwrapped.size == 5 and envs[1].get_wrapper_attr("size") == 5
