"""CuRe: curiosity-driven representations for an off-policy actor-critic (Algorithm 1 of the paper).

Reads beside SB3's ``sac.py``: ``collect_rollouts`` mixes who acts, ``train`` samples and calls ``_gradient_step``, in
which each update of Algorithm 1 is a method. What differs between SAC and TQC is in ``critics.py``; how losses step the
encoder they share, in ``encoder_update.py``.
"""

import warnings
from functools import partial
from typing import Any, ClassVar

import numpy as np
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, RolloutReturn, Schedule

from sb3_cure.cure.arguments import check_arguments
from sb3_cure.cure.crash_report import Guard, crash_report
from sb3_cure.cure.critics import TwinQ
from sb3_cure.cure.metrics import Metrics
from sb3_cure.cure.mixers import CuriousMixer
from sb3_cure.cure.policies import ActorCritic, CuRePolicy
from sb3_cure.data.buffers import FrameStackReplayBuffer, infer_frame_stack, transitions
from sb3_cure.data.observations import rows_of
from sb3_cure.data.samples import Samples
from sb3_cure.intrinsic import IntrinsicReward, get_intrinsic_class
from sb3_cure.networks.augmentations import Augmentation
from sb3_cure.networks.precision import resolve_compile, resolve_precision
from sb3_cure.srl import SRLHead, get_srl_class

#: Latents with their graph, and the copy of them that a loss reads: its gradient stops there
Read = tuple[th.Tensor, th.Tensor]


