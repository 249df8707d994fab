"""The environments: what the agent sees, gets and may do, compared with dm_control itself."""

import copy
import gc
import os
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, ClassVar
from unittest import mock

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils import env_checker as gym_checker
from stable_baselines3.common.env_checker import check_env as sb3_check_env
from stable_baselines3.common.envs import FakeImageEnv
from stable_baselines3.common.preprocessing import is_image_space_channels_first
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack

from sb3_cure.envs import (
    DMC_TASKS,
    NormalizeActions,
    PixelObservation,
    StackFrames,
    make_dmc_env,
    make_pixel_env,
    physics_state,
    physics_state_names,
    physics_state_units,
    register_dmc_envs,
)
from sb3_cure.envs.physics import map_coordinates
from sb3_cure.envs.rendering import GLUnavailableError, check_gl, load_gl
from sb3_cure.envs.wrappers import ActionRepeat, action_repeat_of
from sb3_cure.vec_env import FaultTolerantSubprocVecEnv

load_gl()  # before any test imports dm_control

# Tasks of one domain differ in rewards and starts; cartpole-three_poles and lqr_6_2 build their models otherwise.
IDS = [f"dmc_pixels/{domain}-{tasks[-1]}-v0" for domain, tasks in DMC_TASKS.items()]


@pytest.fixture
def make() -> Iterator[Callable[..., gym.Env]]:
    """Makes small environments quickly and closes them after the test."""
    envs = []

    def make_and_remember(domain: str = "cartpole", task: str = "swingup", **kwargs: Any) -> gym.Env:
        envs.append(make_dmc_env(domain, task, **{"image_size": 36, "renderer": "fast", **kwargs}))
        return envs[-1]

    yield make_and_remember
    for env in envs:
        env.close()


class Painting(gym.Env):
    """Renders its step count as a grey level, white on its right half; an episode has 10 steps, each with reward 1."""

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array", "ansi"], "render_fps": 30}
    observation_space = spaces.Box(-1, 1, (2,))

    def __init__(self, render_mode: str | None = "rgb_array", action_space: spaces.Space | None = None) -> None:
        self.render_mode = render_mode
        self.action_space = action_space or spaces.Discrete(2)
        self.canvas = np.zeros((80, 120, 3), np.uint8)
        self.renders = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.count = 0
        return np.zeros(2, np.float32), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.action = action
        self.count += 1
        return np.zeros(2, np.float32), 1.0, self.count == 10, False, {}

    def render(self) -> Any:
        self.renders += 1
        if self.render_mode != "rgb_array":
            return f"step {self.count}"
        self.canvas[:] = self.count  # the same memory each time, as renderers may do
        self.canvas[:, 60:] = 255
        return self.canvas


# ---------------------------------------------------------------------------------- against dm_control itself


@pytest.mark.parametrize(
    ("domain", "task", "action_repeat", "camera_id"),
    [("cartpole", "swingup", 8, 0), ("walker", "walk", 2, 0), ("quadruped", "escape", 4, 2)],
)
def test_frames_and_rewards_are_those_of_dm_control(make, domain, task, action_repeat, camera_id):
    from dm_control import suite

    env = make(domain, task, image_size=84, renderer="dmc", seed=5)
    assert env.get_wrapper_attr("action_repeat") == action_repeat
    reference = suite.load(domain, task, task_kwargs={"random": 5})
    reference.reset()

    def reference_frame() -> np.ndarray:
        return reference.physics.render(height=84, width=84, camera_id=camera_id).transpose(2, 0, 1)

    obs, _ = env.reset()
    assert obs.dtype == np.uint8
    frames = [reference_frame()] * 3
    np.testing.assert_array_equal(obs, np.concatenate(frames))  # the first frame, three times
    bounds = reference.action_spec()
    env.action_space.seed(0)
    for _ in range(5):
        action = env.action_space.sample()
        scaled = bounds.minimum + (action.astype(np.float64) + 1) / 2 * (bounds.maximum - bounds.minimum)
        expected_reward = sum(reference.step(scaled).reward for _ in range(action_repeat))
        obs, reward, terminated, truncated, _ = env.step(action)
        frames.append(reference_frame())
        np.testing.assert_array_equal(obs, np.concatenate(frames[-3:]))  # oldest first
        assert reward == pytest.approx(expected_reward, rel=1e-9)
        assert not terminated and not truncated
    assert len({frame.tobytes() for frame in frames}) == 6, "the scene did not move, so this test saw nothing"
    reference.physics.free()


