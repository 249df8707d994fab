"""Update the networks while worker processes step and render the environments."""

import contextlib
from collections.abc import Callable

import numpy as np
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn


class OverlappedVecEnv(VecEnvWrapper):
    """Does deferred work between sending actions and fetching their results.

    :param venv: Environments in worker processes (``SubprocVecEnv``)
    :raises ValueError: If the environments live in this process, where nothing can overlap
    """

    def __init__(self, venv: VecEnv) -> None:
        if isinstance(venv.unwrapped, DummyVecEnv):
            raise ValueError(
                "overlap=True needs environments in other processes: use make_vec_env(..., vec_env_cls=SubprocVecEnv), "
                "or overlap=False."
            )
        super().__init__(venv)
        self._work: list[Callable[[], None]] = []

    def defer(self, work: Callable[[], None]) -> None:
        """Do some work during the next step.

        :param work: A function
        """
        self._work.append(work)

    def finish(self) -> None:
        """Do the deferred work now, if it is not done yet."""
        work, self._work = self._work, []
        for each in work:
            each()

    def reset(self) -> VecEnvObs:
        """Reset the environments.

        :return: First observations
        """
        return self.venv.reset()

    def step_async(self, actions: np.ndarray) -> None:
        """Send the actions, then work.

        :param actions: Actions, [n_envs, ...]
        """
        self.venv.step_async(actions)
        try:
            self.finish()
        except BaseException:
            # After Ctrl-C, for example, these results must not be taken for those of a later step. Ignore errors here:
            # the original one is reported.
            with contextlib.suppress(Exception):
                self.venv.step_wait()
            raise

    def step_wait(self) -> VecEnvStepReturn:
        """Fetch the results.

        :return: What the environments return
        """
        return self.venv.step_wait()
