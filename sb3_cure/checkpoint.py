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
from collections.abc import Iterator
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
    Logger,
    TensorBoardOutputFormat,
)
from stable_baselines3.common.type_aliases import GymEnv

from sb3_cure.buffers import FrameStackReplayBuffer
from sb3_cure.envs.state import is_plain, load_vec_env_state, vec_env_state, why_not_restorable
from sb3_cure.generations import CHUNK, CheckpointError, Draft, Entry, Generation, Generations
from sb3_cure.serialization import read_state, write_state

if TYPE_CHECKING:
    from sb3_cure.cure_sac import CuReSAC

MODEL, STATE, BUFFER = "model.zip", "state.zip", "replay_buffer.pkl"
#: What of a FrameStackReplayBuffer is neither frames nor given by its constructor
_BUFFER_COUNTERS = ("pos", "full", "_n_valid", "_n_frames")


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
        self._n_resets: int | None = None

    def continue_from(self, generation: Generation, model: "CuReSAC") -> None:
        """
        :param generation: The checkpoint from which the model was just restored, frames and all
        :param model: The model
        """
        self._segments = _frame_segments(generation)
        self._n_resets = getattr(model.replay_buffer, "n_resets", None)

    def write(self, model: "CuReSAC", keep: int) -> Generation:
        """
        :param model: The model, between an update and the next step of the environments
        :param keep: Number of latest checkpoints to keep
        :return: What was written
        :raises OSError: if it could not be; the checkpoints are then as before
        """
        segments = list(self._segments)

        def fill(draft: Draft) -> dict[str, Any]:
            model.save(draft.path(MODEL))
            state = training_state(model)
            if isinstance(model.replay_buffer, FrameStackReplayBuffer):
                segments[:] = self._write_frames(draft, model.replay_buffer)
                state["buffer"] = _rows(model.replay_buffer)
            else:
                model.save_replay_buffer(draft.path(BUFFER))
            write_state(draft.path(STATE), state)
            frames = [[segment.entry.name, segment.first, segment.last] for segment in segments]
            return {"num_timesteps": model.num_timesteps, "n_updates": model._n_updates, "frames": frames}

        generation = self.generations.write(fill, keep)
        self._segments = segments
        self._n_resets = getattr(model.replay_buffer, "n_resets", None)
        return generation

    def _write_frames(self, draft: Draft, buffer: FrameStackReplayBuffer) -> list[FrameSegment]:
        """Only those frames that no segment has; segments that the ring has overwritten are left out."""
        oldest = max(buffer._n_frames - buffer.frame_capacity, 0)
        known = self._segments if self._n_resets == buffer.n_resets else []
        segments = [segment for segment in known if segment.last > oldest]
        draft.segments += [segment.entry for segment in segments]
        first = max(segments[-1].last if segments else 0, oldest)
        if first < buffer._n_frames:
            runs = (run.reshape(-1).data for run in _frame_runs(buffer, first, buffer._n_frames))
            entry = draft.new_segment(f"frames-{first}-{buffer._n_frames}", runs)
            segments.append(FrameSegment(entry, first, buffer._n_frames))
        return segments


def _frame_segments(generation: Generation) -> list[FrameSegment]:
    entries = {entry.name: entry for entry in generation.segments}
    return [FrameSegment(entries[name], first, last) for name, first, last in generation.about["frames"]]


