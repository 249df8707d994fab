"""Frames that cannot be right are noticed, and those that can be are left alone."""

import itertools
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from dictionaries_for_tests import SensorBox
from envs_for_tests import PixelBox

from sb3_cure.envs import make_dmc_env
from sb3_cure.persistence import ResumableEnv
from sb3_cure.vec_env.frame_watch import EnvFaultError, FrameWatch


class Broken(gym.ObservationWrapper):
    """Its newest frame is black, or stays the same."""

    def __init__(self, env: gym.Env, kind: str) -> None:
        super().__init__(env)
        self.kind, self.frozen = kind, None

    def observation(self, observation: np.ndarray) -> np.ndarray:
        observation = observation.copy()
        stack = np.moveaxis(observation, np.argmin(observation.shape), 0)
        if self.frozen is None and self.kind != "black":
            self.frozen = stack[-3:].copy()
        stack[-3:] = 0 if self.kind == "black" else self.frozen
        return observation


def position(env: gym.Env) -> np.ndarray:
    return env.unwrapped.position


def good_steps(env: gym.Env, speed: float = 0.5, most: int = 30) -> int:
    """Count the steps until an error, -1 if it was in the reset."""
    try:
        n_good = -1
        env.reset(seed=0)
        for n_good in range(most):
            _, _, terminated, truncated, _ = env.step(np.full(2, speed if n_good % 2 else -speed, np.float32))
            if terminated or truncated:
                env.reset()
    except EnvFaultError:
        return n_good
    return most


@pytest.mark.parametrize("channels_last", [False, True])
@pytest.mark.parametrize("episode_length", [2, 20])
def test_black_and_frozen_frames_are_noticed(channels_last: bool, episode_length: int) -> None:
    """Also across short episodes."""
    box = partial(PixelBox, size=12, channels_last=channels_last, episode_length=episode_length)
    assert good_steps(FrameWatch(Broken(box(), "black"))) == -1
    # 20 environment steps are 5 agent steps.
    n_good = good_steps(FrameWatch(Broken(box(), "frozen"), state=position, frozen_steps=20))
    assert n_good == 4 if episode_length == 20 else 2 <= n_good <= 4
    with pytest.raises(EnvFaultError, match="same pixels in 5 steps while its physics moved"):
        env = FrameWatch(Broken(box(), "frozen"), state=position, frozen_steps=20)
        env.reset(seed=0)
        for k in range(9):
            env.step(np.full(2, 0.5 if k % 2 else -0.5, np.float32))


@pytest.mark.parametrize(
    ("kind", "arguments", "speed"),
    [
        ("black", {"allow_black_frames": True}, 0.5),
        ("frozen", {"state": position, "frozen_steps": 8}, 0.0),
        ("frozen", {"state": position, "frozen_steps": 8}, 0.03),
        ("frozen", {"state": position, "frozen_steps": None}, 0.5),
        ("frozen", {"frozen_steps": 8}, 0.5),
        ("frozen", {"state": position, "frozen_steps": 64}, 0.5),
    ],
)
def test_harmless_frames_are_no_fault(kind: str, arguments: dict[str, Any], speed: float) -> None:
    """Dark frames where they are allowed; the same pixels at rest, without a state, or for a short time."""
    assert good_steps(FrameWatch(Broken(PixelBox(size=12), kind), **arguments), speed, most=12) == 12


def test_resumed_watch_goes_on_with_arguments_of_its_own() -> None:
    """What was seen is kept; after the error that asks for more ``frozen_steps`` they can be raised."""

    def watch(frozen_steps: int) -> ResumableEnv:
        env = FrameWatch(Broken(PixelBox(size=12), "frozen"), state=position, frozen_steps=frozen_steps)
        return ResumableEnv(env)

    before = watch(20)
    assert good_steps(before, most=3) == 3
    for frozen_steps, n_good in ((20, 0), (400, 12)):
        resumed = watch(frozen_steps)
        resumed.load_exact_state(before.exact_state())
        assert good_steps(resumed, most=12) == n_good


def test_frozen_pixels_of_dm_control_are_noticed() -> None:
    """It knows the joint positions by itself; of a cartpole that leaves the view, pixels stay the same for a while."""
    env = FrameWatch(Broken(make_dmc_env("ball_in_cup", "catch", image_size=24, renderer="fast"), "frozen"))
    assert good_steps(env, most=60) < 60
    env.close()
    env = FrameWatch(make_dmc_env("cartpole", "swingup", image_size=36, renderer="fast"))
    env.reset(seed=1)
    frames = [env.step(np.ones(1, np.float32))[0][-3:] for _ in range(60)]
    assert sum(np.array_equal(a, b) for a, b in itertools.pairwise(frames)) > 5
    env.close()


class Stuck(gym.Wrapper):
    """One of its cameras shows the same from some step on, or nothing."""

    def __init__(self, env: gym.Env, what: str):
        super().__init__(env)
        self.what, self.n, self.kept = what, 0, np.zeros(0)

    def step(self, action: Any) -> Any:
        seen, *rest = self.env.step(action)
        self.n += 1
        if self.n == 5:
            self.kept = seen["wrist"]
        if self.n > 5 and self.what:
            seen = {**seen, "wrist": self.kept if self.what == "frozen" else self.kept * 0}
        return seen, *rest


@pytest.mark.parametrize(
    "what, step, sentence",
    [("", None, ""), ("black", 6, "returned a black frame"), ("frozen", 13, "same pixels in 8 steps")],
)
def test_frame_watch_looks_at_each_camera(what: str, step: int | None, sentence: str) -> None:
    """One that fails is noticed beside one that works."""
    env: Any = Stuck(SensorBox(episode_length=100), what)
    env = FrameWatch(env, frozen_steps=32, state=lambda env: env.get_wrapper_attr("position"))
    env.reset(seed=0)
    for number in range(1, 20):
        action = np.full(2, 1.0 if number // 4 % 2 else -1.0, np.float32) * (0.9 if number % 2 else 0.4)
        if number == step:
            with pytest.raises(EnvFaultError, match=sentence):
                env.step(action)
            return
        env.step(action)
    assert step is None
