"""CuReSAC: SAC from pixels with state representation learning (SRL) and a policy that is curious about it."""

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, partial
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Image, Logger, TensorBoardOutputFormat
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.type_aliases import (
    GymEnv,
    MaybeCallback,
    ReplayBufferSamples,
    RolloutReturn,
    Schedule,
    TrainFreq,
)
from stable_baselines3.common.utils import update_learning_rate
from stable_baselines3.common.vec_env import VecEnv, VecFrameStack, unwrap_vec_wrapper
from stable_baselines3.sac import policies as sb3_policies
from stable_baselines3.sac.sac import SAC
from torch.nn import functional as F

from sb3_cure.buffers import FrameStackReplayBuffer, skip_marked, why_not_skipping
from sb3_cure.checks import (
    check_arguments,
    check_construction,
    check_curious_agent,
    check_learning,
    check_parts,
    check_sb3s_images,
    check_shared_encoder_space,
    check_srl_error,
    check_srl_head,
    check_srl_output,
    explaining_memory,
    make_env,
)
from sb3_cure.guards import (
    BadTransitionError,
    Guard,
    TransitionGuard,
    check_actions,
    looking_before_steps,
    post_mortem_of_a_step,
    warn_of_dark_images,
)
from sb3_cure.metrics import Metrics, frame_stack_of, reconstruction_strip, told_frame_stack
from sb3_cure.mixers import CuriousMixer
from sb3_cure.overlap import OverlappedVecEnv
from sb3_cure.persistence import Persistence
from sb3_cure.policies import CnnPolicy, CuRePolicy, LatentCritic, MlpPolicy, TrunkActor
from sb3_cure.precision import autocast_context, resolve_compile, resolve_precision
from sb3_cure.srl import SRLHead, get_srl_class
from sb3_cure.values import is_integer

SelfCuReSAC = TypeVar("SelfCuReSAC", bound="CuReSAC")

#: Updates between two pictures of reconstructions in TensorBoard
RECONSTRUCTION_INTERVAL = 1000


@dataclass
class Agent:
    """One actor-critic with its temperature: the task agent, or the curious one.

    :param name: ``"task"`` or ``"curious"``; prefix or suffix of its metrics
    :param trains_encoder: Whether its critics' gradient reaches the shared encoder
    :param log_ent_coef: Logarithm of the learned temperature, or None if it is fixed
    :param ent_coef_optimizer: Its optimiser, or None
    :param ent_coef: Fixed temperature, or None if it is learned
    """

    name: str
    actor: TrunkActor
    critic: LatentCritic
    critic_target: LatentCritic
    trains_encoder: bool
    log_ent_coef: th.Tensor | None
    ent_coef_optimizer: th.optim.Optimizer | None
    ent_coef: th.Tensor | None

    def temperature(self) -> th.Tensor:
        """Temperature alpha, detached, shape [1] or []."""
        return self.ent_coef if self.log_ent_coef is None else self.log_ent_coef.detach().exp()  # type: ignore[return-value]


@dataclass
class EncoderPass:
    """One run of the shared encoder over a batch.

    :param latents: Latents of the observations, with their graph, [B, features_dim]
    :param for_actor: Computes what an actor's update reads, when it is due: trunk features of the observations,
        [B, trunk_dim], and their latents, [B, features_dim], both detached
    :param next_features: Trunk features of the next observations, detached, [B, trunk_dim]; computed by the first call
    """

    latents: th.Tensor
    for_actor: Callable[[], tuple[th.Tensor, th.Tensor]]
    next_features: Callable[[], th.Tensor]


