"""Saving, loading and exact resume for any of SB3's off-policy algorithms."""

import copy
import warnings
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, RolloutReturn
from stable_baselines3.common.vec_env import VecEnvWrapper

from sb3_cure.persistence.archive import SavesModels
from sb3_cure.persistence.callback_state import nested_callbacks, note_contents
from sb3_cure.persistence.checkpoints import MODEL, CheckpointFolder, ExactCheckpoint
from sb3_cure.persistence.replay_buffers import SavesReplayBuffers
from sb3_cure.persistence.resume import Resumption, Run, load_random_state

Self = TypeVar("Self", bound="Persistence")


class Persistence(SavesModels, SavesReplayBuffers):
    """Mixin for an algorithm of SB3: ``class MySAC(Persistence, SAC)``.

    Models are saved as JSON and safetensors, replay buffers as safetensors; loading runs no code of a file and imports
    nothing that it names. With ``ExactCheckpoint`` as a callback, ``resume`` continues a training that was killed.
    """

    @cached_property
    def _run(self) -> Run:
        return Run()

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_run"]

    def __deepcopy__(self: Self, memo: dict[int, Any]) -> Self:
        """Copy the model with its environments and replay buffer, for population-based training.

        The logger is shared, as its open files cannot be copied: until the copy's next ``learn`` makes a new one or, if
        it was set by ``set_logger``, until the copy is given another.
        """
        if "_logger" in vars(self):
            memo[id(self._logger)] = self._logger
        wrappers, env = [], self.env
        while isinstance(env, VecEnvWrapper):
            wrappers.append(env)
            env = env.venv
        # `VecEnvWrapper.class_attributes` cannot be copied.
        for wrapper in reversed(wrappers):
            _copy_attributes(wrapper, "class_attributes", memo)
            vars(memo[id(wrapper)])["class_attributes"] = wrapper.class_attributes
        return _copy_attributes(self, "_run", memo)

    @classmethod
    def resume(
        cls: type[Self],
        path: str | Path,
        env: GymEnv | str,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        **kwargs: Any,
    ) -> Self:
        """Continue a killed training from the newest whole checkpoint of ``ExactCheckpoint``.

        The next ``learn(total)``, with the total and the callbacks of the interrupted call, completes that call;
        ``learn(n, reset_num_timesteps=False)`` makes n more steps, as everywhere in SB3. Environments whose state could
        not be kept begin a new episode, with a warning. Do not use them between ``resume`` and ``learn``.

        :param path: Folder of the checkpoints
        :param env: As many environments as before, built in the same way. Their classes and ids are compared, their
            arguments are not
        :param device: Device of the networks
        :param custom_objects: What the checkpoint cannot hold (a head of your own, a schedule), as for ``load``
        :param kwargs: Settings to change; training then no longer equals the one before. (``buffer_size`` cannot be
            changed, as the saved replay buffer keeps its size)
        :return: The model
        :raises ArchiveError: if there is no whole checkpoint, or another number of environments
        :raises ValueError: if the environments have other layers, or another id
        """
        writer = CheckpointFolder(path)
        folder = writer.generations.newest_whole()
        model = cls.load(folder / MODEL, env, device, custom_objects, force_reset=False, **kwargs)
        state = writer.read(model, folder)
        run = model._run
        run.writers[Path(path).resolve()] = writer
        run.resumed = Resumption(model, state)
        if run.resumed.restore_error is not None:
            warnings.warn(
                f"the training begins a new episode, as {run.resumed.restore_error}; what was set on the environments "
                "while training is lost.",
                stacklevel=2,
            )
        if model.verbose >= 1:
            print(f"Resumed from {folder}, after {model.num_timesteps} agent steps")
        return model

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        run = self._run
        resumed = run.resumed
        # The resumed call had nothing left to do, or was a pretraining, which has ended: this one goes on after it.
        if resumed is not None and (resumed.is_over or resumed.num_timesteps != self.num_timesteps):
            load_random_state(self, resumed.state["random"])
            resumed = run.resumed = None
        continues = resumed is not None and reset_num_timesteps
        if resumed is not None and continues:
            total_timesteps += resumed.num_timesteps_at_start - resumed.num_timesteps  # what is left, maybe nothing
            reset_num_timesteps = False
        total, callback = super()._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
        )
        run.callbacks = nested_callbacks(callback)
        for each in run.callbacks:
            note_contents(each)
        if resumed is not None:
            resumed.set_up(self, run.callbacks, continues)
            resumed.is_over = self.num_timesteps >= total
            if resumed.is_over:
                warnings.warn(
                    f"this call trains nothing: the resumed training had already made its {self.num_timesteps} agent "
                    "steps. The next learn() starts a new call.",
                    stacklevel=5,
                )
        return total, callback

    def collect_rollouts(self, *args: Any, **kwargs: Any) -> RolloutReturn:
        """Collect as in SB3; before that write checkpoints, and continue the random streams of a resumed training.

        :param args: Arguments of SB3's ``collect_rollouts``
        :param kwargs: The same
        :return: What was collected
        """
        resumed, self._run.resumed = self._run.resumed, None
        if resumed is not None:  # last of all, so that nothing can disturb them
            load_random_state(self, resumed.state["random"])
        for callback in self._run.callbacks:
            if isinstance(callback, ExactCheckpoint):
                callback.save_if_due()
        return super().collect_rollouts(*args, **kwargs)


def _copy_attributes(original: Any, left_out: str, memo: dict[int, Any]) -> Any:
    memo[id(original)] = twin = object.__new__(type(original))
    vars(twin).update({k: copy.deepcopy(value, memo) for k, value in vars(original).items() if k != left_out})
    return twin