@pytest.mark.parametrize(
    ("domain", "task", "action_repeat", "agent_steps"),
    [("cartpole", "swingup", None, 125), ("reacher", "easy", 3, 334), ("lqr", "lqr_2_1", None, 250)],
)
def test_time_limit_truncates_after_1000_environment_steps(make, domain, task, action_repeat, agent_steps):
    env = make(domain, task, action_repeat=action_repeat)
    env.reset(seed=0)
    ends = [env.step(env.action_space.sample())[2:4] for _ in range(agent_steps)]
    assert not any(terminated for terminated, _ in ends)
    assert [truncated for _, truncated in ends] == [False] * (agent_steps - 1) + [True]


def test_one_frame_is_rendered_per_agent_step(make):
    from dm_control.mujoco import Camera

    env = make(action_repeat=4, frame_stack=2)
    with mock.patch.object(Camera, "render", autospec=True, side_effect=Camera.render) as render:
        env.reset()
        assert render.call_count == 1
        for _ in range(3):
            env.step(env.action_space.sample())
        assert render.call_count == 4


# ---------------------------------------------------------------------------------------------------- seeding


def test_constructor_and_reset_seed_alike(make):
    constructed, reseeded = make("reacher", "easy", seed=7), make("reacher", "easy", seed=0)
    first = constructed.reset()[0]
    np.testing.assert_array_equal(first, reseeded.reset(seed=7)[0])
    action = np.array([0.5, -0.5], np.float32)
    np.testing.assert_array_equal(constructed.step(action)[0], reseeded.step(action)[0])
    second = constructed.reset()[0]
    np.testing.assert_array_equal(second, reseeded.reset()[0])
    assert (first != second).any()
    np.testing.assert_array_equal(first, constructed.reset(seed=7)[0])


def test_unseeded_episodes_differ_in_same_physics(make):
    first, second = make("lqr", "lqr_2_1"), make("lqr", "lqr_2_1")
    first.reset()
    second.reset()
    assert (first.unwrapped.physics.position() != second.unwrapped.physics.position()).any()
    np.testing.assert_array_equal(
        first.unwrapped.physics.model.jnt_stiffness, second.unwrapped.physics.model.jnt_stiffness
    )


# ---------------------------------------------------------------------------------- renderers, videos, closing


def test_fast_renderer_differs_only_in_pixels(make):
    envs = {renderer: make("cheetah", "run", renderer=renderer, seed=1) for renderer in ("dmc", "fast")}
    obs = {renderer: env.reset()[0] for renderer, env in envs.items()}
    assert [env.get_wrapper_attr("renderer") for env in envs.values()] == ["dmc", "fast"]
    assert obs["dmc"].shape == obs["fast"].shape
    assert (obs["dmc"] != obs["fast"]).any()
    physics = envs["fast"].unwrapped.physics
    flat = physics.render(36, 36, camera_id=0, render_flag_overrides={"shadow": False, "reflection": False})
    assert (flat != physics.render(36, 36, camera_id=0)).any()
    np.testing.assert_array_equal(obs["fast"][:3], flat.transpose(2, 0, 1))
    # Without multisampling a thin pole in a small image moves by whole pixels.
    assert physics.model.vis.quality.offsamples == 4
    np.testing.assert_array_equal(envs["dmc"].unwrapped.physics.get_state(), envs["fast"].unwrapped.physics.get_state())


