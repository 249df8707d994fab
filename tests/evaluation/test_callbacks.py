"""Videos, reconstructions and maps show what they promise, of any SB3 algorithm, and do not change the training."""

import random
import sys
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import gymnasium as gym
import imageio.v2 as imageio
import numpy as np
import pytest
import torch as th
from dictionaries_for_tests import SensorBox
from envs_for_tests import PixelBox, VectorBox, differences, tiny_model
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from matplotlib.axes import Axes
from PIL import Image
from sb3_contrib import RecurrentPPO
from stable_baselines3 import DQN, PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize

from sb3_cure import CuReSAC, evaluation, make_dmc_env
from sb3_cure.data.buffers import transitions
from sb3_cure.envs import StackFrames
from sb3_cure.evaluation import callbacks, plots
from sb3_cure.evaluation.callbacks import (
    CuriosityMapCallback,
    EvalBothCallback,
    PeriodicCallback,
    PolicyVideoCallback,
    ReconstructionCallback,
    StateProbeCallback,
)
from sb3_cure.evaluation.rollouts import Episode, binned_errors, most_uncomfortable, run_episodes, state_probe
from sb3_cure.evaluation.video import annotated_frames
from sb3_cure.persistence import ExactCheckpoint
from sb3_cure.srl import SRLHead, SRLOutput


class Filmed(gym.Wrapper):
    """Renders the dot's position as a light square on black, 64 x 48."""

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": 12}
    render_mode = "rgb_array"

    def render(self) -> Any:
        frame = np.zeros((48, 64, 3), np.uint8)
        row, column = ((self.unwrapped.position + 1) / 2 * (40, 56)).astype(int)
        frame[row : row + 8, column : column + 8] = 200
        return frame


class Silent(SRLHead):
    """A head that learns and does not draw."""

    def loss(self, batch: Any, latents: th.Tensor) -> SRLOutput:
        error = latents.square().mean(dim=1)
        return SRLOutput(error.mean(), error.detach())


def names(folder: Path) -> list[str]:
    """What lies in a folder."""
    return sorted(path.name for path in folder.iterdir()) if folder.exists() else []


def position(env: gym.Env) -> np.ndarray:
    """The true state of the tiny environments."""
    return env.unwrapped.position  # type: ignore[attr-defined]


MAP: dict[str, Any] = dict(state=position, names=["x", "y"])


def test_periods_are_counted_in_agent_steps() -> None:
    """With three environments the steps go by threes: multiples of ten are reached or passed; another learn goes on."""
    seen: list[int] = []

    class Note(PeriodicCallback):
        def on_period(self) -> None:
            seen.append(self.num_timesteps)

    model = tiny_model("MlpPolicy", DummyVecEnv([VectorBox] * 3), srl=None, curiosity=None)
    callback = Note(every=10)
    model.learn(45, callback=callback)
    assert seen == [12, 21, 30, 42]
    model.learn(12, callback=callback, reset_num_timesteps=False)
    assert seen == [12, 21, 30, 42, 51]
    with pytest.raises(NotImplementedError, match="PeriodicCallback must implement on_period"):
        model.learn(5, callback=PeriodicCallback(every=1))


def test_watching_does_not_change_the_training(tmp_path: Path) -> None:
    """All callbacks, with stochastic policies, decoders and CURL's negatives chosen anew: equal bits afterwards."""
    models = []
    for watched in (False, True):
        callbacks: list[BaseCallback] = []
        if watched:
            env = Filmed(PixelBox())
            callbacks = [
                PolicyVideoCallback(env, tmp_path, 15, deterministic=False),
                ReconstructionCallback(tmp_path, 15, decoder_updates=2),
                CuriosityMapCallback(env, tmp_path, 15, n_episodes=1, deterministic=False, **MAP),
                StateProbeCallback(env, tmp_path, 15, n_episodes=2, **MAP),
            ]
        model = tiny_model("CnnPolicy", PixelBox(), srl="curl", srl_kwargs=dict(bank_size=12))
        models.append(model.learn(40, callback=callbacks))
    assert names(tmp_path) == sorted(
        [f"{actor}_policy_{steps}_steps.mp4" for actor in ("task", "curious") for steps in (15, 30)]
        + [f"curiosity_map_{steps}_steps.png" for steps in (15, 30)]
        + ["reconstructions.png", "state_probe.csv", "state_probe.png"]
    )
    assert differences(models[0].get_parameters(), models[1].get_parameters()) == []


class Careless(Filmed):
    """Draws from generators that it shares with all others."""

    def reset(self, **kwargs: Any) -> Any:
        random.random(), np.random.random(), th.rand(1)
        return super().reset(**kwargs)


