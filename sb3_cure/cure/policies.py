"""Encoder, task actor-critic, curious actor-critic, SRL head and their optimisers, as one SB3 policy."""

import contextlib
import copy
import functools
from collections.abc import Iterator
from typing import Any, ClassVar

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import get_action_dim, is_image_space
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, get_actor_critic_arch
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from stable_baselines3.common.utils import update_learning_rate
from torch import nn

from sb3_cure.cure.actor_critic import ActorCritic, TrunkActor
from sb3_cure.cure.critics import LatentCritic, TwinCritic
from sb3_cure.cure.encoder_update import EncoderUpdate
from sb3_cure.data.observations import check_images, image_spaces, images_of, sensed_space
from sb3_cure.data.samples import Samples
from sb3_cure.intrinsic import IntrinsicReward, RewardScale, make_reward
from sb3_cure.networks.augmentations import make_augmentation
from sb3_cure.networks.encoders import DictEncoder, Encoder, PixelEncoder, VectorEncoder, make_encoder
from sb3_cure.networks.layers import flatten_vectors, init_weights, set_mode
from sb3_cure.srl import DictHead, SRLHead


class CuRePolicy(BasePolicy):
    """All networks of CuRe and their optimisers.

    ``encoder`` (with its moving average ``encoder_target``) is trained by the SRL head ``srl`` and by the critics;
    actors see its trunk's features detached. ``task`` is the task's actor-critic, ``curious`` the curious one or None;
    ``actor``, ``critic`` and ``critic_target`` are the task's. ``intrinsic`` computes the intrinsic reward, ``scale``
    scales it. ``augmentation`` makes the views that the encoder sees, ``encoder_update`` steps it.

    :param observation_space: Observation space (channels-first images, vectors, or a dictionary of both)
    :param action_space: Action space
    :param lr_schedule: Learning rate schedule
    :param net_arch: Hidden layers of actors and critics (paper: 1024; two of them in SAC-AE)
    :param activation_fn: Activation function
    :param use_sde: Accepted because SB3 passes it
    :param features_extractor_class: ``PixelEncoder``, ``VectorEncoder``, ``DictEncoder`` or any SB3
        ``BaseFeaturesExtractor``
    :param features_extractor_kwargs: Its arguments
    :param optimizer_class: Optimiser of all networks, ``th.optim.Adam`` by default; temperatures always use Adam
    :param optimizer_kwargs: Its arguments except the learning rate
    :param n_critics: Number of critics
    :param n_quantiles: Quantiles of each critic (TQC; 25 by default)
    :param critic_arch: ``"mlp"`` or ``"residual"``, see ``LatentCritic``
    :param top_quantiles_to_drop_per_net: Quantiles dropped for each critic (TQC), an argument of the algorithm
    :param critic_class: Class of the critics
    :param srl_class: Class of the SRL head, or None
    :param srl_kwargs: Its arguments
    :param augmentation: ``"auto"`` (what the head needs), ``"shift"``, ``"crop"`` or None
    :param augmentation_kwargs: Its arguments
    :param intrinsic_class: Class of the intrinsic reward, or None
    :param intrinsic_kwargs: Its arguments
    :param reward_settings: What rewards may need to know: ``frame_stack``, ``curiosity_target``
    :param task: Whether there is a task to learn (its actor-critic is there either way)
    :param curious: Whether there is a curious actor-critic
    :param curiosity_encoder_grad: Whether the curious critics train the encoder
    :param update: ``"sequential"`` or ``"joint"``, see ``EncoderUpdate``
    """

    #: Class of the encoder by default
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
        n_critics: int = 2,
        n_quantiles: int | None = None,
        critic_arch: str = "mlp",
        *,
        top_quantiles_to_drop_per_net: int | None = None,
        critic_class: type[LatentCritic] = TwinCritic,
        srl_class: type[SRLHead] | None = None,
        srl_kwargs: dict[str, Any] | None = None,
        augmentation: str | None = "auto",
        augmentation_kwargs: dict[str, Any] | None = None,
        intrinsic_class: type[IntrinsicReward] | None = None,
        intrinsic_kwargs: dict[str, Any] | None = None,
        reward_settings: dict[str, Any] | None = None,
        task: bool = True,
        curious: bool = False,
        curiosity_encoder_grad: bool = True,
        update: str = "joint",
    ):
        # This comes first, while `locals()` holds only the arguments, which `_get_constructor_parameters` returns.
        arguments = {name: value for name, value in locals().items() if name not in ("self", "__class__")}
        super().__init__(
            observation_space,
            action_space,
            features_extractor_class or self._choose_encoder(observation_space),
            features_extractor_kwargs,
            optimizer_class=optimizer_class,
            optimizer_kwargs=optimizer_kwargs,
            squash_output=True,
        )
        self._arguments = arguments | {"lr_schedule": self._dummy_schedule}
        self.net_arch = [1024, 1024] if net_arch is None else net_arch
        self.activation_fn = activation_fn
        critic_kwargs = dict(n_quantiles=n_quantiles, top_quantiles_to_drop_per_net=top_quantiles_to_drop_per_net)
        given = {name: value for name, value in critic_kwargs.items() if value is not None}
        self._make_critic: Any = functools.partial(critic_class, n_critics=n_critics, critic_arch=critic_arch, **given)  # type: ignore[arg-type]
        #: Whether encoder and head stay as they are
        self.representation_frozen = False
        #: Who acts in ``predict``: ``"task"`` or ``"curious"``
        self.default_agent = "task" if task or not curious else "curious"
        if self.optimizer_class is th.optim.Adam and not {"foreach", "differentiable"} & self.optimizer_kwargs.keys():
            # One pass over memory per parameter instead of a dozen; the same update.
            self.optimizer_kwargs = {"fused": True, **self.optimizer_kwargs}
        self.learning_rate = lr_schedule(1)
        #: Space of observations as encoder, head and rewards get them
        self.sensed_space = sensed_space(observation_space)
        chosen: Any = augmentation
        if augmentation == "auto":
            chosen = None if srl_class is None else srl_class.choose_augmentation
        self.augmentation = make_augmentation(chosen, self.sensed_space, **(augmentation_kwargs or {}))
        self._build_encoder(srl_class, srl_kwargs or {})
        self.task = self._make_actor_critic()
        self.curious = self.intrinsic = None
        # Also without curiosity, so that all archives have the same buffers
        self.scale = RewardScale()
        if intrinsic_class is not None:
            self._build_intrinsic(intrinsic_class, intrinsic_kwargs or {})
        if curious:
            self.curious = self._make_actor_critic()
        self.encoder_update = EncoderUpdate(
            self.encoder,
            self.encoder_target,
            self._encoder_sources(),
            update,
            optimizer_class,
            lr=self.learning_rate,
            **self.optimizer_kwargs,
        )

    # -------------------------------------------------------------- building

    @classmethod
    def _choose_encoder(cls, observation_space: spaces.Space) -> type[BaseFeaturesExtractor]:
        """Return the default encoder; dictionaries without images count as one vector and get a ``VectorEncoder``."""
        is_vector = cls.default_encoder is DictEncoder and not image_spaces(observation_space)
        return VectorEncoder if is_vector else cls.default_encoder

    def _encoder_kwargs(self, srl_class: type[SRLHead] | None) -> dict[str, Any]:
        """Arguments of the encoder: the head's defaults, overridden by the user's."""
        kwargs = dict(self.features_extractor_kwargs)
        if srl_class is not None and issubclass(self.features_extractor_class, PixelEncoder | VectorEncoder):
            return {**srl_class.configure_encoder(self.augmentation), **kwargs}
        if srl_class is not None and issubclass(self.features_extractor_class, DictEncoder):
            kwargs_by_key = dict(kwargs.pop("by_key", {}))
            for key in image_spaces(self.sensed_space):
                defaults = srl_class.configure_encoder(self.augmentation.of(key))
                kwargs_by_key[key] = {**defaults, **kwargs, **kwargs_by_key.get(key, {})}
            return {"by_key": kwargs_by_key}
        return kwargs

    def _build_encoder(self, srl_class: type[SRLHead] | None, srl_kwargs: dict[str, Any]) -> None:
        kwargs = self._encoder_kwargs(srl_class)
        self.encoder = make_encoder(self.features_extractor_class, self.augmentation.view_space, **kwargs)
        self.encoder_target = copy.deepcopy(self.encoder).requires_grad_(False)
        self.srl = None
        self._head_seed = int(th.randint(2**62, ()))
        if srl_class is None:
            return
        with _forked_rng(self._head_seed):
            self.srl = self._build_head(srl_class, srl_kwargs)
        self.srl.bind(self.encoder_target, self.augmentation)
        parameters = self._own_parameters(self.srl)
        self.srl.optimizer = self._make_optimizer(parameters, **self.srl.optimizer_kwargs) if parameters else None

    def _own_parameters(self, module: nn.Module) -> list[nn.Parameter]:
        """Parameters of a head or reward without those of encoder and head, which it may have registered."""
        others = [each for each in (self.encoder, self.encoder_target, self.srl) if each not in (None, module)]
        shared = {id(parameter) for other in others for parameter in other.parameters()}
        return [parameter for parameter in module.parameters() if id(parameter) not in shared]

    def _build_head(self, srl_class: type[SRLHead], srl_kwargs: dict[str, Any]) -> SRLHead:
        """Dynamics heads use the joint latents; other heads get one instance per image of a dictionary."""
        if srl_class.models_transitions:
            srl_kwargs = {"action_space": self.action_space, **srl_kwargs}
        joint = srl_class.needs_next_latents or srl_class.models_transitions
        if joint or not isinstance(self.sensed_space, spaces.Dict):
            return srl_class(self.encoder, self.sensed_space, **srl_kwargs)
        return DictHead(srl_class, self.encoder, self.sensed_space, **srl_kwargs)

    def _build_intrinsic(self, intrinsic_class: type[IntrinsicReward], intrinsic_kwargs: dict[str, Any]) -> None:
        with _forked_rng(self._head_seed + 1):
            self.intrinsic = make_reward(
                intrinsic_class,
                self.sensed_space,
                self.action_space,  # type: ignore[arg-type]
                self.encoder.features_dim,
                settings={**(self._arguments["reward_settings"] or {}), "srl": self.srl},
                kwargs=intrinsic_kwargs,
            )
        parameters = [each for each in self._own_parameters(self.intrinsic) if each.requires_grad]
        self.intrinsic.optimizer = self._make_optimizer(parameters) if parameters else None

    def _make_actor_critic(self) -> ActorCritic:
        encoder = self.encoder
        actor_layers, critic_layers = get_actor_critic_arch(self.net_arch)
        actor = TrunkActor(
            self.observation_space,
            self.action_space,  # type: ignore[arg-type]
            actor_layers,
            encoder.make_projection(),  # type: ignore[arg-type]
            encoder.features_dim,
            activation_fn=self.activation_fn,
        )
        action_dim = get_action_dim(self.action_space)
        critic = self._make_critic(encoder.features_dim, action_dim, critic_layers, self.activation_fn)
        agent = ActorCritic(init_weights(actor), critic).to(self.device)
        actor.optimizer = self._make_optimizer(actor.parameters())
        critic.optimizer = self._make_optimizer(critic.parameters())
        return agent

    def _make_optimizer(self, parameters: Any, **kwargs: Any) -> th.optim.Optimizer:
        return self.optimizer_class(parameters, lr=self.learning_rate, **{**self.optimizer_kwargs, **kwargs})  # type: ignore[call-arg]

    def _encoder_sources(self) -> list[str]:
        """Losses that train the encoder."""
        trains = {
            "srl": self.srl is not None,
            "intrinsic": self.intrinsic is not None and self.intrinsic.trains_encoder,
            "task": self._arguments["task"],
            "curious": self.curious is not None and self._arguments["curiosity_encoder_grad"],
        }
        return [source for source, does in trains.items() if does]

    def add_curious_agent(self, intrinsic_class: type[IntrinsicReward], intrinsic_kwargs: dict[str, Any]) -> None:
        """Build the curious actor-critic and, if there is none, its reward, with fresh weights.

        :param intrinsic_class: Class of the reward
        :param intrinsic_kwargs: Its arguments
        """
        if self.intrinsic is None:
            self._build_intrinsic(intrinsic_class, intrinsic_kwargs)
        self._arguments |= dict(intrinsic_class=intrinsic_class, intrinsic_kwargs=intrinsic_kwargs, curious=True)
        self.curious = self._make_actor_critic()
        self.to(self.device)
        self.encoder_update.set_sources(self._encoder_sources())

    def remove_curious_agent(self, keep_reward: bool) -> None:
        """Drop the curious actor-critic, and forget the scale of its rewards, which differs from that of a bonus.

        :param keep_reward: Whether its reward stays
        """
        self._arguments["curious"] = False
        self.curious = None
        self.scale.forget()
        if not keep_reward:
            self.intrinsic = self._arguments["intrinsic_class"] = None
        self.encoder_update.set_sources(self._encoder_sources())

    # ---------------------------------------------------------------- agents

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

    @property
    def encoder_optimizer(self) -> EncoderUpdate:
        """``encoder_update`` by the name that it is saved under: SB3 treats names without "optim" as modules."""
        return self.encoder_update

    def _with_optimizer(self) -> dict[str, Any]:
        """Modules with an optimizer, by attribute path."""
        modules: dict[str, Any] = {"actor": self.actor, "critic": self.critic}
        modules |= {"policy.srl": self.srl, "policy.intrinsic": self.intrinsic}
        if self.curious is not None:
            modules |= {"policy.curious.actor": self.curious.actor, "policy.curious.critic": self.curious.critic}
        return {path: each for path, each in modules.items() if each is not None and each.optimizer is not None}

    def set_learning_rate(self, learning_rate: float, temperature_factor: float) -> None:
        """Set all learning rates; the temperatures' rate is a multiple of the others', so that zero freezes everything.

        :param learning_rate: Learning rate of everything except the temperatures
        :param temperature_factor: Learning rate of the temperatures, as a multiple of ``learning_rate``
        """
        self.encoder_update.learning_rate = learning_rate
        for module in self._with_optimizer().values():
            update_learning_rate(module.optimizer, learning_rate)
        for agent in self.agents.values():
            if agent.ent_coef_optimizer is not None:
                update_learning_rate(agent.ent_coef_optimizer, learning_rate * temperature_factor)

    def saved_names(self) -> tuple[list[str], list[str]]:
        """List what is saved of a model in addition to what the base class saves.

        :return: Attribute paths of objects with a state dict, and of tensors
        """
        paths = [f"{path}.optimizer" for path in self._with_optimizer() if path.startswith("policy.")]
        state_dicts, tensors = ["policy.encoder_optimizer", *paths], []
        if self.curious is not None and self.curious.log_ent_coef is None:
            tensors = ["policy.curious.ent_coef_tensor"]
        elif self.curious is not None:
            state_dicts, tensors = [*state_dicts, "policy.curious.ent_coef_optimizer"], ["policy.curious.log_ent_coef"]
        return state_dicts, tensors

    # ---------------------------------------------------------------- seeing

    def sense(self, observations: Any) -> Any:
        """Join a dictionary without images to one vector; other observations stay as they are.

        :param observations: As stored, [B, *shape], or a dictionary of these
        :return: As encoder, head and rewards get them
        """
        if self.sensed_space is self.observation_space or not isinstance(observations, dict):
            return observations
        return flatten_vectors(observations, self.observation_space)

    def prepare(self, observations: Any) -> Any:
        """Convert observations of the replay buffer to those of ``Samples``: vectors in float32, images in NHWC order.

        :param observations: As stored, [B, *shape], a dictionary of these, or None
        :return: As ``sense`` returns them; None stays None
        """
        return _prepared(self.sense(observations))

    def samples(self, sampled: Any, random: bool = True) -> Samples:
        """Convert a batch to the ``Samples`` that heads and rewards get.

        :param sampled: Batch of a replay buffer
        :param random: Whether the views are random ones, to learn from; else the centred ones, to measure
        :return: The batch with ``views``
        """
        fields = sampled._asdict()
        for name in ("observations", "next_observations"):
            fields[name] = self.prepare(fields[name])
        view = self.augmentation if random else self.augmentation.center
        return Samples(**{**fields, "views": _prepared(view(fields["observations"]))})

    def center(self, observations: Any) -> Any:
        """Make the view of observations that has no randomness, as when acting.

        :param observations: As stored, [B, *shape]
        :return: [B, *view shape]
        """
        return self.augmentation.center(self.sense(observations))

    def encode(self, observations: Any) -> th.Tensor:
        """Encode observations as the acting agent sees them.

        :param observations: As stored, [B, *shape]
        :return: Latents, [B, features_dim]
        """
        return self.encoder(self.center(observations))

    @property
    def architecture(self) -> dict[str, Any]:
        """Settings of encoder, head and intrinsic reward that shapes of tensors do not show, by name."""
        encoders: dict[str, Any] = getattr(self.encoder, "images", {"": self.encoder})
        tanh = {key: getattr(encoder.projection, "tanh", None) for key, encoder in encoders.items()}
        named = {name: self._arguments[f"{name}_class"] for name in ("srl", "intrinsic")}
        return {
            "observations": _kinds(self.observation_space),
            "views": _kinds(self.augmentation.view_space),
            "encoder": self.features_extractor_class.__name__,
            "activation": getattr(self.activation_fn, "__name__", repr(self.activation_fn)),
            "tanh": tanh if len(tanh) > 1 else next(iter(tanh.values())),
            **{name: None if each is None else each.__name__ for name, each in named.items()},
        }

    # ------------------------------------------------------------- measuring

    @property
    def measures_errors(self) -> bool:
        """Whether ``error`` can be computed: there is a head, or a reward that measures errors."""
        return self.srl is not None or (self.intrinsic is not None and self.intrinsic.measures)

    def error(self, batch: Samples) -> th.Tensor:
        """Compute the noise-free error by which policies are compared: the reward's if it has one, else the head's.

        :param batch: Samples whose ``views`` are the centred ones
        :return: [B]
        """
        latents = self.encode(batch.observations)
        if self.intrinsic is not None and self.intrinsic.measures:
            return self.intrinsic.error(batch.observations, latents)
        return self.srl.error(batch, latents)  # type: ignore[union-attr]

    def reconstruct(self, observations: Any) -> tuple[Any, Any] | None:
        """Draw observations from their latents, by the head or else by the intrinsic reward.

        :param observations: As stored, [B, *shape]
        :return: Targets and reconstructions (for dictionaries, images by key); None if neither of them reconstructs
        """
        observations = self.sense(observations)
        latents = self.encode(observations)
        for part, seen in ((self.srl, self.center(observations)), (self.intrinsic, observations)):
            drawn = None if part is None else part.reconstruct(latents)
            if isinstance(drawn, dict):
                return images_of(seen, self.sensed_space), drawn
            if drawn is not None:
                return seen, drawn
        return None

    # ---------------------------------------------------------------- acting

    def forward(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        """Choose actions.

        :param observation: [B, *shape]
        :param deterministic: Whether to return the mean action
        :return: Actions in [-1, 1], [B, action_dim]
        """
        return self._predict(observation, deterministic)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        check_images(observation, self.observation_space)
        actor = self.agents[self.default_agent].actor
        return actor(self.encoder.trunk(self.center(observation)), deterministic)

    @contextlib.contextmanager
    def acting(self, agent: str) -> Iterator[None]:
        """Let ``predict`` use the given agent within this context.

        :param agent: ``"task"`` or ``"curious"``
        """
        previous, self.default_agent = self.default_agent, agent
        try:
            yield
        finally:
            self.default_agent = previous

    def set_training_mode(self, mode: bool) -> None:
        """Switch layers that differ between training and evaluation; targets stay in evaluation mode.

        :param mode: Whether to train
        """
        set_mode(self, mode)
        targets = (self.encoder_target, *(agent.critic_target for agent in self.agents.values()))
        frozen = (self.encoder, self.srl) if self.representation_frozen else ()
        for still in filter(None, (*targets, *frozen)):
            set_mode(still, False)

    def freeze_representation(self, frozen: bool = True) -> None:
        """Keep encoder and head as they are; the target encoder becomes a copy, or it would go on moving.

        :param frozen: False: let them learn again
        """
        if frozen == self.representation_frozen:
            return
        self.representation_frozen = frozen
        self.encoder_update.metrics = {}
        if frozen:
            self._frozen_parameters = [each for each in self.encoder.parameters() if each.requires_grad]
            self.encoder_target.load_state_dict(self.encoder.state_dict())
        for parameter in self._frozen_parameters:
            parameter.requires_grad_(not frozen)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return dict(self._arguments)


class CnnPolicy(CuRePolicy):
    """``CuRePolicy`` for images."""


class MlpPolicy(CuRePolicy):
    """``CuRePolicy`` for vectors: the same but for the encoder's default class."""

    default_encoder = VectorEncoder


class MultiInputPolicy(CuRePolicy):
    """``CuRePolicy`` for dictionaries of images and vectors; a dictionary without images counts as one vector."""

    default_encoder = DictEncoder


def _kinds(space: spaces.Space) -> Any:
    """Kind and shape of an observation; for dictionaries, of each part in order."""
    if isinstance(space, spaces.Dict):
        return [f"{key}: {_kinds(part)}" for key, part in space.spaces.items()]
    return f"{'image' if is_image_space(space) else type(space).__name__} {space.shape}"


def _prepared(observations: Any) -> Any:
    """Images in NHWC memory order, vectors in float32; None stays None."""
    if observations is None:
        return None
    if isinstance(observations, dict):
        return {key: _prepared(part) for key, part in observations.items()}
    is_image = observations.dim() == 4
    return observations.contiguous(memory_format=th.channels_last) if is_image else observations.float()


@contextlib.contextmanager
def _forked_rng(seed: int) -> Iterator[None]:
    """Fork the RNG, so that heads and rewards do not change the other networks' initial weights."""
    with th.random.fork_rng(devices=()):
        th.default_generator.manual_seed(seed)
        yield
