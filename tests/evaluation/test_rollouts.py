"""Both policies are evaluated in rollouts of their own, with the noise-free SRL error of what they see."""

import itertools
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from dictionaries_for_tests import SensorBox, sensor_model
from envs_for_tests import PixelBox, VectorBox, differences, tiny_model
from logs_for_tests import KeptRows
from PIL import Image
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_cure.cure.reconstructions import reconstruction_strips
from sb3_cure.data.buffers import transitions
from sb3_cure.data.observations import by_key, rows_of
from sb3_cure.data.samples import Samples
from sb3_cure.evaluation import plots, rollouts
from sb3_cure.evaluation.callbacks import EvalBothCallback
from sb3_cure.evaluation.decoding import draw_latents, fit_decoder
from sb3_cure.evaluation.probe import state_probe
from sb3_cure.evaluation.rollouts import (
    Episode,
    balanced_negatives,
    highest_errors,
    run_episodes,
    srl_errors,
)


class Recorder(PixelBox):
    """Keeps the actions of the episode under way."""

    def reset(self, **kwargs: Any) -> Any:
        self.actions: list[np.ndarray] = []
        return super().reset(**kwargs)

    def step(self, action: np.ndarray) -> Any:
        self.actions.append(np.array(action))
        return super().step(action)


class Shaped(PixelBox):
    """Actions of any shape, of which the first two numbers count."""

    def __init__(self, shape: tuple[int, ...]):
        super().__init__(frame_stack=1)
        self.action_space = gym.spaces.Box(-1, 1, shape, np.float32)

    def step(self, action: np.ndarray) -> Any:
        self.position = np.clip(self.position + 0.3 * np.resize(action, 2), -1, 1)
        self.n_steps += 1
        return self.observe(), 0.0, False, self.n_steps >= self.episode_length, {}


@pytest.mark.parametrize("srl", ["forward", "inverse", "spr"])
@pytest.mark.parametrize(("shape", "flat"), [((2, 3), 6), ((1, 2), 2), ((), 1)])
def test_actions_of_any_shape_are_measured_as_vectors(srl: str, shape: tuple[int, ...], flat: int) -> None:
    """Errors of heads that read actions are those with flat actions: one for each step."""
    errors = []
    for each in (shape, (flat,)):
        model = tiny_model("CnnPolicy", Shaped(each), srl=srl)
        (episode,) = run_episodes(model, Shaped(each), 1, "random", seed=1)
        errors.append(episode.srl_errors)
    assert errors[0].shape == (20,) and errors[0].std() > 0
    np.testing.assert_array_equal(*errors)


class Talkative(SensorBox):
    """Returns a text that is not in its space."""

    def observe(self, first: bool = False) -> Any:
        return {**super().observe(first), "task": "push the T"}


