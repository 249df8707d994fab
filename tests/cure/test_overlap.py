"""Updates overlap with environment steps, and never wait for the device."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from envs_for_tests import PixelBox, tiny_model
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import SubprocVecEnv
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torch.utils._python_dispatch import TorchDispatchMode

from sb3_cure import CuReSAC


class Counting(gym.Env):
    """Observes how many steps it has made."""

    observation_space = spaces.Box(-1e6, 1e6, (1,), np.float32)
    action_space = spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, **kwargs: Any) -> tuple[np.ndarray, dict]:
        super().reset(seed=kwargs.get("seed"))
        self.steps = 0
        return np.zeros(1, np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.steps += 1
        return np.full(1, self.steps, np.float32), 0.0, False, False, {}


@pytest.fixture
def counting() -> Iterator[SubprocVecEnv]:
    """One environment in a worker."""
    venv = SubprocVecEnv([Counting])
    yield venv
    venv.close()


def interrupt(model: CuReSAC, at: int) -> Any:
    """Let Ctrl-C fall into the update after so many steps; returns the update as it was."""
    update = model._update

    def interrupted(*arguments: Any) -> Any:
        if model.num_timesteps == at:
            raise KeyboardInterrupt
        return update(*arguments)

    model._update = interrupted  # type: ignore[method-assign]
    return update


@pytest.mark.parametrize("extras", [{}, dict(srl=None, curiosity=None)], ids=["default", "off"])
def test_updates_are_made_while_workers_step(extras: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    """Every update but the last falls between sending the actions and fetching the results; none is lost."""
    venv = SubprocVecEnv([PixelBox] * 2)
    try:
        model = tiny_model("CnnPolicy", venv, overlap=True, **extras)
        waiting, training_modes = [], []
        sample = model.replay_buffer.sample

        def watched(*arguments: Any, **kwargs: Any) -> Any:
            waiting.append(venv.waiting)
            return sample(*arguments, **kwargs)

        def step(locals_: dict[str, Any], _: Any) -> bool:
            training_modes.append(model.policy.training)
            return True

        monkeypatch.setattr(model.replay_buffer, "sample", watched)
        model.learn(40, callback=step)
        # Two environments: after steps 12, 14, ... 40, two updates each.
        assert waiting == [True] * 28 + [False] * 2
        assert model._n_updates == 30
        assert not any(training_modes)
        # Outside of `learn` an update is made at once.
        model.train(3, 8)
        assert model._n_updates == 33
    finally:
        venv.close()


def test_overlapped_updates_lag_one_step_behind(counting: SubprocVecEnv) -> None:
    """The update after step t is made during step t + 1, on the data of step t."""
    seen: list[tuple[int, int]] = []
    model = tiny_model("MlpPolicy", counting, overlap=True)
    update = model._update
    model._update = lambda *arguments: (  # type: ignore[method-assign]
        seen.append((model.num_timesteps, model.replay_buffer.size())) or update(*arguments)
    )
    model.learn(15)
    assert seen == [(n, n) for n in range(11, 16)]


def test_interrupted_overlap_leaves_usable_environments(counting: SubprocVecEnv) -> None:
    """The next ``learn`` begins an episode, as the environments have made a step that was not stored."""
    model = tiny_model("MlpPolicy", counting, overlap=True)
    update = interrupt(model, at=20)
    with pytest.raises(KeyboardInterrupt):
        model.learn(40)
    model._update = update  # type: ignore[method-assign]
    model.learn(20, reset_num_timesteps=False)
    buffer: Any = model.replay_buffer
    stored = np.s_[: buffer.size()]
    assert (buffer.next_observations[stored] - buffer.observations[stored] == 1).all()
    assert model._n_updates == 29 and not counting.waiting


def test_interrupt_is_raised_although_it_ended_the_workers() -> None:
    """As Ctrl-C in a terminal does to those of SB3."""
    venv = SubprocVecEnv([Counting])
    model = tiny_model("MlpPolicy", venv, overlap=True)

    def interrupted(*arguments: Any) -> None:
        for process in venv.processes:
            process.kill()
            process.join()
        raise KeyboardInterrupt

    model._update = interrupted  # type: ignore[assignment, method-assign]
    with pytest.raises(KeyboardInterrupt):
        model.learn(20)
    venv.remotes[0].close()


def test_callbacks_at_the_end_see_all_updates(counting: SubprocVecEnv) -> None:
    """What is saved when training ends holds the last step's updates and the burst."""

    class AtTheEnd(BaseCallback):
        def _on_step(self) -> bool:
            return True

        def _on_training_end(self) -> None:
            self.n_updates = self.model._n_updates

    callback = AtTheEnd()
    tiny_model("MlpPolicy", counting, overlap=True, warmup_updates=5).learn(12, callback=callback)
    assert callback.n_updates == 5 + 2


def test_pictures_of_an_update_do_not_read_from_stepping_workers(tmp_path: Path) -> None:
    """Their answer would be that to the step."""
    venv = SubprocVecEnv([PixelBox])
    try:
        tiny_model("CnnPolicy", venv, overlap=True, tensorboard_log=str(tmp_path)).learn(20, log_interval=1)
        (folder,) = tmp_path.iterdir()
        assert EventAccumulator(str(folder)).Reload().Tags()["images"] == ["srl/reconstructions"]
    finally:
        venv.close()


def test_overlap_needs_worker_processes(counting: SubprocVecEnv, tmp_path: Path) -> None:
    """Refused by ``learn``; an archive loads with any environment, to predict."""
    tiny_model("MlpPolicy", counting, overlap=True).save(tmp_path / "model")
    loaded = CuReSAC.load(tmp_path / "model", env=Counting())
    with pytest.raises(ValueError, match="overlap=True needs environments in other processes"):
        loaded.learn(5)
    CuReSAC.load(tmp_path / "model", env=Counting(), overlap=False).learn(5)


class CountReads(TorchDispatchMode):
    """Counts operations that hand a tensor's value to Python: on a GPU each waits for all work to end."""

    READS = ("_local_scalar_dense", "nonzero", "equal", "is_nonzero", "masked_select")

    def __init__(self) -> None:
        super().__init__()
        self.reads: list[str] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = func.__name__.split(".")[0]
        if name in self.READS:
            self.reads.append(name)
        return func(*args, **(kwargs or {}))


@pytest.mark.parametrize("update", ["sequential", "joint"])
@pytest.mark.parametrize("srl", ["rae", "curl"])
def test_updates_never_read_a_value_from_the_device(srl: str, update: str) -> None:
    """Values are read in bulk when ``train`` ends."""
    model = tiny_model("CnnPolicy", PixelBox(), srl=srl, update=update).learn(20)
    model._guard.deferred = True  # as on a GPU
    with CountReads() as counter:
        model.train(4, 8)
        assert counter.reads == []
        float(th.ones(1))
    assert counter.reads == ["_local_scalar_dense"]
