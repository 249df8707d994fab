"""Saved environments continue bit for bit: frames, rewards, ends of episodes, and what the next resets draw."""

import copy
import functools
import io
import itertools
import random
import re
import threading
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from envs_for_tests import differences
from gymnasium import spaces, wrappers
from hypothesis import given, settings
from hypothesis import strategies as st
from rl_zoo3.gym_patches import PatchedTimeLimit
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecFrameStack, VecMonitor, VecNormalize

from sb3_cure.envs import make_dmc_env, make_pixel_env
from sb3_cure.persistence import ResumableEnv, read_state, write_state
from sb3_cure.persistence.env_state import load_vec_env_state, saved_error, vec_env_state

#: Tasks that change terrain, targets, gains, weights, sizes and obstacles at reset
TASKS = [
    ("quadruped", "escape"),
    ("fish", "swim"),
    ("finger", "turn_hard"),
    ("manipulator", "insert_peg"),
    ("dog", "fetch"),
]


class Dot(gym.Env):
    """A dot that is pushed about, with noise in each reward."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 30}  # noqa: RUF012
    render_mode = "rgb_array"

    def __init__(self) -> None:
        self.action_space = spaces.Box(-1, 1, (2,), np.float32)
        self.observation_space = spaces.Box(-1, 1, (2,), np.float32)
        self.position, self.n_steps = np.zeros(2), 0

    def observe(self) -> Any:
        """The position, [2]."""
        return self.position.astype(np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict]:
        super().reset(seed=seed)
        self.position, self.n_steps = self.np_random.uniform(-1, 1, 2), 0
        return self.observe(), {}

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict]:
        self.position, self.n_steps = np.clip(self.position + 0.3 * action, -1, 1), self.n_steps + 1
        return self.observe(), self.np_random.normal(), False, self.n_steps >= 20, {}

    def state_dict(self) -> dict[str, Any]:
        return {"position": self.position, "n_steps": self.n_steps}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.position, self.n_steps = state["position"], state["n_steps"]

    def render(self) -> np.ndarray:
        row, column = np.rint((self.position + 1) * 10).astype(int)
        frame = np.zeros((24, 24, 3), np.uint8)
        frame[row : row + 3, column : column + 3] = 255
        return frame


def actions(venv: VecEnv, steps: int) -> list[np.ndarray]:
    """Random actions in [-1, 1]."""
    shape = (steps, venv.num_envs, *(venv.action_space.shape or ()))
    return list(np.random.default_rng(0).uniform(-1, 1, shape).astype(np.float32))


def follow(venv: VecEnv, steps: list[np.ndarray]) -> list[Any]:
    """All that learning sees or logs of each action, without clocks."""
    seen = []
    for action in steps:
        observations, rewards, dones, infos = venv.step(action)
        episodes = [{k: v for k, v in info.get("episode", {}).items() if k != "t"} for info in infos]
        ends = [info.get("terminal_observation") for info in infos]
        seen.append([copy.deepcopy(observations), rewards, dones, episodes, ends])
    return seen


def saved(venv: VecEnv) -> bytes:
    """File of the state, which must be whole."""
    assert saved_error(vec_env_state(venv)) is None
    write_state(file := io.BytesIO(), vec_env_state(venv))
    return file.getvalue()


def check_continues(venv: VecEnv, other: VecEnv, steps: int) -> int:
    """Save one, load into the other, and compare what follows; the number of episodes that end meanwhile."""
    file, path = saved(venv), actions(venv, steps)
    expected, after = follow(venv, path), saved(venv)
    assert load_vec_env_state(other, read_state(io.BytesIO(file))) is None
    assert saved(other) == file
    assert differences(follow(other, path), expected) == []
    assert saved(other) == after
    return sum(int(dones[0]) for _, _, dones, _, _ in expected)


def dmc(domain: str, task: str, seed: int) -> DummyVecEnv:
    """A task with episodes of five agent steps."""
    env = make_dmc_env(domain, task, image_size=16, renderer="fast", seed=seed)
    env.unwrapped._env._step_limit = 5 * env.get_wrapper_attr("action_repeat")  # type: ignore[attr-defined]
    return DummyVecEnv([lambda: Monitor(env)])


@pytest.mark.parametrize(("domain", "task"), TASKS)
def test_dmc_task_continues_bit_for_bit(domain: str, task: str) -> None:
    venv, fresh = dmc(domain, task, seed=1), dmc(domain, task, seed=2)
    if task == "escape":
        fresh.reset()  # has drawn, and shows, another terrain
    venv.reset()
    follow(venv, actions(venv, 8))
    assert check_continues(venv, fresh, 9) == 2
    # Nothing that the task changed in the model, and that these steps did not show, is lost.
    models = [each.envs[0].unwrapped.physics.model.ptr for each in (venv, fresh)]  # type: ignore[attr-defined]
    arrays = [{name: getattr(m, name) for name in dir(m) if name != "names" and name[0] != "_"} for m in models]
    kept, loaded = ({k: v for k, v in each.items() if isinstance(v, np.ndarray)} for each in arrays)
    assert [name for name in kept if kept[name].tobytes() != loaded[name].tobytes()] == []
    venv.close()
    fresh.close()


def test_saving_changes_nothing() -> None:
    venv, unsaved = dmc("walker", "walk", seed=1), dmc("walker", "walk", seed=1)
    for each in (venv, unsaved):
        each.reset()
    for action in actions(venv, 7):
        saved(venv)
        assert differences(follow(venv, [action]), follow(unsaved, [action])) == []


WRAPPERS: dict[str, Callable[[gym.Env], gym.Env]] = {
    "ClipAction": wrappers.ClipAction,
    "TransformReward": lambda env: wrappers.TransformReward(env, np.tanh),
    "TransformReward of a function": lambda env: wrappers.TransformReward(env, lambda reward: reward / 2),
    "ClipReward": lambda env: wrappers.ClipReward(env, -0.5, 0.5),
    "DelayObservation": lambda env: wrappers.DelayObservation(env, 2),
    "FrameStackObservation": lambda env: wrappers.FrameStackObservation(env, 3),
    "NormalizeObservation": wrappers.NormalizeObservation,
    "NormalizeReward": wrappers.NormalizeReward,
    "OrderEnforcing": wrappers.OrderEnforcing,
    "PassiveEnvChecker": wrappers.PassiveEnvChecker,
    "RecordEpisodeStatistics": wrappers.RecordEpisodeStatistics,
    "StickyAction": lambda env: wrappers.StickyAction(env, 0.4, (1, 3)),
    "TimeAwareObservation": wrappers.TimeAwareObservation,
}
VEC_WRAPPERS: dict[str, Callable[[VecEnv], VecEnv]] = {
    "none": lambda venv: venv,
    "VecNormalize": VecNormalize,
    "VecFrameStack": lambda venv: VecFrameStack(venv, 2),
    "VecMonitor": VecMonitor,
}


@settings(max_examples=25, deadline=None)
@given(
    names=st.lists(st.sampled_from(list(WRAPPERS)), max_size=4, unique=True),
    pixels=st.booleans(),
    before=st.integers(0, 12),
    vec=st.sampled_from(list(VEC_WRAPPERS)),
)
def test_known_wrappers_continue_from_any_step(names: list[str], pixels: bool, before: int, vec: str) -> None:
    def build(seed: int) -> VecEnv:
        env: gym.Env = wrappers.TimeLimit(Dot(), 6)
        for name in names:
            env = WRAPPERS[name](env)
        env = make_pixel_env(env, image_size=12) if pixels else env
        env.action_space.seed(seed)
        venv = VEC_WRAPPERS[vec](DummyVecEnv([lambda: env if vec == "VecMonitor" else Monitor(env)]))
        venv.seed(seed)
        return venv

    venv, fresh = build(1), build(2)
    venv.reset()
    follow(venv, actions(venv, before))
    check_continues(venv, fresh, 8)
    assert np.array_equal(venv.action_space.sample(), fresh.action_space.sample())


def test_seed_for_the_next_reset_is_kept() -> None:
    venv, fresh = (DummyVecEnv([Dot]) for _ in range(2))
    venv.seed(7)
    load_vec_env_state(fresh, vec_env_state(venv))
    assert differences(venv.reset(), fresh.reset()) == []


class Nested(Dot):
    """Observes a draw from a part of its space, too."""

    def __init__(self) -> None:
        super().__init__()
        self.draw = spaces.Box(0, 1)
        self.observation_space = spaces.Dict({"position": self.observation_space, "draw": self.draw})

    def observe(self) -> Any:
        return {"position": super().observe(), "draw": self.draw.sample()}


class GlobalNoise(Dot):
    """Draws from the global generators of its process."""

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict]:
        observation, reward, *rest = super().step(action)
        return observation, reward + np.random.normal() + random.random(), *rest


def test_worker_processes_continue_with_their_random_streams() -> None:
    def build() -> VecEnv:
        makers = [lambda: ResumableEnv(Monitor(GlobalNoise()))] * 2
        return VecNormalize(SubprocVecEnv(makers, start_method="fork"), norm_obs=False)

    venv, fresh = build(), build()
    try:
        venv.reset()
        follow(venv, actions(venv, 5))
        check_continues(venv, fresh, 12)
    finally:
        venv.close()
        fresh.close()


@pytest.mark.parametrize("make", [Dot, lambda: Monitor(ResumableEnv(Dot()))])
def test_unreachable_layers_in_workers_are_reported(make: Callable[[], gym.Env]) -> None:
    """Without a wrapper of ours, and with one that has others around it."""
    venv = SubprocVecEnv([make], start_method="fork")
    assert "need sb3_cure.persistence.ResumableEnv as their outermost wrapper" in str(saved_error(vec_env_state(venv)))
    venv.close()


class Halved(gym.RewardWrapper):
    """A wrapper of the user's that keeps nothing."""

    def reward(self, reward: Any) -> float:
        return reward / 2


