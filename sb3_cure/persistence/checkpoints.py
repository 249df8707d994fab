"""Checkpoints from which a training goes on as if it had not been killed."""

import contextlib
import hashlib
import shutil
import signal
import sys
import threading
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_cure.data.buffers import FrameStackReplayBuffer
from sb3_cure.data.frame_ring import FrameRing
from sb3_cure.persistence.encoding import read_state, write_state
from sb3_cure.persistence.env_state import why_not_restorable
from sb3_cure.persistence.files import flush_to_disk
from sb3_cure.persistence.generations import CheckpointError, Generation, Generations
from sb3_cure.persistence.replay_buffers import buffer_from_state, buffer_state, can_be_kept
from sb3_cure.persistence.resume import Run, log_files, training_state

MODEL, STATE, BUFFER = "model.zip", "state.safetensors", "replay_buffer.safetensors"


class CheckpointWriter:
    """Writes a model's checkpoints into one folder; knows which frames lie there already.

    :param path: The folder
    """

    def __init__(self, path: str | Path):
        self.generations = Generations(path)
        # Of each ring of frames, its files: name, numbers of the first frame and after the last one, and checksum
        self._segments: dict[str, list[tuple[str, int, int, str]]] = {}
        # The rings that they hold the frames of
        self._rings: dict[str, FrameRing] = {}

    def continue_from(self, generation: Generation, state: dict[str, Any], buffer: ReplayBuffer | None) -> None:
        """
        :param generation: The checkpoint from which a model was just restored, frames and all
        :param state: Its training state
        :param buffer: The model's replay buffer
        """
        for key, ring in rings_of(buffer).items():
            segments = state["segments"][key]
            self._segments[key] = [(*segment, generation.sums[f"../segments/{segment[0]}"]) for segment in segments]
            self._rings[key] = ring

    def write(
        self, model: OffPolicyAlgorithm, run: Run, keep: int, environments_may_be_gone: bool = False
    ) -> Generation:
        """
        :param model: The model, between an update and the next step of the environments
        :param run: What it knows of its training
        :param keep: Number of latest checkpoints to keep
        :param environments_may_be_gone: Whether to do without the environments' state if they do not answer
        :return: What was written
        :raises OSError: if it could not be; the checkpoints are then as before
        """
        state = training_state(model, run, environments_may_be_gone)
        buffer: Any = model.replay_buffer
        rings = rings_of(buffer)
        segments: dict[str, list[tuple[str, int, int, str]]] = {}

        def fill(folder: Path, number: int) -> dict[str, str]:
            model.save(folder / MODEL)
            if rings:
                state["buffer"] = buffer_state(buffer, frames=False)
                for place, (key, ring) in enumerate(rings.items()):
                    segments[key] = self._write_frames(ring, buffer.counts[key], number, key, place)
                state["segments"] = {key: [list(segment[:3]) for segment in each] for key, each in segments.items()}
            else:
                model.save_replay_buffer(folder / BUFFER)
            for i, output in enumerate(log_files(model.logger)):
                shutil.copyfile(output.file.name, folder / f"log-{i}")
            write_state(folder / STATE, state)
            return {name: digest for each in segments.values() for name, _, _, digest in each}

        generation = self.generations.write(fill, keep)
        self._segments = segments
        self._rings = rings
        return generation

    def _write_frames(
        self, ring: FrameRing, last: int, number: int, key: str, place: int
    ) -> list[tuple[str, int, int, str]]:
        """Only those frames that no segment has; segments that the ring has overwritten are left out."""
        oldest = max(last - ring.capacity, 0)
        known = self._segments[key] if self._rings.get(key) is ring else []
        segments = [segment for segment in known if segment[2] > oldest]
        first = max(segments[-1][2] if segments else 0, oldest)
        if first < last:
            which = f"{place}-" if key else ""
            path = self.generations.segments / f"frames-{which}{first}-{last}-{number:06d}.bin"
            digest = hashlib.sha256()
            with path.open("wb") as file:
                for piece in ring.pieces(first, last):
                    digest.update(piece)
                    file.write(piece)
            flush_to_disk(path)
            segments.append((path.name, first, last, digest.hexdigest()))
        return segments


def rings_of(buffer: ReplayBuffer | None) -> dict[str, FrameRing]:
    """
    :param buffer: A replay buffer
    :return: The rings of frames in it, by the key of their image
    """
    return buffer.rings if isinstance(buffer, FrameStackReplayBuffer) else {}


