"""Replay buffers in files without pickle, of which the used part is written and read without a copy in memory."""

from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_cure.data.buffers import DictFrameStackReplayBuffer, FrameStackReplayBuffer
from sb3_cure.persistence.encoding import BUFFERS, ArchiveError, is_state, read_state, refusing, write_state
from sb3_cure.persistence.files import PathOrFile, reading, writing

_FRAME_COUNTERS = ("_n_valid", "_n_frames")
_ROWS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts", "marked")


def can_be_kept(kind: type) -> bool:
    """
    :param kind: Class of a replay buffer
    :return: Whether it is written without pickle, and so can be read back without trust
    """
    return kind in BUFFERS


def buffer_state(buffer: ReplayBuffer, frames: bool = True, leave_out: tuple[str, ...] = ()) -> dict[str, Any]:
    """
    :param buffer: A replay buffer
    :param frames: Whether the frames of a ``FrameStackReplayBuffer`` are among its arrays
    :param leave_out: Of these, arrays by row that another buffer has, too
    :return: What of it was written to, as plain values and views of its arrays
    """
    n_rows = buffer.buffer_size if buffer.full else buffer.pos
    state = {"class": type(buffer).__name__, "size": buffer.buffer_size, "n_envs": buffer.n_envs}
    counters = {"pos": int(buffer.pos), "full": bool(buffer.full), "n_added": int(getattr(buffer, "n_added", 0))}
    if isinstance(buffer, FrameStackReplayBuffer):
        rows = [name for name in buffer._ROW_ARRAYS if name not in leave_out]
        arrays = {name: getattr(buffer, name)[:n_rows] for name in rows} | {"_tails": buffer._tails}
        counters |= {name: int(getattr(buffer, name)) for name in _FRAME_COUNTERS}
        if frames:
            arrays["frames"] = buffer.frames[: buffer._n_frames]
        return {**state, "frame_capacity": buffer.frame_capacity, "counters": counters, "arrays": arrays}
    if isinstance(buffer, DictFrameStackReplayBuffer):
        state["images"] = {key: buffer_state(image, frames, buffer._ROW_ARRAYS) for key, image in buffer.images.items()}
    # The memory-efficient variant keeps the next observation in the next row.
    n_seen = min(n_rows + buffer.optimize_memory_usage, buffer.buffer_size)
    arrays = {}
    for name, array in _flat({name: getattr(buffer, name, None) for name in _ROWS}).items():
        arrays[name] = array[: n_seen if name.startswith("observations") else n_rows]
    return {**state, "counters": counters, "arrays": arrays}


def _flat(arrays: dict[str, Any]) -> dict[str, np.ndarray]:
    """Arrays by name, those in dictionaries (of Dict observations) by both names."""
    flat: dict[str, np.ndarray] = {}
    for name, value in arrays.items():
        if isinstance(value, dict):
            flat |= {f"{name}/{key}": part for key, part in value.items()}
        elif isinstance(value, np.ndarray):
            flat[name] = value
    return flat


def buffer_from_state(model: OffPolicyAlgorithm, state: dict[str, Any], name: str) -> ReplayBuffer:
    """
    :param model: The model that the replay buffer is for
    :param state: Of ``buffer_state``, with frames or without
    :param name: What to call its file
    :return: A replay buffer of the model's class, of the size that was saved; without frames, they have to follow
    :raises ArchiveError: if it does not fit the model or is damaged
    """
    with refusing(name):
        kind = model.replay_buffer_class
        if kind not in BUFFERS or kind is None or (state["class"], state["n_envs"]) != (kind.__name__, model.n_envs):
            own = "no replay buffer" if kind is None else f"a {kind.__name__}"
            raise ArchiveError(
                f"{name} holds a {state['class']} for {state['n_envs']} environments, but this model has {own} for "
                f"{model.n_envs}: load the replay buffer of a model with the same settings."
            )
        buffer = kind(
            state["size"] * model.n_envs,
            model.observation_space,
            model.action_space,
            device=model.device,
            n_envs=model.n_envs,
            optimize_memory_usage=model.optimize_memory_usage,
            **model.replay_buffer_kwargs,
        )
        _restore(buffer, state, name)
        return buffer