@pytest.mark.parametrize("every", [15, 1000], ids=["watched", "looked at before training alone"])
def test_watched_environments_may_draw_from_common_generators(every: int, tmp_path: Path) -> None:
    """The training draws from them as if nobody watched."""
    drawn = []
    for watched in (False, True):
        env, callbacks = Careless(PixelBox()), []
        if watched:
            callbacks = [
                EvalBothCallback(env, every, n_episodes=1),
                PolicyVideoCallback(env, tmp_path, every),
                CuriosityMapCallback(env, tmp_path, every, n_episodes=1, **MAP),
            ]
        tiny_model("CnnPolicy", PixelBox()).learn(20, callback=callbacks)
        drawn.append((random.random(), np.random.random(), float(th.rand(1))))
    assert drawn[0] == drawn[1]


@pytest.mark.parametrize(
    ("make", "env"),
    [
        (lambda env: SAC("MlpPolicy", env, learning_starts=10, policy_kwargs=dict(net_arch=[8])), VectorBox),
        (lambda env: PPO("MlpPolicy", env, n_steps=16, batch_size=16), VectorBox),
        (lambda env: RecurrentPPO("MlpLstmPolicy", env, n_steps=16, batch_size=16), VectorBox),
        (lambda env: PPO("CnnPolicy", env, n_steps=16, batch_size=16, n_epochs=1), PixelBox),
    ],
    ids=["SAC", "PPO", "RecurrentPPO", "PPO from pixels"],
)
def test_any_algorithm_can_be_filmed(
    make: Callable[[Any], BaseAlgorithm], env: type[VectorBox], tmp_path: Path
) -> None:
    """An episode of 20 steps in 20 frames that change, with a caption and, without an SRL head, no error."""
    callback = PolicyVideoCallback(Filmed(env()), tmp_path / "videos", every=20, seed=1)
    make(env()).learn(30, callback=callback)
    assert names(tmp_path / "videos") == ["task_policy_20_steps.mp4"]
    with imageio.get_reader(tmp_path / "videos" / "task_policy_20_steps.mp4") as video:
        assert video.get_meta_data()["fps"] == 12
        frames = np.stack([np.asarray(frame) for frame in video])
    assert frames.shape[0] == 20 and frames.shape[2] == 256
    camera, caption = frames[:, :192].astype(int), frames[:, 192:].astype(int)
    assert np.abs(camera[0] - camera[-1]).max() > 100
    assert (caption < 80).any() and not is_red(caption).any()


def is_red(pictures: np.ndarray) -> np.ndarray:
    """Where pixels have about the colour of the error's curve."""
    pictures = pictures.astype(int)
    return (pictures[..., 0] > 150) & (pictures[..., 1] < 120) & (pictures[..., 2] < 120)


def test_video_shows_both_policies_with_their_errors(tmp_path: Path) -> None:
    """Decoded, each video shows the frames of that policy's episode; below, the curve grows from frame to frame."""
    env = Filmed(PixelBox())
    model = tiny_model("CnnPolicy", PixelBox())
    model.learn(20, callback=PolicyVideoCallback(env, tmp_path, every=20, seed=4, fps=5))
    # The update after the last step came after the film.
    for actor in ("task", "curious"):
        frames = np.stack(imageio.mimread(tmp_path / f"{actor}_policy_20_steps.mp4", memtest=False))
        assert len(frames) == 20
        (episode,) = run_episodes(model, env, 1, actor, seed=4, render=True)
        first = episode.frames[0].repeat(4, axis=0).repeat(4, axis=1).astype(int)
        assert np.abs(frames[0, :192] - first).mean() < 5
        red = is_red(frames[:, 192:]).any(axis=1).sum(axis=1)  # columns of the panel with red in them
        assert red[-1] > red[0]
        assert not is_red(frames[:, :192]).any()


def test_overlay_shows_the_error_and_leaves_the_picture_alone() -> None:
    """Another error changes pixels of the panel from its step on, and none of the camera's picture."""
    frames = [np.full((48, 64, 3), 10 * step, np.uint8) for step in range(6)]
    errors = np.array([0.1, 0.2, 0.3, 0.2, 1.0, 0.4])
    changed = errors.copy()
    changed[3] = 0.9

    def pictures(errors: np.ndarray) -> np.ndarray:
        return np.stack(list(annotated_frames(Episode(np.ones(6), errors, np.zeros(6), frames), action_repeat=4)))

    plain, other, without = pictures(errors), pictures(changed), pictures(np.zeros(0))
    assert plain.shape[1] % 2 == 0 == plain.shape[2] % 2
    for shown in (plain, other, without):
        np.testing.assert_array_equal(shown[:, :192:4, ::4], np.stack(frames))
    differs = (plain != other).any(axis=-1)
    assert not differs[:3].any() and differs[3:, 192:].any(axis=(1, 2)).all()
    assert is_red(plain[:, 192:]).any(axis=(1, 2)).all() and not is_red(without).any()
    # The dot at the end of the curve, right of all that is red below the text, is the higher the higher the error is.
    heights = []
    for picture in plain:
        rows, columns = np.nonzero(is_red(picture[226:]))
        heights.append(-rows[columns == columns.max()].mean())
    assert heights[1] == heights[3] and (np.diff(np.array(heights)[[0, 1, 2, 5, 4]]) > 0).all()


