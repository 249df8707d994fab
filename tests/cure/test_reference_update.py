"""Sequential updates beside SAC-AE, written plainly in ``benchmarks/sac_ae.py``: equal weights and batches."""

import numpy as np
import pytest
import torch as th
from envs_for_tests import PixelBox
from stable_baselines3.common.logger import Logger
from torch import nn

from benchmarks.sac_ae import PlainSacAe
from sb3_cure import CuReSAC
from sb3_cure.networks.layers import Projection, conv_sizes
from sb3_cure.srl import autoencoder

SIZE, FILTERS, HIDDEN, BATCH = 36, 4, 16, 8
#: Adam's epsilon: with its default a gradient that is rounding alone makes a whole step, which way differs by processor
EPSILON = 1e-4
LAST, _ = conv_sizes(SIZE, SIZE, 4)[-1]
Layer = nn.Linear | nn.Conv2d | nn.ConvTranspose2d | nn.LayerNorm


def layers(module: nn.Module) -> list[Layer]:
    return [layer for layer in module.modules() if isinstance(layer, Layer)]


@th.no_grad()
def copy_layers(target: nn.Module, source: nn.Module) -> None:
    """All weights, layer by layer."""
    for mine, other in zip(layers(target), layers(source), strict=True):
        mine.weight.copy_(other.weight)
        mine.bias.copy_(other.bias)


@th.no_grad()
def copy_projection(target: Projection, source: nn.Module) -> None:
    """Ours reads the convolutions' images as [H, W, C], the plain one as [C, H, W]."""
    by_image = source.fc.weight.view(-1, FILTERS, LAST, LAST)
    target.linear.weight.copy_(by_image.permute(0, 2, 3, 1).flatten(1))
    target.linear.bias.copy_(source.fc.bias)
    copy_layers(target.norm, source.ln)


@th.no_grad()
def copy_weights(model: CuReSAC, plain: PlainSacAe) -> None:
    policy = model.policy
    copy_layers(policy.encoder.trunk, plain.critic.encoder.convs)
    copy_projection(policy.encoder.projection, plain.critic.encoder)
    copy_projection(policy.actor.features_extractor, plain.actor.encoder)
    policy.encoder_target.load_state_dict(policy.encoder.state_dict())
    hidden, output = plain.actor.trunk[:-1], plain.actor.trunk[-1]
    copy_layers(policy.actor.latent_pi, hidden)
    n_actions = policy.actor.mu.out_features
    for head, part in ((policy.actor.mu, slice(n_actions)), (policy.actor.log_std, slice(n_actions, None))):
        head.weight.copy_(output.weight[part])
        head.bias.copy_(output.bias[part])
    for i, other in enumerate((plain.critic.q1, plain.critic.q2)):
        for mine, theirs in zip(policy.critic.ensemble[::2], other[::2], strict=True):
            mine.weight[i].copy_(theirs.weight.T)
            mine.bias[i].copy_(theirs.bias)
    policy.critic_target.load_state_dict(policy.critic.state_dict())
    decoder = policy.srl.decoder
    decoder.linear.weight.copy_(plain.decoder.fc.weight.view(FILTERS, LAST, LAST, -1).permute(1, 2, 0, 3).flatten(0, 2))
    decoder.linear.bias.copy_(plain.decoder.fc.bias.view(FILTERS, LAST, LAST).permute(1, 2, 0).flatten())
    copy_layers(decoder.hidden, plain.decoder.deconvs)
    copy_layers(decoder.output, plain.decoder.output)


def test_sequential_updates_are_those_of_sac_ae(monkeypatch: pytest.MonkeyPatch) -> None:
    """Losses and temperature of ten updates; what differs in any step shows in the losses of those after it."""
    model = CuReSAC(
        "CnnPolicy",
        PixelBox(),
        curiosity=None,
        update="sequential",
        precision="fp32",
        learning_starts=40,
        warmup_updates=0,
        buffer_size=100,
        policy_kwargs=dict(
            net_arch=[HIDDEN, HIDDEN],
            features_extractor_kwargs=dict(n_filters=FILTERS),
            optimizer_kwargs=dict(eps=EPSILON),
        ),
        seed=0,
    )
    model.learn(40)  # random actions
    assert model._n_updates == 0
    channels, actions = model.observation_space.shape[0], model.action_space.shape[0]
    plain = PlainSacAe(channels, actions, HIDDEN, size=SIZE, filters=FILTERS, decoder_first=True)
    copy_weights(model, plain)
    for name, optimizer in vars(plain).items():
        if name.endswith("_optimizer") and name != "alpha_optimizer":
            # Its critics' loss is twice SB3's.
            optimizer.param_groups[0]["eps"] = EPSILON * (2 if name == "critic_optimizer" else 1)
    # The only noise that the two would draw otherwise.
    monkeypatch.setattr(autoencoder, "random_bytes_like", lambda images: th.full_like(images, 99))
    monkeypatch.setattr(plain, "dither", lambda images: th.full_like(images, 99.5 / 256))
    model.replay_buffer.dones[::5] = 1
    model.replay_buffer.timeouts[:] = 0
    found: dict[str, float] = {}
    for update in range(10):
        model.set_logger(Logger(None, []))  # else it would log means over updates
        for train in (lambda: model.train(1, BATCH), lambda: plain.update(model.replay_buffer.sample(BATCH))):
            np.random.seed(update)
            th.manual_seed(update)
            train()
        names = {"critic_loss": "critic", "actor_loss": "actor", "srl_loss": "decoder"}
        logged = {name: model.logger.name_to_value.get(f"train/{name}") for name in names}
        found |= {names[name]: float(value) for name, value in logged.items() if value is not None}
        found["critic"] *= 2  # SB3 halves it
        found["temperature"] = float(model.log_ent_coef.detach().exp())
        expected = {name: float(loss) for name, loss in plain.losses.items()}
        expected["temperature"] = float(plain.log_alpha.detach().exp())
        assert found == pytest.approx(expected, rel=1e-5), update
