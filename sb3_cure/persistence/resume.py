"""What training depends on beside the model and its replay buffer, kept in checkpoints and given back later."""

import contextlib
import copy
import io
import json
import random
import shutil
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import (
    CSVOutputFormat,
    HumanOutputFormat,
    JSONOutputFormat,
    KVWriter,
    Logger,
    TensorBoardOutputFormat,
)
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_cure.persistence.archive import Stateful
from sb3_cure.persistence.encoding import encode, write_tensors
from sb3_cure.persistence.env_state import load_vec_env_state, statistics_state, vec_env_state


class Run:
    """What a model knows of the training that it is in, beside what it saves."""

    def __init__(self) -> None:
        #: Writers of checkpoints by folder
        self.writers: dict[Path, Any] = {}
        #: What a resumed model has yet to restore
        self.resumed: Resumption | None = None
        #: Callbacks of the running ``learn``
        self.watched: list[BaseCallback] = []
        #: Called before each rollout, between an update and the next step
        self.before_rollout: list[Callable[[], None]] = []
        #: What is to be undone when the running ``learn`` ends
        self.leaving = contextlib.ExitStack()
        #: Calls of ``learn`` and ``pretrain`` so far, the running one last
        self.calls: list[str] = []
        #: Whether the first of them counted steps anew, as its ``reset_num_timesteps`` says
        self.began_anew = True
        #: Of these, calls that were over when the checkpoint was taken, and that the script will make again
        self.done: list[str] = []
        #: Whether the script has made one of those again, so that its next call is the interrupted one
        self.replays = False

    def is_made_again(self, counts_anew: bool) -> bool:
        """
        :param counts_anew: ``reset_num_timesteps`` of the first call after ``resume``, or of one after it
        :return: Whether it is a call of the script that is run again: these begin as they did. Else it asks for more
            steps
        """
        return self.resumed is not None and (self.replays or counts_anew or not self.began_anew)

    def skips(self, call: str, counts_anew: bool) -> bool:
        """
        :param call: ``"learn"`` or ``"pretrain"``, which is being called
        :param counts_anew: Its ``reset_num_timesteps``
        :return: Whether the checkpoint that was resumed from was taken after it
        """
        if self.is_made_again(counts_anew) and self.done[:1] == [call]:
            self.done.pop(0)
            self.replays = True
            print(f"{call} number {len(self.calls) - len(self.done)} of this training was over: skipped")
            return True
        self.done = []
        return False

    @contextlib.contextmanager
    def calling(self, call: str, counts_anew: bool = True) -> Iterator[None]:
        """The running call.

        :param call: ``"learn"`` or ``"pretrain"``
        :param counts_anew: Its ``reset_num_timesteps``
        """
        if not self.calls and self.resumed is None:
            self.began_anew = counts_anew
        self.calls.append(call)
        try:
            with self.leaving:
                yield
        except BaseException:
            self.calls.pop()
            raise
        finally:
            self.watched, self.before_rollout = [], []


def training_state(model: OffPolicyAlgorithm, run: Run, environments_may_be_gone: bool = False) -> dict[str, Any]:
    """
    :param model: The model, between an update and the next step of the environments
    :param run: What it knows of its training
    :param environments_may_be_gone: Whether to do without the environments' state if they do not answer
    :return: What training depends on, beside what ``save`` and the replay buffer hold
    """
    assert model.env is not None
    answers = True
    try:
        environments = vec_env_state(model.env)
    except (OSError, EOFError, RuntimeError) as error:
        if not environments_may_be_gone:
            raise RuntimeError(f"the environments do not tell their state ({error or type(error).__name__})") from error
        environments, answers = None, False
    return {
        "num_timesteps": model.num_timesteps,
        "calls": list(run.calls),
        "began_anew": run.began_anew,
        "n_envs": model.n_envs,
        "random": random_state(model),
        "environments": environments,
        # If that is not there, what networks and replay buffer are used to
        "statistics": None if environments is not None else statistics_state(model.env, answers),
        "logger": _logger_state(model.logger),
        "callbacks": [[type(callback).__name__, _changed(callback)] for callback in run.watched],
    }


