"""SRL errors keep their digits where the rest computes in bf16: they are what the curious agent is rewarded with."""

from typing import Any

import pytest
import torch as th
from agents_for_tests import one_update
from envs_for_tests import PixelBox, VectorBox, tiny_model
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from torch import nn
from torch.nn import functional as F

from sb3_cure.srl import CURL, SRLHead, SRLOutput

#: As updates with precision="bf16" compute
as_in_training = th.autocast("cpu", th.bfloat16)


class FixedKeys(nn.Module):
    """A target encoder of fp32 that depends on nothing but the image's mean brightness."""

    features_dim = 50

    def forward(self, images: th.Tensor) -> th.Tensor:
        brightness = images.float().mean(dim=(1, 2, 3))
        return th.sin(brightness[:, None] * th.linspace(1, 40, 50))


@pytest.fixture(scope="module")
def curl() -> tuple[CURL, ReplayBufferSamples, th.Tensor]:
    """CURL with keys that no convolution rounds, a batch and anchors."""
    model = tiny_model("CnnPolicy", PixelBox(), srl="curl", learning_starts=40, precision="bf16").learn(40)
    head = model.policy.srl
    head.bind_target_encoder(FixedKeys())
    batch = model.replay_buffer.sample(8)
    anchors = th.rand((8, 50), generator=th.Generator().manual_seed(0)) - 0.5
    return head, batch, anchors


@pytest.mark.parametrize("method", ["loss", "error"])
def test_curls_logits_are_in_full_precision(curl: Any, method: str) -> None:
    """The same cross-entropies within autocast as outside; of logits in bf16 they differ in the third digit."""
    head, batch, anchors = curl

    def errors() -> th.Tensor:
        th.manual_seed(0)
        output = getattr(head, method)(batch, anchors)
        return output.error if method == "loss" else output

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