class CuReSAC(Persistence, SAC):
    """Soft actor-critic from pixels, with SRL and a policy that seeks what the SRL does badly.

    Paper: "Seeking Visual Discomfort: Curiosity-driven Representations for Reinforcement Learning" (Aljalbout,
    Ulmer and Triebel), Algorithm 1. Defaults are its table of hyperparameters. Timesteps are *agent* steps, as
    everywhere in SB3: environment steps divided by the action repeat.

    With ``srl=None, curiosity=None`` this is SB3's SAC bit for bit: its policies, its choice of replay buffer and its
    update; ``encoder_tau``, ``update``, ``precision``, ``compile`` and ``actor_update_interval`` then do not apply.
    For an agent without SRL on the shared encoder add ``policy_kwargs=dict(share_encoder=True)``.

    A loss or gradient that is not finite changes no parameter: ``train`` raises a ``sb3_cure.guards.NonFiniteError``
    that names it (on a GPU when the log is written, or ``learn`` ends), with a post-mortem beside the logs. What was
    stepped before in the same update stays stepped. With everything off the update is SB3's own, whose optimisers look
    at the gradients before they step.

    :param policy: ``"CnnPolicy"`` for images, ``"MlpPolicy"`` for vectors, or a subclass of ``CuRePolicy``
    :param env: Environment, vectorised environment, or Gymnasium id
    :param learning_rate: Of everything but the temperatures; a number or a schedule of the remaining progress
    :param buffer_size: Transitions in the replay buffer
    :param learning_starts: Agent steps with uniformly random actions before learning
    :param batch_size: Transitions per update
    :param tau: Polyak rate of the target critics, once every ``target_update_interval`` updates
    :param gamma: Discount factor of the task
    :param train_freq: Agent steps per environment between two calls of ``train``
    :param gradient_steps: Updates per call; -1: as many as agent steps were made
    :param srl: ``"rae"`` (regularised autoencoder, as SAC-AE), ``"curl"`` (contrastive, as CURL), a subclass of
        ``SRLHead``, or None
    :param srl_kwargs: Arguments of the head
    :param srl_schedule: ``"simultaneous"``: SRL and RL in every update; ``"alternating"``: ``srl_period`` updates of
        SRL, then as many of RL, in turn
    :param srl_period: Updates per phase when alternating
    :param curiosity: ``"separate"``: a second actor-critic is rewarded with the SRL error; ``"bonus"``: the error is
        added to the task reward; ``"random"``: the second actor draws uniform actions (control); None: off
    :param curiosity_prob: p_c, probability with which the second actor acts, per environment and step; a number in
        [0, 1], or a schedule
    :param curiosity_beta: beta, factor of the curious reward
    :param curiosity_gamma: Discount factor of the curious agent; 0 needs ``curiosity_target="next_observation"``
    :param normalize_curiosity: Standardise the error by running statistics, clipped to +-5; False: the paper's letter
    :param curiosity_target: Whose SRL error rewards a transition: ``"observation"`` (free), or
        ``"next_observation"``, for which the head gets the batch with the next observations as its observations
    :param curiosity_encoder_grad: Whether the curious critics train the encoder (the paper: yes)
    :param task: False: a curious agent alone, which collects, acts and learns without task reward
    :param warmup_updates: Updates in one burst after ``learning_starts``; None: what the head wants (RAE: 1000), or 0
        where there is no warm-up
    :param actor_update_interval: Updates between two updates of actors and temperatures; when alternating, those of RL
    :param target_update_interval: Updates between two Polyak steps
    :param encoder_tau: Polyak rate of the target encoder
    :param update: ``"joint"`` (one encoder pass for all, see ``EncoderOptimizer``) or ``"sequential"`` (a pass and a
        step for each loss: Algorithm 1 to the letter)
    :param precision: ``"auto"``, ``"fp32"`` or ``"bf16"``; auto is bf16 where the hardware computes it natively
    :param compile: Whether updates run the networks through torch.compile: True (with a warning and eager where it does
        not work), False, or ``"auto"``: eager, as it does not pay on CPUs and was not measured on GPUs
    :param overlap: Update while worker processes (``SubprocVecEnv``) step and render the environments: the updates of
        one step are made during the next, so that actions come from a policy that is one step behind
    :param on_bad_transition: What to do when an environment returns a reward or an observation that is not finite:
        ``"raise"`` a ValueError, or ``"skip"``: never sample the transition, warn, and count it in
        ``rollout/bad_transitions``
    :param ent_coef: Temperature: ``"auto_<initial value>"``, ``"auto"`` or a fixed number; also the curious agent's
    :param ent_coef_lr_factor: Learning rate of the temperatures as a multiple of ``learning_rate``
    :param kwargs: The remaining arguments of ``stable_baselines3.SAC`` (``seed``, ``verbose``, ``policy_kwargs``, ...)
    :raises ValueError: for arguments that cannot work, in one sentence that says what to do
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": MlpPolicy,
        "CnnPolicy": CnnPolicy,
        "MultiInputPolicy": sb3_policies.MultiInputPolicy,
    }
    policy: CuRePolicy  # type: ignore[assignment]

    def __init__(
        self,
        policy: str | type[BasePolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 1e-3,
        buffer_size: int = 80_000,
        learning_starts: int = 1000,
        batch_size: int = 128,
        tau: float = 0.01,
        gamma: float = 0.99,
        train_freq: int | tuple[int, str] = 1,
        gradient_steps: int = -1,
        *,
        srl: str | type[SRLHead] | None = "rae",
        srl_kwargs: dict[str, Any] | None = None,
        srl_schedule: str = "simultaneous",
        srl_period: int = 100,
        curiosity: str | None = "separate",
        curiosity_prob: float | Schedule = 0.2,
        curiosity_beta: float = 1.0,
        curiosity_gamma: float = 0.99,
        normalize_curiosity: bool = True,
        curiosity_target: str = "observation",
        curiosity_encoder_grad: bool = True,
        task: bool = True,
        warmup_updates: int | None = None,
        actor_update_interval: int = 2,
        target_update_interval: int = 2,
        encoder_tau: float = 0.05,
        update: str = "joint",
        precision: str = "auto",
        compile: str | bool = "auto",
        overlap: bool = False,
        on_bad_transition: str = "raise",
        ent_coef: str | float = "auto_0.1",
        ent_coef_lr_factor: float = 0.1,
        _init_setup_model: bool = True,
        **kwargs: Any,
    ):
        env = make_env(env, kwargs.get("verbose", 0))
        check_construction(self, policy, env, kwargs)
        kwargs = _plain_arguments(kwargs)
        super().__init__(
            policy,  # type: ignore[arg-type]
            env,
            learning_rate,
            buffer_size,
            learning_starts,
            batch_size,
            tau,
            gamma,
            train_freq,
            gradient_steps,
            ent_coef=ent_coef,
            target_update_interval=target_update_interval,
            _init_setup_model=False,
            **kwargs,
        )
        self.srl = srl
        self.srl_kwargs = dict(srl_kwargs) if isinstance(srl_kwargs, Mapping) else srl_kwargs or {}
        self.srl_schedule = srl_schedule
        self.srl_period = srl_period
        self.curiosity = curiosity
        self.curiosity_prob = curiosity_prob
        self.curiosity_beta = curiosity_beta
        self.curiosity_gamma = curiosity_gamma
        self.normalize_curiosity = normalize_curiosity
        self.curiosity_target = curiosity_target
        self.curiosity_encoder_grad = curiosity_encoder_grad
        self.task = task
        self.warmup_updates = warmup_updates
        self.actor_update_interval = actor_update_interval
        self.encoder_tau = encoder_tau
        self.update = update
        self.precision = precision
        self.compile = compile
        self.overlap = overlap
        self.on_bad_transition = on_bad_transition
        self.ent_coef_lr_factor = ent_coef_lr_factor

        self.curious_log_ent_coef: th.Tensor | None = None
        self.curious_ent_coef_optimizer: th.optim.Optimizer | None = None
        self._mixer: CuriousMixer | None = None
        # Who collects while pretraining ("curious" or "random"); None otherwise.
        self._collector: str | None = None
        # Whether `learn` comes right after `pretrain`, and begins as without it
        self._is_pretrained = False
        self._warmed_up = False
        # While `learn` runs with overlap=True: the environments, which do updates as they step
        self._overlapped: OverlappedVecEnv | None = None
        if overlap is True and self.env is not None:
            OverlappedVecEnv(self.env)  # for its refusal, now rather than in `learn`
        if _init_setup_model:
            self._setup_model()

    # ---------------------------------------------------------------- set-up

    @property
    def is_plain_sac(self) -> bool:
        """Whether every extra is off, so that SB3's own SAC does the work."""
        return self.srl is None and self.curiosity is None and not self.policy_kwargs.get("share_encoder", False)

    def _setup_model(self) -> None:
        check_arguments(self)
        self._metrics = Metrics()
        self._guard = Guard(deferred=self.device.type != "cpu")
        self._transition_guard = TransitionGuard(skip=self.on_bad_transition == "skip")
        self._read_env_attributes()
        if self.is_plain_sac:
            self.policy_kwargs.pop("share_encoder", None)
            own = {CnnPolicy: sb3_policies.CnnPolicy, MlpPolicy: sb3_policies.MlpPolicy}
            self.policy_class = own.get(self.policy_class, self.policy_class)  # type: ignore[call-overload]
            check_parts(self)
            check_sb3s_images(self.policy_class, self.observation_space, self.policy_kwargs)
            with explaining_memory(self):
                super()._setup_model()
            return
        check_shared_encoder_space(self.observation_space, self.policy_class)
        self._choose_replay_buffer()
        check_parts(self)
        # The policy also needs to know what this algorithm's own arguments ask of it; `policy_kwargs` stays the user's.
        user_kwargs = self.policy_kwargs
        self.policy_kwargs = {**user_kwargs, **self._policy_blueprint()}
        try:
            with explaining_memory(self):
                super()._setup_model()
        finally:
            self.policy_kwargs = user_kwargs
        if self._mixer is None:
            self._mixer = CuriousMixer(self.curiosity_prob, self.seed)
        self._computed_precision = resolve_precision(self.precision, self.device)
        if self.verbose >= 1:
            print(f"Networks compute in {self._computed_precision} (precision={self.precision!r})")
        self._compiles, sentence = resolve_compile(self.compile, self.device)
        if self._compiles:
            self.policy.compile_networks()
        if self.verbose >= 1:
            print(sentence)
        if self.policy.srl is not None:
            check_srl_head(self.policy.srl)
        self.policy.encoder_optimizer.guard = self._guard
        self._setup_temperatures()

    def _policy_blueprint(self) -> dict[str, Any]:
        sources = {
            "srl": self.srl is not None,
            "task": self.task,
            "curious": self._has_curious_agent and self.curiosity_encoder_grad,
        }
        return dict(
            srl_class=None if self.srl is None else get_srl_class(self.srl),
            srl_kwargs=self.srl_kwargs,
            curious=self._has_curious_agent,
            curiosity_kwargs=dict(beta=self.curiosity_beta, normalize=self.normalize_curiosity),
            encoder_sources=tuple(name for name, trains in sources.items() if trains),
            update=self.update,
            acting="actor" if self.task else "curious_actor",
        )

    @property
    def _has_curious_agent(self) -> bool:
        return self.curiosity == "separate" or self._collector == "curious"

    @property
    def _uses_curious_reward(self) -> bool:
        return self.curiosity == "bonus" or self._has_curious_agent

    def _choose_replay_buffer(self) -> None:
        """Keep each frame once where the user or the environment says that observations are stacked frames."""
        # Of ``VecFrameStack`` those slide, whatever the environments in it stack.
        stacked = None if self.env is None else unwrap_vec_wrapper(self.env, VecFrameStack)
        if "frame_stack" in self.replay_buffer_kwargs:
            frame_stack = self.replay_buffer_kwargs["frame_stack"]
        else:
            frame_stack = self._told_frame_stack() if stacked is None else stacked.stacked_obs.n_stack
        if self.env is not None and frame_stack is None and "frames_dir" in self.replay_buffer_kwargs:
            raise ValueError(
                f"replay_buffer_kwargs got frames_dir={str(self.replay_buffer_kwargs['frames_dir'])!r}, but the "
                "environment does not tell its frame_stack, without which frames cannot be told apart: use "
                "make_dmc_env or make_pixel_env, or add frame_stack."
            )
        if self.replay_buffer_class is None and self.n_steps == 1 and frame_stack is not None:
            if self.observation_space.dtype == np.uint8 and len(self.observation_space.shape) == 3:  # type: ignore[arg-type]
                self.replay_buffer_class = FrameStackReplayBuffer
                self.replay_buffer_kwargs = {"frame_stack": frame_stack, **self.replay_buffer_kwargs}

    def _told_frame_stack(self) -> int | None:
        if self.env is None:
            return None
        told = told_frame_stack(self.env)
        meant = self._env_attribute("frame_stack")
        if told is None and is_integer(meant, 2) and is_image_space(self.observation_space):
            warnings.warn(
                f"the environment's frame_stack is {meant!r}, but observations of shape "
                f"{self.observation_space.shape} are not of so many frames: it is passed over, and the replay buffer "
                "keeps whole observations.",
                stacklevel=2,
            )
        return told

    def _read_env_attributes(self) -> None:
        """What logging needs to know; again before each ``learn``, as ``set_env`` may have changed it."""
        told = self._env_attribute("action_repeat")
        self._action_repeat = int(told) if is_integer(told, 1) else 1
        self._frame_stack = 1 if self.env is None else frame_stack_of(self.env)

    def _env_attribute(self, name: str) -> Any:
        """An attribute that the environments tell, or None."""
        if self.env is not None and self.env.has_attr(name):
            return self.env.get_attr(name)[0]
        return None

    def _setup_temperatures(self) -> None:
        """Two temperatures with the reference's optimiser: a tenth of the learning rate, beta1 = 0.5 (SAC-AE)."""
        if self.log_ent_coef is not None:
            self.ent_coef_optimizer = self._make_temperature_optimizer(self.log_ent_coef)
        if self._has_curious_agent:
            self._setup_curious_temperature()
        self._create_agents()

    def _setup_curious_temperature(self) -> None:
        if self.log_ent_coef is not None:
            # The same initial value; a fixed temperature serves both agents.
            initial = float(self.ent_coef.split("_")[1]) if "_" in str(self.ent_coef) else 1.0  # type: ignore[union-attr]
            log_ent_coef = th.full((1,), initial, device=self.device).log().requires_grad_(True)
            self.curious_log_ent_coef = log_ent_coef
            self.curious_ent_coef_optimizer = self._make_temperature_optimizer(log_ent_coef)

    def _make_temperature_optimizer(self, log_ent_coef: th.Tensor) -> th.optim.Adam:
        learning_rate = self.lr_schedule(1) * float(self.ent_coef_lr_factor)
        return th.optim.Adam([log_ent_coef], lr=learning_rate, betas=(0.5, 0.999), fused=True)

    def _create_agents(self) -> None:
        policy = self.policy
        fixed = None if self.log_ent_coef is not None else self.ent_coef_tensor
        self._task_agent = Agent(
            "task",
            policy.actor,
            policy.critic,
            policy.critic_target,
            True,
            self.log_ent_coef,
            self.ent_coef_optimizer,
            fixed,
        )
        self._curious_agent: Agent | None = None
        if self._has_curious_agent:
            self._curious_agent = Agent(
                "curious",
                policy.curious_actor,
                policy.curious_critic,
                policy.curious_critic_target,
                self.curiosity_encoder_grad,
                self.curious_log_ent_coef,
                self.curious_ent_coef_optimizer,
                fixed,
            )

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        total, callback = super()._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
        )
        # SB3 does so after each step: the first one would see where the former call ended.
        self._current_progress_remaining = 1 - self.num_timesteps / max(total, 1)
        self._metrics.attach(self.logger)
        self._read_env_attributes()
        self._check_skipping()
        return total, callback

    def _check_skipping(self) -> None:
        """Whether transitions can be left out, if that may be asked for in the middle of the training."""
        reason = why_not_skipping(self.replay_buffer)  # type: ignore[arg-type]
        self._transition_guard.can_skip = reason is None and self._vec_normalize_env is None
        if reason is not None and self.on_bad_transition == "skip":
            raise ValueError(f"on_bad_transition='skip' leaves transitions out of the replay buffer, {reason}")
        if reason is not None and getattr(self.env.unwrapped, "on_env_fault", None) == "restart":  # type: ignore[union-attr]
            warnings.warn(
                f"on_env_fault='restart' leaves transitions out of the replay buffer at the first fault, {reason}",
                stacklevel=2,
            )

    def set_logger(self, logger: Logger) -> None:
        """
        :param logger: SB3's logger
        """
        super().set_logger(logger)
        self._metrics.attach(logger)

    # ---------------------------------------------------------------- acting

    def predict_curious(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """What ``predict`` is to the task policy, to the curious one.

        :param observation: One observation or a batch, as for ``predict``
        :param state: Unused (SB3's signature)
        :param episode_start: Unused (SB3's signature)
        :param deterministic: Whether to return the mean action
        :return: Actions in the action space's bounds, and ``state``
        :raises ValueError: if there is no curious policy
        """
        if self.is_plain_sac or self.policy.curious_actor is None:
            raise ValueError(
                f"predict_curious was called with curiosity={self.curiosity!r}, but only curiosity='separate' trains a "
                "curious policy: use predict, or train with curiosity='separate'."
            )
        with self.policy.acting("curious_actor"):
            return self.policy.predict(observation, state, episode_start, deterministic)

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        self._check_first_observations()
        if self.is_plain_sac:
            executed, actions = super()._sample_action(learning_starts, action_noise, n_envs)
            self._check_actions(actions)
            return executed, actions
        # Noise is added below, once, whoever acts.
        _, actions = super()._sample_action(learning_starts, None, n_envs)
        if self.num_timesteps >= learning_starts:
            second = self._second_actor_acts(n_envs)
            if second.any():
                actions[second] = self._second_actor_actions(self._last_obs[second])  # type: ignore[index, call-overload]
        if action_noise is not None:
            actions = np.clip(actions + action_noise(), -1, 1)
        self._check_actions(actions)
        return self.policy.unscale_action(actions), actions

    def _check_actions(self, actions: np.ndarray) -> None:
        with post_mortem_of_a_step(self, observations=self._last_obs, actions=actions):
            check_actions(actions, self.num_timesteps)

    def _check_first_observations(self) -> None:
        """Observations that no transition has brought: those of a reset."""
        if self._last_obs is not None:
            original = None if self._vec_normalize_env is None else self._last_original_obs
            with post_mortem_of_a_step(self, observations=self._last_obs, original_observations=original):
                self._last_obs = self._transition_guard.admit_first(self._last_obs, original, self.num_timesteps)  # type: ignore[arg-type, assignment]

    def _second_actor_acts(self, n_envs: int) -> np.ndarray:
        """Boolean array [n_envs]: where the second (curious or random) actor acts in this step."""
        if self._collector is not None:
            return np.ones(n_envs, dtype=bool)
        if self.curiosity in ("separate", "random") and self.task:
            # `load` may have been given another probability than its mixer's, and users may change it while training.
            self._mixer.probability = self.curiosity_prob  # type: ignore[union-attr]
            return self._mixer.choose(n_envs, self._progress_remaining)  # type: ignore[union-attr]
        return np.zeros(n_envs, dtype=bool)

    def _second_actor_actions(self, observations: np.ndarray) -> np.ndarray:
        """Actions in [-1, 1], [n, action_dim]."""
        if (self._collector or self.curiosity) == "random":
            actions = np.array([self.action_space.sample() for _ in observations])
        else:
            actions, _ = self.predict_curious(observations)
        return self.policy.scale_action(actions)

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: np.ndarray,
        new_obs: np.ndarray | dict[str, np.ndarray],
        reward: np.ndarray,
        dones: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        seen: dict[str, Any] = {"observations": self._last_obs, "actions": buffer_action}
        seen |= {"next_observations": new_obs, "rewards": reward, "dones": dones}
        seen["terminal_observations"] = {str(i): info.get("terminal_observation") for i, info in enumerate(infos)}
        if self._vec_normalize_env is not None:
            # What is stored; clipped, it may look finite.
            original = self._vec_normalize_env.get_original_obs(), self._vec_normalize_env.get_original_reward()
            seen |= {"original_next_observations": original[0], "original_rewards": original[1]}
        try:
            with post_mortem_of_a_step(self, **seen):
                check_actions(buffer_action, self.num_timesteps)
                is_normalized = self._vec_normalize_env is not None
                if is_normalized:
                    self._transition_guard.admit(self._last_obs, *original, dones, infos, self.num_timesteps)  # type: ignore[arg-type]
                new_obs, reward, infos = self._transition_guard.admit(
                    self._last_obs,  # type: ignore[arg-type]
                    new_obs,
                    reward,
                    dones,
                    infos,
                    self.num_timesteps,
                    is_normalized,
                )
        except BadTransitionError:
            # The environments have gone on: another `learn` starts with a reset.
            self._last_obs = None
            raise
        skip_marked(replay_buffer, infos)
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)

    # -------------------------------------------------------------- learning

    def collect_rollouts(
        self,
        env: VecEnv,
        callback: BaseCallback,
        train_freq: TrainFreq,
        replay_buffer: ReplayBuffer,
        action_noise: ActionNoise | None = None,
        learning_starts: int = 0,
        log_interval: int | None = None,
    ) -> RolloutReturn:
        """SB3's loop, with the mixer of Algorithm 1 in ``_sample_action``, and the burst of updates after the warm-up.

        :param env: Training environments
        :param callback: Called at each step
        :param train_freq: How much to collect
        :param replay_buffer: Where to store it
        :param action_noise: Noise added to the actions
        :param learning_starts: Agent steps with uniformly random actions
        :param log_interval: Episodes between two dumps of the logger
        :return: What was collected
        """
        try:
            rollout = super().collect_rollouts(
                self._overlapped or env,
                callback,
                train_freq,
                replay_buffer,
                action_noise,
                learning_starts,
                log_interval,
            )
        except BaseException:
            if self._overlapped is not None:
                # The environments may have gone on without us: another `learn` starts with a reset.
                self._last_obs = None
            raise
        if not self._warmed_up and self.num_timesteps > learning_starts and rollout.continue_training:
            self._warmed_up = True
            warn_of_dark_images(self.observation_space, replay_buffer)
            updates = self.warmup_updates
            if updates is None:
                updates = 0 if self.srl is None or learning_starts == 0 else get_srl_class(self.srl).warmup_updates
            if updates > 0 and self.gradient_steps != 0:
                if self.verbose >= 1:
                    print(f"{updates} updates on the {self.num_timesteps} agent steps of the random warm-up")
                self.train(gradient_steps=updates, batch_size=self.batch_size)
        return rollout

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        """Sample, update, repeat (with ``overlap=True``, while ``learn`` runs: during the next step).

        :param gradient_steps: Number of updates
        :param batch_size: Transitions per update
        """
        if self._overlapped is not None and self.num_timesteps < self._total_timesteps:
            self._overlapped.defer(partial(self._train, gradient_steps, batch_size))
        else:
            self._train(gradient_steps, batch_size)

    def _train(self, gradient_steps: int, batch_size: int) -> None:
        if self.is_plain_sac:
            # SB3's update knows no guard: its optimisers look before they step.
            optimizers = {"actor": self.actor.optimizer, "critic": self.critic.optimizer}
            with looking_before_steps(self, {**optimizers, "temperature": self.ent_coef_optimizer}):
                super().train(gradient_steps, batch_size)
        else:
            self.policy.set_training_mode(True)
            self._update_learning_rates()
            for _ in range(gradient_steps):
                random_state = np.random.get_state(legacy=False)
                batch = self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)  # type: ignore[union-attr]
                with self._guard.update(self, batch, random_state):
                    self._gradient_step(batch)
                self._n_updates += 1
            self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        if self._overlapped is not None:
            # In the middle of a rollout.
            self.policy.set_training_mode(False)

    def _gradient_step(self, batch: ReplayBufferSamples) -> None:
        """One update, in the order of the paper's Algorithm 1: SRL, task agent, curious agent."""
        with th.no_grad(), self._autocast():
            observations = self.policy.augment(batch.observations)
            next_observations = self.policy.augment(batch.next_observations)
            next_latents = self.policy.encoder_target(next_observations)
        shared = self._encode(observations, next_observations) if self.update == "joint" else None
        # Sequential: a fresh pass for each source, because the one before has moved the encoder.
        encode = lambda: shared or self._encode(observations, next_observations)  # noqa: E731

        rewards = batch.rewards
        if self.policy.srl is not None:
            error = self._update_srl(self.policy.srl, batch, encode())
            if self._uses_curious_reward:
                curious_reward = self._curious_reward(error)
                if self.curiosity == "bonus":
                    rewards = rewards + curious_reward
        if self._in_rl_phase:
            if self.task and self._collector is None:
                self._update_actor_critic(self._task_agent, encode(), next_latents, batch, rewards)
            if self._curious_agent is not None and self._collector != "random":
                self._update_actor_critic(self._curious_agent, encode(), next_latents, batch, curious_reward)
        self.policy.encoder_optimizer.step()
        if self._n_updates % self.target_update_interval == 0:
            self._update_targets()
        self._record_metrics(batch)

    def _encode(self, observations: th.Tensor, next_observations: th.Tensor) -> EncoderPass:
        encoder = self.policy.encoder
        with self._autocast():
            features = encoder.trunk(observations)
            # In full precision, whatever the encoder ends with: losses and the optimiser work with these.
            latents = encoder.projection(features).float()
        self._log({"train/latent_variance": latents.detach().var(dim=0, correction=0).mean()})

        def for_actor() -> tuple[th.Tensor, th.Tensor]:
            if self.update == "joint":  # where the encoder moves when all else has moved
                return features.detach(), latents.detach()
            with th.no_grad(), self._autocast():
                moved = encoder.trunk(observations)
                return moved, encoder.projection(moved).float()

        @cache
        def next_features() -> th.Tensor:
            with th.no_grad(), self._autocast():
                return encoder.trunk(next_observations)

        return EncoderPass(latents, for_actor, next_features)

    def _update_srl(self, srl: SRLHead, batch: ReplayBufferSamples, encoded: EncoderPass) -> th.Tensor:
        """UpdateSRL of Algorithm 1: train head and encoder.

        :return: SRL error of the observations (or next observations) that the curious reward is about, [B]
        """
        trains = self._in_srl_phase
        # The loss stops at a copy of the latents; the encoder's optimiser takes the gradient from there.
        latents = encoded.latents.detach().requires_grad_(trains)
        with th.set_grad_enabled(trains), self._autocast():
            output = srl.loss(batch, latents)
        check_srl_output(srl, output, trains)
        # In full precision, whatever the head computes in.
        loss, error = output[0].float(), output[1].float()
        if trains:
            if srl.optimizer is not None:
                srl.optimizer.zero_grad()
            loss.backward()
            self._guard.check("SRL loss", loss, srl.optimizer)
            if latents.grad is not None:
                self.policy.encoder_optimizer.pull("srl", encoded.latents, latents.grad)
            if srl.optimizer is not None:
                self._guard.step(srl.optimizer)
        check_srl_error(error, len(batch.observations), look=self._n_updates == 0)
        self._log({"train/srl_loss": loss, "train/srl_error": error.mean()})
        if self.curiosity_target == "next_observation" and self._uses_curious_reward:
            with th.no_grad(), self._autocast():
                next_latents = self.policy.encoder.projection(encoded.next_features()).float()
                _, error = srl.loss(batch._replace(observations=batch.next_observations), next_latents)  # type: ignore[arg-type]
            error = error.float()
        return error

    def _curious_reward(self, error: th.Tensor) -> th.Tensor:
        """r_cure of this batch, [B, 1]: computed afresh, never stored, hence never stale."""
        self._guard.check("SRL error", error.square().mean())
        curiosity = self.policy.curiosity
        curiosity.beta, curiosity.normalize = self.curiosity_beta, self.normalize_curiosity
        curiosity.update(error)
        reward = curiosity(error)
        self._log(
            {
                "train/curious_reward_raw_mean": error.mean(),
                "train/curious_reward_raw_max": error.max(),
                "train/curious_reward_mean": reward.mean(),
                "train/curious_reward_max": reward.max(),
                "train/curious_reward_std": reward.std(correction=0),
            }
        )
        return reward

    def _update_actor_critic(
        self,
        agent: Agent,
        encoded: EncoderPass,
        next_latents: th.Tensor,
        batch: ReplayBufferSamples,
        rewards: th.Tensor,
    ) -> None:
        """UpdateTaskAC and UpdateCuriousAC of Algorithm 1: soft actor-critic on the latents.

        :param agent: Task or curious agent
        :param encoded: This agent's pass through the encoder
        :param next_latents: Latents of the next observations by the target encoder, [B, features_dim]
        :param batch: Samples of the replay buffer
        :param rewards: The agent's rewards, [B, 1]
        """
        # Read here, as users may change it between or during calls of `learn`.
        gamma = self.gamma if agent is self._task_agent else self.curiosity_gamma
        discounts = gamma if batch.discounts is None else batch.discounts
        with th.no_grad(), self._autocast():
            next_actions, next_log_prob = agent.actor.action_log_prob(encoded.next_features())
            next_q = th.cat(agent.critic_target(next_latents, next_actions), dim=1).amin(dim=1, keepdim=True)
        next_value = next_q - agent.temperature() * next_log_prob.unsqueeze(1)
        target = rewards + (1 - batch.dones) * discounts * next_value

        latents = encoded.latents.detach().requires_grad_(agent.trains_encoder)
        with self._autocast():
            q_values = agent.critic(latents, batch.actions)
        critic_loss = 0.5 * sum(F.mse_loss(q, target) for q in q_values)
        agent.critic.optimizer.zero_grad()
        critic_loss.backward()  # type: ignore[union-attr]
        self._guard.check(f"{agent.name} critic's loss", critic_loss, agent.critic.optimizer)  # type: ignore[arg-type]
        if agent.trains_encoder:
            self.policy.encoder_optimizer.pull(agent.name, encoded.latents, latents.grad)  # type: ignore[arg-type]
        self._guard.step(agent.critic.optimizer)
        prefix = self._prefix(agent)
        self._log({f"{prefix}critic_loss": critic_loss, f"{prefix}q_value": q_values[0].mean()})  # type: ignore[dict-item]
        if self._n_rl_updates % self.actor_update_interval == 0:
            self._update_actor(agent, *encoded.for_actor())

    def _update_actor(self, agent: Agent, features: th.Tensor, latents: th.Tensor) -> None:
        """SAC's policy improvement and temperature step; neither trains the encoder.

        :param agent: Task or curious agent
        :param features: Trunk features, detached, [B, trunk_dim]
        :param latents: Latents, detached, [B, features_dim]
        """
        temperature = agent.temperature()
        with self._autocast():
            actions, log_prob = agent.actor.action_log_prob(features)
            q_values = th.cat(agent.critic(latents, actions), dim=1).amin(dim=1)
        actor_loss = (temperature * log_prob - q_values).mean()
        agent.actor.optimizer.zero_grad()
        actor_loss.backward(inputs=list(agent.actor.parameters()))
        self._guard.check(f"{agent.name} actor's loss", actor_loss, agent.actor.optimizer)
        self._guard.step(agent.actor.optimizer)

        prefix = self._prefix(agent)
        self._log({f"{prefix}actor_loss": actor_loss, f"{prefix}ent_coef": temperature.squeeze()})
        if agent.log_ent_coef is not None and agent.ent_coef_optimizer is not None:
            ent_coef_loss = -(agent.log_ent_coef * (log_prob + self.target_entropy).detach()).mean()  # type: ignore[operator]
            agent.ent_coef_optimizer.zero_grad()
            ent_coef_loss.backward()
            self._guard.check(f"{agent.name} temperature's loss", ent_coef_loss, agent.ent_coef_optimizer)
            self._guard.step(agent.ent_coef_optimizer)
            self._log({f"{prefix}ent_coef_loss": ent_coef_loss})

    def _update_targets(self) -> None:
        """Polyak step of the target encoder and the target critics."""
        policy = self.policy
        _polyak(policy.encoder, policy.encoder_target, self._guard.rate(self.encoder_tau))
        for agent in (self._task_agent, self._curious_agent):
            if agent is not None:
                _polyak(agent.critic, agent.critic_target, self._guard.rate(self.tau))

    @property
    def _in_srl_phase(self) -> bool:
        only_srl = self._collector == "random"
        # Of torch's kind: NumPy's whole numbers compare to booleans of its own.
        return only_srl or self.srl_schedule == "simultaneous" or bool(self._n_updates // self.srl_period % 2 == 0)

    @property
    def _in_rl_phase(self) -> bool:
        return self.srl_schedule == "simultaneous" or not self._in_srl_phase

    @property
    def _n_rl_updates(self) -> int:
        """How many of the updates before this one, which is of RL, were of RL, too."""
        if self.srl_schedule == "simultaneous":
            return self._n_updates
        periods, position = divmod(self._n_updates, 2 * self.srl_period)
        return periods * self.srl_period + position - self.srl_period

    @property
    def _progress_remaining(self) -> float:
        """What schedules get: SB3's own goes below zero where the last rollout goes beyond ``total_timesteps``."""
        return max(self._current_progress_remaining, 0.0)

    def _autocast(self) -> th.autocast:
        return autocast_context(self._computed_precision, self.device)

    def _update_learning_rates(self) -> None:
        """One schedule for everything; the temperatures follow it at a fixed ratio, so that a zero freezes all."""
        policy = self.policy
        learning_rate = self.lr_schedule(self._progress_remaining)
        self.logger.record("train/learning_rate", learning_rate)
        policy.encoder_optimizer.set_learning_rate(learning_rate)
        owners = (policy.srl, policy.actor, policy.critic, policy.curious_actor, policy.curious_critic)
        for owner in owners:
            if owner is not None and owner.optimizer is not None:
                update_learning_rate(owner.optimizer, learning_rate)  # type: ignore[arg-type]
        for optimizer in (self.ent_coef_optimizer, self.curious_ent_coef_optimizer):
            if optimizer is not None:
                update_learning_rate(optimizer, learning_rate * float(self.ent_coef_lr_factor))

    def learn(
        self: SelfCuReSAC,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "CuReSAC",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfCuReSAC:
        """
        :param total_timesteps: Agent steps to train for (environment steps / action repeat), all environments together
        :param callback: SB3 callback(s)
        :param log_interval: Episodes between two dumps of the logger
        :param tb_log_name: Name of the run in TensorBoard
        :param reset_num_timesteps: Whether to start counting anew
        :param progress_bar: Show a progress bar (needs tqdm and rich)
        :return: self
        """
        check_learning(self, total_timesteps, callback, log_interval)
        if self._run.skips("learn"):
            return self
        # A checkpoint taken while pretraining may have been loaded.
        self._end_pretraining()
        if self._is_pretrained:
            self._restart_random_streams()
        self._learn(
            "learn", int(total_timesteps), callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar
        )
        return self

    def _learn(self, call: str, *arguments: Any) -> None:
        """SB3's ``learn``, with environments that overlap with the updates if they are to."""
        if self.overlap and self.env is not None:
            self._overlapped = OverlappedVecEnv(self.env)
        self._call_name = call
        try:
            super().learn(*arguments)
            self._guard.report(self)
        finally:
            self._overlapped = None
            del self._call_name

    def pretrain(
        self: SelfCuReSAC,
        total_timesteps: int,
        collector: str = "curious",
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "pretrain",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfCuReSAC:
        """Pretrain the representation without task reward (paper, "Effect of Pretraining").

        Trains no task networks. Keeps encoder, target encoder, head and their optimisers (and the curious agent, if
        curiosity is on), empties the replay buffer and starts counting anew: the ``learn`` that follows is vanilla
        unless curiosity is on. Of a model with a seed it also begins with the environments and random numbers that it
        would begin with without pretraining, so that both have the same random warm-up (but for what ``VecNormalize``
        has seen). So pretraining with ``"random"`` begins with the same actions as that warm-up.

        :param total_timesteps: Agent steps
        :param collector: Who collects: ``"curious"``, a policy trained by the SRL error alone (built for the purpose
            if curiosity is off), or ``"random"``, uniform actions
        :param callback: SB3 callback(s)
        :param log_interval: Episodes between two dumps of the logger
        :param tb_log_name: Name of the run in TensorBoard
        :param reset_num_timesteps: False: go on with the pretraining in which a loaded checkpoint was taken
        :param progress_bar: Show a progress bar (needs tqdm and rich)
        :return: self
        :raises ValueError: if there is no SRL head, or the collector is unknown or has nothing to learn from
        """
        if self.srl is None:
            raise ValueError(
                "pretrain was called with srl=None, but it trains the representation alone: choose srl='rae', "
                "srl='curl' or a head of your own."
            )
        if collector not in ("curious", "random"):
            raise ValueError(
                f"pretrain got collector={collector!r}, but data are collected by 'curious' or 'random': choose one."
            )
        if collector == "curious":
            check_curious_agent(self)
        check_learning(self, total_timesteps, callback, log_interval)
        if self._run.skips("pretrain"):
            return self
        if self._run.resumed is not None and self._collector != collector:
            raise ValueError(
                f"pretrain got collector={collector!r}, but the resumed checkpoint was taken with {self._collector!r}: "
                "make the calls of the interrupted training, or load the checkpoint's model.zip to begin another."
            )
        self._collector = collector
        if self._has_curious_agent and self.policy.curious_actor is None:
            self.policy.add_curious_agent()
            self.policy.to(self.device)
            if self._compiles:
                self.policy.compile_networks()
            if self.curiosity_encoder_grad:
                self.policy.encoder_optimizer.add_source("curious")
            self._setup_curious_temperature()
        self._create_agents()
        try:
            self._learn(
                "pretrain", int(total_timesteps), callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar
            )
        finally:
            self._end_pretraining()
        return self

    def _end_pretraining(self) -> None:
        if self._collector is None:
            return
        self._collector = self._run.resumed = None
        if not self._has_curious_agent and self.policy.curious_actor is not None:
            self.policy.remove_curious_agent()
            if self.curiosity_encoder_grad:
                self.policy.encoder_optimizer.remove_source("curious")
            self.curious_log_ent_coef = self.curious_ent_coef_optimizer = None
        self._create_agents()
        self.replay_buffer.reset()  # type: ignore[union-attr]
        self.num_timesteps = self._n_updates = 0
        self._warmed_up = False
        self._last_obs = None
        self._is_pretrained = True

    def _restart_random_streams(self) -> None:
        """All of them are to be where they are when a model of this seed has been made."""
        self._is_pretrained = False
        if self.seed is not None:
            self.set_random_seed(self.seed)
            self._mixer = CuriousMixer(self.curiosity_prob, self.seed)
            # Draws the initial weights once more; nothing else of it is needed.
            arguments = {**self.policy_kwargs, **self._policy_blueprint()}
            self.policy_class(self.observation_space, self.action_space, self.lr_schedule, **arguments)

    # --------------------------------------------------------------- logging

    @staticmethod
    def _prefix(agent: Agent) -> str:
        """SB3's names for the task agent; the curious one's are marked."""
        return "train/" if agent.name == "task" else f"train/{agent.name}_"

    def _log(self, values: dict[str, th.Tensor]) -> None:
        self._metrics.record(self.logger, values)

    def _record_metrics(self, batch: ReplayBufferSamples) -> None:
        optimizer = self.policy.encoder_optimizer
        self._log({f"train/latent_grad_norm_{name}": norm for name, norm in optimizer.gradient_norms.items()})
        self._log({f"train/encoder_share_{name}": share for name, share in optimizer.shares.items()})
        if self._n_updates % RECONSTRUCTION_INTERVAL == 0:
            self._log_reconstructions(batch)

    def _log_reconstructions(self, batch: ReplayBufferSamples) -> None:
        writes_images = any(isinstance(output, TensorBoardOutputFormat) for output in self.logger.output_formats)
        strip = reconstruction_strip(self.policy, batch, self._frame_stack) if writes_images else None
        if strip is not None:
            self.logger.record("srl/reconstructions", Image(strip, "CHW"), exclude=("stdout", "log", "json", "csv"))

    def set_env(self, env: GymEnv | str, force_reset: bool = True) -> None:
        """
        :param env: Environment, vectorised environment or Gymnasium id; spaces and number of environments stay the same
        :param force_reset: Whether the next ``learn`` resets it first
        :raises ValueError: if it is nothing of these, or has other spaces
        """
        super().set_env(make_env(env, self.verbose, required=True), force_reset)

    def set_random_seed(self, seed: int | None = None) -> None:
        """
        :param seed: Of all random streams, that of p_c among them; None changes nothing
        """
        super().set_random_seed(seed)
        # A model that is being set up makes the mixer itself, or has loaded one.
        if seed is not None and self._mixer is not None and getattr(self, "policy", None) is not None:
            self._mixer.rng = np.random.default_rng(seed)

    def _update_info_buffer(self, infos: list[dict[str, Any]], dones: np.ndarray | None = None) -> None:
        """Without episodes whose return is not finite, of which ``on_bad_transition="skip"`` leaves transitions out:
        one would make the mean of the next 99 so, too."""
        if self.on_bad_transition == "skip":
            infos = [
                info
                if np.isfinite((info.get("episode") or {}).get("r", 0))
                else {key: value for key, value in info.items() if key != "episode"}
                for info in infos
            ]
        super()._update_info_buffer(infos, dones)

    def dump_logs(self) -> None:
        """Write the logs: SB3's, and environment steps beside agent steps."""
        self.logger.record("time/environment_steps", self.num_timesteps * self._action_repeat)
        if self._mixer is not None and self._mixer.n_steps > 0:
            self.logger.record("rollout/curious_share", self._mixer.pop_share())
        if self._transition_guard.n_bad > 0:
            self.logger.record("rollout/bad_transitions", self._transition_guard.n_bad)
        super().dump_logs()
        self._guard.report(self)

    # ---------------------------------------------------------------- saving

    def _stateful_parts(self) -> dict[str, Any]:
        parts: dict[str, Any] = {
            "mixer": self._mixer,
            "metrics": self._metrics,
            "transition_guard": self._transition_guard,
        }
        if not self.is_plain_sac:
            parts["encoder_shares"] = _EncoderShares(self.policy)
        return {name: part for name, part in parts.items() if part is not None}

    def _before_checkpoint(self) -> None:
        if self._overlapped is not None:
            self._overlapped.finish()
        self._guard.report(self)  # nothing that is not finite is kept

    def _excluded_save_params(self) -> list[str]:
        own = "_mixer _metrics _guard _transition_guard _task_agent _curious_agent _overlapped _is_pretrained"
        derived = "ent_coef_tensor batch_norm_stats batch_norm_stats_target _computed_precision _compiles"
        return [*super()._excluded_save_params(), *own.split(), *derived.split()]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        state_dicts, variables = super()._get_torch_save_params()
        if self.is_plain_sac:
            return state_dicts, variables
        state_dicts = [*state_dicts, "policy.encoder_optimizer"]
        if self.policy.srl is not None and self.policy.srl.optimizer is not None:
            state_dicts.append("policy.srl.optimizer")
        if self.policy.curious_actor is not None:
            state_dicts += ["policy.curious_actor.optimizer", "policy.curious_critic.optimizer"]
            if self.curious_ent_coef_optimizer is not None:
                state_dicts.append("curious_ent_coef_optimizer")
                variables = [*variables, "curious_log_ent_coef"]
        return state_dicts, variables


class _EncoderShares:
    """Shares of the encoder's sources as a part of a checkpoint: measured now and then, logged every time."""

    def __init__(self, policy: CuRePolicy):
        self.optimizer = policy.encoder_optimizer

    def state_dict(self) -> dict[str, th.Tensor]:
        return dict(self.optimizer.shares)

    def load_state_dict(self, state: dict[str, th.Tensor]) -> None:
        self.optimizer.shares = dict(state)


@th.no_grad()
def _polyak(source: th.nn.Module, target: th.nn.Module, tau: float | th.Tensor) -> None:
    """target <- target + tau (source - target), exactly unchanged where they are equal, or tau is 0; buffers copied."""
    parameters: list[th.Tensor] = list(target.parameters())
    goals: list[th.Tensor] = list(source.parameters())
    if isinstance(tau, th.Tensor):
        th._foreach_lerp_(parameters, goals, [tau] * len(parameters))
    else:
        th._foreach_lerp_(parameters, goals, tau)
    for buffer, target_buffer in zip(source.buffers(), target.buffers(), strict=True):
        target_buffer.copy_(buffer)


def _plain_arguments(arguments: dict[str, Any]) -> dict[str, Any]:
    """Arguments as SB3 takes them; of dictionaries copies, as SB3 writes into one."""
    plain = dict(arguments)
    for name, value in arguments.items():
        if isinstance(value, Mapping) and name.endswith("_kwargs"):
            plain[name] = dict(value)
            if isinstance(value.get("net_arch"), tuple):
                plain[name]["net_arch"] = list(value["net_arch"])
        elif isinstance(value, bool | np.integer) and name in ("verbose", "seed", "stats_window_size"):
            plain[name] = int(value)
    return plain
