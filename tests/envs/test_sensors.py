"""DeepMind Control tasks with several cameras, and with what the robot tells of itself."""

import copy
import pickle
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.env_checker import check_env

from sb3_cure import CuReSAC, make_dmc_env
from sb3_cure.envs import DMC_TASKS, physics_state, physics_state_names
from sb3_cure.envs.physics import Proprioception
from sb3_cure.persistence.env_state import load_vec_env_state, vec_env_state

SMALL: dict[str, Any] = dict(image_size=24, renderer="fast")


def test_images_are_those_of_single_cameras() -> None:
    """Pixel for pixel, along an episode; rewards and ends are the same."""
    both = make_dmc_env("reacher", "easy", cameras=[0, 1], proprioception=True, **SMALL)
    alone = [make_dmc_env("reacher", "easy", camera_id=index, **SMALL) for index in (0, 1)]
    seen, _ = both.reset(seed=3)
    others = [env.reset(seed=3)[0] for env in alone]
    assert list(both.observation_space.spaces) == list(seen) == ["camera0", "camera1", "proprioception"]
    both.action_space.seed(0)
    for _ in range(6):
        for index, other in enumerate(others):
            np.testing.assert_array_equal(seen[f"camera{index}"], other)
        assert (seen["camera0"] != seen["camera1"]).any()
        action = both.action_space.sample()
        seen, *result = both.step(action)
        results = [env.step(action) for env in alone]
        others = [each[0] for each in results]
        assert all(list(each[1:4]) == result[:3] for each in results)
    assert seen["proprioception"].dtype == np.float32 and both.observation_space.contains(seen)


def test_one_render_of_each_camera_per_step(monkeypatch: pytest.MonkeyPatch) -> None:
    from dm_control.mujoco import Camera

    rendered: list[int] = []
    render = Camera.render
    monkeypatch.setattr(Camera, "render", lambda self, **kw: rendered.append(self._width) or render(self, **kw))
    env = make_dmc_env("cartpole", "swingup", cameras=[0, 1], **SMALL)
    env.reset(seed=0)
    env.step(env.action_space.sample())
    assert rendered == [24] * 4


OWN = {
    ("cartpole", "swingup"): ["slider", "hinge_1_cos", "hinge_1_sin", "slider_velocity", "hinge_1_velocity"],
    ("pendulum", "swingup"): ["hinge_cos", "hinge_sin", "hinge_velocity"],
    ("finger", "spin"): ["proximal", "distal", "proximal_velocity", "distal_velocity"],
    ("ball_in_cup", "catch"): ["cup_x", "cup_z", "cup_x_velocity", "cup_z_velocity"],
    ("point_mass", "easy"): ["root_x", "root_y", "root_x_velocity", "root_y_velocity"],
}


@pytest.mark.parametrize("task", OWN)
def test_joints_are_the_robots_own(task: tuple[str, str]) -> None:
    """And their values those of the physics: angles that turn around as cosine and sine."""
    env = make_dmc_env(*task, proprioception=True, **SMALL)
    seen, _ = env.reset(seed=1)
    for _ in range(5):
        seen, *_ = env.step(env.action_space.sample())
    names = env.get_wrapper_attr("proprioception_names")
    assert names == OWN[task]
    state = dict(zip(physics_state_names(env), physics_state(env), strict=True))
    for name, value in zip(names, seen["proprioception"], strict=True):
        joint, _, kind = name.rpartition("_")
        expected = {"cos": lambda j: np.cos(state[j]), "sin": lambda j: np.sin(state[j])}.get(
            kind, lambda _, n=name: state[n]
        )
        assert value == pytest.approx(expected(joint), rel=1e-5, abs=1e-6)


#: What no joint of a robot is called: objects, and where it is in the world
FOREIGN = ("ball", "peg", "box", "target", "spinner", "rootx", "rooty", "rootz")


@pytest.mark.parametrize("domain", DMC_TASKS)
def test_every_robot_feels_its_joints_and_nothing_else(domain: str) -> None:
    """Of every task: the same number of values in each of a domain's tasks with one robot, none of an object."""
    for task in DMC_TASKS[domain][:: max(len(DMC_TASKS[domain]) - 1, 1)]:
        env = make_dmc_env(domain, task, proprioception=True, **SMALL)
        joints = Proprioception(env)
        assert len(joints.names) == len(joints()) == len(set(joints.names)) > 0
        assert not [name for name in joints.names if name.startswith(FOREIGN) or name == "root"]
        if domain in ("walker", "manipulator", "quadruped", "stacker"):
            positions = sum(not name.endswith(("_velocity", "_sin")) for name in joints.names)
            assert positions == {"walker": 6, "manipulator": 8, "quadruped": 16, "stacker": 8}[domain]


def test_it_is_an_environment_as_others_are() -> None:
    """Spaces, copies, ids, and attributes that tell; one camera beside the joints is called image."""
    env = make_dmc_env("walker", "walk", proprioception=True, frame_stack=2, grayscale=True, **SMALL)
    check_env(env, skip_render_check=True)
    assert env.observation_space["image"].shape == (2, 24, 24)
    assert [env.get_wrapper_attr(name) for name in ("image_size", "frame_stack", "action_repeat", "renderer")] == [
        *(24, 2, 2, "fast")
    ]
    copied = copy.deepcopy(env)
    made = gym.make("dmc_pixels/walker-walk-v0", proprioception=True, frame_stack=2, grayscale=True, **SMALL)
    again = gym.make(env.spec)
    first, *others = [each.reset(seed=5)[0] for each in (env, copied, made, again)]
    for other in others:
        assert all(np.array_equal(first[key], other[key]) for key in ("image", "proprioception"))
    assert pickle.loads(pickle.dumps(env.spec)).kwargs["proprioception"] is True
    for each in (env, copied, made, again):
        each.close()


def test_state_is_restored_exactly() -> None:
    """Between two steps, stacks included, in environments that were made with another seed."""
    from stable_baselines3.common.env_util import make_vec_env

    def make(seed: int) -> Any:
        arguments: Any = dict(cameras=[0, 1], proprioception=True, seed=seed, **SMALL)
        return make_vec_env(lambda: make_dmc_env("reacher", "easy", **arguments), 1)

    env, other = make(0), make(1)
    env.seed(0)
    env.reset()
    actions = np.random.default_rng(0).uniform(-1, 1, (8, 1, 2)).astype(np.float32)
    for action in actions[:4]:
        env.step(action)
    load_vec_env_state(other, vec_env_state(env))
    for action in actions[4:]:
        ours, theirs = env.step(action), other.step(action)
        assert all(np.array_equal(ours[0][key], theirs[0][key]) for key in ours[0])


def test_training_from_camera_and_joints() -> None:
    """On a real task."""
    env = make_dmc_env("cartpole", "swingup", proprioception=True, seed=0, **SMALL)
    network = dict(net_arch=[16], features_extractor_kwargs=dict(n_filters=4, n_layers=2))
    model = CuReSAC(
        "MultiInputPolicy", env, learning_starts=20, warmup_updates=0, batch_size=8, policy_kwargs=network, seed=0
    ).learn(40)
    assert model._n_updates == 20 and model.replay_buffer.rings["image"].frame_stack == 3
    assert model.policy.encoder.features_dim == 50 + 5