def load_checkpoint(model: Any, generation: Generation, lost: list[Path]) -> dict[str, Any]:
    """Give a model, which was loaded from a checkpoint's archive, its replay buffer.

    :param model: The model
    :param generation: The checkpoint
    :param lost: Files of frames that are damaged
    :return: The training state
    :raises CheckpointError: if it does not fit the environments
    """
    folder = generation.folder
    state = read_state(folder / STATE)
    if model.n_envs != state["n_envs"]:
        raise CheckpointError(
            f"resume got {model.n_envs} environments, but the checkpoint {folder} is of a training with "
            f"{state['n_envs']}: give as many."
        )
    if "buffer" not in state:
        model.load_replay_buffer(folder / BUFFER, truncate_last_traj=False)
        return state
    if model.replay_buffer_class is not FrameStackReplayBuffer:
        raise CheckpointError(
            f"the checkpoint {folder} has single frames, but this model's replay buffer is a "
            f"{type(model.replay_buffer).__name__}: resume with environments that tell the same frame_stack."
        )
    buffer: Any = buffer_from_state(model, state["buffer"], str(folder))
    model.replay_buffer = buffer
    lost_names = {path.name for path in lost}
    for key, ring in rings_of(buffer).items():
        for name, first, last in state["segments"][key]:
            if name in lost_names:
                _forget_frames_before(buffer, key, last)
                continue
            if f"../segments/{name}" not in generation.sums:
                raise CheckpointError(f"{folder} lacks the checksum of {name}")
            kept = max(first, buffer.counts[key] - ring.capacity)
            with (folder.parent / "segments" / name).open("rb") as file:
                file.seek((kept - first) * int(np.prod(ring.frame_shape)))
                for piece in ring.pieces(kept, last):
                    file.readinto(piece)
    return state


def _forget_frames_before(buffer: FrameStackReplayBuffer, key: str, number: int) -> None:
    """Give up the rows that need older frames; frame numbers never fall from row to row."""
    newest_first = (buffer.pos - 1 - np.arange(buffer._n_valid)) % buffer.buffer_size
    ring, count = buffer.rings[key], buffer.counts[key]
    oldest = count - 1 - (count - 1 - buffer.rows[f"slots/{key}"][newest_first, :, 0, 0]) % ring.capacity
    kept = int((oldest.min(axis=1) >= number).sum())
    warnings.warn(
        f"{buffer._n_valid - kept} of {buffer._n_valid} rows of the replay buffer are lost with their frames: training "
        "goes on without them, and no longer exactly as without the interruption.",
        stacklevel=5,
    )
    buffer._n_valid = kept


def newest_usable(path: str | Path) -> tuple[Generation, list[Path]]:
    """
    :param path: A folder of checkpoints
    :return: The newest one that is whole, or else lacks nothing but frames; and the files that it lacks
    :raises CheckpointError: if there is none
    """
    generations = Generations(path)
    numbers = generations.numbers()
    if not numbers:
        raise CheckpointError(
            f"there is no checkpoint in {path}: give the path of an ExactCheckpoint that has begun a training, or "
            "start one."
        )
    reasons: list[str] = []
    without_frames = []
    for number in reversed(numbers):
        try:
            generation = generations.read(number)
        except CheckpointError as error:
            reasons.append(str(error))
            continue
        damaged = generation.damaged()
        if not damaged:
            _tell(reasons, f"Resuming from {generation.folder.name} instead")
            return generation, []
        reasons += [f"{each} is damaged or missing" for each in damaged]
        if all(each.parent.name == "segments" for each in damaged):
            without_frames.append((generation, damaged))
    if not without_frames:
        raise CheckpointError(f"no checkpoint in {path} is whole ({'; '.join(reasons)}): start anew.")
    generation, damaged = without_frames[0]
    _tell(reasons, f"Resuming from {generation.folder.name} without the transitions that need what is damaged")
    return generation, damaged


def _tell(reasons: list[str], consequence: str) -> None:
    if reasons:
        warnings.warn(f"{'; '.join(dict.fromkeys(reasons))}. {consequence}.", stacklevel=4)


