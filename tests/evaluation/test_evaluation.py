"""Both policies are evaluated in rollouts of their own, with the noise-free SRL error of what they see."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from envs_for_tests import PixelBox, VectorBox, differences, tiny_model
from PIL import Image
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.logger import KVWriter, Logger
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_cure.cure.metrics import reconstruction_strip
from sb3_cure.data.buffers import FrameStackReplayBuffer
from sb3_cure.data.samples import Samples
from sb3_cure.evaluation import plots
from sb3_cure.evaluation.callbacks import EvalBothCallback
from sb3_cure.evaluation.decoding import draw_latents, fit_decoder
from sb3_cure.evaluation.rollouts import (
    Episode,
    even_negatives,
    evenly_measured,
    most_uncomfortable,
    run_episodes,
    state_probe,
)


class Rows(KVWriter):
    """A logger's output that keeps what is written."""

    def __init__(self) -> None:
        self.rows: list[dict[str, Any]] = []

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        self.rows.append({**key_values, "step": step})

    def close(self) -> None: ...


class Recorder(PixelBox):
    """Keeps the actions of the episode under way."""

    def reset(self, **kwargs: Any) -> Any:
        self.actions: list[np.ndarray] = []
        return super().reset(**kwargs)

    def step(self, action: np.ndarray) -> Any:
        self.actions.append(np.array(action))
        return super().step(action)


@pytest.mark.parametrize("actor", ["task", "curious", "random"])
def test_each_episode_is_acted_by_the_policy_that_was_asked_for(actor: str) -> None:
    """Actions are that policy's, rewards the environment's, errors those of the observations before each step."""
    model = tiny_model("CnnPolicy", PixelBox()).learn(20)
    env = Recorder(low=-2.0, high=3.0)
    env.action_space = model.action_space
    (episode,) = run_episodes(model, env, 1, actor, seed=5)
    assert episode.observations.shape == (20, *env.observation_space.shape)
    again, _ = PixelBox().reset(seed=5)
    np.testing.assert_array_equal(episode.observations[0], again)
    predict = {"task": model.predict, "curious": model.predict_curious}.get(actor)
    if predict is None:
        model.action_space.seed(5)
        expected = np.array([model.action_space.sample() for _ in range(20)])
    else:
        expected = np.array([predict(observation, deterministic=True)[0] for observation in episode.observations])
    np.testing.assert_allclose(np.array(env.actions), expected, atol=1e-6)
    assert episode.total_reward == pytest.approx(sum(episode.rewards)) and len(episode.rewards) == 20
    observations = th.as_tensor(episode.observations)
    with th.no_grad():
        drawn = model.policy.srl.decoder(model.policy.encode(observations))
    target = (th.div(observations, 8, rounding_mode="floor").float() + 0.5) / 32 - 0.5
    np.testing.assert_allclose(episode.srl_errors, (drawn - target).square().flatten(1).mean(1), rtol=1e-4)


def test_true_states_are_kept_when_asked_for() -> None:
    """Those before each step, as a function of the environment says; for dm_control that of its physics."""
    model = tiny_model("CnnPolicy", PixelBox()).learn(20)
    (episode,) = run_episodes(model, Recorder(), 1, "curious", seed=5)
    assert episode.states.size == 0
    env = Recorder()
    (seen,) = run_episodes(model, env, 1, "curious", seed=5, states=lambda env: env.unwrapped.position)
    np.testing.assert_array_equal(seen.observations, episode.observations)
    assert seen.states.shape == (20, 2)
    moved = np.clip(seen.states + 0.3 * np.array(env.actions), -1, 1)
    np.testing.assert_allclose(seen.states[1:], moved[:-1], atol=1e-6)
    with pytest.raises(ValueError, match="no physics of dm_control"):
        list(run_episodes(model, env, 1, states=True))


def test_unknown_actor_is_one_sentence() -> None:
    """The names are given."""
    model = tiny_model("CnnPolicy", PixelBox())
    with pytest.raises(ValueError, match=r"actor is 'best', but must be one of 'task', 'curious', 'random'"):
        list(run_episodes(model, PixelBox(), 1, "best"))


