"""Roll out one policy alone (task, curious or random) and measure what it earns and what SRL error it sees."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.type_aliases import ReplayBufferSamples

from sb3_cure.cure_sac import CuReSAC
from sb3_cure.envs import physics_state
from sb3_cure.srl import CURL

ACTORS = ("task", "curious", "random")


@dataclass
class Episode:
    """What one episode showed.

    :param rewards: Reward of each agent step, [T]
    :param srl_errors: The head's noise-free error of the observation before each step, [T]; empty without a head
    :param observations: The observations before each step, [T, *shape]
    :param frames: ``env.render()`` after each step, if asked for
    :param states: The true state of the environment before each step, [T, d], if asked for; else empty
    """

    rewards: np.ndarray
    srl_errors: np.ndarray
    observations: np.ndarray
    frames: list[np.ndarray]
    states: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))

    @property
    def total_reward(self) -> float:
        """Return of the episode, undiscounted."""
        return float(self.rewards.sum())


def srl_errors(model: CuReSAC, batch: ReplayBufferSamples, chunk: int = 128) -> np.ndarray:
    """SRL error of transitions without training noise, as the acting agent sees them (no augmentation).

    :param model: A model with an SRL head
    :param batch: Transitions, observations as stored (images in 0-255)
    :param chunk: How many at a time
    :return: Error per sample, [n]
    """
    policy = model.policy
    policy.set_training_mode(False)
    errors = []
    with th.no_grad():
        for start in range(0, len(batch.observations), chunk):
            part = ReplayBufferSamples(*[field[start : start + chunk] for field in batch if field is not None])
            errors.append(policy.srl.error(part, policy.encode(part.observations)).cpu().numpy())  # type: ignore[union-attr]
    return np.concatenate(errors)


def trained_actors(model: CuReSAC) -> list[str]:
    """
    :param model: A model, also of SB3's own SAC
    :return: Which of ``"task"`` and ``"curious"`` it trains
    """
    has_curious = getattr(model.policy, "curious_actor", None) is not None
    there = {"task": getattr(model, "task", True), "curious": has_curious}
    return [actor for actor, trained in there.items() if trained]


def even_negatives(model: CuReSAC, env: gym.Env, seed: int | None = None) -> None:
    """Before policies are compared by CURL's error: take its negatives evenly from what they see.

    Rolls out an episode of each policy that the model has. Without this the negatives are those of the random
    warm-up, to which the random policy's observations are the most alike. Heads without negatives are left alone.

    :param model: A trained model
    :param env: One (not vectorised) environment
    :param seed: Seed of the resets and of random actions
    """
    head = model.policy.srl
    if not isinstance(head, CURL):
        return
    actors = [*trained_actors(model), "random"]
    share = max(len(head.bank) // len(actors), 1)  # type: ignore[arg-type]
    seen = [next(run_episodes(model, env, 1, actor, seed=seed)).observations for actor in actors]
    frames = [each[np.linspace(0, len(each) - 1, share).astype(int)] for each in seen]
    head.set_bank(th.as_tensor(np.concatenate(frames)[: len(head.bank)]))  # type: ignore[arg-type]


def _actor(model: CuReSAC, env: gym.Env, actor: str, deterministic: bool) -> Callable[[np.ndarray], np.ndarray]:
    if actor not in ACTORS:
        raise ValueError(f"actor is {actor!r}, but it must be one of {', '.join(map(repr, ACTORS))}: choose one.")
    if actor == "random":
        return lambda observation: env.action_space.sample()
    predict = model.predict_curious if actor == "curious" else model.predict
    return lambda observation: predict(observation, deterministic=deterministic)[0]


def run_episodes(
    model: CuReSAC,
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
    :param actor: Whose actions: ``"task"``, ``"curious"`` or ``"random"`` (uniform)
    :param deterministic: Whether policies act by their mean
    :param seed: Seed of the first reset and of random actions
    :param render: Whether to keep ``env.render()`` of each step
    :param states: Whether to keep the true state before each step: ``True`` for that of a dm_control environment
        (``sb3_cure.envs.physics_state``), or a function of the environment that returns an array [d]
    :return: The episodes
    :raises ValueError: if the actor is unknown, the model has no curious policy, or the environment no known state
    """
    state_of = physics_state if states is True else states
    choose = _actor(model, env, actor, deterministic)
    if seed is not None:
        env.action_space.seed(seed)
    for index in range(n_episodes):
        observation, _ = env.reset(seed=seed if index == 0 else None)
        observations, actions, rewards, dones, frames = [observation], [], [], [], []
        true_states = []
        done = False
        while not done:
            action = choose(observation)
            if state_of:
                true_states.append(np.array(state_of(env)))  # a copy
            observation, reward, terminated, truncated, _ = env.step(action)
            done = terminated or truncated
            observations.append(observation)
            actions.append(action)
            rewards.append(float(reward))
            dones.append(terminated)
            if render:
                frames.append(env.render())
        seen = np.stack(observations)
        errors = np.zeros(0, np.float32)
        if getattr(model.policy, "srl", None) is not None:
            errors = srl_errors(model, _as_batch(model, seen, actions, rewards, dones))
        episode = Episode(np.array(rewards), errors, seen[:-1], frames)  # type: ignore[arg-type]
        if true_states:
            episode.states = np.stack(true_states)
        yield episode


def _as_batch(
    model: CuReSAC, observations: np.ndarray, actions: list[np.ndarray], rewards: list[float], dones: list[bool]
) -> ReplayBufferSamples:
    """An episode in the form in which heads read the replay buffer (actions scaled to [-1, 1])."""
    device = model.device
    stacked = th.as_tensor(observations, device=device)
    column = {"dtype": th.float32, "device": device}
    return ReplayBufferSamples(
        observations=stacked[:-1],
        actions=th.as_tensor(model.policy.scale_action(np.stack(actions)), **column),  # type: ignore[arg-type]
        next_observations=stacked[1:],
        dones=th.as_tensor(dones, **column).unsqueeze(1),  # type: ignore[arg-type]
        rewards=th.as_tensor(rewards, **column).unsqueeze(1),  # type: ignore[arg-type]
    )
