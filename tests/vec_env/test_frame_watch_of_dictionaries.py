"""``FrameWatch`` of environments with several cameras."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from dictionaries_for_tests import SensorBox

from sb3_cure.vec_env.frame_watch import FrameFaultError, FrameWatch


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
    "what, step, sentence", [("", None, ""), ("black", 6, "returned a black frame"), ("frozen", 13, "same pixels 8")]
)
def test_frame_watch_looks_at_each_camera(what: str, step: int | None, sentence: str) -> None:
    """One that fails is noticed beside one that works."""
    env: Any = Stuck(SensorBox(episode_length=100), what)
    env = FrameWatch(env, frozen_steps=32, state=lambda env: env.get_wrapper_attr("position"))
    env.reset(seed=0)
    for number in range(1, 20):
        action = np.full(2, 1.0 if number // 4 % 2 else -1.0, np.float32) * (0.9 if number % 2 else 0.4)
        if number == step:
            with pytest.raises(FrameFaultError, match=sentence):
                env.step(action)
            return
        *_, info = env.step(action)
    assert step is None and "frozen_frames" not in info
