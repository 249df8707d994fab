"""Encoder, task actor-critic, curious actor-critic, SRL head and their optimisers, as one SB3 policy."""

import contextlib
import copy
import functools
import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BaseModel, BasePolicy, ContinuousCritic
from stable_baselines3.common.preprocessing import get_obs_shape, is_image_space
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from stable_baselines3.sac.policies import Actor, SACPolicy
from torch import nn

from sb3_cure.curiosity import CuriousReward
from sb3_cure.encoder_optimizer import EncoderOptimizer
from sb3_cure.encoders import Encoder, PixelEncoder, VectorEncoder, make_encoder
from sb3_cure.layers import Projection, dense, full_precision, init_weights, preprocess
from sb3_cure.precision import compile_while_training
from sb3_cure.srl import SRLHead
from sb3_cure.values import check_optimizer_kwargs

# Bounds of the actor's log standard deviation (paper, table of hyperparameters); SB3 clamps to [-20, 2] instead.
LOG_STD_MIN, LOG_STD_MAX = -10.0, 2.0
# Keeps the logarithm finite where tanh is 1 in floating point, as in SB3.
EPSILON = 1e-6


class TrunkActor(Actor):
    """SAC's actor on the (detached) trunk features of the shared encoder, behind a projection of its own."""

    def get_action_dist_params(self, obs: PyTorchObs) -> tuple[th.Tensor, th.Tensor, dict[str, th.Tensor]]:
        """
        :param obs: Trunk features of the encoder, [B, trunk_dim]
        :return: Mean and log standard deviation before squashing, [B, action_dim] each
        :raises ValueError: if it is given observations, as SB3's actors are
        """
        if obs.ndim != 2:  # type: ignore[union-attr]
            raise ValueError(
                f"the actor got {obs.ndim} dimensions, but it reads the shared encoder's features: call the policy, or "  # type: ignore[union-attr]
                "sb3_cure.deployment.DeterministicActor(model) for actions of observations."
            )
        latent = dense(list(self.latent_pi), self.features_extractor(obs).float())  # type: ignore[arg-type]
        with full_precision(latent):
            latent = latent.float()
            # Rescaled, not clamped: a clamped log std has no gradient with which to come back.
            log_std = th.tanh(self.log_std(latent))  # type: ignore[operator]
            log_std = LOG_STD_MIN + 0.5 * (LOG_STD_MAX - LOG_STD_MIN) * (log_std + 1)
            return self.mu(latent), log_std, {}

    def action_log_prob(self, obs: PyTorchObs) -> tuple[th.Tensor, th.Tensor]:
        """
        :param obs: Trunk features of the encoder, [B, trunk_dim]
        :return: Actions in [-1, 1], [B, action_dim], and their log-probabilities, [B]
        """
        mean, log_std, _ = self.get_action_dist_params(obs)
        # What SB3's SquashedDiagGaussianDistribution computes; torch's Normal would read its arguments to check them,
        # for which a GPU has to stop.
        with full_precision(mean):
            noise = th.randn_like(mean)
            actions = th.tanh(mean + noise * log_std.exp())
            log_prob = -0.5 * (noise.square() + math.log(2 * math.pi)) - log_std
            return actions, (log_prob - th.log(1 - actions.square() + EPSILON)).sum(dim=1)


class LatentCritic(ContinuousCritic):
    """SAC's critics on the latents of the shared encoder, which they do not own."""

    def forward(self, obs: th.Tensor, actions: th.Tensor) -> tuple[th.Tensor, ...]:
        """
        :param obs: Latents, [B, features_dim]
        :param actions: [B, action_dim], in [-1, 1]
        :return: Q values of each critic, [B, 1]
        """
        inputs = th.cat([obs.float(), actions], dim=1)
        return tuple(self._q_value(q_net, inputs) for q_net in self.q_networks)

    @staticmethod
    def _q_value(q_net: nn.Module, inputs: th.Tensor) -> th.Tensor:
        *hidden, output = q_net.children()
        inputs = dense(hidden, inputs)
        with full_precision(inputs):
            return output(inputs.float())


