"""Milliseconds per frame of the software (or GPU) renderer, by setting."""

from collections.abc import Callable
from contextlib import ExitStack, closing
from typing import Any

import gymnasium as gym

from benchmarks.harness import interleaved, make_env, summary
from sb3_cure.envs import make_dmc_env, make_pixel_env


def _step_call(env: gym.Env) -> Callable[[], object]:
    env.reset(seed=0)
    action = env.action_space.sample()

    def step() -> None:
        _, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            env.reset()

    return step


def measure(repeats: int = 7) -> dict[str, Any]:
    """Time environment steps that render one frame.

    :param repeats: Rounds
    :return: Time of one environment step of action repeat 1, which renders one frame, by setting
    """
    make_env().close()
    envs = {
        f"{domain}-{task}, {size} px, {renderer}": make_dmc_env(
            domain, task, image_size=size, renderer=renderer, action_repeat=1
        )
        for domain, task in (("cartpole", "swingup"), ("cheetah", "run"))
        for size in (36, 84, 100)
        for renderer in ("dmc", "fast")
    }
    envs |= {
        f"{id} of Gymnasium, {size} px, {renderer}": make_pixel_env(id, image_size=size, renderer=renderer)
        for id in ("HalfCheetah-v5", "Ant-v5")
        for size in (48, 84)
        for renderer in ("env", "fast")
    }
    with ExitStack() as stack:  # at the exit of the process MuJoCo would end EGL before dm_control frees its contexts
        variants = {name: _step_call(stack.enter_context(closing(env))) for name, env in envs.items()}
        return {name: summary(values) for name, values in interleaved(variants, repeats, calls=20).items()}
