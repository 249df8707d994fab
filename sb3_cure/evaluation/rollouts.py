"""Roll out one policy alone (task, curious or random) and measure what it earns and what SRL error it sees."""

import contextlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.preprocessing import maybe_transpose
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.utils import obs_as_tensor

from sb3_cure.cure.policies import encoder_of
from sb3_cure.data.buffers import stored_places, transitions
from sb3_cure.data.observations import copied, images_of, len_of, rows_of, stacked
from sb3_cure.data.samples import Samples
from sb3_cure.envs import physics_state
from sb3_cure.srl import CURL, heads_by_key

ACTORS = ("task", "curious", "random")


@dataclass
class Episode:
    """
    What one episode of T agent steps showed.

    :param rewards: Reward of each step, [T]
    :param srl_errors: The head's noise-free error of the observation before each step, [T]; empty without a head
    :param observations: The observations before each step, [T, *shape], or such by key; images channels first, as the
        model has them
    :param frames: ``env.render()`` after each step, if asked for
    :param states: The true state of the environment before each step, [T, d], if asked for; else empty
    """

    rewards: np.ndarray
    srl_errors: np.ndarray
    observations: Any
    frames: list[np.ndarray]
    states: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))

    @property
    def total_reward(self) -> float:
        """Return of the episode, undiscounted."""
        return float(self.rewards.sum())


def srl_errors(model: BaseAlgorithm, batch: ReplayBufferSamples | Samples, chunk: int = 128) -> np.ndarray:
    """
    Error of transitions without training noise, as the acting agent sees them (no augmentation): the SRL head's, or
    that of an intrinsic reward which measures, such as ``"reconstruction"``.

    :param model: A model with an SRL head, or such a reward
    :param batch: Transitions, observations as stored (images in 0-255)
    :param chunk: How many at a time
    :return: Error per sample, [n]
    """
    policy: Any = model.policy
    policy.set_training_mode(False)
    errors, fields = [], batch._asdict()
    with th.no_grad():
        for start in range(0, len_of(batch.observations), chunk):
            rows = slice(start, start + chunk)
            columns: Any = {name: None if each is None else rows_of(each, rows) for name, each in fields.items()}
            part = policy.samples(Samples(**columns), random=False)
            errors.append(policy.error(part).float().cpu().numpy())
    return np.concatenate(errors)


def trained_actors(model: BaseAlgorithm) -> list[str]:
    """
    :param model: A model, also of SB3's own algorithms
    :return: Which of ``"task"`` and ``"curious"`` it trains
    """
    has_curious = getattr(model.policy, "curious", None) is not None
    return ["task"] * getattr(model, "task", True) + ["curious"] * has_curious


