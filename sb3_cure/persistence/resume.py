"""What a training depends on besides the model and its replay buffer, and how a resumed model gets it back."""

import copy
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_cure.persistence.callback_state import callback_state, load_callback_state
from sb3_cure.persistence.env_state import load_random_streams, load_vec_env_state, random_streams, vec_env_state

#: Attributes of SB3's logger
_RECORDS = ("name_to_value", "name_to_count", "name_to_excluded")


class Run:
    """A model's running training, which archives do not hold."""

    def __init__(self) -> None:
        #: Writers of checkpoints by folder
        self.writers: dict[Path, Any] = {}
        #: What a resumed model has yet to restore
        self.resumed: Resumption | None = None
        #: All callbacks of the running ``learn``
        self.callbacks: list[BaseCallback] = []


def training_state(model: OffPolicyAlgorithm, run: Run) -> dict[str, Any]:
    """Get what training depends on besides what ``save`` and the replay buffer hold.

    :param model: Model between an update and the next step of the environments
    :param run: Its training
    :return: Values that ``encode`` knows
    """
    assert model.env is not None
    return {
        # Before the random streams, because this may replace a dead worker, which may draw from them
        "environments": vec_env_state(model.env),
        "callbacks": [callback_state(callback) for callback in run.callbacks],
        "recorded": _recorded(model.logger),
        "elapsed": time.time_ns() - model.start_time,
        "random": random_state(model),
    }


def _recorded(logger: Logger) -> dict[str, Any]:
    """List what was recorded and not yet logged, which callbacks may read."""
    kinds = bool | int | float | str | np.number | th.Tensor
    plain = {key for key, value in logger.name_to_value.items() if isinstance(value, kinds)}
    return {name: {k: v for k, v in getattr(logger, name).items() if k in plain} for name in _RECORDS}


def random_state(model: OffPolicyAlgorithm) -> dict[str, Any]:
    """Get the states of all generators that a model draws from, except those of its parts and environments.

    :param model: Model
    :return: Values that ``encode`` knows
    """
    cuda = th.cuda.get_rng_state(model.device) if model.device.type == "cuda" else None
    return {**random_streams(), "cuda": cuda, "action_space": model.action_space.np_random.bit_generator.state}


def load_random_state(model: OffPolicyAlgorithm, state: dict[str, Any]) -> None:
    """Set the generators of ``random_state``.

    :param model: Model
    :param state: Result of ``random_state``
    """
    load_random_streams(state)
    if state["cuda"] is not None and model.device.type == "cuda":
        th.cuda.set_rng_state(state["cuda"], model.device)
    model.action_space.np_random.bit_generator.state = state["action_space"]


class Resumption:
    """What a resumed model restores: environments at once, callbacks when ``learn`` begins, random streams last of all.

    :param model: Model as it was saved, with its new environments
    :param state: Result of ``training_state``
    :raises ValueError: if the environments have other layers
    """

    def __init__(self, model: OffPolicyAlgorithm, state: dict[str, Any]):
        assert model.env is not None
        self.state, self.num_timesteps = state, model.num_timesteps
        # What SB3's set-up of `learn` changes
        self.num_timesteps_at_start = model._num_timesteps_at_start
        self._action_noise = copy.deepcopy(model.action_noise)
        #: Whether the resumed ``learn`` had nothing left to do
        self.is_over = False
        #: Why a new episode begins, or None
        self.restore_error = load_vec_env_state(model.env, state["environments"])
        if self.restore_error is not None:
            model._last_obs = None
            # A new seed, or the episodes would start from the same states as at the beginning of this training.
            model.env.seed(None if model.seed is None else (model.seed + model.num_timesteps) % 2**31)

    def set_up(self, model: OffPolicyAlgorithm, callbacks: list[BaseCallback], continues: bool) -> None:
        """Restore callbacks, and what SB3's set-up has reset.

        :param model: Model at the end of its ``_setup_learn``
        :param callbacks: All callbacks
        :param continues: Whether this is the interrupted call of ``learn``
        """
        model.action_noise = copy.deepcopy(self._action_noise)
        if continues:
            model._num_timesteps_at_start = self.num_timesteps_at_start
            model.start_time -= self.state["elapsed"]  # SB3's fps also counts the earlier steps
        for name, values in self.state["recorded"].items():
            getattr(model.logger, name).update(values)
        saved = list(self.state["callbacks"])
        for callback in callbacks:
            own = next((each for each in saved if each["class"] == type(callback).__name__), None)
            if own is not None:
                saved.remove(own)
                load_callback_state(callback, own)