class Silent(gym.Wrapper):
    """A wrapper of the user's that keeps something, and does not say whether that is all of its state."""

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self.seen = 0


def locked() -> gym.Env:
    """An environment of Gymnasium with an attribute that no file holds."""
    env = gym.make("Pendulum-v1").unwrapped
    env.lock = threading.Lock()  # type: ignore[attr-defined]
    return env


@pytest.mark.parametrize(
    "make",
    [
        Nested,
        lambda: Halved(Dot()),
        lambda: PatchedTimeLimit(Dot(), 7),  # rl-zoo3 puts it in place of Gymnasium's
        functools.partial(make_pixel_env, "Pendulum-v1", image_size=12),
    ],
)
def test_other_layers_continue(make: Any) -> None:
    venv, fresh = (DummyVecEnv([lambda: Monitor(make())] * 2) for _ in range(2))
    venv.seed(0)
    venv.reset()
    follow(venv, actions(venv, 5))
    check_continues(venv, fresh, 12)


class Broken(Dot):
    """Fails when asked for its state."""

    def state_dict(self) -> dict[str, Any]:
        return {"x": self.missing}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        pass


class Fading:
    """A function of the user's that remembers how often it was called."""

    def __init__(self) -> None:
        self.n_calls = 0

    def __call__(self, reward: Any) -> float:
        self.n_calls += 1
        return float(reward) / self.n_calls