class Resumption:
    """What is left to restore when a resumed model learns on.

    :param folder: The checkpoint
    :param state: Its training state
    :param model: The model as it was saved
    :param parts: Its parts with a state
    """

    def __init__(self, folder: Path, state: dict[str, Any], model: OffPolicyAlgorithm, parts: dict[str, Stateful]):
        self.folder, self.state = folder, state
        self._last = ("_last_obs", "_last_episode_starts", "_last_original_obs")
        kept = (*self._last, "_num_timesteps_at_start", "action_noise")
        self._kept = {name: copy.deepcopy(getattr(model, name)) for name in kept}
        self._parts = {name: copy.deepcopy(part.state_dict()) for name, part in parts.items()}

    @property
    def started_at(self) -> int:
        """Agent steps at which the interrupted call began."""
        return self._kept["_num_timesteps_at_start"]

    def set_up(self, model: OffPolicyAlgorithm, watched: list[BaseCallback], continues: bool) -> None:
        """Attributes of callbacks, files of the logger and what was not yet logged.

        :param model: The model, at the end of its ``_setup_learn``
        :param watched: The callbacks
        :param continues: Whether it goes on with the interrupted call
        """
        model.action_noise = self._kept["action_noise"]  # which `learn` has begun anew
        if continues:
            model._num_timesteps_at_start = self.started_at
        saved = list(self.state["callbacks"])
        for callback in watched:
            entry = next((entry for entry in saved if entry[0] == type(callback).__name__), None)
            if entry is not None:
                saved.remove(entry)
                _restore_callback(callback, entry[1])
        _continue_logs(model, self.folder, self.state["logger"])

    def enter(self, model: OffPolicyAlgorithm, parts: dict[str, Stateful]) -> None:
        """Environments, parts and random streams, last of all, so that nothing can disturb them.

        :param model: The model, before its next step
        :param parts: Its parts with a state
        """
        assert model.env is not None
        if self.state["environments"] is not None:
            load_vec_env_state(model.env, self.state["environments"])
            for name in self._last:
                setattr(model, name, self._kept[name])
        for name, part in parts.items():
            part.load_state_dict(self._parts[name])
        load_random_state(model, self.state["random"])


# ------------------------------------------------------------------------------------------ random numbers


def random_state(model: OffPolicyAlgorithm) -> dict[str, Any]:
    """
    :param model: The model
    :return: States of all generators that its training draws from, but those of its parts and environments
    """
    return {
        "python": random.getstate(),
        "numpy": np.random.get_state(),
        "torch": th.get_rng_state(),
        "cuda": th.cuda.get_rng_state_all() if model.device.type == "cuda" else [],
        "action_space": model.action_space.np_random.bit_generator.state,
    }


def load_random_state(model: OffPolicyAlgorithm, state: dict[str, Any]) -> None:
    """
    :param model: The model
    :param state: Of ``random_state``
    """
    random.setstate(state["python"])
    np.random.set_state(state["numpy"])
    th.set_rng_state(state["torch"])
    if state["cuda"] and model.device.type == "cuda":
        th.cuda.set_rng_state_all(state["cuda"])
    model.action_space.np_random.bit_generator.state = state["action_space"]


# --------------------------------------------------------------------------------------------------- logger


def log_files(logger: Logger) -> list[Any]:
    """
    :param logger: SB3's logger
    :return: Its outputs that write to a file of their own
    """
    kinds = (CSVOutputFormat, JSONOutputFormat, HumanOutputFormat)
    outputs: list[KVWriter] = [output for output in logger.output_formats if isinstance(output, kinds)]
    return [output for output in outputs if getattr(output, "own_file", True)]


def _logger_state(logger: Logger) -> dict[str, Any]:
    """What was recorded and not yet written, and which files there are; their content is copied beside."""
    recorded = {
        key: [value, logger.name_to_count.get(key), logger.name_to_excluded[key]]
        for key, value in logger.name_to_value.items()
        if isinstance(value, bool | int | float | str | np.number | th.Tensor)
    }
    files = []
    for output in log_files(logger):
        output.file.flush()
        files.append([Path(output.file.name).name, list(getattr(output, "keys", []))])
    boards = [each for each in logger.output_formats if isinstance(each, TensorBoardOutputFormat)]
    return {"recorded": recorded, "files": files, "boards": [Path(board.writer.log_dir).name for board in boards]}


