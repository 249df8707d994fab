"""Checkpoints from which a training continues as if it had not been killed."""

import hashlib
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_cure.data.buffers import FrameStackReplayBuffer
from sb3_cure.data.frame_ring import FrameRing
from sb3_cure.persistence.encoding import read_state, write_state
from sb3_cure.persistence.env_state import saved_error
from sb3_cure.persistence.files import flush_to_disk, locked
from sb3_cure.persistence.generations import CheckpointError, Generations
from sb3_cure.persistence.replay_buffers import buffer_from_state
from sb3_cure.persistence.resume import Run, training_state

MODEL, STATE = "model.zip", "state.safetensors"
#: How long a checkpoint waits for one that another process writes
LOCK_SECONDS = 300


class _Segment(NamedTuple):
    """File with the frames ``first`` to ``last`` (exclusive) of a ring."""

    name: str
    first: int
    last: int
    digest: str


class CheckpointFolder:
    """Writes a model's checkpoints into one folder, each frame of its replay buffer once, and reads them.

    :param path: Folder
    """

    def __init__(self, path: str | Path):
        self.generations = Generations(path)
        #: Rings of the replay buffer, and which of their frames are in files, by the key of their image
        self.rings: dict[str, FrameRing] = {}
        self.segments: dict[str, list[_Segment]] = {}

    def write(self, model: OffPolicyAlgorithm, run: Run, keep: int) -> dict[str, Any]:
        """Write a checkpoint.

        :param model: Model between an update and the next step of the environments
        :param run: Its training
        :param keep: Number of latest checkpoints to keep
        :return: The training state that was written
        :raises OSError: if it could not be written; the checkpoints are then as before
        """
        model._before_save()  # type: ignore[attr-defined]  # deferred updates draw random numbers
        state = training_state(model, run)
        buffer: Any = model.replay_buffer
        segments: dict[str, list[_Segment]] = {}
        if not self.generations.numbers():  # removed meanwhile, and the files of frames with them
            self.rings = {}
        # Locked, so that a second training in this folder, which is refused, removes no file that this one writes.
        with locked(self.generations.path, LOCK_SECONDS), self.generations.writing(keep) as draft:
            model.save(draft.folder / MODEL)
            for place, (key, ring) in enumerate(buffer.rings.items()):
                segments[key] = self._write_frames(ring, buffer.counts[key], key, f"{place}-{draft.number:06d}")
                draft.sums.update({f"../segments/{each.name}": each.digest for each in segments[key]})
            state["buffer"] = buffer.state_dict(frames=False)
            state["segments"] = {key: [list(each) for each in own] for key, own in segments.items()}
            write_state(draft.folder / STATE, state)
        self.rings, self.segments = buffer.rings, segments
        return state

    def _write_frames(self, ring: FrameRing, last: int, key: str, suffix: str) -> list[_Segment]:
        """Write new frames up to number ``last``, and leave out segments that the ring has overwritten."""
        oldest = max(last - ring.capacity, 0)
        known = self.segments[key] if self.rings.get(key) is ring else []
        segments = [segment for segment in known if segment.last > oldest]
        first = max(segments[-1].last if segments else 0, oldest)
        if first < last:
            path = self.generations.segments / f"frames-{first}-{last}-{suffix}.bin"
            digest = hashlib.sha256()
            with path.open("wb") as file:
                for piece in ring.pieces(first, last):
                    digest.update(piece)
                    file.write(piece)
            flush_to_disk(path)
            segments.append(_Segment(path.name, first, last, digest.hexdigest()))
        return segments

    def read(self, model: Any, folder: Path) -> dict[str, Any]:
        """Give a model that was loaded from a checkpoint's archive its replay buffer.

        :param model: Model
        :param folder: Folder of the checkpoint
        :return: Training state
        :raises ArchiveError: if it was written with another number of environments
        """
        state = read_state(folder / STATE)
        buffer = model.replay_buffer = buffer_from_state(model, state.pop("buffer"), str(folder))
        self.rings = buffer.rings
        self.segments = {key: [_Segment(*each) for each in own] for key, own in state.pop("segments").items()}
        for key, ring in self.rings.items():
            for segment in self.segments[key]:
                first = max(segment.first, buffer.counts[key] - ring.capacity)
                with (self.generations.segments / segment.name).open("rb") as file:
                    file.seek((first - segment.first) * int(np.prod(ring.frame_shape)))
                    for piece in ring.pieces(first, segment.last):
                        file.readinto(piece)
        return state


