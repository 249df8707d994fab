"""What a model does with its environments: a look at all they return, and updates while they step."""

from functools import partial
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import RolloutReturn
from stable_baselines3.common.vec_env import VecEnv

from sb3_cure.vec_env.asynchronous import OverlappedVecEnv
from sb3_cure.vec_env.finite_check import FiniteCheck


class ModelEnvironments(OffPolicyAlgorithm):
    """Wraps a model's environments, with SB3's hooks alone.

    ``on_bad_transition`` says what ``FiniteCheck`` does, ``overlap`` whether the updates of one step are made during
    the next.
    """

    on_bad_transition: str
    overlap: bool
    #: While ``learn`` runs with ``overlap=True``: the environments, which do updates as they step
    _overlapped: OverlappedVecEnv | None = None

    def _check_environments(self) -> None:
        skip = self.on_bad_transition == "skip"
        if self.env is not None and not (isinstance(self.env, FiniteCheck) and self.env.skip == skip):
            self.env = FiniteCheck(self.env, self.on_bad_transition)

    def get_env(self) -> VecEnv | None:
        """
        :return: The environments without our look around them: callbacks compare their kind with that of others
        """
        return self.env.venv if isinstance(self.env, FiniteCheck) else self.env

    def _setup_model(self) -> None:
        self._check_environments()
        super()._setup_model()

    def _setup_learn(self, *args: Any, **kwargs: Any) -> tuple[int, BaseCallback]:
        self._check_environments()  # `set_env` may have brought others
        told = (
            self.env.get_attr("action_repeat")[0] if self.env is not None and self.env.has_attr("action_repeat") else 1
        )
        self._action_repeat = told if isinstance(told, int) else 1
        return super()._setup_learn(*args, **kwargs)

    def learn(self, *args: Any, **kwargs: Any) -> Any:
        """As in SB3, with environments that overlap with the updates if they are to."""
        self._check_environments()
        if self.overlap and self.env is not None:
            self._overlapped = OverlappedVecEnv(self.env)
        try:
            return super().learn(*args, **kwargs)
        finally:
            self._overlapped = None

    def collect_rollouts(self, env: VecEnv, *args: Any, **kwargs: Any) -> RolloutReturn:
        """As in SB3.

        :param env: Environments
        :return: What was collected
        """
        goes_on = False
        try:
            rollout = super().collect_rollouts(self._overlapped or env, *args, **kwargs)
            goes_on = rollout.continue_training
        finally:
            if not goes_on:
                # The environments have made a step that is not stored: another `learn` starts with a reset.
                self._last_obs = None
        return rollout

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        """Update now or, with ``overlap=True`` while ``learn`` runs, during the next step.

        :param gradient_steps: Number of updates
        :param batch_size: Transitions per update
        """
        if self._overlapped is not None and self.num_timesteps < self._total_timesteps:
            self._overlapped.defer(partial(self._train_in_rollout, gradient_steps, batch_size))
        else:
            super().train(gradient_steps, batch_size)

    def _train_in_rollout(self, gradient_steps: int, batch_size: int) -> None:
        super().train(gradient_steps, batch_size)
        self.policy.set_training_mode(False)

    def dump_logs(self) -> None:
        """Write the logs: SB3's, environment steps beside agent steps, and how many transitions were left out."""
        self.logger.record("time/environment_steps", self.num_timesteps * self._action_repeat)
        if isinstance(self.env, FiniteCheck) and self.env.n_bad > 0:
            self.logger.record("rollout/bad_transitions", self.env.n_bad)
        super().dump_logs()

    def _before_checkpoint(self) -> None:
        if self._overlapped is not None:
            self._overlapped.finish()
        super()._before_checkpoint()  # type: ignore[misc]

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_overlapped"]
