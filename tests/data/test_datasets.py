"""Episodes on disk: written, read into replay buffers, and learned from without an environment's step."""

import copy
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import minari
import numpy as np
import pytest
from dictionaries_for_tests import Goal
from envs_for_tests import Cliff, PixelBox, VectorBox, differences, state_of, tiny_model
from logs_for_tests import KeptRows
from minari.data_collector import EpisodeBuffer
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import SimpleMultiObsEnv
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import VecNormalize
from updates_for_tests import ALGORITHMS

from sb3_cure import CuReSAC
from sb3_cure.data.buffers import transitions
from sb3_cure.data.datasets import RecordedEpisode, RecordEpisodes, load_episode, save_episode
from sb3_cure.evaluation.rollouts import run_episodes
from sb3_cure.persistence import ExactCheckpoint

both_algorithms = pytest.mark.parametrize("algorithm", list(ALGORITHMS))


def record(make: Any, folder: Path, steps: int) -> gym.Env:
    """Random actions; the last episode has no end."""
    env = RecordEpisodes(make(), folder)
    env.action_space.seed(0)
    env.reset(seed=0)
    for _ in range(steps):
        _, _, terminated, truncated, _ = env.step(env.action_space.sample())
        if terminated or truncated:
            env.reset()
    env.close()
    return env


class InPlace(VectorBox):
    """Writes each observation into one place, and scales the actions that it is given."""

    def reset(self, **kwargs: Any) -> Any:
        self.seen = np.zeros(2, np.float32)
        super().reset(**kwargs)
        return self.observe(), {}

    def observe(self, first: bool = False) -> np.ndarray:
        self.seen[:] = self.position
        return self.seen

    def step(self, action: np.ndarray) -> Any:
        step = super().step(action)
        action *= 0.5
        return step


def test_environments_may_write_into_what_they_are_given_and_give(tmp_path: Path) -> None:
    """Files, and episodes that measure policies, hold what there was."""
    plain, in_place = record(VectorBox, tmp_path / "plain", 9), record(InPlace, tmp_path / "in place", 9)
    first, second = (load_episode(next((tmp_path / name).iterdir())) for name in ("plain", "in place"))
    for ours, theirs in zip(first, second, strict=True):
        np.testing.assert_array_equal(ours, theirs)
    model = tiny_model("MlpPolicy", VectorBox(), srl="inverse")
    measured = [next(run_episodes(model, env.env, 1, "random", seed=0)) for env in (plain, in_place)]
    np.testing.assert_array_equal(measured[0].observations, measured[1].observations)
    np.testing.assert_allclose(measured[0].srl_errors, measured[1].srl_errors, rtol=1e-6)


def test_goals_come_from_one_episode() -> None:
    """Of episodes that were stopped without an end."""
    model: Any = tiny_model("MultiInputPolicy", Goal(), replay_buffer_class=HerReplayBuffer)
    episodes, nothing = [], np.zeros(8, bool)
    for number in range(4):
        seen = {key: np.full((9, 2), number / 4) for key in ("observation", "achieved_goal", "desired_goal")}
        episodes.append(RecordedEpisode(seen, np.zeros((8, 2), np.float32), np.zeros(8), nothing, nothing))
    assert model.load_transitions(episodes) == 32
    batch = model.replay_buffer.sample(200)
    np.testing.assert_array_equal(batch.observations["desired_goal"], batch.observations["achieved_goal"])
    assert (batch.dones == 0).all()


def test_kill_while_an_episode_is_written_leaves_the_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    env = RecordEpisodes(VectorBox(episode_length=3), tmp_path)

    def half(file: Any, **arrays: Any) -> None:
        file.write(b"half a zip")
        raise KeyboardInterrupt

    for end in ("whole", "killed"):
        if end == "killed":
            monkeypatch.setattr(np, "savez_compressed", half)
        env.reset(seed=0)
        for _ in range(2):
            env.step(np.zeros(2))
        if end == "whole":
            env.step(np.zeros(2))
        else:
            with pytest.raises(KeyboardInterrupt):
                env.step(np.zeros(2))
    assert tiny_model("MlpPolicy", VectorBox()).load_transitions(tmp_path) == 3


