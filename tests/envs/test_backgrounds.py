"""Distractors behind the robot: where they are seen, and that the task goes on as without them."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_cure import make_dmc_env
from sb3_cure.persistence.env_state import load_vec_env_state, vec_env_state

COLOURS = [(255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 0), (0, 255, 255), (255, 0, 255)]


@pytest.fixture
def folder(tmp_path: Path) -> str:
    """Images of one colour each, none of them square, and a file that is no image."""
    for i, colour in enumerate(COLOURS):
        Image.new("RGB", (50, 30 + i), colour).save(tmp_path / f"{i}.png")
    (tmp_path / "about.txt").write_text("colours")
    return str(tmp_path)


def episode(steps: int = 5, domain: str = "reacher", task: str = "easy", seed: int = 1, **kwargs: Any) -> Any:
    """Observations, [steps + 1, 3, 36, 36], and rewards."""
    arguments: dict[str, Any] = {"image_size": 36, "frame_stack": 1, "renderer": "fast", **kwargs}
    env = make_dmc_env(domain, task, **arguments)
    observations, rewards = [env.reset(seed=seed)[0]], []
    for t in range(steps):
        obs, reward, *_ = env.step(np.full(env.action_space.shape, np.sin(t), np.float32))
        observations.append(obs)
        rewards.append(reward)
    env.close()
    return np.array(observations), rewards


@pytest.mark.parametrize("renderer", ["fast", "dmc"])
@pytest.mark.parametrize(("domain", "task"), [("reacher", "easy"), ("cartpole", "swingup")])
def test_robot_and_task_are_as_without(domain: str, task: str, renderer: str, folder: str) -> None:
    plain, rewards = episode(domain=domain, task=task, renderer=renderer)
    seen, same_rewards = episode(domain=domain, task=task, renderer=renderer, background=folder)
    assert same_rewards == rewards
    (colour,) = {tuple(int(c) for c in seen[0][:, 0, 0])} & set(COLOURS)
    behind = (seen == np.array(colour)[:, None, None]).all(axis=1)
    # Sky, floor and walls are most of these pictures, and all that is not of the colour is as it was.
    assert 0.7 < behind.mean() < 0.99
    kept = np.broadcast_to(~behind[:, None], seen.shape)
    np.testing.assert_array_equal(seen[kept], plain[kept])
    corners = seen[:, :, [0, 0, -1, -1], [0, -1, 0, -1]]
    assert (corners == np.array(colour)[:, None]).all()


def test_noise_is_new_in_each_frame_and_drawn_by_the_seed() -> None:
    first, _ = episode(background="noise")
    again, _ = episode(background="noise")
    other, _ = episode(background="noise", seed=2)
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first[0][:, :5, :5], other[0][:, :5, :5])
    corners = first[:, :, :6, :6]
    assert np.abs(corners[1:].astype(int) - corners[:-1]).mean() > 60, "of independent pixels: 85"


def test_cameras_see_noise_of_their_own() -> None:
    """That of the first is the one that it would see alone."""
    alone, _ = episode(steps=0, background="noise")
    env = make_dmc_env(
        "reacher", "easy", cameras=[0, 1], image_size=36, frame_stack=1, renderer="fast", background="noise"
    )
    for _ in range(2):  # also where a seed is given again
        seen: Any = env.reset(seed=1)[0]
        np.testing.assert_array_equal(seen["camera0"], alone[0])
        assert (seen["camera1"] == seen["camera0"]).mean() < 0.1
    env.close()


def test_each_episode_draws_an_image(folder: str) -> None:
    """The first by the seed, those after it go on with its stream."""

    def colours(seed: int) -> list[tuple[int, ...]]:
        env = make_dmc_env("reacher", "easy", image_size=16, background=folder, renderer="fast", frame_stack=1)
        found = [tuple(env.reset(seed=seed if i == 0 else None)[0][:, 0, 0]) for i in range(8)]
        env.close()
        return [tuple(map(int, colour)) for colour in found]

    first = colours(0)
    assert set(first) <= set(COLOURS) and len(set(first)) > 2
    assert colours(0) == first != colours(1)


@pytest.mark.parametrize("kind", ["noise", "images"])
def test_exact_resume(kind: str, folder: str) -> None:
    def made() -> DummyVecEnv:
        background = "noise" if kind == "noise" else folder
        kwargs: dict[str, Any] = dict(image_size=16, background=background, renderer="fast", seed=3)
        return DummyVecEnv([lambda: make_dmc_env("reacher", "easy", **kwargs)])

    first, second = made(), made()
    action = np.zeros((1, 2), np.float32)
    first.reset()
    first.step(action)
    state = vec_env_state(first)
    assert state is not None
    load_vec_env_state(second, state)
    for _ in range(2):
        np.testing.assert_array_equal(first.step(action)[0], second.step(action)[0])
        np.testing.assert_array_equal(first.reset(), second.reset())
    first.close()
    second.close()


@pytest.mark.parametrize("background", ["nois", "/nowhere"])
def test_no_such_background_is_refused(background: str) -> None:
    with pytest.raises(ValueError, match="neither 'noise' nor a folder with images"):
        make_dmc_env("reacher", "easy", background=background)