class ExactCheckpoint(BaseCallback):
    """Keep checkpoints from which ``resume`` goes on exactly where the training was killed.

    A checkpoint holds networks, optimisers, temperatures, running statistics, schedules, counters, the replay buffer,
    all random streams, the state of the environments where they offer it, what was logged, and the public attributes
    of the callbacks that are plain Python, NumPy or torch. The frames of a ``FrameStackReplayBuffer`` are written once:
    a checkpoint adds the new ones. It is written aside, flushed to the disk, checksummed and renamed; until then the
    former ones count. One is written when training starts and one when it ends, unless a callback ends it.

    On the CPU with ``precision="fp32", compile=False`` the resumed run equals one without interruption bit for bit
    (with ``overlap=True``, whose updates lag behind, it does not). Environments that cannot tell their state begin a
    new episode instead, which is said when training starts; ``VecNormalize`` and Gymnasium's ``NormalizeReward`` go on
    with their statistics. On SIGTERM and SIGINT a checkpoint is written before the next rollout (with ``train_freq=1``:
    the next step), then the process leaves with the status that the signal asks for. Workers of SB3's
    ``SubprocVecEnv`` die of a Ctrl-C in a terminal: their episodes then begin anew.

    :param save_freq: Agent steps between two checkpoints (of all environments together)
    :param path: Folder for the checkpoints of this training, made if missing
    :param keep: Number of latest checkpoints to keep
    :param verbose: 1 prints each checkpoint
    :raises ValueError: if a number is below 1, or the folder holds checkpoints of another training or cannot be written
        to; all of this before training starts
    """

    def __init__(self, save_freq: int, path: str | Path, keep: int = 3, verbose: int = 0):
        super().__init__(verbose)
        if save_freq < 1 or keep < 1:  # the one would never save, the other would remove what it has saved
            raise ValueError(f"ExactCheckpoint got save_freq={save_freq}, keep={keep}: both must be at least 1.")
        self.save_freq, self.path, self.keep = save_freq, Path(path), keep
        self._last_saved = self._last_tried = 0
        self._signal: int | None = None
        self._writer = CheckpointWriter(self.path)

    @staticmethod
    def exists(path: str | Path) -> bool:
        """
        :param path: Folder for checkpoints
        :return: Whether there is one, from which ``resume`` can go on
        """
        return bool(Generations(path).numbers())

    @property
    def _run(self) -> Run:
        return self.model._run  # type: ignore[attr-defined]

    def _init_callback(self) -> None:
        name = type(self.model).__name__
        if not isinstance(getattr(self.model, "_run", None), Run):
            raise ValueError(f"ExactCheckpoint got a {name}, which cannot resume: use SB3's CheckpointCallback.")
        buffer = self.model.replay_buffer  # type: ignore[attr-defined]
        if not can_be_kept(type(buffer)):
            raise ValueError(
                f"ExactCheckpoint got a model whose replay buffer is a {type(buffer).__name__}, which it cannot read "
                "back without pickle: train with a FrameStackReplayBuffer or one of SB3's (but HerReplayBuffer)."
            )
        writer = self._run.writers.get(self.path.resolve())
        if writer is None:
            if self.exists(self.path):
                raise CheckpointError(
                    f"{self.path} holds checkpoints of another training: go on with it by "
                    f"{name}.resume({str(self.path)!r}, env), or choose another path, or remove that folder."
                )
            writer = CheckpointWriter(self.path)
        self.path.mkdir(parents=True, exist_ok=True)
        self._run.leaving.callback(writer.generations.lock().release)
        self._writer = self._run.writers[self.path.resolve()] = writer
        self._run.leaving.enter_context(self._signals_noted())
        # Before any callback hears of the rollout: when it is resumed, all of them do.
        self._run.before_rollout.append(self._look)

    def _on_training_start(self) -> None:
        for setting in ("overlap", "use_sde"):
            if getattr(self.model, setting, False):
                warnings.warn(
                    f"ExactCheckpoint with {setting}=True: a resumed training goes on, but not bit for bit as without "
                    "the interruption.",
                    stacklevel=2,
                )
        assert self.model.env is not None
        reason = why_not_restorable(self.model.env)
        if reason is not None:
            warnings.warn(
                f"ExactCheckpoint cannot keep the state of the environments, as {reason}: a resumed training begins "
                "with a new episode.",
                stacklevel=2,
            )
        self._last_saved = self._last_tried = self.num_timesteps
        if self._run.resumed is None:
            self._writer.write(self.model, self._run, self.keep)  # type: ignore[arg-type]

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
        steps = self.model.num_timesteps
        if steps >= self.model._total_timesteps and steps > self._last_saved:
            self._save()

    def _save(self) -> None:
        model: Any = self.model
        self.num_timesteps = self._last_tried = model.num_timesteps
        model._before_checkpoint()
        try:
            generation = self._writer.write(model, self._run, self.keep, self._signal is not None)
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
