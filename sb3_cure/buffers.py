"""Replay buffer for stacked images that keeps every frame once."""

import itertools
import math
import os
import tempfile
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecEnv, VecFrameStack, VecNormalize, unwrap_vec_wrapper

from sb3_cure.values import check_folder, is_integer

try:
    import psutil
except ImportError:
    psutil = None  # type: ignore[assignment]


class Samples(NamedTuple):
    """A batch of one-step transitions, as heads, rewards and critics get it.

    :param observations: As stored, images unscaled in 0-255, [B, *shape]
    :param actions: Executed actions in [-1, 1], [B, action_dim]
    :param next_observations: As stored, [B, *shape]
    :param dones: 1 where the episode terminated (time limits do not count), [B, 1]
    :param rewards: The task's rewards, [B, 1]
    :param discounts: Discounts of SB3's n-step buffer, [B, 1]; None for single steps
    :param views: What the encoder saw of the observations, before scaling, [B, *view shape]
    """

    observations: th.Tensor
    actions: th.Tensor
    next_observations: th.Tensor
    dones: th.Tensor
    rewards: th.Tensor
    discounts: th.Tensor | None = None
    views: th.Tensor = None  # type: ignore[assignment]


#: Keys of ``info`` that mark a transition which is never to be sampled: ``FaultTolerantSubprocVecEnv`` sets
#: ``env_fault`` where an environment failed in it, ``CuReSAC(on_bad_transition="skip")`` sets ``bad_transition``.
MARKS = ("env_fault", "bad_transition")


def is_marked(info: Mapping[str, Any]) -> bool:
    """
    :param info: What an environment told of a transition
    :return: Whether that transition is never to be sampled
    """
    return any(info.get(mark) is not None for mark in MARKS)


def unmarked(buffer: ReplayBuffer, rows: np.ndarray, env_inds: np.ndarray) -> npt.NDArray[np.bool_]:
    """
    :param buffer: A replay buffer
    :param rows: Row positions, [n]
    :param env_inds: Environment of each, [n]
    :return: Which of these transitions can be sampled, [n]
    """
    return ~buffer.marked[rows, env_inds] if isinstance(buffer, _SkipsMarked) else np.ones(len(rows), dtype=bool)


