"""The yardstick: SAC-AE (Yarats et al., 2019) written plainly, in eager fp32, without curiosity.

The same networks, losses, schedule and order of steps as the public implementation: observations as float tensors of
0-255, five passes of the convolutions per update (critic, actor's next observation, target, actor, decoder), one Adam
per loss, Polyak averages parameter by parameter.
"""

import copy

import numpy as np
import torch as th
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from torch import nn
from torch.nn import functional as F

from sb3_cure.networks.layers import conv_sizes, init_weights

FEATURES = 50


class _Encoder(nn.Module):
    def __init__(self, channels: int, size: int, filters: int):
        super().__init__()
        self.convs = nn.ModuleList(
            [nn.Conv2d(channels, filters, 3, stride=2), *(nn.Conv2d(filters, filters, 3) for _ in range(3))]
        )
        self.fc = nn.Linear(filters * conv_sizes(size, size, 4)[-1][0] ** 2, FEATURES)
        self.ln = nn.LayerNorm(FEATURES)

    def forward(self, images: th.Tensor, detach: bool = False) -> th.Tensor:
        hidden = images / 255.0
        for conv in self.convs:
            hidden = th.relu(conv(hidden))
        hidden = hidden.flatten(1)
        return th.tanh(self.ln(self.fc(hidden.detach() if detach else hidden)))


class _Decoder(nn.Module):
    def __init__(self, channels: int, size: int, filters: int):
        super().__init__()
        self.last_size, _ = conv_sizes(size, size, 4)[-1]
        self.fc = nn.Linear(FEATURES, filters * self.last_size**2)
        self.deconvs = nn.ModuleList(nn.ConvTranspose2d(filters, filters, 3) for _ in range(3))
        self.output = nn.ConvTranspose2d(filters, channels, 3, stride=2, output_padding=1)

    def forward(self, latents: th.Tensor) -> th.Tensor:
        hidden = th.relu(self.fc(latents)).view(len(latents), -1, self.last_size, self.last_size)
        for deconv in self.deconvs:
            hidden = th.relu(deconv(hidden))
        return self.output(hidden)


