"""What environments return is copied and checked, images are told from vectors, and large images can be resized."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from envs_for_tests import PixelBox, VectorBox, tiny_model
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_cure.envs import (
    CopyObservations,
    NormalizeActions,
    ResizeImages,
    StackFrames,
    check_observation_space,
    make_pixel_env,
)
from sb3_cure.persistence import ResumableEnv


class Returns(gym.Env):
    """Returns one observation for ever.

    :param space: Its space
    :param observation: The observation
    """

    action_space = spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, space: spaces.Space, observation: Any) -> None:
        self.observation_space, self.value = space, observation

    def reset(self, **kwargs: Any) -> Any:
        return self.value, {}

    def step(self, action: Any) -> Any:
        return self.value, 0.0, False, False, {}


def image(*shape: int, low: float = 0, high: float = 255, dtype: Any = np.uint8) -> spaces.Box:
    return spaces.Box(low, high, shape, dtype)


# -------------------------------------------------------------------------------------------------- copies and checks


@pytest.mark.parametrize(
    ("space", "value", "message"),
    [
        (image(3, 8, 8), np.full((3, 8, 8), -0.5), "float64 with numbers such as -0.5, but its space is uint8"),
        (image(3, 8, 8), np.full((3, 8, 8), 0.3, np.float32), "float32 with numbers such as 0.3"),
        (image(3, 8, 8), np.full((3, 8, 8), 300), "int64 with numbers such as 300"),
        (image(3, 8, 8), np.full((3, 8, 8), np.nan), "such as nan"),
        (spaces.Discrete(3), 1.5, "float64 with numbers such as 1.5, but its space is int64"),
        (
            image(3, 8, 8),
            np.zeros((8, 8), np.uint8),
            r"with the shape \(8, 8\), but its space has the shape \(3, 8, 8\)",
        ),
    ],
)
def test_observation_that_would_be_stored_as_another_is_refused(space: Any, value: Any, message: str) -> None:
    """SB3's DummyVecEnv would cast or broadcast it without a word."""
    with pytest.raises(ValueError, match=f"^an observation was returned .*{message}"):
        CopyObservations(Returns(space, value)).reset()
    with pytest.raises(ValueError, match=f"^'front' was returned .*{message}"):
        CopyObservations(Returns(spaces.Dict(front=space), {"front": value})).step(None)


def test_whole_numbers_in_another_type_are_cast() -> None:
    observation, _ = CopyObservations(Returns(image(3, 8, 8), np.full((3, 8, 8), 200.0))).reset()
    assert observation.dtype == np.uint8 and (observation == 200).all()


def test_observations_are_copies_of_the_keys_in_the_space() -> None:
    value = {"front": np.ones((3, 8, 8), np.uint8), "joint": np.ones(1, np.float32), "text": "go left"}
    env = CopyObservations(Returns(spaces.Dict(front=image(3, 8, 8), joint=spaces.Box(-1, 1, (1,))), value))
    observation, *_ = env.step(None)
    value["front"][:], value["joint"][:] = 0, 0
    assert observation.keys() == {"front", "joint"} and observation["front"].all() and observation["joint"].all()


@pytest.mark.parametrize("wrapper", [CopyObservations, ResumableEnv])
def test_attributes_that_are_set_are_the_environments(wrapper: Any) -> None:
    """As with SB3's `set_attr`, which sets attributes of the outermost layer."""
    venv = DummyVecEnv([lambda: wrapper(VectorBox())])
    venv.set_attr("episode_length", 2)
    venv.reset()
    dones = [venv.step(np.zeros((1, 2), np.float32))[2][0] for _ in range(2)]
    assert dones == [False, True] and venv.get_attr("episode_length") == [2]


# ------------------------------------------------------------------------------------------------------------- spaces