def test_negatives_are_taken_evenly_from_what_each_policy_sees() -> None:
    """A third of CURL's bank from each policy's episode, spread over it; a model without such a head is left alone."""
    model = tiny_model("CnnPolicy", PixelBox(), srl="curl", srl_kwargs=dict(bank_size=12)).learn(20)
    env = PixelBox()
    even_negatives(model, env, seed=3)
    head = model.policy.srl
    assert int(head.bank_filled) == 12
    for third, actor in enumerate(("task", "curious", "random")):
        (episode,) = run_episodes(model, env, 1, actor, seed=3)
        expected = episode.observations[[0, 6, 12, 19]]
        np.testing.assert_array_equal(head.bank[4 * third : 4 * third + 4].numpy(), expected)
    # Two policies share it where there is no curious one.
    plain = tiny_model("CnnPolicy", PixelBox(), srl="curl", curiosity=None).learn(20)
    even_negatives(plain, env, seed=3)
    assert int(plain.policy.srl.bank_filled) == 64
    autoencoder = tiny_model("CnnPolicy", PixelBox(), srl="rae")
    before = {key: value.clone() for key, value in autoencoder.policy.state_dict().items()}
    even_negatives(autoencoder, env)
    assert all(th.equal(value, before[key]) for key, value in autoencoder.policy.state_dict().items())


def test_callback_logs_both_policies_at_its_interval() -> None:
    """Rows at 20 and 40 steps with both returns and both errors, equal to evaluations by hand."""
    writer = Rows()
    model = tiny_model("CnnPolicy", PixelBox())
    model.set_logger(Logger(None, [writer]))
    callback = EvalBothCallback(PixelBox(), eval_freq=20, n_episodes=2, seed=3)
    model.learn(45, callback=callback)
    rows = [row for row in writer.rows if "eval/task_reward" in row]
    assert [row["step"] for row in rows] == [20, 40] == [row["timesteps"] for row in callback.history]
    last = callback.evaluate()
    for actor in ("task", "curious"):
        episodes = list(run_episodes(model, PixelBox(), 2, actor, seed=3))
        assert last[f"eval/{actor}_reward"] == pytest.approx(np.mean([episode.total_reward for episode in episodes]))
        errors = np.concatenate([episode.srl_errors for episode in episodes])
        assert last[f"eval/{actor}_srl_error"] == pytest.approx(errors.mean())


def test_callback_evaluates_a_model_without_extras() -> None:
    """SB3's SAC has no curious policy and no SRL error: only the task's return is logged."""
    model = tiny_model("MlpPolicy", "Pendulum-v1", srl=None, curiosity=None)
    callback = EvalBothCallback(gym.make("Pendulum-v1"), eval_freq=20, n_episodes=1)
    model.learn(25, callback=callback)
    assert callback.history[0].keys() == {"timesteps", "eval/task_reward"}


def test_reconstructions_show_the_newest_frames_above_what_is_drawn() -> None:
    """Left to right the samples, top row their newest frames, bottom row the head's reconstruction of these."""
    model = tiny_model("CnnPolicy", PixelBox(frame_stack=2)).learn(30)
    batch = model.replay_buffer.sample(8)
    strip = reconstruction_strip(model.policy, batch, frame_stack=2, columns=3)
    assert strip.shape == (3, 72, 108) and strip.dtype == np.uint8
    with th.no_grad():
        drawn = model.policy.srl.reconstruct(model.policy.encode(batch.observations[:3]))
    for column in range(3):
        cut = strip[:, :, 36 * column : 36 * (column + 1)]
        np.testing.assert_array_equal(cut[:, :36], batch.observations[column, 3:])
        np.testing.assert_array_equal(cut[:, 36:], drawn[column, 3:])


