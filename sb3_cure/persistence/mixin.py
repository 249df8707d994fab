"""Saving, loading and exact resume for any of SB3's off-policy algorithms."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any, TypeVar

import torch as th
from stable_baselines3.common.base_class import maybe_make_env
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, RolloutReturn

from sb3_cure.buffers import FrameStackReplayBuffer
from sb3_cure.persistence.archive import (
    Stateful,
    is_pickled_model,
    lay_out_moments,
    load_model,
    read_parameters,
    save_model,
)
from sb3_cure.persistence.buffers import buffer_state, can_be_kept, load_buffer
from sb3_cure.persistence.checkpoints import MODEL, CheckpointWriter, load_checkpoint, newest_usable
from sb3_cure.persistence.encoding import ArchiveError, is_state, write_state
from sb3_cure.persistence.files import PathOrFile, reading, writing
from sb3_cure.persistence.resume import Resumption, Run, watch

Self = TypeVar("Self", bound="Persistence")


class Persistence(OffPolicyAlgorithm):
    """Mixin for an algorithm of SB3: ``class MySAC(Persistence, SAC)``.

    Models are saved as JSON and safetensors, replay buffers as safetensors; loading runs no code of a file and imports
    nothing that it names. With ``ExactCheckpoint`` as a callback, ``resume`` goes on with a training that was killed.
    """

    _run: Run
    #: What the running ``learn`` is to checkpoints: a call of this name
    _call_name = "learn"

    def __init__(self, *args: Any, **kwargs: Any):
        self._run = Run()
        super().__init__(*args, **kwargs)

    # ------------------------------------------------------------- what an algorithm may say of itself

    def _stateful_parts(self) -> dict[str, Stateful]:
        """Objects with a state beside tensors and settings, such as a generator, by name: saved and resumed."""
        return {}

    def _before_checkpoint(self) -> None:
        """Finish what is under way, and raise if the model must not be kept."""

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "lr_schedule", "_run", "_call_name"]

    # ----------------------------------------------------------------------------------------- models

    def save(
        self, path: PathOrFile, exclude: Iterable[str] | None = None, include: Iterable[str] | None = None
    ) -> None:
        """Save networks, optimisers and settings, without pickle; a file at the path is replaced once this is whole.

        What is no data (a function as ``learning_rate``, a class of your own) is saved as a placeholder that tells what
        it was, and ``load`` asks for it as ``custom_objects``.

        :param path: Path, whose folder is made and which gets the suffix ``.zip`` if it has none, or a binary file
        :param exclude: Names of settings that are not to be saved
        :param include: As in SB3; an archive holds everything but parts of the running model, so that this is refused
        :raises ValueError: if ``include`` names parts of the running model
        """
        save_model(self, self._stateful_parts(), path, exclude, include)

    @classmethod
    def load(  # type: ignore[override]
        cls: type[Self],
        path: PathOrFile,
        env: GymEnv | str | None = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        *,
        trusted: bool = False,
        **kwargs: Any,
    ) -> Self:
        """Load a model, also one from a stranger: no code that an archive holds is run, and nothing that it names is
        imported. (Settings may still ask for more memory than there is.)

        :param path: Path with or without its suffix ``.zip``, or a binary file
        :param env: Environment, vectorised environment or Gymnasium id to go on learning in; not needed to predict
        :param device: Device of the networks
        :param custom_objects: Settings to replace by name; needed for what archives do not hold, for example
            ``{"srl": MyHead}``, or ``{"policy_kwargs": {...}}`` where something in it is not data. Names that the
            archive does not have are ignored
        :param print_system_info: Whether to print of which system the model was saved, and of this one
        :param force_reset: Whether to reset the environment before learning goes on
        :param trusted: Also load what SB3's ``save`` has pickled, which runs any code in it
        :param kwargs: Settings to change
        :return: The model
        :raises ArchiveError: (a ``ValueError``) if the file is damaged, hostile or pickled
        """
        env = maybe_make_env(env, kwargs.get("verbose", 0))  # type: ignore[arg-type]
        if trusted and is_pickled_model(path):
            return super().load(path, env, device, custom_objects, print_system_info, force_reset, **kwargs)
        model, states = load_model(
            cls,
            path,
            env,  # type: ignore[arg-type]
            device,
            custom_objects,
            print_system_info,
            force_reset,
            kwargs,
        )
        for name, part in model._stateful_parts().items():
            if name in states:
                part.load_state_dict(states[name])
        return model

    def set_parameters(
        self,
        load_path_or_dict: Any,
        exact_match: bool = True,
        device: th.device | str = "auto",
    ) -> None:
        """Load parameters into this model. Of a file only the tensors are read, so that pickled archives are safe, too.

        :param load_path_or_dict: An archive's path or file, or state dicts by name (see ``get_parameters``)
        :param exact_match: Whether all of the model's parameters have to be there, and no others
        :param device: As in SB3; the parameters stay on the model's device
        """
        if not isinstance(load_path_or_dict, dict):
            load_path_or_dict = read_parameters(load_path_or_dict) or load_path_or_dict
        try:
            super().set_parameters(load_path_or_dict, exact_match, device)
        finally:
            lay_out_moments(self)

    # --------------------------------------------------------------------------------- replay buffers

    def save_replay_buffer(self, path: PathOrFile) -> None:
        """Save the used part of the replay buffer, without pickle and without a copy in memory.

        Buffers of classes that this package does not know, and ``HerReplayBuffer``, are pickled, as SB3 does.

        :param path: Path, whose folder is made and which gets the suffix ``.pkl`` if it has none, or a binary file
        """
        assert self.replay_buffer is not None, "The replay buffer is not defined"
        if not can_be_kept(type(self.replay_buffer)):
            return super().save_replay_buffer(path)
        with writing(path, "pkl") as file:
            write_state(file, buffer_state(self.replay_buffer))

    def load_replay_buffer(self, path: PathOrFile, truncate_last_traj: bool = True, *, trusted: bool = False) -> None:
        """Load a replay buffer, also one from a stranger.

        :param path: Path with or without its suffix ``.pkl``, or a binary file
        :param truncate_last_traj: For ``HerReplayBuffer``, as in SB3
        :param trusted: Also load what is pickled, which runs any code in it
        :raises ArchiveError: (a ``ValueError``) if the file is damaged, hostile, pickled, or does not fit the model
        """
        with reading(path, "pkl") as (file, name):
            if is_state(file):
                file.seek(0)
                self.replay_buffer = load_buffer(self, file if name == "the file" else Path(file.name), name)
                return
        if not trusted:
            raise ArchiveError(
                f"{name} is no replay buffer that was saved without pickle, and unpickling runs any code that is in a "
                "file: if you know where it comes from, load it with trusted=True."
            )
        super().load_replay_buffer(path, truncate_last_traj)

    # ------------------------------------------------------------------------------------------ resume

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
        is. A single ``learn(n, reset_num_timesteps=False)`` means n more steps, as everywhere in SB3. Log files are
        gone on with where ``set_logger`` is called as before.

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
        if not lost and isinstance(model.replay_buffer, FrameStackReplayBuffer):
            writer.continue_from(generation, state, model.replay_buffer)
        run = model._run
        run.writers[Path(path).resolve()] = writer
        run.calls, run.done = state["calls"][:-1], state["calls"][:-1]
        if state["environments"] is None:
            # The interrupted episode cannot be gone on with; other first states than those that this run has seen.
            model._last_obs = None
            model.env.seed(None if model.seed is None else (model.seed + model.num_timesteps) % 2**31)
        run.resumed = Resumption(generation.folder, state, model, model._stateful_parts())
        if model.verbose >= 1:
            print(f"Resumed from {generation.folder}, after {model.num_timesteps} agent steps")
        return model

    def learn(self: Self, *args: Any, **kwargs: Any) -> Self:
        """
        :param args: As of SB3's ``learn``
        :param kwargs: The same
        :return: self
        """
        if self._run.skips(self._call_name):
            return self
        with self._run.calling(self._call_name):
            super().learn(*args, **kwargs)
            self._restore_rest()  # where nothing was left to do
        return self

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
        continues = resumed is not None and (reset_num_timesteps or run.replays)
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