class _SkipsMarked(ReplayBuffer):
    """
    What a replay buffer needs that never samples marked transitions (see ``MARKS``).

    Rows hold the transitions of all environments, so that one of them cannot be left out: its place is kept and marked.
    Where a marked one is drawn, another is drawn in its stead from all those that are not marked, so that sampling
    stays uniform. As long as none is drawn, the random numbers used are SB3's.
    """

    marked: npt.NDArray[np.bool_]  # [buffer_size, n_envs]
    #: Rows and environments of the latest batch, [batch_size] each
    last_sampled: tuple[np.ndarray, np.ndarray] | None = None

    def _mark(self, infos: list[dict[str, Any]]) -> npt.NDArray[np.bool_]:
        """
        Mark what ``infos`` say of the row at ``pos``, which must not have been moved yet, and of rows before it.

        :param infos: One dictionary per environment; ``env_fault_steps`` tells how many of its latest transitions,
            this one included, are marked (by default 1)
        :return: Which transitions of the row are marked, [n_envs]
        """
        marks = np.array([is_marked(info) for info in infos])
        self.marked[self.pos] = marks
        for i in np.flatnonzero(marks):
            n_steps = min(infos[i].get("env_fault_steps", 1), self.buffer_size)
            self.marked[(self.pos - np.arange(n_steps)) % self.buffer_size, i] = True
        return marks

    def _without_marked(self, rows: np.ndarray, env_inds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """
        :param rows: Row positions that were drawn, [n]
        :param env_inds: Environment of each, [n]
        :return: The same, but others where these are marked
        :raises ValueError: If all transitions are marked
        """
        bad = self.marked[rows, env_inds]
        if not bad.any():
            return rows, env_inds
        stored = (self.pos - 1 - np.arange(self.size())) % self.buffer_size
        good_rows, good_envs = np.nonzero(~self.marked[stored])
        if len(good_rows) == 0:
            raise ValueError(
                f"All {self.size() * self.n_envs} transitions in the replay buffer are marked as faulty, but at least "
                "one good one is needed to learn from: raise learning_starts, or mend the environments."
            )
        drawn = np.random.randint(0, len(good_rows), size=int(bad.sum()))
        rows, env_inds = rows.copy(), env_inds.copy()
        rows[bad], env_inds[bad] = stored[good_rows[drawn]], good_envs[drawn]
        return rows, env_inds

    def _get_samples(self, batch_inds: np.ndarray, env: VecNormalize | None = None) -> ReplayBufferSamples:
        """
        Transitions of the given rows, each of a randomly drawn environment; other rows where these are marked.

        :param batch_inds: Row positions in [0, buffer_size): the row that ``add`` wrote when ``pos`` had this value,
            [batch_size]
        :param env: VecEnv to normalize the observations and rewards with
        :return: Batch on ``device``
        :raises IndexError: If a row of a ``FrameStackReplayBuffer`` is empty, or its frames have been overwritten
        """
        env_inds = np.random.randint(0, high=self.n_envs, size=(len(batch_inds),))
        self.last_sampled = self._without_marked(batch_inds, env_inds)
        return transitions(self, *self.last_sampled, env)


class SkippingReplayBuffer(_SkipsMarked):
    """
    SB3's ``ReplayBuffer``, which never samples transitions whose ``info`` is marked (see ``MARKS``).

    For SB3's algorithms on a ``FaultTolerantSubprocVecEnv``: ``SAC(..., replay_buffer_class=SkippingReplayBuffer)``.
    ``CuReSAC`` needs no telling. Without marks it returns the same batches as ``ReplayBuffer``, bit for bit.

    :param args: As of ``ReplayBuffer``
    :param kwargs: As of ``ReplayBuffer``
    :raises ValueError: If ``optimize_memory_usage`` is set
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._start_marking()

    def _start_marking(self) -> None:
        if self.optimize_memory_usage:
            raise ValueError(
                "optimize_memory_usage is True, but then a transition cannot be left out, as its observation is the "
                "next one of another: leave it False."
            )
        self.marked = np.zeros((self.buffer_size, self.n_envs), dtype=bool)

    def add(
        self,
        obs: np.ndarray,
        next_obs: np.ndarray,
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """
        Store one transition per environment; of marked ones nothing but the mark.

        :param obs: Observations, [n_envs, ...]
        :param next_obs: Successors
        :param action: Actions, [n_envs, ...]
        :param reward: Rewards, [n_envs]
        :param done: Whether the episode ended, [n_envs]
        :param infos: One dictionary per environment
        """
        row, marks = self.pos, self._mark(infos)
        super().add(obs, next_obs, action, reward, done, infos)
        for array in (self.observations, self.next_observations, self.actions, self.rewards):
            array[row, marks] = 0


def why_not_skipping(buffer: ReplayBuffer) -> str | None:
    """
    :param buffer: A replay buffer
    :return: Why it cannot leave transitions out, and what to do, as the end of a sentence; None if it can
    """
    if isinstance(buffer, _SkipsMarked):
        return None
    if type(buffer) is not ReplayBuffer:
        kind = type(buffer).__name__
        return f"which a {kind} cannot do: train with SB3's ReplayBuffer or a FrameStackReplayBuffer."
    if buffer.optimize_memory_usage:
        return (
            "which it cannot do with optimize_memory_usage=True, as its observation is the next one of another: leave "
            "it False."
        )
    return None


def skip_marked(buffer: ReplayBuffer, infos: list[dict[str, Any]]) -> None:
    """
    Before a row is added: see to it that a replay buffer never samples what is marked in it.

    SB3's ``ReplayBuffer`` becomes a ``SkippingReplayBuffer`` with the first mark that it meets.

    :param buffer: A replay buffer
    :param infos: What it is about to be given
    :raises ValueError: If there is a mark and the buffer is of a class that cannot skip it
    """
    if isinstance(buffer, _SkipsMarked):
        return
    told = [info[mark] for info in infos for mark in MARKS if info.get(mark) is not None]
    if not told:
        return
    reason = why_not_skipping(buffer)
    if reason is not None:
        raise ValueError(f"A transition is to be left out of the replay buffer ({told[0]}), {reason}")
    # In place, as a rollout under way holds this very object.
    buffer.__class__ = SkippingReplayBuffer
    buffer._start_marking()  # type: ignore[attr-defined]


class FrameStackReplayBuffer(_SkipsMarked):
    """
    SB3's ``ReplayBuffer`` for stacks of uint8 images, in about a sixth of its memory (three stacked frames).

    Two consecutive observations share all their frames but one, and an observation and its successor do so again.
    The buffer therefore keeps one ring of frames for all environments, and per transition only the positions of its
    ``2 * frame_stack`` frames in that ring; stacks are rebuilt when they are sampled. With equal seeds and an equal
    stream it returns the same batches as ``ReplayBuffer``, bit for bit.

    Nothing is assumed about the stream: where an observation does not continue the stored one (after a reset,
    another ``learn()``, ``set_env`` or ``load``), its frames are stored anew. The ring has room for 4 % more frames
    than transitions, enough for episodes of 25 steps and more. Where streams break more often than that, the oldest
    rows (one row: the transitions of all environments at one time) are given up: they are never sampled and
    ``size()`` does not count them.

    Transitions whose ``info`` is marked (see ``MARKS``) are never sampled either, and nothing of them is kept.

    :param buffer_size: Max number of transitions, over all environments
    :param observation_space: uint8 ``Box`` of shape (frame_stack * c, height, width), oldest frame first
    :param action_space: Action space
    :param device: PyTorch device of the sampled tensors
    :param n_envs: Number of parallel environments
    :param optimize_memory_usage: Only ``False``: sharing frames already saves more than SB3's variant does
    :param handle_timeout_termination: Handle timeout termination (due to timelimit) separately and treat the task
        as an infinite horizon task
    :param frame_stack: Number of frames in one observation, which its number of channels cannot tell
    :param frames_dir: Keep the frames in an unnamed file in this directory, mapped into memory, instead of in memory:
        a million transitions of 84x84 take 22 GB. The last directory of the path is made if there is none.
        The room is reserved by the first ``add`` and given back at the end
    :raises ValueError: If the observation space is not made of ``frame_stack`` uint8 images, channels first, or if
        ``optimize_memory_usage`` is set
    """

    # Room for the one frame that every episode has more than steps; with the index table and the action this stays
    # below 1.05 frames per transition for images of 84x84.
    SPARE_FRAMES = 0.04
    # What `pos` and the frame counter index: only the used part of these is pickled.
    _ROW_ARRAYS = ("frame_slots", "oldest_frame", "actions", "rewards", "dones", "timeouts", "marked")

    #: Another one for each sequence of frame numbers: `reset` begins them anew, and so does every other buffer
    frame_numbers: object
    frames: npt.NDArray[np.uint8]  # [frame_capacity, c, height, width]
    frame_slots: npt.NDArray[np.int32]  # [buffer_size, n_envs, 2 (obs, next_obs), frame_stack], positions in `frames`
    oldest_frame: npt.NDArray[np.int64]  # [buffer_size], running number of the oldest frame that the row needs

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        device: th.device | str = "auto",
        n_envs: int = 1,
        optimize_memory_usage: bool = False,
        handle_timeout_termination: bool = True,
        *,
        frame_stack: int,
        frames_dir: str | Path | None = None,
    ):
        _check_arguments(observation_space, frame_stack, optimize_memory_usage)
        if not (is_integer(buffer_size, 1) and is_integer(n_envs, 1)):
            raise ValueError(
                f"buffer_size is {buffer_size!r} and n_envs {n_envs!r}, but both must be whole numbers of at least 1: "
                "change them."
            )
        if frames_dir is not None:
            check_folder("frames_dir", frames_dir)
        # As SB3's DictReplayBuffer does: ReplayBuffer's constructor would allocate what this class avoids
        super(ReplayBuffer, self).__init__(buffer_size, observation_space, action_space, device, n_envs=n_envs)
        self.buffer_size = max(buffer_size // n_envs, 1)
        self.optimize_memory_usage = False
        self.handle_timeout_termination = handle_timeout_termination
        self.frame_stack = frame_stack
        channels, height, width = self.obs_shape
        self.frame_shape = (channels // frame_stack, height, width)
        # The constant part is what one `add` may write (two whole stacks per environment), plus the first stack, so
        # that not even the smallest buffer overwrites a frame of the row it is writing.
        self._max_frames_per_add = 2 * frame_stack * n_envs
        self.frame_capacity = (
            math.ceil((1 + self.SPARE_FRAMES) * self.buffer_size * n_envs)
            + self._max_frames_per_add
            + frame_stack * n_envs
        )

        self.frames_dir = frames_dir
        # Fresh zeros cost no memory until they are written to
        rows = (self.buffer_size, n_envs)
        # A file is reserved when it is needed: a model that is loaded to act needs none.
        shape = (self.frame_capacity if frames_dir is None else 0, *self.frame_shape)
        try:
            self.frames = np.zeros(shape, dtype=np.uint8)
        except MemoryError as error:
            raise ValueError(
                f"buffer_size is {buffer_size}, for which the frames need {math.prod(shape) / 1e9:.0f} GB of memory: "
                "make it smaller, or keep the frames on a disk with replay_buffer_kwargs=dict(frames_dir=...)."
            ) from error
        self.frame_slots = np.zeros((*rows, 2, frame_stack), dtype=np.int32)
        self.oldest_frame = np.zeros(self.buffer_size, dtype=np.int64)
        self.actions = np.zeros((*rows, self.action_dim), dtype=self._maybe_cast_dtype(action_space.dtype))
        self.rewards = np.zeros(rows, dtype=np.float32)
        self.dones = np.zeros(rows, dtype=np.float32)
        self.timeouts = np.zeros(rows, dtype=np.float32)
        self.marked = np.zeros(rows, dtype=bool)
        self._tails = np.zeros((n_envs, frame_stack), dtype=np.int64)
        self.reset()

        if psutil is not None and self.nbytes > (mem_available := psutil.virtual_memory().available):
            warnings.warn(
                "This system does not have apparently enough memory to store the complete "
                f"replay buffer {self.nbytes / 1e9:.2f}GB > {mem_available / 1e9:.2f}GB",
                stacklevel=2,
            )

    def reserve_frames(self) -> None:
        """Make the file for the frames, if there is to be one and there is none yet.

        :raises ValueError: If ``frames_dir`` cannot hold all frames
        """
        if len(self.frames) == 0:
            self.frames = self._file_for_frames()

    def _file_for_frames(self) -> npt.NDArray[np.uint8]:
        """Zeros for all frames, in an unnamed file that ends with this array."""
        shape = (self.frame_capacity, *self.frame_shape)
        size = math.prod(shape)
        assert self.frames_dir is not None
        try:
            Path(self.frames_dir).mkdir(exist_ok=True)
            with tempfile.TemporaryFile(dir=self.frames_dir) as file:
                # Reserved, because writing to a mapped file on a full disk kills the process.
                if hasattr(os, "posix_fallocate"):  # not on macOS and Windows
                    os.posix_fallocate(file.fileno(), 0, size)
                else:
                    file.truncate(size)
                return np.memmap(file, dtype=np.uint8, mode="r+", shape=shape)
        except OSError as error:
            raise ValueError(
                f"frames_dir is {str(self.frames_dir)!r}, but {size / 1e9:.2f} GB for frames cannot be reserved there "
                f"({error.strerror}): name a directory on a disk with room, or make buffer_size smaller."
            ) from error

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays of the full buffer; the system commits them as they fill."""
        return sum(value.nbytes for value in vars(self).values() if isinstance(value, np.ndarray))

    def reset(self) -> None:
        """Forget all transitions."""
        super().reset()
        self.frame_numbers = object()
        self._n_valid = 0  # rows that can be sampled: the latest ones before `pos`
        self._n_frames = 0  # frames ever stored; frame number i lies at `frames[i % frame_capacity]`
        # Per environment, the running numbers of the frames of its last `next_obs`; -frame_capacity: none yet
        self._tails.fill(-self.frame_capacity)

    def size(self) -> int:
        """
        :return: Number of rows that can be sampled. Below SB3's value only where streams broke so often that the
            frames of the oldest rows had to be overwritten.
        """
        return self._n_valid

    def add(
        self,
        obs: np.ndarray,
        next_obs: np.ndarray,
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """
        Store one transition per environment. All inputs are copied.

        :param obs: Observations, uint8 [n_envs, frame_stack * c, height, width]
        :param next_obs: Successors of the same shape; of an episode's last step the terminal observation
        :param action: Actions, [n_envs, ...]
        :param reward: Rewards, [n_envs]
        :param done: Whether the episode ended, [n_envs]
        :param infos: One dictionary per environment; ``TimeLimit.truncated`` and marks are used
        :raises ValueError: If observations have another dtype or shape, or ``frames_dir`` cannot hold all frames
        """
        self.reserve_frames()
        stacks, next_stacks = self._split(obs, "obs"), self._split(next_obs, "next_obs")
        action = np.asarray(action).reshape((self.n_envs, self.action_dim))

        # The row at `pos` is about to be overwritten
        self._n_valid = min(self._n_valid, self.buffer_size - 1)
        oldest_frame = self._n_frames
        marks = self._mark(infos)
        for i, (stack, next_stack) in enumerate(zip(stacks, next_stacks, strict=True)):
            if marks[i]:
                # What follows must not need older frames than this row, or it would outlive them.
                self._tails[i] = -self.frame_capacity
                continue
            numbers = self._tails[i] if self._continues_tail(i, stack) else self._store_stack(stack)
            if np.array_equal(next_stack[:-1], stack[1:]):
                next_numbers = np.append(numbers[1:], self._store_frame(next_stack[-1]))
            else:
                next_numbers = self._store_stack(next_stack)
            self.frame_slots[self.pos, i] = np.stack((numbers, next_numbers)) % self.frame_capacity
            oldest_frame = min(oldest_frame, int(numbers[0]))
            self._tails[i] = next_numbers
        self.oldest_frame[self.pos] = oldest_frame

        self.actions[self.pos] = action
        self.rewards[self.pos] = reward
        self.actions[self.pos, marks] = self.rewards[self.pos, marks] = 0
        self.dones[self.pos] = done
        if self.handle_timeout_termination:
            self.timeouts[self.pos] = [info.get("TimeLimit.truncated", False) for info in infos]

        self._n_valid += 1
        self.pos += 1
        if self.pos == self.buffer_size:
            self.full = True
            self.pos = 0

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> ReplayBufferSamples:
        """
        Sample uniformly, with replacement, from the valid rows and the environments.

        :param batch_size: Number of transitions to sample
        :param env: VecEnv to normalize the observations and rewards with
        :return: Batch on ``device``, observations uint8 (unless ``env`` normalizes them)
        """
        # As in SB3 a row's offset is its position, unless rows were lost: then it counts from the oldest valid one
        rows = np.random.randint(0, self._n_valid, size=batch_size)
        n_stored = self.buffer_size if self.full else self.pos
        if self._n_valid < n_stored:
            rows = (rows + self.pos - self._n_valid) % self.buffer_size
        return self._get_samples(rows, env=env)

    def transitions(
        self, rows: np.ndarray, env_inds: np.ndarray, env: VecNormalize | None = None
    ) -> ReplayBufferSamples:
        """
        The given transitions, to look at what is stored.

        :param rows: Row positions, as of ``_get_samples``, [n]
        :param env_inds: Environment of each, [n]
        :param env: VecEnv to normalize the observations and rewards with
        :return: Batch on ``device``
        :raises IndexError: If a row is empty, or its frames have been overwritten
        """
        if np.any((self.pos - 1 - rows) % self.buffer_size >= self._n_valid):
            raise IndexError(
                f"Some of the rows asked for hold no transition: of {self.buffer_size} rows only the {self._n_valid} "
                f"before pos={self.pos} are valid; draw rows with sample()."
            )
        inds = rows, env_inds
        # One gather for both stacks; `index_select` is threaded, unlike the fancy indexing of numpy
        slots = th.from_numpy(self.frame_slots[inds].swapaxes(0, 1).ravel())
        obs, next_obs = th.from_numpy(self.frames).index_select(0, slots).view(2, -1, *self.obs_shape).numpy()
        data = (
            self._normalize_obs(obs, env),
            self.actions[inds],
            self._normalize_obs(next_obs, env),
            # Only use dones that are not due to timeouts
            (self.dones[inds] * (1 - self.timeouts[inds])).reshape(-1, 1),
            self._normalize_reward(self.rewards[inds].reshape(-1, 1), env),
        )
        # All of these are fresh arrays already, so no second copy
        return ReplayBufferSamples(*(self.to_torch(array, copy=False) for array in data))  # type: ignore[arg-type]

    def _split(self, obs: np.ndarray, name: str) -> npt.NDArray[np.uint8]:
        """Observations of all environments as single frames: uint8 [n_envs, frame_stack, c, height, width]."""
        obs = np.ascontiguousarray(obs)
        if obs.dtype != np.uint8 or obs.shape != (self.n_envs, *self.obs_shape):
            raise ValueError(
                f"{name} is {obs.dtype} of shape {obs.shape}, but this buffer expects uint8 of shape "
                f"{(self.n_envs, *self.obs_shape)}: pass the observations of all {self.n_envs} environments unscaled."
            )
        return obs.reshape((self.n_envs, self.frame_stack, *self.frame_shape))

    def _continues_tail(self, i: int, stack: npt.NDArray[np.uint8]) -> bool:
        """Whether a stack equals the last one of environment ``i``, and that one outlives the current ``add``."""
        tail = self._tails[i]
        survives = tail[0] + self.frame_capacity >= self._n_frames + self._max_frames_per_add
        return bool(survives) and np.array_equal(self.frames[tail % self.frame_capacity], stack)

    def _store_stack(self, stack: npt.NDArray[np.uint8]) -> npt.NDArray[np.int64]:
        """Store a stack that continues nothing, repeated frames (the first after a reset) once; returns numbers."""
        numbers = [self._store_frame(stack[0])]
        for previous, frame in itertools.pairwise(stack):
            numbers.append(numbers[-1] if np.array_equal(previous, frame) else self._store_frame(frame))
        return np.array(numbers, dtype=np.int64)

    def _store_frame(self, frame: npt.NDArray[np.uint8]) -> int:
        """Store one frame, at the cost of the rows that need the frame it replaces; returns its running number."""
        number = self._n_frames
        # Frame numbers never fall from row to row, so the rows that go are the oldest ones
        while (
            self._n_valid
            and self.oldest_frame[(self.pos - self._n_valid) % self.buffer_size] + self.frame_capacity <= number
        ):
            self._n_valid -= 1
        self.frames[number % self.frame_capacity] = frame
        self._n_frames += 1
        return number

    def __getstate__(self) -> dict[str, Any]:
        """Leave out what has not been written to yet: a saved buffer is as large as its contents."""
        state = self.__dict__.copy()
        if not self.full:
            state.update({name: state[name][: self.pos] for name in self._ROW_ARRAYS})
        state["frames"] = np.asarray(self.frames[: self._n_frames])
        state.pop("last_sampled", None)
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore the full size of every array."""
        self.__dict__.update(state)
        self.frame_numbers = object()
        state.setdefault("marked", np.zeros((0, self.n_envs), dtype=bool))  # saved before there were marks
        for name in self._ROW_ARRAYS:
            setattr(self, name, _grown(state[name], self.buffer_size))
        stored: npt.NDArray[np.uint8] = state["frames"]
        if self.frames_dir is None:
            self.frames = _grown(stored, self.frame_capacity)
        elif len(stored) > 0:
            self.frames = self._file_for_frames()
            self.frames[: len(stored)] = stored


def transitions(
    buffer: ReplayBuffer, rows: np.ndarray, env_inds: np.ndarray, env: VecNormalize | None = None
) -> ReplayBufferSamples:
    """Given transitions of any replay buffer of arrays, where ``sample`` draws them and their environments.

    :param buffer: SB3's ``ReplayBuffer`` or a ``FrameStackReplayBuffer``
    :param rows: Row positions, [n]
    :param env_inds: Environment of each, [n]
    :param env: VecEnv to normalize the observations and rewards with
    :return: Batch on the buffer's device
    :raises ValueError: If the buffer holds dictionaries
    """
    if isinstance(buffer, FrameStackReplayBuffer):
        return buffer.transitions(rows, env_inds, env)
    if not isinstance(buffer.observations, np.ndarray):
        raise ValueError(
            f"the replay buffer is a {type(buffer).__name__}, whose observations are dictionaries, but only images and "
            "vectors can be looked at: train on one of these."
        )
    inds = rows, env_inds
    next_inds = ((rows + 1) % buffer.buffer_size, env_inds)
    next_obs = buffer.observations[next_inds] if buffer.optimize_memory_usage else buffer.next_observations[inds]
    data = (
        buffer._normalize_obs(buffer.observations[inds], env),
        buffer.actions[inds],
        buffer._normalize_obs(next_obs, env),
        (buffer.dones[inds] * (1 - buffer.timeouts[inds])).reshape(-1, 1),
        buffer._normalize_reward(buffer.rewards[inds].reshape(-1, 1), env),
    )
    return ReplayBufferSamples(*(buffer.to_torch(array) for array in data))  # type: ignore[arg-type]


def _grown(array: np.ndarray, length: int) -> np.ndarray:
    """The array itself where it has the length, else a copy that is filled up with zeros."""
    if len(array) == length:
        return array
    grown = np.zeros((length, *array.shape[1:]), dtype=array.dtype)
    grown[: len(array)] = array
    return grown


def _check_arguments(observation_space: spaces.Space, frame_stack: int, optimize_memory_usage: bool) -> None:
    """
    Refuse what the buffer cannot store.

    :raises ValueError: One sentence: the value, what is expected, what to do
    """
    if not isinstance(observation_space, spaces.Box) or observation_space.dtype != np.uint8:
        raise ValueError(
            f"observation_space is {observation_space}, but FrameStackReplayBuffer stores uint8 images in a Box: "
            "use stable_baselines3's ReplayBuffer or DictReplayBuffer for anything else."
        )
    shape = observation_space.shape
    if len(shape) != 3:
        raise ValueError(
            f"observation_space has shape {shape}, but FrameStackReplayBuffer expects (frame_stack * c, height, "
            "width): concatenate the stacked frames along the channel axis."
        )
    # The convention of SB3's `is_image_space_channels_first`
    if shape[2] < min(shape[:2]):
        raise ValueError(
            f"observation_space has shape {shape}, which looks like channels last, but FrameStackReplayBuffer expects "
            "(frame_stack * c, height, width): wrap the environment in VecTransposeImage."
        )
    if not is_integer(frame_stack, 1):
        raise ValueError(
            f"frame_stack is {frame_stack!r}, but it must be an integer of at least 1: pass the number of frames that "
            "one observation stacks."
        )
    if shape[0] % frame_stack != 0:
        raise ValueError(
            f"observation_space has {shape[0]} channels, which frame_stack={frame_stack} does not divide: pass the "
            "number of frames that one observation stacks."
        )
    if optimize_memory_usage:
        raise ValueError(
            "optimize_memory_usage is True, but FrameStackReplayBuffer already stores each frame once: leave it False."
        )


def choose_replay_buffer(
    env: VecEnv | None, observation_space: spaces.Space, kwargs: dict[str, Any]
) -> tuple[type[ReplayBuffer] | None, dict[str, Any]]:
    """Keep each frame once where the user or the environment says that observations are stacked frames.

    :param env: Environments, or None
    :param observation_space: Their observations, channels first
    :param kwargs: Arguments of the replay buffer that the user gave
    :return: Class of the replay buffer (None: SB3's choice), and its arguments
    """
    stacked = None if env is None else unwrap_vec_wrapper(env, VecFrameStack)
    frame_stack = kwargs.get("frame_stack")
    if frame_stack is None and stacked is not None:
        # Its stacks slide, whatever the environments in it stack.
        frame_stack = stacked.stacked_obs.n_stack
    elif frame_stack is None and env is not None:
        frame_stack = told_frame_stack(env)
    is_image = len(observation_space.shape or ()) == 3 and observation_space.dtype == np.uint8
    if is_image and frame_stack is not None:
        return FrameStackReplayBuffer, {"frame_stack": frame_stack, **kwargs}
    if isinstance(observation_space, spaces.Box) and not kwargs:
        return SkippingReplayBuffer, kwargs
    return None, kwargs


def told_frame_stack(env: VecEnv) -> int | None:
    """
    :param env: Environments, channels first
    :return: Frames per observation, as the environments tell in ``frame_stack`` (those of this package do); None where
        that cannot be meant
    """
    told: Any = env.get_attr("frame_stack")[0] if env.has_attr("frame_stack") else None
    shape = env.observation_space.shape or ()
    return int(told) if isinstance(told, int) and told > 0 and (len(shape) != 3 or shape[0] % told == 0) else None


def frame_stack_of(env: VecEnv) -> int:
    """
    :param env: Environments
    :return: Frames per observation, as they and SB3's ``VecFrameStack`` around them tell; 1 where nothing tells
    """
    stacked = unwrap_vec_wrapper(env, VecFrameStack)
    return (told_frame_stack(env) or 1) * (1 if stacked is None else stacked.stacked_obs.n_stack)