@pytest.mark.parametrize(
    ("part", "advice"),
    [
        (spaces.Dict(top=image(48, 48, 3)), "is a Dict, which .* flatten it"),
        (spaces.Tuple([image(48, 48, 3)]), "is a Tuple, which"),
        (spaces.Text(16), "is a Text, .*FilterObservation"),
        (spaces.Box(-1, 1, ()), r"return a number as \[1\]"),
        (spaces.Box(-1, 1, (0,)), "leave out what is empty"),
        (image(84, 84), r"return it as \[H, W, 1\]"),
        (image(1, 84, 84, 3), "StackFrames"),
        (image(84, 84, 3, high=1, dtype=np.float32), r"return it as uint8 from 0 to 255, \[H, W, C\], else flatten it"),
        (image(3, 84, 84, low=-1, high=1, dtype=np.float32), "return it as uint8"),
        (image(3, 8, 8, dtype=np.float64), "float64 of shape .* vector of 192 numbers"),
        (image(64, 64, 1, high=10, dtype=np.float32), "return it as uint8"),  # depth in metres
        (image(64, 64, 1, high=65535, dtype=np.uint16), "return it as uint8"),  # and in millimetres
        (image(64, 48, high=10, dtype=np.float32), r"return it as uint8 from 0 to 255, \[H, W, C\]"),
    ],
)
def test_part_that_would_be_read_otherwise_is_refused(part: spaces.Space, advice: str) -> None:
    with pytest.raises(ValueError, match=rf"the observation 'front' .*{advice}"):
        check_observation_space(spaces.Dict(joints=spaces.Box(-1, 1, (4,)), front=part), "MultiInputPolicy")


@pytest.mark.parametrize(
    "part",
    [
        image(84, 84, 3),
        image(9, 84, 84),
        image(1, 6, 2, low=-1, high=1, dtype=np.float32),  # joints
        image(6, 2),  # a table
        image(7, 7, 3, high=1, dtype=np.float32),  # a grid
        image(7, 7, 3, high=9),
        image(12, 12, low=-np.inf, high=np.inf, dtype=np.float32),  # an inertia matrix
        spaces.Discrete(3),
    ],
)
def test_images_and_vectors_of_any_shape_pass(part: spaces.Space) -> None:
    check_observation_space(spaces.Dict(front=part), "MultiInputPolicy")
    check_observation_space(part, None)
    check_observation_space(part, "MlpPolicy")


@pytest.mark.parametrize(
    ("space", "policy", "advice"),
    [
        (image(84, 84, 3), "MultiInputPolicy", "use 'CnnPolicy'"),
        (image(84, 84), "CnnPolicy", r"return it as \[H, W, 1\]"),
        (image(4, 84, 84, 3), "CnnPolicy", "StackFrames"),
        (spaces.Tuple([image(84, 84, 3)]), None, "is a Tuple, which .* flatten it"),
    ],
)
def test_policy_for_another_space_is_refused(space: spaces.Space, policy: str | None, advice: str) -> None:
    with pytest.raises(ValueError, match=advice):
        check_observation_space(space, policy)


@pytest.mark.parametrize(
    ("policy", "space", "value", "advice"),
    [
        ("MultiInputPolicy", spaces.Dict(front=image(1, 48, 48, 3)), None, "StackFrames"),
        ("MultiInputPolicy", spaces.Dict(pixels=spaces.Dict(top=image(48, 48, 3))), None, "flatten it"),
        ("MultiInputPolicy", image(48, 48, 3), None, "use 'CnnPolicy'"),
        ("CnnPolicy", image(3, 36, 36), np.full((3, 36, 36), -0.5, np.float32), "with numbers such as -0.5"),
    ],
)
def test_model_refuses_what_it_would_see_wrongly(policy: str, space: spaces.Space, value: Any, advice: str) -> None:
    """Spaces before training, numbers at the first reset."""
    with pytest.raises(ValueError, match=advice):
        tiny_model(policy, Returns(space, value)).learn(1)


def test_integer_actions_are_refused() -> None:
    """Replay buffers would store -1, 0 and 1 for them."""
    env = VectorBox()
    env.action_space = spaces.Box(0, 10, (2,), np.int32)
    with pytest.raises(ValueError, match=r"actions are .*int32"):
        tiny_model("MlpPolicy", env)


@pytest.mark.parametrize(
    ("low", "high", "wrapped"),
    [
        (0.5, 0.5, 0.5),
        (-1e10, 1e10, -1),
        (np.finfo(np.float32).min, np.finfo(np.float32).max, -1),
        (-np.inf, np.inf, -1),
    ],
)
def test_actions_that_cannot_be_scaled_are_refused(low: float, high: float, wrapped: float) -> None:
    """A locked joint, which the policy's scaling would divide by zero, and bounds of an actuator that has none."""
    env = Returns(spaces.Box(-1, 1, (2,)), np.zeros(2, np.float32))
    env.action_space = spaces.Box(np.array([-1, low], np.float32), np.array([1, high], np.float32))
    with pytest.raises(ValueError, match="NormalizeActions"):
        tiny_model("MlpPolicy", env)
    tiny_model("MlpPolicy", NormalizeActions(env))
    assert NormalizeActions(env).action(np.array([1, -1], np.float32)).tolist() == [1, wrapped]


