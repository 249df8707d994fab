"""Updates overlap with environment steps, and never wait for the device."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from envs_for_tests import PixelBox, tiny_model
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import SubprocVecEnv
from torch.utils._python_dispatch import TorchDispatchMode

from sb3_cure import CuReSAC

# ------------------------------------------------------------- overlapped updates


@pytest.mark.parametrize("extras", [{}, dict(srl=None, curiosity=None)], ids=["all", "plain SAC"])
def test_updates_are_made_while_the_workers_step(extras: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    """Every update but the last falls between sending the actions and fetching the results; none is lost."""
    venv = SubprocVecEnv([PixelBox] * 2)
    try:
        model = tiny_model("CnnPolicy", venv, overlap=True, warmup_updates=0, **extras)
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


def test_overlapped_updates_lag_one_step_behind() -> None:
    """The update after step t is made during step t + 1, on the data of step t, and acts from step t + 2 on."""
    venv = SubprocVecEnv([PixelBox])
    try:
        seen: list[tuple[int, int]] = []
        model = tiny_model("CnnPolicy", venv, overlap=True, warmup_updates=0)
        step = model._gradient_step

        def watched(*arguments: Any) -> None:
            seen.append((model.num_timesteps, model.replay_buffer.size()))
            step(*arguments)

        model._gradient_step = watched
        model.learn(15)
        assert seen == [(n, n) for n in range(11, 16)]
    finally:
        venv.close()


def test_interrupted_overlap_leaves_usable_environments() -> None:
    """Ctrl-C falls into an update, while the workers step: the next `learn` goes on as if nothing had happened."""
    venv = SubprocVecEnv([PixelBox])
    try:
        model = tiny_model("CnnPolicy", venv, overlap=True, warmup_updates=0)
        step = model._gradient_step

        def interrupted(*arguments: Any) -> None:
            raise KeyboardInterrupt

        model._gradient_step = interrupted
        with pytest.raises(KeyboardInterrupt):
            model.learn(20)
        model._gradient_step = step
        model.learn(20, reset_num_timesteps=False)
        assert model._n_updates == 20 and not venv.waiting
    finally:
        venv.close()


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


def test_no_transition_spans_an_interrupt_while_workers_step() -> None:
    """The environments have made a step that was not stored: the next `learn` begins an episode."""
    venv = SubprocVecEnv([Counting])
    try:
        model = tiny_model("MlpPolicy", venv, overlap=True)
        step = model._gradient_step

        def interrupted(*arguments: Any) -> None:
            if model.num_timesteps == 20:
                raise KeyboardInterrupt
            step(*arguments)

        model._gradient_step = interrupted
        with pytest.raises(KeyboardInterrupt):
            model.learn(40)
        model._gradient_step = step
        model.learn(20, reset_num_timesteps=False)
        buffer = model.replay_buffer
        stored = np.s_[: buffer.size()]
        assert (buffer.next_observations[stored] - buffer.observations[stored] == 1).all()
    finally:
        venv.close()


def test_an_interrupt_is_told_although_it_has_ended_the_workers() -> None:
    """As Ctrl-C in a terminal does to those of SB3."""
    venv = SubprocVecEnv([PixelBox])
    model = tiny_model("CnnPolicy", venv, overlap=True, warmup_updates=0)

    def interrupted(*arguments: Any) -> None:
        for process in venv.processes:
            process.kill()
            process.join()
        raise KeyboardInterrupt

    model._gradient_step = interrupted
    with pytest.raises(KeyboardInterrupt):
        model.learn(20)
    venv.remotes[0].close()


def test_callbacks_at_the_end_see_all_updates() -> None:
    """What is saved when training ends holds the last step's updates and the burst."""

    class AtTheEnd(BaseCallback):
        def _on_step(self) -> bool:
            return True

        def _on_training_end(self) -> None:
            self.n_updates = self.model._n_updates

    venv = SubprocVecEnv([PixelBox])
    try:
        callback = AtTheEnd()
        tiny_model("CnnPolicy", venv, overlap=True, warmup_updates=5).learn(12, callback=callback)
        assert callback.n_updates == 5 + 2
    finally:
        venv.close()


def test_overlap_needs_worker_processes(tmp_path: Path) -> None:
    """Refused by `learn`, in one sentence; an archive loads with any environment, to predict."""
    venv = SubprocVecEnv([PixelBox])
    try:
        tiny_model("CnnPolicy", venv, overlap=True).save(tmp_path / "model")
    finally:
        venv.close()
    loaded = CuReSAC.load(tmp_path / "model", env=PixelBox())
    assert loaded.overlap
    with pytest.raises(ValueError, match=r"overlap=True .* in this process .* vec_env_cls=SubprocVecEnv"):
        loaded.learn(5)
    CuReSAC.load(tmp_path / "model", env=PixelBox(), overlap=False).learn(5)


# ------------------------------------------------------------ waiting for the device


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
    """No `.item()` in an update on a device where it would wait; the logger reads, when it writes."""
    model = tiny_model("CnnPolicy", PixelBox(), srl=srl, update=update).learn(20)
    model._guard.deferred = True  # as on a GPU
    with CountReads() as counter:
        model.train(4, 8)
    assert counter.reads == []
    # The counter does count.
    with CountReads() as counter:
        model.logger.dump(0)
    assert counter.reads
