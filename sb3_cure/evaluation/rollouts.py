"""Roll out one policy alone (task, curious or random), and measure its returns and SRL errors."""

import contextlib
import copy
import random
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.preprocessing import maybe_transpose
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.utils import obs_as_tensor, set_random_seed

from sb3_cure.data.buffers import stored_places, transitions
from sb3_cure.data.observations import by_key, images_of, rows_of, stacked
from sb3_cure.data.samples import Samples
from sb3_cure.envs import physics_state
from sb3_cure.srl import CURL, heads_by_key

ACTORS = ("task", "curious", "random")
#: Observations that are encoded at a time
CHUNK = 128


@dataclass
class Episode:
    """One episode of T agent steps.

    :param rewards: Reward of each step, [T]
    :param srl_errors: Noise-free SRL error of the observation before each step, [T]; empty if the model measures none
    :param observations: Observations before each step, [T, *shape], or these by key; images channels first, as the
        model gets them
    :param frames: ``env.render()`` before each step and after the last one, [T + 1], if requested; else empty
    :param states: True state of the environment before each step, [T, d], if requested; else empty
    """

    rewards: np.ndarray
    srl_errors: np.ndarray
    observations: Any
    frames: list[np.ndarray]
    states: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))

    @property
    def total_reward(self) -> float:
        """Undiscounted return of the episode."""
        return float(self.rewards.sum())


def states_and_errors(episodes: Iterable[Episode]) -> tuple[np.ndarray, np.ndarray]:
    """Join the steps of episodes.

    :param episodes: Episodes with true states
    :return: States, [n, d], and SRL errors, [n]
    """
    states, errors = zip(*((episode.states, episode.srl_errors) for episode in episodes), strict=True)
    return np.concatenate(states), np.concatenate(errors)


def returns_and_errors(episodes: Iterable[Episode]) -> tuple[np.ndarray, np.ndarray]:
    """Keep of episodes what evaluations report, so that no two of them are in memory at a time.

    :param episodes: At least one, as ``run_episodes`` yields them
    :return: Their returns, [n], and the SRL errors of all steps, [steps]; empty if the model measures none
    """
    kept = [(episode.total_reward, episode.srl_errors) for episode in episodes]
    return np.array([total for total, _ in kept]), np.concatenate([errors for _, errors in kept])


def chunks(n: int) -> list[slice]:
    """Split observations into parts of ``CHUNK``, which are encoded one at a time.

    :param n: Number of observations
    :return: Where each part is, in order
    """
    return [slice(start, start + CHUNK) for start in range(0, n, CHUNK)]


def srl_errors(model: BaseAlgorithm, batch: ReplayBufferSamples | Samples) -> np.ndarray:
    """Errors of transitions without training noise or augmentation.

    They are the SRL head's, or those of an intrinsic reward that measures errors itself, such as ``"reconstruction"``.

    :param model: A model with an SRL head, or such a reward
    :param batch: Transitions, observations as stored (images in 0-255)
    :return: Error per sample, [n]
    """
    policy: Any = model.policy
    policy.set_training_mode(False)
    errors = []
    with th.no_grad():
        for chunk in chunks(len(next(iter(by_key(batch.observations).values())))):
            part: Any = (None if each is None else rows_of(each, chunk) for each in batch[:5])
            errors.append(policy.error(policy.samples(Samples(*part), random=False)).float().cpu().numpy())
    return np.concatenate(errors)


@contextlib.contextmanager
def untouched_randomness(device: th.device, seed: int | None = None) -> Iterator[None]:
    """Restore the random number generators of Python, NumPy and PyTorch afterwards.

    :param device: Device whose generator is restored besides the CPU's
    :param seed: Seed of all of them meanwhile; None: they continue from their state
    """
    python_state, numpy_state = random.getstate(), np.random.get_state()
    with th.random.fork_rng([device] if device.type == "cuda" else []):
        try:
            if seed is not None:
                set_random_seed(seed)
            yield
        finally:
            random.setstate(python_state)
            np.random.set_state(numpy_state)


def trained_actors(model: BaseAlgorithm) -> list[str]:
    """Policies that a model trains.

    :param model: A model, also of SB3's own algorithms
    :return: ``"task"``, ``"curious"``, or both
    """
    has_curious = getattr(model.policy, "curious", None) is not None
    return ["task"] * getattr(model, "task", True) + ["curious"] * has_curious