def test_file_of_an_episode_has_its_suffix(tmp_path: Path) -> None:
    """As NumPy gives it; a folder is read by it."""
    arrays = (
        np.zeros((3, 2), np.float32),
        np.zeros((2, 2), np.float32),
        np.zeros(2),
        np.zeros(2, bool),
        np.ones(2, bool),
    )
    for name in ("one", "two.npz"):
        save_episode(tmp_path / name, RecordedEpisode(*arrays))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["one.npz", "two.npz"]


def test_lengths_of_an_episode_must_agree() -> None:
    """A camera that saw twice as often as actions were taken would pair them wrongly."""
    model, n = tiny_model("MlpPolicy", VectorBox()), 5
    ends = np.zeros(n, bool)
    twice = RecordedEpisode(np.zeros((2 * n + 1, 2), np.float32), np.zeros((n, 2)), np.zeros(n), ends, ends)
    with pytest.raises(ValueError, match=r"T \+ 1 observations, but in one T is 5 \(actions\), .* 10 \(observations\)"):
        model.load_transitions([twice])
    assert model.replay_buffer.size() == 0


def test_several_episodes_in_one_are_refused() -> None:
    """At the boundary a value would bootstrap from the first observation of the next episode."""
    model, n = tiny_model("MlpPolicy", VectorBox()), 6
    ends = np.zeros(n, bool)
    ends[2] = True
    joined = RecordedEpisode(np.zeros((n + 1, 2), np.float32), np.zeros((n, 2)), np.zeros(n), ~ends & ends, ends)
    with pytest.raises(ValueError, match="ends before its last step"):
        model.load_transitions([joined])


@pytest.mark.parametrize("part", ["observations", "actions", "rewards"])
@pytest.mark.parametrize("number", [np.nan, 1e39])
def test_numbers_that_are_not_finite_are_refused(part: str, number: float) -> None:
    ends = np.zeros(8, bool)
    episode = RecordedEpisode(np.zeros((9, 2)), np.zeros((8, 2)), np.zeros(8), ends, ends)
    getattr(episode, part)[3] = number
    model = tiny_model("MlpPolicy", VectorBox())
    with pytest.raises(ValueError, match=r"not finite|not within"):
        model.load_transitions([episode])
    assert model.replay_buffer.size() == 0


def test_rows_of_several_environments_are_counted() -> None:
    """One long episode beside a short one fills the buffer's rows, and the rest of them is empty."""
    envs = make_vec_env(VectorBox, 2)
    model, episodes = tiny_model("MlpPolicy", envs, buffer_size=40), []
    for n in (30, 5):
        ends = np.zeros(n, bool)
        episodes.append(RecordedEpisode(np.zeros((n + 1, 2), np.float32), np.zeros((n, 2)), np.zeros(n), ends, ends))
    with pytest.warns(UserWarning, match="35 transitions in 30 rows .*2 environments side by side.* the last 20 rows"):
        model.load_transitions(episodes)


@both_algorithms
@pytest.mark.parametrize(
    ("policy", "make"),
    [
        ("CnnPolicy", PixelBox),
        ("CnnPolicy", lambda: PixelBox(1, channels_last=True)),
        ("MlpPolicy", Cliff),
        ("MlpPolicy", lambda: VectorBox(low=-1.0, high=3.0)),
    ],
    ids=["stacked frames", "channels last", "terminations", "asymmetric actions"],
)
def test_loaded_transitions_are_those_collected(algorithm: str, policy: str, make: Any, tmp_path: Path) -> None:
    """What a model collects, and what another one reads from the files that a wrapper wrote meanwhile, are the same."""
    collector = tiny_model(policy, RecordEpisodes(make(), tmp_path), ALGORITHMS[algorithm], learning_starts=10**6)
    collector.learn(45)
    collector.env.close()
    reader = tiny_model(policy, make(), ALGORITHMS[algorithm])
    assert reader.load_transitions(tmp_path) == 45 and reader.num_timesteps == 0
    rows = np.arange(45), np.zeros(45, int)
    ours, theirs = (transitions(each.replay_buffer, *rows) for each in (reader, collector))
    for name, value in theirs._asdict().items():
        if value is not None:
            np.testing.assert_allclose(getattr(ours, name), value, atol=1e-6, err_msg=name)
    assert (ours.dones.sum() > 0) == (make is Cliff)


