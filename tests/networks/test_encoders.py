"""Encoders: architecture, initialisation, what they read, and the statistics that standardise vectors."""

import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from dictionaries_for_tests import SensorBox
from envs_for_tests import PixelBox, VectorBox, tiny_model
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn
from torch.nn import functional as F

from sb3_cure.networks import encoders
from sb3_cure.networks.decoders import PixelDecoder
from sb3_cure.networks.encoders import DictEncoder, Encoder, PixelEncoder, VectorEncoder, make_encoder
from sb3_cure.networks.layers import RunningStandardize, conv_sizes


def image_space(channels: int = 3, height: int = 84, width: int | None = None) -> spaces.Box:
    return spaces.Box(0, 255, (channels, height, width or height), np.uint8)


def images(space: spaces.Box, batch: int = 2) -> th.Tensor:
    """Encoder inputs: noise in [0, 1]."""
    return th.rand(batch, *space.shape, generator=th.Generator().manual_seed(0))


def test_parameters_in_the_order_that_others_rely_on() -> None:
    """conv1-4, FC, LayerNorm, with SAC-AE's sizes (84 pixels shrink to 35 x 35)."""
    encoder = PixelEncoder(image_space(9))
    shapes = [tuple(parameter.shape) for parameter in encoder.parameters()]
    convolutions = [(32, 9, 3, 3), (32,), *[(32, 32, 3, 3), (32,)] * 3]
    assert shapes == [*convolutions, (50, 32 * 35 * 35), (50,), (50,), (50,)]
    norm = list(encoder.parameters())[-2:]
    assert th.equal(norm[0], th.ones(50))
    assert th.equal(norm[1], th.zeros(50))
    assert encoder.features_dim == 50
    assert encoder.trunk_dim == 32 * 35 * 35


@pytest.mark.parametrize("tanh", [True, False])
def test_pixel_encoder_against_straight_line_code(tanh: bool) -> None:
    """Strides 2, 1, 1, 1, a ReLU after each convolution; linear map, LayerNorm and tanh of what they give."""
    space = image_space(6, 36, 40)
    encoder = PixelEncoder(space, features_dim=10, n_filters=5, tanh=tanh)
    with th.no_grad():
        for parameter in encoder.parameters():
            parameter.normal_(std=0.3, generator=th.Generator().manual_seed(parameter.numel()))
        x = images(space)
        *convolutions, weight, bias, scale, offset = encoder.parameters()
        hidden = x
        for i in range(4):
            hidden = F.conv2d(hidden, convolutions[2 * i], convolutions[2 * i + 1], stride=2 if i == 0 else 1)
            hidden = hidden.clamp(min=0)
        features = encoder.trunk(x)
        # The order in which the features are flattened is the encoder's own business.
        th.testing.assert_close(features.sort(dim=1).values, hidden.flatten(1).sort(dim=1).values)
        projected = features @ weight.T + bias
        centered = projected - projected.mean(dim=1, keepdim=True)
        latents = centered / (centered.square().mean(dim=1, keepdim=True) + 1e-5).sqrt() * scale + offset
        th.testing.assert_close(encoder(x), latents.tanh() if tanh else latents)


def test_latents_lie_within_the_tanh() -> None:
    """[B, 50] in (-1, 1) by default; CURL's latents have no such bound."""
    space = image_space(9, 48)
    with th.no_grad():
        latents = PixelEncoder(space)(images(space, 16))
        unbounded = PixelEncoder(space, tanh=False)(images(space, 16))
    assert latents.shape == (16, 50)
    assert float(latents.abs().max()) < 1
    assert float(unbounded.abs().max()) > 1