class CuRePolicy(SACPolicy):
    """All networks of CuReSAC and their optimisers.

    ``encoder`` is trained by the SRL head and by the critics; actors see its trunk's features detached. With
    ``curious=True`` there is a second actor-critic. Names: ``encoder``, ``encoder_target``, ``srl``, ``actor``,
    ``critic``, ``critic_target``, ``curious_actor``, ``curious_critic``, ``curious_critic_target``, ``curiosity``
    (scale and running statistics of the curious reward), ``encoder_optimizer``.

    :param observation_space: Observation space (channels-first images, or vectors)
    :param action_space: Action space
    :param lr_schedule: Learning rate schedule
    :param net_arch: Hidden layers of actors and critics (paper: 1024; two of them in SAC-AE)
    :param activation_fn: Activation function
    :param use_sde: Accepted because SB3 passes it; must be False
    :param features_extractor_class: ``PixelEncoder``, ``VectorEncoder`` or any SB3 ``BaseFeaturesExtractor``
    :param features_extractor_kwargs: Its arguments
    :param normalize_images: Must be True: heads and encoder read images in 0-255
    :param optimizer_class: Optimiser of everything, ``th.optim.Adam`` by default
    :param optimizer_kwargs: Its arguments but for the learning rate
    :param n_critics: Number of critics of each agent
    :param share_encoder: Must be True; it asks for this policy where neither SRL nor curiosity does
    :param srl_class: Class of the SRL head, or None
    :param srl_kwargs: Its arguments
    :param curious: Whether there is a second, curious actor-critic
    :param curiosity_kwargs: Arguments of ``CuriousReward``
    :param encoder_sources: Which losses train the encoder
    :param update: ``"sequential"`` or ``"joint"``, see ``EncoderOptimizer``
    :param acting: Who acts in ``predict``: ``"actor"`` or ``"curious_actor"``
    """

    encoder: Encoder
    encoder_target: Encoder
    srl: SRLHead | None
    actor: TrunkActor
    critic: LatentCritic
    critic_target: LatentCritic
    curious_actor: TrunkActor
    curious_critic: LatentCritic
    curious_critic_target: LatentCritic

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        net_arch: list[int] | dict[str, list[int]] | None = None,
        activation_fn: type[nn.Module] = nn.ReLU,
        use_sde: bool = False,
        features_extractor_class: type[BaseFeaturesExtractor] = PixelEncoder,
        features_extractor_kwargs: dict[str, Any] | None = None,
        normalize_images: bool = True,
        optimizer_class: type[th.optim.Optimizer] = th.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
        n_critics: int = 2,
        share_encoder: bool = True,
        srl_class: type[SRLHead] | None = None,
        srl_kwargs: dict[str, Any] | None = None,
        curious: bool = False,
        curiosity_kwargs: dict[str, Any] | None = None,
        encoder_sources: tuple[str, ...] = ("task",),
        update: str = "joint",
        acting: str = "actor",
    ):
        if not (normalize_images and share_encoder) or use_sde:
            raise ValueError(
                f"policy_kwargs got normalize_images={normalize_images}, share_encoder={share_encoder}, "
                f"use_sde={use_sde}, but the shared encoder reads images in 0-255 and has no gSDE: leave them out, or "
                "use srl=None and curiosity=None, which is SB3's own SAC."
            )
        # SACPolicy builds within its constructor: what _build needs comes first.
        self._blueprint: dict[str, Any] = dict(
            srl_class=srl_class,
            srl_kwargs=srl_kwargs or {},
            curious=curious,
            curiosity_kwargs=curiosity_kwargs or {},
            encoder_sources=encoder_sources,
            update=update,
            acting=acting,
        )
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            [1024, 1024] if net_arch is None else net_arch,
            activation_fn,
            features_extractor_class=features_extractor_class,
            features_extractor_kwargs=features_extractor_kwargs,
            optimizer_class=optimizer_class,
            optimizer_kwargs=optimizer_kwargs,
            n_critics=n_critics,
        )

    def _build(self, lr_schedule: Schedule) -> None:
        blueprint = self._blueprint
        if self.optimizer_class is th.optim.Adam and not {"foreach", "differentiable"} & self.optimizer_kwargs.keys():
            # One pass over memory per parameter instead of a dozen; the same update.
            self.optimizer_kwargs = {"fused": True, **self.optimizer_kwargs}
        self.learning_rate = lr_schedule(1)
        self._build_encoder(blueprint["srl_class"], blueprint["srl_kwargs"])
        self.actor, self.critic, self.critic_target = self._make_actor_critic()
        # Always there, as the same buffers then travel with every archive; it costs three numbers.
        self.curiosity = CuriousReward(**blueprint["curiosity_kwargs"])
        self._acting = blueprint["acting"]
        self.remove_curious_agent()
        if blueprint["curious"]:
            self.add_curious_agent()
        self.encoder_optimizer = EncoderOptimizer(
            self.encoder,
            blueprint["encoder_sources"],
            blueprint["update"],
            self.optimizer_class,
            lr=self.learning_rate,
            **self.optimizer_kwargs,
        )

    def _build_encoder(self, srl_class: type[SRLHead] | None, srl_kwargs: dict[str, Any]) -> None:
        space = self.observation_space
        defaults: dict[str, Any] = {}
        if srl_class is not None:
            space, defaults = srl_class.configure_encoder(self.observation_space, **srl_kwargs)
        if not issubclass(self.features_extractor_class, PixelEncoder | VectorEncoder):
            defaults = {}
        self.encoder_space = space
        kwargs = {**defaults, **self.features_extractor_kwargs}
        self.encoder = make_encoder(self.features_extractor_class, space, **kwargs)
        self.encoder_target = copy.deepcopy(self.encoder).requires_grad_(False)
        self.srl = None
        head_seed = int(th.randint(2**62, ()))
        if srl_class is not None:
            # By random numbers of its own, so that under every head the other networks of a seed begin alike.
            with th.random.fork_rng(devices=()):
                th.default_generator.manual_seed(head_seed)
                self.srl = srl_class(self.encoder, self.observation_space, **srl_kwargs)
            check_optimizer_kwargs(f"{srl_class.__name__}.optimizer_kwargs", self.srl.optimizer_kwargs)
            self.srl.bind_target_encoder(self.encoder_target)
            # A head may hold the encoder as a part of its own: it is the encoder's optimiser that trains it.
            shared = set(map(id, [*self.encoder.parameters(), *self.encoder_target.parameters()]))
            parameters = [parameter for parameter in self.srl.parameters() if id(parameter) not in shared]
            # A head without parameters (say, one that scores latents) has nothing to optimise.
            self.srl.optimizer = self._make_optimizer(parameters, **self.srl.optimizer_kwargs) if parameters else None

    def _make_actor_critic(self) -> tuple[TrunkActor, LatentCritic, LatentCritic]:
        encoder = self.encoder
        tanh = getattr(encoder.projection, "tanh", True)
        actor = TrunkActor(
            **self.actor_kwargs,  # type: ignore[arg-type]
            features_extractor=Projection(encoder.trunk_dim, encoder.features_dim, tanh),
            features_dim=encoder.features_dim,
        )
        critic = LatentCritic(
            **self.critic_kwargs,  # type: ignore[arg-type]
            features_extractor=nn.Identity(),  # type: ignore[arg-type]
            features_dim=encoder.features_dim,
        )
        init_weights(actor).to(self.device)
        init_weights(critic).to(self.device)
        target = copy.deepcopy(critic).requires_grad_(False)
        target.set_training_mode(False)
        actor.optimizer = self._make_optimizer(actor.parameters())
        critic.optimizer = self._make_optimizer(critic.parameters())
        return actor, critic, target

    def _make_optimizer(self, parameters: Any, **kwargs: Any) -> th.optim.Optimizer:
        return self.optimizer_class(parameters, lr=self.learning_rate, **{**self.optimizer_kwargs, **kwargs})  # type: ignore[call-arg]

    def add_curious_agent(self) -> None:
        """Build the second actor-critic (with fresh weights)."""
        self.curious_actor, self.curious_critic, self.curious_critic_target = self._make_actor_critic()

    def remove_curious_agent(self) -> None:
        """Drop the second actor-critic."""
        self.curious_actor = self.curious_critic = self.curious_critic_target = None  # type: ignore[assignment]

    def compile_networks(self) -> None:
        """Run what is not compiled yet through torch.compile in training mode: encoders, projections and the head's
        modules. The rest of actors and critics is products of matrices, between which there is nothing to fuse.
        """
        modules = [
            part for encoder in (self.encoder, self.encoder_target) for part in (encoder.trunk, encoder.projection)
        ]
        modules += [actor.features_extractor for actor in (self.actor, self.curious_actor) if actor]
        modules += [] if self.srl is None else list(self.srl.children())
        for module in modules:
            if module._compiled_call_impl is None:
                compile_while_training(module, self)

    def preprocess(self, observations: th.Tensor) -> th.Tensor:
        """
        :param observations: What the encoder is to see (after ``srl.augment`` or ``srl.center``), images in 0-255
        :return: The encoder's input: images in [0, 1]
        """
        return preprocess(observations, self.encoder_space)

    def augment(self, observations: th.Tensor) -> th.Tensor:
        """
        :param observations: [B, *shape], images in 0-255
        :return: Randomly augmented encoder inputs, as in training
        """
        return self.preprocess(self._changed("augment", observations))

    def center(self, observations: th.Tensor) -> th.Tensor:
        """
        :param observations: [B, *shape], images in 0-255
        :return: Encoder inputs without randomness, as when acting
        """
        return self.preprocess(self._changed("center", observations))

    def _changed(self, method: str, observations: th.Tensor) -> th.Tensor:
        """What the head makes of observations, if it is what the encoder was built for."""
        if self.srl is None:
            return observations
        changed: th.Tensor = getattr(self.srl, method)(observations)
        built_for = get_obs_shape(self.encoder_space)
        # Observations that were wrong before the head saw them are not its fault.
        if changed.shape[1:] != built_for and observations.shape[1:] == get_obs_shape(self.observation_space):
            raise ValueError(
                f"{type(self.srl).__name__}.{method} made observations of shape {tuple(changed.shape[1:])} of those of "
                f"shape {tuple(observations.shape[1:])}, but the encoder was built for {built_for}: return that shape, "
                "or name another one in configure_encoder."
            )
        return changed

    def encode(self, observations: th.Tensor) -> th.Tensor:
        """
        :param observations: [B, *shape], images in 0-255
        :return: Latents as the acting agent sees them, [B, features_dim]
        """
        return self.encoder(self.center(observations))

    def obs_to_tensor(self, observation: np.ndarray | dict[str, np.ndarray]) -> tuple[PyTorchObs, bool]:
        """SB3's, which would divide images that are floats by 255 once more.

        :param observation: One observation or a batch
        :return: The batch as a tensor, and whether it was a batch
        :raises ValueError: if it is not made of numbers, or of floats where images are bytes
        """
        dtype = None if isinstance(observation, dict) else np.asarray(observation).dtype
        images = is_image_space(self.observation_space)
        if dtype is None or not np.issubdtype(dtype, np.integer if images else np.number):
            given = "a dictionary" if dtype is None else f"values of type {dtype}"
            raise ValueError(
                f"the observation has {given}, but the policy reads {self.observation_space}: give it as the "
                "environment returns it."
            )
        return super().obs_to_tensor(observation)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        actor = getattr(self, self._acting)
        return actor(self.encoder.trunk(self.center(observation)), deterministic)  # type: ignore[arg-type]

    @contextlib.contextmanager
    def acting(self, actor: str) -> Iterator[None]:
        """Within this context ``predict`` asks the given actor.

        :param actor: ``"actor"`` or ``"curious_actor"``
        """
        previous, self._acting = self._acting, actor
        try:
            yield
        finally:
            self._acting = previous

    def set_training_mode(self, mode: bool) -> None:
        """
        :param mode: Whether layers that differ between training and evaluation behave as in training
        """
        self.train(mode)
        for target in (self.encoder_target, self.critic_target, self.curious_critic_target):
            if target is not None:
                target.train(False)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        for key in ("log_std_init", "use_expln", "clip_mean"):
            del data[key]
        data.update(self._blueprint, curious=self.curious_actor is not None)
        return data