def _restore(buffer: Any, state: dict[str, Any], name: str, leave_out: tuple[str, ...] = ()) -> None:
    """Put counters and arrays into a new buffer, and into those that it is made of."""
    counters, images, given_images = state["counters"], getattr(buffer, "images", {}), state.get("images", {})
    kinds = {"n_added": int, **{key: type(value) for key, value in vars(buffer).items()}}
    vars(buffer).update({key: kinds[key](value) for key, value in counters.items()})
    if images.keys() != given_images.keys():
        raise ArchiveError(f"{name} has other images than this model: load the replay buffer of the same environment.")
    for key, image in images.items():
        if not counters.items() <= given_images[key]["counters"].items():
            raise ArchiveError(f"{name} has images that do not belong together: it is damaged.")
        _restore(image, given_images[key], name, buffer._ROW_ARRAYS)
    if isinstance(buffer, FrameStackReplayBuffer) and buffer._n_frames > 0:
        buffer.reserve_frames()
    own_state = buffer_state(buffer, "frames" in state["arrays"], leave_out)
    for key in ("frame_capacity", "counters"):
        if state.get(key) != own_state.get(key):
            raise ArchiveError(f"{name} has {key}={state.get(key)!s:.50}, not {own_state.get(key)}.")
    own, given = own_state["arrays"], state["arrays"]
    for key in sorted(own.keys() | given.keys()):
        here, there = (_kind(arrays.get(key)) for arrays in (own, given))
        if here != there:
            raise ArchiveError(
                f"{name} has {key:.50} as {there}, but this model's replay buffer needs {here}: load the replay "
                "buffer of a model with the same settings and environment."
            )
        own[key][...] = given[key]


def _kind(array: Any) -> str:
    return f"{array.dtype} of shape {array.shape}" if isinstance(array, np.ndarray) else str(type(array).__name__)


class SavesReplayBuffers(OffPolicyAlgorithm):
    """Mixin for an algorithm of SB3: replay buffers in files without pickle."""

    def save_replay_buffer(self, path: PathOrFile) -> None:
        """Save the used part of the replay buffer, without pickle and without a copy in memory.

        Buffers of classes that this package does not know, and ``HerReplayBuffer``, are pickled, as SB3 does.

        :param path: Path, whose folder is made and which gets the suffix ``.pkl`` if it has none, or a binary file
        """
        buffer = self.replay_buffer
        if buffer is None or not can_be_kept(type(buffer)):
            super().save_replay_buffer(path)
            return
        with writing(path, "pkl") as file:
            write_state(file, buffer_state(buffer))

    def load_replay_buffer(self, path: PathOrFile, truncate_last_traj: bool = True, *, trusted: bool = False) -> None:
        """Load a replay buffer, also one from a stranger.

        :param path: Path with or without its suffix ``.pkl``, or a binary file
        :param truncate_last_traj: For ``HerReplayBuffer``, as in SB3
        :param trusted: Also load what is pickled, which runs any code in it
        :raises ArchiveError: (a ``ValueError``) if the file is damaged, hostile, pickled, or does not fit the model
        """
        with reading(path, "pkl") as (file, name):
            if is_state(file):
                # Of a path, arrays stay in the file until they are copied.
                source = Path(file.name) if isinstance(path, str | Path) else file
                self.replay_buffer = buffer_from_state(self, read_state(source, copy=False), name)
            elif trusted:
                super().load_replay_buffer(path, truncate_last_traj)
            else:
                raise ArchiveError(
                    f"{name} is no replay buffer that was saved without pickle, and unpickling runs any code that is "
                    "in a file: if you know where it comes from, load it with trusted=True."
                )
        self.replay_buffer.device = self.device  # type: ignore[union-attr]
