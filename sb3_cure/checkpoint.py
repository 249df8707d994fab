"""Exact resume: all that training depends on, kept so that a killed run goes on as if it had not been killed."""

import contextlib
import copy
import io
import random
import shutil
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import (
    CSVOutputFormat,
    HumanOutputFormat,
    JSONOutputFormat,
    KVWriter,
    TensorBoardOutputFormat,
)
from stable_baselines3.common.type_aliases import GymEnv

from sb3_cure.buffer_files import can_be_kept, frame_rows, load_frame_rows
from sb3_cure.buffers import FrameStackReplayBuffer
from sb3_cure.envs.state import is_plain, load_vec_env_state, vec_env_state, why_not_restorable
from sb3_cure.generations import CHUNK, CheckpointError, Draft, Entry, Generation, Generations
from sb3_cure.serialization import ArchiveError, read_state, sentences, write_state

if TYPE_CHECKING:
    from sb3_cure.cure_sac import CuReSAC

MODEL, STATE, BUFFER = "model.zip", "state.zip", "replay_buffer.pkl"


class FrameSegment(NamedTuple):
    """A file of frames.

    :param entry: The file
    :param first: Running number of its first frame
    :param last: Running number after its last frame
    """

    entry: Entry
    first: int
    last: int


class CheckpointWriter:
    """Writes a model's checkpoints into one folder; knows which frames lie there already.

    :param path: The folder
    """

    def __init__(self, path: str | Path):
        self.generations = Generations(path)
        self._segments: list[FrameSegment] = []
        #: Whose frames the segments hold
        self._frame_numbers: object = None

    def continue_from(self, generation: Generation, model: "CuReSAC") -> None:
        """
        :param generation: The checkpoint from which the model was just restored, frames and all
        :param model: The model
        """
        self._segments = _frame_segments(generation, model.replay_buffer)
        self._frame_numbers = getattr(model.replay_buffer, "frame_numbers", None)

    def write(self, model: "CuReSAC", keep: int, environments_may_be_gone: bool = False) -> Generation:
        """
        :param model: The model, between an update and the next step of the environments
        :param keep: Number of latest checkpoints to keep
        :param environments_may_be_gone: Whether to do without the environments' state if they do not answer
        :return: What was written
        :raises OSError: if it could not be; the checkpoints are then as before
        """
        segments = list(self._segments)
        state = training_state(model, environments_may_be_gone)

        def fill(draft: Draft) -> dict[str, Any]:
            with draft.file(MODEL) as path:
                model.save(path)
            if isinstance(model.replay_buffer, FrameStackReplayBuffer):
                segments[:] = self._write_frames(draft, model.replay_buffer)
                state["buffer"] = frame_rows(model.replay_buffer)
            else:
                with draft.file(BUFFER) as path:
                    model.save_replay_buffer(path)
            for number, output in enumerate(_log_files(model)):
                with draft.file(f"log-{number}") as path:
                    shutil.copyfile(output.file.name, path)  # type: ignore[attr-defined]
            with draft.file(STATE) as path:
                write_state(path, state)
            frames = [[segment.entry.name, segment.first, segment.last] for segment in segments]
            return {"num_timesteps": model.num_timesteps, "n_updates": model._n_updates, "frames": frames}

        generation = self.generations.write(fill, keep)
        self._segments = segments
        self._frame_numbers = getattr(model.replay_buffer, "frame_numbers", None)
        return generation

    def _write_frames(self, draft: Draft, buffer: FrameStackReplayBuffer) -> list[FrameSegment]:
        """Only those frames that no segment has; segments that the ring has overwritten are left out."""
        oldest = max(buffer._n_frames - buffer.frame_capacity, 0)
        known = self._segments if self._frame_numbers is buffer.frame_numbers else []
        segments = [segment for segment in known if segment.last > oldest]
        draft.segments += [segment.entry for segment in segments]
        first = max(segments[-1].last if segments else 0, oldest)
        if first < buffer._n_frames:
            runs = (run.reshape(-1).data for run in _frame_runs(buffer, first, buffer._n_frames))
            entry = draft.new_segment(f"frames-{first}-{buffer._n_frames}", runs)
            segments.append(FrameSegment(entry, first, buffer._n_frames))
        return segments