@pytest.mark.parametrize("srl", ["rae", "curl"])
def test_episodes_of_dictionaries_are_measured(srl: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """By key, without keys that the space does not have; each row's error does not depend on the others."""
    model = sensor_model(srl=srl).learn(40)
    banks = [head.bank.clone() for head in model.policy.srl.heads] if srl == "curl" else []
    with balanced_negatives(model, SensorBox(), seed=1):
        changed = [not th.equal(head.bank, bank) for head, bank in zip(model.policy.srl.heads, banks, strict=False)]
        assert len(changed) == len(banks) and all(changed)
        (episode,) = run_episodes(model, Talkative(), 1, "curious", seed=2)
    assert all(th.equal(head.bank, bank) for head, bank in zip(model.policy.srl.heads, banks, strict=False))
    assert {key: len(part) for key, part in episode.observations.items()} == {"front": 20, "joints": 20, "wrist": 20}
    assert episode.srl_errors.shape == (20,) and (episode.srl_errors >= 0).all()
    batch = model.replay_buffer.sample(12)
    alone = [srl_errors(model, Samples(*(rows_of(part, slice(i, i + 1)) for part in batch[:5]))) for i in range(12)]
    monkeypatch.setattr(rollouts, "CHUNK", 5)
    np.testing.assert_allclose(srl_errors(model, batch), np.concatenate(alone), rtol=1e-4, atol=1e-6)
    worst = highest_errors(model, 3, gap=1)
    assert worst.observations["wrist"].shape == (3, 6, 28, 28) and worst.errors[0] == max(worst.errors)


@pytest.mark.parametrize("actor", ["task", "curious", "random"])
def test_the_requested_policy_acts(actor: str) -> None:
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


def test_each_frame_is_a_picture_of_its_own() -> None:
    """Also where the environment renders into one array."""
    env, canvas = Recorder(), np.zeros((4, 4, 3), np.uint8)

    def render() -> np.ndarray:
        canvas[:] = len(env.actions)
        return canvas

    env.render = render  # type: ignore[method-assign]
    (episode,) = run_episodes(tiny_model("CnnPolicy", PixelBox()), env, 1, render=True)
    assert [frame.max() for frame in episode.frames] == list(range(21))


def test_true_states_are_kept_on_request() -> None:
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
        next(run_episodes(model, env, 1, states=True))
    with pytest.raises(ValueError, match="actor must be one of 'task', 'curious', 'random', not 'best'"):
        next(run_episodes(model, env, 1, "best"))


def test_negatives_are_taken_evenly_from_each_policy() -> None:
    """A third of CURL's bank from each policy's episode, spread over it; restored after a measurement or an error."""
    model = tiny_model("CnnPolicy", PixelBox(), srl="curl", srl_kwargs=dict(bank_size=12)).learn(20)
    env, head = PixelBox(), model.policy.srl
    before = {key: value.clone() for key, value in head.state_dict().items()}
    with pytest.raises(RuntimeError), balanced_negatives(model, env, seed=3):
        for third, actor in enumerate(("task", "curious", "random")):
            (episode,) = run_episodes(model, env, 1, actor, seed=3)
            expected = episode.observations[[0, 6, 12, 19]]
            np.testing.assert_array_equal(head.bank[4 * third : 4 * third + 4].numpy(), expected)
        raise RuntimeError
    assert differences(head.state_dict(), before) == []
    # Two policies share it without a curious one; other models are left alone.
    plain = tiny_model("CnnPolicy", PixelBox(), srl="curl", curiosity=None).learn(20)
    with balanced_negatives(plain, env, seed=3):
        assert plain.policy.srl.n_banked == 64
    for other in (tiny_model("CnnPolicy", PixelBox()), SAC("MlpPolicy", VectorBox())):
        before = {key: value.clone() for key, value in other.policy.state_dict().items()}
        with balanced_negatives(other, env):
            assert differences(dict(other.policy.state_dict()), before) == []


def test_callback_logs_both_policies_at_its_interval() -> None:
    """Rows at 20 and 40 steps with both returns and both errors, equal to evaluations by hand."""
    writer = KeptRows()
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


@pytest.mark.parametrize(
    ("make", "shapes"),
    [
        (partial(tiny_model, "CnnPolicy", PixelBox()), {"": (3, 72, 108)}),
        (sensor_model, {"front": (3, 72, 108), "wrist": (3, 56, 84)}),
    ],
    ids=["image", "dictionary"],
)
def test_strips_show_newest_frames_above_their_reconstructions(make: Any, shapes: dict[str, tuple[int, ...]]) -> None:
    """Left to right the samples, of each image; heads that do not reconstruct have none."""
    model = make().learn(14)
    batch = model.policy.samples(model.replay_buffer.sample(8), random=False)
    strips = reconstruction_strips(model.policy, batch, frame_stack=2, columns=3)
    assert {key: strip.shape for key, strip in strips.items()} == shapes
    seen, drawn = map(by_key, model.policy.reconstruct(batch.observations))
    for key, strip in strips.items():
        above, below = (images[key][:3, 3:].permute(1, 2, 0, 3).flatten(2).detach() for images in (seen, drawn))
        np.testing.assert_array_equal(strip, np.concatenate([above, below], axis=1))
    assert reconstruction_strips(make(srl="curl").policy, batch, 2) == {}
    assert reconstruction_strips(tiny_model("MlpPolicy", VectorBox()).policy, batch, 2) == {}


def test_decoder_draws_what_a_frozen_encoder_sees() -> None:
    """Crops, at their size, the closer the more updates it makes; the encoder does not learn."""
    crops: dict[str, Any] = dict(augmentation="crop", augmentation_kwargs=dict(size=30))
    model = tiny_model("CnnPolicy", PixelBox(frame_stack=1), srl="curl", **crops).learn(30)
    before = {key: value.clone() for key, value in model.policy.state_dict().items()}
    distances = []
    for updates in (1, 100):
        decoder = fit_decoder(model, lambda n: model.replay_buffer.sample(n).observations, updates)
        observed, drawn = draw_latents(model, decoder, model.replay_buffer.sample(4).observations)
        assert observed.shape == drawn.shape == (4, 3, 30, 30)
        distances.append(float((observed - drawn).abs().mean()))
    assert distances[1] < 0.6 * distances[0]
    assert differences(dict(model.policy.state_dict()), before) == []


@pytest.mark.parametrize(
    ("n_envs", "kwargs"),
    [(1, dict(buffer_size=50)), (2, dict(buffer_size=500, replay_buffer_class=ReplayBuffer))],
    ids=["full", "SB3's, half full, two environments"],
)
def test_highest_errors_equal_brute_force(n_envs: int, kwargs: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    """Highest first, apart in time, whatever the chunks; looking draws no random numbers."""
    model = tiny_model("CnnPolicy", DummyVecEnv([PixelBox] * n_envs), **kwargs).learn(74)
    buffer, everything = model.replay_buffer, []
    for age, env in itertools.product(range(buffer.size()), range(n_envs)):
        place = np.array([(buffer.pos - 1 - age) % buffer.buffer_size]), np.array([env])
        observation = transitions(buffer, *place).observations
        with th.no_grad():
            drawn = model.policy.srl.decoder(model.policy.encode(observation))
        target = model.policy.srl.target(observation, dither=False)
        everything.append((age, env, float((drawn - target).square().mean())))
    before = np.random.get_state()[1].copy(), th.get_rng_state()
    for gap, chunk in ((1, 11), (6, 1000)):
        chosen: list[tuple[int, int, float]] = []
        for each in sorted(everything, key=lambda each: -each[2]):
            if len(chosen) < 7 and not any(each[1] == other[1] and abs(each[0] - other[0]) < gap for other in chosen):
                chosen.append(each)
        monkeypatch.setattr(rollouts, "CHUNK", chunk)
        found = highest_errors(model, 7, gap=gap)
        np.testing.assert_allclose(found.errors, [error for _, _, error in chosen], rtol=1e-4)
        assert found.ages.tolist() == [age * n_envs for age, _, _ in chosen]
        batch = Samples(th.as_tensor(found.observations), *[None] * 4)
        np.testing.assert_allclose(srl_errors(model, batch), found.errors, rtol=1e-4)
    assert found.mean_error == pytest.approx(np.mean([error for _, _, error in everything]), rel=1e-4)
    assert len(highest_errors(model, 10_000, gap=1).errors) == len(everything)
    np.testing.assert_array_equal(before[0], np.random.get_state()[1])
    assert th.equal(before[1], th.get_rng_state())


def test_highest_error_frames_are_drawn(tmp_path: Path) -> None:
    """With and without reconstructions, and with a row of frames that is not full."""
    model = tiny_model("CnnPolicy", PixelBox(frame_stack=2))
    with pytest.raises(ValueError, match="the replay buffer is empty"):
        highest_errors(model)
    found = highest_errors(model.learn(20), 5, gap=2)
    for name, images in (("alone.png", None), ("both.png", found.observations)):
        plots.highest_error_frames(tmp_path / name, found, 2, "title", images)
        assert np.asarray(Image.open(tmp_path / name).convert("L")).std() > 5


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


# ---------------------------------------------------------------- state probe


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


def test_state_probe_of_known_maps() -> None:
    """1 for linear functions and for angles of turning latents, about 0 for noise, NaN for constants."""
    rng = np.random.default_rng(0)
    turns = [rng.uniform(-np.pi, np.pi, (200, 1)) for _ in range(4)]
    latents = [np.hstack([np.cos(each), np.sin(each), rng.normal(size=(200, 2))]) for each in turns]
    states = [
        np.column_stack([latent @ [1, 2, 3, 4], rng.normal(size=200), np.full(200, 3.0), turn])
        for latent, turn in zip(latents, turns, strict=True)
    ]
    found = probed(latents, states, units=["m", "m", "m", "rad"])
    assert found["s0"] > 0.999 and abs(found["s1"]) < 0.05 and np.isnan(found["s2"]) and found["s3"] > 0.999
    assert probed(latents, states)["s3"] < 0.8, "as a number it jumps"
    states[1][7, 1] = np.nan
    assert probed(latents, states)["s0"] > 0.999, "others are not lost"


def test_state_probe_does_not_know_an_episode_from_itself() -> None:
    """Latents that identify the episode predict nothing of another one, however similar its own steps are."""
    rng = np.random.default_rng(0)
    latents = [np.eye(8)[[index] * 50] for index in range(8)]
    states = [np.full((50, 1), rng.normal()) + rng.normal(0, 0.01, (50, 1)) for _ in range(8)]
    assert probed(latents, states)["s0"] < 0.1


def test_probe_reads_the_latents_of_any_encoder() -> None:
    """It changes nothing; joints among the observations are read nearly perfectly; the rest is refused."""
    env = PixelBox()
    for model in (tiny_model("CnnPolicy", env, srl="curl").learn(12), SAC("CnnPolicy", env, buffer_size=10)):
        episodes = list(run_episodes(model, env, 3, "random", states=lambda env: env.unwrapped.position, seed=1))
        before = {name: value.clone() for name, value in model.policy.state_dict().items()}
        found = state_probe(model, episodes, ["x", "y"])
        assert found.keys() == {"x", "y"} and np.isfinite(list(found.values())).all()
        assert not differences(before, dict(model.policy.state_dict()))
    seen = run_episodes(sensor_model(), SensorBox(), 4, "random", states=lambda env: env.unwrapped.position, seed=0)
    assert min(state_probe(sensor_model(), seen, ["x", "y"]).values()) > 0.95
    with pytest.raises(ValueError, match="needs two episodes"):
        state_probe(model, episodes[:1], ["x", "y"])
    with pytest.raises(ValueError, match="no true states"):
        state_probe(model, run_episodes(model, env, 2, "random"), ["x", "y"])
    with pytest.raises(ValueError, match="needs a policy with an encoder"):
        state_probe(SAC("MlpPolicy", VectorBox()), episodes, ["x", "y"])