def _mlp(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Linear(inputs, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU(), nn.Linear(hidden, outputs)
    )


class _Actor(nn.Module):
    def __init__(self, encoder: _Encoder, actions: int, hidden: int):
        super().__init__()
        self.encoder = encoder
        self.trunk = _mlp(FEATURES, hidden, 2 * actions)

    def forward(self, images: th.Tensor, detach: bool = False) -> tuple[th.Tensor, th.Tensor]:
        mean, log_std = self.trunk(self.encoder(images, detach)).chunk(2, dim=-1)
        log_std = -10 + 6 * (th.tanh(log_std) + 1)
        noise = th.randn_like(mean)
        action = th.tanh(mean + noise * log_std.exp())
        log_prob = (-0.5 * noise.pow(2) - log_std).sum(-1, keepdim=True) - 0.5 * np.log(2 * np.pi) * mean.shape[-1]
        log_prob = log_prob - th.log(F.relu(1 - action.pow(2)) + 1e-6).sum(-1, keepdim=True)
        return action, log_prob


class _Critic(nn.Module):
    def __init__(self, encoder: _Encoder, actions: int, hidden: int):
        super().__init__()
        self.encoder = encoder
        self.q1 = _mlp(FEATURES + actions, hidden, 1)
        self.q2 = _mlp(FEATURES + actions, hidden, 1)

    def forward(self, images: th.Tensor, actions: th.Tensor, detach: bool = False) -> tuple[th.Tensor, th.Tensor]:
        inputs = th.cat([self.encoder(images, detach), actions], dim=1)
        return self.q1(inputs), self.q2(inputs)


class PlainSacAe:
    """SAC-AE's update.

    :param channels: Channels of the observations
    :param actions: Size of the action
    :param hidden: Hidden units of actor and critics
    :param device: Where to compute
    :param size: Height and width of the observations, an even number
    :param filters: Channels of the convolutions
    :param decoder_first: Whether the autoencoder's step comes first, as in the CuRe paper's Algorithm 1, or last, as in
        the public implementation
    """

    def __init__(
        self,
        channels: int = 9,
        actions: int = 1,
        hidden: int = 1024,
        device: th.device | str = "cpu",
        size: int = 84,
        filters: int = 32,
        decoder_first: bool = False,
    ):
        self.decoder_first = decoder_first
        encoders = [_Encoder(channels, size, filters) for _ in range(2)]
        self.actor = init_weights(_Actor(encoders[0], actions, hidden)).to(device)
        self.critic = init_weights(_Critic(encoders[1], actions, hidden)).to(device)
        self.critic_target = copy.deepcopy(self.critic)
        self.actor.encoder.convs = self.critic.encoder.convs
        self.decoder = init_weights(_Decoder(channels, size, filters)).to(device)
        self.log_alpha = th.tensor(np.log(0.1), device=device, requires_grad=True)
        self.target_entropy = -float(actions)
        adam = th.optim.Adam
        self.actor_optimizer = adam(self.actor.parameters(), lr=1e-3)
        self.critic_optimizer = adam(self.critic.parameters(), lr=1e-3)
        self.alpha_optimizer = adam([self.log_alpha], lr=1e-4, betas=(0.5, 0.999))
        self.encoder_optimizer = adam(self.critic.encoder.parameters(), lr=1e-3)
        self.decoder_optimizer = adam(self.decoder.parameters(), lr=1e-3, weight_decay=1e-7)
        self.step = 0
        #: Losses of the last update, detached
        self.losses: dict[str, th.Tensor] = {}

    def update(self, batch: ReplayBufferSamples) -> None:
        """One update of everything.

        :param batch: Samples of the replay buffer, observations uint8 [B, C, H, W]
        """
        images, next_images = batch.observations.float(), batch.next_observations.float()
        if self.decoder_first:
            self._update_decoder(images)
        self._update_critic(images, batch.actions, batch.rewards, next_images, 1 - batch.dones)
        if self.step % 2 == 0:
            self._update_actor(images)
            self._update_targets()
        if not self.decoder_first:
            self._update_decoder(images)
        self.step += 1

    def _update_critic(
        self, images: th.Tensor, actions: th.Tensor, rewards: th.Tensor, next_images: th.Tensor, not_done: th.Tensor
    ) -> None:
        with th.no_grad():
            next_actions, log_prob = self.actor(next_images)
            next_q = th.min(*self.critic_target(next_images, next_actions)) - self.log_alpha.exp() * log_prob
            target = rewards + not_done * 0.99 * next_q
        q1, q2 = self.critic(images, actions)
        loss = F.mse_loss(q1, target) + F.mse_loss(q2, target)
        self.losses["critic"] = loss.detach()
        self.critic_optimizer.zero_grad()
        loss.backward()
        self.critic_optimizer.step()

    def _update_actor(self, images: th.Tensor) -> None:
        actions, log_prob = self.actor(images, detach=True)
        q = th.min(*self.critic(images, actions, detach=True))
        loss = (self.log_alpha.exp().detach() * log_prob - q).mean()
        self.losses["actor"] = loss.detach()
        self.actor_optimizer.zero_grad()
        loss.backward()
        self.actor_optimizer.step()
        self.alpha_optimizer.zero_grad()
        (self.log_alpha.exp() * (-log_prob - self.target_entropy).detach()).mean().backward()
        self.alpha_optimizer.step()

    def _update_targets(self) -> None:
        for name, target in self.critic_target.named_parameters():
            tau = 0.05 if name.startswith("encoder") else 0.01
            source = self.critic.get_parameter(name)
            target.data.copy_(tau * source.data + (1 - tau) * target.data)

    def _update_decoder(self, images: th.Tensor) -> None:
        latents = self.critic.encoder(images)
        target = th.floor(images / 8) / 32
        target = target + self.dither(target) / 32 - 0.5
        loss = F.mse_loss(target, self.decoder(latents)) + 1e-6 * (0.5 * latents.pow(2).sum(1)).mean()
        self.losses["decoder"] = loss.detach()
        self.encoder_optimizer.zero_grad()
        self.decoder_optimizer.zero_grad()
        loss.backward()
        self.encoder_optimizer.step()
        self.decoder_optimizer.step()

    @staticmethod
    def dither(images: th.Tensor) -> th.Tensor:
        """Draw the noise that dithers images of 5 bits.

        :param images: [B, C, H, W]
        :return: Uniform noise in [0, 1) of that shape
        """
        return th.rand_like(images)