def test_decoder_draws_from_a_contrastive_encoder_without_training_it() -> None:
    """The encoder is bit-equal before and after; with more updates the drawing comes closer to the observation."""
    model = tiny_model("CnnPolicy", PixelBox(frame_stack=1), srl="curl").learn(30)
    before = {key: value.clone() for key, value in model.policy.state_dict().items()}
    distances = []
    for updates in (1, 150):
        th.manual_seed(0)
        np.random.seed(0)
        decoder = fit_decoder(model, lambda n: model.replay_buffer.sample(n).observations, updates)
        observed, drawn = draw_latents(model, decoder, model.replay_buffer.sample(4).observations)
        distances.append(float((observed - drawn).abs().mean()))
    assert distances[1] < 0.5 * distances[0]
    assert all(th.equal(value, before[key]) for key, value in model.policy.state_dict().items())


def test_decoder_draws_what_the_encoder_sees() -> None:
    """Of crops, pictures of the crops' size."""
    crops: dict[str, Any] = dict(augmentation="crop", augmentation_kwargs=dict(size=30))
    model = tiny_model("CnnPolicy", PixelBox(), srl="curl", **crops).learn(30)
    decoder = fit_decoder(model, lambda n: model.replay_buffer.sample(n).observations, 1)
    observed, drawn = draw_latents(model, decoder, model.replay_buffer.sample(4).observations)
    assert observed.shape == drawn.shape == (4, model.observation_space.shape[0], 30, 30)


def all_errors(model: Any) -> list[tuple[int, int, float]]:
    """Age, environment and error of everything in a model's buffer, one observation at a time."""
    buffer = model.replay_buffer
    found = []
    for age in range(buffer.size() - int(buffer.optimize_memory_usage and buffer.full)):
        for env in range(buffer.n_envs):
            row = (buffer.pos - 1 - age) % buffer.buffer_size
            if isinstance(buffer, FrameStackReplayBuffer):
                observation = np.concatenate(buffer.frames[buffer.frame_slots[row, env, 0]])
            else:
                observation = buffer.observations[row, env]
            observation = th.as_tensor(observation)[None]
            with th.no_grad():
                drawn = model.policy.srl.decoder(model.policy.encode(observation))
            target = model.policy.srl.target(observation, dither=False)
            found.append((age, env, float((drawn - target).square().mean())))
    return found


@pytest.mark.parametrize(
    ("n_envs", "kwargs"),
    [
        (1, dict(buffer_size=50)),
        (2, dict(buffer_size=60)),
        (2, dict(buffer_size=500, replay_buffer_class=ReplayBuffer)),
        (
            1,
            dict(
                buffer_size=40,
                replay_buffer_class=ReplayBuffer,
                optimize_memory_usage=True,
                replay_buffer_kwargs=dict(handle_timeout_termination=False),
            ),
        ),
    ],
    ids=["full", "full, two environments", "SB3's, half full", "SB3's memory-saving, full"],
)
def test_most_uncomfortable_equals_brute_force(n_envs: int, kwargs: dict[str, Any]) -> None:
    """The worst observations first, apart in time, whatever the chunks; looking draws no random numbers."""
    model = tiny_model("CnnPolicy", DummyVecEnv([PixelBox] * n_envs), **kwargs).learn(74)
    everything = all_errors(model)
    before = np.random.get_state()[1].copy(), th.get_rng_state()
    for gap, chunk in ((1, 11), (6, 1000)):
        chosen: list[tuple[int, int, float]] = []
        for each in sorted(everything, key=lambda each: -each[2]):
            if len(chosen) < 7 and not any(each[1] == other[1] and abs(each[0] - other[0]) < gap for other in chosen):
                chosen.append(each)
        found = most_uncomfortable(model, 7, gap=gap, chunk=chunk)
        np.testing.assert_allclose(found.errors, [error for _, _, error in chosen], rtol=1e-4)
        assert found.ages.tolist() == [age * n_envs for age, _, _ in chosen]
        assert found.observations.dtype == np.uint8
        images = th.as_tensor(found.observations)
        batch = Samples(images, *[None] * 4, views=images)
        with th.no_grad():
            errors = model.policy.srl.error(batch, model.policy.encode(batch.observations))
        np.testing.assert_allclose(errors, found.errors, rtol=1e-4)
    assert found.mean_error == pytest.approx(np.mean([error for _, _, error in everything]), rel=1e-4)
    assert len(most_uncomfortable(model, 10_000, gap=1).errors) == len(everything)
    np.testing.assert_array_equal(before[0], np.random.get_state()[1])
    assert th.equal(before[1], th.get_rng_state())


