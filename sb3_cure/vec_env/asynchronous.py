"""Update the networks while worker processes step and render the environments."""

import contextlib
from collections.abc import Callable

import numpy as np
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn


class OverlappedVecEnv(VecEnvWrapper):
    """Does deferred work between the moment when actions are sent and the moment when results are fetched.

    :param venv: Environments in worker processes (``SubprocVecEnv``)
    :raises ValueError: if the environments live in this process, where nothing can overlap
    """

    def __init__(self, venv: VecEnv):
        if isinstance(venv.unwrapped, DummyVecEnv):
            raise ValueError(
                "overlap=True was given with environments in this process (DummyVecEnv), where stepping and updating "
                "cannot overlap: use make_vec_env(..., vec_env_cls=SubprocVecEnv), or overlap=False."
            )
        super().__init__(venv)
        self._work: list[Callable[[], None]] = []

    def defer(self, work: Callable[[], None]) -> None:
        """
        :param work: What to do during the next step
        """
        self._work.append(work)

    def finish(self) -> None:
        """Do now what is left."""
        work, self._work = self._work, []
        for each in work:
            each()

    def reset(self) -> VecEnvObs:
        """
        :return: First observations
        """
        return self.venv.reset()

    def step_async(self, actions: np.ndarray) -> None:
        """Send the actions, then work.

        :param actions: One per environment
        """
        self.venv.step_async(actions)
        try:
            self.finish()
        except BaseException:
            # Ctrl-C, say: the results under way must not be taken for those of a later step. Where they do not come, as
            # it has ended the workers, too, that is not what is to be told.
            with contextlib.suppress(Exception):
                self.venv.step_wait()
            raise

    def step_wait(self) -> VecEnvStepReturn:
        """
        :return: What the environments returned
        """
        return self.venv.step_wait()
