"""Encoders and the networks that read them: architecture, initialisation, ranges and number formats."""

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
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, NatureCNN
from torch import nn
from torch.nn import functional as F

from sb3_cure.data.samples import Samples
from sb3_cure.networks import layers
from sb3_cure.networks.decoders import PixelDecoder
from sb3_cure.networks.encoders import Encoder, PixelEncoder, VectorEncoder, make_encoder
from sb3_cure.networks.layers import conv_sizes, preprocess


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


def test_actors_and_critics_are_initialised_alike() -> None:
    """Orthogonal linear maps and zero biases in both agents (SAC-AE), not torch's default."""
    policy = tiny_model("CnnPolicy", PixelBox()).policy
    for network in (policy.actor, policy.critic, policy.curious.actor, policy.curious.critic):
        linear = [layer for layer in network.modules() if isinstance(layer, nn.Linear | layers.EnsembleLinear)]
        assert len(linear) >= 2
        for layer in linear:
            weights = layer.weight.detach()
            for weight in weights if weights.dim() == 3 else [weights]:
                smaller = weight if len(weight) <= weight.shape[1] else weight.T
                th.testing.assert_close(smaller @ smaller.T, th.eye(len(smaller)), rtol=0, atol=1e-5)
            assert not layer.bias.any()


@given(st.integers(1, 40), st.integers(1, 40), st.integers(1, 6))
@settings(deadline=None, max_examples=60)
def test_smallest_image(height: int, width: int, n_layers: int) -> None:
    """Just the sizes through which a 3x3 window fits at every layer are accepted, and their shapes are foretold."""
    layers = [nn.Conv2d(1, 1, 3, stride=2 if i == 0 else 1) for i in range(n_layers)]
    try:
        expected = tuple(nn.Sequential(*layers)(th.zeros(1, 1, height, width)).shape[2:])
    except RuntimeError:
        with pytest.raises(ValueError, match=rf"{height}x{width} pixels are too small for {n_layers} convolutions"):
            conv_sizes(height, width, n_layers)
    else:
        assert conv_sizes(height, width, n_layers)[-1] == expected


def test_an_image_that_is_too_small_is_refused_with_the_size_that_would_do() -> None:
    """The sentence names the smallest size, which works."""
    with pytest.raises(ValueError, match=r"14x20 pixels are too small for 4 convolutions, which need at least 15x15"):
        PixelEncoder(image_space(3, 14, 20))
    space = image_space(3, 15, 20)
    assert PixelEncoder(space, n_filters=2)(images(space)).shape == (2, 50)


@pytest.mark.parametrize("features_dim", [1, 2])
def test_too_few_latents_are_refused(features_dim: int) -> None:
    """LayerNorm makes 0 of one number, and of two their order: no observation would be told from another."""
    for make in (lambda **k: PixelEncoder(image_space(), **k), lambda **k: VectorEncoder(spaces.Box(-1, 1, (7,)), **k)):
        with pytest.raises(ValueError, match=rf"features_dim is {features_dim}, .* use at least 3"):
            make(features_dim=features_dim)


def test_pixel_encoder_refuses_vectors() -> None:
    with pytest.raises(ValueError, match=r"shape \(7,\): use 'MlpPolicy' for vectors"):
        PixelEncoder(spaces.Box(-1, 1, (7,)))


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

    def __init__(self, observation_space: spaces.Space, features_dim: int = 12):
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


class ImageAndVector(BaseFeaturesExtractor):
    """A user's extractor of a dictionary, as SB3's documentation writes it."""

    def __init__(self, observation_space: spaces.Dict):
        super().__init__(observation_space, 6)
        self.image = Viewing(observation_space["front"])
        self.vector = nn.Linear(2, 1)

    def forward(self, observations: dict[str, th.Tensor]) -> th.Tensor:
        return th.cat([self.image(observations["front"]), self.vector(observations["joints"])], dim=1)


def test_vectors_beside_images_reach_an_extractor_in_full_precision() -> None:
    """.5000 and .5005, which are one number in bf16."""
    policy_kwargs = {"features_extractor_class": ImageAndVector}
    env = SensorBox(("front", "joints"))
    policy = tiny_model("MultiInputPolicy", env, srl="forward", precision="bf16", policy_kwargs=policy_kwargs).policy
    seen = {
        "front": th.zeros(2, 6, 36, 36, dtype=th.uint8),
        "joints": th.tensor([[0.5, 0.5], [0.5005, 0.5]]),
    }
    with th.autocast("cpu", th.bfloat16):
        latents = policy.encode(seen)
    expected = 0.0005 * policy.encoder.trunk.extractor.vector.weight[0, 0]
    th.testing.assert_close(latents[1, 5] - latents[0, 5], expected, rtol=1e-2, atol=0)