def test_uncomfortable_frames_are_drawn(tmp_path: Path) -> None:
    """With and without reconstructions, and where one row of frames is not full."""
    model = tiny_model("CnnPolicy", PixelBox(frame_stack=2)).learn(60)
    found = most_uncomfortable(model, 5, gap=2)
    with th.no_grad():
        drawn = model.policy.srl.reconstruct(model.policy.encode(th.as_tensor(found.observations))).numpy()
    for name, images in (("alone.png", None), ("both.png", drawn)):
        plots.uncomfortable_frames(tmp_path / name, found, 2, "title", images)
        assert np.asarray(Image.open(tmp_path / name).convert("L")).std() > 5
    for wrong in (1, 3, 4):
        with pytest.raises(ValueError, match=rf"frame_stack is {wrong}, but the observations have 6 channels"):
            plots.uncomfortable_frames(tmp_path / "wrong.png", found, wrong, "title")
    assert not (tmp_path / "wrong.png").exists()


def test_empty_buffer_has_nothing_uncomfortable() -> None:
    with pytest.raises(ValueError, match="the replay buffer is empty"):
        most_uncomfortable(tiny_model("CnnPolicy", PixelBox()))


def test_even_measurement_leaves_the_head_as_it_was() -> None:
    """Within, the negatives are even; afterwards, also after an error, they are the training's again."""
    model = tiny_model("CnnPolicy", PixelBox(), srl="curl", srl_kwargs=dict(bank_size=12)).learn(20)
    head = model.policy.srl
    before = {key: value.clone() for key, value in head.state_dict().items()}
    with pytest.raises(RuntimeError), evenly_measured(model, PixelBox(), seed=3):
        assert not th.equal(head.bank, before["bank"])
        raise RuntimeError
    assert differences(head.state_dict(), before) == []
    plain = SAC("MlpPolicy", VectorBox())
    with evenly_measured(plain, VectorBox()):
        pass


def test_observations_are_normalised_as_in_training() -> None:
    """Of a model trained in VecNormalize the policy acts on, and its error is that of, normalised observations."""
    venv = VecNormalize(DummyVecEnv([VectorBox]))
    model = tiny_model("MlpPolicy", venv, srl="rae").learn(40)
    (episode,) = run_episodes(model, VectorBox(), 1, seed=5)
    seen = venv.normalize_obs(episode.observations)
    assert np.abs(seen - episode.observations).max() > 0.1
    batch = Samples(th.as_tensor(seen), *[None] * 4, views=th.as_tensor(seen))
    with th.no_grad():
        errors = model.policy.srl.error(batch, model.policy.encode(batch.observations))
    np.testing.assert_allclose(episode.srl_errors, errors, rtol=1e-4)
    first = model.predict(seen[0], deterministic=True)[0]
    moved = np.clip(episode.observations[0] + 0.3 * first, -1, 1)
    np.testing.assert_allclose(episode.observations[1], moved, atol=1e-6)


# ---------------------------------------------------------------- what the latents tell of the true state


def probed(latents: list[np.ndarray], states: list[np.ndarray], **kwargs: Any) -> dict[str, float]:
    """R² from given latents: the encoder is the identity.

    :param latents: Of each episode, [T, k]
    :param states: Of each episode, [T, d]
    """
    model = tiny_model("MlpPolicy", VectorBox())
    model.policy.encode = lambda observations: observations  # type: ignore[method-assign]
    none = np.zeros(0)
    episodes = [
        Episode(np.zeros(len(state)), none, seen, [], state) for seen, state in zip(latents, states, strict=True)
    ]
    return state_probe(model, iter(episodes), [f"s{i}" for i in range(states[0].shape[1])], **kwargs)


