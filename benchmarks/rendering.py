"""Milliseconds per frame of the software (or GPU) renderer, by setting."""

from collections.abc import Callable
from typing import Any

from benchmarks.harness import interleaved, make_env, summary


def _step_call(image_size: int, renderer: str, task: tuple[str, str]) -> Callable[[], object]:
    from sb3_cure import make_dmc_env

    env = make_dmc_env(*task, image_size=image_size, renderer=renderer, action_repeat=1, seed=0)
    env.reset()
    action = env.action_space.sample()

    def step() -> None:
        _, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            env.reset()

    return step


def measure(repeats: int = 7) -> dict[str, Any]:
    """
    :param repeats: Rounds
    :return: Time of one environment step of action repeat 1, which renders one frame, by setting
    """
    make_env().close()
    variants = {
        f"{domain}-{task}, {size} px, {renderer}": _step_call(size, renderer, (domain, task))
        for domain, task in (("cartpole", "swingup"), ("cheetah", "run"))
        for size in (36, 84, 100)
        for renderer in ("dmc", "fast")
    }
    return {name: summary(values) for name, values in interleaved(variants, repeats, calls=20).items()}
