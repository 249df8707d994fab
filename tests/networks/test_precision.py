"""bf16 is used inside trunks, decoders and wide layers of updates, and nowhere else."""

import copy
from typing import Any

import pytest
import torch as th
from agents_for_tests import q_values
from dictionaries_for_tests import SensorBox
from envs_for_tests import PixelBox, VectorBox, gradients_of_an_update, samples_of, tiny_model
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn
from torch.nn import functional as F

from sb3_cure import CuReSAC
from sb3_cure.networks import layers, precision
from sb3_cure.networks.layers import Conv2dReLU, Convolutions, run_mlp
from sb3_cure.networks.precision import compute_in, resolve_precision

IMAGES = spaces.Box(0, 255, (3, 36, 36), "uint8")
VECTORS = spaces.Box(-1, 1, (3,))


@pytest.fixture
def all_wide(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every hidden layer counts as wide."""
    monkeypatch.setattr(layers, "WIDE", 0)


@pytest.mark.parametrize("fast", [True, False])
def test_auto_is_bf16_for_images_on_fast_hardware(fast: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(precision, "has_fast_bf16", lambda device: fast)
    cpu = th.device("cpu")
    assert resolve_precision("auto", cpu, IMAGES) == ("bf16" if fast else "fp32")
    assert resolve_precision("auto", cpu, VECTORS) == "fp32"
    assert resolve_precision("bf16", cpu, VECTORS) == "bf16"


def test_context_ends_with_its_block() -> None:
    """Also after an error, and within another context."""
    trunk = Convolutions(Conv2dReLU(3, 4, 3))
    images = th.zeros(1, 3, 8, 8)
    with compute_in(trunk, "bf16"):
        with pytest.raises(KeyError), compute_in(trunk, "bf16"):
            raise KeyError
        with compute_in(trunk, "fp32"):
            pass
        assert trunk(images).dtype == th.bfloat16
    assert trunk(images).dtype == th.float32


def test_images_alone_enter_in_bf16(all_wide: None) -> None:
    """Inside in bf16; latents, values, means, errors and all parameters in fp32, close to those of fp32."""
    model = tiny_model("CnnPolicy", PixelBox(), precision="bf16", policy_kwargs={"net_arch": [16, 16]}).learn(12)
    policy, batch = model.policy, samples_of(model, 4)
    inside: dict[str, th.dtype] = {}
    parts: dict[str, nn.Module] = {
        "trunk": policy.encoder.trunk[1],
        "projection": policy.encoder.projection.linear,
        "actor": policy.actor.latent_pi[2],
        "critic": policy.critic.ensemble[2],
        "decoder": policy.srl.decoder.hidden[0],
    }
    for name, part in parts.items():
        part.register_forward_hook(lambda module, args, output, name=name: inside.update({name: output.dtype}))

    def compute() -> dict[str, th.Tensor]:
        th.manual_seed(0)
        features = policy.encoder.trunk(batch.views)
        latents = policy.encoder.projection(features)
        actions, log_prob = policy.actor.action_log_prob(features)
        mean, log_std, _ = policy.actor.get_action_dist_params(features)
        results = {"latents": latents, "actions": actions, "log_prob": log_prob, "mean": mean, "log_std": log_std}
        loss, error = policy.srl.loss(batch, latents)
        return {**results, "q": policy.critic(latents, batch.actions), "loss": loss, "error": error}

    with th.no_grad():
        exact = compute()
        assert set(inside.values()) == {th.float32}
        with compute_in(policy, "bf16"):
            rounded = compute()
    assert inside == dict.fromkeys(parts, th.bfloat16)
    for name, value in rounded.items():
        assert value.dtype == th.float32, name
        th.testing.assert_close(value, exact[name], rtol=0.05, atol=0.05)
        assert not th.equal(value, exact[name]), name
    assert {parameter.dtype for parameter in policy.parameters()} == {th.float32}


@pytest.mark.parametrize("srl", ["rae", "curl"])
def test_gradients_point_where_those_of_fp32_do(srl: str) -> None:
    """One state, batch and stream of random numbers: cosine of at least 0.99 for every part of the agent.

    With the paper's batch size: in a batch of a few samples an actor's gradients may nearly cancel.
    """
    network = dict(net_arch=[64], features_extractor_kwargs=dict(n_filters=16, n_layers=3))
    arguments: dict[str, Any] = dict(srl=srl, update="joint", batch_size=128, policy_kwargs=network)
    trained = tiny_model("CnnPolicy", PixelBox(), learning_starts=50, **arguments).learn(60)
    state = copy.deepcopy(trained.get_parameters())
    found = {}
    for name in ("fp32", "bf16"):
        model = tiny_model("CnnPolicy", PixelBox(), precision=name, **arguments)
        model.set_logger(trained.logger)
        model.set_parameters(state)
        model.replay_buffer = trained.replay_buffer
        found[name] = gradients_of_an_update(model, seed=5)
    assert found["fp32"].keys() == found["bf16"].keys() and len(found["fp32"]) == 6
    for name, expected in found["fp32"].items():
        assert not th.equal(expected, found["bf16"][name]), name
        assert float(th.cosine_similarity(expected, found["bf16"][name], dim=0)) >= 0.99, name


def test_acting_and_measuring_compute_in_fp32() -> None:
    """After training in bf16, so that results do not depend on the hardware."""
    model = tiny_model("CnnPolicy", PixelBox(), precision="bf16").learn(12)
    assert model._n_updates == 2
    assert model.policy.encoder.trunk(samples_of(model, 2).views).dtype == th.float32


# ---------------------------------------------------------------- vectors, actions, users' extractors


def relative_error(module: nn.Module, compute: Any, first: th.Tensor, second: th.Tensor) -> float:
    """Error in bf16 of the difference between two outputs, relative to that difference in fp32."""
    with th.no_grad():
        exact = compute(second) - compute(first)
        with compute_in(module, "bf16"):
            rounded = compute(second) - compute(first)
    return float((rounded - exact).norm() / exact.norm())


def first_output(layer: nn.Module, run: Any) -> Any:
    """Function that runs a network and returns the output of one of its layers."""
    seen: list[th.Tensor] = []
    layer.register_forward_hook(lambda module, args, output: seen.append(output))

    def compute(inputs: th.Tensor) -> th.Tensor:
        run(inputs)
        return seen[-1]

    return compute


@pytest.fixture
def vector_model() -> CuReSAC:
    return tiny_model("MlpPolicy", VectorBox(), policy_kwargs={"net_arch": [16, 16]})


def test_vectors_enter_in_fp32(all_wide: None, vector_model: CuReSAC) -> None:
    """1.000 and 1.003, equal in bf16, differ in latents and in each actor's first layer as in fp32."""
    policy = vector_model.policy
    near = th.tensor([[1.0, 0.5]]), th.tensor([[1.003, 0.5]])
    assert relative_error(policy, policy.encoder, *near) < 1e-3
    for name in ("task", "curious"):
        actor: Any = vector_model.policy.agents[name].actor
        layer = first_output(actor.latent_pi[0], lambda x, actor=actor: actor.action_log_prob(policy.encoder.trunk(x)))
        assert relative_error(policy, layer, *near) < 1e-3


@pytest.mark.parametrize("name", ["task", "curious"])
def test_actions_enter_the_critics_in_fp32(all_wide: None, vector_model: CuReSAC, name: str) -> None:
    """.500 and .501, equal in bf16, differ in the first layer as in fp32."""
    critic: Any = vector_model.policy.agents[name].critic
    latents = th.full((1, vector_model.policy.encoder.features_dim), 0.7)
    layer = first_output(critic.ensemble[0], lambda actions: q_values(vector_model, name, latents, actions))
    near = th.tensor([[0.5, 0.5]]), th.tensor([[0.501, 0.5]])
    assert relative_error(vector_model.policy, layer, *near) < 1e-3


def test_vectors_are_decoded_in_fp32(vector_model: CuReSAC) -> None:
    head: Any = vector_model.policy.srl
    latents = th.rand(4, 8, generator=th.Generator().manual_seed(0))
    with compute_in(head, "bf16"):
        drawn = head.decoder(latents)
    assert th.equal(drawn, head.decoder(latents))


class ImageAndVector(BaseFeaturesExtractor):
    """A user's extractor of a dictionary, which borrows a layer of ours."""

    def __init__(self, observation_space: spaces.Dict):
        super().__init__(observation_space, 6)
        self.image = nn.Sequential(Convolutions(Conv2dReLU(6, 2, 3, stride=12)), nn.Flatten(), nn.Linear(18, 5))
        self.vector = nn.Linear(2, 1)

    def forward(self, observations: dict[str, th.Tensor]) -> th.Tensor:
        return th.cat([self.image(observations["front"]), self.vector(observations["joints"])], dim=1)


def test_users_extractors_compute_in_fp32() -> None:
    env = SensorBox(("front", "joints"))
    kwargs = {"features_extractor_class": ImageAndVector}
    policy = tiny_model("MultiInputPolicy", env, srl="forward", policy_kwargs=kwargs).policy
    seen = policy.obs_to_tensor(env.reset(seed=0)[0])[0]
    with compute_in(policy, "bf16"):
        assert policy.critic.compute_dtype == th.bfloat16
        latents = policy.encode(seen)
    assert th.equal(latents, policy.encode(seen))


# ---------------------------------------------------------------- layers


def test_only_wide_hidden_layers_compute_in_bf16(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(layers, "WIDE", 30)
    mlp = nn.Sequential(*(nn.Linear(*pair) for pair in ((9, 5), (5, 5), (5, 8), (8, 9), (9, 9))))
    formats: list[th.dtype] = []
    for layer in mlp:
        layer.register_forward_hook(lambda module, args, output: formats.append(output.dtype))
    inputs = th.randn(2, 9, generator=th.Generator().manual_seed(0))
    assert run_mlp(mlp, inputs, th.bfloat16).dtype == th.float32
    assert formats == [th.float32, th.float32, th.bfloat16, th.bfloat16, th.float32]
    assert th.equal(run_mlp(mlp, inputs), mlp(inputs))


def test_torchs_convolutions_follow_the_context() -> None:
    """Those of rewards and users, which need autocast, too."""
    trunk = Convolutions(nn.Conv2d(3, 4, 3, padding=1), nn.ReLU())
    images = th.randint(256, (2, 3, 8, 8), dtype=th.uint8, generator=th.Generator().manual_seed(0))
    with compute_in(trunk, "bf16"):
        rounded = trunk(images)
    assert rounded.dtype == th.bfloat16
    th.testing.assert_close(rounded.float(), F.relu(trunk[0](images.float() / 255)), rtol=0.02, atol=0.02)