def fading() -> Callable[[Any], float]:
    """The same as a closure."""
    count = itertools.count(1)
    return lambda reward: float(reward) / next(count)


NOT_KEPT: dict[str, Callable[[], gym.Env]] = {
    "Silent has no state_dict": lambda: Silent(Dot()),
    r"PendulumEnv\.lock is of the type _thread\.lock": locked,
    "Broken.*'missing'": Broken,
    r"TransformReward\.func is of the type .*Fading": lambda: wrappers.TransformReward(Dot(), Fading()),
    r"TransformReward\.func is the function .*Fading": lambda: wrappers.TransformReward(Dot(), Fading().__call__),
    r"TransformReward\.func is the function .*fading": lambda: wrappers.TransformReward(Dot(), fading()),
}


@pytest.mark.parametrize("reason", NOT_KEPT)
def test_other_states_are_reported(reason: str) -> None:
    """The reason is said, the other layers are restored, and the environment may be reset."""
    venv, other = (VecNormalize(DummyVecEnv([NOT_KEPT[reason]])) for _ in range(2))
    venv.reset()
    follow(venv, actions(venv, 3))
    error = load_vec_env_state(other, vec_env_state(venv))
    assert re.search(reason, str(error))
    assert other.obs_rms.count == venv.obs_rms.count > 3  # type: ignore[union-attr]