@pytest.mark.parametrize(
    "policy, env, extractor, kwargs, srl_kwargs",
    [
        ("CnnPolicy", PixelBox(), NatureCNN, {"features_dim": 16}, {"srl": "rae"}),
        ("CnnPolicy", PixelBox(), NatureCNN, {"features_dim": 16}, {"srl": "curl"}),
        (
            "CnnPolicy",
            PixelBox(),
            MeanColour,
            {},
            {"srl": "curl", "augmentation": "crop", "augmentation_kwargs": {"size": 24}},
        ),
        ("MlpPolicy", VectorBox(), SumOfVector, {}, {"srl": "rae"}),
        ("CnnPolicy", PixelBox(), Viewing, {}, {"srl": "rae"}),
    ],
    ids=["nature-rae", "nature-curl", "own-curl-crop", "own-vector", "own-view"],
)
@pytest.mark.parametrize("precision", ["fp32", "bf16"])
@pytest.mark.parametrize("update", ["joint", "sequential"])
def test_any_features_extractor_is_shared(
    policy: str, env: gym.Env, extractor: type, kwargs: dict[str, Any], srl_kwargs: Any, update: str, precision: str
) -> None:
    """It is trained, every part of the agent reads it, and actors have a projection of its features."""
    policy_kwargs = {"features_extractor_class": extractor, "features_extractor_kwargs": kwargs}
    model = tiny_model(policy, env, policy_kwargs=policy_kwargs, update=update, precision=precision, **srl_kwargs)
    encoder = model.policy.encoder
    dim = kwargs.get("features_dim", 12 if extractor is MeanColour else 5)
    assert isinstance(encoder, Encoder)
    assert encoder.features_dim == encoder.trunk_dim == dim
    before = [parameter.detach().clone() for parameter in encoder.parameters()]
    model.learn(12)
    assert model._n_updates == 2
    assert any(isinstance(module, extractor) for module in encoder.modules())
    assert all(not th.equal(a, b) for a, b in zip(before, encoder.parameters(), strict=True))
    observations = model.policy.obs_to_tensor(env.reset(seed=0)[0])[0]
    assert model.policy.encode(observations).shape == (1, dim)
    assert model.predict(env.reset(seed=0)[0])[0].shape == env.action_space.shape


def test_make_encoder_leaves_ours_as_they_are() -> None:
    """Encoders of this package are not wrapped; others become one whose latents are their features."""
    space = image_space(3, 36)
    assert type(make_encoder(PixelEncoder, space, n_filters=2)) is PixelEncoder
    wrapped = make_encoder(MeanColour, space, features_dim=4)
    x = images(space)
    assert isinstance(wrapped, Encoder)
    assert th.equal(wrapped(x), wrapped.trunk(x))


def test_log_std_is_rescaled_not_clamped() -> None:
    """Within [-10, 2] (the paper's bounds) for any features, the middle at 0, with a gradient almost everywhere."""
    actor = tiny_model("CnnPolicy", PixelBox()).policy.actor
    features = th.rand(64, actor.features_extractor.linear.in_features, generator=th.Generator().manual_seed(0))
    raw = actor.log_std(actor.latent_pi(actor.features_extractor(features))).detach()
    _, log_std, _ = actor.get_action_dist_params(features)
    th.testing.assert_close(log_std.detach(), -4 + 6 * raw.tanh())
    log_std.sum().backward()
    assert float(actor.log_std.bias.grad.abs().min()) > 0
    with th.no_grad():
        actor.log_std.weight.mul_(1e3)
        extreme = actor.get_action_dist_params(features)[1]
    assert -10 <= float(extreme.min()) < -9.99
    assert 1.99 < float(extreme.max()) <= 2


def test_log_probability_is_that_of_the_squashed_gaussian() -> None:
    """Against the change of variables, written out: log N(u; mu, sigma) - sum log(1 - tanh(u)^2)."""
    actor = tiny_model("CnnPolicy", PixelBox()).policy.actor
    features = th.rand(8, actor.features_extractor.linear.in_features, generator=th.Generator().manual_seed(0))
    with th.no_grad():
        actions, log_prob = actor.action_log_prob(features)
        mean, log_std, _ = actor.get_action_dist_params(features)
    u = np.arctanh(actions.double().numpy())
    mu, sigma = mean.double().numpy(), np.exp(log_std.double().numpy())
    gaussian = -0.5 * ((u - mu) / sigma) ** 2 - np.log(sigma) - 0.5 * np.log(2 * np.pi)
    expected = (gaussian - np.log(1 - np.tanh(u) ** 2)).sum(axis=1)
    np.testing.assert_allclose(log_prob[:, 0].numpy(), expected, rtol=1e-3, atol=1e-3)


