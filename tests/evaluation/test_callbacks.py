"""Videos, reconstructions and maps show what they promise, of any SB3 algorithm, and do not change the training."""

import io
import random
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import gymnasium as gym
import imageio.v2 as imageio
import numpy as np
import pytest
import torch as th
from dictionaries_for_tests import Goal, SensorBox, sensor_model
from envs_for_tests import PixelBox, VectorBox, differences, tiny_model
from gymnasium.wrappers import TimeLimit
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from logs_for_tests import KeptRows
from PIL import Image
from sb3_contrib import RecurrentPPO
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import HumanOutputFormat, Logger
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sb3_cure import evaluation, make_dmc_env
from sb3_cure.data.buffers import transitions
from sb3_cure.envs import StackFrames
from sb3_cure.evaluation import callbacks, diagnostics, plots
from sb3_cure.evaluation.callbacks import (
    CuriosityMapCallback,
    DiagnosticsCallback,
    EvalBothCallback,
    PeriodicCallback,
    PolicyVideoCallback,
    ReconstructionCallback,
    StateProbeCallback,
)
from sb3_cure.evaluation.probe import state_probe
from sb3_cure.evaluation.rollouts import Episode, binned_errors, run_episodes
from sb3_cure.evaluation.video import annotated_frames


class Filmed(gym.Wrapper):
    """Renders the dot's position as a light square on black, 64 x 48."""

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": 12}
    render_mode = "rgb_array"

    def render(self) -> Any:
        frame = np.zeros((48, 64, 3), np.uint8)
        row, column = ((self.unwrapped.position + 1) / 2 * (40, 56)).astype(int)
        frame[row : row + 8, column : column + 8] = 200
        return frame


def names(folder: Path) -> list[str]:
    """What lies in a folder."""
    return sorted(path.name for path in folder.iterdir()) if folder.exists() else []


def position(env: gym.Env) -> np.ndarray:
    """The true state of the tiny environments."""
    return env.unwrapped.position  # type: ignore[attr-defined]


MAP: dict[str, Any] = dict(state=position, names=["x", "y"])


def test_periods_are_counted_in_agent_steps() -> None:
    """Three environments count three steps at a time: multiples of ten are reached or passed, also in another learn."""
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


class Careless(Filmed):
    """Uses the global random number generators."""

    def reset(self, **kwargs: Any) -> Any:
        random.random(), np.random.random(), th.rand(1)
        return super().reset(**kwargs)


def test_watching_does_not_change_the_training(tmp_path: Path) -> None:
    """All callbacks, with stochastic policies, decoders, new negatives and careless environments: equal bits."""
    models = []
    for watched in (False, True):
        callbacks: list[BaseCallback] = []
        training, watching = PixelBox(), PixelBox()
        watching.action_space = training.action_space  # as where it is an attribute of the class
        if watched:
            env = Careless(watching)
            callbacks = [
                *(EvalBothCallback(env, 5, 1, actors=["task", "curious", "random"], seed=seed) for seed in (1, None)),
                PolicyVideoCallback(env, tmp_path, 11, deterministic=False),
                ReconstructionCallback(tmp_path, 11, decoder_updates=2),
                CuriosityMapCallback(env, tmp_path, 11, n_episodes=1, deterministic=False, **MAP),
                StateProbeCallback(env, 11, n_episodes=2, **MAP),
            ]
        model = tiny_model("CnnPolicy", training, srl="curl", srl_kwargs=dict(bank_size=12))
        models.append(model.learn(24, callback=callbacks))
    assert names(tmp_path) == sorted(
        [f"{actor}_policy_{steps}_steps.mp4" for actor in ("task", "curious") for steps in (11, 22)]
        + [f"curiosity_map_{steps}_steps.png" for steps in (11, 22)]
        + ["reconstructions.png"]
    )
    assert differences(models[0].get_parameters(), models[1].get_parameters()) == []