def _frame_runs(buffer: FrameStackReplayBuffer, first: int, last: int) -> Iterator[np.ndarray]:
    """The places of frames ``first`` to ``last`` in the ring, in pieces that are contiguous in memory."""
    at_once = max(CHUNK // int(np.prod(buffer.frame_shape)), 1)
    while first < last:
        start = first % buffer.frame_capacity
        count = min(last - first, buffer.frame_capacity - start, at_once)
        yield buffer.frames[start : start + count]
        first += count


def _rows(buffer: FrameStackReplayBuffer) -> dict[str, Any]:
    """All but the frames, as far as it is used."""
    stored = buffer.buffer_size if buffer.full else buffer.pos
    arrays = {name: getattr(buffer, name)[:stored] for name in buffer._ROW_ARRAYS}
    counters = {name: getattr(buffer, name) for name in _BUFFER_COUNTERS}
    return {"arrays": arrays, "counters": counters, "tails": buffer._tails}


# --------------------------------------------------------------- the state beside networks and replay buffer


def training_state(model: "CuReSAC") -> dict[str, Any]:
    """What training depends on, beside what ``CuReSAC.save`` and the replay buffer hold.

    :param model: The model, between an update and the next step of the environments
    :return: Plain values and arrays
    """
    assert model.env is not None
    return {
        "collector": model._collector,
        "n_envs": model.n_envs,
        "random": _random_state(model),
        "environments": vec_env_state(model.env),
        "metrics": {
            "sums": dict(model._metrics._sums),
            "counts": dict(model._metrics._counts),
            # Measured now and then, logged every time (sequential updates)
            "shares": {} if model.is_plain_sac else dict(model.policy.encoder_optimizer.shares),
        },
        "logger": _logger_state(model),
        "callbacks": [_changed(callback) for callback in model._callbacks],
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
    """What was recorded and not yet written, and the files as they are now."""
    logger = model.logger
    recorded = {
        key: [value, logger.name_to_count[key] if key in logger.name_to_count else None, logger.name_to_excluded[key]]
        for key, value in logger.name_to_value.items()
        if isinstance(value, bool | int | float | str | np.number | th.Tensor)
    }
    outputs = [_output_state(output) for output in logger.output_formats if output is not model._metrics]
    return {
        "custom": model._custom_logger,
        "folder": logger.dir,
        "recorded": recorded,
        "outputs": [output for output in outputs if output is not None],
    }


_FILES: dict[type[KVWriter], str] = {CSVOutputFormat: "csv", JSONOutputFormat: "json", HumanOutputFormat: "log"}


def _output_state(output: KVWriter) -> dict[str, Any] | None:
    if isinstance(output, TensorBoardOutputFormat):
        return {"kind": "tensorboard", "path": output.writer.log_dir}
    if isinstance(output, HumanOutputFormat) and not output.own_file:
        return {"kind": "stdout", "path": ""}
    kind = _FILES.get(type(output))
    if kind is None:
        return None
    output.file.flush()  # type: ignore[attr-defined]
    path = Path(output.file.name).absolute()  # type: ignore[attr-defined]
    return {"kind": kind, "path": str(path), "content": path.read_bytes(), "keys": list(getattr(output, "keys", []))}


def _make_logger(state: dict[str, Any]) -> Logger:
    """A logger that writes where that of the killed run wrote."""
    outputs: list[KVWriter] = []
    kinds = {kind: output_format for output_format, kind in _FILES.items()}
    for output in state["outputs"]:
        if output["kind"] == "stdout":
            outputs.append(HumanOutputFormat(sys.stdout))
        elif output["kind"] == "tensorboard":
            outputs.append(TensorBoardOutputFormat(output["path"]))
        else:
            Path(output["path"]).parent.mkdir(parents=True, exist_ok=True)
            outputs.append(kinds[output["kind"]](output["path"]))  # type: ignore[call-arg]
    return Logger(state["folder"], outputs)


def _continue_logger(logger: Logger, state: dict[str, Any], step: int) -> None:
    """Files become what they were at the checkpoint; what came after is dropped."""
    for key, (value, count, excluded) in state["recorded"].items():
        logger.name_to_value[key] = value
        logger.name_to_excluded[key] = excluded
        if count is not None:
            logger.name_to_count[key] = count
    for output in logger.output_formats:
        if isinstance(output, TensorBoardOutputFormat):
            from torch.utils.tensorboard import SummaryWriter

            output.writer.close()
            output.writer = SummaryWriter(log_dir=output.writer.log_dir, purge_step=step + 1)
        kind = _FILES.get(type(output))
        saved = [other for other in state["outputs"] if other["kind"] == kind]
        if kind is None or not saved or (isinstance(output, HumanOutputFormat) and not output.own_file):
            continue
        file: io.TextIOWrapper = output.file  # type: ignore[attr-defined]
        file.seek(0)
        file.truncate()
        file.write(saved[0]["content"].decode())
        file.flush()
        if isinstance(output, CSVOutputFormat):
            output.keys = list(saved[0]["keys"])


# ----------------------------------------------------------------------------------------------- callbacks


def walk(callback: BaseCallback) -> list[BaseCallback]:
    """
    :param callback: A callback
    :return: It and those inside it, in a fixed order
    """
    inside = [*getattr(callback, "callbacks", []), *filter(None, [getattr(callback, "callback", None)])]
    return [callback, *(each for child in inside if isinstance(child, BaseCallback) for each in walk(child))]


class WatchedCallback(NamedTuple):
    """A callback of the running ``learn``, and what its plain attributes were when that began."""

    callback: BaseCallback
    before: dict[str, Any]


def watch(callback: BaseCallback) -> list[WatchedCallback]:
    """
    :param callback: The callback of a ``learn`` that begins
    :return: All callbacks in it, to see later what has changed in them
    """
    others = [each for each in walk(callback) if not isinstance(each, ExactCheckpoint)]
    return [WatchedCallback(each, copy.deepcopy(_plain_attributes(each))) for each in others]


def _plain_attributes(callback: BaseCallback) -> dict[str, Any]:
    given = ("locals", "globals", "num_timesteps", "verbose")
    public = {name: value for name, value in vars(callback).items() if not name.startswith("_")}
    return {name: value for name, value in public.items() if name not in given and is_plain(value)}


def _changed(watched: WatchedCallback) -> dict[str, Any]:
    """A callback's counters and the like: public plain attributes that differ from those at the start of ``learn``."""
    now = _plain_attributes(watched.callback)
    missing = object()
    changed = {name: value for name, value in now.items() if not _equal(watched.before.get(name, missing), value)}
    return {"class": type(watched.callback).__name__, "changed": changed}


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
    generation, lost = _newest(generations)
    model = model_class.load(
        generation.folder / MODEL, env=env, custom_objects=custom_objects, force_reset=False, **kwargs
    )
    state = read_state(generation.folder / STATE)
    if model.n_envs != state["n_envs"]:
        raise CheckpointError(
            f"resume got {model.n_envs} environments, but the checkpoint in {path} is of a training with "
            f"{state['n_envs']}: give as many."
        )
    _load_buffer(model, generation, state, lost)
    model._resumed = Resumption(generation, state)
    model._checkpoint_writer = CheckpointWriter(path)
    if not lost:
        model._checkpoint_writer.continue_from(generation, model)
    if state["environments"] is None:
        assert model.env is not None
        # The interrupted episode cannot be gone on with; other first states than those that this run has seen.
        model._last_obs = None
        model.env.seed(None if model.seed is None else (model.seed + model.num_timesteps) % 2**31)
    if state["logger"]["custom"]:
        model.set_logger(_make_logger(state["logger"]))
        _continue_logger(model.logger, state["logger"], model.num_timesteps)
    if model.verbose >= 1:
        print(f"Resumed from {generation.folder}, after {model.num_timesteps} agent steps")
    return model


def _newest(generations: Generations) -> tuple[Generation, list[Path]]:
    """The newest generation that is whole, or else the newest that lacks nothing but frames; and what it lacks."""
    numbers = generations.numbers()
    if not numbers:
        raise CheckpointError(
            f"there is no checkpoint in {generations.path}: give the path of an ExactCheckpoint that has begun a "
            "training, or start one."
        )
    reasons, without_frames = [], []
    for number in reversed(numbers):
        try:
            generation = generations.read(number)
        except CheckpointError as error:
            reasons.append(str(error))
            continue
        damaged = generations.damaged(generation)
        if not damaged:
            _tell(reasons, generation)
            return generation, []
        reasons += [f"{path} is damaged: {fault}" for path, fault in damaged]
        if all(path.parent == generations.segments for path, _ in damaged):
            without_frames.append((generation, [path for path, _ in damaged]))
    if without_frames:
        _tell(list(dict.fromkeys(reasons)), without_frames[0][0])
        return without_frames[0]
    raise CheckpointError(f"no checkpoint in {generations.path} is whole ({'; '.join(reasons)}): start anew.")


def _tell(reasons: list[str], taken: Generation) -> None:
    if reasons:
        warnings.warn(f"{'; '.join(reasons)}. Resuming from {taken.folder.name} instead.", stacklevel=4)


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
    for name, array in state["buffer"]["arrays"].items():
        getattr(buffer, name)[: len(array)] = array
    vars(buffer).update(state["buffer"]["counters"])
    buffer._tails[:] = state["buffer"]["tails"]
    if len(buffer.frames) == 0 and buffer._n_frames > 0:
        buffer.frames = buffer._file_for_frames()
    lost_names = {path.name for path in lost}
    for segment in _frame_segments(generation):
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
    """

    def __init__(self, generation: Generation, state: dict[str, Any]):
        self.generation = generation
        self.state = state

    def set_up(self, model: "CuReSAC") -> None:
        """Counters of callbacks, files of the logger and what was not yet logged.

        :param model: The model, at the end of its ``_setup_learn``
        """
        saved = list(self.state["callbacks"])
        for watched in model._callbacks:
            entry = next((entry for entry in saved if entry["class"] == type(watched.callback).__name__), None)
            if entry is not None:
                saved.remove(entry)
                vars(watched.callback).update(entry["changed"])
        _continue_logger(model.logger, self.state["logger"], model.num_timesteps)
        metrics = self.state["metrics"]
        model._metrics._sums = {key: value.to(model.device) for key, value in metrics["sums"].items()}
        model._metrics._counts = dict(metrics["counts"])
        if not model.is_plain_sac:
            shares = {key: value.to(model.device) for key, value in metrics["shares"].items()}
            model.policy.encoder_optimizer.shares = shares

    def enter(self, model: "CuReSAC") -> None:
        """Environments and random streams, last of all, so that nothing can disturb them.

        :param model: The model, before its next step
        """
        assert model.env is not None
        if self.state["environments"] is not None:
            load_vec_env_state(model.env, self.state["environments"])
        _load_random_state(model, self.state["random"])


class ExactCheckpoint(BaseCallback):
    """Keep checkpoints from which ``CuReSAC.resume`` goes on exactly where the training was killed.

    A checkpoint holds networks, optimisers, SRL head, temperatures, running statistics, schedules, counters, the
    replay buffer, all random streams, the state of the environments where they offer it, what was logged, and the
    counters of the callbacks. The frames of a ``FrameStackReplayBuffer`` are written once: a checkpoint adds the new
    ones. It is written aside, flushed to the disk, checksummed and renamed; until then the former ones count. One is
    written when training starts and one when it ends.

    On the CPU with ``precision="fp32", compile=False`` the resumed run equals one without interruption bit for bit
    (with ``overlap=True``, whose updates lag behind, it does not). Environments that cannot tell their state begin a
    new episode instead, which is said when training starts. On SIGTERM and SIGINT a checkpoint is written before the
    next step, then the process leaves with the status that the signal asks for.

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
        writer = self.model._checkpoint_writer
        if writer is None or writer.generations.path.absolute() != self.path.absolute():
            if Generations(self.path).numbers():
                raise CheckpointError(
                    f"{self.path} holds checkpoints of another training: go on with it by "
                    f"CuReSAC.resume({str(self.path)!r}, env), or choose another path, or remove that folder."
                )
            writer = CheckpointWriter(self.path)
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            leaving = self.model._leaving_learn
            leaving.enter_context(writer.generations.locked())
        except OSError as error:
            raise CheckpointError(
                f"ExactCheckpoint cannot write to {self.path} ({error.strerror}): choose another path."
            ) from error
        self.model._checkpoint_writer = writer
        leaving.enter_context(self._signals_noted())

    def _on_training_start(self) -> None:
        model: Any = self.model
        reason = why_not_restorable(model.env)
        if reason is not None:
            warnings.warn(
                f"ExactCheckpoint cannot keep the state of the environments, as {reason}: a resumed training begins "
                "with a new episode.",
                stacklevel=2,
            )
        if model.overlap:
            warnings.warn(
                "ExactCheckpoint with overlap=True: a resumed training goes on, but not bit for bit as without the "
                "interruption; for that set overlap=False.",
                stacklevel=2,
            )
        self._last_saved = self._last_tried = self.num_timesteps
        if model._resumed is None:
            try:
                self._check_room(model._checkpoint_writer.write(model, self.keep))
            except OSError as error:
                raise CheckpointError(
                    f"ExactCheckpoint cannot write to {self.path} ({error.strerror}): choose another path."
                ) from error

    def _check_room(self, first: Generation) -> None:
        buffer = self.model.replay_buffer  # type: ignore[attr-defined]
        arrays = {name: value.nbytes for name, value in vars(buffer).items() if isinstance(value, np.ndarray)}
        if isinstance(buffer, FrameStackReplayBuffer):
            shared = buffer.frame_capacity * int(np.prod(buffer.frame_shape))
            own = sum(arrays.values()) - arrays["frames"]
        else:
            shared, own = 0, sum(arrays.values())
        own += sum(entry.size for entry in first.files)
        # While one is written, the one that it will replace is still there.
        needed, free = shared + (self.keep + 1) * own, shutil.disk_usage(self.path).free
        if needed > free:
            raise CheckpointError(
                f"checkpoints in {self.path} will need up to {needed / 1e9:.2f} GB, but only {free / 1e9:.2f} GB are "
                "free there: choose another path, a smaller keep, or a smaller buffer_size."
            )

    def _on_rollout_start(self) -> None:
        if self.is_due() or self._signal is not None:
            self._save()
        if self._signal == signal.SIGINT:
            raise KeyboardInterrupt
        if self._signal is not None:
            raise SystemExit(128 + self._signal)

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
        if self.num_timesteps >= model._total_timesteps and self.num_timesteps > self._last_saved:
            self._save()

    def _save(self) -> None:
        model: Any = self.model
        self._last_tried = self.num_timesteps
        if model._overlapped is not None:
            model._overlapped.finish()
        try:
            generation = model._checkpoint_writer.write(model, self.keep)
        except OSError as error:
            warnings.warn(
                f"no checkpoint could be written to {self.path} after {self.num_timesteps} agent steps "
                f"({error.strerror}): training goes on, and the one after {self._last_saved} remains the last.",
                stacklevel=2,
            )
            return
        self._last_saved = self.num_timesteps
        if self.verbose >= 1:
            print(f"Checkpoint {generation.folder} after {self.num_timesteps} agent steps")

    @contextlib.contextmanager
    def _signals_noted(self) -> Iterator[None]:
        """SIGTERM and SIGINT are obeyed before the next step; a second one at once."""
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
