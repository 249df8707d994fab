"""CuRe: curiosity-driven representations for an off-policy actor-critic (Algorithm 1 of the paper).

Compare with SB3's ``sac.py``: ``_sample_action`` chooses who acts; ``_train`` samples batches and calls ``_update``,
which has a method for each update of Algorithm 1. Losses and targets of the critics are in ``critics.py``;
``encoder_update.py`` describes how several losses train the encoder that they share.
"""

import warnings
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.type_aliases import RolloutReturn
from stable_baselines3.common.vec_env import VecEnv

from sb3_cure.cure.actor_critic import ActorCritic
from sb3_cure.cure.base import CuReBase
from sb3_cure.cure.crash_report import crash_report
from sb3_cure.cure.metrics import PREFIXES, Metrics, log_reconstructions, means
from sb3_cure.data.buffers import FrameStackReplayBuffer, transitions
from sb3_cure.data.observations import rows_of
from sb3_cure.data.samples import Samples
from sb3_cure.intrinsic import RewardInputs
from sb3_cure.networks.precision import compute_in
from sb3_cure.srl import SRLOutput, get_srl_class


class CuRe(CuReBase):
    """Adds to an SB3 off-policy actor-critic a shared encoder, an SRL head, a curious actor-critic and their mixer.

    Paper: "Seeking Visual Discomfort: Curiosity-driven Representations for Reinforcement Learning" (Aljalbout,
    Ulmer and Triebel), Algorithm 1. Arguments are described at ``CuReBase``.
    """

    # ---------------------------------------------- acting: lines 2 to 8 of Algorithm 1

    def predict_curious(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """Predict actions of the curious policy, as ``predict`` does for the task policy.

        :param observation: One observation or a batch, as for ``predict``
        :param state: Unused (SB3's signature)
        :param episode_start: Unused (SB3's signature)
        :param deterministic: Whether to return the mean action
        :return: Actions in the action space's bounds, and ``state``
        :raises ValueError: if there is no curious policy
        """
        if self.policy.curious is None:
            raise ValueError(f"only curiosity='separate' trains a curious policy, but curiosity is {self.curiosity!r}.")
        with self.policy.acting("curious"):
            return self.policy.predict(observation, state, episode_start, deterministic)

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        """Let the curious (or, as a control, a random) actor act where the mixer chooses it, else the task actor."""
        if self.curiosity == "random" and not self.task:  # uniform actions all the time
            learning_starts = self.num_timesteps + 1
        _, actions = super()._sample_action(learning_starts, None, n_envs)
        if self.num_timesteps < learning_starts:
            self._mixer.forget()  # who acted in an earlier `learn` no longer matters
        elif self.task and self.curiosity in ("separate", "random"):
            starts: Any = self._last_episode_starts
            is_second = self._mixer.choose(starts, self.curiosity_prob, self.curiosity_bout, self._progress_remaining)
            if is_second.any():
                if self.curiosity == "random":
                    chosen = self._mixer.hold(self.action_space.sample)
                else:
                    chosen, _ = self.predict_curious(rows_of(self._last_obs, is_second))
                actions[is_second] = self.policy.scale_action(chosen)
        if action_noise is not None:  # added once, whoever acts
            actions = np.clip(actions + action_noise(), -1, 1)
        return self.policy.unscale_action(actions), actions

    def collect_rollouts(self, env: VecEnv, *args: Any, **kwargs: Any) -> RolloutReturn:
        """Collect as SB3 does, with the mixer in ``_sample_action``; after the warm-up, make the burst of updates.

        :param env: Environments
        :return: What was collected
        """
        continues = False
        try:
            rollout = super().collect_rollouts(self._overlapped or env, *args, **kwargs)
            continues = rollout.continue_training
        finally:
            if not continues:  # SB3 made a step without storing it: reset in the next `learn`
                self._last_obs = None
        if continues and not self._warmed_up and self.num_timesteps > self.learning_starts:
            self._warm_up()
        return rollout

    def _warm_up(self) -> None:
        """Make the burst of updates after the random steps, as SAC-AE does."""
        updates = self.warmup_updates
        if updates is None:
            wanted = self._has_trainable_head and self.learning_starts > 0
            updates = get_srl_class(self.srl).warmup_updates if wanted else 0  # type: ignore[arg-type]
        elif self.learning_starts == 0 and self.replay_buffer.size() * self.n_envs < self.batch_size:  # type: ignore[union-attr]
            return  # wait until there is a whole batch
        if updates > 0 and self.gradient_steps != 0:
            if self.verbose >= 1:
                print(f"Making {updates} updates before the next step (warmup_updates).")
            self._in_burst = True
            try:
                self._train(updates, self.batch_size)
            finally:
                self._in_burst = False
        self._warmed_up = True

    # -------------------------------------------- learning: lines 9 to 12 of Algorithm 1

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        """Update now or, with ``overlap=True`` in ``learn``, while the environments make their next step.

        :param gradient_steps: Number of updates (when alternating, of pairs of updates)
        :param batch_size: Transitions per update
        """
        if self._overlapped is not None and self.num_timesteps < self._total_timesteps:
            self._overlapped.defer(partial(self._train, gradient_steps, batch_size))
        else:
            self._train(gradient_steps, batch_size)

    def _train(self, gradient_steps: int, batch_size: int) -> None:
        """Sample, update, repeat."""
        self.policy.freeze_representation(self.representation_frozen)
        self.policy.set_training_mode(True)
        task = self.policy.task  # callbacks may have replaced the temperature on the model
        task.log_ent_coef, task.ent_coef_optimizer = self.log_ent_coef, self.ent_coef_optimizer
        task.ent_coef_tensor = self.ent_coef_tensor
        learning_rate = self.lr_schedule(self._progress_remaining)
        self.policy.set_learning_rate(learning_rate, self.ent_coef_lr_factor)
        metrics = []
        for _ in range(gradient_steps):
            learns_srl, learns_rl, n_batches = self._plan()
            for _ in range(n_batches):
                learners = self._learners() if learns_rl else []
                batch = self._sample_batch(batch_size, learners)
                self._guard.update = self._n_updates
                with crash_report(self, batch), compute_in(self.policy, self._computed_precision):
                    metrics.append(self._update(batch, learns_srl, learners))
                self._n_batches += 1
                self._n_rl_batches += learns_rl
            self._n_updates += 1
        self.policy.set_training_mode(False)
        self._guard.report()
        for name, mean in means(metrics).items():
            self.logger.record_mean(f"train/{name}", mean)
        self.logger.record("train/learning_rate", learning_rate)
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        if gradient_steps > 0:
            log_reconstructions(self, batch, gradient_steps)

    def _sample_batch(self, batch_size: int, learners: list[str]) -> Samples:
        """Draw transitions and the views of them that the encoder sees."""
        buffer: Any = self.replay_buffer
        prepare = self.policy.prepare
        batch = self.policy.samples(buffer.sample(batch_size, env=self._vec_normalize_env))
        if self.n_steps > 1 and "task" in learners:
            n_step = buffer.n_step(self.n_steps, self.gamma, self._vec_normalize_env)
            batch = batch._replace(n_step=n_step._replace(next_observations=prepare(n_step.next_observations)))
        goes_on = "curious" in learners and not self.curiosity_episodic
        if goes_on and type(buffer) is FrameStackReplayBuffer:  # a subclass may sample otherwise
            batch = batch._replace(restarts=prepare(buffer.restarts(self._vec_normalize_env)))
        return batch

    def _plan(self) -> tuple[bool, bool, int]:
        """Whether the next update trains the representation, whether it trains agents, and its number of batches."""
        learns_srl = self._has_trainable_head
        learns_rl = self.task or self._has_curious_agent
        if not (learns_srl and learns_rl):
            return learns_srl, learns_rl, 1
        if self.srl_schedule == "simultaneous":
            return self._is_due(self._n_updates, self.srl_interval), True, 1
        srl_phase = self._n_updates // self.srl_period % 2 == 0
        return srl_phase, not srl_phase, 2

    @property
    def _has_trainable_head(self) -> bool:
        return self.srl is not None and not self.representation_frozen

    def _is_due(self, n_before: int, interval: int) -> bool:
        """Whether a step that is made once per ``interval`` updates is due now; in the burst it always is."""
        return self._in_burst or n_before % interval == 0

    def _is_agents_step_due(self, name: str, interval: int) -> bool:
        """Whether a step that an agent makes once per ``interval`` of its own updates is due now."""
        own_interval = self.curious_interval if name == "curious" else 1
        return self._is_due(self._n_rl_batches // own_interval, interval)

    def _update(self, batch: Samples, learns_srl: bool, learners: list[str]) -> Metrics:
        """UpdateSRL, UpdateTaskAC and UpdateCuriousAC of Algorithm 1 on one batch."""
        policy, encoder = self.policy, self.policy.encoder_update
        encoder.begin(self._views(batch), self._guard.check)
        if not policy.representation_frozen:
            for each in (policy.encoder, policy.encoder_target):
                each.update_statistics(batch.views)
        self._metrics = {}
        rewarded = "task" if self.curiosity == "bonus" else "curious"
        srl = rewards = None
        if rewarded in learners:  # computed before head and encoder step
            reward: Any = policy.intrinsic
            reward_steps_encoder = reward.trains_encoder and encoder.mode == "sequential"
            # If the reward steps the encoder, the head's loss must be computed after that step.
            srl = self._srl_loss(batch) if learns_srl and not reward_steps_encoder else None
            rewards = self._intrinsic_rewards(batch, srl)
        if learns_srl:
            srl = srl or self._srl_loss(batch)
            self._update_srl(srl.loss)
        if "task" in learners:
            self._update_task(batch, rewards if rewarded == "task" else None)
        if "curious" in learners:
            self._update_curious(batch, rewards)
        encoder.finish()
        self._update_targets(learners)
        return self._metrics | encoder.metrics

    def _views(self, batch: Samples) -> dict[str, Callable[[], Any]]:
        """Functions that make what the encoder may see in an update: random views and, for rewards, centred ones."""
        policy, n_step = self.policy, batch.n_step
        return {
            "observations": lambda: batch.views,
            "next_observations": lambda: policy.augmentation(batch.next_observations),
            "n_step": lambda: policy.augmentation(n_step.next_observations),  # type: ignore[union-attr]
            "restarts": lambda: policy.augmentation(batch.restarts),
            "centred observations": lambda: policy.center(batch.observations),
            "centred next_observations": lambda: policy.center(batch.next_observations),
        }

    def _learners(self) -> list[str]:
        """Names of the agents that learn from this batch."""
        curious = self._has_curious_agent and self._is_due(self._n_rl_batches, self.curious_interval)
        return ["task"] * self.task + ["curious"] * curious

    def _srl_loss(self, batch: Samples, learns: bool = True) -> SRLOutput:
        """Loss of the head, and the error of each sample, [B]."""
        srl: Any = self.policy.srl
        source = "srl" if learns else "measured"
        names = ["observations", "next_observations"] if srl.needs_next_latents else ["observations"]
        latents = [self.policy.encoder_update.latents(source, name) for name in names]
        with th.set_grad_enabled(learns):
            loss, error = srl.loss(batch, *latents)
        if error.shape != (len(latents[0]),) or error.requires_grad or error.dtype in (th.bfloat16, th.float16):
            raise ValueError(
                f"{type(srl).__name__}.loss returned an error of shape {tuple(error.shape)} in {error.dtype} "
                f"(requires_grad={error.requires_grad}), but it must be one number per sample, detached, in fp32."
            )
        variance = latents[0].detach().var(dim=0, correction=0).mean()
        self._note({"srl_loss": loss, "srl_error": error.mean(), "latent_variance": variance})
        return SRLOutput(loss.float(), error.float())

    def _srl_error(self, batch: Samples, srl_output: SRLOutput | None) -> th.Tensor:
        """SRL error that rewards a transition, [B]: of the observation, the next one, or the transition itself."""
        srl: Any = self.policy.srl
        if self.curiosity_target == "observation" or srl.needs_next_latents or srl.models_transitions:
            return (srl_output or self._srl_loss(batch, learns=False)).error
        views = self.policy.augmentation(batch.next_observations)
        # All other fields are None: heads must not read (s', a, s') as a transition.
        alone = Samples(batch.next_observations, None, None, None, None, views=views)  # type: ignore[arg-type]
        with th.no_grad():
            return srl.loss(alone, self.policy.encoder(views)).error.float()  # type: ignore[no-any-return]

    def _update_srl(self, loss: th.Tensor) -> None:
        """UpdateSRL: train the head and, through the latents, the encoder."""
        srl: Any = self.policy.srl
        leaves = self.policy.encoder_update.leaves("srl")
        self._step_with_encoder("srl", "srl", loss, srl.optimizer)
        if leaves and all(leaf.grad is None for leaf in leaves):
            warnings.warn(
                f"the loss of {type(srl).__name__} does not depend on the latents that it is given, so it does not "
                "train the encoder: what a head encodes itself counts as constant.",
                stacklevel=2,
            )
        srl.after_step()

    def _intrinsic_rewards(self, batch: Samples, srl: SRLOutput | None) -> th.Tensor:
        """Train the reward's own networks, and return the scaled reward, [B, 1]: never stored, so never stale."""
        reward: Any = self.policy.intrinsic
        loss, raw = reward.loss(self._reward_inputs(batch, srl))
        if raw.shape != (len(batch.actions),):
            raise ValueError(
                f"{type(reward).__name__}.loss returned a reward of shape {tuple(raw.shape)}, but it must be one "
                "number per sample."
            )
        raw = raw.detach().float()
        if loss is not None:
            self._step_with_encoder("intrinsic", "intrinsic reward", loss.float(), reward.optimizer)
        scaled = self.policy.scale(raw, self.curiosity_beta, self.normalize_curiosity, self._has_curious_agent)
        self._note(
            {
                "curious_reward_raw_mean": raw.mean(),
                "curious_reward_raw_max": raw.max(),
                "curious_reward_mean": scaled.mean(),
                "curious_reward_max": scaled.max(),
                "curious_reward_std": scaled.std(correction=0),
            }
        )
        return scaled

    def _update_task(self, batch: Samples, bonus: th.Tensor | None) -> None:
        """UpdateTaskAC, with returns of one step or of several."""
        returns = batch.n_step or batch
        rewards = returns.rewards if bonus is None else returns.rewards + bonus
        discounts = (1 - returns.dones) * (self.gamma if returns.discounts is None else returns.discounts)
        next_view = "next_observations" if batch.n_step is None else "n_step"
        self._update_actor_critic("task", batch.actions, rewards, discounts, next_view)

    def _update_curious(self, batch: Samples, rewards: Any) -> None:
        """UpdateCuriousAC: unless ``curiosity_episodic``, returns go on in the next episode where one terminates.

        As in RND (Burda et al., 2019). They go on from the first observation of the next episode if the buffer has it:
        no action is ever taken in a terminal observation, so no loss would correct its value.
        """
        continues = 1 - batch.dones if self.curiosity_episodic else th.ones_like(batch.dones)
        discounts = continues * self.curiosity_gamma
        next_view = "next_observations" if batch.restarts is None else "restarts"
        self._update_actor_critic("curious", batch.actions, rewards, discounts, next_view)

    def _update_actor_critic(
        self, name: str, actions: th.Tensor, rewards: th.Tensor, discounts: th.Tensor, next_view: str
    ) -> None:
        """Soft actor-critic on the latents; the critics' loss also trains the encoder.

        :param name: ``"task"`` or ``"curious"``
        :param actions: The batch's, in [-1, 1], [B, action_dim]
        :param rewards: The agent's rewards, [B, 1]
        :param discounts: Discount factor where the return continues, else 0, [B, 1]
        :param next_view: Name of the views that the return bootstraps from
        """
        agent, encoder, prefix = self.policy.agents[name], self.policy.encoder_update, PREFIXES[name]
        with th.no_grad():
            next_actions, next_log_prob = agent.actor.action_log_prob(encoder.features(next_view))
            next_values = agent.critic_target.target_values(encoder.target_latents(next_view), next_actions)
            target = rewards + discounts * (next_values - agent.temperature() * next_log_prob)
        critic_loss = agent.critic.loss(encoder.latents(name), actions, target)
        self._step_with_encoder(name, f"{name} critic", critic_loss, agent.critic.optimizer)
        self._note({f"{prefix}critic_loss": critic_loss, f"{prefix}q_target": target.mean()})
        if self._is_agents_step_due(name, self.actor_update_interval):
            self._update_actor(name, agent)

    def _update_actor(self, name: str, agent: ActorCritic) -> None:
        """Policy improvement and the temperature's step; neither trains the encoder."""
        encoder, temperature, prefix = self.policy.encoder_update, agent.temperature(), PREFIXES[name]
        latents = encoder.latents("actor")
        actions, log_prob = agent.actor.action_log_prob(encoder.features())
        actor_loss = (temperature * log_prob - agent.critic.value(latents, actions)).mean()
        self._optimize(f"{name} actor", actor_loss, agent.actor.optimizer)
        self._note({f"{prefix}actor_loss": actor_loss, f"{prefix}ent_coef": temperature.squeeze()})
        if agent.log_ent_coef is not None:
            ent_coef_loss = -(agent.log_ent_coef * (log_prob + float(self.target_entropy)).detach()).mean()
            self._optimize(f"{name} temperature", ent_coef_loss, agent.ent_coef_optimizer)
            self._note({f"{prefix}ent_coef_loss": ent_coef_loss})

    def _update_targets(self, learners: list[str]) -> None:
        """Make the Polyak steps: the target encoder's in every phase, the target critics' when their critics learn."""
        policy = self.policy
        if self._is_due(self._n_batches, self.target_update_interval):
            _polyak_step(policy.encoder, policy.encoder_target, self.encoder_tau)
        for name in learners:
            if self._is_agents_step_due(name, self.target_update_interval):
                _polyak_step(policy.agents[name].critic, policy.agents[name].critic_target, self.tau)

    def _note(self, metrics: Metrics) -> None:
        """Add to this update's metrics."""
        self._metrics |= {name: value.detach() for name, value in metrics.items()}

    def _step_with_encoder(self, source: str, name: str, loss: th.Tensor, optimizer: th.optim.Optimizer | None) -> None:
        """Step the loss's own parameters, and pass its gradient at the latents on to the encoder update."""
        self._optimize(name, loss, optimizer, self.policy.encoder_update.leaves(source))
        self.policy.encoder_update.collect(source)

    def _optimize(
        self, name: str, loss: th.Tensor, optimizer: th.optim.Optimizer | None, leaves: Sequence[th.Tensor] = ()
    ) -> None:
        """Compute the gradients of the optimiser's parameters and of ``leaves``, check them, and step."""
        inputs = list(leaves)
        if optimizer is not None:
            optimizer.zero_grad()
            inputs += [p for group in optimizer.param_groups for p in group["params"] if p.requires_grad]
        if inputs:
            loss.backward(inputs=inputs)
        self._guard.check(name, [each.grad for each in inputs if each.grad is not None], loss)
        if optimizer is not None:
            optimizer.step()

    def _reward_inputs(self, batch: Samples, srl: SRLOutput | None) -> RewardInputs:
        """What an intrinsic reward may read of this batch, of the encoder and of the replay buffer."""
        policy, encoder = self.policy, self.policy.encoder_update
        is_random = policy.augmentation.is_random
        # Without random views the other losses read these latents, too, and need their graph.
        graph = policy.intrinsic.trains_encoder or not is_random  # type: ignore[union-attr]

        def read(name: str) -> th.Tensor:
            return encoder.latents("intrinsic", f"centred {name}" if is_random else name, graph)

        def look_up(rows: np.ndarray, env_inds: np.ndarray) -> Samples:
            sampled = transitions(self.replay_buffer, rows, env_inds, self._vec_normalize_env)  # type: ignore[arg-type]
            return policy.samples(sampled, random=False)

        srl_error = partial(self._srl_error, batch, srl) if policy.intrinsic.needs_srl else None  # type: ignore[union-attr]
        return RewardInputs(batch, srl_error, read, self.replay_buffer, look_up)  # type: ignore[arg-type]


@th.no_grad()
def _polyak_step(source: th.nn.Module, target: th.nn.Module, tau: float) -> None:
    """target <- target + tau (source - target), exactly unchanged where they are equal; buffers are copied."""
    parameters: list[th.Tensor] = list(target.parameters())
    if parameters:
        th._foreach_lerp_(parameters, list(source.parameters()), tau)
    for buffer, target_buffer in zip(source.buffers(), target.buffers(), strict=True):
        target_buffer.copy_(buffer)