def test_several_environments_share_the_episodes(tmp_path: Path) -> None:
    """Each transition once, in its order; where none is left for an environment, it goes on with the first again."""
    episodes = []
    for number, length in enumerate((30, 10, 10)):
        rewards = 100.0 * number + np.arange(length)
        observations = np.stack([np.append(rewards, rewards[-1] + 0.5)] * 2, axis=1).astype(np.float32)
        ends = np.zeros(length, bool)
        episodes.append(RecordedEpisode(observations, np.zeros((length, 2)), rewards, ends, ends))
    first, second, third = (each.rewards.tolist() for each in episodes)
    for source in (episodes, iter(episodes)):
        model = tiny_model("MlpPolicy", make_vec_env(VectorBox, 2), buffer_size=100)
        assert model.load_transitions(source) == 50
        buffer: Any = model.replay_buffer
        assert buffer.size() == 30 and buffer.rewards[:30, 0].tolist() == first
        assert buffer.rewards[:30, 1].tolist() == [*second, *third, *first[:10]]
        model.learn(2)
        assert np.flatnonzero(buffer.starts[:, 1]).tolist() == [0, 10, 20, 30], "`learn` does not continue an episode"


def test_no_episode_gets_most_of_the_samples() -> None:
    """Of more environments than are left episodes: no transition is there three times."""
    episodes, ends = [], np.zeros(5, bool)
    for number in range(10):
        observations = np.full((6, 2), number / 10, np.float32)
        episodes.append(RecordedEpisode(observations, np.zeros((5, 2)), np.full(5, number), ends, ends))
    model = tiny_model("MlpPolicy", make_vec_env(VectorBox, 8), buffer_size=400)
    assert model.load_transitions(episodes) == 50
    counts = np.bincount(model.replay_buffer.rewards[:10].astype(int).ravel())
    assert counts.min() == 5 and counts.max() == 10