def _continue_logs(model: OffPolicyAlgorithm, folder: Path, state: dict[str, Any]) -> None:
    """Files that the logger has open become what those of the same name were; what came after is dropped."""
    logger = model.logger
    for key, (value, count, excluded) in state["recorded"].items():
        logger.name_to_value[key] = value
        logger.name_to_excluded[key] = excluded
        if count is not None:
            logger.name_to_count[key] = count
    outputs = {Path(output.file.name).name: output for output in log_files(logger)}
    for number, (name, keys) in enumerate(state["files"]):
        output = outputs.get(name)
        if output is None:
            warnings.warn(
                f"the training that is resumed wrote the log {name}, which nothing goes on with: before learn, call "
                "set_logger as it did.",
                stacklevel=4,
            )
            continue
        output.file.seek(0)
        output.file.truncate()
        with (folder / f"log-{number}").open("rb") as content:
            shutil.copyfileobj(content, output.file.buffer)
        output.file.seek(0, io.SEEK_END)
        if isinstance(output, CSVOutputFormat):
            output.keys = keys
    boards = [output for output in logger.output_formats if isinstance(output, TensorBoardOutputFormat)]
    for board, name in zip(boards, state["boards"], strict=False):
        from torch.utils.tensorboard import SummaryWriter

        # The folder of the killed run, beside that which SB3 has chosen, if it is there.
        run_folder = Path(board.writer.log_dir).parent / Path(name).name
        if run_folder.is_dir():
            board.writer.close()
            board.writer = SummaryWriter(log_dir=str(run_folder), purge_step=model.num_timesteps + 1)


# ------------------------------------------------------------------------------------------------ callbacks

#: Where a callback keeps what its attributes were before its first ``learn``
_AT_FIRST = "_sb3_cure_at_first"


def watch(callback: BaseCallback) -> list[BaseCallback]:
    """
    :param callback: The callback of a ``learn`` that begins
    :return: All callbacks in it, to see later what has changed in them
    """
    callbacks = _walk(callback)
    for each in callbacks:
        # A callback may serve several calls, of which those that are over will be skipped.
        if not hasattr(each, _AT_FIRST):
            setattr(each, _AT_FIRST, {name: content for name, (_, content) in _attributes(each).items()})
    return callbacks


def _walk(callback: BaseCallback) -> list[BaseCallback]:
    """The callback and those inside it, in a fixed order."""
    # `callback_on_new_best` is of SB3's EvalCallback.
    single = [getattr(callback, name, None) for name in ("callback", "callback_on_new_best")]
    inside = [*getattr(callback, "callbacks", []), *single]
    return [callback, *(each for child in inside if isinstance(child, BaseCallback) for each in _walk(child))]


def _attributes(callback: BaseCallback) -> dict[str, tuple[Any, bytes]]:
    """Public attributes that can be kept, each with its content as bytes, to compare."""
    found = {}
    for name, value in vars(callback).items():
        if name.startswith("_") or name in ("locals", "globals", "num_timesteps", "verbose"):
            continue
        value = dict(value) if isinstance(value, dict) else value  # counters and the like
        tensors: dict[str, th.Tensor] = {}
        with contextlib.suppress(TypeError):
            file = io.BytesIO(json.dumps(encode(value, "", tensors)).encode())
            file.seek(0, io.SEEK_END)
            write_tensors(file, tensors)
            found[name] = (value, file.getvalue())
    return found


def _changed(callback: BaseCallback) -> dict[str, Any]:
    """A callback's counters and the like: attributes that differ from those before its first ``learn``."""
    before = getattr(callback, _AT_FIRST)
    return {name: value for name, (value, now) in _attributes(callback).items() if before.get(name) != now}


def _restore_callback(callback: BaseCallback, changed: dict[str, Any]) -> None:
    for name, value in changed.items():
        own = vars(callback).get(name)
        if isinstance(own, dict):
            own.clear()
            own.update(value)
        elif name in vars(callback):
            setattr(callback, name, value)