class CnnPolicy(CuRePolicy):
    """``CuRePolicy`` for images."""


class MlpPolicy(CuRePolicy):
    """``CuRePolicy`` for vectors: the same but for the encoder's default class."""

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        features_extractor_class: type[BaseFeaturesExtractor] = VectorEncoder,
        **kwargs: Any,
    ):
        super().__init__(
            observation_space, action_space, lr_schedule, features_extractor_class=features_extractor_class, **kwargs
        )


def encoder_of(policy: BasePolicy) -> tuple[nn.Module, Callable[[th.Tensor], th.Tensor]] | None:
    """Where a policy of any SB3 algorithm makes latents of observations.

    Of other policies than ``CuRePolicy`` it is the features extractor of the critic, else of DQN's networks, of the
    actor, or of the policy itself (PPO, A2C).

    :param policy: A policy
    :return: The encoder, and what it makes, as when acting, of observations as stored ([B, *shape], images in 0-255):
        latents [B, features_dim]. None for dictionaries, and where nothing is learned in between
    """
    encoder: Any
    encode: Callable[[th.Tensor], th.Tensor]
    if isinstance(policy, CuRePolicy):
        encoder, encode = policy.encoder, policy.encode
    else:
        networks = [*(getattr(policy, name, None) for name in ("critic", "q_net", "quantile_net", "actor")), policy]
        owner: Any = next((each for each in networks if getattr(each, "features_extractor", None) is not None), None)
        if owner is None:
            return None
        encoder = owner.features_extractor
        # BaseModel's, as an actor-critic's own returns features of both where these are not shared.
        encode = functools.partial(BaseModel.extract_features, owner, features_extractor=encoder)
    learned = any(True for _ in encoder.parameters())
    return (encoder, encode) if learned and not isinstance(policy.observation_space, spaces.Dict) else None