def test_rendering_for_videos_does_not_change_observations(make):
    filmed, plain = make(render_mode="rgb_array", seed=3), make(seed=3)
    np.testing.assert_array_equal(filmed.reset()[0], plain.reset()[0])
    for action in np.linspace(-1, 1, 4, dtype=np.float32):
        video = filmed.render()
        assert video.shape == (256, 256, 3) and video.dtype == np.uint8 and video.std() > 0
        np.testing.assert_array_equal(filmed.step(action[None])[0], plain.step(action[None])[0])
    assert filmed.render_mode == "rgb_array" and filmed.metadata["render_modes"] == ["rgb_array"]
    assert filmed.metadata["render_fps"] == pytest.approx(12.5)  # 0.01 s of physics, 8 times per agent step
    assert plain.render_mode is None and plain.render() is None


def test_several_sizes_and_cameras_live_in_one_process(make):
    large = make(image_size=700, frame_stack=1, camera_id=1)  # larger than MuJoCo's default frame buffer
    grey = make(grayscale=True, frame_stack=2)
    large_obs, grey_obs = large.reset(seed=0)[0], grey.reset(seed=0)[0]
    assert large_obs.shape == (3, 700, 700) and large_obs.std() > 0
    assert grey_obs.shape == (2, 36, 36)
    rgb = make(frame_stack=1).reset(seed=0)[0]
    np.testing.assert_allclose(grey_obs[0], np.tensordot([0.299, 0.587, 0.114], rgb, 1), atol=1)
    np.testing.assert_array_equal(large_obs, large.reset(seed=0)[0])


def test_closing_frees_the_renderer(make):
    env = make()
    env.reset()
    physics = env.unwrapped.physics
    assert physics._contexts is not None
    env.close()
    assert physics._contexts is None
    env.close()


# ------------------------------------------------------------------------------- Gymnasium, Stable-Baselines3


def test_every_task_of_the_suite_is_registered():
    from dm_control import suite

    expected = {f"dmc_pixels/{domain}-{task}-v0" for domain, task in suite.ALL_TASKS}
    assert {env_id for env_id in gym.registry if env_id.startswith("dmc_pixels/")} == expected
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        register_dmc_envs()


@pytest.mark.parametrize("env_id", IDS)
def test_ids_make_environments_that_step_and_repeat(env_id):
    env = gym.make(env_id, image_size=36)
    obs, _ = env.reset(seed=0)
    next_obs, reward, terminated, truncated, _ = env.step(np.zeros(env.action_space.shape, np.float32))
    assert next_obs in env.observation_space and np.isfinite(reward) and not terminated and not truncated
    np.testing.assert_array_equal(env.reset(seed=0)[0], obs)
    assert type(env.unwrapped).__name__ == "DmControlCompatibilityV0"
    env.close()


