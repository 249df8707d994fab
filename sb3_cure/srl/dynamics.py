"""Dynamics in the latent space: a forward and an inverse model (Pathak et al., 2017; Lesort et al., 2018, survey)."""

import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_action_dim

from sb3_cure.data.samples import Samples
from sb3_cure.networks.encoders import Encoder
from sb3_cure.networks.layers import small_mlp
from sb3_cure.srl.base import SRLHead, SRLOutput


class NextLatents(SRLHead):
    """Base class of heads that predict the momentum encoder's next latents from latents and action.

    Latents that are all alike would be the easiest to predict. Two things keep the encoder from this collapse: the
    target has no gradient (Tang et al., 2023, explain why that helps), and each of its entries is standardised by mean
    and variance of the batch, as by BYOL's batch normalisation. Predicting the mean is then as bad for small latents as
    for large ones. A subclass implements ``distance``, and may ``project`` the target.

    :param encoder: The shared encoder
    :param observation_space: Space of the stored observations
    :param action_space: Action space
    """

    error_tells_novelty = False
    models_transitions = True

    def __init__(self, encoder: Encoder, observation_space: spaces.Space, action_space: spaces.Box):
        super().__init__(encoder, observation_space)
        #: Size of latents and action together
        self.n_inputs = encoder.features_dim + get_action_dim(action_space)
        # Running statistics of the target: `error` must not depend on the rest of its batch
        self.register_buffer("mean", th.zeros(encoder.features_dim))
        self.register_buffer("variance", th.ones(encoder.features_dim))

    def project(self, latents: th.Tensor) -> th.Tensor:
        """Compute the target of the prediction.

        :param latents: Of the next observations, by the momentum encoder, [B, features_dim]
        :return: Target before it is standardised, [B, features_dim]; by default the latents
        """
        return latents

    def distance(self, inputs: th.Tensor, target: th.Tensor) -> th.Tensor:
        """Compute the error of each prediction.

        :param inputs: Latents and action, [B, n_inputs]
        :param target: Standardised target, [B, features_dim]
        :return: Error of each prediction, >= 0, [B]
        """
        raise NotImplementedError(f"{type(self).__name__} must implement distance(inputs, target)")

    def loss(self, batch: Samples, latents: th.Tensor, next_latents: th.Tensor | None = None) -> SRLOutput:
        """Predict the target of another view of the next observations.

        :param batch: Samples of the replay buffer
        :param latents: [B, features_dim]
        :param next_latents: Unused
        :return: Mean error, and the error of each prediction, [B]
        """
        error = self._error(batch, latents, self.augment(batch.next_observations), learns=th.is_grad_enabled())
        return SRLOutput(error.mean(), error.detach())

    @th.no_grad()
    def error(self, batch: Samples, latents: th.Tensor) -> th.Tensor:
        """Compute the error for centred views, with the running statistics of the target.

        :param batch: Samples of the replay buffer
        :param latents: [B, features_dim]
        :return: [B]
        """
        return self._error(batch, latents, self.augment.center(batch.next_observations), learns=False)

    def _error(self, batch: Samples, latents: th.Tensor, next_views: th.Tensor, learns: bool) -> th.Tensor:
        with th.no_grad():
            target = self._standardise(self.project(self.target_encoder(next_views)), learns)
        return self.distance(th.cat([latents, batch.actions], dim=1), target)

    def _standardise(self, target: th.Tensor, learns: bool) -> th.Tensor:
        """Standardise by the batch's statistics and update the running ones; if not learning, by the running ones."""
        mean: th.Tensor = self.mean  # type: ignore[assignment]
        variance: th.Tensor = self.variance  # type: ignore[assignment]
        if learns:
            of_batch = target.mean(dim=0), target.var(dim=0, correction=0)
            mean.lerp_(of_batch[0], 0.1)
            variance.lerp_(of_batch[1], 0.1)
            mean, variance = of_batch
        return (target - mean) / (variance + 1e-5).sqrt()


class Forward(NextLatents):
    """Forward model: predicts the next latents, with squared error.

    :param encoder: The shared encoder
    :param observation_space: Space of the stored observations
    :param action_space: Action space
    :param hidden_dim: Width of the hidden layer
    """

    def __init__(
        self, encoder: Encoder, observation_space: spaces.Space, action_space: spaces.Box, hidden_dim: int = 256
    ):
        super().__init__(encoder, observation_space, action_space)
        self.model = small_mlp(self.n_inputs, encoder.features_dim, hidden_dim)

    def distance(self, inputs: th.Tensor, target: th.Tensor) -> th.Tensor:
        """Compute the mean squared error of each prediction.

        :param inputs: Latents and action, [B, n_inputs]
        :param target: The next latents, standardised, [B, features_dim]
        :return: Errors, [B]; always predicting the mean would give 1
        """
        return (self.model(inputs) - target).square().mean(dim=1)


class Inverse(SRLHead):
    """Inverse model: predicts the executed action from the latents before and after it, and trains both.

    :param encoder: The shared encoder
    :param observation_space: Space of the stored observations
    :param action_space: Action space
    :param hidden_dim: Width of the hidden layer
    """

    error_tells_novelty = False
    needs_next_latents = True
    models_transitions = True

    def __init__(
        self, encoder: Encoder, observation_space: spaces.Space, action_space: spaces.Box, hidden_dim: int = 256
    ):
        super().__init__(encoder, observation_space)
        self.model = small_mlp(2 * encoder.features_dim, get_action_dim(action_space), hidden_dim)

    def loss(self, batch: Samples, latents: th.Tensor, next_latents: th.Tensor | None = None) -> SRLOutput:
        """Predict the executed action.

        :param batch: Samples of the replay buffer
        :param latents: [B, features_dim]
        :param next_latents: Those of the next observations, [B, features_dim]
        :return: Loss, and the mean squared error of each action (scaled to [-1, 1]), [B]
        """
        assert next_latents is not None
        error = (self.model(th.cat([latents, next_latents], dim=1)) - batch.actions).square().mean(dim=1)
        return SRLOutput(error.mean(), error.detach())