def test_own_dm_control_task_is_reported() -> None:
    from dm_control.suite import cartpole

    class OwnTask(cartpole.Balance):
        """May remember anything."""

    venv = dmc("cartpole", "balance", 0)
    venv.envs[0].unwrapped._env._task = OwnTask(False, False)  # type: ignore[attr-defined]
    assert saved_error(vec_env_state(venv)) == "the task OwnTask is not one of dm_control.suite"


def test_arguments_of_new_wrappers_hold() -> None:
    """A longer time limit, in an episode that goes on."""
    before, after = (DummyVecEnv([lambda limit=limit: wrappers.TimeLimit(Dot(), limit)]) for limit in (3, 5))
    before.reset()
    before.step(np.zeros((1, *before.action_space.shape), np.float32))
    assert load_vec_env_state(after, vec_env_state(before)) is None
    ends = [after.step(np.zeros((1, *after.action_space.shape), np.float32))[2][0] for _ in range(4)]
    assert ends == [False, False, False, True]


def test_state_of_other_environments_is_refused() -> None:
    makers: list[Callable[[], VecEnv]] = [
        lambda: DummyVecEnv([Dot]),
        lambda: DummyVecEnv([lambda: Monitor(Dot())]),
        lambda: VecNormalize(DummyVecEnv([Dot])),
        lambda: dmc("walker", "walk", 0),
    ]
    for first, second in itertools.permutations(makers, 2):
        with pytest.raises(ValueError, match=r"the saved state is of \w.*, and here is \w.*: build the environments"):
            load_vec_env_state(second(), vec_env_state(first()))


@pytest.mark.parametrize("workers", [False, True])
def test_state_of_another_task_is_refused(workers: bool) -> None:
    """Its layers and shapes are the same."""

    def built(task: str) -> VecEnv:
        makers: Any = [lambda: ResumableEnv(Monitor(make_dmc_env("cartpole", task, image_size=24, renderer="fast")))]
        return SubprocVecEnv(makers, start_method="fork") if workers else DummyVecEnv(makers)

    venv, wrong = built("swingup"), built("balance")
    with pytest.raises(ValueError, match=r"of .*cartpole-swingup-v0\), and here is .*cartpole-balance-v0"):
        load_vec_env_state(wrong, vec_env_state(venv))
    venv.close()
    wrong.close()


def test_workers_without_the_wrapper_begin_a_new_episode() -> None:
    """Where the saved ones had it."""
    venv, fresh = (SubprocVecEnv([make], start_method="fork") for make in (lambda: ResumableEnv(Dot()), Dot))
    assert "need sb3_cure.persistence.ResumableEnv" in str(load_vec_env_state(fresh, vec_env_state(venv)))
    assert fresh.reset().shape == (1, 2)
    venv.close()
    fresh.close()