@pytest.mark.parametrize(
    ("make", "env"),
    [
        (lambda env: SAC("MlpPolicy", env, learning_starts=10, policy_kwargs=dict(net_arch=[8])), VectorBox),
        (lambda env: RecurrentPPO("MlpLstmPolicy", env, n_steps=16, batch_size=16), VectorBox),
        (lambda env: PPO("CnnPolicy", env, n_steps=16, batch_size=16, n_epochs=1), PixelBox),
    ],
    ids=["SAC", "RecurrentPPO", "PPO from pixels"],
)
def test_any_algorithm_can_be_filmed(
    make: Callable[[Any], BaseAlgorithm], env: type[VectorBox], tmp_path: Path
) -> None:
    """An episode of 20 steps in 21 frames that change, with a caption and, without an SRL head, no error."""
    callback = PolicyVideoCallback(Filmed(env()), tmp_path / "videos", every=20, seed=1)
    make(env()).learn(30, callback=callback)
    assert names(tmp_path / "videos") == ["task_policy_20_steps.mp4"]
    with imageio.get_reader(tmp_path / "videos" / "task_policy_20_steps.mp4") as video:
        assert video.get_meta_data()["fps"] == 12
        frames = np.stack([np.asarray(frame) for frame in video])
    assert frames.shape[0] == 21 and frames.shape[2] == 256
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
    model.learn(20, callback=PolicyVideoCallback(env, tmp_path, every=20, seed=4))
    # The update after the last step came after the film.
    for actor in ("task", "curious"):
        frames = np.stack(imageio.mimread(tmp_path / f"{actor}_policy_20_steps.mp4", memtest=False))
        assert len(frames) == 21
        (episode,) = run_episodes(model, env, 1, actor, seed=4, render=True)
        first = episode.frames[0].repeat(4, axis=0).repeat(4, axis=1).astype(int)
        assert np.abs(frames[0, :192] - first).mean() < 5
        red = is_red(frames[:, 192:]).any(axis=1).sum(axis=1)  # columns of the panel with red in them
        assert red[-1] > red[0]
        assert not is_red(frames[:, :192]).any()


def test_frames_show_what_the_agent_saw() -> None:
    """Not what came of its action: beside each other they would be a step apart."""
    env = PixelBox()
    env.render = lambda: env.frames[-1]  # type: ignore[method-assign]
    (episode,) = run_episodes(tiny_model("CnnPolicy", PixelBox()), env, 1, seed=4, render=True)
    np.testing.assert_array_equal(np.stack(episode.frames[:-1]), episode.observations[:, -3:])
    assert len(episode.frames) == len(episode.rewards) + 1 and (episode.frames[-1] != episode.frames[-2]).any()


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
    np.testing.assert_array_equal(callback.rows[-1][1][""], drawn[:, 3:])
    assert not np.array_equal(callback.rows[0][1][""], callback.rows[-1][1][""])
    picture = np.asarray(Image.open(tmp_path / "reconstructions.png").convert("L"))
    assert picture.shape[0] > height and picture.std() > 5


def test_reconstructions_show_all_channels_of_frames_that_the_buffer_is_told(tmp_path: Path) -> None:
    """Where the environment stacks frames, and does not say so."""
    env = PixelBox(frame_stack=2, tells_frame_stack=False)
    model = tiny_model("CnnPolicy", env, replay_buffer_kwargs=dict(frame_stack=2))
    callback = ReconstructionCallback(tmp_path, every=15, columns=2)
    model.learn(20, callback=callback)
    assert callback.rows[0][1][""].shape[1] == 3


def test_picture_has_no_more_rows_than_fit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It stays as high as ``MAX_ROWS`` rows, the first and the last among them."""
    monkeypatch.setattr(callbacks, "MAX_ROWS", 3)
    callback = ReconstructionCallback(tmp_path, every=4, columns=3)
    heights = {}

    class Measure(BaseCallback):
        def _on_step(self) -> bool:
            if self.num_timesteps % 4 == 0:
                heights[self.num_timesteps] = Image.open(tmp_path / "reconstructions.png").size[1]
            return True

    tiny_model("CnnPolicy", PixelBox()).learn(20, callback=[callback, Measure()])
    assert [steps for steps, _ in callback.rows] == list(heights) == [4, 8, 12, 16, 20]
    assert heights[4] < heights[8] < heights[12] == heights[20]


def test_the_newest_frame_of_a_stack_is_shown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In colour, of SB3's stacks, for SB3's own algorithms."""
    shown: list[np.ndarray] = []
    monkeypatch.setattr(plots, "reconstructions_over_training", lambda _, observed, *__: shown.append(observed))
    env = VecFrameStack(DummyVecEnv([lambda: PixelBox(frame_stack=1)]), 3)
    callback = ReconstructionCallback(tmp_path, every=20, columns=4, decoder_updates=1)
    SAC("CnnPolicy", env, buffer_size=100).learn(32, callback=callback)
    np.testing.assert_array_equal(shown[0], callback.observations[:, -3:])


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


