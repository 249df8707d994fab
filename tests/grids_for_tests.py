"""What the tests of experiments share: a tiny task under an id, and grids of it."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import yaml
from envs_for_tests import PixelBox

from sb3_cure.evaluation.result_files import read_rows

#: 20 steps per episode, an action repeat of 4
TASK = "grids/PixelBox-v0"
gym.register(TASK, PixelBox)
TINY: dict[str, Any] = dict(
    srl="rae", learning_starts=20, warmup_updates=2, batch_size=8, buffer_size=400, precision="fp32",
    policy_kwargs=dict(net_arch=[16], features_extractor_kwargs=dict(n_filters=4, n_layers=2)),
)  # fmt: skip
DMC_TASK = "dmc_pixels/cartpole-swingup-v0"
#: 25 steps per episode
DMC = {**TINY, "env_kwargs": {"image_size": 36, "renderer": "fast", "grayscale": True, "action_repeat": 40}}


class Shaped(gym.Wrapper[Any, Any, Any, Any]):
    """Rewards of one's own, in the form that most people write."""

    def step(self, action: Any) -> Any:
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, float(reward) + 100, terminated, truncated, info


def write_grid(folder: Path, **changes: Any) -> Path:
    """A grid of one cell on the tiny task, unless ``changes`` say otherwise."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "zoo.yml").write_text(yaml.safe_dump({"default": TINY, DMC_TASK: DMC}))
    content: dict[str, Any] = dict(
        experiment="tiny",
        kind="curves",
        budget=400,
        seeds=1,
        evaluation=dict(every=160, episodes=2),
        tasks=[TASK],
        methods={"cure": {"config": "zoo.yml"}},
    )
    content.update(changes)
    path = folder / "grid.yml"
    path.write_text(
        yaml.safe_dump({key: value for key, value in content.items() if value is not None}, sort_keys=False)
    )
    return path


def method(**overrides: Any) -> dict[str, Any]:
    """An arm of the tiny settings."""
    return {"config": "zoo.yml", "overrides": overrides}


def steps_of(folder: Path) -> list[int]:
    """Environment steps of a cell's evaluations."""
    return [row["environment_steps"] for row in read_rows(folder / "eval.csv")]
