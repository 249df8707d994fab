"""Saved environments go on bit for bit: frames, rewards, ends of episodes, and what the next resets draw."""

import copy
import functools
import itertools
import threading
from collections import deque
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from envs_for_tests import VectorBox, differences
from gymnasium import spaces, wrappers
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecEnv,
    VecFrameStack,
    VecMonitor,
    VecNormalize,
    VecTransposeImage,
)

from sb3_cure.envs import make_dmc_env, make_pixel_env
from sb3_cure.persistence.env_state import load_vec_env_state, vec_env_state, why_not_restorable
from sb3_cure.vec_env import OverlappedVecEnv

# Every kind of thing that tasks of the suite change at reset: terrain, targets, gains, weights, sizes, obstacles
TASKS = [
    *(("quadruped", "escape"), ("fish", "swim"), ("finger", "turn_hard"), ("point_mass", "hard"), ("humanoid", "run")),
    *(
        ("manipulator", "insert_peg"),
        ("stacker", "stack_2"),
        ("swimmer", "swimmer6"),
        ("lqr", "lqr_2_1"),
        ("dog", "fetch"),
    ),
]
# Of the clock (``buf_infos`` has times of episodes), and what PassiveEnvChecker has looked at.
NOT_KEPT = (
    *("t_start", "episode_times", "time_queue", "episode_start_time", "buf_infos"),
    *("checked_reset", "checked_step", "checked_render", "checked_data_reuse", "_previous_data"),
)
PLAIN = (bool, int, float, str, bytes, type(None), np.number, np.bool_)


class Dot(VectorBox):
    """``VectorBox`` that offers its state, renders itself, and draws noise in every step."""

    def __init__(self, render_mode: str = "rgb_array", **kwargs: Any):
        super().__init__(**kwargs)
        self.render_mode = render_mode
        self.metadata = {"render_modes": ["rgb_array"], "render_fps": 30}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        observation, reward, terminated, truncated, info = super().step(action)
        return observation, reward + self.np_random.normal(), terminated, truncated, info

    def render(self) -> np.ndarray:
        row, column = np.rint((self.position + 1) * 10).astype(int)
        frame = np.zeros((24, 24, 3), np.uint8)
        frame[row : row + 3, column : column + 3] = 255
        return frame

    def state_dict(self) -> dict[str, Any]:
        """What this class remembers."""
        return {"position": self.position, "n_steps": self.n_steps}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """
        :param state: Of ``state_dict``
        """
        self.position, self.n_steps = state["position"], state["n_steps"]


class Drift(gym.Wrapper):
    """Adds to each reward how often it was asked, ever."""

    asked = 0

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict]:
        self.asked += 1
        observation, reward, terminated, truncated, info = super().step(action)
        return observation, float(reward) + self.asked, terminated, truncated, info

    def state_dict(self) -> dict[str, Any]:
        """What this class remembers."""
        return {"asked": self.asked}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """
        :param state: Of ``state_dict``
        """
        self.asked = state["asked"]


def actions(venv: VecEnv, steps: int) -> list[np.ndarray]:
    """Random actions in [-1, 1]."""
    shape = (steps, venv.num_envs, *(venv.action_space.shape or ()))
    return list(np.random.default_rng(0).uniform(-1, 1, shape).astype(np.float32))


def follow(venv: VecEnv, steps: list[np.ndarray]) -> list[Any]:
    """What comes of each action: all that learning sees or logs, but the time of the clock."""
    seen = []
    for action in steps:
        observations, rewards, dones, infos = venv.step(action)
        episodes = [{k: v for k, v in info.get("episode", {}).items() if k != "t"} for info in infos]
        ends = [info.get("terminal_observation") for info in infos]
        seen.append([copy.deepcopy(observations), rewards, dones, episodes, ends])
    return seen


def is_plain(value: Any) -> bool:
    """Whether it can be written to a file without pickle."""
    if isinstance(value, dict):
        return all(type(key) is str and is_plain(part) for key, part in value.items())
    if isinstance(value, list | tuple):
        return all(map(is_plain, value))
    return (value.dtype.kind in "biuf") if isinstance(value, np.ndarray) else isinstance(value, PLAIN)


