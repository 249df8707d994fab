"""Encoder, task actor-critic, curious actor-critic, SRL head and their optimisers, as one SB3 policy."""

import contextlib
import copy
import functools
import math
from collections.abc import Callable, Iterator
from typing import Any, ClassVar

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BaseModel, BasePolicy
from stable_baselines3.common.preprocessing import get_action_dim, is_image_space
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, get_actor_critic_arch
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from stable_baselines3.common.utils import update_learning_rate
from stable_baselines3.sac.policies import Actor
from torch import nn

from sb3_cure.augmentations import make_augmentation
from sb3_cure.buffers import Samples
from sb3_cure.critics import LatentCritic, TwinQ
from sb3_cure.encoder_update import EncoderUpdate
from sb3_cure.encoders import DictEncoder, Encoder, PixelEncoder, VectorEncoder, make_encoder
from sb3_cure.intrinsic import DictReward, IntrinsicReward, RewardScale
from sb3_cure.layers import full_precision, init_weights, preprocess, run_mlp, set_mode
from sb3_cure.observations import image_spaces, images_of, join, sensed_space
from sb3_cure.precision import compile_while_training
from sb3_cure.srl import DictHead, SRLHead, heads_by_key

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
        """
        latent = run_mlp(self.latent_pi, self.features_extractor(obs))
        with full_precision(latent):
            # Rescaled, not clamped: a clamped log std has no gradient with which to come back.
            log_std = th.tanh(self.log_std(latent))  # type: ignore[operator]
            log_std = LOG_STD_MIN + 0.5 * (LOG_STD_MAX - LOG_STD_MIN) * (log_std + 1)
            return self.mu(latent), log_std, {}

    def forward(self, obs: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        """
        :param obs: Trunk features of the encoder, [B, trunk_dim]
        :param deterministic: Whether to return the mean actions
        :return: Actions in [-1, 1], [B, action_dim]
        """
        mean, log_std, _ = self.get_action_dist_params(obs)
        with full_precision(mean):
            return th.tanh(mean if deterministic else mean + th.randn_like(mean) * log_std.exp())

    def action_log_prob(self, obs: PyTorchObs) -> tuple[th.Tensor, th.Tensor]:
        """
        :param obs: Trunk features of the encoder, [B, trunk_dim]
        :return: Actions in [-1, 1], [B, action_dim], and their log-probabilities, [B, 1]
        """
        mean, log_std, _ = self.get_action_dist_params(obs)
        # What SB3's SquashedDiagGaussianDistribution computes; torch's Normal would read its arguments to check them,
        # for which a GPU has to stop.
        with full_precision(mean):
            noise = th.randn_like(mean)
            actions = th.tanh(mean + noise * log_std.exp())
            log_prob = -0.5 * (noise.square() + math.log(2 * math.pi)) - log_std
            return actions, (log_prob - th.log(1 - actions.square() + EPSILON)).sum(dim=1, keepdim=True)


class ActorCritic(nn.Module):
    """One agent on the shared encoder: actor, critics, target critics and temperature, with their optimisers.

    :param actor: The actor, with its optimiser
    :param critic: The critics, with their optimiser
    """

    def __init__(self, actor: TrunkActor, critic: LatentCritic):
        super().__init__()
        self.actor = actor
        self.critic = critic
        self.critic_target = copy.deepcopy(critic).requires_grad_(False).eval()
        #: Logarithm of the learned temperature, [1], and its optimiser; None where it is fixed
        self.log_ent_coef: th.Tensor | None = None
        self.ent_coef_optimizer: th.optim.Optimizer | None = None
        #: The fixed temperature, []
        self.ent_coef_tensor: th.Tensor | None = None

    def set_temperature(self, ent_coef: str | float, lr: float, device: th.device) -> None:
        """Make a temperature of its own, as SB3's SAC does.

        :param ent_coef: ``"auto"``, ``"auto_<initial value>"``, or a fixed number
        :param lr: Learning rate
        :param device: Where to put it
        """
        if isinstance(ent_coef, str) and ent_coef.startswith("auto"):
            initial = float(ent_coef.split("_")[1]) if "_" in ent_coef else 1.0
            self.adopt_temperature(th.full((1,), initial, device=device).log().requires_grad_(True), lr)
        else:
            self.ent_coef_tensor = th.tensor(float(ent_coef), device=device)

    def adopt_temperature(self, log_ent_coef: th.Tensor, lr: float) -> None:
        """Take a learned temperature, with the reference's optimiser (SAC-AE: beta1 = 0.5).

        :param log_ent_coef: Logarithm of the temperature, [1]
        :param lr: Learning rate
        """
        self.log_ent_coef = log_ent_coef
        self.ent_coef_optimizer = th.optim.Adam([log_ent_coef], lr=lr, betas=(0.5, 0.999), fused=True)

    def temperature(self) -> th.Tensor:
        """
        :return: Temperature alpha, detached, [1] or []
        """
        return self.ent_coef_tensor if self.log_ent_coef is None else self.log_ent_coef.detach().exp()  # type: ignore[return-value]


class CuRePolicy(BasePolicy):
    """All networks of CuRe and their optimisers.

    ``encoder`` (with its moving average ``encoder_target``) is trained by the SRL head ``srl`` and by the critics;
    actors see its trunk's features detached. ``task`` is the task's actor-critic, ``curious`` the curious one or None;
    ``actor``, ``critic`` and ``critic_target`` are the task's. ``intrinsic`` computes the intrinsic reward, ``scale``
    scales it. ``augmentation`` says what the encoder sees, ``encoder_update`` how it is stepped.

    :param observation_space: Observation space (channels-first images, vectors, or a dictionary of both)
    :param action_space: Action space
    :param lr_schedule: Learning rate schedule
    :param net_arch: Hidden layers of actors and critics (paper: 1024; two of them in SAC-AE)
    :param activation_fn: Activation function
    :param use_sde: Accepted because SB3 passes it
    :param features_extractor_class: ``PixelEncoder``, ``VectorEncoder``, ``DictEncoder`` or any SB3
        ``BaseFeaturesExtractor``
    :param features_extractor_kwargs: Its arguments
    :param optimizer_class: Optimiser of everything, ``th.optim.Adam`` by default
    :param optimizer_kwargs: Its arguments but for the learning rate
    :param share_encoder: Asks for this policy where neither SRL nor curiosity does
    :param srl_class: Class of the SRL head, or None
    :param srl_kwargs: Its arguments
    :param augmentation: ``"auto"`` (what the head asks for), ``"shift"``, ``"crop"`` or None
    :param augmentation_kwargs: Its arguments
    :param intrinsic_class: Class of the intrinsic reward, or None
    :param intrinsic_kwargs: Its arguments
    :param curious: Whether there is a curious actor-critic
    :param encoder_sources: Which losses train the encoder
    :param update: ``"sequential"`` or ``"joint"``, see ``EncoderUpdate``
    :param default_agent: Who acts in ``predict``: ``"task"`` or ``"curious"``
    :param critic_kwargs: Arguments of the critics: ``n_critics``, ``critic_arch`` (see ``LatentCritic``), and TQC's
        ``n_quantiles``
    """

    critics: ClassVar[type[TwinQ]] = TwinQ
    #: By default for vectors or for images
    default_encoder: ClassVar[type[BaseFeaturesExtractor]] = PixelEncoder

    encoder: Encoder
    encoder_target: Encoder
    srl: SRLHead | None
    intrinsic: IntrinsicReward | None
    curious: ActorCritic | None

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        net_arch: list[int] | dict[str, list[int]] | None = None,
        activation_fn: type[nn.Module] = nn.ReLU,
        use_sde: bool = False,
        features_extractor_class: type[BaseFeaturesExtractor] | None = None,
        features_extractor_kwargs: dict[str, Any] | None = None,
        optimizer_class: type[th.optim.Optimizer] = th.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
        share_encoder: bool = True,
        *,
        srl_class: type[SRLHead] | None = None,
        srl_kwargs: dict[str, Any] | None = None,
        augmentation: str | None = "auto",
        augmentation_kwargs: dict[str, Any] | None = None,
        intrinsic_class: type[IntrinsicReward] | None = None,
        intrinsic_kwargs: dict[str, Any] | None = None,
        curious: bool = False,
        encoder_sources: tuple[str, ...] = ("task",),
        update: str = "joint",
        default_agent: str = "task",
        **critic_kwargs: Any,
    ):
        super().__init__(
            observation_space,
            action_space,
            features_extractor_class or self.choose_encoder(observation_space),
            features_extractor_kwargs,
            optimizer_class=optimizer_class,
            optimizer_kwargs=optimizer_kwargs,
            squash_output=True,
        )
        self.net_arch = [1024, 1024] if net_arch is None else net_arch
        self.activation_fn = activation_fn
        self.critic_kwargs = {"n_critics": 2, **critic_kwargs}
        #: Whether encoder and head stay as they are
        self.representation_frozen = False
        #: Who acts in ``predict``
        self.default_agent = default_agent
        if self.optimizer_class is th.optim.Adam and not {"foreach", "differentiable"} & self.optimizer_kwargs.keys():
            # One pass over memory per parameter instead of a dozen; the same update.
            self.optimizer_kwargs = {"fused": True, **self.optimizer_kwargs}
        self.learning_rate = lr_schedule(1)
        # What `_get_constructor_parameters` gives back
        self._choices: dict[str, Any] = dict(
            srl_class=srl_class,
            srl_kwargs=srl_kwargs,
            augmentation=augmentation,
            augmentation_kwargs=augmentation_kwargs,
            update=update,
        )
        #: What encoder, head and rewards take observations for
        self.sensed_space = sensed_space(observation_space)
        chosen: Any = augmentation
        if augmentation == "auto":
            chosen = None if srl_class is None else srl_class.choose_augmentation
        self.augmentation = make_augmentation(chosen, self.sensed_space, **(augmentation_kwargs or {}))
        self._build_encoder(srl_class, srl_kwargs or {})
        self.task = self._make_actor_critic()
        self.curious = self.intrinsic = None
        # Always there, as the same buffers then travel with every archive; it costs two numbers.
        self.scale = RewardScale()
        if intrinsic_class is not None:
            self._build_intrinsic(intrinsic_class, intrinsic_kwargs or {})
        if curious:
            self.curious = self._make_actor_critic()
        self.encoder_update = EncoderUpdate(
            self.encoder, encoder_sources, update, optimizer_class, lr=self.learning_rate, **self.optimizer_kwargs
        )

    @classmethod
    def choose_encoder(cls, observation_space: spaces.Space) -> type[BaseFeaturesExtractor]:
        """
        :param observation_space: Observation space
        :return: Class of the encoder where the user names none
        """
        return cls.default_encoder

    def _encoder_kwargs(self, srl_class: type[SRLHead] | None, srl_kwargs: dict[str, Any]) -> dict[str, Any]:
        """The user's, and what the head asks for where the user does not."""
        kwargs = dict(self.features_extractor_kwargs)
        if srl_class is not None and issubclass(self.features_extractor_class, PixelEncoder | VectorEncoder):
            return {**srl_class.configure_encoder(self.augmentation, **srl_kwargs), **kwargs}
        if srl_class is not None and issubclass(self.features_extractor_class, DictEncoder):
            own, by_key = kwargs.pop("by_key", {}), {}
            for key in image_spaces(self.sensed_space):
                asked = srl_class.configure_encoder(self.augmentation.of(key), **srl_kwargs)
                by_key[key] = {**asked, **kwargs, **own.get(key, {})}
            return {"by_key": by_key}
        return kwargs

    def _build_head(self, srl_class: type[SRLHead], srl_kwargs: dict[str, Any]) -> SRLHead:
        # Dynamics are of the joined latents; what there is to see of an image is each image's own.
        joined = srl_class.needs_next_latents or srl_class.models_transitions
        if joined or not isinstance(self.sensed_space, spaces.Dict):
            return srl_class(self.encoder, self.sensed_space, **srl_kwargs)
        return DictHead(srl_class, self.encoder, self.sensed_space, **srl_kwargs)

    def _build_encoder(self, srl_class: type[SRLHead] | None, srl_kwargs: dict[str, Any]) -> None:
        kwargs = self._encoder_kwargs(srl_class, srl_kwargs)
        self.encoder = make_encoder(self.features_extractor_class, self.augmentation.view_space, **kwargs)
        self.encoder_target = copy.deepcopy(self.encoder).requires_grad_(False)
        self.srl = None
        seed = int(th.randint(2**62, ()))
        if srl_class is not None:
            if srl_class.models_transitions:
                srl_kwargs = {"action_space": self.action_space, **srl_kwargs}
            with _seeded(seed):
                self.srl = self._build_head(srl_class, srl_kwargs)
            self.srl.bind(self.encoder_target, self.augmentation)
            # A head may hold the encoder as a part of its own: it is the encoder's optimiser that trains it.
            shared = set(map(id, [*self.encoder.parameters(), *self.encoder_target.parameters()]))
            parameters = [parameter for parameter in self.srl.parameters() if id(parameter) not in shared]
            # A head without parameters (say, one that scores latents) has nothing to optimise.
            self.srl.optimizer = self._make_optimizer(parameters, **self.srl.optimizer_kwargs) if parameters else None
        self._intrinsic_seed = seed + 1

    def _build_intrinsic(self, intrinsic_class: type[IntrinsicReward], kwargs: dict[str, Any]) -> None:
        self._intrinsic_choice = intrinsic_class, kwargs
        per_image = isinstance(self.sensed_space, spaces.Dict) and intrinsic_class.configured(**kwargs).per_image
        make: Any = functools.partial(DictReward, intrinsic_class) if per_image else intrinsic_class
        with _seeded(self._intrinsic_seed):
            self.intrinsic = make(self.sensed_space, self.action_space, self.encoder.features_dim, **kwargs)
        assert self.intrinsic is not None
        self.intrinsic.bind(self.srl)
        parameters = [parameter for parameter in self.intrinsic.parameters() if parameter.requires_grad]
        self.intrinsic.optimizer = self._make_optimizer(parameters) if parameters else None

    def _make_actor_critic(self) -> ActorCritic:
        encoder = self.encoder
        actor_arch, critic_arch = get_actor_critic_arch(self.net_arch)
        actor = TrunkActor(
            self.observation_space,
            self.action_space,  # type: ignore[arg-type]
            actor_arch,
            encoder.make_projection(),  # type: ignore[arg-type]
            encoder.features_dim,
            activation_fn=self.activation_fn,
        )
        action_dim = get_action_dim(self.action_space)
        critic = self.critics.make(
            encoder.features_dim, action_dim, critic_arch, self.activation_fn, **self.critic_kwargs
        )
        agent = ActorCritic(init_weights(actor), init_weights(critic)).to(self.device)
        actor.optimizer = self._make_optimizer(actor.parameters())
        critic.optimizer = self._make_optimizer(critic.parameters())
        return agent

    def _make_optimizer(self, parameters: Any, **kwargs: Any) -> th.optim.Optimizer:
        return self.optimizer_class(parameters, lr=self.learning_rate, **{**self.optimizer_kwargs, **kwargs})  # type: ignore[call-arg]

    def add_curious_agent(self, intrinsic_class: type[IntrinsicReward], kwargs: dict[str, Any]) -> None:
        """Build the curious actor-critic and its reward, with fresh weights.

        :param intrinsic_class: Class of the reward
        :param kwargs: Its arguments
        """
        if self.intrinsic is None:
            self._build_intrinsic(intrinsic_class, kwargs)
        self.curious = self._make_actor_critic()

    @property
    def actor(self) -> TrunkActor:
        """The task's actor."""
        return self.task.actor

    @property
    def critic(self) -> LatentCritic:
        """The task's critics."""
        return self.task.critic

    @property
    def critic_target(self) -> LatentCritic:
        """The task's target critics."""
        return self.task.critic_target

    @property
    def agents(self) -> dict[str, ActorCritic]:
        """Actor-critics by name: ``"task"``, and ``"curious"`` if there is one."""
        return {"task": self.task} if self.curious is None else {"task": self.task, "curious": self.curious}

    def _owners(self) -> dict[str, Any]:
        """What has an optimiser that follows the learning rate, by the name that a model knows it by."""
        owners: dict[str, Any] = {"actor": self.actor, "critic": self.critic}
        owners |= {"policy.srl": self.srl, "policy.intrinsic": self.intrinsic}
        if self.curious is not None:
            owners |= {"policy.curious.actor": self.curious.actor, "policy.curious.critic": self.curious.critic}
        return {name: owner for name, owner in owners.items() if owner is not None and owner.optimizer is not None}

    def set_learning_rate(self, learning_rate: float, temperature_factor: float) -> None:
        """One rate for everything; the temperatures follow it at a fixed ratio, so that a zero freezes all.

        :param learning_rate: Of everything but the temperatures
        :param temperature_factor: Theirs as a multiple of it
        """
        self.encoder_update.learning_rate = learning_rate
        for owner in self._owners().values():
            update_learning_rate(owner.optimizer, learning_rate)
        for agent in self.agents.values():
            if agent.ent_coef_optimizer is not None:
                update_learning_rate(agent.ent_coef_optimizer, learning_rate * temperature_factor)

    def saved_names(self) -> tuple[list[str], list[str]]:
        """What is saved of a model beside the base class's.

        :return: Names of what has a state dict, and of tensors
        """
        state_dicts = ["policy.encoder_update"]
        state_dicts += [f"{name}.optimizer" for name in self._owners() if name.startswith("policy.")]
        if self.curious is None:
            return state_dicts, []
        if self.curious.log_ent_coef is None:
            return state_dicts, ["policy.curious.ent_coef_tensor"]
        return [*state_dicts, "policy.curious.ent_coef_optimizer"], ["policy.curious.log_ent_coef"]

    def compile_networks(self) -> None:
        """Run what is not compiled yet through torch.compile in training mode: encoders, projections and the head's
        modules. The rest of actors and critics is products of matrices, between which there is nothing to fuse.
        """
        modules = [
            part for encoder in (self.encoder, self.encoder_target) for part in (encoder.trunk, encoder.projection)
        ]
        modules += [agent.actor.features_extractor for agent in self.agents.values()]
        modules += [part for head in heads_by_key(self.srl).values() for part in head.children()]
        for module in modules:
            if module._compiled_call_impl is None:
                compile_while_training(module, self)

    def sense(self, observations: Any) -> Any:
        """
        :param observations: As stored, [B, *shape], or a dictionary of such
        :return: What encoder, head and rewards take them for: a dictionary without images is one vector
        """
        if self.sensed_space is self.observation_space or not isinstance(observations, dict):
            return observations
        return join(observations, self.observation_space)  # type: ignore[arg-type]

    def samples(self, sampled: Any, random: bool = True) -> Samples:
        """
        :param sampled: What a replay buffer returned
        :param random: Whether the views are random ones, to learn from; else the centred ones, to measure
        :return: The same as heads and rewards get it
        """
        fields = sampled._asdict()
        for name in ("observations", "next_observations"):
            fields[name] = _channels_last(self.sense(fields[name]))
        see = self.views if random else self.augmentation.center
        return Samples(**{**fields, "views": see(fields["observations"])})

    def preprocess(self, views: Any) -> Any:
        """
        :param views: What the encoder is to see, images in 0-255
        :return: The encoder's input: images in [0, 1]
        """
        return preprocess(views, self.augmentation.view_space)

    def augment(self, observations: Any) -> Any:
        """
        :param observations: [B, *shape], images in 0-255
        :return: Randomly augmented encoder inputs, as in training
        """
        return self.preprocess(self.views(observations))

    def views(self, observations: Any) -> Any:
        """
        :param observations: [B, *shape], images in 0-255
        :return: What the encoder is to learn from: random views, images in NHWC memory order, [B, *view shape]
        """
        return _channels_last(self.augmentation(self.sense(observations)))

    def center(self, observations: Any) -> Any:
        """
        :param observations: [B, *shape], images in 0-255
        :return: Encoder inputs without randomness, as when acting
        """
        return self.preprocess(self.augmentation.center(self.sense(observations)))

    def encode(self, observations: Any) -> th.Tensor:
        """
        :param observations: [B, *shape], images in 0-255
        :return: Latents as the acting agent sees them, [B, features_dim]
        """
        return self.encoder(self.center(observations))

    @property
    def traits(self) -> dict[str, Any]:
        """What the shapes of tensors do not tell of encoder, head and intrinsic reward, by name."""
        encoders: dict[str, Any] = getattr(self.encoder, "images", {"": self.encoder})
        tanh = {key: getattr(encoder.projection, "tanh", None) for key, encoder in encoders.items()}
        srl_class = self._choices["srl_class"]
        return {
            "observations": _kinds(self.observation_space),
            "views": _kinds(self.augmentation.view_space),
            "encoder": self.features_extractor_class.__name__,
            "tanh": tanh if len(tanh) > 1 else next(iter(tanh.values())),
            "srl": None if srl_class is None else srl_class.__name__,
            "intrinsic": None if self.intrinsic is None else self._intrinsic_choice[0].__name__,
        }

    @property
    def measures_errors(self) -> bool:
        """Whether there is something to measure by: see ``error``."""
        return self.srl is not None or (self.intrinsic is not None and self.intrinsic.measures)

    def error(self, batch: Samples) -> th.Tensor:
        """The noise-free error by which policies are compared: the intrinsic reward's, if it has one, else the head's.

        :param batch: Samples whose ``views`` are the centred ones
        :return: [B]
        """
        latents = self.encode(batch.observations)
        if self.intrinsic is not None and self.intrinsic.measures:
            return self.intrinsic.error(batch.observations, latents)
        return self.srl.error(batch, latents)  # type: ignore[union-attr]

    def reconstruct(self, observations: Any) -> tuple[Any, Any] | None:
        """
        :param observations: [B, *shape], images in 0-255
        :return: What was to be drawn, and what the head, or else the intrinsic reward, draws of it from the latents
            (of dictionaries, the images by key); None if neither draws
        """
        observations = self.sense(observations)
        latents = self.encode(observations)
        for part, seen in ((self.srl, self.augmentation.center(observations)), (self.intrinsic, observations)):
            drawn = None if part is None else part.reconstruct(latents)
            if isinstance(drawn, dict):
                return images_of(seen, self.sensed_space), drawn
            if drawn is not None:
                return seen, drawn
        return None

    def forward(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        """
        :param observation: [B, *shape]
        :param deterministic: Whether to return the mean action
        :return: Actions in [-1, 1], [B, action_dim]
        """
        return self._predict(observation, deterministic)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        actor = self.agents[self.default_agent].actor
        return actor(self.encoder.trunk(self.center(observation)), deterministic)

    @contextlib.contextmanager
    def acting(self, agent: str) -> Iterator[None]:
        """Within this context ``predict`` asks the given agent.

        :param agent: ``"task"`` or ``"curious"``
        """
        previous, self.default_agent = self.default_agent, agent
        try:
            yield
        finally:
            self.default_agent = previous

    def set_training_mode(self, mode: bool) -> None:
        """
        :param mode: Whether layers that differ between training and evaluation behave as in training; those of targets
            and of a frozen representation never do
        """
        set_mode(self, mode)
        targets = (self.encoder_target, *(agent.critic_target for agent in self.agents.values()))
        frozen = (self.encoder, self.srl) if self.representation_frozen else ()
        for still in filter(None, (*targets, *frozen)):
            set_mode(still, False)

    def freeze_representation(self) -> None:
        """Keep encoder and head as they are; the target encoder, which would follow, becomes the encoder."""
        self.representation_frozen = True
        self.encoder.requires_grad_(False)
        self.encoder_target.load_state_dict(self.encoder.state_dict())

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        del data["normalize_images"]
        # Of what there is now: a curious agent may have come for a pretraining.
        intrinsic = (None, None) if self.intrinsic is None else self._intrinsic_choice
        return data | dict(
            lr_schedule=self._dummy_schedule,
            net_arch=self.net_arch,
            activation_fn=self.activation_fn,
            features_extractor_class=self.features_extractor_class,
            features_extractor_kwargs=self.features_extractor_kwargs,
            optimizer_class=self.optimizer_class,
            optimizer_kwargs=self.optimizer_kwargs,
            intrinsic_class=intrinsic[0],
            intrinsic_kwargs=intrinsic[1],
            curious=self.curious is not None,
            encoder_sources=tuple(self.encoder_update.weights),
            default_agent=self.default_agent,
            **self._choices,
            **self.critic_kwargs,
        )


class CnnPolicy(CuRePolicy):
    """``CuRePolicy`` for images."""


class MlpPolicy(CuRePolicy):
    """``CuRePolicy`` for vectors: the same but for the encoder's default class."""

    default_encoder = VectorEncoder


class MultiInputPolicy(CuRePolicy):
    """``CuRePolicy`` for dictionaries of images and vectors; one without images acts as one vector."""

    @classmethod
    def choose_encoder(cls, observation_space: spaces.Space) -> type[BaseFeaturesExtractor]:
        """
        :param observation_space: Dictionary of images and vectors
        :return: Class of the encoder
        """
        return DictEncoder if image_spaces(observation_space) else VectorEncoder


def _kinds(space: spaces.Space) -> Any:
    """Kind and shape of an observation, of dictionaries of each part in their order."""
    if isinstance(space, spaces.Dict):
        return [f"{key}: {_kinds(part)}" for key, part in space.spaces.items()]
    return f"{'image' if is_image_space(space) else type(space).__name__} {space.shape}"


def _channels_last(views: Any) -> Any:
    """Images in NHWC memory order; vectors, and None, as they are."""
    if isinstance(views, dict):
        return {key: _channels_last(view) for key, view in views.items()}
    is_images = isinstance(views, th.Tensor) and views.dim() == 4
    return views.contiguous(memory_format=th.channels_last) if is_images else views


@contextlib.contextmanager
def _seeded(seed: int) -> Iterator[None]:
    """Random numbers of its own, so that under every head and reward the other networks of a seed begin alike."""
    with th.random.fork_rng(devices=()):
        th.default_generator.manual_seed(seed)
        yield


def encoder_of(policy: BasePolicy) -> tuple[nn.Module, Callable[[th.Tensor], th.Tensor]] | None:
    """Where a policy of any SB3 algorithm makes latents of observations.

    Of other policies than ``CuRePolicy`` it is the features extractor of the critic, else of DQN's networks, of the
    actor, or of the policy itself (PPO, A2C).

    :param policy: A policy
    :return: The encoder, and what it makes, as when acting, of observations as stored ([B, *shape], images in 0-255):
        latents [B, features_dim]. None for dictionaries of other policies, and where nothing is learned in between
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
    known = isinstance(policy, CuRePolicy) or not isinstance(policy.observation_space, spaces.Dict)
    return (encoder, encode) if learned and known else None