# ------------------------------------------------------------------------------------------------------------- resize


@pytest.mark.parametrize("channels", [1, 3, 6])
@pytest.mark.parametrize("channels_last", [False, True])
def test_resized_images_are_means_of_areas(channels: int, channels_last: bool) -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (channels, 48, 64), dtype=np.uint8)
    value = np.moveaxis(pixels, 0, 2) if channels_last else pixels
    env = ResizeImages(Returns(image(*value.shape), value), (12, 16))
    means = pixels.reshape(channels, 12, 4, 16, 4).mean(axis=(2, 4))
    seen, _ = env.reset()
    assert env.observation_space == image(*seen.shape)
    np.testing.assert_allclose(np.moveaxis(seen, 2, 0) if channels_last else seen, means, atol=1)


def camera_and_joints() -> gym.Env:
    parts = dict(front=image(48, 64, 3), wrist=image(3, 48, 48), joints=spaces.Box(-1, 1, (2,)))
    space = spaces.Dict(list(parts.items()))
    space.seed(0)
    return Returns(space, space.sample())


def test_images_of_dictionaries_are_resized_by_key() -> None:
    env = ResizeImages(camera_and_joints(), 16, keys=["front"])
    shapes = {key: part.shape for key, part in env.observation_space.items()}
    assert shapes == {"front": (16, 16, 3), "wrist": (3, 48, 48), "joints": (2,)}
    assert env.reset()[0] in env.observation_space
    for keys in (["joints"], ["left"]):
        with pytest.raises(ValueError, match="ResizeImages found no images"):
            ResizeImages(camera_and_joints(), 16, keys=keys)
    with pytest.raises(ValueError, match="ResizeImages found no images"):
        ResizeImages(VectorBox(), 16)
    nested = Returns(spaces.Dict(pixels=spaces.Dict(top=image(48, 64, 3))), None)
    with pytest.raises(ValueError, match=r"'pixels' is a Dict, which .* flatten it"):
        ResizeImages(nested, 16)


def test_height_and_width_may_be_a_list() -> None:
    """As YAML and an environment's JSON have it; one number may be NumPy's."""
    for size, shape in (([12, 16], (12, 16, 3)), (np.int64(12), (12, 12, 3))):
        env = ResizeImages(camera_and_joints(), size, keys=["front"])  # type: ignore[arg-type]
        assert env.observation_space["front"].shape == shape


def test_own_images_are_resized_and_stacked() -> None:
    env = make_pixel_env(camera_and_joints(), source="observation", image_size=16, frame_stack=2)
    assert env.observation_space["front"].shape == (16, 16, 6) and env.observation_space["wrist"].shape == (6, 16, 16)
    assert env.reset()[0] in env.observation_space and env.step(env.action_space.sample())[0] in env.observation_space
    alone = make_pixel_env(PixelBox(frame_stack=1), source="observation", image_size=12)
    assert alone.reset()[0].shape == (9, 12, 12) and alone.get_wrapper_attr("image_size") == 12
    with pytest.raises(ValueError, match="source must be 'render', or 'observation', which takes neither"):
        make_pixel_env(camera_and_joints(), source="observation", grayscale=True)


def test_images_of_a_dictionary_are_stacked() -> None:
    """The rest stays as it is, as a copy."""
    env = StackFrames(camera_and_joints(), 2)
    (first, _), (second, *_) = env.reset(), env.step(None)
    assert first["front"].shape == (48, 64, 6) and (first["front"] == second["front"]).all()
    assert env.observation_space["joints"] == spaces.Box(-1, 1, (2,)) and first in env.observation_space
    assert np.array_equal(first["joints"], second["joints"]) and not np.shares_memory(first["joints"], second["joints"])
    with pytest.raises(ValueError, match="cannot be stacked: expected a Box"):
        StackFrames(gym.wrappers.FilterObservation(camera_and_joints(), ["joints"]), 2)