def saved(venv: VecEnv) -> dict[str, Any]:
    """The state, which must exist and be plain."""
    state = vec_env_state(venv)
    assert state is not None, why_not_restorable(venv)
    assert is_plain(state)
    return state


def remembered(venv: Any) -> list[dict[str, Any]]:
    """All plain attributes of all layers, of which nothing may be forgotten (but ``NOT_KEPT``)."""
    layers = [venv]
    while hasattr(layers[-1], "venv") or hasattr(layers[-1], "envs") or hasattr(layers[-1], "env"):
        outer = vars(layers[-1])
        layers.append(outer["venv"] if "venv" in outer else outer["envs"][0] if "envs" in outer else outer["env"])
    attributes = [{k: list(v) if isinstance(v, deque) else v for k, v in vars(layer).items()} for layer in layers]
    return [{k: v for k, v in each.items() if k not in NOT_KEPT and is_plain(v)} for each in attributes]


def goes_on(venv: VecEnv, other: VecEnv, steps: int) -> list[Any]:
    """Save one, load into the other, and compare what follows; the steps of both."""
    state = saved(venv)
    kept = copy.deepcopy(state)
    path = actions(venv, steps)
    expected = follow(venv, path[:1])
    after_a_step = saved(venv)
    expected += follow(venv, path[1:])
    load_vec_env_state(other, state)
    assert differences(saved(other), kept) == []
    assert differences(follow(other, path[:1]), expected[:1]) == []
    assert differences(saved(other), after_a_step) == []
    assert differences(follow(other, path[1:]), expected[1:]) == []
    assert differences(state, kept) == []  # neither environment writes into it
    return expected


def dmc(domain: str, task: str, seed: int) -> DummyVecEnv:
    """A task with episodes of five agent steps."""
    env = make_dmc_env(domain, task, image_size=16, renderer="fast", seed=seed)
    env.unwrapped._env._step_limit = 5 * env.get_wrapper_attr("action_repeat")  # type: ignore[attr-defined]
    return DummyVecEnv([lambda: Monitor(env)])


@pytest.mark.parametrize("domain, task", TASKS)
def test_a_dmc_task_goes_on_bit_for_bit_in_a_fresh_environment(domain: str, task: str) -> None:
    venv, fresh = dmc(domain, task, seed=1), dmc(domain, task, seed=2)
    if task == "escape":
        fresh.reset()  # has drawn, and shows, another terrain
    venv.reset()
    follow(venv, actions(venv, 8))
    expected = goes_on(venv, fresh, 9)
    assert [bool(dones[0]) for _, _, dones, _, _ in expected].count(True) == 2
    # And what was not seen in these steps: nothing that the task changed in the model is forgotten, nor forces.
    models = [each.envs[0].unwrapped.physics.model.ptr for each in (venv, fresh)]  # type: ignore[attr-defined]
    arrays = [{name: getattr(m, name) for name in dir(m) if name != "names" and name[0] != "_"} for m in models]
    kept, loaded = ({k: v for k, v in each.items() if isinstance(v, np.ndarray)} for each in arrays)
    assert [name for name in kept if kept[name].tobytes() != loaded[name].tobytes()] == []
    venv.close()
    fresh.close()


def test_a_dmc_task_is_saved_before_its_first_step() -> None:
    venv, fresh = dmc("walker", "walk", seed=1), dmc("walker", "walk", seed=2)
    venv.reset()
    goes_on(venv, fresh, 6)


def test_saving_changes_nothing() -> None:
    venv, unsaved = dmc("walker", "walk", seed=1), dmc("walker", "walk", seed=1)
    for each in (venv, unsaved):
        each.reset()
    for action in actions(venv, 12):
        saved(venv)
        assert differences(follow(venv, [action]), follow(unsaved, [action])) == []


def reacher(seed: int) -> gym.Env:
    """For worker processes."""
    return Monitor(make_dmc_env("reacher", "easy", image_size=16, renderer="fast", render_mode="rgb_array", seed=seed))


def pixel_dot(episode_length: int) -> gym.Env:
    """For worker processes, with the spaces of ``reacher``."""
    return Monitor(make_pixel_env(Drift(Dot(episode_length=episode_length)), image_size=16))