def test_bf16_stays_within_the_hidden_layers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Under autocast wide layers compute in bf16; latents, Q, log-probabilities, targets and losses are fp32."""
    monkeypatch.setattr(layers, "WIDE", 0)
    model = tiny_model("CnnPolicy", PixelBox(), precision="bf16", policy_kwargs={"net_arch": [16, 16]})
    policy = model.policy
    observations = th.randint(256, (4, 6, 36, 36), dtype=th.uint8, generator=th.Generator().manual_seed(0))
    zeros = th.zeros(4, 1)
    batch = Samples(observations, th.zeros(4, 2), observations, zeros, zeros, views=observations)
    hidden: list[th.dtype] = []
    for layer in (policy.encoder.trunk[0], policy.encoder.projection.linear, policy.actor.latent_pi[2]):
        layer.register_forward_hook(lambda module, inputs, output: hidden.append(output.dtype))
    policy.critic.ensemble[2].register_forward_hook(lambda module, inputs, output: hidden.append(output.dtype))
    policy.srl.decoder.linear.register_forward_hook(lambda module, inputs, output: hidden.append(output.dtype))

    def compute() -> dict[str, th.Tensor]:
        features = policy.encoder.trunk(policy.center(observations))
        latents = policy.encoder.projection(features)
        th.manual_seed(0)
        actions, log_prob = policy.actor.action_log_prob(features)
        mean, log_std, _ = policy.actor.get_action_dist_params(features)
        q_values = policy.critic(latents, batch.actions)
        loss, error = policy.srl.loss(batch, latents)
        own = policy.actor.features_extractor(features)
        actor = {"own": own, "actions": actions, "log_prob": log_prob, "mean": mean, "log_std": log_std}
        return {**actor, "latents": latents, "q": q_values, "loss": loss, "error": error}

    with th.no_grad(), model._autocast():
        halves = compute()
    assert set(hidden) == {th.bfloat16}
    assert len(hidden) == 6
    with th.no_grad():
        full = compute()
    for name, value in halves.items():
        assert value.dtype == th.float32, name
        if name not in ("loss", "error"):
            th.testing.assert_close(value, full[name], rtol=0.05, atol=0.05)
    assert {parameter.dtype for parameter in policy.parameters()} == {th.float32}


@pytest.mark.parametrize("memory_format", [th.contiguous_format, th.channels_last])
@pytest.mark.parametrize("channels", [1, 3])
def test_preprocessing_leaves_its_input_alone(channels: int, memory_format: th.memory_format) -> None:
    """Also of floats, which a caller may still own."""
    space = image_space(channels, 20)
    given = th.full((2, channels, 20, 20), 200.0).contiguous(memory_format=memory_format)
    scaled = preprocess(given, space)
    assert (given == 200).all() and scaled.max() == th.tensor(200.0) / 255


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


@pytest.mark.parametrize("update", ["joint", "sequential"])
def test_what_is_frozen_in_training_stays(update: str) -> None:
    """Also where the last update before left a gradient."""
    model = tiny_model("CnnPolicy", PixelBox(), update=update).learn(15)
    frozen = [model.policy.encoder.trunk[0], model.policy.srl.decoder, model.policy.critic.ensemble[0]]
    before = [parameter.clone() for part in frozen for parameter in part.requires_grad_(False).parameters()]
    model.learn(5, reset_num_timesteps=False)
    assert all(map(th.equal, before, (parameter for part in frozen for parameter in part.parameters())))


def test_bf16_and_fp32_train_alike() -> None:
    """A few updates from equal weights on equal data: losses differ by bf16's rounding only, parameters stay finite."""
    losses = {}
    for precision in ("fp32", "bf16"):
        model = tiny_model("CnnPolicy", PixelBox(), precision=precision, learning_rate=1e-4)
        model.learn(14, log_interval=10**9)
        logged = model.logger.name_to_value
        losses[precision] = [float(logged[f"train/{name}"]) for name in ("srl_loss", "critic_loss", "actor_loss")]
        assert all(th.isfinite(parameter).all() for parameter in model.policy.parameters())
    assert losses["bf16"] == pytest.approx(losses["fp32"], rel=0.05)
    assert losses["bf16"] != losses["fp32"]