@pytest.mark.parametrize("through_gymnasium", [False, True])
def test_environment_checkers_find_nothing(through_gymnasium):
    kwargs = {"image_size": 36, "renderer": "fast", "render_mode": "rgb_array"}
    env = (
        gym.make("dmc_pixels/finger-spin-v0", **kwargs)
        if through_gymnasium
        else make_dmc_env("finger", "spin", **kwargs)
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*is different from the unwrapped version.*")
        gym_checker.check_env(env)
        sb3_check_env(env)
    env.close()


def test_environment_that_rendered_can_be_copied(make):
    """For planning, say: both go on alike, each with a camera of its own."""
    env = make()
    env.reset(seed=1)
    env.step(env.action_space.sample())
    twin = copy.deepcopy(env)
    action = env.action_space.sample()
    for ours, theirs in zip(env.step(action)[:2], twin.step(action)[:2], strict=True):
        np.testing.assert_array_equal(ours, theirs)
    twin.close()
    assert env.step(action)[0].any()


# --------------------------------------------------------------------------------- any Gymnasium environment


def test_repeats_of_the_environment_are_counted():
    """An environment that tells its own repeat, inside another one."""
    painting = Painting()
    painting.action_repeat = 4
    assert make_pixel_env(painting, image_size=40).get_wrapper_attr("action_repeat") == 4
    twice = make_pixel_env(painting, image_size=40, action_repeat=2)
    assert twice.get_wrapper_attr("action_repeat") == 8
    assert twice.metadata["render_fps"] == 15


def test_repeats_of_gymnasiums_wrapper_are_counted():
    """Inside ours, outside of it, and around an environment with a repeat of its own."""
    inside = ActionRepeat(gym.wrappers.RepeatAction(Painting(), 4), 2)
    assert (inside.action_repeat, action_repeat_of(inside)) == (8, 8)
    assert action_repeat_of(gym.wrappers.RepeatAction(inside, 3)) == 24
    assert action_repeat_of(gym.wrappers.TimeLimit(gym.wrappers.RepeatAction(Painting(), 4), 10)) == 4


def test_rendered_environment_is_seen_through_pixels():
    painting = Painting(action_space=spaces.Box(np.float32([0, -2]), np.float32([10, 2])))
    env = make_pixel_env(painting, image_size=40, frame_stack=3, action_repeat=4)
    assert env.observation_space == spaces.Box(0, 255, (9, 40, 40), np.uint8)
    assert [env.get_wrapper_attr(name) for name in ("image_size", "frame_stack", "action_repeat")] == [40, 3, 4]
    obs, _ = env.reset()
    assert (obs[:, :, :20] == 0).all() and (obs[:, :, 20:] == 255).all()
    steps = [env.step(np.array([1, -1], np.float32)) for _ in range(3)]
    np.testing.assert_array_equal(painting.action, [10, -2])
    assert [step[1] for step in steps] == [4, 4, 2]  # the repeat stops with the episode
    assert [step[2] for step in steps] == [False, False, True]
    assert steps[1][0][::3, 0, 0].tolist() == [0, 4, 8] and steps[2][0][::3, 0, 0].tolist() == [4, 8, 10]
    assert painting.renders == 4
    assert env.metadata["render_fps"] == 7.5
    assert env.reset()[0].max(axis=(1, 2)).tolist() == [255] * 9 and env.reset()[0][:, 0, 0].tolist() == [0] * 9
    sb3_check_env(env)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_actions_lie_in_the_environments_space(dtype):
    """Many environments assert it: the dtype, and bounds that a rounding error would cross or that are one alone."""
    low, high = np.array([-0.1, 0, 2, -np.inf, -np.inf], dtype), np.array([0.7, np.inf, np.inf, 3, np.inf], dtype)
    painting = Painting(action_space=spaces.Box(low, high, dtype=dtype))
    env = make_pixel_env(painting, image_size=10, frame_stack=1)
    env.reset()
    for value, expected in ((-2, [-0.1, 0, 2, 1, -1]), (0, [0.3, 1, 3, 2, 0]), (1, [0.7, 2, 4, 3, 1])):
        env.step(np.full(5, value, np.float32))
        assert painting.action_space.contains(painting.action)
        np.testing.assert_allclose(painting.action, np.array(expected), atol=1e-7)


def test_channels_last_images_are_stacked():
    """As SB3's VecFrameStack does."""
    env = StackFrames(gym.wrappers.AddRenderObservation(Painting()), 3)
    height, width, _ = Painting().canvas.shape
    assert env.observation_space.shape == (height, width, 9)
    venv = VecFrameStack(DummyVecEnv([lambda: gym.wrappers.AddRenderObservation(Painting())]), 3)
    venv.reset(), env.reset()
    for _ in range(3):
        ours, theirs = env.step(1)[0], venv.step([1])[0][0]
    np.testing.assert_array_equal(ours, theirs)


def test_frames_of_another_size_are_area_averaged():
    env = make_pixel_env(Painting(), image_size=10, frame_stack=1, grayscale=True)
    assert env.action_space == spaces.Discrete(2)
    assert env.reset()[0].shape == (1, 10, 10)
    # 120 pixels become 3, so the middle one is half black and half white.
    assert PixelObservation(Painting(), 3).reset()[0][:, 0].tolist() == [[0, 128, 255]] * 3


def test_gymnasium_is_drawn_fast():
    """The same steps, seen in the same way but for shadows, which lie beside the robot here; few pixels are drawn."""
    frames = {}
    for renderer in ("env", "fast"):
        env = make_pixel_env("InvertedPendulum-v5", image_size=36, frame_stack=1, renderer=renderer)
        first, _ = env.reset(seed=0)
        steps = [env.step(np.array([action], dtype=np.float32)) for action in (1, 1, 1, -1, -1)]
        frames[renderer] = np.array([first, *(step[0] for step in steps[1:])], dtype=float)
        assert env.render().shape == {"env": (480, 480, 3), "fast": (72, 72, 3)}[renderer]
        env.close()
    between = np.abs(frames["fast"] - frames["env"]).mean(axis=(1, 2, 3))
    since_the_first = np.abs(frames["env"][1:] - frames["env"][0]).mean(axis=(1, 2, 3))
    assert between.max() < since_the_first.min() / 2


def step_of(env):
    env.reset(seed=0)
    return env.step(np.full(env.action_space.shape, 0.5, np.float32))[0]


def test_environments_are_drawn_as_if_each_were_alone(make):
    """MuJoCo draws in whichever OpenGL context is current, which Gymnasium and dm_control leave to chance."""
    makers = [partial(make, "cheetah", "run")]
    makers += [partial(make_pixel_env, name, image_size=36) for name in ("HalfCheetah-v5", "InvertedPendulum-v5")]
    makers += [partial(makers[1], renderer="fast")]
    envs, alone = [], []
    for maker in makers:
        envs.append(maker())
        alone.append(step_of(envs[-1]))
        np.testing.assert_array_equal(step_of(envs[0]), alone[0])  # after the first frame of another one
    for env, expected in zip(envs, alone, strict=True):
        np.testing.assert_array_equal(step_of(env), expected)


@pytest.mark.parametrize("ends", ["closed", "dropped", "dropped while another one draws"])
def test_end_of_one_environment_leaves_the_others_their_pictures(ends):
    """MuJoCo frees textures and meshes by number, in whichever OpenGL context is current."""
    other, env = (make_pixel_env("HalfCheetah-v5", image_size=36, renderer="fast") for _ in range(2))
    step_of(other)
    expected = step_of(env)
    if ends == "closed":
        other.close()
    if ends == "dropped while another one draws":
        frame, held = env.unwrapped.mujoco_renderer.render, [other]

        def render(mode):
            held.clear()
            gc.collect()
            return frame(mode)

        env.unwrapped.mujoco_renderer.render = render
    del other
    gc.collect()
    for _ in range(2):
        np.testing.assert_array_equal(step_of(env), expected)


def test_drawn_environment_can_be_copied_and_drawn_after_it_was_closed():
    env = make_pixel_env("InvertedPendulum-v5", image_size=36, renderer="fast")
    expected = step_of(env)
    assert copy.deepcopy(env).observation_space == env.observation_space
    env.close()
    np.testing.assert_array_equal(step_of(env), expected)


def test_mazes_are_drawn_fast():
    """Those of Gymnasium-Robotics have the environment that draws inside."""

    class Maze(gym.Wrapper):
        @property
        def unwrapped(self):
            return self

        @property
        def point_env(self):
            return self.env

    env = make_pixel_env(Maze(gym.make("InvertedPendulum-v5", render_mode="rgb_array")), image_size=36, renderer="fast")
    env.reset(seed=0)
    assert env.render().shape == (72, 72, 3)


def test_renderer_is_fast_after_a_frame_of_the_environment():
    """A user may look at a frame before wrapping."""
    env = gym.make("InvertedPendulum-v5", render_mode="rgb_array")
    env.reset(seed=0)
    assert env.render().shape == (480, 480, 3)
    env = make_pixel_env(env, image_size=36, renderer="fast")
    env.reset(seed=0)
    assert env.render().shape == (72, 72, 3)
    env.close()


@pytest.mark.parametrize(
    ("environment", "chosen"),
    [({}, "egl"), ({"DISPLAY": ":0"}, None), ({"WAYLAND_DISPLAY": "wayland-0"}, None), ({"MUJOCO_GL": "glfw"}, "glfw")],
)
def test_egl_is_chosen_only_without_display(environment, chosen):
    with (
        mock.patch.dict(os.environ, environment, clear=True),
        mock.patch.object(sys, "platform", "linux"),
        mock.patch("glfw.init", return_value=1),
    ):
        load_gl()
        assert os.environ.get("MUJOCO_GL") == chosen


@pytest.mark.parametrize(
    ("domain", "task", "telling"),
    [
        ("cartpole", "swingup", ("hinge_1", "hinge_1_velocity")),
        ("finger", "spin", ("proximal", "hinge_velocity")),
        ("reacher", "easy", ("shoulder", "wrist")),
        ("ball_in_cup", "catch", ("ball_x", "ball_z")),
        ("quadruped", "walk", ("root_x", "root_y")),
    ],
)
def test_true_state_is_that_of_the_physics_by_name(
    make: Callable[..., gym.Env], domain: str, task: str, telling: tuple[str, str]
) -> None:
    """Positions and velocities as dm_control names them, through wrappers, as a copy; two of them for maps."""
    env = gym.wrappers.RecordEpisodeStatistics(make(domain, task))
    env.reset(seed=0)
    for _ in range(3):
        env.step(np.ones(env.action_space.shape, np.float32))
    names, units, state = physics_state_names(env), physics_state_units(env), physics_state(env)
    assert len(names) == len(set(names)) == len(units) == len(state)
    named = env.get_wrapper_attr("physics").named.data
    for name, unit, value in zip(names, units, state, strict=True):
        joint = name.removesuffix("_velocity")
        table = named.qvel if name.endswith("_velocity") else named.qpos
        if domain == "quadruped" and joint.startswith("root_"):
            free = ["x", "y", "z", "rx", "ry", "rz"] if joint != name else ["x", "y", "z", "qw", "qx", "qy", "qz"]
            assert value == table["root"][free.index(joint.removeprefix("root_"))]
        else:
            assert np.isclose(np.sin(value), np.sin(table[joint].item()))
            assert unit in (("m/s", "rad/s") if joint != name else ("m", "rad"))
    assert map_coordinates(names) == telling
    before = state.copy()
    env.step(-np.ones(env.action_space.shape, np.float32))
    np.testing.assert_array_equal(state, before)
    assert not np.array_equal(physics_state(env), before)


def test_angles_without_limits_are_wrapped(make: Callable[..., gym.Env]) -> None:
    """To (-pi, pi], whatever their turns; places and velocities are left as they are."""
    env = make("cartpole", "swingup")
    env.reset(seed=0)
    data = env.get_wrapper_attr("physics").data
    for turns in (-3, -1, 0, 1, 20):
        for angle in (-3.1, -0.5, 0.0, 0.5, np.pi):
            data.qpos[:] = 9.5, angle + 2 * np.pi * turns
            data.qvel[:] = 40.0, -40.0
            np.testing.assert_allclose(physics_state(env), [9.5, angle, 40.0, -40.0], atol=1e-12)


def test_true_state_of_other_environments_is_refused() -> None:
    """One sentence that says what to do."""
    for function in (physics_state, physics_state_names, physics_state_units):
        with pytest.raises(ValueError, match=r"Pendulum-v1.* has no physics of dm_control.*make_dmc_env, or give"):
            function(gym.make("Pendulum-v1"))


def test_gymnasium_make_passes_every_argument_on():
    kwargs = dict(image_size=40, frame_stack=2, action_repeat=3, camera_id=1, renderer="fast", render_mode="rgb_array")
    direct = make_dmc_env("fish", "swim", seed=4, **kwargs)
    first = direct.reset()[0]
    assert direct.spec.id == "dmc_pixels/fish-swim-v0" and first.shape == (6, 40, 40)
    for env in (gym.make("dmc_pixels/fish-swim-v0", seed=4, **kwargs), direct.spec.make()):
        np.testing.assert_array_equal(env.reset()[0], first)
        for name in set(kwargs) - {"camera_id"}:
            assert env.get_wrapper_attr(name) == kwargs[name]
        env.close()


def test_workers_give_the_same_stream():
    """Started as by default, which is not by fork."""
    factories = [
        partial(make_dmc_env, "point_mass", "easy", image_size=36, renderer="fast", seed=seed) for seed in (1, 2)
    ]
    local, remote = DummyVecEnv(factories), FaultTolerantSubprocVecEnv(factories)
    try:
        first = local.reset()
        assert (first[0] != first[1]).any()
        np.testing.assert_array_equal(first, remote.reset())
        for _ in range(3):
            actions = np.stack([local.action_space.sample() for _ in factories])
            (obs, rewards, *_), (remote_obs, remote_rewards, *_) = (each.step(actions) for each in (local, remote))
            np.testing.assert_array_equal(obs, remote_obs)
            np.testing.assert_array_equal(rewards, remote_rewards.astype(np.float32))  # only DummyVecEnv rounds them
    finally:
        local.close()
        remote.close()


# -------------------------------------------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"image_size": 84.0}, "image_size must be an integer of at least 1, not 84.0"),
        ({"frame_stack": True}, "frame_stack must be an integer"),
        ({"action_repeat": 0}, "action_repeat must be an integer"),
        ({"image_size": 8}, "9 channels in all, .* larger images"),
        ({"renderer": "slow"}, "renderer must be 'dmc', or 'fast'"),
        ({"render_mode": "human"}, "render_mode must be 'rgb_array'"),
    ],
)
def test_bad_arguments_of_tasks_are_refused(kwargs, message):
    with pytest.raises(ValueError, match=message):
        make_dmc_env(**{"domain": "cartpole", "task": "swingup", **kwargs})


