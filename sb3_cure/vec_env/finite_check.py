"""Check everything that environments return, and the actions that they get."""

import contextlib
import copy
from collections.abc import Iterator
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecNormalize, unwrap_vec_wrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from sb3_cure.data.observations import first_not_finite


class BadTransitionError(ValueError):
    """A reward, an observation or an action is not finite; it was neither returned nor executed."""


class FiniteCheck(VecEnvWrapper):
    """Raises an error for numbers that are not finite in float32, in which rewards are stored and networks compute.

    It checks observations of resets and steps, rewards, terminal observations and actions, and with
    ``VecNormalize`` also the values that it normalizes, as it may clip them. Returned observations are copies, as
    environments may reuse their arrays.

    :param venv: Environments
    """

    def __init__(self, venv: VecEnv) -> None:
        super().__init__(venv)
        #: Agent steps so far, of all environments together
        self.n_steps = 0
        self._normalizer = unwrap_vec_wrapper(venv, VecNormalize)

    def reset(self) -> VecEnvObs:
        """Reset the environments.

        :return: Copy of the first observations
        :raises BadTransitionError: If one is not finite
        """
        with self._checking_originals():
            return copy.deepcopy(self._reset(self.venv, self._normalizer is not None))

    def step_async(self, actions: np.ndarray) -> None:
        """Send actions.

        :param actions: Actions, [n_envs, ...]
        :raises BadTransitionError: If one is not finite; none is executed then
        """
        if (found := first_not_finite(actions)) is not None:
            raise BadTransitionError(
                f"the agent chose the action {actions[found[0]]} for environment {found[0]} at agent step "
                f"{self.n_steps}, but actions must be finite: check action_noise and the policy's parameters."
            )
        self.venv.step_async(actions)

    def step_wait(self) -> VecEnvStepReturn:
        """Get the results of a step.

        :return: Copy of the observations, rewards, dones and infos
        :raises BadTransitionError: If a number is not finite
        """
        self.n_steps += self.num_envs
        with self._checking_originals():
            observations, rewards, dones, infos = self._step_wait(self.venv, self._normalizer is not None)
        return copy.deepcopy(observations), rewards, dones, infos

    @contextlib.contextmanager
    def _checking_originals(self) -> Iterator[None]:
        """Apply the same checks to what ``VecNormalize`` normalizes."""
        if self._normalizer is None:
            yield
            return
        # Only for this call: SB3 compares the wrappers of training and evaluation one by one.
        venv = self._normalizer.venv
        self._normalizer.venv = _Originals(venv, self)  # type: ignore[assignment]
        try:
            yield
        finally:
            self._normalizer.venv = venv

    def _reset(self, venv: VecEnv, is_normalized: bool) -> VecEnvObs:
        observations = venv.reset()
        self._check("first observation", observations, is_normalized)
        return observations

    def _step_wait(self, venv: VecEnv, is_normalized: bool) -> VecEnvStepReturn:
        observations, rewards, dones, infos = venv.step_wait()
        if rewards.dtype == object:  # a worker process returned None
            rewards = rewards.astype(np.float32)
        self._check("reward", rewards, is_normalized)
        for i in map(int, np.flatnonzero(dones)):
            terminal = self._as_row(infos[i].get("terminal_observation"))
            self._check("terminal observation", terminal, is_normalized, index=i)
        self._check("observation", observations, is_normalized)
        return observations, rewards, dones, infos

    def _as_row(self, observation: Any) -> Any:
        """Add the dimension of environments; keys that are not in the space are left out, as they are not stored."""
        if isinstance(observation, dict):
            return {key: np.asarray(observation[key])[None] for key in self.observation_space}  # type: ignore[attr-defined]
        return np.zeros(0) if observation is None else np.asarray(observation)[None]

    def _check(self, kind: str, values: Any, is_normalized: bool, index: int | None = None) -> None:
        if (found := first_not_finite(values)) is None:
            return
        row, key, number = found
        source = "VecNormalize made" if is_normalized else f"environment {row if index is None else index} returned"
        fix = "load or make a new VecNormalize, as its statistics are not finite" if is_normalized else "fix it"
        raise BadTransitionError(
            f"{source} {number} in the {kind}{f' {key!r}' if key else ''} at agent step {self.n_steps}, but numbers "
            f"must be finite in float32: nothing of this step was stored; {fix}."
        )


class _Originals:
    """The environments under a ``VecNormalize``, checked by the ``FiniteCheck`` around it."""

    def __init__(self, venv: VecEnv, check: FiniteCheck) -> None:
        self._venv, self._finite_check = venv, check

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):  # looked up while it is copied, before it has attributes
            raise AttributeError(name)
        return getattr(self._venv, name)

    def reset(self) -> VecEnvObs:
        return self._finite_check._reset(self._venv, False)

    def step_wait(self) -> VecEnvStepReturn:
        return self._finite_check._step_wait(self._venv, False)
