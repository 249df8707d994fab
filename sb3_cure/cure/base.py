"""Everything in CuRe except its algorithm: arguments, set-up, environments and saving."""

import inspect
import warnings
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch as th
from gymnasium.wrappers import RepeatAction
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.vec_env import VecEnv

from sb3_cure.cure.arguments import check_arguments, choose_intrinsic
from sb3_cure.cure.crash_report import FiniteGuard
from sb3_cure.cure.critics import LatentCritic
from sb3_cure.cure.mixers import CuriousMixer
from sb3_cure.cure.policies import CuRePolicy
from sb3_cure.data.buffers import FrameStackReplayBuffer, infer_frame_stack
from sb3_cure.envs.sharing import share_environment
from sb3_cure.envs.spaces_check import check_action_space, check_observation_space
from sb3_cure.intrinsic import IntrinsicReward
from sb3_cure.networks.allocator import tune_allocator
from sb3_cure.networks.precision import resolve_precision
from sb3_cure.persistence.callback_state import nested_callbacks
from sb3_cure.srl import SRLHead, get_srl_class
from sb3_cure.vec_env import FiniteCheck, OverlappedVecEnv, check_environments

Self = TypeVar("Self", bound="CuReBase")


class CuReBase(OffPolicyAlgorithm):
    """Arguments, set-up, environments and saving of ``CuRe``, whose algorithm is in ``cure.py``.

    Defaults are the paper's table of hyperparameters. Timesteps are *agent* steps, as everywhere in SB3: environment
    steps divided by the action repeat.

    With ``srl=None, curiosity=None`` it is SAC or TQC with one shared encoder, trained by the critics alone.

    :param policy: ``"CnnPolicy"`` for images, ``"MlpPolicy"`` for vectors, ``"MultiInputPolicy"`` for dictionaries of
        both, or a subclass of ``CuRePolicy``
    :param env: Environment, vectorised environment, or Gymnasium id
    :param learning_rate: Learning rate of everything except the temperatures; a number, or a schedule of the remaining
        progress
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
    :param srl_schedule: ``"simultaneous"``: SRL and RL in every update; ``"alternating"``: phases of SRL and of RL take
        turns. Each phase has ``srl_period`` gradient steps of two updates each, so that after a pair of phases both
        have had as many updates as with ``"simultaneous"``
    :param srl_period: Gradient steps per phase when alternating
    :param srl_interval: The SRL loss trains head and encoder in every ``srl_interval``-th update. It does so in every
        update during the burst (``warmup_updates``), in the SRL phases of ``"alternating"``, and where nothing else is
        learned
    :param intrinsic: What the curious agent is rewarded for: ``"auto"`` (the SRL error if the head's error is
        high on novel observations, else ``"rnd"``), ``"srl_error"`` (the paper), ``"reconstruction"`` (what
        the latents miss of the image, for any head), ``"rnd"``, ``"icm"``, ``"impact"``, ``"disagreement"``,
        ``"particle"``, ``"shuffled"`` (another reward, by default that of ``"auto"``, in a random order: a control), or
        a subclass of ``IntrinsicReward``
    :param intrinsic_kwargs: Arguments of the reward
    :param curiosity: ``"separate"``: a second actor-critic gets the intrinsic reward; ``"bonus"``: it is added to the
        task's; ``"random"``: the second actor draws a uniform action for each bout (control); None: off
    :param curiosity_prob: p_c, probability with which the second actor acts; a number in [0, 1], or a schedule
    :param curiosity_bout: L: who acts is redrawn with probability 1/L per step, and at resets. 1: a coin flip per
        step, as in the paper; ``"episode"``: at resets only
    :param curiosity_beta: beta, factor of the intrinsic reward
    :param curiosity_gamma: Discount factor of the curious agent; 0 needs ``curiosity_target="next_observation"`` where
        the reward is the SRL error of one observation
    :param curiosity_ent_coef: Temperature of the curious agent, as ``ent_coef``; None: like ``ent_coef``
    :param curiosity_episodic: Whether the curious return ends where the episode terminates. By default it goes on with
        the first observation of the next episode: a reward of mean zero would otherwise make dying attractive wherever
        the error is low. (With SB3's replay buffers and subclasses of ours, it goes on with the terminal observation)
    :param normalize_curiosity: Standardise the reward (see ``RewardScale``); False: exactly as in the paper
    :param curiosity_target: Whose SRL error rewards a transition: ``"observation"`` (at no cost) or
        ``"next_observation"``
    :param curiosity_encoder_grad: Whether the curious critics train the encoder (the paper: yes)
    :param curious_interval: The separate curious agent and its reward learn in every ``curious_interval``-th update,
        and in every update of the burst
    :param task: False: a curious agent alone, which collects, acts and learns without task reward
    :param augmentation: What the encoder sees: ``"shift"``, ``"crop"``, None, or ``"auto"``: what the head needs
    :param augmentation_kwargs: Arguments of the augmentation (``pad`` of shifts, ``size`` of crops; pixels)
    :param warmup_updates: Gradient steps in one burst after ``learning_starts``; None: the head's default (RAE:
        1000), or 0 where there is no random warm-up or the head is frozen. With ``learning_starts=0`` the burst waits
        for ``batch_size`` transitions. In the burst, actors, temperatures and targets learn in every update, as in
        SAC-AE's code
    :param actor_update_interval: Updates of the critics per update of actors and temperatures
    :param target_update_interval: Updates between two Polyak steps
    :param encoder_tau: Polyak rate of the target encoder
    :param update: ``"joint"`` (one encoder pass for all) or ``"sequential"`` (a pass and a step for each loss:
        Algorithm 1 to the letter), see ``EncoderUpdate``
    :param precision: ``"auto"``, ``"fp32"`` or ``"bf16"``; auto is bf16 for images on hardware that computes
        it natively
    :param overlap: Update while worker processes (``SubprocVecEnv``) step and render the environments: actions then
        come from a policy that is one call of ``train`` behind
    :param ent_coef: Temperature: ``"auto_<initial value>"``, ``"auto"`` or a fixed number
    :param ent_coef_lr_factor: Learning rate of the temperatures as a multiple of ``learning_rate``
    :param kwargs: The remaining arguments of the base class (``seed``, ``verbose``, ``policy_kwargs``, ...)
    :raises ValueError: for arguments that cannot work, in one sentence
    """

    #: Critics of the base class
    critic_class: ClassVar[type[LatentCritic]]
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
        srl_interval: int = 1,
        intrinsic: str | type[IntrinsicReward] = "auto",
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
        curious_interval: int = 1,
        task: bool = True,
        augmentation: str | None = "auto",
        augmentation_kwargs: dict[str, Any] | None = None,
        warmup_updates: int | None = None,
        actor_update_interval: int = 2,
        target_update_interval: int = 2,
        encoder_tau: float = 0.05,
        update: str = "joint",
        precision: str = "auto",
        overlap: bool = False,
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
        self.srl_interval = srl_interval
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
        self.curious_interval = curious_interval
        self.task = task
        self.augmentation = augmentation
        self.augmentation_kwargs = augmentation_kwargs or {}
        self.warmup_updates = warmup_updates
        self.actor_update_interval = actor_update_interval
        self.encoder_tau = encoder_tau
        self.update = update
        self.precision = precision
        self.overlap = overlap
        self.ent_coef_lr_factor = ent_coef_lr_factor
        # Batches learned from, and those of them that trained actors and critics (`_n_updates` counts gradient steps)
        self._n_batches = self._n_rl_batches = 0
        self._warmed_up = self._in_burst = False
        #: Whether encoder and head are kept as they are; it can be set at any time
        self.representation_frozen = False
        #: Metrics of the current update
        self._metrics: dict[str, th.Tensor] = {}
        #: While ``learn`` runs with ``overlap=True``: the environments, wrapped so that updates run while they step
        self._overlapped: OverlappedVecEnv | None = None
        self._action_repeat = 1
        #: Frames per observation, for buffers and rewards; kept in archives, as models are loaded without environments
        self._frame_stack: int | dict[str, int] | None = None
        if _init_setup_model:
            self._setup_model()

    # ---------------------------------------------------------------- set-up

    @property
    def _has_curious_agent(self) -> bool:
        return self.curiosity == "separate"

    def _setup_model(self) -> None:
        tune_allocator()
        check_arguments(self)
        check_observation_space(self.observation_space, self.policy_class)
        self._guard = FiniteGuard(deferred=self.device.type != "cpu")
        self._mixer = CuriousMixer(self.seed)
        if self.replay_buffer_class is None:
            self.replay_buffer_class = FrameStackReplayBuffer
        given = self.replay_buffer_kwargs.get("frame_stack")
        self._frame_stack = given or self._frame_stack or infer_frame_stack(self.env)
        if issubclass(self.replay_buffer_class, FrameStackReplayBuffer):
            if "frame_stack" in inspect.signature(self.replay_buffer_class).parameters:
                self.replay_buffer_kwargs.setdefault("frame_stack", self._frame_stack)
            # If this were True, SB3's `learn` would mark the newest row as done.
            self.optimize_memory_usage = False
        user_kwargs, settings = self.policy_kwargs, self._policy_settings()
        if own := sorted(user_kwargs.keys() & settings.keys()):
            raise ValueError(f"policy_kwargs has {own}, which the algorithm sets: pass these to the algorithm instead.")
        self.policy_kwargs = {**user_kwargs, **settings}
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "`n_steps=")  # SB3 cannot know that our buffer has returns of n steps
            super()._setup_model()
        self.policy_kwargs = user_kwargs
        self._computed_precision = resolve_precision(self.precision, self.device, self.observation_space)
        if self.verbose >= 1:
            print(f"Updates compute in {self._computed_precision} (precision={self.precision!r}).")
            if self.intrinsic == "auto" and self.policy.intrinsic is not None:
                print(f"The curious agent is rewarded by {choose_intrinsic(self).__name__} (intrinsic='auto').")
        for name in self.policy.agents:
            self._set_temperature(name)

    def _policy_settings(self) -> dict[str, Any]:
        """Arguments of the policy that are derived from the algorithm's."""
        rewarded = self.curiosity in ("separate", "bonus")
        return dict(
            critic_class=self.critic_class,
            srl_class=None if self.srl is None else get_srl_class(self.srl),
            srl_kwargs=self.srl_kwargs,
            augmentation=self.augmentation,
            augmentation_kwargs=self.augmentation_kwargs,
            intrinsic_class=choose_intrinsic(self) if rewarded else None,
            intrinsic_kwargs=self.intrinsic_kwargs,
            reward_settings={"frame_stack": self._frame_stack, "curiosity_target": self.curiosity_target},
            task=self.task,
            curious=self._has_curious_agent,
            curiosity_encoder_grad=self.curiosity_encoder_grad,
            update=self.update,
        )

    def _set_temperature(self, name: str) -> None:
        """Give an agent its temperature; the task agent's is also in SB3's attributes."""
        agent, ent_coef = self.policy.agents[name], self.ent_coef
        if name == "curious" and self.curiosity_ent_coef is not None:
            ent_coef = self.curiosity_ent_coef
        agent.set_temperature(ent_coef, self.lr_schedule(1) * self.ent_coef_lr_factor, self.device)
        if name == "task":
            self.log_ent_coef, self.ent_coef_optimizer = agent.log_ent_coef, agent.ent_coef_optimizer
            self.ent_coef_tensor = agent.ent_coef_tensor  # type: ignore[assignment]

    def set_random_seed(self, seed: int | None = None) -> None:
        """Seed all random streams, the mixer's included.

        :param seed: Seed; None changes nothing
        """
        super().set_random_seed(seed)
        if seed is not None:
            self._mixer.rng = np.random.default_rng(seed)

    # ---------------------------------------------------------- environments

    @staticmethod
    def _wrap_env(env: GymEnv, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        check_observation_space(env.observation_space)
        check_action_space(env.action_space)
        return check_environments(OffPolicyAlgorithm._wrap_env(env, verbose, monitor_wrapper))

    def get_env(self) -> VecEnv | None:
        """Get the environments.

        :return: The environments without ``FiniteCheck``, because callbacks compare the types of training and
            evaluation environments
        """
        return self.env.venv if isinstance(self.env, FiniteCheck) else self.env

    def learn(
        self: Self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> Self:
        """Train.

        :param total_timesteps: Agent steps to train for (environment steps / action repeat), all environments together
        :param callback: SB3 callback(s)
        :param log_interval: Episodes between two dumps of the logger
        :param tb_log_name: Name of the run in TensorBoard; None: the algorithm's
        :param reset_num_timesteps: Whether to start counting anew
        :param progress_bar: Show a progress bar (needs tqdm and rich)
        :return: self
        """
        name = tb_log_name or type(self).__name__
        self._overlapped = OverlappedVecEnv(self.env) if self.overlap else None  # type: ignore[arg-type]
        try:
            return super().learn(total_timesteps, callback, log_interval, name, reset_num_timesteps, progress_bar)
        finally:
            self._overlapped = None

    def _init_callback(self, callback: MaybeCallback, progress_bar: bool = False) -> BaseCallback:
        initialised = super()._init_callback(callback, progress_bar)
        for each in nested_callbacks(initialised):
            if share_environment(getattr(each, "eval_env", None), self.env):
                raise ValueError(
                    f"{type(each).__name__} evaluates in the training environment, which would store transitions that "
                    "never happened: give it a separate eval_env."
                )
        return initialised

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        *args: Any,
        **kwargs: Any,
    ) -> tuple[int, BaseCallback]:
        buffer: Any = self.replay_buffer
        if isinstance(buffer, HerReplayBuffer):
            buffer.env = self.env  # SB3 does not update it in `set_env`
            if reset_num_timesteps or self._last_obs is None:  # the environments are reset
                with warnings.catch_warnings(action="ignore"):
                    buffer.truncate_last_trajectory()
        total, callback = super()._setup_learn(total_timesteps, callback, reset_num_timesteps, *args, **kwargs)
        # SB3 sets this after each step; without this line the first step would see the previous call's progress.
        self._current_progress_remaining = 1 - self.num_timesteps / max(total, 1)
        env: Any = self.env
        restarts_workers = getattr(env.unwrapped, "on_env_fault", None) == "restart"
        if restarts_workers and not isinstance(buffer, FrameStackReplayBuffer):
            raise ValueError(
                f"a {type(buffer).__name__} cannot leave out the steps of workers that died: use "
                "on_env_fault='raise', or leave replay_buffer_class out."
            )
        # Gymnasium's `RepeatAction` has no `action_repeat`; wrappers of ours add it, but SB3's workers may lack them.
        known = [name for name in ("action_repeat", "num_repeats") if env.has_attr(name)]
        repeat = env.get_attr(known[0])[0] if known else 1
        self._action_repeat = repeat if isinstance(repeat, int) else 1
        if isinstance(buffer, HerReplayBuffer) and self._action_repeat > 1 and any(env.env_is_wrapped(RepeatAction)):
            raise ValueError(
                f"action_repeat={self._action_repeat} sums rewards, and HerReplayBuffer would mix such sums with "
                "the single rewards that it computes for other goals: use action_repeat=1."
            )
        return total, callback

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: np.ndarray,
        new_obs: np.ndarray | dict[str, np.ndarray],
        reward: np.ndarray,
        dones: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        self._last_episode_starts = np.array(dones, dtype=bool)  # SB3 keeps this up to date for PPO only
        if any(info.get("env_fault") for info in infos):  # a worker died: this step is not stored
            replay_buffer.break_stream()  # type: ignore[attr-defined]
            self._last_obs = new_obs  # type: ignore[assignment]
            if self._vec_normalize_env is not None:
                self._last_original_obs = self._vec_normalize_env.get_original_obs()
            return
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)

    @property
    def _progress_remaining(self) -> float:
        """Remaining progress for schedules: SB3's own falls below zero if the last rollout exceeds the total."""
        return max(self._current_progress_remaining, 0.0)

    def dump_logs(self) -> None:
        """Write the logs: SB3's, environment steps next to agent steps, and how often the curious actor acted."""
        self.logger.record("time/environment_steps", self.num_timesteps * self._action_repeat)
        for name, value in self._mixer.pop_metrics().items():
            self.logger.record(name, value)
        super().dump_logs()

    # ---------------------------------------------------------------- saving

    def _stateful_parts(self) -> dict[str, Any]:
        """Objects with a state besides tensors and settings, by name."""
        return {"mixer": self._mixer}

    def _before_save(self) -> None:
        """Finish deferred updates, and refuse to save parameters that are not finite."""
        if self._overlapped is not None:
            self._overlapped.finish()
        self._guard.report()

    def _excluded_save_params(self) -> list[str]:
        made_anew = ["_guard", "_metrics", "_mixer", "_overlapped", "_computed_precision", "ent_coef_tensor"]
        return [*super()._excluded_save_params(), *made_anew]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        state_dicts, variables = super()._get_torch_save_params()
        ours, our_variables = self.policy.saved_names()
        return [*state_dicts, *ours], [*variables, *our_variables]
