"""Variational autoencoder (Kingma and Welling, 2014), with which SAC-AE (Yarats et al., 2019) is compared."""

from typing import Any

import torch as th
from gymnasium import spaces
from torch import nn

from sb3_cure.data.samples import Samples
from sb3_cure.networks.encoders import Encoder
from sb3_cure.srl.autoencoder import RAE
from sb3_cure.srl.base import SRLOutput


class VAE(RAE):
    """``RAE`` with noisy latents, which a Kullback-Leibler divergence keeps near N(0, 1).

    The posterior is N(z, diag(sigma(z)^2)): its mean is the encoder's latents, which actors and critics read without
    noise, and log sigma(z)^2 is a linear map of them that the head owns. Loss: mean squared error per pixel + ``beta``
    KL. The mean's share of the KL is the latent penalty of ``RAE``, and ``beta`` has the same default. With ``beta`` =
    2 s^2 / n the loss is the evidence bound for n pixels with noise of standard deviation s. The posterior's noise
    comes from torch's stream, like ``RAE``'s dither.

    :param encoder: The shared encoder
    :param observation_space: Space of the stored observations: images, or anything that SB3 can flatten
    :param beta: Factor of the divergence, which is a sum over latents
    :param kwargs: ``decoder_weight_decay`` and ``bits`` of ``RAE``
    """

    def __init__(self, encoder: Encoder, observation_space: spaces.Space, beta: float = 1e-6, **kwargs: Any):
        super().__init__(encoder, observation_space, latent_penalty=0.0, **kwargs)
        self.beta = beta
        self.log_variance = nn.Linear(encoder.features_dim, encoder.features_dim)
        # Constant at first; with the variance of N(0, 1), latents in (-1, 1) would drown in noise.
        nn.init.zeros_(self.log_variance.weight)
        nn.init.constant_(self.log_variance.bias, -2.0)

    def loss(self, batch: Samples, latents: th.Tensor, next_latents: th.Tensor | None = None) -> SRLOutput:
        """Compute the negative evidence bound (Kingma and Welling, eq. 7 and appendix B) with weight ``beta``.

        :param batch: Samples of the replay buffer
        :param latents: Means of the posterior, [B, features_dim]
        :param next_latents: Unused
        :return: Loss, and the mean squared error of each observation, drawn from its noisy latents, [B]
        """
        log_variance = self.log_variance(latents)
        divergence = 0.5 * (latents.square() + log_variance.exp() - log_variance - 1).sum(dim=1)
        sampled = latents + (0.5 * log_variance).exp() * th.randn_like(latents)
        drawn = super().loss(batch, sampled)
        return SRLOutput(drawn.loss + self.beta * divergence.mean(), drawn.error)
