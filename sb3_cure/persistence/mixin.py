"""Saving, loading and exact resume for any of SB3's off-policy algorithms."""

from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, RolloutReturn

from sb3_cure.persistence.archive import SavesModels
from sb3_cure.persistence.checkpoints import MODEL, CheckpointWriter, load_checkpoint, newest_usable
from sb3_cure.persistence.env_state import load_statistics
from sb3_cure.persistence.replay_buffers import SavesReplayBuffers
from sb3_cure.persistence.resume import Resumption, Run, watch

Self = TypeVar("Self", bound="Persistence")


class Persistence(SavesModels, SavesReplayBuffers):
    """Mixin for an algorithm of SB3: ``class MySAC(Persistence, SAC)``.

    Models are saved as JSON and safetensors, replay buffers as safetensors; loading runs no code of a file and imports
    nothing that it names. With ``ExactCheckpoint`` as a callback, ``resume`` goes on with a training that was killed.
    """

    #: What the running ``learn`` is to checkpoints: a call of this name
    _call_name = "learn"

    @cached_property
    def _run(self) -> Run:
        """What the model knows of the training that it is in, beside what it saves."""
        return Run()

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_run", "_call_name"]

    def _before_checkpoint(self) -> None:
        """Finish what is under way, and raise if the model must not be kept."""
        getattr(super(), "_before_checkpoint", lambda: None)()

    @classmethod
    def resume(
        cls: type[Self],
        path: str | Path,
        env: GymEnv | str,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        **kwargs: Any,
    ) -> Self:
        """Go on with a training that was killed, from the newest whole checkpoint of ``ExactCheckpoint``.

        The same calls of ``learn`` (and ``pretrain``) as before, with the same numbers of timesteps and the same
        callbacks, then do what was left: those that were over are skipped, so that a script can be started again as it
        is. A single ``learn(n, reset_num_timesteps=False)`` means n more steps, as everywhere in SB3, unless the
        training's first call did not reset them either. Log files are gone on with where ``set_logger`` is called as
        before.

        :param path: Folder of the checkpoints
        :param env: Environments as those before: as many, of the same settings
        :param device: Where to compute
        :param custom_objects: What the checkpoint cannot hold (a head of your own, a schedule), as for ``load``
        :param kwargs: Settings to change; training then no longer equals the one before
        :return: The model
        :raises CheckpointError: if there is no whole checkpoint, or the environments do not fit
        """
        generation, lost = newest_usable(path)
        model = cls.load(generation.folder / MODEL, env, device, custom_objects, force_reset=False, **kwargs)
        assert model.env is not None, "resume needs the environments of the training"
        state = load_checkpoint(model, generation, lost)
        writer = CheckpointWriter(path)
        if not lost:
            writer.continue_from(generation, state, model.replay_buffer)
        run = model._run
        run.writers[Path(path).resolve()] = writer
        run.calls, run.done = state["calls"][:-1], state["calls"][:-1]
        run.began_anew = state["began_anew"]
        if state["environments"] is None:
            # The interrupted episode cannot be gone on with; other first states than those that this run has seen.
            model._last_obs = None
            model.env.seed(None if model.seed is None else (model.seed + model.num_timesteps) % 2**31)
            load_statistics(model.env, state["statistics"])
        run.resumed = Resumption(generation.folder, state, model, model._stateful_parts())
        if model.verbose >= 1:
            print(f"Resumed from {generation.folder}, after {model.num_timesteps} agent steps")
        return model

    def learn(
        self: Self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "run",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> Self:
        """As in SB3; after ``resume``, what was left of the interrupted call."""
        if self._was_over(self._call_name, reset_num_timesteps):
            return self
        with self._run.calling(self._call_name, reset_num_timesteps):
            super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)
            self._restore_rest()  # where nothing was left to do
        return self

    def _was_over(self, call: str, counts_anew: bool) -> bool:
        """Whether the checkpoint that was resumed from was taken after this call of a script that is run again."""
        return self._run.skips(call, counts_anew)

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        run, resumed = self._run, self._run.resumed
        # Whether this is the interrupted call, made again, whose total is meant
        continues = run.is_made_again(reset_num_timesteps)
        if resumed is not None:
            reset_num_timesteps = False
            total_timesteps += resumed.started_at - self.num_timesteps if continues else 0
        total, callback = super()._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
        )
        run.watched = watch(callback)
        if resumed is not None:
            resumed.set_up(self, run.watched, continues)
        return total, callback

    def collect_rollouts(self, *args: Any, **kwargs: Any) -> RolloutReturn:
        """
        :param args: As of SB3's ``collect_rollouts``
        :param kwargs: The same
        :return: What was collected
        """
        self._restore_rest()
        for look in self._run.before_rollout:
            look()
        return super().collect_rollouts(*args, **kwargs)

    def _restore_rest(self) -> None:
        """Of a resumed training, what has to be the last before the next step."""
        resumed, self._run.resumed = self._run.resumed, None
        if resumed is not None:
            resumed.enter(self, self._stateful_parts())
