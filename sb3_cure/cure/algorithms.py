"""The algorithms that users name: CuRe on SB3's SAC and on sb3-contrib's TQC."""

from functools import partial
from typing import Any, ClassVar

from sb3_contrib.tqc import policies as tqc_policies
from sb3_contrib.tqc.tqc import TQC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import RolloutReturn
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.sac import policies as sac_policies
from stable_baselines3.sac.sac import SAC

from sb3_cure.cure import policies
from sb3_cure.cure.critics import TruncatedQuantiles, TwinQ
from sb3_cure.cure.cure import CuRe
from sb3_cure.cure.pretraining import Pretraining
from sb3_cure.envs import check_observation_space
from sb3_cure.persistence import Persistence
from sb3_cure.vec_env import FiniteCheck, OverlappedVecEnv, check_environments


class ModelEnvironments(OffPolicyAlgorithm):
    """Wraps a model's environments, with SB3's hooks alone."""

    overlap: bool
    _overlapped: OverlappedVecEnv | None = None

    @staticmethod
    def _wrap_env(env: Any, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        check_observation_space(env.observation_space)
        return check_environments(OffPolicyAlgorithm._wrap_env(env, verbose, monitor_wrapper))

    def get_env(self) -> VecEnv | None:
        """Get the environments without the check around them.

        :return: Environments
        """
        return self.env.venv if isinstance(self.env, FiniteCheck) else self.env

    def _setup_model(self) -> None:
        check_observation_space(self.observation_space, self.policy_class)
        super()._setup_model()

    def _setup_learn(self, *args: Any, **kwargs: Any) -> tuple[int, BaseCallback]:
        told = (
            self.env.get_attr("action_repeat")[0] if self.env is not None and self.env.has_attr("action_repeat") else 1
        )
        self._action_repeat = told if isinstance(told, int) else 1
        return super()._setup_learn(*args, **kwargs)

    def _store_transition(self, buffer: Any, action: Any, new_obs: Any, reward: Any, dones: Any, infos: Any) -> None:
        if any("env_fault" in info for info in infos):
            getattr(buffer, "break_stream", lambda: None)()
            self._last_obs = new_obs
            if self._vec_normalize_env is not None:
                self._last_original_obs = self._vec_normalize_env.get_original_obs()
        else:
            super()._store_transition(buffer, action, new_obs, reward, dones, infos)

    def learn(self, *args: Any, **kwargs: Any) -> Any:
        """As in SB3, with environments that overlap with the updates if they are to."""
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
        super().dump_logs()

    def _before_checkpoint(self) -> None:
        if self._overlapped is not None:
            self._overlapped.finish()
        super()._before_checkpoint()  # type: ignore[misc]

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_overlapped"]


class CuReSAC(Pretraining, Persistence, ModelEnvironments, CuRe, SAC):  # type: ignore[misc]
    """Soft actor-critic from pixels, with state representation learning and a policy that seeks what it does badly.

    All arguments are described at ``CuRe``.
    """

    critics = TwinQ
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": policies.MlpPolicy,
        "CnnPolicy": policies.CnnPolicy,
        "MultiInputPolicy": policies.MultiInputPolicy,
    }
    plain_policies: ClassVar[dict[type[BasePolicy], type[BasePolicy]]] = {
        policies.MlpPolicy: sac_policies.MlpPolicy,
        policies.CnnPolicy: sac_policies.CnnPolicy,
        policies.MultiInputPolicy: sac_policies.MultiInputPolicy,
    }


class QuantileCnnPolicy(policies.CnnPolicy):
    """``CuRePolicy`` for images with critics of quantiles: ``policy_kwargs=dict(n_quantiles=25, n_critics=2)``."""

    critics = TruncatedQuantiles


class QuantileMlpPolicy(policies.MlpPolicy):
    """``CuRePolicy`` for vectors with critics of quantiles."""

    critics = TruncatedQuantiles


class QuantileMultiInputPolicy(policies.MultiInputPolicy):
    """``CuRePolicy`` for dictionaries with critics of quantiles."""

    critics = TruncatedQuantiles


class CuReTQC(Pretraining, Persistence, ModelEnvironments, CuRe, TQC):  # type: ignore[misc]
    """Truncated quantile critics from pixels, with state representation learning and a curious policy.

    All arguments are described at ``CuRe``; ``top_quantiles_to_drop_per_net`` is TQC's.
    """

    critics = TruncatedQuantiles
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": QuantileMlpPolicy,
        "CnnPolicy": QuantileCnnPolicy,
        "MultiInputPolicy": QuantileMultiInputPolicy,
    }
    plain_policies: ClassVar[dict[type[BasePolicy], type[BasePolicy]]] = {
        QuantileMlpPolicy: tqc_policies.MlpPolicy,
        QuantileCnnPolicy: tqc_policies.CnnPolicy,
        QuantileMultiInputPolicy: tqc_policies.MultiInputPolicy,
    }