def even_negatives(model: BaseAlgorithm, env: gym.Env, seed: int | None = None) -> None:
    """
    Before policies are compared by CURL's error: take its negatives evenly from what they see.

    Rolls out an episode of each policy that the model has. Without this the negatives are those of the random
    warm-up, to which the random policy's observations are the most alike. Heads without negatives are left alone.

    :param model: A trained model
    :param env: One (not vectorised) environment
    :param seed: Seed of the resets and of random actions
    """
    heads = _with_banks(model)
    if not heads:
        return
    actors = [*trained_actors(model), "random"]
    seen = [as_trained(model, next(run_episodes(model, env, 1, actor, seed=seed)).observations) for actor in actors]
    for key, head in heads.items():
        share = max(len(head.bank) // len(actors), 1)
        images = [images_of(each, model.observation_space)[key] for each in seen]
        frames = np.concatenate([each[np.linspace(0, len(each) - 1, share).astype(int)] for each in images])
        head.set_bank(th.as_tensor(frames[: len(head.bank)]))


def _with_banks(model: BaseAlgorithm) -> dict[str, Any]:
    """The model's heads that have negatives, by the key of their image."""
    heads = heads_by_key(getattr(model.policy, "srl", None))
    return {key: head for key, head in heads.items() if isinstance(head, CURL)}


@contextlib.contextmanager
def evenly_measured(model: BaseAlgorithm, env: gym.Env, seed: int | None = None) -> Iterator[None]:
    """
    Measure with ``even_negatives`` for a while, and leave the head as it was.

    :param model: A model, also of SB3's own algorithms
    :param env: One (not vectorised) environment
    :param seed: Seed of the resets and of random actions
    """
    heads = _with_banks(model)
    if not heads or any(int(head.bank_filled) == 0 for head in heads.values()):
        yield
        return
    usual = {key: head.bank[: int(head.bank_filled)].clone() for key, head in heads.items()}
    even_negatives(model, env, seed)
    try:
        yield
    finally:
        for key, head in heads.items():
            head.set_bank(usual[key])


def as_trained(model: BaseAlgorithm, observations: Any) -> Any:
    """
    :param model: A model
    :param observations: As its environments give them
    :return: Normalised as in training, if a ``VecNormalize`` did so
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
    """
    Roll out one policy alone, episode by episode (one is in memory at a time).

    :param model: A trained model
    :param env: One (not vectorised) environment
    :param n_episodes: How many episodes
    :param actor: Whose actions: ``"task"``, ``"curious"`` or ``"random"`` (uniform)
    :param deterministic: Whether policies act by their mean
    :param seed: Seed of the first reset and of random actions. Later episodes start as the environment's random numbers
        go on: alike for all policies where ``step`` draws none, as in DeepMind Control; else the first one only
    :param render: Whether to keep ``env.render()`` of each step
    :param states: Whether to keep the true state before each step: ``True`` for that of a dm_control environment
        (``sb3_cure.envs.physics_state``), or a function of the environment that returns an array [d]
    :return: The episodes
    :raises ValueError: if the actor is unknown, or the environment no known state
    """
    if actor not in ACTORS:
        raise ValueError(f"actor is {actor!r}, but must be one of {', '.join(map(repr, ACTORS))}.")
    agent: Any = model
    predict = agent.predict_curious if actor == "curious" else agent.predict
    state_of = physics_state if states is True else states
    if seed is not None:
        env.action_space.seed(seed)
    for index in range(n_episodes):
        observation, _ = env.reset(seed=seed if index == 0 else None)
        observations, frames, true_states, steps = [copied(observation)], [], [], list[tuple[Any, ...]]()
        done, memory = False, None  # memory: of recurrent policies
        while not done:
            if actor == "random":
                action = env.action_space.sample()
            else:
                action, memory = predict(as_trained(model, observation), memory, np.array([not steps]), deterministic)
            if state_of:
                true_states.append(np.array(state_of(env)))  # a copy
            given = np.array(action)  # the environment may change it, and write each observation into one place
            observation, reward, terminated, truncated, _ = env.step(action)
            done = terminated or truncated
            observations.append(copied(observation))
            steps.append((given, float(reward), terminated))
            if render:
                frames.append(env.render())
        seen: Any = _channels_first(stacked(observations), model.observation_space)
        actions, rewards, dones = map(np.array, zip(*steps, strict=True))
        errors = np.zeros(0, np.float32)
        if getattr(model.policy, "measures_errors", False):
            errors = srl_errors(model, _as_batch(model, as_trained(model, seen), actions, rewards, dones))
        kept = {"states": np.stack(true_states)} if states else {}
        yield Episode(rewards, errors, rows_of(seen, slice(-1)), frames, **kept)  # type: ignore[arg-type]


def _channels_first(observations: Any, space: spaces.Space) -> Any:
    if isinstance(space, spaces.Dict):
        return {key: maybe_transpose(observations[key], part) for key, part in space.spaces.items()}
    return maybe_transpose(observations, space)


def _as_batch(
    model: BaseAlgorithm, observations: Any, actions: np.ndarray, rewards: np.ndarray, dones: np.ndarray
) -> Samples:
    """An episode in the form in which heads read the replay buffer (actions scaled to [-1, 1])."""
    seen = obs_as_tensor(observations, model.device)
    columns = (model.policy.scale_action(actions), dones[:, None], rewards[:, None])  # type: ignore[operator]
    scaled, done, reward = (th.as_tensor(each, dtype=th.float32, device=model.device) for each in columns)
    return Samples(rows_of(seen, slice(-1)), scaled, rows_of(seen, slice(1, None)), done, reward)


class Uncomfortable(NamedTuple):
    """
    Where the agent's representation errs the most.

    :param observations: The observations, the worst first, [k, *shape], or such by key
    :param errors: Their SRL errors, [k]
    :param ages: How many agent steps ago they were stored, [k]
    :param mean_error: Mean SRL error of the whole replay buffer
    """

    observations: Any
    errors: np.ndarray
    ages: np.ndarray
    mean_error: float


def most_uncomfortable(model: BaseAlgorithm, k: int = 16, *, gap: int = 25, chunk: int = 128) -> Uncomfortable:
    """
    The observations of the replay buffer with the highest noise-free SRL error.

    Reads the whole buffer, a chunk at a time. Two observations of one environment are at least ``gap`` steps apart:
    else the answer would be one moment k times.

    :param model: A model with an SRL head and a replay buffer
    :param k: How many observations; fewer where the buffer does not hold so many that are far enough apart
    :param gap: Least distance in time, in steps of one environment; 1 allows neighbours
    :param chunk: How many observations are in memory at a time
    :return: The observations, worst first, with their errors
    :raises ValueError: if there is nothing to measure in the replay buffer
    """
    buffer: Any = model.replay_buffer  # type: ignore[attr-defined]
    rows, env_inds, ages = stored_places(buffer)
    if len(rows) == 0:
        raise ValueError("the replay buffer is empty.")

    errors = np.zeros(len(rows), np.float32)
    for start in range(0, len(rows), chunk):
        part = slice(start, start + chunk)
        errors[part] = srl_errors(
            model, transitions(buffer, rows[part], env_inds[part], model.get_vec_normalize_env()), chunk
        )
    chosen: list[int] = []
    for candidate in np.argsort(-errors, kind="stable"):
        same = [other for other in chosen if env_inds[other] == env_inds[candidate]]
        if all(abs(ages[other] - ages[candidate]) >= gap for other in same):
            chosen.append(int(candidate))
        if len(chosen) == k:
            break
    found: Any = transitions(buffer, rows[chosen], env_inds[chosen]).observations
    is_dict = isinstance(found, dict)
    observations = {k: part.cpu().numpy() for k, part in found.items()} if is_dict else found.cpu().numpy()
    return Uncomfortable(observations, errors[chosen], ages[chosen] * buffer.n_envs, float(errors.mean()))


def binned_errors(
    states: np.ndarray, errors: np.ndarray, edges: tuple[np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """
    Visits and mean SRL error on a grid over two coordinates of the state.

    :param states: The two coordinates of each visited state, [n, 2]; those outside of the grid count to its border
    :param errors: SRL error of each visited state, [n], or empty
    :param edges: Edges of the bins of both coordinates, increasing, [a + 1] and [b + 1]
    :return: Visits, [a, b], which add up to n; and the mean error of each bin, [a, b], NaN where there is none
    """
    x, y = (np.clip(states[:, axis], edges[axis][0], edges[axis][-1]) for axis in (0, 1))
    visits = np.histogram2d(x, y, bins=edges)[0]  # type: ignore[call-overload]
    if len(errors) == 0:
        return visits, np.full_like(visits, np.nan)
    sums = np.histogram2d(x, y, bins=edges, weights=errors)[0]  # type: ignore[call-overload]
    return visits, np.divide(sums, visits, out=np.full_like(sums, np.nan), where=visits > 0)


def state_probe(
    model: BaseAlgorithm,
    episodes: Iterable[Episode],
    names: Sequence[str],
    units: Sequence[str] | None = None,
    ridge: float = 1e-3,
) -> dict[str, float]:
    """
    What a linear map reads of the true state in the latents: R² of each coordinate, by ridge regression.

    Each episode is predicted by the regression on all others, as its neighbours in time would give it away. An angle
    is predicted as sine and cosine, of which the R² is one: as a number it would jump by a turn. R² is 1 for perfect
    predictions, 0 for the mean of all states, and below 0 for what is worse than that.

    :param model: A model of any SB3 algorithm with an encoder (``policies.encoder_of``); compare models on the same
        episodes, such as those of random actions with a seed
    :param episodes: Two or more, of ``run_episodes(..., states=True)``
    :param names: Names of the state's coordinates, [d], as of ``sb3_cure.envs.physics_state_names``
    :param units: Their units, [d], as of ``physics_state_units``: ``"rad"`` marks angles. None: there are none
    :param ridge: Penalty of the squared weights for latents of variance 1, as a share of the number of observations
    :return: R² by name; NaN for coordinates that never change
    :raises ValueError: if the model has no encoder, or episodes have no states, or there is only one
    """
    policy: Any = model.policy
    found = encoder_of(policy)
    if found is None:
        raise ValueError(f"the {type(policy).__name__} has no encoder whose latents could be read.")
    policy.set_training_mode(False)
    latents, states = [], []
    for episode in episodes:
        n = len(episode.states)
        if n != len(episode.rewards):
            raise ValueError("the episodes have no true states: make them by run_episodes(..., states=True).")
        seen = obs_as_tensor(as_trained(model, episode.observations), model.device)
        parts = [rows_of(seen, slice(start, start + 128)) for start in range(0, n, 128)]
        with th.no_grad():
            latents.append(np.concatenate([found[1](part).double().cpu().numpy() for part in parts]))
        states.append(episode.states)
    if len(states) < 2:
        raise ValueError("the probe predicts each episode from others, but there is one at most: give more.")

    is_angle = [unit == "rad" for unit in units or [""] * len(names)]
    columns = np.concatenate(states).T
    targets_of = [
        np.stack([np.sin(column), np.cos(column)], axis=1) if angle else column[:, None]
        for column, angle in zip(columns, is_angle, strict=True)
    ]
    targets, inputs = np.concatenate(targets_of, axis=1), np.concatenate(latents)
    owners = np.repeat(np.arange(len(states)), [len(each) for each in states])
    errors = np.zeros(targets.shape[1])
    for owner in range(len(states)):
        own = owners == owner
        predicted = _ridge(inputs[~own], targets[~own], inputs[own], ridge)
        errors += np.square(predicted - targets[own]).sum(axis=0)
    spread = np.square(targets - targets.mean(axis=0)).sum(axis=0)
    ends = np.cumsum([part.shape[1] for part in targets_of])[:-1]
    result = {}
    for name, error, total in zip(names, np.split(errors, ends), np.split(spread, ends), strict=True):
        varies = total.sum() > 1e-9 * len(targets)
        result[name] = float(1 - error.sum() / total.sum()) if varies else float("nan")
    return result


def _ridge(inputs: np.ndarray, targets: np.ndarray, new_inputs: np.ndarray, penalty: float) -> np.ndarray:
    """Predictions for new inputs of a ridge regression on standardised inputs."""
    mean, deviation, middle = inputs.mean(axis=0), inputs.std(axis=0) + 1e-12, targets.mean(axis=0)
    design = (inputs - mean) / deviation
    gram = design.T @ design + penalty * len(design) * np.eye(design.shape[1])
    weights = np.linalg.solve(gram, design.T @ (targets - middle))
    return (new_inputs - mean) / deviation @ weights + middle
