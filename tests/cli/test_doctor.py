"""``sb3-cure doctor``: what is shown, and when the exit status says that training cannot work."""

from importlib import metadata
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.wrappers import TimeLimit, TransformReward

from sb3_cure import make_dmc_env
from sb3_cure.cli import doctor
from sb3_cure.cli.main import main

WORKS = {"renderer": "llvmpipe (LLVM 15.0.6, 256 bits)", "backend": "egl", "dmc": 13.0, "fast": 2.0}


def test_doctor_on_a_machine_that_works(capsys: pytest.CaptureFixture[str]) -> None:
    """System, versions, choices, and the time of a frame with both renderers; status 0."""
    assert main(["doctor"]) == 0
    report = capsys.readouterr().out
    versions = [f"{name} {metadata.version(name)}" for name in ("torch", "mujoco", "rl_zoo3", "scipy")]
    choices = ['precision="auto": ']
    for text in ["Python version: ", *versions, *choices, '(renderer="fast")', "MUJOCO_GL=", "Training can work here."]:
        assert text in report
    assert "ERROR" not in report


def test_doctor_survives_broken_opengl(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """The rest of the report is there, the error says what to install, and the status is 1."""
    monkeypatch.setenv("MUJOCO_GL", "nonsense")
    assert main(["doctor"]) == 1
    report = capsys.readouterr().out
    assert "torch " in report and "Traceback" not in report
    assert "ERROR    OpenGL cannot render here" in report and "apt-get install libegl1" in report


@pytest.mark.parametrize(("extra", "status"), [("", 1), ("zoo", 0)])
def test_doctor_names_missing_packages(
    extra: str, status: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """An error only where every installation needs it."""
    marker = f'; extra == "{extra}"' if extra else ""
    lines = [*(metadata.requires("sb3-cure") or []), f"no-such-package>=1,<2{marker}"]
    monkeypatch.setattr(doctor.metadata, "requires", lambda package: lines)
    monkeypatch.setattr(doctor, "try_rendering", lambda: WORKS)
    assert main(["doctor"]) == status
    report = capsys.readouterr().out
    assert "no-such-package" in report and ("ERROR" in report) == bool(status)
    assert ("pip install -e '.[zoo]'" in report) == (extra == "zoo")


def test_doctor_warns_of_unused_gpus(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Of torch without CUDA, and of frames that the CPU computes; training can work all the same."""
    monkeypatch.setattr(doctor.th.cuda, "is_available", lambda: False)
    monkeypatch.setattr(doctor, "find_gpus", lambda: ["NVIDIA GPU"])
    monkeypatch.setattr(doctor, "try_rendering", lambda: WORKS)
    assert main(["doctor"]) == 0
    assert capsys.readouterr().out.count("WARNING") == 2


class Walk(gym.Env):
    """Twenty steps along a line; ``reward_of`` gives the reward of a place."""

    observation_space = gym.spaces.Box(-20, 20, (1,))
    action_space = gym.spaces.Box(-1, 1, (1,))

    def __init__(self, reward_of: Any, length: float = 20):
        self.reward_of, self.length = reward_of, length

    def reset(self, **kwargs: Any) -> tuple[np.ndarray, dict]:
        super().reset(**kwargs)
        self.place, self.n = np.zeros(1, np.float32), 0
        return self.place, {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.place, self.n = self.place + action, self.n + 1
        return self.place, self.reward_of(self.place[0]), False, self.n >= self.length, {}


@pytest.mark.parametrize(
    ("reward_of", "advice"),
    [
        (lambda place: 0.0, "in 0 of 60 episodes; returns 0 to 0.\nHardly any"),
        (lambda place: -1.0 if place < 15 else 0.0, "in 0 of 60 episodes; returns -20 to -20.\nHardly any"),
        (lambda place: float(place > 3), "Some: "),
        (lambda place: float(place > 3) - float(place < -3), "Some: "),  # falls are no rewards
        (lambda place: float(place), "No two of 60 episodes"),
        (lambda place: float(place > 15) - 0.01 * float(place) ** 2, "a cost of actions hides"),
        (lambda place: float(place > 0), "Most: "),
    ],
)
def test_doctor_counts_the_random_episodes_that_meet_a_reward(
    reward_of: Any, advice: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    spec = EnvSpec("Walk-v0", entry_point=Walk, kwargs=dict(reward_of=reward_of))
    monkeypatch.setitem(gym.registry, "Walk-v0", spec)
    assert main(["doctor", "--env", "Walk-v0"]) == 0
    assert advice in capsys.readouterr().out


def test_doctor_needs_episodes_that_end(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    spec = EnvSpec("Walk-v0", entry_point=Walk, kwargs=dict(reward_of=float, length=np.inf))
    monkeypatch.setitem(gym.registry, "Walk-v0", spec)
    monkeypatch.setattr(doctor.play_randomly, "__defaults__", (60, 0.05))
    assert main(["doctor", "--env", "Walk-v0"]) == 2
    assert "0 episodes" in capsys.readouterr().err


def test_doctor_gives_the_environment_its_arguments(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Those of its own, and ``gym.make``'s limit of an episode; without what it needs it is no traceback."""
    spec = EnvSpec("Walk-v0", entry_point=Walk, kwargs=dict(length=np.inf))
    monkeypatch.setitem(gym.registry, "Walk-v0", spec)
    monkeypatch.setattr(Walk, "step", lambda self, action: (self.place, self.reward_of["each"], False, False, {}))
    assert main(["doctor", "--env", "Walk-v0"]) == 2
    assert "missing 1 required positional argument: 'reward_of'" in capsys.readouterr().err
    arguments = ["--env-kwargs", "reward_of:{'each': 2}", "max_episode_steps:7"]
    assert main(["doctor", "--env", "Walk-v0", *arguments]) == 0
    assert "in 60 of 60 episodes; returns 14 to 14" in capsys.readouterr().out


def test_doctor_plays_what_is_trained(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """A task of DeepMind Control that another id wraps, here in rewards of 0."""

    def sparse(**kwargs: Any) -> gym.Env:
        env = make_dmc_env("cartpole", "balance", image_size=16, renderer="fast")
        return TransformReward(TimeLimit(env, 3), lambda reward: 0.0)

    monkeypatch.setitem(gym.registry, "Sparse-v0", EnvSpec("Sparse-v0", entry_point=sparse))
    assert main(["doctor", "--env", "Sparse-v0"]) == 0
    assert "in 0 of 60 episodes; returns 0 to 0." in capsys.readouterr().out


def test_doctor_shortens_the_episodes_of_dmc_tasks() -> None:
    """Also below their camera, which it leaves out."""
    env = doctor._below_camera(gym.make("dmc_pixels/cartpole-swingup_sparse-v0", max_episode_steps=5))
    assert not env.has_wrapper_attr("image_size")
    env.reset(seed=0)
    assert [env.step(env.action_space.sample())[3] for _ in range(5)] == [False] * 4 + [True]


@pytest.mark.parametrize("flags", [["--env-kwargs", "size:3"], ["--env", "Pendulum-v1", "--env-kwargs", "size"]])
def test_doctor_refuses_arguments_of_nothing(flags: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["doctor", *flags])
    assert "--env-kwargs takes KEY:VALUE of the environment that --env names" in capsys.readouterr().err