@pytest.mark.parametrize("make", [VectorBox, PixelBox, lambda: SimpleMultiObsEnv(discrete_actions=False)])
def test_datasets_of_minari_are_read(make: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As Minari writes and loads them: the same transitions as from files of our own."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    env = record(make, tmp_path / "ours", 12)
    episodes = [load_episode(path) for path in sorted((tmp_path / "ours").glob("*.npz"))]
    buffers = [
        EpisodeBuffer(
            observations=episode.observations,
            actions=list(episode.actions),
            rewards=[float(reward) for reward in episode.rewards],
            terminations=list(episode.terminations),
            truncations=list(episode.truncations),
        )
        for episode in episodes
    ]
    minari.create_dataset_from_buffers(
        "test/random-v0", buffers, observation_space=env.observation_space, action_space=env.action_space,
        jpeg_encoding=False, data_format="hdf5",
    )  # fmt: skip
    policy = "MultiInputPolicy" if isinstance(env.observation_space, gym.spaces.Dict) else "MlpPolicy"
    policy = "CnnPolicy" if make is PixelBox else policy
    models = [tiny_model(policy, make(), srl=None, curiosity=None) for _ in range(2)]
    assert models[0].load_transitions(tmp_path / "ours") == 12
    assert models[1].load_transitions(minari.load_dataset("test/random-v0")) == 12
    rows = np.arange(12), np.zeros(12, int)
    ours, theirs = (transitions(model.replay_buffer, *rows) for model in models)
    assert not differences(ours._asdict(), theirs._asdict())


def test_episodes_in_float64_are_read() -> None:
    """By their attributes, as most datasets of Minari have them; for returns of several steps, too."""
    rng = np.random.default_rng(0)
    episode = SimpleNamespace(
        id=0, observations=rng.uniform(-1, 1, (6, 2)), actions=rng.uniform(-1, 1, (5, 2)), rewards=rng.normal(size=5),
        terminations=np.zeros(5, bool), truncations=np.arange(5) == 4, infos={},
    )  # fmt: skip
    model = tiny_model("MlpPolicy", VectorBox(), n_steps=3)
    assert model.load_transitions([episode, episode]) == 10
    model.learn(15)


def test_dictionaries_keep_their_keys(tmp_path: Path) -> None:
    make = lambda: SimpleMultiObsEnv(discrete_actions=False)  # noqa: E731
    record(make, tmp_path, 12)
    episode = load_episode(min(tmp_path.glob("*.npz")))
    assert set(episode.observations) == {"img", "vec"} and len(episode.observations["vec"]) == len(episode.actions) + 1
    model = CuReSAC("MultiInputPolicy", make(), srl=None, curiosity=None, buffer_size=20, learning_starts=5)
    assert model.load_transitions(tmp_path) == 12
    stored: Any = transitions(model.replay_buffer, np.zeros(1, int), np.zeros(1, int)).observations  # type: ignore[arg-type]
    np.testing.assert_array_equal(stored["vec"][0], episode.observations["vec"][0])


def test_what_does_not_fit_is_one_sentence(tmp_path: Path) -> None:
    record(VectorBox, tmp_path / "vectors", 5)
    model = tiny_model("CnnPolicy", PixelBox())
    for source, sentence in (
        (tmp_path / "vectors", "observations of an episode are float32 of shape"),
        (tmp_path, "has no .npz files"),
    ):
        with pytest.raises(ValueError, match=sentence):
            model.load_transitions(source)
    vectors = tiny_model("MlpPolicy", VectorBox(), buffer_size=3)
    far = load_episode(min((tmp_path / "vectors").glob("*.npz")))
    with pytest.raises(ValueError, match="actions of an episode"):
        vectors.load_transitions([far._replace(actions=3 * np.ones_like(far.actions))])
    with pytest.warns(UserWarning, match="make buffer_size larger"):
        vectors.load_transitions([far])


def test_files_are_not_unpickled(tmp_path: Path) -> None:
    episode = RecordedEpisode(*(np.array([{"any": "object"}], dtype=object) for _ in range(5)))
    save_episode(tmp_path / "pickled.npz", episode)
    with pytest.raises(ValueError, match="allow_pickle=False"):
        tiny_model("MlpPolicy", VectorBox()).load_transitions(tmp_path)


# ------------------------------------------------------------------------------------------ learning from them


@both_algorithms
def test_fit_representation_trains_encoder_and_head_alone(algorithm: str, tmp_path: Path) -> None:
    record(PixelBox, tmp_path, 60)
    model = tiny_model("CnnPolicy", PixelBox(), ALGORITHMS[algorithm])
    model.load_transitions(tmp_path)
    before = state_of(model)
    kept = KeptRows()
    model.set_logger(Logger(None, [kept]))
    model.fit_representation(60, log_interval=25)
    losses = [row["train/srl_loss"] for row in kept.rows]
    assert len(losses) == 3 and losses[-1] < losses[0]
    changed = {name.split("[")[0].split(".")[0] for name in _changed(before["policy"], state_of(model)["policy"])}
    assert changed == {"encoder", "encoder_target", "srl"}
    assert (model.num_timesteps, model._n_updates, model.task, model.curiosity) == (0, 0, True, "separate")
    assert model.replay_buffer.size() == 60
    model.learn(14)
    assert model._n_updates == 4 and model.replay_buffer.size() == 74


def test_training_goes_on_after_fitting() -> None:
    """Neither a random warm-up nor a burst again, its counters and the scale of its bonus as they were."""
    model = tiny_model("CnnPolicy", PixelBox(), warmup_updates=3, curiosity="bonus").learn(14)
    done, progress = (model.num_timesteps, model._n_updates, model._n_batches), model._current_progress_remaining
    scale = copy.deepcopy(model.policy.scale.state_dict())
    model.fit_representation(5)
    assert differences(scale, model.policy.scale.state_dict()) == []
    assert (model.num_timesteps, model._n_updates, model._n_batches) == done == (14, 7, 7)
    assert model._current_progress_remaining == progress != 1 / 5
    model.learn(2, reset_num_timesteps=False)
    assert (model.num_timesteps, model._n_updates) == (16, 9)


def _changed(first: Any, second: Any) -> list[str]:
    return [name for name in first if differences(first[name], second[name])]


def test_learn_after_fitting_begins_as_without_it(tmp_path: Path) -> None:
    """The same random warm-up, so that runs of one seed stay paired."""
    record(PixelBox, tmp_path, 30)
    plain = tiny_model("CnnPolicy", PixelBox()).learn(10)
    fitted = tiny_model("CnnPolicy", PixelBox())
    fitted.load_transitions(tmp_path)
    fitted.fit_representation(3).learn(10)
    np.testing.assert_array_equal(fitted.replay_buffer.actions[30:40], plain.replay_buffer.actions[:10])


def test_schedules_follow_the_updates(tmp_path: Path) -> None:
    """Also after a training that has come to their end."""
    record(VectorBox, tmp_path, 30)
    seen: list[float] = []
    model = tiny_model("MlpPolicy", VectorBox(), learning_rate=lambda progress: seen.append(progress) or 1e-3)  # type: ignore[func-returns-value]
    model.learn(15)
    model.load_transitions(tmp_path)
    seen.clear()
    kept = KeptRows()
    model.set_logger(Logger(None, [kept]))
    model.fit_representation(4, log_interval=3)
    assert seen[:4] == [1, 0.75, 0.5, 0.25] and len(kept.rows) == 2


def test_nothing_to_fit_is_refused() -> None:
    with pytest.raises(ValueError, match="srl is None"):
        tiny_model("CnnPolicy", PixelBox(), srl=None, curiosity=None).fit_representation(1)
    with pytest.raises(ValueError, match="call load_transitions"):
        tiny_model("CnnPolicy", PixelBox()).fit_representation(1)


class Interrupt(BaseCallback):
    """Stands in for a kill."""

    def __init__(self, at: int = 25):
        super().__init__()
        self.at = at

    def _on_step(self) -> bool:
        if self.num_timesteps == self.at:
            raise KeyboardInterrupt
        return True


def test_resumed_run_records_each_episode_once(tmp_path: Path) -> None:
    """Those that it plays again, too, which the killed run had written after its last checkpoint."""

    def make(folder: str) -> gym.Env:
        return RecordEpisodes(VectorBox(), tmp_path / folder)

    def recorded(folder: str) -> list[list[float]]:
        return [load_episode(path).rewards.tolist() for path in sorted((tmp_path / folder).glob("*.npz"))]

    arguments: dict[str, Any] = dict(learning_starts=10**6)
    whole = tiny_model("MlpPolicy", make("whole"), **arguments).learn(80)
    whole.env.close()  # type: ignore[union-attr]
    with pytest.raises(KeyboardInterrupt):
        checkpoint = ExactCheckpoint(15, tmp_path / "checkpoints")
        tiny_model("MlpPolicy", make("parts"), **arguments).learn(80, callback=[checkpoint, Interrupt(44)])
    n_written = len(recorded("parts"))
    resumed = CuReSAC.resume(tmp_path / "checkpoints", make("parts"), device="cpu").learn(80)
    assert resumed.num_timesteps == 80 and n_written > 1
    resumed.env.close()  # type: ignore[union-attr]
    assert recorded("parts") == recorded("whole")


def test_resumed_run_records_into_its_own_folder(tmp_path: Path) -> None:
    """That of the new environment: the old one may be on another machine."""
    checkpoint = ExactCheckpoint(15, tmp_path / "checkpoints")
    model = tiny_model("MlpPolicy", RecordEpisodes(VectorBox(), tmp_path / "old"), learning_starts=10**6)
    with pytest.raises(KeyboardInterrupt):
        model.learn(80, callback=[checkpoint, Interrupt(44)])
    shutil.rmtree(tmp_path / "old")
    env = RecordEpisodes(VectorBox(), tmp_path / "new")
    CuReSAC.resume(tmp_path / "checkpoints", env, device="cpu").learn(80)
    assert list((tmp_path / "new").glob("*.npz")) and not (tmp_path / "old").exists()


def test_unknown_statistics_are_refused(tmp_path: Path) -> None:
    """VecNormalize would show all of it as the same."""
    record(VectorBox, tmp_path, 20)
    model = tiny_model("MlpPolicy", VecNormalize(make_vec_env(VectorBox, 1)))
    with pytest.raises(ValueError, match="VecNormalize has no statistics"):
        model.load_transitions(tmp_path)
