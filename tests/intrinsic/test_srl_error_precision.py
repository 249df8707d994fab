"""SRL errors keep their digits where the rest computes in bf16: they are what the curious agent is rewarded with."""

from typing import Any

import pytest
import torch as th
from agents_for_tests import one_update
from envs_for_tests import PixelBox, VectorBox, samples_of, tiny_model
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from torch import nn
from torch.nn import functional as F

from sb3_cure.srl import CURL, SRLHead, SRLOutput

#: As updates with precision="bf16" compute
as_in_training = th.autocast("cpu", th.bfloat16)


class FixedKeys(nn.Module):
    """A target encoder whose latents do not depend on the images, and hence not on their precision."""

    features_dim = 50

    def forward(self, images: th.Tensor) -> th.Tensor:
        return th.rand((len(images), 50), generator=th.Generator().manual_seed(len(images))) - 0.5


@pytest.fixture(scope="module")
def curl() -> tuple[CURL, ReplayBufferSamples, th.Tensor]:
    """CURL with keys that are known exactly, a batch and anchors."""
    model = tiny_model("CnnPolicy", PixelBox(), srl="curl", learning_starts=40, precision="bf16").learn(40)
    head = model.policy.srl
    head.bind(FixedKeys(), model.policy.augmentation)
    batch = samples_of(model, 8)
    anchors = th.rand((8, 50), generator=th.Generator().manual_seed(0)) * 4 - 2
    return head, batch, anchors


@pytest.mark.parametrize("method", ["loss", "error"])
def test_curls_logits_are_in_full_precision(curl: Any, method: str) -> None:
    """The same cross-entropies within autocast as outside; of logits in bf16 they differ in the third digit."""
    head, batch, anchors = curl

    def errors() -> th.Tensor:
        th.manual_seed(0)
        output = getattr(head, method)(batch, anchors)
        return output.error if method == "loss" else output

    head.loss(batch, anchors)  # whose views the bank of `error` holds from now on
    with th.no_grad():
        exact = errors()
        with as_in_training:
            within = errors()
    assert float(exact.std()) > 0.1
    th.testing.assert_close(within, exact, rtol=1e-6, atol=1e-6)


def test_curls_gradients_are_in_full_precision(curl: Any) -> None:
    """Those of W and of the anchors."""
    head, batch, anchors = curl
    gradients = []
    for context in (as_in_training, th.autocast("cpu", enabled=False)):
        leaf = anchors.clone().requires_grad_()
        th.manual_seed(0)
        with context:
            loss = head.loss(batch, leaf).loss
        gradients.append(th.autograd.grad(loss, [leaf, head.W]))
    for within, exact in zip(*gradients, strict=True):
        th.testing.assert_close(within, exact, rtol=1e-4, atol=1e-7)


class Twins(SRLHead):
    """A user's head of a linear map: its error is how far its output is from that of next to the same inputs."""

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.map = nn.Linear(self.encoder.features_dim, 32)
        self.formats: list[th.dtype] = []

    def loss(self, batch: ReplayBufferSamples, latents: th.Tensor) -> SRLOutput:
        drawn = self.map(latents)
        self.formats.append(drawn.dtype)
        error = (drawn - self.map(latents + 1e-3)).square().mean(dim=1)
        return SRLOutput(error.mean(), error.detach())


@pytest.mark.parametrize("target", ["observation", "next_observation"])
def test_users_heads_compute_in_fp32(target: str) -> None:
    """Whatever the precision: a difference of bf16 would be rounding, and nothing in its format could tell."""
    logged = {}
    for precision in ("fp32", "bf16"):
        model = tiny_model(
            "MlpPolicy", VectorBox(), srl=Twins, learning_starts=40, precision=precision, curiosity_target=target
        ).learn(40)
        logged[precision] = one_update(model)
        assert set(model.policy.srl.formats) == {th.float32}
    for name in ("srl_loss", "curious_reward_raw_mean", "curious_reward_raw_max"):
        assert logged["bf16"][name] == pytest.approx(logged["fp32"][name], rel=1e-3)


class Half(SRLHead):
    """A head that asks for autocast, and does not see to its error."""

    mixed_precision = True

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.map = nn.Linear(self.encoder.features_dim, 32)

    def loss(self, batch: ReplayBufferSamples, latents: th.Tensor) -> SRLOutput:
        error = self.map(latents).square().mean(dim=1)
        return SRLOutput(F.mse_loss(error, th.zeros_like(error)), error.detach())


@pytest.mark.parametrize("precision", ["fp32", "bf16"])
def test_an_error_in_bf16_is_refused(precision: str) -> None:
    """Of a head that computes in mixed precision of its own will."""
    model = tiny_model("MlpPolicy", VectorBox(), srl=Half, learning_starts=40, precision=precision).learn(40)
    if precision == "fp32":
        model.train(1, batch_size=8)
    else:
        with pytest.raises(ValueError, match="bfloat16"):
            model.train(1, batch_size=8)