@contextlib.contextmanager
def balanced_negatives(model: BaseAlgorithm, env: gym.Env, seed: int | None = None) -> Iterator[None]:
    """Take CURL's negatives evenly from what each policy sees, while policies are compared by CURL's error.

    Rolls out an episode of each policy of the model. Otherwise the negatives are those of the random warm-up, which
    the random policy's observations resemble most. Heads without negatives stay unchanged.

    :param model: A model, also of SB3's own algorithms
    :param env: One (not vectorised) environment
    :param seed: Seed of the resets and of random actions
    """
    every = heads_by_key(getattr(model.policy, "srl", None))
    heads: dict[str, Any] = {key: head for key, head in every.items() if isinstance(head, CURL) and head.n_banked}
    banks = {key: head.bank[: head.n_banked].clone() for key, head in heads.items()}
    actors = [*trained_actors(model), "random"] if heads else []
    seen = [as_trained(model, next(run_episodes(model, env, 1, actor, seed=seed)).observations) for actor in actors]
    for key, head in heads.items():
        share = max(len(head.bank) // len(actors), 1)
        images = [images_of(each, model.observation_space)[key] for each in seen]
        frames = np.concatenate([each[np.linspace(0, len(each) - 1, share).astype(int)] for each in images])
        head.set_bank(th.as_tensor(frames[: len(head.bank)]))
    try:
        yield
    finally:
        for key, head in heads.items():
            head.set_bank(banks[key])


def as_trained(model: BaseAlgorithm, observations: Any) -> Any:
    """Normalize observations as in training.

    :param model: A model
    :param observations: As its environments return them
    :return: The same, normalized if the model is trained in ``VecNormalize``
    """
    normalizer = model.get_vec_normalize_env()
    return observations if normalizer is None else normalizer.normalize_obs(observations)


def run_episodes(
    model: BaseAlgorithm,
    env: gym.Env,
    n_episodes: int,
    actor: str = "task",
    *,
    deterministic: bool = True,
    seed: int | None = None,
    render: bool = False,
    states: bool | Callable[[gym.Env], np.ndarray] = False,
) -> Iterator[Episode]:
    """Roll out one policy alone, episode by episode (one is in memory at a time).

    :param model: A trained model
    :param env: One (not vectorised) environment
    :param n_episodes: How many episodes
    :param actor: Who acts: ``"task"``, ``"curious"`` or ``"random"`` (uniform)
    :param deterministic: Whether policies act by their mean
    :param seed: Seed of the first reset and of random actions. The environment's random numbers decide where later
        episodes start: equal for all policies if ``step`` draws none, as in DeepMind Control
    :param render: Whether to keep ``env.render()`` before each step and after the last one
    :param states: Whether to keep the true state before each step: ``True`` for that of a dm_control environment
        (``sb3_cure.envs.physics_state``), or a function of the environment that returns an array [d]
    :return: The episodes
    :raises ValueError: if the actor is unknown, or the environment has no known state
    """
    if actor not in ACTORS:
        raise ValueError(f"actor must be one of {', '.join(map(repr, ACTORS))}, not {actor!r}.")
    agent: Any = model
    predict = agent.predict_curious if actor == "curious" else agent.predict
    state_of = physics_state if states is True else states
    space = copy.deepcopy(env.action_space)  # as a class attribute, it is also the training environment's
    space.seed(seed)
    for index in range(n_episodes):
        observation, _ = env.reset(seed=seed if index == 0 else None)
        # Copies: environments may reuse their arrays for observations, and change actions
        observations = [_own_keys(observation, model.observation_space)]
        actions, true_states, frames = list[np.ndarray](), list[np.ndarray](), list[Any]()
        rewards, dones = list[float](), list[bool]()
        finished, memory = False, None  # memory of recurrent policies
        while not finished:
            if actor == "random":
                action = space.sample()
            else:
                action, memory = predict(
                    as_trained(model, observations[-1]), memory, np.array([not actions]), deterministic
                )
            if state_of:
                true_states.append(np.array(state_of(env)))
            if render:
                frames.append(np.array(env.render()))  # a copy: the environment may write into its own
            actions.append(np.array(action))
            observation, reward, terminated, truncated, _ = env.step(action)
            finished = terminated or truncated
            observations.append(_own_keys(observation, model.observation_space))
            rewards.append(float(reward))
            dones.append(terminated)
        if render:
            frames.append(np.array(env.render()))
        seen: Any = _channels_first(stacked(observations), model.observation_space)
        errors = np.zeros(0, np.float32)
        if getattr(model.policy, "measures_errors", False):
            errors = srl_errors(model, _as_batch(model, as_trained(model, seen), actions, rewards, dones))
        kept = {"states": np.stack(true_states)} if states else {}
        yield Episode(np.array(rewards), errors, rows_of(seen, slice(-1)), frames, **kept)


def _own_keys(observation: Any, space: spaces.Space) -> Any:
    """Copy an observation without keys that its space does not have, as SB3's VecEnvs do."""
    own = {key: observation[key] for key in space.spaces} if isinstance(space, spaces.Dict) else observation
    return copy.deepcopy(own)


def _channels_first(observations: Any, space: spaces.Space) -> Any:
    if isinstance(space, spaces.Dict):
        return {key: maybe_transpose(observations[key], part) for key, part in space.spaces.items()}
    return maybe_transpose(observations, space)


def _as_batch(
    model: BaseAlgorithm, observations: Any, actions: list[np.ndarray], rewards: list[float], dones: list[bool]
) -> Samples:
    """Form a batch of an episode as replay buffers do: actions in [-1, 1], as vectors."""
    seen = obs_as_tensor(observations, model.device)
    scaled = model.policy.scale_action(np.array(actions))  # type: ignore[operator]
    columns = (np.reshape(each, (len(actions), -1)) for each in (scaled, dones, rewards))
    action, done, reward = (th.as_tensor(each, dtype=th.float32, device=model.device) for each in columns)
    return Samples(rows_of(seen, slice(-1)), action, rows_of(seen, slice(1, None)), done, reward)


class HighestErrors(NamedTuple):
    """Observations with the highest SRL error.

    :param observations: The observations, highest error first, [k, *shape], or these by key
    :param errors: Their SRL errors, [k]
    :param ages: How many agent steps ago they were stored, [k]
    :param mean_error: Mean SRL error of the whole replay buffer
    """

    observations: Any
    errors: np.ndarray
    ages: np.ndarray
    mean_error: float


def as_arrays(observations: Any) -> Any:
    """Convert tensors to arrays.

    :param observations: Tensor, or a dictionary of these
    :return: NumPy arrays
    """
    if isinstance(observations, dict):
        return {key: part.cpu().numpy() for key, part in observations.items()}
    return observations.cpu().numpy()


def highest_errors(model: BaseAlgorithm, k: int = 16, *, gap: int = 25) -> HighestErrors:
    """Find the observations of the replay buffer with the highest noise-free SRL error.

    Reads the whole buffer, a chunk at a time. Two observations of one environment are at least ``gap`` steps apart:
    else the result would be one moment k times.

    :param model: A model with an SRL head and a replay buffer
    :param k: How many observations; fewer if the buffer does not hold so many that are far enough apart
    :param gap: Least distance in time, in steps of one environment; 1 allows neighbours
    :return: The observations with their errors, highest first
    :raises ValueError: if the replay buffer is empty
    """
    buffer: Any = model.replay_buffer  # type: ignore[attr-defined]
    rows, env_inds, ages = stored_places(buffer)
    if len(rows) == 0:
        raise ValueError("the replay buffer is empty.")
    normalizer, places = model.get_vec_normalize_env(), chunks(len(rows))
    batches = (transitions(buffer, rows[chunk], env_inds[chunk], normalizer) for chunk in places)
    errors = np.concatenate([srl_errors(model, batch) for batch in batches])
    chosen: list[int] = []
    for candidate in np.argsort(-errors, kind="stable"):
        same = [other for other in chosen if env_inds[other] == env_inds[candidate]]
        if all(abs(ages[other] - ages[candidate]) >= gap for other in same):
            chosen.append(int(candidate))
        if len(chosen) == k:
            break
    observations = as_arrays(transitions(buffer, rows[chosen], env_inds[chosen]).observations)
    return HighestErrors(observations, errors[chosen], ages[chosen] * buffer.n_envs, float(errors.mean()))


def binned_errors(
    states: np.ndarray, errors: np.ndarray, edges: tuple[np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Visits and mean SRL error on a grid over two coordinates of the state.

    :param states: The two coordinates of each visited state, [n, 2]; those outside of the grid count in its outer bins
    :param errors: SRL error of each visited state, [n], or empty
    :param edges: Edges of the bins of both coordinates, increasing, [a + 1] and [b + 1]
    :return: Visits, [a, b], which add up to n; and the mean error of each bin, [a, b], NaN without visits
    """
    x, y = (np.clip(states[:, axis], edges[axis][0], edges[axis][-1]) for axis in (0, 1))
    visits = np.histogram2d(x, y, bins=edges)[0]  # type: ignore[call-overload]
    if len(errors) == 0:
        return visits, np.full_like(visits, np.nan)
    sums = np.histogram2d(x, y, bins=edges, weights=errors)[0]  # type: ignore[call-overload]
    return visits, np.divide(sums, visits, out=np.full_like(sums, np.nan), where=visits > 0)