def test_worker_processes_go_on() -> None:
    def build(seed: int) -> VecEnv:
        venv = SubprocVecEnv([functools.partial(reacher, seed), functools.partial(pixel_dot, 7)])
        return VecNormalize(venv, norm_obs=False)

    venv, fresh = OverlappedVecEnv(build(1)), build(5)
    try:
        venv.seed(3)
        venv.reset()
        venv.action_space.seed(4)
        follow(venv, actions(venv, 5))
        state = saved(venv)
        expected = goes_on(venv, fresh, 16)
        assert sum(bool(dones[1]) for _, _, dones, _, _ in expected) == 3
        assert np.array_equal(venv.action_space.sample(), fresh.action_space.sample())

        state["envs"][1][-1]["attributes"]["state_dict()"] = {"dict": []}
        with pytest.raises(ValueError, match=r"build them as they were built .* environment 1 .* KeyError: 'position'"):
            load_vec_env_state(venv, state)
        venv.step_async(actions(venv, 1)[0])  # the worker lives
        with pytest.raises(RuntimeError, match=r"call step_wait\(\)"):
            vec_env_state(venv)
        venv.step_wait()
    finally:
        venv.close()
        fresh.close()


def test_a_worker_process_whose_environment_cannot_be_reached_is_refused() -> None:
    venv = SubprocVecEnv([Dot], start_method="fork")
    try:
        assert vec_env_state(venv) is None
        assert why_not_restorable(venv) == (
            "an environment in a worker process can only be reached through a wrapper, such as Monitor, and has none"
        )
    finally:
        venv.close()


WRAPPERS: dict[str, Callable[[gym.Env], gym.Env]] = {
    "ClipAction": wrappers.ClipAction,
    "DelayObservation": lambda env: wrappers.DelayObservation(env, 2),
    "Drift": Drift,
    "MaxAndSkipObservation": lambda env: wrappers.MaxAndSkipObservation(env, 4),
    "FrameStackObservation": lambda env: wrappers.FrameStackObservation(env, 3),
    "NormalizeObservation": wrappers.NormalizeObservation,
    "NormalizeReward": wrappers.NormalizeReward,
    "OrderEnforcing": wrappers.OrderEnforcing,
    "PassiveEnvChecker": wrappers.PassiveEnvChecker,
    "RecordEpisodeStatistics": wrappers.RecordEpisodeStatistics,
    "RepeatAction": lambda env: wrappers.RepeatAction(env, 2),
    "StickyAction": lambda env: wrappers.StickyAction(env, 0.4, (1, 3)),
    "TimeAwareObservation": wrappers.TimeAwareObservation,
}


@settings(max_examples=40, deadline=None)
@given(
    names=st.lists(st.sampled_from(list(WRAPPERS)), max_size=4, unique=True),
    pixels=st.booleans(),
    before=st.integers(0, 20),
    vec=st.sampled_from(["", "VecNormalize", "VecFrameStack", "VecMonitor", "VecTransposeImage"]),
)
def test_any_stack_of_known_wrappers_goes_on_from_any_step(
    names: list[str], pixels: bool, before: int, vec: str
) -> None:
    def build(seed: int) -> VecEnv:
        env: gym.Env = wrappers.TimeLimit(Dot(), 6)
        for name in names:
            env = WRAPPERS[name](env)
        if pixels:
            env = make_pixel_env(env, image_size=12)
        env.action_space.seed(seed)
        venv: VecEnv = DummyVecEnv([lambda: env if vec == "VecMonitor" else Monitor(env)])
        if vec == "VecNormalize":
            venv = VecNormalize(venv)
        elif vec == "VecFrameStack":
            venv = VecFrameStack(venv, 2)
        elif vec == "VecMonitor":
            venv = VecMonitor(venv)
        elif pixels and vec:
            venv = VecTransposeImage(venv, skip=True)
        venv.seed(seed)
        return venv

    venv, fresh = build(1), build(2)
    venv.reset()
    follow(venv, actions(venv, before))
    goes_on(venv, fresh, 15)
    assert np.array_equal(venv.action_space.sample(), fresh.action_space.sample())
    assert differences(remembered(fresh), remembered(venv)) == []


def test_a_seed_that_waits_for_the_next_reset_is_kept() -> None:
    venv, fresh = (DummyVecEnv([Dot]) for _ in range(2))
    venv.seed(7)
    load_vec_env_state(fresh, saved(venv))
    assert differences(venv.reset(), fresh.reset()) == []