@pytest.mark.parametrize(("size", "channel_first"), [(36, True), (37, False)])
def test_many_frames_are_stacked_if_sb3_finds_the_channels(size, channel_first):
    """Of equal dimensions SB3 takes the first, so 36 channels that come last need larger images."""

    def stack(size):
        sides = dict(screen_height=size, screen_width=size, n_channels=3)
        return StackFrames(FakeImageEnv(**sides, channel_first=channel_first, discrete=False), 12)

    assert is_image_space_channels_first(stack(size).observation_space) == channel_first
    with pytest.raises(ValueError, match="36 channels in all"):
        stack(size - 1)


class WithAlpha(Painting):
    """As some environments of PyBullet render."""

    def render(self):
        return np.concatenate([super().render(), np.full((80, 120, 1), 99, np.uint8)], axis=2)


@pytest.mark.parametrize("grayscale", [False, True])
def test_alpha_channel_of_frames_is_left_out(grayscale):
    seen, expected = (make_pixel_env(env(), grayscale=grayscale) for env in (WithAlpha, Painting))
    assert np.array_equal(seen.reset()[0], expected.reset()[0])
    assert np.array_equal(seen.step(1)[0], expected.step(1)[0])


class Unfinished(Painting):
    def render(self):
        return np.zeros((4, 4, 3))


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: make_pixel_env(Painting(render_mode="ansi")).reset(), "'ansi' rendered a str.*'rgb_array'"),
        (lambda: make_pixel_env(Unfinished()).reset(), r"rendered float64 \(4, 4, 3\)"),
        (lambda: make_pixel_env(Painting(), renderer="fast"), "Gymnasium's MuJoCo environments.*use 'env'"),
        (lambda: make_pixel_env(Painting(), renderer="quick"), "renderer must be 'env' or 'fast'"),
        (lambda: NormalizeActions(Painting()), "Discrete"),
    ],
)
def test_environments_that_cannot_be_wrapped_are_refused(build, message):
    with pytest.raises(ValueError, match=message):
        build()