class CuRe(OffPolicyAlgorithm):
    """Adds to an SB3 off-policy actor-critic a shared encoder, an SRL head, a curious actor-critic and their mixer.

    Paper: "Seeking Visual Discomfort: Curiosity-driven Representations for Reinforcement Learning" (Aljalbout,
    Ulmer and Triebel), Algorithm 1. Defaults are its table of hyperparameters. Timesteps are *agent* steps, as
    everywhere in SB3: environment steps divided by the action repeat.

    With ``srl=None, curiosity=None``, no augmentation and no ``policy_kwargs=dict(share_encoder=True)`` everything is
    off: policies, replay buffer and ``train`` are the base class's, bit for bit.

    :param policy: ``"CnnPolicy"`` for images, ``"MlpPolicy"`` for vectors, ``"MultiInputPolicy"`` for dictionaries of
        both, or a subclass of ``CuRePolicy``
    :param env: Environment, vectorised environment, or Gymnasium id
    :param learning_rate: Of everything but the temperatures; a number or a schedule of the remaining progress
    :param buffer_size: Transitions in the replay buffer
    :param learning_starts: Agent steps with uniformly random actions before learning
    :param batch_size: Transitions per update
    :param tau: Polyak rate of the target critics, once every ``target_update_interval`` updates
    :param gamma: Discount factor of the task
    :param train_freq: Agent steps per environment between two calls of ``train``
    :param gradient_steps: Updates per call; -1: as many as agent steps were made
    :param srl: ``"rae"`` (regularised autoencoder, as SAC-AE), ``"curl"`` (contrastive, as CURL), ``"vae"``, ``"spr"``,
        ``"forward"``, ``"inverse"`` (see ``sb3_cure.srl``), a subclass of ``SRLHead``, or None
    :param srl_kwargs: Arguments of the head
    :param srl_schedule: ``"simultaneous"``: SRL and RL in every update; ``"alternating"``: phases of ``srl_period``
        gradient steps, two updates in each, in turn: after whole periods both were updated as often as simultaneously
    :param srl_period: Gradient steps per phase when alternating
    :param intrinsic: What the curious agent is rewarded for: ``"srl_error"`` (the paper), ``"reconstruction"`` (what
        the latents do not hold of the image, for any head), ``"rnd"``, ``"icm"``, ``"impact"``, ``"disagreement"``,
        ``"particle"``, ``"shuffled"`` (another one without its information, as a control), or a subclass of
        ``IntrinsicReward``
    :param intrinsic_kwargs: Arguments of the reward
    :param curiosity: ``"separate"``: a second actor-critic gets the intrinsic reward; ``"bonus"``: it is added to the
        task's; ``"random"``: the second actor draws a uniform action for each bout (control); None: off
    :param curiosity_prob: p_c, probability with which the second actor acts; a number in [0, 1], or a schedule
    :param curiosity_bout: L: who acts is redrawn with probability 1/L per step, and at resets. 1: the paper's coin;
        ``"episode"``: at resets only
    :param curiosity_beta: beta, factor of the intrinsic reward
    :param curiosity_gamma: Discount factor of the curious agent; 0 needs ``curiosity_target="next_observation"``
    :param curiosity_ent_coef: Temperature of the curious agent, as ``ent_coef``; None: like ``ent_coef``
    :param curiosity_episodic: Whether the curious return ends where the episode terminates. By default it goes on: a
        reward of mean zero would otherwise make dying attractive wherever the error is low
    :param normalize_curiosity: Standardise the reward (see ``RewardScale``); False: the paper's letter
    :param curiosity_target: Whose SRL error rewards a transition: ``"observation"`` (free) or ``"next_observation"``
    :param curiosity_encoder_grad: Whether the curious critics train the encoder (the paper: yes)
    :param task: False: a curious agent alone, which collects, acts and learns without task reward
    :param augmentation: What the encoder sees: ``"shift"``, ``"crop"``, None, or ``"auto"``: what the head asks for
    :param augmentation_kwargs: Arguments of the augmentation (``pad`` of shifts, ``size`` of crops; pixels)
    :param warmup_updates: Updates in one burst after ``learning_starts``; None: what the head wants (RAE: 1000), or 0
        where there is no warm-up. In each of them actors, temperatures and targets are updated, as in SAC-AE's code
    :param actor_update_interval: Updates of critics between two of actors and temperatures
    :param target_update_interval: Updates between two Polyak steps
    :param encoder_tau: Polyak rate of the target encoder
    :param update: ``"joint"`` (one encoder pass for all) or ``"sequential"`` (a pass and a step for each loss:
        Algorithm 1 to the letter), see ``EncoderUpdate``
    :param precision: ``"auto"``, ``"fp32"`` or ``"bf16"``; auto is bf16 for images where the hardware computes it
    :param compile: Whether updates run the networks through torch.compile: True (with a warning and eager where it does
        not work), False, or ``"auto"``: eager, as it does not pay on CPUs and was not measured on GPUs
    :param overlap: Update while worker processes (``SubprocVecEnv``) step and render the environments: actions then
        come from a policy that is one step behind
    :param on_bad_transition: What to do when an environment returns a reward or an observation that is not finite:
        ``"raise"`` a ValueError, or ``"skip"``: never sample the transition, and warn
    :param ent_coef: Temperature: ``"auto_<initial value>"``, ``"auto"`` or a fixed number
    :param ent_coef_lr_factor: Learning rate of the temperatures as a multiple of ``learning_rate``
    :param kwargs: The remaining arguments of the base class (``seed``, ``verbose``, ``policy_kwargs``, ...)
    :raises ValueError: for arguments that cannot work, in one sentence
    """

    #: Critics of the base class
    critics: ClassVar[type[TwinQ]]
    #: The base class's own policies, for when everything is off
    plain_policies: ClassVar[dict[type[BasePolicy], type[BasePolicy]]]
    policy: CuRePolicy
    log_ent_coef: th.Tensor | None
    ent_coef: str | float
    ent_coef_tensor: th.Tensor
    ent_coef_optimizer: th.optim.Optimizer | None
    target_entropy: float
    target_update_interval: int

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
        intrinsic: str | type[IntrinsicReward] = "srl_error",
        intrinsic_kwargs: dict[str, Any] | None = None,
        curiosity: str | None = "separate",
        curiosity_prob: float | Schedule = 0.2,
        curiosity_bout: float | str = 1,
        curiosity_beta: float = 1.0,
        curiosity_gamma: float = 0.99,
        curiosity_ent_coef: str | float | None = None,
        curiosity_episodic: bool = False,
        normalize_curiosity: bool = True,
        curiosity_target: str = "observation",
        curiosity_encoder_grad: bool = True,
        task: bool = True,
        augmentation: str | None = "auto",
        augmentation_kwargs: dict[str, Any] | None = None,
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
        for name in ("policy_kwargs", "replay_buffer_kwargs"):  # SB3 writes into them
            kwargs[name] = dict(kwargs.get(name) or {})
        super().__init__(  # type: ignore[call-arg]
            policy,
            env,
            learning_rate,
            buffer_size,
            learning_starts,
            batch_size,
            tau,
            gamma,
            train_freq,  # type: ignore[arg-type]
            gradient_steps,
            ent_coef=ent_coef,
            target_update_interval=target_update_interval,
            _init_setup_model=False,
            **kwargs,
        )
        self.srl = srl
        self.srl_kwargs = srl_kwargs or {}
        self.srl_schedule = srl_schedule
        self.srl_period = srl_period
        self.intrinsic = intrinsic
        self.intrinsic_kwargs = intrinsic_kwargs or {}
        self.curiosity = curiosity
        self.curiosity_prob = curiosity_prob
        self.curiosity_bout = curiosity_bout
        self.curiosity_beta = curiosity_beta
        self.curiosity_gamma = curiosity_gamma
        self.curiosity_ent_coef = curiosity_ent_coef
        self.curiosity_episodic = curiosity_episodic
        self.normalize_curiosity = normalize_curiosity
        self.curiosity_target = curiosity_target
        self.curiosity_encoder_grad = curiosity_encoder_grad
        self.task = task
        self.augmentation = augmentation
        self.augmentation_kwargs = augmentation_kwargs or {}
        self.warmup_updates = warmup_updates
        self.actor_update_interval = actor_update_interval
        self.encoder_tau = encoder_tau
        self.update = update
        self.precision = precision
        self.compile = compile
        self.overlap = overlap
        self.on_bad_transition = on_bad_transition
        self.ent_coef_lr_factor = ent_coef_lr_factor
        # Batches learned from, and those of them that trained actors and critics (`_n_updates` counts gradient steps)
        self._n_batches = self._n_rl_batches = 0
        self._warmed_up = self._in_burst = False
        if _init_setup_model:
            self._setup_model()

    # ---------------------------------------------------------------- set-up

    @property
    def everything_off(self) -> bool:
        """Whether the base class does the work."""
        augments = self.augmentation not in (None, "auto")
        shares = self.policy_kwargs.get("share_encoder", False)
        return self.srl is None and self.curiosity is None and not (augments or shares)

    @property
    def _has_curious_agent(self) -> bool:
        return self.curiosity == "separate"

    def _setup_model(self) -> None:
        check_arguments(self)
        self._metrics, self._guard = Metrics(), Guard(deferred=self.device.type != "cpu")
        self._mixer = CuriousMixer(self.seed)
        if self.replay_buffer_class is None and not self.everything_off:
            self.replay_buffer_class = FrameStackReplayBuffer
            self.replay_buffer_kwargs = {"frame_stack": infer_frame_stack(self.env), **self.replay_buffer_kwargs}
        if self.everything_off:
            self.policy_kwargs.pop("share_encoder", None)
            self.policy_class = self.plain_policies.get(self.policy_class, self.policy_class)
            super()._setup_model()
            return
        user_kwargs = self.policy_kwargs
        self.policy_kwargs = {**user_kwargs, **self._policy_choices()}
        with warnings.catch_warnings():
            if issubclass(self.replay_buffer_class or object, FrameStackReplayBuffer):  # type: ignore[arg-type]
                warnings.filterwarnings("ignore", "`n_steps=")  # which SB3 takes for ignored
            super()._setup_model()
        self.policy_kwargs = user_kwargs
        self._critics = self.critics(self)
        self._computed_precision = resolve_precision(self.precision, self.device, self.observation_space)
        enabled = self._computed_precision == "bf16"
        self.policy.encoder_update.autocast = partial(th.autocast, self.device.type, th.bfloat16, enabled=enabled)
        self._compiles, sentence = resolve_compile(self.compile, self.device)
        if self._compiles:
            self.policy.compile_networks()
        if self.verbose >= 1:
            print(f"Networks compute in {self._computed_precision} (precision={self.precision!r}). {sentence}")
        self._setup_temperatures()

    def _policy_choices(self) -> dict[str, Any]:
        """What this algorithm's own arguments ask of the policy."""
        intrinsic = get_intrinsic_class(self.intrinsic) if self.curiosity in ("separate", "bonus") else None
        declared = IntrinsicReward if intrinsic is None else intrinsic.configured(**self.intrinsic_kwargs)
        frame_stack = self.replay_buffer_kwargs.get("frame_stack", 1)
        told = {"frame_stack": frame_stack, "curiosity_target": self.curiosity_target}
        sources = {
            "srl": self.srl is not None,
            "intrinsic": declared.trains_encoder,
            "task": self.task,
            "curious": self._has_curious_agent and self.curiosity_encoder_grad,
        }
        return dict(
            srl_class=None if self.srl is None else get_srl_class(self.srl),
            srl_kwargs=self.srl_kwargs,
            augmentation=self.augmentation,
            augmentation_kwargs=self.augmentation_kwargs,
            intrinsic_class=intrinsic,
            intrinsic_kwargs={**{name: told[name] for name in declared.asks}, **self.intrinsic_kwargs},
            curious=self._has_curious_agent,
            encoder_sources=tuple(name for name, trains in sources.items() if trains),
            update=self.update,
            default_agent="task" if self.task or not self._has_curious_agent else "curious",
        )

    def _setup_temperatures(self) -> None:
        """The task's agent takes SB3's own; the curious one gets another."""
        if self.log_ent_coef is not None:
            self.policy.task.adopt_temperature(self.log_ent_coef, self.lr_schedule(1) * self.ent_coef_lr_factor)
            self.ent_coef_optimizer = self.policy.task.ent_coef_optimizer
        else:
            self.policy.task.ent_coef_tensor = self.ent_coef_tensor
        self._setup_curious_temperature()

    def _setup_curious_temperature(self) -> None:
        if self.policy.curious is not None:
            ent_coef = self.ent_coef if self.curiosity_ent_coef is None else self.curiosity_ent_coef
            lr = self.lr_schedule(1) * self.ent_coef_lr_factor
            self.policy.curious.set_temperature(ent_coef, lr, self.device)

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        *args: Any,
        **kwargs: Any,
    ) -> tuple[int, BaseCallback]:
        resets = reset_num_timesteps or self._last_obs is None
        total, callback = super()._setup_learn(total_timesteps, callback, reset_num_timesteps, *args, **kwargs)
        # SB3 does so after each step: the first one would see where the former call ended.
        self._current_progress_remaining = 1 - self.num_timesteps / max(total, 1)
        self._metrics.attach(self.logger)
        if resets:
            self._mixer.starts = np.ones(self.n_envs, dtype=bool)
        return total, callback

    def set_logger(self, logger: Logger) -> None:
        """
        :param logger: SB3's logger
        """
        super().set_logger(logger)
        self._metrics.attach(logger)

    def set_random_seed(self, seed: int | None = None) -> None:
        """
        :param seed: Of all random streams, the mixer's among them; None changes nothing
        """
        super().set_random_seed(seed)
        if seed is not None:
            self._mixer.rng = np.random.default_rng(seed)

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
        if getattr(self.policy, "curious", None) is None:
            raise ValueError(f"only curiosity='separate' trains a curious policy, but curiosity is {self.curiosity!r}.")
        with self.policy.acting("curious"):
            return self.policy.predict(observation, state, episode_start, deterministic)

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        """Lines 2 to 6 of Algorithm 1: the curious actor acts with probability p_c, else the task's."""
        if self.everything_off:
            return super()._sample_action(learning_starts, action_noise, n_envs)
        # Noise is added below, once, whoever acts.
        _, actions = super()._sample_action(learning_starts, None, n_envs)
        if self.num_timesteps >= learning_starts:
            second = self._second_actor_acts(n_envs)
            if second.any():
                actions[second] = self._second_actor_actions(second)
        if action_noise is not None:
            actions = np.clip(actions + action_noise(), -1, 1)
        return self.policy.unscale_action(actions), actions

    def _second_actor_acts(self, n_envs: int) -> np.ndarray:
        """Where the curious (or, as a control, a random) actor acts in this step, bool [n_envs]."""
        if self.curiosity not in ("separate", "random"):
            return np.zeros(n_envs, dtype=bool)
        if not self.task:  # the policy itself is the curious one
            return np.full(n_envs, self.curiosity == "random")
        return self._mixer.choose(n_envs, self.curiosity_prob, self.curiosity_bout, self._progress_remaining)

    def _second_actor_actions(self, where: np.ndarray) -> np.ndarray:
        """Actions in [-1, 1] in the environments where it acts, [n, action_dim]."""
        if self.curiosity == "random" and self.task:
            actions = self._mixer.hold(self.action_space.sample)
        elif self.curiosity == "random":
            actions = np.array([self.action_space.sample() for _ in np.flatnonzero(where)])
        else:
            actions, _ = self.predict_curious(rows_of(self._last_obs, where))
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
        self._mixer.starts = np.array(dones, dtype=bool)
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)

    # -------------------------------------------------------------- learning

    def collect_rollouts(self, *args: Any, **kwargs: Any) -> RolloutReturn:
        """SB3's loop, with the mixer of Algorithm 1 in ``_sample_action``, and the burst of updates after the warm-up.

        :return: What was collected
        """
        rollout = super().collect_rollouts(*args, **kwargs)
        if not self._warmed_up and self.num_timesteps > self.learning_starts and rollout.continue_training:
            updates = self.warmup_updates
            if updates is None:
                updates = 0 if self.srl is None or self.learning_starts == 0 else get_srl_class(self.srl).warmup_updates
            if updates > 0 and self.gradient_steps != 0:
                self._in_burst = True
                try:
                    CuRe.train(self, gradient_steps=updates, batch_size=self.batch_size)  # now, also with overlap=True
                finally:
                    self._in_burst = False
            self._warmed_up = True
        return rollout

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        """Sample, update, repeat.

        :param gradient_steps: Number of updates (when alternating, of pairs of updates)
        :param batch_size: Transitions per update
        """
        if self.everything_off:
            super().train(gradient_steps, batch_size)
            return
        self.policy.set_training_mode(True)
        learning_rate = self.lr_schedule(self._progress_remaining)
        self.policy.set_learning_rate(learning_rate, self.ent_coef_lr_factor)
        for _ in range(gradient_steps):
            learns_srl, learns_rl = self._phase()
            for _ in range(2 if self._takes_turns else 1):
                sampled: Any = self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)  # type: ignore[union-attr]
                batch = self.policy.samples(sampled)
                if (
                    self.n_steps > 1
                    and self.task
                    and learns_rl
                    and isinstance(self.replay_buffer, FrameStackReplayBuffer)
                ):
                    n_step = self.replay_buffer.n_step(self.n_steps, self.gamma, self._vec_normalize_env)
                    batch = batch._replace(n_step=n_step)
                self._guard.begin(self._n_updates)
                with crash_report(self, batch):
                    self._gradient_step(batch, learns_srl, learns_rl)
                self._n_batches += 1
                self._n_rl_batches += learns_rl
            self._n_updates += 1
            self._metrics.log_reconstructions(self, batch)
        self.logger.record("train/learning_rate", learning_rate)
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")

    @property
    def _takes_turns(self) -> bool:
        """Whether SRL and RL alternate, which takes one of each."""
        return self.srl_schedule == "alternating" and self.srl is not None and (self.task or self._has_curious_agent)

    def _phase(self) -> tuple[bool, bool]:
        """Whether the next update is one of SRL, and whether it is one of actors and critics."""
        if not (self.task or self._has_curious_agent):
            return True, False
        if not self._takes_turns:
            return True, True
        in_turn = bool(self._n_updates // self.srl_period % 2 == 0)
        return in_turn, not in_turn

    def _gradient_step(self, batch: Samples, learns_srl: bool, learns_rl: bool) -> None:
        """One update on one batch: UpdateSRL, UpdateTaskAC and UpdateCuriousAC of Algorithm 1."""
        policy, encoder = self.policy, self.policy.encoder_update
        with th.no_grad(), self._autocast():
            views, next_views = policy.preprocess(batch.views), {"next ": policy.augment(batch.next_observations)}
            if batch.n_step is not None:
                next_views["n-step "] = policy.augment(batch.n_step.next_observations)
            # Where each agent that learns bootstraps: the task's after n steps, the curious one after one
            goals = {"task": list(next_views)[-1]} if self.task and learns_rl else {}
            if self._has_curious_agent and learns_rl:
                goals["curious"] = "next "
            next_latents = {goal: policy.encoder_target(next_views[goal]).float() for goal in set(goals.values())}
        encoder.begin(views, *next_views.values())

        srl_error, rewards, curious_rewards = None, batch.rewards, None
        if policy.srl is not None:
            srl_error = self._update_srl(policy.srl, batch, learns_srl)
        if policy.intrinsic is not None and learns_rl:
            curious_rewards = self._update_intrinsic(policy.intrinsic, batch, srl_error)
            if self.curiosity == "bonus":
                rewards = rewards + curious_rewards
        if "task" in goals:
            goal = goals["task"]
            self._update_actor_critic("task", batch, *self._task_return(batch, rewards), next_latents[goal], goal)
        if "curious" in goals:
            assert curious_rewards is not None
            goes_on = 1 - batch.dones if self.curiosity_episodic else th.ones_like(batch.dones)
            discounts, goal = goes_on * self.curiosity_gamma, goals["curious"]
            self._update_actor_critic("curious", batch, curious_rewards, discounts, next_latents[goal], goal)
        encoder.step(self._optimize)
        self._metrics.record(encoder.end())
        self._update_targets(learns_rl)

    def _update_srl(self, srl: SRLHead, batch: Samples, trains: bool) -> th.Tensor:
        """UpdateSRL: train the head and, through the latents, the encoder.

        :return: SRL error of the observations (or next observations) that an intrinsic reward may be made of, [B]
        """
        encoder = self.policy.encoder_update
        runs = [encoder.run(), encoder.next_run()] if srl.needs_next_latents else [encoder.run()]
        read = [_read(run.latents, trains) for run in runs]
        with th.set_grad_enabled(trains), self._autocast(srl.mixed_precision):
            loss, error = srl.loss(batch, *(latents for _, latents in read))
        latents = runs[0].latents.detach()
        if error.shape != (len(latents),) or error.requires_grad or error.dtype in (th.bfloat16, th.float16):
            raise ValueError(
                f"{type(srl).__name__}.loss returned an error of shape {tuple(error.shape)} in {error.dtype} "
                f"(requires_grad={error.requires_grad}), but it is one number per sample, detached, in fp32."
            )
        if trains:
            self._learn_from("srl", loss.float(), srl.optimizer, "srl", read)
            if all(copy.grad is None and copy.requires_grad for _, copy in read):
                warnings.warn(
                    f"the loss of {type(srl).__name__} does not depend on the latents that it is given, so it does not "
                    "train the encoder: what a head encodes itself counts as constant.",
                    stacklevel=2,
                )
            srl.after_step()
        variance = latents.var(dim=0, correction=0).mean()
        self._metrics.record({"srl_loss": loss, "srl_error": error.float().mean(), "latent_variance": variance})
        of_transitions = srl.needs_next_latents or srl.models_transitions
        about_next = self.curiosity_target == "next_observation" and not of_transitions
        if about_next and self.policy.intrinsic is not None and self.policy.intrinsic.needs_srl:
            with th.no_grad(), self._autocast(srl.mixed_precision):
                views = self.policy.augmentation(batch.next_observations)
                latents = self.policy.encoder(self.policy.preprocess(views)).float()
                # With nothing else, so that no head takes (s', a, s') for a transition.
                shown = Samples(batch.next_observations, None, None, None, None, views=views)  # type: ignore[arg-type]
                error = srl.loss(shown, latents).error
        return error.float()

    def _update_intrinsic(self, intrinsic: IntrinsicReward, batch: Samples, srl_error: th.Tensor | None) -> th.Tensor:
        """The intrinsic reward of this batch, and the step of what computes it.

        Computed afresh for each batch and never stored, hence never stale.

        :return: Scaled reward, [B, 1]
        """
        intrinsic.attach(self.replay_buffer, self._look_up, self._encode_centred)  # type: ignore[arg-type]
        read = self._read_centred(batch, intrinsic)
        latents, next_latents = [read[name][1] if name in read else None for name in ("latents", "next_latents")]
        with self._autocast(intrinsic.mixed_precision):
            loss, raw = intrinsic.loss(batch, latents, next_latents, srl_error)
        raw = raw.detach().float()
        if loss is not None:
            self._learn_from("intrinsic reward", loss.float(), intrinsic.optimizer, "intrinsic", list(read.values()))
        centers = self._has_curious_agent
        reward = self.policy.scale(raw, self.curiosity_beta, self.normalize_curiosity, centers)
        self._metrics.record(
            {
                "curious_reward_raw_mean": raw.mean(),
                "curious_reward_raw_max": raw.max(),
                "curious_reward_mean": reward.mean(),
                "curious_reward_max": reward.max(),
                "curious_reward_std": reward.std(correction=0),
            }
        )
        return reward

    def _read_centred(self, batch: Samples, intrinsic: IntrinsicReward) -> dict[str, Read]:
        """The latents that a reward reads, of centred views, by the online encoder."""
        encoder, read = self.policy.encoder_update, {}
        for name in intrinsic.reads:
            if type(self.policy.augmentation) is Augmentation:  # then all others see the centred views, too
                latents = (encoder.run() if name == "latents" else encoder.next_run()).latents
            else:
                observations = batch.observations if name == "latents" else batch.next_observations
                latents = self._encode_centred(observations, intrinsic.trains_encoder)
            read[name] = _read(latents, intrinsic.trains_encoder)
        return read

    def _look_up(self, rows: np.ndarray, env_inds: np.ndarray) -> Samples:
        """Transitions of the replay buffer by their places, as heads and rewards get them."""
        assert self.replay_buffer is not None
        sampled = transitions(self.replay_buffer, rows, env_inds, self._vec_normalize_env)
        return self.policy.samples(sampled, random=False)

    def _encode_centred(self, observations: Any, gradient: bool = False) -> th.Tensor:
        """Latents of centred views by the online encoder, fp32, [n, features_dim]."""
        with th.set_grad_enabled(gradient), self._autocast():
            return self.policy.encode(observations).float()

    def _task_return(self, batch: Samples, rewards: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """The task's rewards, of one step or of n, and the discount of what follows them, [B, 1] each."""
        if batch.n_step is None:
            return rewards, (1 - batch.dones) * (self.gamma if batch.discounts is None else batch.discounts)
        return batch.n_step.rewards, (1 - batch.n_step.dones) * batch.n_step.discounts

    def _update_actor_critic(
        self, name: str, batch: Samples, rewards: th.Tensor, discounts: th.Tensor, next_latents: th.Tensor, goal: str
    ) -> None:
        """UpdateTaskAC and UpdateCuriousAC: soft actor-critic on the latents.

        :param name: ``"task"`` or ``"curious"``
        :param batch: Samples of the replay buffer
        :param rewards: The agent's rewards, [B, 1]
        :param discounts: Discount factor where the return goes on, else 0, [B, 1]
        :param next_latents: Latents by the target encoder of where the return goes on, [B, features_dim]
        :param goal: Where that is: ``"next "`` or ``"n-step "`` observations
        """
        agent, encoder = self.policy.agents[name], self.policy.encoder_update
        with th.no_grad(), self._autocast():
            next_actions, next_log_prob = agent.actor.action_log_prob(encoder.next_features(goal))
            next_values = self._critics.next_values(agent.critic_target, next_latents, next_actions)
        target = rewards + discounts * (next_values - agent.temperature() * next_log_prob)

        read = _read(encoder.run().latents, name == "task" or self.curiosity_encoder_grad)
        with self._autocast():
            values = agent.critic(read[1], batch.actions)
        loss = self._critics.loss(values, target)
        self._learn_from(f"{name} critic", loss, agent.critic.optimizer, name, [read])
        self._metrics.record({"critic_loss": loss, "q_value": values.mean()}, name)
        if self._in_burst or self._n_rl_batches % self.actor_update_interval == 0:
            self._update_actor(name, agent)

    def _update_actor(self, name: str, agent: ActorCritic) -> None:
        """Policy improvement and the temperature's step; neither trains the encoder."""
        run, temperature = self.policy.encoder_update.run(), agent.temperature()
        with self._autocast():
            actions, log_prob = agent.actor.action_log_prob(run.features)
            value = self._critics.value(agent.critic, run.latents.detach(), actions)
        loss = (temperature * log_prob - value).mean()
        self._optimize(f"{name} actor", loss, agent.actor.optimizer)
        self._metrics.record({"actor_loss": loss, "ent_coef": temperature.squeeze()}, name)
        if agent.log_ent_coef is not None:
            ent_coef_loss = -(agent.log_ent_coef * (log_prob + float(self.target_entropy)).detach()).mean()
            self._optimize(f"{name} temperature", ent_coef_loss, agent.ent_coef_optimizer)
            self._metrics.record({"ent_coef_loss": ent_coef_loss}, name)

    def _update_targets(self, learns_rl: bool) -> None:
        """Polyak steps: of the target encoder in every phase, of target critics with their critics."""
        policy, interval = self.policy, 1 if self._in_burst else self.target_update_interval
        if self._n_batches % interval == 0:
            _polyak(policy.encoder, policy.encoder_target, self._guard.rate(self.encoder_tau))
        if learns_rl and self._n_rl_batches % interval == 0:
            for agent in policy.agents.values():
                _polyak(agent.critic, agent.critic_target, self._guard.rate(self.tau))

    def _learn_from(
        self, name: str, loss: th.Tensor, optimizer: th.optim.Optimizer | None, source: str, read: list[Read]
    ) -> None:
        """A loss steps its own parameters and gives the encoder its gradient, along which a sequential update steps."""
        self._optimize(name, loss, optimizer, *(latents for _, latents in read if latents.requires_grad))
        self.policy.encoder_update.backward(source, read)
        if self.update == "sequential":
            self.policy.encoder_update.step(self._optimize)

    def _optimize(self, name: str, loss: th.Tensor, optimizer: th.optim.Optimizer | None, *also: th.Tensor) -> None:
        """Gradients of the optimiser's parameters, and of nothing else but ``also``; a look at them; its step."""
        inputs = list(also)
        if optimizer is not None:
            optimizer.zero_grad()
            inputs += [p for group in optimizer.param_groups for p in group["params"] if p.requires_grad]
        if inputs:
            loss.backward(inputs=inputs)
        self._guard.step(name, loss, optimizer, inputs)

    @property
    def _progress_remaining(self) -> float:
        """What schedules get: SB3's own goes below zero where the last rollout goes beyond ``total_timesteps``."""
        return max(self._current_progress_remaining, 0.0)

    def _autocast(self, enabled: bool = True) -> th.autocast:
        """Context in which convolutions and linear maps compute in bf16, if they are to; weights stay fp32."""
        return th.autocast(self.device.type, th.bfloat16, enabled=enabled and self._computed_precision == "bf16")

    def dump_logs(self) -> None:
        """Write the logs, and look at what a GPU has found."""
        for name, value in self._mixer.pop_metrics().items():
            self.logger.record(name, value)
        super().dump_logs()
        self._guard.report()

    # ---------------------------------------------------------------- saving

    def _stateful_parts(self) -> dict[str, Any]:
        """What has a state besides tensors and settings, by name."""
        return {"mixer": self._mixer, "metrics": self._metrics}

    def _before_checkpoint(self) -> None:
        """Nothing that is not finite is kept."""
        self._guard.report()

    def _excluded_save_params(self) -> list[str]:
        made_anew = ["_metrics", "_guard", "_mixer", "_critics", "_computed_precision", "_compiles", "ent_coef_tensor"]
        return [*super()._excluded_save_params(), *made_anew]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        state_dicts, variables = super()._get_torch_save_params()
        if self.everything_off:
            return state_dicts, variables
        ours, our_variables = self.policy.saved_names()
        return [*state_dicts, *ours], [*variables, *our_variables]


def _read(latents: th.Tensor, gradient: bool) -> Read:
    return latents, latents.detach().requires_grad_(gradient and latents.requires_grad)


@th.no_grad()
def _polyak(source: th.nn.Module, target: th.nn.Module, tau: float | th.Tensor) -> None:
    """target <- target + tau (source - target), exactly unchanged where they are equal, or tau is 0; buffers copied."""
    parameters: list[th.Tensor] = list(target.parameters())
    goals: list[th.Tensor] = list(source.parameters())
    weights: Any = [tau] * len(parameters) if isinstance(tau, th.Tensor) else tau
    th._foreach_lerp_(parameters, goals, weights)
    for buffer, target_buffer in zip(source.buffers(), target.buffers(), strict=True):
        target_buffer.copy_(buffer)