def _frame_segments(generation: Generation, buffer: Any) -> list[FrameSegment]:
    """Those of a generation, whose manifest may be a stranger's."""
    entries = {entry.name: entry for entry in generation.segments}
    segments = [FrameSegment(entries[name], first, last) for name, first, last in generation.about["frames"]]
    for segment in segments:
        size = (segment.last - segment.first) * int(np.prod(buffer.frame_shape))
        if segment.first < 0 or segment.last > buffer._n_frames or segment.entry.size != size or size == 0:
            raise ArchiveError(
                f"{segment.entry.name} of {generation.folder} has {segment.entry.size} bytes, which are not the frames "
                f"{segment.first} to {segment.last} of {buffer._n_frames}: the checkpoint is damaged."
            )
    return segments


def _frame_runs(buffer: FrameStackReplayBuffer, first: int, last: int) -> Iterator[np.ndarray]:
    """The places of frames ``first`` to ``last`` in the ring, in pieces that are contiguous in memory."""
    at_once = max(CHUNK // int(np.prod(buffer.frame_shape)), 1)
    while first < last:
        start = first % buffer.frame_capacity
        count = min(last - first, buffer.frame_capacity - start, at_once)
        yield buffer.frames[start : start + count]
        first += count


# --------------------------------------------------------------- the state beside networks and replay buffer


def training_state(model: "CuReSAC", environments_may_be_gone: bool = False) -> dict[str, Any]:
    """What training depends on, beside what ``CuReSAC.save`` and the replay buffer hold.

    :param model: The model, between an update and the next step of the environments
    :param environments_may_be_gone: Whether to do without the environments' state if they do not answer
    :return: Plain values and arrays
    """
    assert model.env is not None
    try:
        environments = vec_env_state(model.env)
    except (OSError, EOFError, RuntimeError) as error:
        if not environments_may_be_gone:
            raise RuntimeError(f"the environments do not tell their state ({error or type(error).__name__})") from error
        environments = None
    return {
        "calls": list(model._run.calls),
        "n_envs": model.n_envs,
        "random": _random_state(model),
        "environments": environments,
        "transition_guard": model._transition_guard.state_dict(),
        "metrics": {
            "sums": dict(model._metrics._sums),
            "counts": dict(model._metrics._counts),
            # Measured now and then, logged every time
            "parameter_norms": {} if model.is_plain_sac else dict(model.policy.encoder_optimizer.parameter_norms),
        },
        "logger": _logger_state(model),
        "callbacks": [_changed(watched) for watched in model._run.watched],
    }


def _random_state(model: "CuReSAC") -> dict[str, Any]:
    return {
        "python": random.getstate(),
        "numpy": np.random.get_state(),
        "torch": th.get_rng_state(),
        "cuda": th.cuda.get_rng_state_all() if model.device.type == "cuda" else [],
        "action_space": model.action_space.np_random.bit_generator.state,
    }


def _load_random_state(model: "CuReSAC", state: dict[str, Any]) -> None:
    random.setstate(state["python"])
    np.random.set_state(state["numpy"])
    th.set_rng_state(state["torch"])
    if state["cuda"] and model.device.type == "cuda":
        th.cuda.set_rng_state_all(state["cuda"])
    model.action_space.np_random.bit_generator.state = state["action_space"]


def _logger_state(model: "CuReSAC") -> dict[str, Any]:
    """What was recorded and not yet written, and which files there are; their content is copied beside."""
    logger = model.logger
    recorded = {
        key: [value, logger.name_to_count[key] if key in logger.name_to_count else None, logger.name_to_excluded[key]]
        for key, value in logger.name_to_value.items()
        if isinstance(value, bool | int | float | str | np.number | th.Tensor)
    }
    files = []
    for output in _log_files(model):
        output.file.flush()  # type: ignore[attr-defined]
        name = Path(output.file.name).name  # type: ignore[attr-defined]
        files.append({"name": name, "keys": list(getattr(output, "keys", []))})
    boards = [each for each in logger.output_formats if isinstance(each, TensorBoardOutputFormat)]
    return {"recorded": recorded, "files": files, "boards": [Path(board.writer.log_dir).name for board in boards]}


def _log_files(model: "CuReSAC") -> list[KVWriter]:
    """The outputs of the logger that write to a file of their own."""
    kinds = (CSVOutputFormat, JSONOutputFormat, HumanOutputFormat)
    outputs = [output for output in model.logger.output_formats if isinstance(output, kinds)]
    return [output for output in outputs if getattr(output, "own_file", True)]


def _continue_logger(model: "CuReSAC", generation: Generation, state: dict[str, Any]) -> None:
    """Files that the logger has open become what those of the same name were; what came after is dropped."""
    logger = model.logger
    for key, (value, count, excluded) in state["recorded"].items():
        logger.name_to_value[key] = value
        logger.name_to_excluded[key] = excluded
        if count is not None:
            logger.name_to_count[key] = count
    outputs: dict[str, Any] = {Path(output.file.name).name: output for output in _log_files(model)}  # type: ignore[attr-defined]
    for number, saved in enumerate(state["files"]):
        output = outputs.get(saved["name"])
        if output is None:
            warnings.warn(
                f"the training that is resumed wrote the log {saved['name']}, which nothing goes on with: before "
                "learn, call set_logger as it did.",
                stacklevel=4,
            )
            continue
        output.file.seek(0)
        output.file.truncate()
        with (generation.folder / f"log-{number}").open("rb") as content:
            shutil.copyfileobj(content, output.file.buffer, CHUNK)
        output.file.seek(0, io.SEEK_END)
        if isinstance(output, CSVOutputFormat):
            output.keys = [str(key) for key in saved["keys"]]
    boards = [output for output in logger.output_formats if isinstance(output, TensorBoardOutputFormat)]
    for board, name in zip(boards, state["boards"], strict=False):
        from torch.utils.tensorboard import SummaryWriter

        # The folder of the killed run, beside that which SB3 has chosen, if it is there.
        folder = Path(board.writer.log_dir).parent / Path(name).name
        if folder.is_dir():
            board.writer.close()
            board.writer = SummaryWriter(log_dir=str(folder), purge_step=model.num_timesteps + 1)


# ----------------------------------------------------------------------------------------------- callbacks


def walk(callback: BaseCallback) -> list[BaseCallback]:
    """
    :param callback: A callback
    :return: It and those inside it, in a fixed order
    """
    # `callback_on_new_best` is of SB3's EvalCallback.
    single = [getattr(callback, name, None) for name in ("callback", "callback_on_new_best")]
    inside = [*getattr(callback, "callbacks", []), *single]
    return [callback, *(each for child in inside if isinstance(child, BaseCallback) for each in walk(child))]


#: Where a callback keeps what its plain attributes were before its first ``learn``
_AT_FIRST = "_sb3_cure_at_first"


class WatchedCallback(NamedTuple):
    """A callback of the running ``learn``, and what its plain attributes were when the first one with it began."""

    callback: BaseCallback
    before: dict[str, Any]


def watch(callback: BaseCallback) -> list[WatchedCallback]:
    """
    :param callback: The callback of a ``learn`` that begins
    :return: All callbacks in it, to see later what has changed in them
    """
    others = [each for each in walk(callback) if not isinstance(each, ExactCheckpoint)]
    for each in others:
        # A callback may serve several calls, of which those that are over will be skipped.
        if not hasattr(each, _AT_FIRST):
            setattr(each, _AT_FIRST, copy.deepcopy(_plain_attributes(each)))
    return [WatchedCallback(each, getattr(each, _AT_FIRST)) for each in others]


def _plain_attributes(callback: BaseCallback) -> dict[str, Any]:
    given = ("locals", "globals", "num_timesteps", "verbose")
    public = {name: value for name, value in vars(callback).items() if not name.startswith("_")}
    return {name: value for name, value in public.items() if name not in given and is_plain(value)}


def _changed(watched: WatchedCallback) -> dict[str, Any]:
    """A callback's counters and the like: public plain attributes that differ from those before its first ``learn``."""
    now = _plain_attributes(watched.callback)
    missing = object()
    changed = {name: value for name, value in now.items() if not _equal(watched.before.get(name, missing), value)}
    kept = {name: value for name, value in changed.items() if _can_be_kept(watched.callback, name, value)}
    return {"class": type(watched.callback).__name__, "changed": kept}


def _can_be_kept(callback: BaseCallback, name: str, value: Any) -> bool:
    try:
        write_state(io.BytesIO(), {name: value})
    except (TypeError, ValueError) as error:
        warnings.warn(f"checkpoints do not keep {name} of {type(callback).__name__}: {error}", stacklevel=2)
        return False
    return True


def _take_back(callback: BaseCallback, changed: dict[str, Any]) -> None:
    """What was saved of a callback, perhaps by a stranger: values of plain attributes that it has, of their kinds."""
    now = _plain_attributes(callback)
    lost = []
    for name, value in changed.items():
        if name not in now or _equal(now[name], value):
            continue
        # A text may be a path, to which the callback writes.
        if not isinstance(value, str) and is_plain(value) and _is_alike(now[name], value):
            setattr(callback, name, value)
        else:
            lost.append(name)
    if lost:
        warnings.warn(
            f"resume does not give {type(callback).__name__} its former {', '.join(lost)}: texts are left as they are, "
            "as they may be paths, and so is what was of another type (but None, and any number for another).",
            stacklevel=4,
        )


def _is_alike(now: Any, value: Any) -> bool:
    """Whether a value may take an attribute's place: a number that of any other number."""
    numbers = bool | int | float | np.number | np.bool_
    return now is None or type(now) is type(value) or (isinstance(now, numbers) and isinstance(value, numbers))


def _equal(one: Any, other: Any) -> bool:
    if isinstance(one, list | tuple) and type(one) is type(other):
        return len(one) == len(other) and all(map(_equal, one, other))
    if isinstance(one, dict) and isinstance(other, dict):
        return one.keys() == other.keys() and all(_equal(one[key], other[key]) for key in one)
    if isinstance(one, th.Tensor):
        return isinstance(other, th.Tensor) and th.equal(one, other)
    return type(one) is type(other) and bool(np.array_equal(one, other))


# -------------------------------------------------------------------------------------------------- resume


def resume(
    model_class: type["CuReSAC"], path: str | Path, env: GymEnv, custom_objects: dict[str, Any] | None, **kwargs: Any
) -> "CuReSAC":
    """See ``CuReSAC.resume``."""
    if not isinstance(path, str | Path):
        raise CheckpointError(f"resume got path={path!r}, but it must be the folder of an ExactCheckpoint: give it.")
    if env is None:
        raise CheckpointError("resume got no environment: give those of the training, made as they were then.")
    generations = Generations(path)
    refused: list[tuple[Generation, ArchiveError]] = []
    for generation, lost in _usable(generations):
        try:
            with sentences(str(generation.folder), "resume on a machine with more"):
                model = _restore(model_class, generation, lost, env, custom_objects, kwargs)
        except CheckpointError:
            raise
        except ArchiveError as error:
            refused.append((generation, error))
            continue
        for newer, reason in refused:
            warnings.warn(f"{newer.folder.name} cannot be resumed from: {reason}", stacklevel=3)
        return model
    # What is amiss with the settings that were given is amiss with all of them: the newest tells best.
    raise refused[0][1]


def _restore(
    model_class: type["CuReSAC"],
    generation: Generation,
    lost: list[Path],
    env: GymEnv,
    custom_objects: dict[str, Any] | None,
    kwargs: dict[str, Any],
) -> "CuReSAC":
    """The model of a generation, ready to learn on."""
    model = model_class.load(
        generation.folder / MODEL, env=env, custom_objects=custom_objects, force_reset=False, **kwargs
    )
    state = read_state(generation.folder / STATE)
    if model.n_envs != state["n_envs"]:
        raise CheckpointError(
            f"resume got {model.n_envs} environments, but the checkpoint {generation.folder} is of a training with "
            f"{state['n_envs']}: give as many."
        )
    _load_buffer(model, generation, state, lost)
    writer = CheckpointWriter(generation.folder.parent)
    if not lost and isinstance(model.replay_buffer, FrameStackReplayBuffer):
        writer.continue_from(generation, model)
    model._run.writers[generation.folder.parent.resolve()] = writer
    *model._run.calls, _ = *model._run.done, _ = [str(call) for call in state["calls"]]
    if state["environments"] is None:
        assert model.env is not None
        # The interrupted episode cannot be gone on with; other first states than those that this run has seen.
        model._last_obs = None
        model.env.seed(None if model.seed is None else (model.seed + model.num_timesteps) % 2**31)
    model._run.resumed = Resumption(generation, state, model)
    if model.verbose >= 1:
        print(f"Resumed from {generation.folder}, after {model.num_timesteps} agent steps")
    return model


def _usable(generations: Generations) -> Iterator[tuple[Generation, list[Path]]]:
    """The generations that are whole, newest first, then those that lack nothing but frames; and what they lack."""
    numbers = generations.numbers()
    if not numbers:
        raise CheckpointError(
            f"there is no checkpoint in {generations.path}: give the path of an ExactCheckpoint that has begun a "
            "training, or start one."
        )
    reasons: list[str] = []
    without_frames = []
    found = False
    for number in reversed(numbers):
        try:
            generation = generations.read(number)
        except CheckpointError as error:
            reasons.append(str(error))
            continue
        damaged = generations.damaged(generation)
        if not damaged:
            _tell(reasons, f"Resuming from {generation.folder.name} instead")
            found = True
            yield generation, []
            continue
        reasons += [f"{path} is damaged: {fault}" for path, fault in damaged]
        if all(path.parent == generations.segments for path, _ in damaged):
            without_frames.append((generation, [path for path, _ in damaged]))
    for generation, lost in without_frames:
        _tell(reasons, f"Resuming from {generation.folder.name} without the transitions that need what is damaged")
        found = True
        yield generation, lost
    if not found:
        told = "; ".join(dict.fromkeys(reasons))
        raise CheckpointError(f"no checkpoint in {generations.path} is whole ({told}): start anew.")


def _tell(reasons: list[str], consequence: str) -> None:
    if reasons:
        warnings.warn(f"{'; '.join(dict.fromkeys(reasons))}. {consequence}.", stacklevel=4)
        reasons.clear()


def _load_buffer(model: "CuReSAC", generation: Generation, state: dict[str, Any], lost: list[Path]) -> None:
    buffer = model.replay_buffer
    if "buffer" not in state:
        model.load_replay_buffer(generation.folder / BUFFER, truncate_last_traj=False)
        return
    if not isinstance(buffer, FrameStackReplayBuffer):
        raise CheckpointError(
            f"the checkpoint {generation.folder} has single frames, but the replay buffer of this model is a "
            f"{type(buffer).__name__}: resume with environments that tell the same frame_stack."
        )
    load_frame_rows(buffer, state["buffer"], str(generation.folder))
    if buffer._n_frames > 0:
        buffer.reserve_frames()
    lost_names = {path.name for path in lost}
    for segment in _frame_segments(generation, buffer):
        first = max(segment.first, buffer._n_frames - buffer.frame_capacity)
        if segment.entry.name in lost_names:
            _forget_frames_before(buffer, segment.last)
            continue
        with (generation.folder.parent / "segments" / segment.entry.name).open("rb") as file:
            file.seek((first - segment.first) * int(np.prod(buffer.frame_shape)))
            for run in _frame_runs(buffer, first, segment.last):
                file.readinto(run.reshape(-1).data)  # type: ignore[attr-defined]


def _forget_frames_before(buffer: FrameStackReplayBuffer, number: int) -> None:
    """Give up the rows that need older frames; frame numbers never fall from row to row."""
    newest_first = (buffer.pos - 1 - np.arange(buffer._n_valid)) % buffer.buffer_size
    kept = int((buffer.oldest_frame[newest_first] >= number).sum())
    warnings.warn(
        f"{buffer._n_valid - kept} of {buffer._n_valid} rows of the replay buffer are lost with their frames: training "
        "goes on without them, and no longer exactly as without the interruption.",
        stacklevel=5,
    )
    buffer._n_valid = kept
    buffer._tails[buffer._tails.min(axis=1) < number] = -buffer.frame_capacity


class Resumption:
    """What is left to restore when a resumed model learns on.

    :param generation: The checkpoint
    :param state: Its training state
    :param model: The model
    """

    def __init__(self, generation: Generation, state: dict[str, Any], model: "CuReSAC"):
        self.generation = generation
        self.state = state
        kept = ("_last_obs", "_last_episode_starts", "_last_original_obs", "action_noise")
        self._kept = {name: copy.deepcopy(getattr(model, name)) for name in kept}
        #: Agent steps at which the call that is gone on with began
        self.started_at: int = model._num_timesteps_at_start

    def set_up(self, model: "CuReSAC") -> None:
        """Counters of callbacks, files of the logger and what was not yet logged.

        :param model: The model, at the end of its ``_setup_learn``
        """
        # `learn` begins noises anew, and takes its start for now.
        model.action_noise = self._kept["action_noise"]
        model._num_timesteps_at_start = self.started_at
        with sentences(str(self.generation.folder), "resume on a machine with more"):
            saved = list(self.state["callbacks"])
            for watched in model._run.watched:
                name = type(watched.callback).__name__
                entry = next((entry for entry in saved if entry["class"] == name), None)
                if entry is not None:
                    saved.remove(entry)
                    _take_back(watched.callback, entry["changed"])
            _continue_logger(model, self.generation, self.state["logger"])
            metrics = self.state["metrics"]
            model._metrics._sums = {key: value.to(model.device) for key, value in metrics["sums"].items()}
            model._metrics._counts = dict(metrics["counts"])
            if not model.is_plain_sac:
                norms = {key: value.to(model.device) for key, value in metrics["parameter_norms"].items()}
                model.policy.encoder_optimizer.parameter_norms = norms

    def enter(self, model: "CuReSAC") -> None:
        """Environments and random streams, last of all, so that nothing can disturb them.

        :param model: The model, before its next step
        """
        assert model.env is not None
        with sentences(str(self.generation.folder), "resume on a machine with more"):
            if self.state["environments"] is not None:
                load_vec_env_state(model.env, self.state["environments"])
                for name in ("_last_obs", "_last_episode_starts", "_last_original_obs"):
                    setattr(model, name, self._kept[name])
            model._transition_guard.load_state_dict(self.state["transition_guard"])
            _load_random_state(model, self.state["random"])


class Run:
    """What a model knows of the training that it is in, beside what it saves."""

    def __init__(self) -> None:
        #: By folder
        self.writers: dict[Path, CheckpointWriter] = {}
        #: What a resumed model has yet to restore
        self.resumed: Resumption | None = None
        #: Callbacks of the running ``learn``
        self.watched: list[WatchedCallback] = []
        #: Called before each rollout, between an update and the next step
        self.before_rollout: list[Callable[[], None]] = []
        #: What is to be undone when the running ``learn`` ends
        self.leaving = contextlib.ExitStack()
        #: Calls of ``learn`` and ``pretrain`` so far, the running one last
        self.calls: list[str] = []
        #: Of these, calls that were over when the checkpoint was taken, and that the script will make again
        self.done: list[str] = []

    def skips(self, call: str, counts_anew: bool = True) -> bool:
        """
        :param call: ``"learn"`` or ``"pretrain"``, which is being called
        :param counts_anew: Its ``reset_num_timesteps``: without, it asks for more steps and is none of those before
        :return: Whether the checkpoint that was resumed from was taken after it
        """
        if self.resumed is not None and counts_anew and self.done[:1] == [call]:
            self.done.pop(0)
            print(f"{call} number {len(self.calls) - len(self.done)} of this training was over: skipped")
            return True
        self.done = []
        return False

    @contextlib.contextmanager
    def calling(self, call: str) -> Iterator[None]:
        """The running call.

        :param call: ``"learn"`` or ``"pretrain"``
        """
        self.calls.append(call)
        try:
            with self.leaving:
                yield
        except BaseException:
            self.calls.pop()
            raise
        finally:
            self.watched, self.before_rollout = [], []


class ExactCheckpoint(BaseCallback):
    """Keep checkpoints from which ``CuReSAC.resume`` goes on exactly where the training was killed.

    A checkpoint holds networks, optimisers, SRL head, temperatures, running statistics, schedules, counters, the
    replay buffer, all random streams, the state of the environments where they offer it, what was logged, and the
    public attributes of the callbacks. The frames of a ``FrameStackReplayBuffer`` are written once: a checkpoint adds
    the new ones. It is written aside, flushed to the disk, checksummed and renamed; until then the former ones count.
    One is written when training starts and one when it ends.

    On the CPU with ``precision="fp32", compile=False`` the resumed run equals one without interruption bit for bit
    (with ``overlap=True``, whose updates lag behind, it does not). Environments that cannot tell their state begin a
    new episode instead, which is said when training starts. On SIGTERM and SIGINT a checkpoint is written before the
    next rollout (with ``train_freq=1``: the next step), then the process leaves with the status that the signal asks
    for. Workers of SB3's ``SubprocVecEnv`` die of a Ctrl-C in a terminal: their episodes then begin anew.

    :param save_freq: Agent steps between two checkpoints (of all environments together)
    :param path: Folder for the checkpoints of this training, made if missing
    :param keep: Number of latest checkpoints to keep
    :param verbose: 1 prints each checkpoint
    :raises ValueError: if a number is below 1, the folder holds checkpoints of another training or cannot be written
        to, or its disk has too little room; all of this before training starts
    """

    def __init__(self, save_freq: int, path: str | Path, keep: int = 3, verbose: int = 0):
        super().__init__(verbose)
        for name, value in (("save_freq", save_freq), ("keep", keep)):
            if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
                raise ValueError(
                    f"ExactCheckpoint got {name}={value!r}, but it must be a whole number of at least 1: change {name}."
                )
        if not isinstance(path, str | Path):
            raise ValueError(f"ExactCheckpoint got path={path!r}, but it must be the path of a folder: give one.")
        self.save_freq = int(save_freq)
        self.path = Path(path)
        self.keep = int(keep)
        self._last_saved = self._last_tried = 0
        self._signal: int | None = None
        self._writer = CheckpointWriter(self.path)

    @staticmethod
    def exists(path: str | Path) -> bool:
        """
        :param path: Folder for checkpoints
        :return: Whether there is one, from which ``CuReSAC.resume`` can go on
        """
        return bool(Generations(path).numbers())

    def _init_callback(self) -> None:
        from sb3_cure.cure_sac import CuReSAC

        if not isinstance(self.model, CuReSAC):
            raise ValueError(
                f"ExactCheckpoint got a {type(self.model).__name__}, but only CuReSAC can resume exactly: use SB3's "
                "CheckpointCallback, or CuReSAC (with srl=None, curiosity=None it is SB3's SAC)."
            )
        buffer = self.model.replay_buffer
        if not can_be_kept(type(buffer)):
            raise ValueError(
                f"ExactCheckpoint got a model whose replay buffer is a {type(buffer).__name__}, which it cannot read "
                "back without pickle: train with a FrameStackReplayBuffer or one of SB3's (but HerReplayBuffer)."
            )
        run = self.model._run
        writer = run.writers.get(self.path.resolve())
        if writer is None:
            if self.exists(self.path):
                raise CheckpointError(
                    f"{self.path} holds checkpoints of another training: go on with it by "
                    f"CuReSAC.resume({str(self.path)!r}, env), or choose another path, or remove that folder."
                )
            writer = CheckpointWriter(self.path)
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            run.leaving.enter_context(writer.generations.locked())
        except OSError as error:
            raise CheckpointError(
                f"ExactCheckpoint cannot write to {self.path} ({error.strerror}): choose another path."
            ) from error
        self._writer = run.writers[self.path.resolve()] = writer
        run.leaving.enter_context(self._signals_noted())
        # Before any callback hears of the rollout: when it is resumed, all of them do.
        run.before_rollout.append(self._look)

    def _on_training_start(self) -> None:
        model: Any = self.model
        inexact = {
            "overlap=True": model.overlap,
            "use_sde=True": model.use_sde,
        }
        for setting, is_set in inexact.items():
            if is_set:
                warnings.warn(
                    f"ExactCheckpoint with {setting}: a resumed training goes on, but not bit for bit as without the "
                    "interruption.",
                    stacklevel=2,
                )
        reason = why_not_restorable(model.env)
        if reason is not None:
            warnings.warn(
                f"ExactCheckpoint cannot keep the state of the environments, as {reason}: a resumed training begins "
                "with a new episode.",
                stacklevel=2,
            )
        self._last_saved = self._last_tried = self.num_timesteps
        if model._run.resumed is None:
            self._check_room()
            try:
                self._writer.write(model, self.keep)
            except OSError as error:
                raise CheckpointError(
                    f"ExactCheckpoint cannot write to {self.path} ({error.strerror}): choose another path."
                ) from error

    def _check_room(self) -> None:
        model: Any = self.model
        arrays = {name: each.nbytes for name, each in vars(model.replay_buffer).items() if isinstance(each, np.ndarray)}
        shared = 0
        if isinstance(model.replay_buffer, FrameStackReplayBuffer):
            arrays.pop("frames")
            shared = model.replay_buffer.frame_capacity * int(np.prod(model.replay_buffer.frame_shape))
        # Adam keeps two more numbers for each parameter.
        networks = 3 * sum(value.nbytes for value in model.policy.state_dict().values())
        # While one is written, the one that it will replace is still there.
        needed = shared + (self.keep + 1) * (sum(arrays.values()) + networks)
        free = shutil.disk_usage(self.path).free
        if needed > free:
            raise CheckpointError(
                f"checkpoints in {self.path} will need up to {needed / 1e9:.2f} GB, but only {free / 1e9:.2f} GB are "
                "free there: choose another path, a smaller keep, or a smaller buffer_size."
            )

    def _look(self) -> None:
        if self.is_due() or self._signal is not None:
            self._save()
        self._leave_if_told()

    def is_due(self) -> bool:
        """
        :return: Whether a checkpoint is to be written now; asked before each rollout
        """
        return self.num_timesteps // self.save_freq > self._last_tried // self.save_freq

    def _on_step(self) -> bool:
        return True

    def _on_training_end(self) -> None:
        # Where another callback stopped it, the last step was not stored: the checkpoint before stays the last one.
        model: Any = self.model
        if self.model.num_timesteps >= model._total_timesteps and self.model.num_timesteps > self._last_saved:
            self._save()

    def _save(self) -> None:
        model: Any = self.model
        self.num_timesteps = self._last_tried = model.num_timesteps
        if model._overlapped is not None:
            model._overlapped.finish()
        model._guard.report(model)  # nothing that is not finite is kept
        try:
            generation = self._writer.write(model, self.keep, environments_may_be_gone=self._signal is not None)
        except Exception as error:
            reason = error.strerror if isinstance(error, OSError) and error.strerror else error
            warnings.warn(
                f"no checkpoint could be written to {self.path} after {self.num_timesteps} agent steps ({reason}): "
                f"training goes on, and the one after {self._last_saved} remains the last.",
                stacklevel=2,
            )
            return
        self._last_saved = self.num_timesteps
        if self.verbose >= 1:
            print(f"Checkpoint {generation.folder} after {self.num_timesteps} agent steps")

    @contextlib.contextmanager
    def _signals_noted(self) -> Iterator[None]:
        """SIGTERM and SIGINT are obeyed before the next rollout; a second one at once."""
        self._signal = None
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        former = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}

        def note(number: int, _: Any) -> None:
            self._signal = number
            print(
                f"{signal.Signals(number).name}: when the updates under way are done, a checkpoint is written and "
                "training ends; once more to end it at once.",
                file=sys.stderr,
            )
            signal.signal(number, former[signal.Signals(number)])

        for number in former:
            signal.signal(number, note)
        try:
            yield
        finally:
            for number, handler in former.items():
                signal.signal(number, handler)
        self._leave_if_told()

    def _leave_if_told(self) -> None:
        number, self._signal = self._signal, None
        if number == signal.SIGINT:
            raise KeyboardInterrupt
        if number is not None:
            raise SystemExit(128 + number)