# ----------------------------------------------------------------------------------------------------- OpenGL


def run_python(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    hidden = ("MUJOCO_GL", "PYOPENGL_PLATFORM", "DISPLAY", "WAYLAND_DISPLAY")
    env = {name: value for name, value in os.environ.items() if name not in hidden} | environment
    env["PYTHONPATH"] = os.pathsep.join(sys.path)
    return subprocess.run([sys.executable, *arguments], env=env, capture_output=True, text=True, timeout=120)


def test_importing_needs_neither_gl_nor_dm_control():
    result = run_python(
        "-c",
        "import sys, sb3_cure.envs, gymnasium\n"
        "assert 'dmc_pixels/cartpole-swingup-v0' in gymnasium.registry\n"
        "print([name for name in ('dm_control', 'mujoco', 'OpenGL', 'shimmy') if name in sys.modules])",
    )
    assert result.stdout.strip() == "[]", result.stderr


def test_triton_is_loaded_before_opengl(tmp_path):
    """triton 3.7.0, 3.7.1 and 3.8.0, 700 to 900 MB and part of torch's CUDA builds, crash if they come after Mesa."""
    (tmp_path / "triton.py").touch()
    result = run_python(
        "-c",
        f"import sys; sys.path.insert(0, {str(tmp_path)!r})\n"
        "import sb3_cure.envs\n"
        "print([name for name in ('triton', 'OpenGL') if name in sys.modules])",
    )
    assert result.stdout.strip() == "['triton']", result.stderr


@pytest.mark.parametrize("missing", ["libEGL", "lib(OpenGL|GL|GLESv2|GLESv1_CM)[.]"])
def test_missing_gl_is_one_sentence(missing):
    result = run_python(
        "-c",
        f"""
import ctypes, re, runpy
load = ctypes.CDLL.__init__

def refuse(self, name, *args, **kwargs):
    if name and re.search({missing!r}, str(name)):
        raise OSError(f"{{name}}: cannot open shared object file: No such file or directory")
    load(self, name, *args, **kwargs)

ctypes.CDLL.__init__ = refuse
runpy.run_module("sb3_cure.envs", run_name="__main__")
""",
    )
    assert result.returncode == 1 and result.stderr.count("\n") == 1
    assert "MUJOCO_GL=egl: " in result.stderr and "apt-get install libegl1 libopengl0 libgl1-mesa-dri" in result.stderr


def test_working_gl_names_its_renderer_without_a_warning():
    result = run_python("-m", "sb3_cure.envs")
    assert result.returncode == 0 and result.stdout.strip() == check_gl() and "Warning" not in result.stderr


def test_display_that_cannot_be_opened_is_none():
    """As that of an ssh connection that has ended: frames are drawn, without a word about displays."""
    code = (
        "from sb3_cure.envs import make_dmc_env, make_pixel_env\n"
        "print(make_pixel_env('InvertedPendulum-v5').reset()[0].std())\n"
        "print(make_dmc_env('cartpole', 'swingup').reset()[0].std())"
    )
    result = run_python("-c", code, DISPLAY=":77")
    assert result.returncode == 0 and all(float(each) > 1 for each in result.stdout.split()), result.stderr
    assert "isplay" not in result.stderr


@pytest.mark.parametrize(("backend", "fix"), [("off", "apt-get install"), (None, "apt-get"), ("glfw", "MUJOCO_GL=egl")])
def test_backend_that_cannot_render_is_refused(backend, fix):
    with (
        mock.patch.dict(os.environ, clear=True),
        mock.patch.object(sys, "platform", "linux"),
        mock.patch("dm_control._render.BACKEND", backend),
        pytest.raises(GLUnavailableError, match=fix),
    ):
        load_gl()