class ExactCheckpoint(BaseCallback):
    """Keep checkpoints from which ``resume`` continues exactly where the training was killed.

    A checkpoint holds networks, optimizers, temperatures, running statistics, schedules, counters, the replay buffer,
    all random streams, the state of the environments, and plain attributes of callbacks or their ``state_dict()``.
    Frames are written once: a checkpoint adds the new ones. It is written under another name, flushed to the disk,
    checksummed and renamed; until then the former checkpoints stay in place. One is written when training starts and
    one when it ends, unless a callback ends it.

    On the CPU with ``precision="fp32"`` the resumed training equals one without interruption bit for bit (with
    ``overlap=True``, whose updates lag behind, it does not). Environments whose state cannot be kept begin a new
    episode instead, with a warning.

    :param save_freq: Agent steps between two checkpoints (of all environments together)
    :param path: Folder for the checkpoints of this training, made if missing
    :param keep: Number of latest checkpoints to keep
    :param verbose: 1 prints each checkpoint
    :raises ValueError: if a number is below 1, or, before training starts, if the folder holds checkpoints of another
        training
    """

    def __init__(self, save_freq: int, path: str | Path, keep: int = 3, verbose: int = 0):
        super().__init__(verbose)
        if save_freq < 1 or keep < 1:
            raise ValueError(f"save_freq and keep must be at least 1 (save_freq={save_freq}, keep={keep})")
        self.save_freq, self.path, self.keep = save_freq, Path(path), keep
        self._last_saved = self._last_tried = 0

    @staticmethod
    def exists(path: str | Path) -> bool:
        """Check whether there is a checkpoint to resume from.

        :param path: Folder for checkpoints
        :return: Whether there is one
        """
        return bool(Generations(path).numbers())

    def is_due(self) -> bool:
        """Check before a rollout whether to write a checkpoint.

        :return: Whether to write one
        """
        return self.num_timesteps // self.save_freq > self._last_tried // self.save_freq

    def save_if_due(self) -> None:
        """Write a checkpoint if one is due; called before each rollout, between an update and the next step.

        ``_on_rollout_start`` would be too late: other callbacks may have run already, and would run again when resumed.
        """
        if self.is_due():
            self._save()

    @property
    def _run(self) -> Run:
        return self.model._run  # type: ignore[attr-defined]

    def _init_callback(self) -> None:
        name = type(self.model).__name__
        if not isinstance(getattr(self.model, "_run", None), Run):
            raise ValueError(f"ExactCheckpoint needs an algorithm that can resume, not {name}: use CheckpointCallback.")
        if type(self.model.replay_buffer) is not FrameStackReplayBuffer:  # type: ignore[attr-defined]
            raise ValueError(
                f"ExactCheckpoint can only save a FrameStackReplayBuffer: give {name} "
                "replay_buffer_class=FrameStackReplayBuffer, replay_buffer_kwargs=dict(frame_stack=1)."
            )
        path = self.path.resolve()
        if path not in self._run.writers and self.exists(path):
            raise CheckpointError(
                f"{self.path} holds checkpoints of another training: continue it by "
                f"{name}.resume({str(self.path)!r}, env), or choose another path, or remove that folder."
            )
        path.mkdir(parents=True, exist_ok=True)
        self._run.writers.setdefault(path, CheckpointFolder(path))
        self._folder = path  # whatever the working directory is later

    def _on_training_start(self) -> None:
        if getattr(self.model, "overlap", False):
            warnings.warn("with overlap=True a resumed training is not bit for bit the same.", stacklevel=2)
        self._last_saved = self._last_tried = self.num_timesteps
        if self._run.resumed is None:
            self._write()

    def _on_step(self) -> bool:
        return True

    def _on_training_end(self) -> None:
        # If another callback stopped it, the last step was not stored: the checkpoint before stays the last one.
        steps = self.model.num_timesteps
        if steps >= self.model._total_timesteps and steps > self._last_saved:
            self._save()

    def _save(self) -> None:
        self.num_timesteps = self._last_tried = self.model.num_timesteps
        try:
            self._write()
        except OSError as error:
            warnings.warn(
                f"no checkpoint could be written to {self.path} after {self.num_timesteps} agent steps ({error}): "
                f"training continues, and the one after {self._last_saved} remains the last.",
                stacklevel=2,
            )
            return
        self._last_saved = self.num_timesteps
        if self.verbose >= 1:
            print(f"Checkpoint in {self.path} after {self.num_timesteps} agent steps")

    def _write(self) -> None:
        """Write a checkpoint, and warn of what it cannot hold; Python shows a warning of equal text once."""
        writer = self._run.writers[self._folder]
        state = writer.write(self.model, self._run, self.keep)
        reason = saved_error(state["environments"])
        if reason is not None:
            warnings.warn(
                f"checkpoints cannot keep the state of the environments, as {reason}: a resumed training begins a new "
                "episode, without what was set on them (state_dict() and load_state_dict(state) avoid this).",
                stacklevel=1,
            )
        for name in sorted({name for own in state["callbacks"] for name in own["missing"]}):
            warnings.warn(f"checkpoints do not keep {name}.", stacklevel=1)