def test_images_with_the_channels_last(tmp_path: Path) -> None:
    """SB3 moves the channels for training: policies are watched, and errors measured, as if they had come first."""
    seen: list[dict[str, Any]] = []
    for last in (False, True):
        env = PixelBox(channels_last=last)
        folder = tmp_path / str(last)
        evaluation = EvalBothCallback(env, eval_freq=20, n_episodes=1, seed=0)
        film = PolicyVideoCallback(Filmed(PixelBox(channels_last=last)), folder, every=20, seed=4)
        curiosity_map = CuriosityMapCallback(env, folder, every=20, n_episodes=1, seed=0, bins=5, **MAP)
        model = tiny_model("CnnPolicy", PixelBox(channels_last=last))
        model.learn(25, callback=[evaluation, film, curiosity_map])
        kinds = ["curiosity_map_20_steps.png", "curious_policy_20_steps.mp4", "task_policy_20_steps.mp4"]
        assert names(folder) == kinds
        (episode,) = run_episodes(model, env, 1, seed=0)
        seen.append({"history": evaluation.history, "errors": episode.srl_errors, "images": episode.observations})
    assert len(seen[0]["history"]) == 1 and differences(*seen) == []


def test_stacked_by_sb3_watched_in_one_environment() -> None:
    """In ``StackFrames``, which begins episodes as SB3 does; the unstacked one is refused."""
    single = partial(PixelBox, frame_stack=1, channels_last=True, tells_frame_stack=False)
    model = tiny_model("CnnPolicy", VecFrameStack(DummyVecEnv([single]), 3))
    with pytest.raises(ValueError, match="Observation spaces do not match"):
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
    """By default it evaluates the policies that each of them trains."""
    evaluation = EvalBothCallback(PixelBox(), eval_freq=10, n_episodes=1)
    tiny_model("CnnPolicy", PixelBox()).pretrain(10, callback=evaluation).learn(10, callback=evaluation)
    assert [{name for name in row if name.endswith("_reward")} for row in evaluation.history] == [
        {"eval/curious_reward"},
        {"eval/task_reward", "eval/curious_reward"},
    ]


def test_random_actions_are_evaluated_where_no_policy_is_trained() -> None:
    evaluation = EvalBothCallback(PixelBox(), eval_freq=10, n_episodes=1)
    tiny_model("CnnPolicy", PixelBox(), curiosity=None).pretrain(14, "random", callback=evaluation)
    assert evaluation.history[-1]["eval/random_srl_error"] > 0


def test_vectors_beside_drawn_images_are_normalised(tmp_path: Path) -> None:
    """As in training, for the decoder that is fitted, and for what is drawn."""
    env = VecNormalize(DummyVecEnv([lambda: SensorBox(("front", "joints"))]), norm_obs_keys=["joints"], clip_obs=0.01)
    model = tiny_model("MultiInputPolicy", env, srl="curl")
    seen: list[float] = []
    encode = model.policy.encode

    def noted(observations: Any) -> Any:
        seen.append(float(observations["joints"].abs().max()))
        return encode(observations)

    model.policy.encode = noted  # type: ignore[method-assign]
    model.learn(20, callback=ReconstructionCallback(tmp_path, every=10, decoder_updates=2))
    assert len(seen) > 2 and max(seen) <= 0.01


# ------------------------------------------------------------------ environments that do not fit


@pytest.mark.parametrize("share", [lambda env: env, Filmed, lambda env: Filmed(TimeLimit(env, 9))])
@pytest.mark.parametrize("wrap", [lambda env: env, lambda env: VecNormalize(DummyVecEnv([lambda: Monitor(env)]))])
def test_training_environment_is_refused_for_evaluation(share: Any, wrap: Any) -> None:
    """Also within wrappers: it would store transitions that never happened."""
    env = VectorBox()
    model = tiny_model("MlpPolicy", wrap(env))
    with pytest.raises(ValueError, match="EvalBothCallback evaluates in the training environment"):
        model.learn(5, callback=EvalBothCallback(share(env)))
    model.learn(5, callback=EvalBothCallback(Filmed(VectorBox()), 5, n_episodes=1))


