"""Nothing of a fault is sampled: buffers never draw transitions that their infos mark."""

import os
import signal
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from envs_for_tests import KillNow, PixelBox, VectorBox, differences, tiny_model
from gymnasium import spaces
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from stable_baselines3.common.buffers import ReplayBuffer

from sb3_cure.data.buffers import FrameStackReplayBuffer, SkippingReplayBuffer, transitions
from sb3_cure.evaluation.callbacks import ReconstructionCallback
from sb3_cure.evaluation.rollouts import highest_errors
from sb3_cure.vec_env import FaultTolerantSubprocVecEnv

pytestmark = pytest.mark.filterwarnings("ignore:Environment [0-9]+ :RuntimeWarning", "ignore:.*fork:DeprecationWarning")

EVENTS = ("go on", "truncate", "terminate", "raise", "die", "black", "freeze")


class Tagged(gym.Env):
    """Each frame says where it is from: environment, process, episode, step. The action says what happens."""

    observation_space = spaces.Box(0, 255, (12, 2, 2), np.uint8)
    action_space = spaces.Box(0, len(EVENTS), (1,), np.float32)
    frame_stack = 2

    def __init__(self, index: int) -> None:
        self.index, self.episode, self.frozen = index, 0, False

    def frame(self) -> np.ndarray:
        pid = os.getpid()
        tag = [self.index + 1, self.episode, self.n_steps, pid % 256, pid // 256 % 256, pid // 65536]
        return np.broadcast_to(np.array(tag, np.uint8)[:, None, None], (6, 2, 2))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        self.n_steps, self.episode = 0, self.episode + 1
        if not self.frozen:
            self.frames = [self.frame()] * 2
        return np.concatenate(self.frames), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        event = EVENTS[int(action[0])]
        self.n_steps += 1
        if event == "raise":
            raise RuntimeError
        if event == "die":
            os.kill(os.getpid(), signal.SIGKILL)
        self.frozen |= event == "freeze"
        frame = np.zeros_like(self.frames[1]) if event == "black" else self.frame()
        self.frames = [self.frames[1], self.frames[1] if self.frozen else frame]
        return np.concatenate(self.frames), 0.0, event == "terminate", event == "truncate", {}


def clock(env: gym.Env) -> np.ndarray:
    return np.array([env.unwrapped.episode, env.unwrapped.n_steps])


def filled_buffers(events: np.ndarray, buffer_size: int) -> list[ReplayBuffer]:
    """Both kinds of buffer, fed as SB3 does it."""
    n_envs = events.shape[1]
    watch: dict[str, Any] = dict(frozen_steps=3, frozen_motion=0.5, state=clock)
    makers = [partial(Tagged, i) for i in range(n_envs)]
    env = FaultTolerantSubprocVecEnv(makers, on_env_fault="restart", start_method="fork", max_faults=100, **watch)
    arguments = (buffer_size, env.observation_space, env.action_space, "cpu", n_envs)
    both = [FrameStackReplayBuffer(*arguments, frame_stack=2), SkippingReplayBuffer(*arguments)]
    obs = env.reset()
    for row in events:
        actions = row[:, None].astype(np.float32)
        new_obs, rewards, dones, infos = env.step(actions)
        next_obs = new_obs.copy()
        for i in np.flatnonzero(dones):
            next_obs[i] = infos[i]["terminal_observation"]
        for buffer in both:
            buffer.add(obs, next_obs, actions, rewards, dones, infos)
        obs = new_obs
    env.close()
    return both


@settings(max_examples=8, deadline=None, suppress_health_check=list(HealthCheck))
@given(st.data())
def test_no_transition_that_spans_a_fault_is_sampled(data: st.DataObject) -> None:
    n_envs, n_steps = data.draw(st.integers(1, 2)), data.draw(st.integers(5, 25))
    row = st.lists(st.sampled_from([0, 0, 0, *range(len(EVENTS))]), min_size=n_envs, max_size=n_envs)
    events = np.array(data.draw(st.lists(row, min_size=n_steps, max_size=n_steps)))
    # The last steps move, so that a picture that is stuck has been noticed
    events = np.concatenate([events, np.zeros((4, n_envs), int)])
    both = filled_buffers(events, data.draw(st.sampled_from([n_envs * n_steps // 2, 1000])))
    for buffer in both:
        np.random.seed(0)
        batch = buffer.sample(500)
        tags, next_tags = (
            getattr(batch, name).numpy()[:, 6:, 0, 0].astype(int) for name in ("observations", "next_observations")
        )
        step = np.array([0, 0, 1, 0, 0, 0])
        assert np.array_equal(tags + step, next_tags)
        kinds = np.array(EVENTS)[batch.actions.numpy().astype(int).ravel()]
        assert not set(kinds) & {"raise", "die", "black", "freeze"}
        assert not batch.dones.numpy()[kinds != "terminate"].any()
    # Sharing frames changes nothing of all that
    if both[0].size() == both[1].size():
        batches = []
        for buffer in both:
            np.random.seed(1)
            batches.append(buffer.sample(200))
        assert differences(tuple(batches[0]), tuple(batches[1])) == []


def test_pictures_and_measurements_leave_out_marked_ones(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    env = FaultTolerantSubprocVecEnv([partial(PixelBox, size=36)] * 2, on_env_fault="restart", start_method="fork")
    model = tiny_model("CnnPolicy", env)
    callback = KillNow(3, 6, 9, 12)
    model.learn(40, callback=callback)
    env.close()
    buffer = model.replay_buffer
    assert callback.faults == buffer.marked.sum() == 4
    looked_at = []

    def look(buffer: Any, rows: np.ndarray, env_inds: np.ndarray, *rest: Any) -> Any:
        looked_at.append(buffer.marked[rows, env_inds])
        return transitions(buffer, rows, env_inds, *rest)

    for module in ("callbacks", "rollouts"):
        monkeypatch.setattr(f"sb3_cure.evaluation.{module}.transitions", look)
    picture = ReconstructionCallback(tmp_path, columns=10)
    picture.init_callback(model)
    buffer.marked[0, 0] = True  # one that a picture from the first to the last would begin with
    assert len(picture._spread()) == 10
    highest_errors(model, k=40)
    assert len(looked_at) > 1 and not np.concatenate(looked_at).any()
    buffer.marked[:, 0] = True
    assert len(picture._spread()) == 10 and not looked_at[-1].any(), "those of the other environment"
    buffer.marked[:] = True
    assert picture._spread() is None
    with pytest.raises(ValueError, match="the replay buffer is empty"):
        highest_errors(model, k=40)


def test_buffer_that_samples_faults_is_refused() -> None:
    """When training begins, not at the first fault."""
    venv = FaultTolerantSubprocVecEnv([VectorBox], on_env_fault="restart", start_method="fork")
    try:
        with pytest.raises(ValueError, match="NStepReplayBuffer cannot promise that faulty transitions are never"):
            tiny_model("MlpPolicy", venv, srl=None, curiosity=None, n_steps=3).learn(2)
    finally:
        venv.close()