@given(
    title=st.text("cure_sac-ae, swingup", min_size=60, max_size=160),
    reward=st.sampled_from([1.0, -1e15]),
    width=st.sampled_from([64, 130, 300]),
)
@settings(max_examples=25, deadline=None)
def test_text_of_a_video_fits(title: str, reward: float, width: int) -> None:
    """Nothing is cut off at the right: there is a margin, the end of the title is seen, pictures are of one size."""
    frames = [np.zeros((40, width, 3), np.uint8)] * 3

    def pictures(end: str) -> np.ndarray:
        episode = Episode(np.array([reward, 0, -reward]), np.zeros(0), np.zeros(3), frames)
        return np.stack(list(annotated_frames(episode, action_repeat=8, title=title + end)))

    one, other = pictures("A"), pictures("B")
    top = 40 * -(-256 // width)
    assert (one[:, top:, -(one.shape[2] // 64) :] > 250).all() and (one[:, top:] < 80).any()
    assert one.shape != other.shape or (one != other).any()


def test_long_numbers_in_a_video_fit() -> None:
    """A large SRL error is written in full, as it is smaller."""
    frames = [np.zeros((40, 64, 3), np.uint8)] * 2
    errors = [np.array([1.0, 123_456_789_012_345.25 + more]) for more in (0, 0.25)]
    one, other = (list(annotated_frames(Episode(np.ones(2), each, np.zeros(2), frames)))[-1] for each in errors)
    text = slice(160, 160 + 2 * 16)
    assert (one[text, -4:] > 250).all() and (one[text] != other[text]).any(), "the last digits are seen"


def test_reconstructions_are_of_the_same_observations_over_training(tmp_path: Path) -> None:
    """Each row is what the head draws then of the observations of the first row, newest frames only."""
    model = tiny_model("CnnPolicy", PixelBox(frame_stack=2))
    callback = ReconstructionCallback(tmp_path, every=15, columns=5)
    model.learn(40, callback=callback)
    assert [steps for steps, _ in callback.rows] == [15, 30]
    chosen = callback.observations.copy()
    assert len(chosen) == 5
    stored = transitions(model.replay_buffer, np.arange(15), np.zeros(15, int)).observations.numpy()
    assert all((observation == stored).all(axis=(1, 2, 3)).any() for observation in chosen)
    height = np.asarray(Image.open(tmp_path / "reconstructions.png")).shape[0]
    callback.on_period()
    np.testing.assert_array_equal(callback.observations, chosen)
    with th.no_grad():
        drawn = model.policy.srl.reconstruct(model.policy.encode(th.as_tensor(chosen)))
    np.testing.assert_array_equal(callback.rows[-1][1], drawn[:, 3:])
    assert not np.array_equal(callback.rows[0][1], callback.rows[-1][1])
    picture = np.asarray(Image.open(tmp_path / "reconstructions.png").convert("L"))
    assert picture.shape[0] > height and picture.std() > 5


def test_given_observations_are_drawn_from_the_start_and_rows_thinned_out(tmp_path: Path) -> None:
    """The first row is the untrained model's; the picture stays as high as ``max_rows`` rows."""
    env = PixelBox()
    observations = np.stack([env.reset(seed=seed)[0] for seed in range(3)])
    callback = ReconstructionCallback(tmp_path, every=4, observations=observations, max_rows=3)
    heights = []

    class Measure(BaseCallback):
        def _on_step(self) -> bool:
            heights.append(Image.open(tmp_path / "reconstructions.png").size[1])
            return True

    tiny_model("CnnPolicy", env).learn(20, callback=[callback, Measure()])
    assert [steps for steps, _ in callback.rows] == [0, 4, 8, 12, 16, 20]
    assert heights[0] < heights[4] < heights[8] == heights[-1]


def test_a_resumed_training_draws_no_more_rows(tmp_path: Path) -> None:
    """With a head that needs a decoder there is no row of the untrained model, nor one of the moment of resuming."""
    env = PixelBox()
    observations = np.stack([env.reset(seed=seed)[0] for seed in range(3)])

    class Stop(BaseCallback):
        def _on_step(self) -> bool:
            if self.num_timesteps == 13:
                raise InterruptedError
            return True

    def watching(folder: str) -> ReconstructionCallback:
        return ReconstructionCallback(tmp_path / folder, 15, observations, decoder_updates=1)

    def checkpoints() -> ExactCheckpoint:
        return ExactCheckpoint(save_freq=5, path=tmp_path / "checkpoints")

    curl: dict[str, Any] = dict(srl="curl", srl_kwargs=dict(bank_size=12))
    whole, first, second = watching("whole"), watching("parts"), watching("parts")
    tiny_model("CnnPolicy", PixelBox(), **curl).learn(31, callback=whole)
    with pytest.raises(InterruptedError):
        tiny_model("CnnPolicy", PixelBox(), **curl).learn(31, callback=[checkpoints(), first, Stop()])
    CuReSAC.resume(tmp_path / "checkpoints", PixelBox()).learn(31, callback=[checkpoints(), second])
    assert [steps for steps, _ in second.rows] == [steps for steps, _ in whole.rows] == [15, 30]
    for (_, drawn), (_, other) in zip(whole.rows, second.rows, strict=True):
        np.testing.assert_array_equal(drawn, other)


def test_heads_that_do_not_draw_get_a_decoder(tmp_path: Path) -> None:
    """A decoder fitted to the latents draws; without it nothing is written, and that is said."""
    model = tiny_model("CnnPolicy", PixelBox(frame_stack=1), srl=Silent)
    fitted = ReconstructionCallback(tmp_path / "fitted", every=25, decoder_updates=30)
    refused = ReconstructionCallback(tmp_path / "none", every=5, decoder_updates=0)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model.learn(26, callback=[fitted, refused])
    said = [str(warning.message) for warning in caught if "does not reconstruct" in str(warning.message)]
    assert said and "Silent does not reconstruct" in said[0]
    assert names(tmp_path) == ["fitted"] and names(tmp_path / "fitted") == ["reconstructions.png"]
    observed = fitted.observations.astype(float)
    untouched = np.abs(observed - 128).mean()  # what an untrained decoder is off by: it draws grey
    assert np.abs(fitted.rows[-1][1] - observed).mean() < 0.75 * untouched


class Compass(gym.ActionWrapper):
    """Steps to one of four sides, for algorithms with discrete actions."""

    def __init__(self, env: gym.Env):
        super().__init__(env)
        self.action_space = gym.spaces.Discrete(4)

    def action(self, action: int) -> np.ndarray:
        return np.array([(-1, 0), (1, 0), (0, -1), (0, 1)][action], np.float32)


SAC_ARGUMENTS: dict[str, Any] = dict(learning_starts=30, batch_size=8, buffer_size=100, seed=0)
PPO_ARGUMENTS: dict[str, Any] = dict(n_steps=16, batch_size=16, n_epochs=1, seed=0)


@pytest.mark.parametrize(
    "make",
    [
        lambda: SAC("CnnPolicy", PixelBox(), policy_kwargs=dict(net_arch=[8]), **SAC_ARGUMENTS),
        pytest.param(
            lambda: DQN("CnnPolicy", Compass(PixelBox()), seed=0, learning_starts=10, buffer_size=100),
            marks=pytest.mark.long,
        ),
        pytest.param(lambda: PPO("CnnPolicy", PixelBox(), **PPO_ARGUMENTS), marks=pytest.mark.long),
        lambda: PPO("CnnPolicy", PixelBox(), policy_kwargs=dict(share_features_extractor=False), **PPO_ARGUMENTS),
        lambda: RecurrentPPO("CnnLstmPolicy", PixelBox(), **PPO_ARGUMENTS),
        lambda: CuReSAC("CnnPolicy", PixelBox(), srl=None, curiosity=None, **SAC_ARGUMENTS),
    ],
    ids=["SAC", "DQN", "PPO", "PPO, nothing shared", "RecurrentPPO", "CuReSAC as SAC"],
)
def test_latents_of_any_algorithm_are_drawn(make: Callable[[], BaseAlgorithm], tmp_path: Path) -> None:
    """A decoder makes pictures of its features, another for each observation; training is as without pictures."""
    callback = ReconstructionCallback(tmp_path, every=20, columns=5, decoder_updates=30)
    watched, alone = make().learn(48, callback=callback), make().learn(48)
    assert [steps for steps, _ in callback.rows] == [20, 40] and names(tmp_path) == ["reconstructions.png"]
    observed, drawn = callback.observations[:, -3:].astype(float), callback.rows[-1][1]
    different = len(np.unique(callback.observations, axis=0))
    assert different >= 3, "of different times"
    assert np.abs(drawn - observed).mean() < 0.75 * np.abs(observed - 128).mean(), "no grey"
    assert len(np.unique(drawn, axis=0)) == different, "of different latents"
    assert differences(watched.get_parameters(), alone.get_parameters()) == []


def test_the_latest_observations_serve_where_there_is_no_replay_buffer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The last ``LATEST``, of all environments, each as it was acted upon; whatever the rollouts call what follows."""

    class Renamed(PPO):
        def collect_rollouts(self, env: Any, callback: BaseCallback, *args: Any, **kwargs: Any) -> bool:
            update_locals = callback.update_locals
            callback.update_locals = lambda found: update_locals({**found, "new_obs": None})  # type: ignore[method-assign]
            return super().collect_rollouts(env, callback, *args, **kwargs)

    monkeypatch.setattr(callbacks, "LATEST", 12)
    model = Renamed("CnnPolicy", DummyVecEnv([PixelBox] * 2), **PPO_ARGUMENTS)
    callback = ReconstructionCallback(tmp_path, every=20, columns=40, decoder_updates=1)
    seen: list[np.ndarray] = []

    class Note(BaseCallback):
        def _on_step(self) -> bool:
            seen.extend(self.locals["obs_tensor"].numpy().copy() if self.num_timesteps <= 20 else [])
            return True

    model.learn(32, callback=[Note(), callback])
    assert len(seen) == 20 and len(callback.observations) == 40
    stored = np.stack(seen[-12:])
    np.testing.assert_array_equal(np.unique(callback.observations, axis=0), np.unique(stored, axis=0))


@pytest.mark.parametrize("frames", [1, 2])
def test_the_newest_frame_of_a_stack_is_shown(frames: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In colour, where SB3 stacks, and around environments that stack."""
    shown: list[np.ndarray] = []
    monkeypatch.setattr(plots, "reconstructions_over_training", lambda _, observed, *__: shown.append(observed))
    env = VecFrameStack(DummyVecEnv([lambda: PixelBox(frame_stack=frames)]), 3)
    callback = ReconstructionCallback(tmp_path, every=20, columns=4, decoder_updates=1)
    PPO("CnnPolicy", env, **PPO_ARGUMENTS).learn(32, callback=callback)
    np.testing.assert_array_equal(shown[0], callback.observations[:, -3:])


def test_reconstructions_that_improve_are_seen_to(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Their errors are small: .00038 and .00035 would both be .0004."""
    labels: list[str] = []
    set_yticks = Axes.set_yticks
    monkeypatch.setattr(Axes, "set_yticks", lambda self, at, names: (labels.extend(names), set_yticks(self, at, names)))
    observed = np.zeros((1, 1, 10, 10), np.uint8)
    drawn = np.full_like(observed, 5)
    better = drawn.copy()
    better[..., :1, :] = 0
    plots.reconstructions_over_training(tmp_path / "rows.png", observed, [(10, drawn), (20, better)], "title")
    assert labels == ["seen by the agent", "10 agent steps\nMSE 0.00038", "20 agent steps\nMSE 0.00035"]


def test_map_counts_the_steps_of_each_policy(tmp_path: Path) -> None:
    """What was visited is what the policies visit in the same episodes, with their errors."""
    env = PixelBox()
    model = tiny_model("CnnPolicy", PixelBox())
    callback = CuriosityMapCallback(
        env, tmp_path, every=20, n_episodes=2, seed=3, actors=("curious", "random"), bins=5, **MAP
    )
    model.learn(25, callback=callback)
    assert names(tmp_path) == ["curiosity_map_20_steps.png"]
    callback.on_period()
    assert list(callback.visits) == ["curious", "random"]
    for actor, (states, errors) in callback.visits.items():
        episodes = list(run_episodes(model, PixelBox(), 2, actor, seed=3, states=position))
        assert states.shape == (40, 2) and errors.shape == (40,)
        np.testing.assert_array_equal(errors, np.concatenate([episode.srl_errors for episode in episodes]))
        if actor == "curious":  # random actions come from each environment's own space
            np.testing.assert_array_equal(states, np.concatenate([episode.states for episode in episodes]))
    assert np.asarray(Image.open(tmp_path / "curiosity_map_25_steps.png").convert("L")).std() > 5


@pytest.mark.parametrize("srl", ["rae", pytest.param("curl", marks=pytest.mark.long)])
def test_images_with_the_channels_last(srl: str, tmp_path: Path) -> None:
    """SB3 moves the channels for training: policies are watched, and errors measured, as if they had come first."""
    seen: list[dict[str, Any]] = []
    for last in (False, True):
        env = PixelBox(channels_last=last)
        folder = tmp_path / str(last)
        evaluation = EvalBothCallback(env, eval_freq=20, n_episodes=1, seed=0)
        film = PolicyVideoCallback(Filmed(PixelBox(channels_last=last)), folder, every=20, seed=4)
        curiosity_map = CuriosityMapCallback(env, folder, every=20, n_episodes=1, seed=0, bins=5, **MAP)
        model = tiny_model("CnnPolicy", PixelBox(channels_last=last), srl=srl)
        model.learn(25, callback=[evaluation, film, curiosity_map])
        kinds = ["curiosity_map_20_steps.png", "curious_policy_20_steps.mp4", "task_policy_20_steps.mp4"]
        assert names(folder) == kinds
        (episode,) = run_episodes(model, env, 1, seed=0)
        seen.append({"history": evaluation.history, "errors": episode.srl_errors, "images": episode.observations})
    assert len(seen[0]["history"]) == 1 and differences(*seen) == []


def test_states_that_are_not_finite_are_left_out_of_a_map(tmp_path: Path) -> None:
    """A callback that only draws ends no training; without any state there is no picture."""
    places: list[np.ndarray] = []

    def at_times(env: gym.Env) -> np.ndarray:
        places.append(position(env))
        return places[-1] * (np.nan if len(places) % 4 == 0 else 1.0)

    model = tiny_model("CnnPolicy", PixelBox())
    callback = CuriosityMapCallback(PixelBox(), tmp_path, every=20, n_episodes=1, state=at_times, names=["x", "y"])
    with pytest.warns(UserWarning, match="leaves out 5 of 20 states of the task policy"):
        model.learn(25, callback=callback)
    assert names(tmp_path) == ["curiosity_map_20_steps.png"]
    states, errors = callback.visits["task"]
    assert len(states) == len(errors) == 15 and np.isfinite(states).all()
    nowhere = CuriosityMapCallback(
        PixelBox(), tmp_path / "none", every=20, n_episodes=1, state=lambda env: np.full(2, np.nan), names=["x", "y"]
    )
    with pytest.warns(UserWarning, match="leaves out 20 of 20 states"):
        tiny_model("CnnPolicy", PixelBox()).learn(25, callback=nowhere)
    assert not (tmp_path / "none").exists() or names(tmp_path / "none") == []


def test_map_of_an_algorithm_without_errors(tmp_path: Path) -> None:
    """SB3's PPO has visits and no errors: the picture has one column instead of two."""
    callback = CuriosityMapCallback(VectorBox(), tmp_path, every=16, n_episodes=1, **MAP)
    PPO("MlpPolicy", VectorBox(), n_steps=16, batch_size=16).learn(16, callback=callback)
    both = CuriosityMapCallback(VectorBox(), tmp_path, every=20, n_episodes=1, actors=["task"], **MAP)
    tiny_model("MlpPolicy", VectorBox(), srl="rae").learn(20, callback=both)
    one, two = (Image.open(tmp_path / f"curiosity_map_{steps}_steps.png").size for steps in (16, 20))
    assert one[1] == two[1] and one[0] == pytest.approx(two[0] / 2, rel=0.1)
    borders = np.asarray(Image.open(tmp_path / "curiosity_map_16_steps.png").convert("L"))[:, [0, -1]]
    assert (borders == 255).all()  # of the title nothing is cut off


def test_map_of_a_dm_control_task_needs_no_names(tmp_path: Path) -> None:
    """Joints and suitable coordinates come from the physics; another pair can be named."""
    env = make_dmc_env("cartpole", "swingup", image_size=36, renderer="fast", action_repeat=50)
    model = tiny_model("CnnPolicy", env)
    callback = CuriosityMapCallback(env, tmp_path, every=5, n_episodes=1)
    assert callback.coordinates == ("hinge_1", "hinge_1_velocity") and callback.units[1] == "rad"
    callback.init_callback(model)
    callback.on_period()
    assert callback.visits["task"][0].shape == (20, 4)
    other = CuriosityMapCallback(env, tmp_path, every=5, coordinates=("slider", "hinge_1"))
    assert other.coordinates == ("slider", "hinge_1")
    with pytest.raises(ValueError, match=r"coordinates are \('pole', 'hinge_1'\).*choose of slider, hinge_1, slider_v"):
        CuriosityMapCallback(env, tmp_path, coordinates=("pole", "hinge_1"))
    env.close()


def test_state_probe_over_training(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A row of the untrained encoder, then one each time, of the same episodes; logged, written, and drawn."""
    drawn: list[Any] = []
    monkeypatch.setattr(plots, "state_probe_bars", lambda path, probes, title: drawn.append(probes))
    model = tiny_model("CnnPolicy", PixelBox())
    callback = StateProbeCallback(PixelBox(), tmp_path, every=15, n_episodes=3, **MAP)
    untrained = tiny_model("CnnPolicy", PixelBox())
    model.learn(35, callback=callback, log_interval=1)
    rows = [line.split(",") for line in (tmp_path / "state_probe.csv").read_text().splitlines()]
    assert rows[0] == ["timesteps", "x", "y"] and [row[0] for row in rows[1:]] == ["0", "15", "30"]
    for trained, row in ((untrained, callback.rows[0]), (model, None)):
        episodes = list(run_episodes(trained, PixelBox(), 3, "random", states=position, seed=0))
        expected = state_probe(trained, episodes, ["x", "y"])
        if row is None:
            callback.on_period()
            row = callback.rows[-1]
            logged = model.logger.name_to_value
            assert (logged["probe/x"], logged["probe/y"]) == (row["x"], row["y"])
            assert logged["probe/mean"] == pytest.approx((row["x"] + row["y"]) / 2)
        assert [row["x"], row["y"]] == pytest.approx([expected["x"], expected["y"]])
    assert [list(probes) for probes in drawn][-2] == ["0 agent steps", "30 agent steps"]
    assert drawn[-2]["30 agent steps"] == {"x": callback.rows[2]["x"], "y": callback.rows[2]["y"]}
    with pytest.raises(ValueError, match="state and names belong together"):
        StateProbeCallback(PixelBox(), tmp_path, state=position)


def test_bars_of_a_state_probe(tmp_path: Path) -> None:
    """Any number of probes; what is far below zero or unknown still has its number beside it."""
    found = {"a": 0.9, "b_velocity": -7.0, "c": np.nan}
    plots.state_probe_bars(tmp_path / "one.png", {"now": found}, "title")
    plots.state_probe_bars(tmp_path / "two.png", {"first": found, "now": found}, "title")
    one, two = (np.asarray(Image.open(tmp_path / f"{name}.png").convert("L")) for name in ("one", "two"))
    assert one.std() > 5 and two.shape[0] > one.shape[0] and two.shape[1] == one.shape[1]


@given(
    states=arrays(np.float64, st.tuples(st.integers(1, 60), st.just(2)), elements=st.floats(-5, 5)),
    bins=st.tuples(st.integers(1, 7), st.integers(1, 7)),
    span=st.tuples(st.floats(-6, 0), st.floats(0.1, 6)),
)
@settings(max_examples=60, deadline=None)
def test_bins_hold_every_step_once(states: np.ndarray, bins: tuple[int, int], span: tuple[float, float]) -> None:
    """Visits add up to the steps, also of those outside of the grid; means times visits add up to all errors."""
    edges = np.linspace(*span, bins[0] + 1), np.linspace(*span, bins[1] + 1)
    errors = np.arange(1.0, len(states) + 1)
    visits, means = binned_errors(states, errors, edges)
    assert visits.shape == means.shape == bins
    assert visits.sum() == len(states)
    np.testing.assert_array_equal(np.isnan(means), visits == 0)
    assert np.nansum(means * visits) == pytest.approx(errors.sum())
    inside = [np.clip(states[:, axis], edges[axis][0], edges[axis][-1]) for axis in (0, 1)]
    cells = [
        np.minimum(np.searchsorted(edges[axis], inside[axis], side="right") - 1, bins[axis] - 1) for axis in (0, 1)
    ]
    brute = np.zeros(bins)
    for cell in zip(*cells, strict=True):
        brute[cell] += 1
    np.testing.assert_array_equal(visits, brute)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda env, path: PolicyVideoCallback(env.env, path), "render_mode=None: make it with 'rgb_array'"),
        (lambda env, path: CuriosityMapCallback(env, path), "has no physics of dm_control"),
        (lambda env, path: CuriosityMapCallback(env, path, state=position), "state and names belong together"),
        (lambda env, path: CuriosityMapCallback(env, path, names=["x", "y"]), "state and names belong together"),
        (lambda env, path: CuriosityMapCallback(env, path, state=position, names=["x"]), "a map needs two"),
        (lambda env, path: CuriosityMapCallback(env, path, coordinates=("x", "z"), **MAP), "choose of x, y"),
    ],
)
def test_what_cannot_be_drawn_is_refused(make: Callable[..., BaseCallback], message: str, tmp_path: Path) -> None:
    """Before training starts, and nothing is written."""
    with pytest.raises(ValueError, match=message):
        make(Filmed(VectorBox()), tmp_path / "pictures")
    assert names(tmp_path) == []


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda env, path: PolicyVideoCallback(env, path, actors=["curious"]),
            r"actors are \['curious'\], but this model has task, random",
        ),
        (
            lambda env, path: CuriosityMapCallback(env, path, actors=["best"], **MAP),
            r"actors are \['best'\], but this model has task, random",
        ),
        (
            lambda env, path: ReconstructionCallback(path),
            "needs a policy of images of uint8",
        ),
    ],
)
def test_callbacks_that_do_not_fit_the_model_say_so(
    make: Callable[..., BaseCallback], message: str, tmp_path: Path
) -> None:
    """When ``learn`` is called, before its first step."""
    model = SAC("MlpPolicy", VectorBox())
    with pytest.raises(ValueError, match=message):
        model.learn(5, callback=make(Filmed(VectorBox()), tmp_path))
    assert model.num_timesteps == 0


def test_images_of_another_format_are_known_before_training() -> None:
    """Height and width exchanged: the same numbers in another order."""

    class Wide(PixelBox):
        def __init__(self, shape: tuple[int, int, int]):
            super().__init__()
            self.observation_space = gym.spaces.Box(0, 255, shape, np.uint8)

        def observe(self, first: bool = False) -> np.ndarray:
            return np.zeros(self.observation_space.shape, np.uint8)

    model = tiny_model("CnnPolicy", Wide((6, 36, 48)))
    with pytest.raises(ValueError, match="make it as the training environment"):
        model.learn(5, callback=EvalBothCallback(Wide((6, 48, 36))))


def test_vectorised_evaluation_environment_is_refused() -> None:
    model = tiny_model("CnnPolicy", PixelBox())
    with pytest.raises(ValueError, match=r"eval_env is a VecEnv, .* give a gymnasium\.Env"):
        model.learn(5, callback=EvalBothCallback(DummyVecEnv([PixelBox])))  # type: ignore[arg-type]


def test_stacked_by_sb3_watched_in_one_environment() -> None:
    """In ``StackFrames``, which begins episodes as SB3 does; the unstacked one is refused."""
    single = partial(PixelBox, frame_stack=1, channels_last=True, tells_frame_stack=False)
    model = tiny_model("CnnPolicy", VecFrameStack(DummyVecEnv([single]), 3))
    with pytest.raises(ValueError, match="make it as the training environment"):
        model.learn(5, callback=EvalBothCallback(single()))
    env, theirs = StackFrames(single(), 3, padding="zeros"), VecFrameStack(DummyVecEnv([single]), 3)
    theirs.seed(0)
    for ours, [stacked] in (
        (env.reset(seed=0)[0], theirs.reset()),
        (env.step(np.ones(2))[0], theirs.step(np.ones((1, 2)))[0]),
    ):
        np.testing.assert_array_equal(ours, stacked)
    evaluation = EvalBothCallback(env, eval_freq=10, n_episodes=1, seed=0)
    model.learn(10, callback=evaluation)
    assert len(evaluation.history) == 1


def test_one_callback_serves_pretraining_and_learning() -> None:
    """By default whom each of them trains."""
    evaluation = EvalBothCallback(PixelBox(), eval_freq=10, n_episodes=1)
    tiny_model("CnnPolicy", PixelBox()).pretrain(10, callback=evaluation).learn(10, callback=evaluation)
    assert [{name for name in row if name.endswith("_reward")} for row in evaluation.history] == [
        {"eval/curious_reward"},
        {"eval/task_reward", "eval/curious_reward"},
    ]


def test_dictionaries_with_channels_last_are_watched() -> None:
    """As they are trained: SB3 moves the channels there."""
    env = SensorBox(("front", "joints"), channels_last=True)
    evaluation = EvalBothCallback(SensorBox(("front", "joints"), channels_last=True), eval_freq=10, n_episodes=1)
    tiny_model("MultiInputPolicy", env).learn(10, callback=evaluation)
    assert len(evaluation.history) == 1


def test_vectors_beside_drawn_images_are_normalised(tmp_path: Path) -> None:
    """As in training, for the decoder that is fitted, and for what is drawn."""
    env = VecNormalize(DummyVecEnv([lambda: SensorBox(("front", "joints"))]), norm_obs_keys=["joints"], clip_obs=0.01)
    model = tiny_model("MultiInputPolicy", env, srl="curl")
    seen: list[float] = []
    center = model.policy.center

    def noted(observations: Any) -> Any:
        seen.append(float(observations["joints"].abs().max()))
        return center(observations)

    model.policy.center = noted  # type: ignore[method-assign]
    model.learn(20, callback=ReconstructionCallback(tmp_path, every=10, decoder_updates=2))
    assert len(seen) > 2 and max(seen) <= 0.01


def test_observations_must_fit(tmp_path: Path) -> None:
    """Those of another shape or type are refused."""
    for wrong in (np.zeros((2, 3, 8, 8), np.uint8), np.zeros((2, 6, 36, 36), np.float32)):
        shown = ReconstructionCallback(tmp_path, observations=wrong)
        with pytest.raises(ValueError, match=r"observations must be n of Box\(0, 255, \(6, 36, 36\)"):
            tiny_model("CnnPolicy", PixelBox()).learn(5, callback=shown)


@pytest.mark.parametrize(
    ("room", "package", "make"),
    [
        ("plots", "matplotlib", lambda path: ReconstructionCallback(path)),
        ("video", "imageio", lambda path: PolicyVideoCallback(Filmed(VectorBox()), path)),
    ],
)
def test_missing_package_is_known_at_once(
    room: str, package: str, make: Callable[[Path], Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before training starts."""
    monkeypatch.delitem(sys.modules, f"sb3_cure.evaluation.{room}", raising=False)
    monkeypatch.delattr(evaluation, room, raising=False)
    for name in [name for name in sys.modules if name == package or name.startswith(f"{package}.")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ImportError, match=package):
        make(tmp_path)


def test_faulty_transitions_are_neither_shown_nor_measured(tmp_path: Path) -> None:
    """Pictures are of the others, of all environments; where all are faulty there is no picture."""
    model = tiny_model("CnnPolicy", DummyVecEnv([PixelBox] * 2)).learn(40)
    buffer = model.replay_buffer
    buffer.marked[:] = True
    buffer.marked[[3, 7], [0, 1]] = False
    callback = ReconstructionCallback(tmp_path, columns=4)
    callback.init_callback(model)
    callback.on_period()
    good = transitions(buffer, np.array([3, 3, 7, 7]), np.array([0, 0, 1, 1])).observations.numpy()
    np.testing.assert_array_equal(callback.observations[[0, -1]], good[[0, -1]])
    assert np.unique(callback.observations, axis=0).shape[0] == 2
    found = most_uncomfortable(model, k=40)
    assert len(found.errors) == 2 and sorted(found.ages.tolist()) == [2 * (buffer.pos - 8), 2 * (buffer.pos - 4)]
    buffer.marked[:] = True
    none = ReconstructionCallback(tmp_path / "none")
    none.init_callback(model)
    none.on_period()
    assert none.rows == [] and names(tmp_path / "none") == []
    with pytest.raises(ValueError, match="all its transitions are marked as faulty"):
        most_uncomfortable(model, k=40)