class Wide(PixelBox):
    """Height and width exchanged: the same numbers in another order."""

    def __init__(self) -> None:
        super().__init__()
        self.observation_space = gym.spaces.Box(0, 255, (6, 18, 72), np.uint8)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda path: EvalBothCallback(Wide()), "Observation spaces do not match"),
        (lambda path: EvalBothCallback(PixelBox(low=-2)), "Action spaces do not match"),
        (lambda path: EvalBothCallback(DummyVecEnv([PixelBox])), "not a VecEnv"),  # type: ignore[arg-type]
        (lambda path: EvalBothCallback(PixelBox(), actors=["best"]), r"must be of task, random .* not \['best'\]"),
        (lambda path: PolicyVideoCallback(PixelBox(), path), "must have render_mode='rgb_array', not None"),
        (lambda path: CuriosityMapCallback(PixelBox(), path), "has no physics of dm_control"),
        (lambda path: StateProbeCallback(PixelBox(), state=position), "state and names belong together"),
        (lambda path: CuriosityMapCallback(PixelBox(), path, state=position, names=["x"]), "a map needs two"),
        (lambda path: CuriosityMapCallback(PixelBox(), path, coordinates=("x", "z"), **MAP), "two coordinates of x, y"),
    ],
)
def test_refused_before_training(make: Any, message: str, tmp_path: Path) -> None:
    """In one sentence, and nothing is written."""
    model = tiny_model("CnnPolicy", PixelBox(), curiosity=None)
    with pytest.raises(ValueError, match=message):
        model.learn(5, callback=make(tmp_path))
    assert model.num_timesteps == 0 and names(tmp_path) == []


def test_pictures_need_images(tmp_path: Path) -> None:
    """Vectors have none."""
    with pytest.raises(ValueError, match="needs a policy with an encoder of uint8 images"):
        SAC("MlpPolicy", VectorBox()).learn(5, callback=ReconstructionCallback(tmp_path))
    with pytest.raises(ValueError, match="needs a replay buffer"):
        PPO("CnnPolicy", PixelBox()).learn(5, callback=ReconstructionCallback(tmp_path))


@pytest.mark.parametrize("srl", ["rae", "curl"])
def test_each_image_has_a_picture_of_reconstructions(srl: str, tmp_path: Path) -> None:
    """Drawn by its head, or by a decoder that is fitted afterwards; of the same observations at all times."""
    callback = ReconstructionCallback(tmp_path, every=14, columns=3, decoder_updates=15)
    model = sensor_model(srl=srl).learn(14, callback=callback)
    callback.draw(model)
    files = sorted(path.name for path in tmp_path.iterdir())
    assert files == [f"reconstructions_{key}.png" for key in ("front", "wrist")]
    steps, (*_, drawn) = zip(*callback.rows, strict=True)
    assert steps == (14, 14) and {key: image.shape[2] for key, image in drawn.items()} == {"front": 36, "wrist": 28}
    seen: Any = callback.observations
    if srl == "rae":
        expected = model.policy.reconstruct({key: th.as_tensor(part) for key, part in seen.items()})[1]  # type: ignore[index]
        np.testing.assert_array_equal(drawn["wrist"], expected["wrist"][:, 3:].numpy())
    else:
        for key, image in drawn.items():
            there = seen[key][:, 3:].astype(float)
            assert np.abs(image - there).mean() < 0.75 * np.abs(127.5 - there).mean()


def test_tensorboard_shows_each_image(tmp_path: Path) -> None:
    """Reconstructed by the intrinsic reward if the head does not."""
    reward: Any = {"intrinsic": "reconstruction", "intrinsic_kwargs": {"n_filters": 4, "n_layers": 2}}
    model = sensor_model(tensorboard_log=str(tmp_path), srl="curl", **reward).learn(14)
    model.logger.dump(14)
    (folder,) = tmp_path.iterdir()
    images = EventAccumulator(str(folder)).Reload().Tags()["images"]
    assert images == ["srl/reconstructions_front", "srl/reconstructions_wrist"]