@pytest.mark.parametrize("module", [PixelEncoder(image_space(9, 24)), PixelDecoder(50, (9, 24, 24))])
def test_delta_orthogonal_initialisation(module: nn.Module) -> None:
    """Convolutions: only the central tap, orthogonal with gain sqrt(2); linear maps: orthogonal; biases: zero."""
    kinds = set()
    for layer in module.modules():
        if isinstance(layer, nn.Conv2d | nn.ConvTranspose2d):
            center = layer.weight.detach()[:, :, 1, 1]
            assert float(layer.weight.detach().abs().sum()) == pytest.approx(float(center.abs().sum()))
            gain = 2.0
        elif isinstance(layer, nn.Linear):
            center, gain = layer.weight.detach(), 1.0
        else:
            continue
        kinds.add(nn.Linear if isinstance(layer, nn.Linear) else nn.Conv2d)
        # Rows or columns, whichever are fewer, are orthogonal and of equal length.
        smaller = center if len(center) <= center.shape[1] else center.T
        th.testing.assert_close(smaller @ smaller.T, gain * th.eye(len(smaller)), rtol=0, atol=1e-5)
        assert th.equal(layer.bias, th.zeros_like(layer.bias))
    assert len(kinds) == 2


@given(st.integers(1, 40), st.integers(1, 40), st.integers(1, 6))
@settings(deadline=None, max_examples=60)
def test_smallest_image(height: int, width: int, n_layers: int) -> None:
    """Exactly the sizes through which a 3x3 window fits at every layer are accepted, with the right shapes."""
    layers = [nn.Conv2d(1, 1, 3, stride=2 if i == 0 else 1) for i in range(n_layers)]
    try:
        expected = tuple(nn.Sequential(*layers)(th.zeros(1, 1, height, width)).shape[2:])
    except RuntimeError:
        with pytest.raises(ValueError, match=f"need at least {4 * n_layers - 1}x{4 * n_layers - 1}"):
            conv_sizes(height, width, n_layers)
    else:
        assert conv_sizes(height, width, n_layers)[-1] == expected


@pytest.mark.parametrize("memory_format", [th.contiguous_format, th.channels_last])
@pytest.mark.parametrize("make", [PixelEncoder, lambda space: make_encoder(MeanColour, space)])
def test_bytes_and_scaled_floats_give_the_same_latents(make: Any, memory_format: th.memory_format) -> None:
    """Views in 0-255, as stored, and images in [0, 1]; neither is written to."""
    space = image_space(3, 20, 24)
    encoder = make(space)
    views = th.randint(256, (2, *space.shape), dtype=th.uint8, generator=th.Generator().manual_seed(0))
    views = views.contiguous(memory_format=memory_format)
    scaled = views.float() / 255
    before = views.clone(), scaled.clone()
    assert th.equal(encoder(views), encoder(scaled))
    assert th.equal(views, before[0]) and th.equal(scaled, before[1])