def test_dmc_by_its_id_goes_on_from_the_first_step() -> None:
    """Until then Gymnasium's checker keeps what the reset told, which is not plain."""
    venv, fresh = (
        DummyVecEnv([lambda: gym.make("dmc_pixels/cartpole-swingup-v0", image_size=12, renderer="fast")])
        for _ in range(2)
    )
    venv.seed(1)
    venv.reset()
    assert why_not_restorable(venv) is None
    goes_on(venv, fresh, 4)


class Nested(Dot):
    """Observes a draw from a part of its space, too."""

    def __init__(self) -> None:
        super().__init__()
        self.draw = spaces.Box(0, 1)
        self.observation_space = spaces.Dict({"position": self.observation_space, "draw": self.draw})

    def observe(self, first: bool = False) -> Any:
        """As of ``VectorBox``."""
        return {"position": super().observe(), "draw": self.draw.sample()}


def test_dictionaries_of_observations_and_the_generators_of_their_spaces_go_on() -> None:
    venv, fresh = (VecNormalize(VecFrameStack(DummyVecEnv([Nested]), 2)) for _ in range(2))
    venv.reset()
    goes_on(venv, fresh, 30)


class Plain(gym.Env):
    """Offers no state, but keeps all of it in plain attributes, some of them made by the first reset."""

    action_space = spaces.Box(-1, 1, (2,), np.float32)
    observation_space = spaces.Box(-np.inf, np.inf, (4,), np.float64)

    def __init__(self) -> None:
        self.scale, self.seen, self.function = np.float32(0.3), {(0, 0): 0}, np.tanh

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.wind, self.old = self.np_random, deque([0.5], maxlen=3)  # one generator by two names
        self.cells = {1, 2}
        self.noise = np.random.RandomState(int(self.np_random.integers(1000)))
        self.n_steps = 0
        return self.observe(), {}

    def observe(self) -> np.ndarray:
        """Depends on all attributes."""
        return np.array([sum(self.old) * self.scale, len(self.seen), self.noise.normal(), len(self.cells)])

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.n_steps += 1
        self.old.append(float(self.function(action[0])))
        self.seen[(self.n_steps, int(self.np_random.integers(5)))] = 1
        self.cells.add(self.n_steps % 4)
        return self.observe(), self.wind.normal(), False, self.n_steps >= 7, {}


@pytest.mark.parametrize("vec", [DummyVecEnv, functools.partial(SubprocVecEnv, start_method="fork")])
def test_environment_of_plain_attributes_goes_on(vec: Any) -> None:
    venv, fresh = (vec([lambda: Monitor(Plain())] * 2) for _ in range(2))
    venv.seed(0)
    venv.reset()
    follow(venv, actions(venv, 5))
    goes_on(venv, fresh, 12)
    venv.close()
    fresh.close()


def test_classic_control_seen_through_pixels_goes_on() -> None:
    """Its renderer keeps pygame's surfaces, which are no state."""
    venv, fresh = (DummyVecEnv([lambda: make_pixel_env("Pendulum-v1", image_size=16)]) for _ in range(2))
    venv.reset()
    follow(venv, actions(venv, 3))
    goes_on(venv, fresh, 5)


class Connected(Dot):
    """Offers a state in which a function is; without it, holds a lock."""

    def __init__(self) -> None:
        super().__init__()
        self.lock = threading.Lock()

    def state_dict(self) -> dict[str, Any]:
        return {"function": len}


class Locked(gym.Wrapper):
    """Holds what cannot be saved."""

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self.locks = [threading.Lock()]


def test_what_cannot_be_saved_is_named() -> None:
    refused: dict[str, Callable[[], VecEnv]] = {
        "Connected keeps in state_dict() a builtin_function_or_method, ": lambda: DummyVecEnv([Dot, Connected]),
        "Locked keeps in locks a lock, ": lambda: DummyVecEnv([Dot, lambda: Monitor(Locked(Dot()))]),
    }
    for name, build in refused.items():
        venv = build()
        assert vec_env_state(venv) is None
        assert why_not_restorable(venv) == (
            f"{name}which cannot be saved (give it state_dict() and load_state_dict(state) of plain data)"
        )
    assert why_not_restorable(DummyVecEnv([Dot])) is None


