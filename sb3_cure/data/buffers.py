"""A replay buffer that keeps each frame of stacked images once, and the look-up of stored transitions."""

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from numpy import ndarray
from stable_baselines3.common.buffers import BaseBuffer, ReplayBuffer, psutil
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import DictReplayBufferSamples, ReplayBufferSamples
from stable_baselines3.common.vec_env import VecEnv, VecFrameStack, VecNormalize, unwrap_vec_wrapper

from sb3_cure.data.frame_ring import FrameRing
from sb3_cure.data.observations import by_key, image_spaces, rows_of
from sb3_cure.data.samples import NStep

Infos = list[dict[str, Any]]


class FrameStackReplayBuffer(ReplayBuffer):
    """SB3's ``ReplayBuffer`` and ``DictReplayBuffer`` in about a sixth of their memory for three stacked frames.

    Consecutive observations share all their frames but one, and so do an observation and its successor. The buffer
    keeps each frame once, in one ring for each image, and for each transition the slots of its frames in the ring;
    stacks are rebuilt when they are sampled. Everything else is stored as in SB3. With equal seeds and an equal stream
    it returns the same batches as SB3's buffers, bit for bit.

    Nothing is assumed about the stream: where an observation does not continue the stored one (after a reset, another
    ``learn()`` or ``set_env``), its frames are stored anew. A ring has room for 4 % more frames than transitions,
    enough for episodes of 25 steps and more. Where streams break more often, the oldest rows (a row: the transitions of
    all environments at one time) are given up: they are never sampled, and ``size()`` does not count them.

    :param buffer_size: Max number of transitions, over all environments
    :param observation_space: Images (uint8, channels first, oldest frame first), vectors, or a dictionary of both
    :param action_space: Action space
    :param device: PyTorch device of the sampled tensors
    :param n_envs: Number of parallel environments
    :param optimize_memory_usage: Ignored: frames are kept once in any case
    :param handle_timeout_termination: Handle timeout termination (due to timelimit) separately and treat the task
        as an infinite horizon task
    :param frame_stack: Frames per observation, which cannot be inferred from the channels: by key (1 for images
        that are not named), or one number for all (in dictionaries, 1 for images whose channels it does not divide)
    :param info_shapes: What to keep of each step's ``info``, for rewards and heads of your own: shapes by key, such as
        ``{"contacts": (4,)}``; ``rows["infos/contacts"]`` has it as float32
    :param frames_dir: Keep the frames in an unnamed, memory-mapped file in this directory instead of in memory: a
        million transitions of 84x84 take 22 GB. The last directory of the path is created if it is missing. The
        first ``add`` reserves the room on the disk (``OSError`` if there is too little)
    """

    #: Row arrays by name, [buffer_size, n_envs, ...] each. Images have ``slots/<key>``, everything else has
    #: ``observations/<key>`` and ``next_observations/<key>`` (the key of a single observation is ``""``), and kept
    #: infos have ``infos/<key>``
    rows: dict[str, ndarray]
    #: ``rows["starts"]``: whether a row's observation does not continue the row before, bool [buffer_size, n_envs]
    starts: ndarray
    #: Rings of frames by the key of their image
    rings: dict[str, FrameRing]
    #: Frames ever stored, by the key of their image
    counts: dict[str, int]
    #: Rows ever added
    n_added: int
    #: Rows and environments of the batch sampled last, [batch_size] each
    last_sampled: tuple[ndarray, ndarray] | None

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
        frame_stack: int | Mapping[str, int],
        info_shapes: Mapping[str, tuple[int, ...]] | None = None,
        frames_dir: str | Path | None = None,
    ):
        # As SB3's DictReplayBuffer does: ReplayBuffer's constructor would allocate what this class avoids.
        BaseBuffer.__init__(self, buffer_size, observation_space, action_space, device, n_envs=n_envs)
        self.buffer_size = max(buffer_size // n_envs, 1)
        self.optimize_memory_usage, self.handle_timeout_termination = False, handle_timeout_termination
        self.frame_stack, self.frames_dir = frame_stack, frames_dir
        self.info_shapes = dict(info_shapes or {})
        self._spaces = by_key(observation_space)
        self._shapes = {key: (n_envs, *shape) for key, shape in by_key(self.obs_shape).items()}
        self.reset()

        def zeros(*shape: int, dtype: Any = np.float32) -> ndarray:
            return np.zeros((self.buffer_size, n_envs, *shape), dtype)

        self.rows = {f"slots/{key}": zeros(2, ring.frame_stack, dtype=np.int32) for key, ring in self.rings.items()}
        for key, space in self._spaces.items():
            if key not in self.rings:
                for name in ("observations", "next_observations"):
                    self.rows[f"{name}/{key}"] = zeros(*self._shapes[key][1:], dtype=space.dtype)
        self.rows["actions"] = zeros(self.action_dim, dtype=self._maybe_cast_dtype(action_space.dtype))
        self.rows |= {name: zeros() for name in ("rewards", "dones", "timeouts")}
        self.rows |= {f"infos/{key}": zeros(*shape) for key, shape in self.info_shapes.items()}
        self.rows["starts"] = zeros(dtype=bool)
        names = ("actions", "rewards", "dones", "timeouts", "starts")
        self.actions, self.rewards, self.dones, self.timeouts, self.starts = (self.rows[name] for name in names)
        # SB3's names of single vectors; None for images, which are in the rings, and for dictionaries
        self.observations, self.next_observations = (  # type: ignore[assignment]
            self.rows.get(f"{name}/") for name in ("observations", "next_observations")
        )
        self._own_attributes = {"_own_attributes", *vars(self)}  # all others are a subclass's
        if frames_dir is None and psutil is not None and self.nbytes > (free := psutil.virtual_memory().available):
            warnings.warn(
                f"The full replay buffer needs {self.nbytes / 1e9:.2f} GB of memory, but {free / 1e9:.2f} GB are "
                "available: make buffer_size smaller, or keep the frames on a disk (frames_dir).",
                stacklevel=2,
            )

    @property
    def nbytes(self) -> int:
        """Bytes that the full buffer takes; the system provides them as it fills."""
        return sum(array.nbytes for array in self.rows.values()) + sum(ring.nbytes for ring in self.rings.values())

    def reset(self) -> None:
        """Forget all transitions and frames."""
        super().reset()
        self.rings = {
            key: FrameRing(self._spaces[key].shape, stack, self.buffer_size, self.n_envs, self.frames_dir)  # type: ignore[arg-type]
            for key, stack in stacks_by_key(self.observation_space, self.frame_stack).items()
        }
        self.counts = dict.fromkeys(self.rings, 0)
        self.n_added, self._n_valid, self._breaks, self.last_sampled = 0, 0, False, None

    def size(self) -> int:
        """Number of rows that can be sampled.

        :return: SB3's value, or less where streams broke so often that the oldest rows lost their frames
        """
        return self._n_valid

    def break_stream(self) -> None:
        """Note that the next row does not continue the one before, as after a step that was not stored."""
        self._breaks = True

    def add(self, obs: Any, next_obs: Any, action: ndarray, reward: ndarray, done: ndarray, infos: Infos) -> None:
        """Store copies of one transition per environment: if an exception is raised, nothing is stored.

        :param obs: Observations, [n_envs, *shape], or these by key
        :param next_obs: Successors of the same shape; for an episode's last step, the terminal observation
        :param action: Actions, [n_envs, ...]
        :param reward: Rewards, [n_envs]
        :param done: Whether the episode ended, [n_envs]
        :param infos: One dictionary per environment; ``TimeLimit.truncated`` and the keys of ``info_shapes`` are read
        :raises ValueError: If an observation has another shape, or numbers that a uint8 space cannot hold, or
            an info lacks a key of ``info_shapes``
        """
        obs, next_obs = self._checked(obs), self._checked(next_obs)
        before = (self.pos - 1) % self.buffer_size
        continues = np.full(self.n_envs, self._n_valid > 0 and not self._breaks)
        row: dict[str, Any] = {"actions": np.asarray(action).reshape(self.n_envs, self.action_dim)}
        row |= {"rewards": reward, "dones": done}
        if self.handle_timeout_termination:
            row["timeouts"] = np.array([info.get("TimeLimit.truncated", False) for info in infos]).reshape(self.n_envs)
        for key, shape in self.info_shapes.items():
            if not all(key in info for info in infos):
                raise ValueError(f"info has no {key!r}, which replay_buffer_kwargs=dict(info_shapes=...) keeps.")
            row[f"infos/{key}"] = np.array([info[key] for info in infos]).reshape(self.n_envs, *shape)
        counts = {}
        for key, ring in self.rings.items():
            tails = self.rows[f"slots/{key}"][before, :, 1] if self._n_valid else None
            stored = ring.store(obs[key], next_obs[key], tails, self.counts[key])
            row[f"slots/{key}"], same, counts[key] = stored
            continues &= same
        for key in obs.keys() - self.rings.keys():
            row[f"observations/{key}"], row[f"next_observations/{key}"] = obs[key], next_obs[key]
            same = obs[key] == self.rows[f"next_observations/{key}"][before]
            continues &= same.reshape(self.n_envs, -1).all(axis=1)
        row["starts"] = ~continues
        self._commit(row, counts)

    def _checked(self, observations: Any) -> dict[str, ndarray]:
        """Observations by key, of the shapes and types that are stored; refuse what would be stored as garbage."""
        checked = {}
        for key, space in self._spaces.items():
            array = np.asarray(by_key(observations)[key])
            shape = self._shapes[key]
            what = f"the observation {key!r}" if key else "the observation"
            if (array.size != self.n_envs) if isinstance(space, spaces.Discrete) else (array.shape != shape):
                raise ValueError(f"{what} has shape {array.shape}, but the replay buffer stores {shape}.")
            if space.dtype == np.uint8 and array.dtype != np.uint8:
                if not ((array >= 0) & (array <= 255) & (array % 1 == 0)).all():
                    raise ValueError(
                        f"{what} is uint8 in its space, but {array.dtype} with numbers that are not whole or not in "
                        "0 to 255: return unscaled uint8 images, or declare a float space."
                    )
            checked[key] = array.astype(space.dtype, copy=False).reshape(shape)
        return checked

    def _commit(self, row: dict[str, Any], counts: dict[str, int]) -> None:
        """Write a row in place of the oldest one, then change position, size and counts at once."""
        pos, full = (self.pos + 1) % self.buffer_size, self.full or self.pos + 1 == self.buffer_size
        # An exception from here on, such as KeyboardInterrupt, loses no more than the row that is replaced.
        self._n_valid = min(self._n_valid, self.buffer_size - 1)
        for name, value in row.items():
            self.rows[name][self.pos] = value
        n_valid = self._n_valid + 1
        for key, ring in self.rings.items():
            slots = self.rows[f"slots/{key}"]
            while n_valid > 1 and ring.is_lost(slots[(pos - n_valid) % self.buffer_size], counts[key]):
                n_valid -= 1
        vars(self).update(pos=pos, full=full, counts=counts, n_added=self.n_added + 1, _n_valid=n_valid, _breaks=False)
        if n_valid < 0.9 * (super().size() - 1):
            warnings.warn(
                "Frames do not slide: fewer than 9 of 10 rows fit into the replay buffer, because "
                f"consecutive observations seldom share all but the newest of frame_stack={self.frame_stack} "
                "frames (give the right number in replay_buffer_kwargs=dict(frame_stack=...), by key in "
                "dictionaries), or because many episodes have fewer than 25 steps: choose a larger buffer_size.",
                stacklevel=3,
            )

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> Any:
        """Sample uniformly, with replacement, from the valid rows and the environments.

        :param batch_size: Number of transitions to sample
        :param env: VecEnv to normalize the observations and rewards with
        :return: SB3's ``ReplayBufferSamples`` or ``DictReplayBufferSamples`` on ``device``
        """
        rows = np.random.randint(0, self._n_valid, size=batch_size)
        if self._n_valid < super().size():
            # Rows were given up: count from the oldest one that is left. Else rows are positions, as in SB3.
            rows = (rows + self.pos - self._n_valid) % self.buffer_size
        return self._get_samples(rows, env)

    def _get_samples(self, batch_inds: ndarray, env: VecNormalize | None = None) -> Any:
        self.last_sampled = batch_inds, np.random.randint(0, high=self.n_envs, size=(len(batch_inds),))
        return transitions(self, *self.last_sampled, env)

    def observations_at(self, rows: ndarray, env_inds: ndarray, which: slice = slice(None)) -> list[Any]:
        """Look up observations and their successors.

        :param rows: Row positions, [n]
        :param env_inds: Environment of each, [n]
        :param which: ``slice(1, None)`` for the successors alone
        :return: Observations, and successors, [n, *shape] or these by key
        :raises IndexError: If a row is empty, or its frames have been overwritten
        """
        if np.any((self.pos - 1 - rows) % self.buffer_size >= self._n_valid):
            raise IndexError(f"Only the {self._n_valid} rows before pos={self.pos} hold transitions: use sample().")
        parts: dict[str, Any] = {}
        for key in self._spaces:
            if key in self.rings:  # observations and successors together
                parts[key] = self.rings[key].stacks(self.rows[f"slots/{key}"][rows, env_inds].swapaxes(0, 1)[which])
            else:
                names = ("observations", "next_observations")[which]
                parts[key] = [self.rows[f"{name}/{key}"][rows, env_inds] for name in names]
        if not isinstance(self.observation_space, spaces.Dict):
            return list(parts[""])
        return [dict(zip(parts, each, strict=True)) for each in zip(*parts.values(), strict=True)]

    def n_step(self, n_steps: int, gamma: float, env: VecNormalize | None = None) -> NStep:
        """Compute n-step returns for the batch sampled last, with the same values as SB3's ``NStepReplayBuffer``.

        A sum ends with the episode, with the newest row, and where the stored stream breaks within an episode (another
        ``learn()``, ``set_env``, a step that was not stored).

        :param n_steps: Rewards per sum, at most
        :param gamma: Discount factor
        :param env: VecEnv to normalize the observations and rewards with
        :return: The returns on ``device``
        """
        assert self.last_sampled is not None, "n_step uses the batch sampled last: call sample() before it"
        rows, env_inds = self.last_sampled
        steps = np.arange(n_steps, dtype=np.float32)
        window, envs = (rows[:, None] + np.arange(n_steps)) % self.buffer_size, env_inds[:, None]
        ends = (self.dones[window, envs] > 0) | (window == (self.pos - 1) % self.buffer_size)
        ends[:, :-1] |= self.starts[window[:, 1:], envs]
        ends[:, -1] = True
        last = ends.argmax(axis=1)
        counted = steps <= last[:, None]
        rewards = self._normalize_reward(self.rewards[window, envs], env) * gamma**steps * counted
        final = (rows + last) % self.buffer_size, env_inds
        (next_obs,) = self.observations_at(*final, slice(1, None))
        return NStep(
            rewards=self.to_torch(rewards.sum(axis=1, keepdims=True)),
            next_observations=_to_torch(self, self._normalize_obs(next_obs, env)),
            dones=self.to_torch((self.dones[final] * (1 - self.timeouts[final])).reshape(-1, 1)),
            discounts=self.to_torch(gamma ** counted.sum(axis=1, keepdims=True).astype(np.float32)),
        )

    def restarts(self, env: VecNormalize | None = None) -> Any | None:
        """Successors for the batch sampled last: where an episode terminated, the first observation of the next one.

        An episode after which nothing has been stored yet keeps its terminal observation.

        :param env: VecEnv to normalize the observations with
        :return: Observations on ``device``; None if they are those of ``sample``
        """
        assert self.last_sampled is not None, "restarts uses the batch sampled last: call sample() before it"
        rows, env_inds = self.last_sampled
        terminated = self.dones[rows, env_inds] * (1 - self.timeouts[rows, env_inds]) > 0
        terminated &= rows != (self.pos - 1) % self.buffer_size
        if not terminated.any():
            return None
        (successors,) = self.observations_at(rows, env_inds, slice(1, None))
        first = (rows[terminated] + 1) % self.buffer_size, env_inds[terminated]
        parts = by_key(successors)
        for key, observations in by_key(self.observations_at(*first, slice(1))[0]).items():
            parts[key][terminated] = observations
        return _to_torch(self, self._normalize_obs(successors, env))

    def state_dict(self, frames: bool = True) -> dict[str, Any]:
        """State as plain values and views of the used part of all arrays.

        :param frames: Whether the frames are among the arrays, as ``frames/<key>``
        :return: ``size`` and ``n_envs``, ``counters`` and ``arrays`` by name
        """
        arrays = {name: array[: super(FrameStackReplayBuffer, self).size()] for name, array in self.rows.items()}
        if frames:
            arrays |= {f"frames/{key}": ring.frames[: self.counts[key]] for key, ring in self.rings.items()}
        counters = {name: getattr(self, name) for name in _COUNTERS}
        return {"size": self.buffer_size, "n_envs": self.n_envs, "counters": counters, "arrays": arrays}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take over the state of another buffer; frames that are not among its arrays must be filled in later.

        :param state: From ``state_dict`` of a buffer with equal arguments
        :raises ValueError: If the state does not fit this buffer
        """
        self.reset()
        vars(self).update({name: state["counters"][name] for name in _COUNTERS})
        for ring in self.rings.values():
            ring.reserve()
        given = state["arrays"]
        own = self.state_dict(frames=any(name.startswith("frames/") for name in given))["arrays"]
        for name in sorted(own.keys() | given.keys()):
            needed, found = (
                f"{arrays[name].dtype} of shape {arrays[name].shape}" if name in arrays else "missing"
                for arrays in (own, given)
            )
            if needed != found:
                raise ValueError(f"the array {name:.50} is {found} in the file, but {needed} in this replay buffer")
            own[name][...] = given[name]

    def __getstate__(self) -> dict[str, Any]:
        """Leave out what has not been written to: a pickled buffer is as large as its contents."""
        names = ("observation_space", "action_space", "device", "n_envs", "handle_timeout_termination")
        settings = {name: getattr(self, name) for name in (*names, "frame_stack", "info_shapes", "frames_dir")}
        settings["buffer_size"] = self.buffer_size * self.n_envs
        of_subclass = {name: value for name, value in vars(self).items() if name not in self._own_attributes}
        return {"settings": settings, "state": self.state_dict(), "of_subclass": of_subclass}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Allocate the full size of every array."""
        FrameStackReplayBuffer.__init__(self, **state["settings"])
        self.load_state_dict(state["state"])
        vars(self).update(state["of_subclass"])


#: Attributes that change together with each row
_COUNTERS = ("pos", "full", "counts", "n_added", "_n_valid", "_breaks")


def stored_places(buffer: ReplayBuffer) -> tuple[ndarray, ndarray, ndarray]:
    """Places of all transitions that can be sampled, for ``transitions``.

    :param buffer: SB3's ``ReplayBuffer``, ``DictReplayBuffer`` or a ``FrameStackReplayBuffer``
    :return: Rows, environments and ages (in rows), newest first, [n] each
    """
    size = buffer.size()
    if buffer.full and buffer.optimize_memory_usage:
        size -= 1  # the newest one's successor has replaced the oldest one's observation
    ages, env_inds = np.divmod(np.arange(size * buffer.n_envs), buffer.n_envs)
    return (buffer.pos - 1 - ages) % buffer.buffer_size, env_inds, ages


def transitions(
    buffer: ReplayBuffer, rows: ndarray, env_inds: ndarray, env: VecNormalize | None = None
) -> ReplayBufferSamples:
    """Look up the transitions at given places, as ``sample`` does for places that it draws.

    :param buffer: SB3's ``ReplayBuffer``, ``DictReplayBuffer`` or a ``FrameStackReplayBuffer``
    :param rows: Row positions in [0, buffer_size): the row that ``add`` wrote when ``pos`` had this value, [n]
    :param env_inds: Environment of each, [n]
    :param env: VecEnv to normalize the observations and rewards with
    :return: Batch on the buffer's device
    :raises IndexError: If a row of a ``FrameStackReplayBuffer`` is empty, or its frames have been overwritten
    """
    inds = rows, env_inds
    if isinstance(buffer, FrameStackReplayBuffer):
        obs, next_obs = buffer.observations_at(*inds)
    else:
        obs = rows_of(buffer.observations, inds)
        if buffer.optimize_memory_usage:  # SB3 keeps it as the next row's observation
            next_obs = rows_of(buffer.observations, ((rows + 1) % buffer.buffer_size, env_inds))
        else:
            next_obs = rows_of(buffer.next_observations, inds)
    data = (
        buffer._normalize_obs(obs, env),
        buffer.actions[inds],
        buffer._normalize_obs(next_obs, env),
        # Only use dones that are not due to timeouts
        (buffer.dones[inds] * (1 - buffer.timeouts[inds])).reshape(-1, 1),
        buffer._normalize_reward(buffer.rewards[inds].reshape(-1, 1), env),
    )
    kind: Any = DictReplayBufferSamples if isinstance(obs, dict) else ReplayBufferSamples
    return kind(*(_to_torch(buffer, array) for array in data))


def _to_torch(buffer: ReplayBuffer, array: Any) -> Any:
    """Move fresh arrays, or a dictionary of these, to the buffer's device; being fresh, they need no copy."""
    if isinstance(array, dict):
        return {key: _to_torch(buffer, part) for key, part in array.items()}
    return buffer.to_torch(array, copy=False)


def stacks_by_key(space: spaces.Space, frame_stack: int | Mapping[str, int]) -> dict[str, int]:
    """Frames per observation of each image.

    :param space: Space of observations
    :param frame_stack: By key (1 for other images), or one number for all (in dictionaries 1 where it does not divide
        the channels)
    :return: Frames by the keys of ``image_spaces``
    """
    images = image_spaces(space)
    if isinstance(frame_stack, Mapping):
        return {key: frame_stack.get(key, 1) for key in images}
    return {key: 1 if key and image.shape[0] % frame_stack else frame_stack for key, image in images.items()}


def frame_stacks(model: OffPolicyAlgorithm) -> dict[str, int]:
    """Frames per observation of each image: the replay buffer's setting or, without it, what the environments say.

    :param model: A model
    :return: Frames by the keys of ``image_spaces``
    """
    known = getattr(model, "_frame_stack", None)  # our models keep it, even without environments
    told = known or model.replay_buffer_kwargs.get("frame_stack")
    return stacks_by_key(model.observation_space, told or infer_frame_stack(model.env))


def infer_frame_stack(env: VecEnv | None) -> int:
    """Frames per observation, as SB3's ``VecFrameStack`` or the attribute ``frame_stack`` of the environments says.

    :param env: Environments, channels first, or None
    :return: The number; 1 if nothing says it, or if the channels are not a multiple of it
    """
    if env is None:
        return 1
    if (stacked := unwrap_vec_wrapper(env, VecFrameStack)) is not None:
        return stacked.stacked_obs.n_stack  # it slides these, whatever the environments inside stack
    frame_stack: Any = env.get_attr("frame_stack")[0] if env.has_attr("frame_stack") else 1
    shape = env.observation_space.shape or ()
    is_number = isinstance(frame_stack, int | np.integer) and frame_stack > 0
    return int(frame_stack) if is_number and (len(shape) != 3 or shape[0] % frame_stack == 0) else 1
