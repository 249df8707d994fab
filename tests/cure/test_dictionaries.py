"""Observations that are dictionaries: of images and vectors, and of vectors alone."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from dictionaries_for_tests import Goal, SensorBox, sensor_model
from envs_for_tests import PixelBox, differences, state_of, tiny_model
from gymnasium import spaces
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.torch_layers import CombinedExtractor
from stable_baselines3.common.vec_env import VecFrameStack, VecNormalize
from updates_for_tests import StraightLine, prepare, sampled, train_once

from sb3_cure import CuReSAC, CuReTQC
from sb3_cure.data.samples import Samples
from sb3_cure.networks.augmentations import Augmentation, RandomCrop, RandomShift
from sb3_cure.networks.layers import MeanError
from sb3_cure.srl import RAE, DictHead

# ---------------------------------------------------------------- one key is no other method


@pytest.mark.parametrize(
    "kwargs",
    [
        {},
        {"srl": "curl", "update": "sequential"},
        {"srl": "curl", "augmentation": "crop", "augmentation_kwargs": {"size": 28}, "curiosity": "bonus"},
        {"srl": None, "curiosity": None, "augmentation": "shift"},
    ],
)
def test_one_image_trains_as_without_dictionary(kwargs: dict[str, Any]) -> None:
    """Latents, actions and every parameter after updates are those of the plain image, bit for bit."""
    network = {"features_extractor_kwargs": {"features_dim": 8, "n_filters": 4, "n_layers": 2}}
    plain = tiny_model("CnnPolicy", PixelBox(), **kwargs, policy_kwargs=network).learn(20)
    ours = sensor_model(SensorBox(("front",)), **kwargs).learn(20)
    assert plain._n_updates == ours._n_updates == 10
    for mine, theirs in zip(ours.policy.parameters(), plain.policy.parameters(), strict=True):
        assert th.equal(mine, theirs)
    image = plain.observation_space.sample()
    actions, _ = ours.predict({"front": image}, deterministic=True)
    np.testing.assert_array_equal(actions, plain.predict(image, deterministic=True)[0])
    assert type(plain.policy.srl) is not DictHead


class Flat(gym.ObservationWrapper):
    """As one vector."""

    def __init__(self, env: gym.Env):
        super().__init__(env)
        self.observation_space = spaces.Box(-np.inf, np.inf, (6,), np.float32)

    def observation(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        return np.concatenate([observation[key] for key in self.env.observation_space]).astype(np.float32)


@pytest.mark.parametrize("kwargs", [{}, {"srl": None, "intrinsic": "reconstruction"}])
def test_dictionary_without_images_acts_as_one_vector(kwargs: dict[str, Any]) -> None:
    """Of an environment in the style of Gymnasium-Robotics, bit for bit."""
    network = {"features_extractor_kwargs": {"features_dim": 8, "hidden_dim": 16}}
    ours = tiny_model("MultiInputPolicy", Goal(), **kwargs, policy_kwargs=network).learn(20)
    plain = tiny_model("MlpPolicy", Flat(Goal()), **kwargs, policy_kwargs=network).learn(20)
    assert ours._n_updates == 10
    assert differences(state_of(ours), state_of(plain)) == []


def test_hindsight_trains_with_sb3s_own_buffer() -> None:
    model = tiny_model("MultiInputPolicy", Goal(), replay_buffer_class=HerReplayBuffer).learn(30)
    assert type(model.replay_buffer) is HerReplayBuffer
    assert model._n_updates > 0 and np.isfinite(train_once(model)["srl_error"])


# ---------------------------------------------------------------- several keys, written out


class TwoCameras(StraightLine):
    """An update of the agent with two images and a vector."""

    parts = (slice(0, 8), slice(8, 16))

    def standardise_by(self, observations: Any) -> None:
        super().standardise_by(observations["joints"])

    def scaled(self, observations: Any) -> Any:
        if isinstance(observations, dict):
            return {key: super(TwoCameras, self).scaled(part) for key, part in observations.items()}
        return super().scaled(observations)

    def srl(self, batch: Samples, latents: th.Tensor) -> tuple[th.Tensor, th.Tensor]:  # type: ignore[override]
        losses, errors, joint = [], [], self.head
        for i, key in enumerate(("front", "wrist")):
            self.head = joint.heads[i]
            loss, error = super().srl(batch.of(key), latents[:, 8 * i : 8 * i + 8])
            losses.append(loss)
            errors.append(error / error.square().mean().sqrt())
        self.head = joint
        return losses[0] + losses[1], (errors[0] + errors[1]) / 2


@pytest.mark.parametrize("algorithm", [CuReSAC, CuReTQC])
@pytest.mark.parametrize("update", ["joint", "sequential"])
def test_whole_update_of_two_images_equals_straight_line_code(algorithm: type[CuReSAC], update: str) -> None:
    """Every loss, and every parameter, target and temperature after it."""
    quantiles = {} if algorithm is CuReSAC else {"n_quantiles": 5}
    model = sensor_model(
        SensorBox(),
        algorithm,
        learning_starts=40,
        learning_rate=0.03,
        tau=0.2,
        encoder_tau=0.6,
        gamma=0.95,
        curiosity_beta=0.7,
        curiosity_gamma=0.8,
        curiosity_prob=0.0,
        update=update,
        policy_kwargs={
            "optimizer_class": th.optim.SGD,
            "features_extractor_kwargs": {"features_dim": 8, "n_filters": 4, "n_layers": 2},
            **quantiles,
        },
    ).learn(40)
    prepare(model)
    batch = sampled(model)
    written_out = TwoCameras(model)
    expected = written_out.update(batch, update == "sequential")
    before = StraightLine(model).groups()
    logged = train_once(model)
    assert {name: logged[name] for name in expected} == pytest.approx(expected, rel=1e-4, abs=1e-6)
    for old, actual, wanted in zip(before, StraightLine(model).groups(), written_out.groups(), strict=True):
        distance = float((wanted - old).norm())
        assert float((actual - wanted).norm()) < 2e-3 * distance + 1e-6 * float(old.norm()) + 1e-7


# ---------------------------------------------------------------- the encoder


def test_latents_are_those_of_each_image_then_vectors() -> None:
    """Of the encoder and of its moving average, which share no parameter."""
    policy = sensor_model().learn(12).policy
    seen = {key: th.as_tensor(part[None]) for key, part in policy.observation_space.sample().items()}
    for encoder in (policy.encoder, policy.encoder_target):
        joints = (seen["joints"] - encoder.trunk.vectors.mean) / encoder.trunk.vectors.variance.sqrt()
        expected = [encoder.images["front"](seen["front"]), encoder.images["wrist"](seen["wrist"]), joints]
        th.testing.assert_close(encoder(seen), th.cat(expected, dim=1))
    assert not {id(p) for p in policy.encoder.parameters()} & {id(p) for p in policy.encoder_target.parameters()}


def test_each_image_has_its_own_settings() -> None:
    """``by_key`` over what the head asks for over the shared ones; cameras differ in size."""
    network = {
        "features_dim": 6,
        "n_filters": 4,
        "n_layers": 2,
        "by_key": {"wrist": {"n_layers": 1, "features_dim": 3}},
    }
    crops = {"srl": "curl", "augmentation": "crop", "augmentation_kwargs": {"size": 24}}
    model = sensor_model(**crops, policy_kwargs={"features_extractor_kwargs": network})
    encoder = model.policy.encoder
    assert (encoder.images["front"].n_layers, encoder.images["wrist"].n_layers) == (2, 1)
    assert [encoder.slices[key] for key in ("front", "wrist")] == [slice(0, 6), slice(6, 9)]
    assert encoder.features_dim == 6 + 3 + 2
    assert not any(image.projection.tanh for image in encoder.images.values())  # as CURL asks of crops
    assert not model.policy.actor.features_extractor.parts[0].tanh


def test_head_chooses_an_augmentation_for_each_image() -> None:
    """CURL crops what is larger than 84 pixels and shifts the rest; each image is moved by itself, vectors stay."""

    class Large(SensorBox):
        def __init__(self) -> None:
            super().__init__(size=90)

    augmentation = sensor_model(Large(), srl="curl").policy.augmentation
    assert {key: type(part) for key, part in augmentation.images.items()} == {"front": RandomCrop, "wrist": RandomShift}
    assert augmentation.view_space["front"].shape == (6, 76, 76) and augmentation.view_space["joints"].shape == (2,)
    assert type(sensor_model().policy.augmentation) is Augmentation
    shifted = sensor_model(srl="curl").policy.augmentation
    index = th.arange(28, dtype=th.uint8).expand(8, 6, 28, 28)
    seen = {"front": index, "wrist": index, "joints": th.zeros(8, 2)}
    views = shifted(seen, th.Generator().manual_seed(0))
    assert not th.equal(views["front"], views["wrist"]) and views["joints"] is seen["joints"]
    assert th.equal(shifted.center(seen)["front"], index)


# ---------------------------------------------------------------- heads, rewards


def test_error_is_the_mean_over_images_by_their_own_sizes() -> None:
    """Whatever the sizes of their numbers; measured without noise it does not move these."""
    model = sensor_model().learn(40)
    head, policy = model.policy.srl, model.policy
    assert isinstance(head, DictHead) and [type(each) for each in head.heads] == [RAE, RAE]
    batch = policy.samples(model.replay_buffer.sample(16), random=False)
    latents = policy.encode(batch.observations)
    before = head.mean_error.mean_squares.clone()
    errors = [
        each.error(batch.of(key), latents[:, policy.encoder.slices[key]])
        for key, each in zip(("front", "wrist"), head.heads, strict=True)
    ]
    sizes = (before / head.mean_error.weight).sqrt()
    expected = (errors[0] / sizes[0] + errors[1] / sizes[1]) / 2
    th.testing.assert_close(policy.error(batch), expected)
    assert th.equal(head.mean_error.mean_squares, before) and float(before.min()) > 0
    # A sensor whose numbers are a thousand times as large weighs the same.
    alike = th.stack([errors[0], 1000 * errors[1]])
    head.mean_error.mean_squares.copy_(before * th.tensor([1.0, 1e6]))
    th.testing.assert_close(head.mean_error(alike, learns=False), expected)
    head.mean_error(th.full((2, 16), th.inf), learns=True)
    assert head.mean_error.mean_squares.isfinite().all()


def test_camera_that_shows_no_change_does_not_drown_the_other() -> None:
    """What is left of its errors is noise; those of the other camera decide."""
    mean_error, rng = MeanError(2), th.Generator().manual_seed(0)
    for _ in range(300):
        moving = th.rand(64, generator=rng)
        still = 0.01 + 1e-5 * th.randn(64, generator=rng)
        joint = mean_error([moving, still], learns=True)
    assert th.corrcoef(th.stack([moving, joint]))[0, 1] > 0.99
    assert mean_error([2 * moving, still], learns=False).mean() > 1.3 * joint.mean()


# ---------------------------------------------------------------- environments


@pytest.mark.parametrize("curiosity", ["separate", "random"])
def test_discrete_keys_and_several_environments(curiosity: str) -> None:
    """Numbers are one-hot; the second actor acts in some environments of several."""
    env = make_vec_env(SensorBox, 3, env_kwargs={"keys": ("front", "joints", "mode")})
    model = sensor_model(env, curiosity=curiosity, curiosity_prob=0.5).learn(45)
    assert model.policy.encoder.vector_dim == 2 + 3 and model._n_updates > 0


def test_stacks_of_sb3_are_stored_once() -> None:
    """``VecFrameStack`` stacks images and vectors."""
    env = VecFrameStack(make_vec_env(SensorBox, 2, env_kwargs={"frame_stack": 1, "tells_frame_stack": False}), 3)
    model = sensor_model(env).learn(30)
    assert {key: ring.frame_stack for key, ring in model.replay_buffer.rings.items()} == {"front": 3, "wrist": 3}
    assert model.policy.encoder.vector_dim == 6


def test_normalised_vectors_beside_images() -> None:
    """As they come out of ``VecNormalize``; the buffer keeps the original ones."""
    env = VecNormalize(make_vec_env(SensorBox, 1), norm_obs_keys=["joints"])
    model = sensor_model(env).learn(30)
    batches = []
    for normalizer in (env, None):
        np.random.seed(0)
        batches.append(model.replay_buffer.sample(64, env=normalizer).observations)
    expected = (batches[1]["joints"].numpy() - env.obs_rms["joints"].mean) / np.sqrt(env.obs_rms["joints"].var + 1e-8)
    np.testing.assert_allclose(batches[0]["joints"], expected, rtol=1e-4, atol=1e-5)
    assert th.equal(batches[0]["front"], batches[1]["front"]) and batches[0]["front"].dtype == th.uint8


def test_extractor_that_mixes_images_trains_without_head() -> None:
    """Heads need the latents of each image."""
    network = {"features_extractor_class": CombinedExtractor, "features_extractor_kwargs": {"cnn_output_dim": 8}}
    env = SensorBox(size=64, keys=("front", "joints"))
    with pytest.raises(ValueError, match="needs the latents of each image"):
        sensor_model(env, policy_kwargs=network)
    assert sensor_model(env, srl=None, curiosity=None, policy_kwargs=network).learn(14)._n_updates == 4


@pytest.mark.parametrize("srl", ["rae", None])
def test_arguments_of_an_unknown_image_are_refused(srl: str | None) -> None:
    """They would be left out, and another encoder trained."""
    network = {"features_extractor_kwargs": {"n_layers": 2, "by_key": {"writs": {"n_filters": 2}}}}
    with pytest.raises(ValueError, match=r"by_key names \['writs'\], but the images are \['front', 'wrist'\]"):
        sensor_model(srl=srl, policy_kwargs=network)


@pytest.mark.parametrize("dtype", [np.float32, np.int64])
def test_policy_refuses_images_that_are_not_bytes(dtype: Any) -> None:
    """Such as those of environments in SB3's workers: they were not scaled as those of the replay buffer are."""
    model = sensor_model()
    observation: Any = model.observation_space.sample()
    model.predict(observation)
    with pytest.raises(ValueError, match="images must be uint8, not torch"):
        model.predict({**observation, "front": observation["front"].astype(dtype)})