def test_a_task_of_dm_control_that_is_not_of_the_suite_is_refused() -> None:
    from dm_control.suite import cartpole

    class OwnTask(cartpole.Balance):
        """May remember anything."""

    venv = dmc("cartpole", "balance", 0)
    venv.envs[0].unwrapped._env._task = OwnTask(False, False)  # type: ignore[attr-defined]
    assert vec_env_state(venv) is None
    assert why_not_restorable(venv) == "the task OwnTask is not one of dm_control.suite"


def test_a_state_of_other_environments_is_refused_in_one_sentence() -> None:
    makers: list[Callable[[], VecEnv]] = [
        lambda: DummyVecEnv([Dot]),
        lambda: DummyVecEnv([Dot, Dot]),
        lambda: DummyVecEnv([lambda: Monitor(Dot())]),
        lambda: VecNormalize(DummyVecEnv([Dot])),
        lambda: dmc("walker", "walk", 0),
    ]
    for first, second in itertools.permutations(makers, 2):
        with pytest.raises(ValueError, match=r"does not fit these environments, build them as .*: \w") as error:
            load_vec_env_state(second(), saved(first()))
        assert "\n" not in str(error.value)


@pytest.mark.parametrize("workers", [False, True])
@pytest.mark.parametrize(
    "other, sentence",
    [
        (dict(task="balance"), "of DmControlCompatibilityV0 with id='dmc_pixels/cartpole-swingup-v0', and here it is "),
        (dict(action_repeat=4), "of ActionRepeat with num_repeats=8, and here it is 4"),
        (dict(renderer="dmc", camera_id=1), r"of DMCPixels with cameras=.*0.*, and here it is .*1"),
    ],
)
def test_environments_built_otherwise_are_refused(other: dict[str, Any], sentence: str, workers: bool) -> None:
    """Their states have the same shapes, but the task is another one from here on."""
    arguments: dict[str, Any] = dict(domain="cartpole", task="swingup", action_repeat=8, image_size=24, renderer="fast")

    def built(**changed: Any) -> VecEnv:
        makers = [lambda: Monitor(make_dmc_env(**{**arguments, **changed}))]
        return SubprocVecEnv(makers, start_method="fork") if workers else DummyVecEnv(makers)  # type: ignore[arg-type]

    venv, wrong = built(), built(**other)
    with pytest.raises(ValueError, match=f"does not fit .* it is {sentence}"):
        load_vec_env_state(wrong, saved(venv))
    venv.close()
    wrong.close()


def test_arguments_are_compared_by_value() -> None:
    def wrapped(bound: Any, low: Any) -> DummyVecEnv:
        return DummyVecEnv([lambda: wrappers.RescaleAction(wrappers.ClipReward(Dot(), -1, bound), low, -low)])

    venv = wrapped(1.0, np.array([-0.5, -0.5], np.float32))
    load_vec_env_state(wrapped(np.float64(1.0), np.array([-0.5, -0.5])), saved(venv))
    with pytest.raises(
        ValueError, match=r"RescaleAction with max_action=\[0\.5, 0\.5\], and here it is \[1\.0, 1\.0\]"
    ):
        load_vec_env_state(wrapped(1.0, np.array([-1, -1], np.float32)), saved(venv))


def test_rl_zoos_time_limit_is_known() -> None:
    """rl-zoo puts a class of its own in the place of Gymnasium's, in every process that imports it."""
    from rl_zoo3.gym_patches import PatchedTimeLimit

    (original,) = (kind for kind in PatchedTimeLimit.__mro__ if kind.__name__ == "TimeLimit")

    def limited(kind: type) -> DummyVecEnv:
        return DummyVecEnv([lambda: Monitor(kind(Dot(episode_length=1000), 6))])

    venv, other = limited(PatchedTimeLimit), limited(original)
    venv.reset()
    for _ in range(4):
        venv.step(np.zeros((1, 2)))
    assert why_not_restorable(venv) is None
    load_vec_env_state(other, vec_env_state(venv))
    dones = [other.step(np.zeros((1, 2)))[2][0] for _ in range(8)]
    assert dones == [step in (1, 7) for step in range(8)]