@pytest.mark.parametrize(
    "make", [lambda: SensorBox(("front", "joints"), channels_last=True), Goal], ids=["channels last", "vectors"]
)
def test_dictionaries_are_watched(make: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Evaluation and diagnostics see them as training does; another dictionary is refused."""
    monkeypatch.setattr(diagnostics, "MIN_UPDATES", 1)
    evaluate = EvalBothCallback(make(), eval_freq=20, n_episodes=1)
    model = tiny_model("MultiInputPolicy", make())
    model.learn(30, [evaluate, DiagnosticsCallback(every=10)])
    assert {"eval/task_reward", "eval/curious_srl_error"} <= evaluate.history[-1].keys()
    with pytest.raises(ValueError, match="Observation spaces do not match"):
        model.learn(1, EvalBothCallback(SensorBox(), 20))


class Walker(PixelBox):
    """Observations named as by dm_control."""

    def __init__(self) -> None:
        super().__init__(frame_stack=1)
        parts = {"walker/camera": self.observation_space, "walker/joints": gym.spaces.Box(-1, 1, (2,), np.float32)}
        self.observation_space = gym.spaces.Dict(parts)  # type: ignore[assignment]

    def observe(self, first: bool = False) -> Any:
        return {"walker/camera": super().observe(first), "walker/joints": self.position.astype(np.float32)}


def test_key_with_slash_names_a_file(tmp_path: Path) -> None:
    """Not a folder that does not exist."""
    tiny_model("MultiInputPolicy", Walker()).learn(12, callback=ReconstructionCallback(tmp_path, every=12))
    assert names(tmp_path) == ["reconstructions_walker_camera.png"]


def test_long_names_that_begin_alike_are_logged() -> None:
    """SB3's printed table refuses them; other logs have both."""
    long = [f"position_of_the_gripper_in_the_world_{axis}" for axis in "xy"]
    kept, printed = KeptRows(), io.StringIO()
    model = tiny_model("CnnPolicy", PixelBox())
    model.set_logger(Logger(None, [HumanOutputFormat(printed), kept]))
    probe = StateProbeCallback(PixelBox(), every=20, n_episodes=2, state=position, names=long)
    model.learn(41, callback=probe, log_interval=1)
    assert model.num_timesteps == 41 and "mean" in printed.getvalue()
    assert {f"probe/{name}" for name in long} <= kept.rows[0].keys()


# ------------------------------------------------------------------ pictures of any algorithm


@pytest.mark.parametrize(
    "make",
    [
        lambda: SAC("CnnPolicy", PixelBox(), learning_starts=30, batch_size=8, buffer_size=100, seed=0),
        lambda: tiny_model("CnnPolicy", PixelBox(), srl="curl"),
    ],
    ids=["SAC", "CURL"],
)
def test_latents_of_any_algorithm_are_drawn(make: Callable[[], BaseAlgorithm], tmp_path: Path) -> None:
    """A decoder fitted to them draws another picture for each observation; 0 updates draw nothing."""
    callback = ReconstructionCallback(tmp_path, every=32, columns=5, decoder_updates=30)
    none = ReconstructionCallback(tmp_path / "none", every=32, decoder_updates=0)
    make().learn(32, callback=[callback, none])
    assert [steps for steps, _ in callback.rows] == [32] and names(tmp_path) == ["reconstructions.png"]
    observed, drawn = callback.observations[:, -3:].astype(float), callback.rows[-1][1][""]  # type: ignore[index, call-overload]
    different = len(np.unique(callback.observations, axis=0))  # type: ignore[arg-type]
    assert different >= 3, "of different times"
    assert np.abs(drawn - observed).mean() < 0.75 * np.abs(observed - 128).mean(), "not grey"
    assert len(np.unique(drawn, axis=0)) == different, "of different latents"


# ------------------------------------------------------------------ videos


def test_overlay_shows_the_error_and_leaves_the_picture_alone() -> None:
    """Another error changes pixels of the panel from its step on, and none of the camera's picture."""
    frames = [np.full((48, 64, 3), 10 * step, np.uint8) for step in range(6)]
    errors = np.array([0.1, 0.2, 0.3, 0.2, 1.0, 0.4])

    def pictures(errors: np.ndarray) -> np.ndarray:
        return np.stack(list(annotated_frames(Episode(np.ones(6), errors, np.zeros(6), frames), 4, "", 1.0)))

    plain, other = pictures(errors), pictures(np.where(np.arange(6) == 3, 0.9, errors))
    assert plain.shape[1] % 2 == 0 == plain.shape[2] % 2
    for shown in (plain, other, pictures(np.zeros(0))):
        np.testing.assert_array_equal(shown[:, :192:4, ::4], np.stack(frames))
    differs = (plain != other).any(axis=-1)
    assert not differs[:3].any() and differs[3:, 192:].any(axis=(1, 2)).all()
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
@settings(max_examples=8, deadline=None)
def test_text_of_a_video_fits(title: str, reward: float, width: int) -> None:
    """There is a margin at the right, the end of the title is seen, and pictures are of one size."""
    frames = [np.zeros((40, width, 3), np.uint8)] * 3

    def pictures(end: str) -> np.ndarray:
        episode = Episode(np.array([reward, 0, -reward]), np.zeros(0), np.zeros(3), frames)
        return np.stack(list(annotated_frames(episode, 8, title + end, 1.0)))

    one, other = pictures("A"), pictures("B")
    top = 40 * -(-256 // width)
    assert (one[:, top:, -(one.shape[2] // 64) :] > 250).all() and (one[:, top:] < 80).any()
    assert one.shape != other.shape or (one != other).any()


# ------------------------------------------------------------------ maps and probes


def test_map_without_errors_has_one_column(tmp_path: Path) -> None:
    """SB3's PPO has visits alone."""
    callback = CuriosityMapCallback(VectorBox(), tmp_path, every=16, n_episodes=1, **MAP)
    PPO("MlpPolicy", VectorBox(), n_steps=16, batch_size=16).learn(16, callback=callback)
    both = CuriosityMapCallback(VectorBox(), tmp_path, every=20, n_episodes=1, actors=["task"], **MAP)
    tiny_model("MlpPolicy", VectorBox(), srl="rae").learn(20, callback=both)
    one, two = (Image.open(tmp_path / f"curiosity_map_{steps}_steps.png").size for steps in (16, 20))
    assert one[1] == two[1] and one[0] == pytest.approx(two[0] / 2, rel=0.1)


def test_map_of_a_dm_control_task_needs_no_names(tmp_path: Path) -> None:
    """Joints and suitable coordinates come from the physics."""
    env = make_dmc_env("cartpole", "swingup", image_size=36, renderer="fast", action_repeat=50)
    callback = CuriosityMapCallback(env, tmp_path, every=5, n_episodes=1)
    assert callback.coordinates == ("hinge_1", "hinge_1_velocity") and callback.units[1] == "rad"  # type: ignore[index]
    training = make_dmc_env("cartpole", "swingup", image_size=36, renderer="fast", action_repeat=50)
    callback.init_callback(tiny_model("CnnPolicy", training))
    callback.on_period()
    assert callback.visits["task"][0].shape == (20, 4)
    env.close(), training.close()


def test_state_probe_over_training() -> None:
    """A row of the untrained encoder, then one each time, of the same episodes; logged as rows of their own."""
    model, untrained = (tiny_model("CnnPolicy", PixelBox()) for _ in range(2))
    callback = StateProbeCallback(PixelBox(), every=15, n_episodes=3, **MAP)
    kept = KeptRows()
    model.set_logger(Logger(None, [kept]))
    model.learn(35, callback=callback, log_interval=100)
    callback.on_period()
    assert [row["timesteps"] for row in callback.rows] == [0, 15, 30, 35]
    for trained, row in ((untrained, callback.rows[0]), (model, callback.rows[-1])):
        episodes = list(run_episodes(trained, PixelBox(), 3, "random", states=position, seed=0))
        expected = state_probe(trained, episodes, ["x", "y"])
        assert [row["x"], row["y"]] == pytest.approx([expected["x"], expected["y"]])
    for logged, row in zip(kept.rows, callback.rows, strict=True):
        assert logged["time/total_timesteps"] == row["timesteps"]
        assert (logged["probe/x"], logged["probe/y"]) == (row["x"], row["y"])
        assert logged["probe/mean"] == pytest.approx((row["x"] + row["y"]) / 2)


@given(
    states=arrays(np.float64, st.tuples(st.integers(1, 60), st.just(2)), elements=st.floats(-5, 5)),
    bins=st.tuples(st.integers(1, 7), st.integers(1, 7)),
)
@settings(max_examples=40, deadline=None)
def test_bins_hold_every_step_once(states: np.ndarray, bins: tuple[int, int]) -> None:
    """Visits add up to the steps, also of those outside of the grid; means times visits add up to all errors."""
    edges = np.linspace(-4, 3, bins[0] + 1), np.linspace(-4, 3, bins[1] + 1)
    errors = np.arange(1.0, len(states) + 1)
    visits, means = binned_errors(states, errors, edges)
    assert visits.shape == means.shape == bins and visits.sum() == len(states)
    np.testing.assert_array_equal(np.isnan(means), visits == 0)
    assert np.nansum(means * visits) == pytest.approx(errors.sum())


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