def test_state_probe_against_straight_line_code() -> None:
    """Each episode by least squares on the others, the penalty as rows of its own (Tikhonov)."""
    rng = np.random.default_rng(0)
    latents = [rng.normal(1, [1, 5, 0.2], (n, 3)) for n in (10, 17, 25)]
    mix = rng.normal(size=(3, 2))
    states = [each @ mix + rng.normal(0, 2, (len(each), 2)) for each in latents]
    sums = np.zeros((2, 2))
    for out in range(3):
        rest = [index for index in range(3) if index != out]
        x, y = (np.concatenate([each[index] for index in rest]) for each in (latents, states))
        deviation = x.std(axis=0)
        rows = np.vstack([(x - x.mean(axis=0)) / deviation, np.sqrt(0.3 * len(x)) * np.eye(3)])
        goal = np.vstack([y - y.mean(axis=0), np.zeros((3, 2))])
        weights = np.linalg.lstsq(rows, goal, rcond=None)[0]
        predicted = (latents[out] - x.mean(axis=0)) / deviation @ weights + y.mean(axis=0)
        sums[0] += ((predicted - states[out]) ** 2).sum(axis=0)
    sums[1] = ((np.concatenate(states) - np.concatenate(states).mean(axis=0)) ** 2).sum(axis=0)
    expected = 1 - sums[0] / sums[1]
    assert 0.1 < expected.min() and expected.max() < 0.9
    assert list(probed(latents, states, ridge=0.3).values()) == pytest.approx(expected.tolist(), rel=1e-6)


def test_state_probe_of_what_is_there_and_what_is_not() -> None:
    """1 for a linear function of the latents, about 0 for noise; of a constant there is nothing to tell."""
    rng = np.random.default_rng(0)
    latents = [rng.normal(size=(200, 4)) for _ in range(4)]
    states = [np.column_stack([each @ [1, 2, 3, 4], rng.normal(size=200), np.full(200, 3.0)]) for each in latents]
    found = probed(latents, states)
    assert found["s0"] > 0.999 and abs(found["s1"]) < 0.05 and np.isnan(found["s2"])
    states[1][7, 1] = np.nan  # which is no reason to lose the others
    assert probed(latents, states)["s0"] > 0.999


def test_state_probe_does_not_know_an_episode_from_itself() -> None:
    """Latents that only tell which episode it is tell nothing of another one, however alike its own steps are."""
    rng = np.random.default_rng(0)
    latents = [np.eye(8)[[index] * 50] for index in range(8)]
    states = [np.full((50, 1), rng.normal()) + rng.normal(0, 0.01, (50, 1)) for _ in range(8)]
    assert probed(latents, states)["s0"] < 0.1


def test_angles_are_probed_as_directions() -> None:
    """A latent that turns with the joint tells the angle, also where its number jumps from pi to -pi."""
    rng = np.random.default_rng(0)
    turns = [rng.uniform(-np.pi, np.pi, (100, 1)) for _ in range(4)]
    latents = [np.hstack([np.cos(each), np.sin(each)]) for each in turns]
    assert probed(latents, turns, units=["rad"])["s0"] > 0.999
    assert probed(latents, turns, units=["m"])["s0"] < 0.8


def test_probe_reads_the_latents_of_the_acting_encoder() -> None:
    """Of any algorithm with an encoder, changing nothing; what cannot be probed is one sentence."""
    env = PixelBox()
    for model in (tiny_model("CnnPolicy", env, srl="curl").learn(12), SAC("CnnPolicy", env, buffer_size=10)):
        episodes = list(run_episodes(model, env, 3, "random", states=lambda env: env.unwrapped.position, seed=1))
        before = {name: value.clone() for name, value in model.policy.state_dict().items()}
        found = state_probe(model, episodes, ["x", "y"])
        assert found.keys() == {"x", "y"} and np.isfinite(list(found.values())).all()
        assert not differences(before, dict(model.policy.state_dict()))
    with pytest.raises(ValueError, match="one at most"):
        state_probe(model, episodes[:1], ["x", "y"])
    with pytest.raises(ValueError, match="no true states"):
        state_probe(model, run_episodes(model, env, 2, "random"), ["x", "y"])
    with pytest.raises(ValueError, match="no encoder whose latents"):
        state_probe(SAC("MlpPolicy", VectorBox()), episodes, ["x", "y"])