def test_large_cameras_are_warned_of_before_memory_is_spent(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the parameters that the projection would have, and a remedy."""

    def allocate(*args: Any) -> None:
        raise AssertionError("allocated")

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(PixelEncoder(image_space(9, 100)).projection.linear.weight) == 50
        monkeypatch.setattr(encoders, "Projection", allocate)
        for height, width, n in ((480, 640, 117), (240, 320, 28)):
            with pytest.raises(UserWarning, match=rf"{height}x{width} .* {n} million parameters, .* ResizeImages"):
                PixelEncoder(image_space(3, height, width))


@pytest.mark.parametrize("features_dim", [1, 2])
def test_too_few_latents_are_refused(features_dim: int) -> None:
    """LayerNorm makes 0 of one number, and of two their order: all observations would look alike."""
    for make in (lambda **k: PixelEncoder(image_space(), **k), lambda **k: VectorEncoder(spaces.Box(-1, 1, (7,)), **k)):
        with pytest.raises(ValueError, match=rf"features_dim={features_dim} is too small: .* Use at least 3"):
            make(features_dim=features_dim)


@pytest.mark.parametrize(
    "space, n_inputs",
    [(spaces.Box(-1, 1, (3,)), 3), (spaces.Box(-1, 1, (2, 3)), 6), (spaces.MultiBinary(4), 4)],
    ids=["vector", "matrix", "bits"],
)
def test_vector_encoder(space: spaces.Space, n_inputs: int) -> None:
    """One hidden layer and a ReLU as the trunk, then the same projection; parameters in the same order."""
    encoder = VectorEncoder(space, features_dim=6, hidden_dim=7)
    shapes = [tuple(parameter.shape) for parameter in encoder.parameters()]
    assert shapes == [(7, n_inputs), (7,), (6, 7), (6,), (6,), (6,)]
    x = th.randn(5, *space.shape, generator=th.Generator().manual_seed(0))
    features = encoder.trunk(x)
    assert features.shape == (5, 7)
    assert float(features.detach().min()) == 0
    latents = encoder(x)
    assert latents.shape == (5, 6)
    assert float(latents.detach().abs().max()) < 1
    assert float(VectorEncoder(space, features_dim=6, tanh=False)(x).detach().abs().max()) > 1


class MeanColour(BaseFeaturesExtractor):
    """A user's extractor: the mean of each channel through a linear map."""

    def __init__(self, observation_space: spaces.Space, features_dim: int = 5):
        super().__init__(observation_space, features_dim)
        self.linear = nn.Linear(observation_space.shape[0], features_dim)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        assert float(observations.max()) <= 1
        return self.linear(observations.mean(dim=(2, 3)))


class SumOfVector(BaseFeaturesExtractor):
    """A user's extractor of vectors."""

    def __init__(self, observation_space: spaces.Space):
        super().__init__(observation_space, 5)
        self.linear = nn.Linear(observation_space.shape[0], 5)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return self.linear(observations)


class Viewing(BaseFeaturesExtractor):
    """A user's extractor that flattens with ``view``, which SB3's memory order allows."""

    def __init__(self, observation_space: spaces.Space):
        super().__init__(observation_space, 5)
        self.convolution = nn.Conv2d(observation_space.shape[0], 2, 3, stride=3)
        self.linear = nn.Linear(2 * 12 * 12, 5)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        features = self.convolution(observations)
        return self.linear(features.view(len(features), -1))


@pytest.mark.parametrize(
    "policy, env, extractor, srl_kwargs",
    [
        (
            "CnnPolicy",
            PixelBox(),
            MeanColour,
            {"srl": "curl", "augmentation": "crop", "augmentation_kwargs": {"size": 24}},
        ),
        ("MlpPolicy", VectorBox(), SumOfVector, {"srl": "rae"}),
        ("CnnPolicy", PixelBox(), Viewing, {"srl": "rae"}),
    ],
    ids=["own-curl-crop", "own-vector", "own-view"],
)
@pytest.mark.parametrize("update", ["joint", "sequential"])
def test_any_features_extractor_is_shared(
    policy: str, env: gym.Env, extractor: type, srl_kwargs: Any, update: str
) -> None:
    """It is trained, every part of the agent reads it, and actors have a projection of its features."""
    policy_kwargs = {"features_extractor_class": extractor}
    model = tiny_model(policy, env, policy_kwargs=policy_kwargs, update=update, **srl_kwargs)
    encoder = model.policy.encoder
    assert isinstance(encoder, Encoder)
    assert encoder.features_dim == encoder.trunk_dim == 5
    before = [parameter.detach().clone() for parameter in encoder.parameters()]
    model.learn(12)
    assert model._n_updates == 2
    assert any(isinstance(module, extractor) for module in encoder.modules())
    assert all(not th.equal(a, b) for a, b in zip(before, encoder.parameters(), strict=True))
    observations = model.policy.obs_to_tensor(env.reset(seed=0)[0])[0]
    assert model.policy.encode(observations).shape == (1, 5)
    assert model.predict(env.reset(seed=0)[0])[0].shape == env.action_space.shape


def test_make_encoder_leaves_ours_as_they_are() -> None:
    """Encoders of this package are not wrapped; others become one whose latents are their features."""
    space = image_space(3, 36)
    assert type(make_encoder(PixelEncoder, space, n_filters=2)) is PixelEncoder
    wrapped = make_encoder(MeanColour, space, features_dim=4)
    x = images(space)
    assert isinstance(wrapped, Encoder)
    assert th.equal(wrapped(x), wrapped.trunk(x))


def test_encoder_with_a_forward_of_its_own_is_refused() -> None:
    """Critics would read latents of trunk and projection, and their targets those of forward."""

    class Unit(PixelEncoder):
        def forward(self, views: Any) -> th.Tensor:
            return F.normalize(super().forward(views))

    with pytest.raises(ValueError, match="Unit overrides forward"):
        make_encoder(Unit, image_space(3, 36))


@pytest.mark.parametrize("update", ["joint", "sequential"])
def test_pretrained_extractor_may_be_frozen(update: str) -> None:
    """Its parameters stay, everything that reads its features learns."""

    class Frozen(SumOfVector):
        def __init__(self, observation_space: spaces.Space):
            super().__init__(observation_space)
            self.requires_grad_(False)

    model = tiny_model(
        "MlpPolicy",
        VectorBox(),
        update=update,
        policy_kwargs={"features_extractor_class": Frozen, "features_extractor_kwargs": {}},
    )
    policy = model.policy
    modules = {"encoder": policy.encoder, "head": policy.srl, "critic": policy.critic, "actor": policy.actor}
    before = {name: [p.detach().clone() for p in module.parameters()] for name, module in modules.items()}
    model.learn(13)
    changed = {
        name
        for name, module in modules.items()
        if not all(th.equal(a, b) for a, b in zip(before[name], module.parameters(), strict=True))
    }
    assert changed == {"head", "critic", "actor"}


# ---------------------------------------------------------------- running statistics of vectors


def vectors(n: int, seed: int) -> th.Tensor:
    """Joints of .1 rad beside forces of 100 N, one of them constant."""
    noise = th.randn(n, 4, generator=th.Generator().manual_seed(seed))
    return noise * th.tensor([0.1, 100.0, 0.1, 0.0]) + th.tensor([0.0, 50.0, 1.0, 1000.1])


def standardizer(**kwargs: Any) -> RunningStandardize:
    return RunningStandardize(spaces.Box(-np.inf, np.inf, (4,)), **kwargs)


def test_entries_are_standardised_each_by_itself() -> None:
    """After any number of updates by mean and deviation of all batches; a constant entry gives 0."""
    standardize, seen = standardizer(), [vectors(64, seed) for seed in range(5)]
    for batch in seen:
        standardize.update(batch)
    together = th.cat(seen)
    expected = (together - together.mean(dim=0)) / together.std(dim=0, correction=0)
    found = standardize(together)
    # Early batches weigh a little less than late ones.
    th.testing.assert_close(found[:, :3], expected[:, :3], rtol=0.02, atol=0.02)
    assert not found[:, 3].any()


@pytest.mark.parametrize("size", [1.0, 1e3, 1e6])
def test_large_numbers_that_vary_are_no_constants(size: float) -> None:
    """Absolute positions and encoder ticks: five parts in a million are told from rounding."""
    standardize = RunningStandardize(spaces.Box(-np.inf, np.inf, (2,)))
    noise = th.randn(500, 256, 1, generator=th.Generator().manual_seed(0))
    for batch in th.cat([size * (1 + 5e-6 * noise), th.full_like(noise, 1.1 * size)], dim=2):
        standardize.update(batch)
    found = standardize(batch)
    assert 0.8 < float(found[:, 0].std()) < 1.2
    assert not found[:, 1].any()


def test_old_batches_fade() -> None:
    standardize = standardizer(decay=0.9)
    for seed in range(100):
        standardize.update(vectors(256, seed) + (0 if seed < 20 else 7))
    found = standardize(vectors(256, 200) + 7)
    assert found[:, :3].mean(dim=0).abs().max() < 0.2


def test_nothing_explodes() -> None:
    """Outliers are clipped, infinite numbers move no statistics, and before the first update none are used."""
    standardize = standardizer()
    th.testing.assert_close(standardize(th.tensor([[0.5, -1.0, 200.0, 0.0]])), th.tensor([[0.5, -1.0, 10.0, 0.0]]))
    standardize.update(vectors(64, 0))
    state = {name: value.clone() for name, value in standardize.state_dict().items()}
    standardize.update(th.full((4, 4), th.inf))
    assert all(th.equal(value, state[name]) for name, value in standardize.state_dict().items())
    assert standardize(th.full((1, 4), 1e9)).tolist() == [[10.0, 10.0, 10.0, 0.0]]


def test_joints_move_latents_beside_forces() -> None:
    """.1 rad beside forces of 100 N moves the joint's entry by its deviation, and nothing else."""
    space = spaces.Dict({"front": image_space(3, 36), "joints": spaces.Box(-np.inf, np.inf, (4,))})
    encoder = DictEncoder(space, n_filters=2)
    views = {"front": th.zeros(64, 3, 36, 36, dtype=th.uint8), "joints": vectors(64, 0)}
    encoder.update_statistics(views)
    moved = {**views, "joints": views["joints"] + th.tensor([0.1, 0.0, 0.0, 0.0])}
    difference = (encoder(moved) - encoder(views)).detach()
    assert 0.8 < float(difference[:, 50].mean()) < 1.2
    difference[:, 50] = 0
    assert not difference.any()
    assert encoder.features_dim == 50 + 4 and encoder.make_projection()(encoder.trunk(views)).shape == (64, 54)


def test_dictionaries_without_images_are_one_vector() -> None:
    """Discrete values one-hot, in the order of the keys."""
    space = spaces.Dict({"goal": spaces.Box(-1, 1, (2, 2)), "mode": spaces.Discrete(3)})
    views = {"goal": th.rand(5, 2, 2), "mode": th.tensor([0, 1, 2, 1, 0])}
    encoder = VectorEncoder(space, features_dim=6)
    joined = th.cat([views["goal"].flatten(1), F.one_hot(views["mode"], 3)], dim=1)
    th.testing.assert_close(encoder.trunk[0](views), joined)  # type: ignore[index]
    encoder.update_statistics(views)
    th.testing.assert_close(encoder.trunk[0].mean, joined.mean(dim=0))  # type: ignore[index]
    assert encoder(views).shape == (5, 6)


@pytest.mark.parametrize("policy, env", [("MlpPolicy", VectorBox), ("MultiInputPolicy", SensorBox)])
def test_statistics_follow_updates_alone(policy: str, env: type[gym.Env]) -> None:
    """Once an update, those of targets too; never while acting, nor where the representation is frozen."""
    srl = "forward" if policy == "MultiInputPolicy" else "rae"
    model = tiny_model(policy, env(), srl=srl).learn(10)

    def statistics(encoder: Encoder) -> dict[str, th.Tensor]:
        return {name: value.clone() for name, value in encoder.named_buffers()}

    def n_updates() -> float:
        (weight,) = (value for name, value in statistics(model.policy.encoder).items() if name.endswith("weight"))
        return float(np.log1p(-float(weight[0])) / np.log(0.999))

    assert n_updates() == 0
    for total in (11, 12, 15):
        model.learn(total - model.num_timesteps, reset_num_timesteps=False)
        assert n_updates() == pytest.approx(total - 10, rel=1e-3)
        target = statistics(model.policy.encoder_target)
        assert all(th.equal(value, target[name]) for name, value in statistics(model.policy.encoder).items())
    model.predict(model.env.reset())
    model.representation_frozen = True
    model.train(2, 8)
    assert n_updates() == pytest.approx(5, rel=1e-3)
