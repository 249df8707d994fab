"""Replay buffers in files without pickle, of which the used part is written and read without a copy in memory."""

from pathlib import Path
from typing import Any

from numpy import ndarray
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_cure.data.buffers import FrameStackReplayBuffer, copy_arrays
from sb3_cure.persistence.encoding import BUFFERS, ArchiveError, is_state, read_state, refusing, write_state
from sb3_cure.persistence.files import PathOrFile, reading, writing

_ARRAYS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


def can_be_kept(kind: type) -> bool:
    """
    Whether replay buffers of a class are written without pickle, and so can be read back without trust.

    :param kind: Class of a replay buffer
    :return: Whether they are
    """
    return kind in BUFFERS


def buffer_state(buffer: ReplayBuffer, frames: bool = True) -> dict[str, Any]:
    """
    State of a replay buffer as plain values and views of the used part of its arrays.

    :param buffer: A replay buffer
    :param frames: Whether the frames of a ``FrameStackReplayBuffer`` are among its arrays
    :return: Class, size, number of environments, counters and arrays
    """
    state = {"class": type(buffer).__name__, "size": buffer.buffer_size, "n_envs": buffer.n_envs}
    if isinstance(buffer, FrameStackReplayBuffer):
        return {**state, **buffer.state_dict(frames)}
    return {**state, "counters": {"pos": buffer.pos, "full": buffer.full}, "arrays": _arrays_of(buffer)}


def _arrays_of(buffer: ReplayBuffer) -> dict[str, ndarray]:
    """Used part of the arrays of SB3's buffers; those of dictionaries by both names."""
    arrays: dict[str, ndarray] = {}
    for name in _ARRAYS:
        value = getattr(buffer, name, {})  # `optimize_memory_usage` does without next observations
        parts = {f"{name}/{key}": part for key, part in value.items()} if isinstance(value, dict) else {name: value}
        # ... but keeps the latest one in the row at `pos`.
        n_rows = buffer.size() + int(buffer.optimize_memory_usage and name == "observations")
        arrays |= {each: array[:n_rows] for each, array in parts.items()}
    return arrays


def buffer_from_state(model: OffPolicyAlgorithm, state: dict[str, Any], name: str) -> ReplayBuffer:
    """
    A new replay buffer of a model with the state of another one.

    :param model: The model that the replay buffer is for
    :param state: From ``buffer_state``, with frames or without
    :param name: Name of its file in messages
    :return: A replay buffer of the model's class, of the size that was saved; without frames, they have to follow
    :raises ArchiveError: If it does not fit the model or is damaged
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
        try:
            if isinstance(buffer, FrameStackReplayBuffer):
                buffer.load_state_dict(state)
            else:
                buffer.pos, buffer.full = int(state["counters"]["pos"]), bool(state["counters"]["full"])
                copy_arrays(_arrays_of(buffer), state["arrays"])
        except ValueError as error:
            fix = "load the replay buffer of a model with the same settings and environment"
            raise ArchiveError(f"{name} does not fit this model ({error}): {fix}.") from error
        return buffer


class SavesReplayBuffers(OffPolicyAlgorithm):
    """Mixin for an algorithm of SB3: replay buffers in files without pickle."""

    def save_replay_buffer(self, path: PathOrFile) -> None:
        """
        Save the used part of the replay buffer, without pickle and without a copy in memory.

        Buffers of classes that this package does not know, and ``HerReplayBuffer``, are pickled, as SB3 does.

        :param path: Path, with a folder that is made and the suffix ``.pkl`` if it has none, or a binary file
        """
        buffer = self.replay_buffer
        if buffer is None or not can_be_kept(type(buffer)):
            super().save_replay_buffer(path)
            return
        with writing(path, "pkl") as file:
            write_state(file, buffer_state(buffer))

    def load_replay_buffer(self, path: PathOrFile, truncate_last_traj: bool = True, *, trusted: bool = False) -> None:
        """
        Load a replay buffer, also one from a stranger.

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
