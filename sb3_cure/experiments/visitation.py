"""SRL error that policies meet (paper, Figure 2), and the true states that they reach.

Own heads differ from run to run: see ``heads`` for common ones.
"""

import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.preprocessing import is_image_space

from sb3_cure.cure.algorithms import CuReSAC
from sb3_cure.envs import physics_state_names, physics_state_units
from sb3_cure.evaluation.result_files import Row, write_csv
from sb3_cure.evaluation.rollouts import (
    Episode,
    balanced_negatives,
    chunks,
    run_episodes,
    trained_actors,
    untouched_randomness,
)
from sb3_cure.experiments.grid import Cell
from sb3_cure.networks.layers import flatten_vectors
from sb3_cure.srl import RAE

#: Added to a cell's seed for its rollouts: the arms of a seed start from the same states, other seeds from others
VISIT_SEED = 20_000
COLUMNS = ("actor", "head", "episode", "error_min", "error_mean", "error_max", "return")


def visiting_actors(model: CuReSAC, cell: Cell) -> list[str]:
    """Policies to measure: those that the cell has trained (none if it was only pretrained), and the random one.

    :param model: The cell's model
    :param cell: A cell
    :return: Their names
    """
    return [*(trained_actors(model) if cell.budget > 0 else []), "random"]


def measure_visits(model: CuReSAC, cell: Cell, folder: Path) -> None:
    """Roll out each policy as it acts in training, and write ``visitation.csv`` and ``visits.npz``.

    Errors are those that the model measures (its head's, or its reward's) and of two constant predictions: ``zero``,
    the middle grey, and ``mean_image``, the mean of all observations of these episodes (of vectors: 0, and their mean).

    :param model: A trained model
    :param cell: Its cell
    :param folder: Where to write
    """
    arrays: dict[str, Any] = {}
    with contextlib.closing(cell.make_eval_env()) as env, balanced_negatives(model, env, VISIT_SEED - 1):
        has_physics = env.has_wrapper_attr("physics")
        episodes = {actor: roll_out(model, cell, env, actor, has_physics) for actor in visiting_actors(model, cell)}
        if has_physics:
            arrays.update(state_names=physics_state_names(env), state_units=physics_state_units(env))
    for actor, seen in episodes.items():
        arrays[f"{actor}_errors"] = np.concatenate([each.srl_errors for each in seen], dtype=np.float32)
        if has_physics:
            arrays[f"{actor}_states"] = np.concatenate([each.states for each in seen], dtype=np.float32)
    mean_image = mean_target(model, [each for seen in episodes.values() for each in seen])
    rows: list[Row] = []
    for actor, seen in episodes.items():
        for number, each in enumerate(seen):
            errors = {"own": each.srl_errors} if len(each.srl_errors) else {}  # none without a head
            for head, image in (("zero", np.zeros_like(mean_image)), ("mean_image", mean_image)):
                errors[head] = constant_errors(model, each.observations, image)
            rows += [visit_row(actor, head, number, values, each) for head, values in errors.items()]
    np.savez_compressed(folder / "visits.npz", **arrays)
    write_csv(folder / "visitation.csv", COLUMNS, rows)


def roll_out(model: CuReSAC, cell: Cell, env: gym.Env, actor: str, states: bool = False) -> list[Episode]:
    """Roll out a policy as it acts in training, with sampled actions; always the same episodes.

    :param model: A trained model
    :param cell: Its cell
    :param env: The cell's environment
    :param actor: The policy
    :param states: Whether to record the true states
    :return: The episodes
    """
    seed = VISIT_SEED + cell.seed
    with untouched_randomness(model.device, seed):
        return list(run_episodes(model, env, cell.eval_episodes, actor, deterministic=False, seed=seed, states=states))


def _targets(model: CuReSAC, observations: np.ndarray) -> Iterator[np.ndarray]:
    """Targets of an autoencoder, which are the centred views, float32 [n, ...], in batches."""
    head = model.policy.srl
    for chunk in chunks(len(observations)):
        images = model.policy.center(th.as_tensor(observations[chunk], device=model.device))
        if isinstance(head, RAE):
            yield head.target(images, dither=False).cpu().numpy()
        elif not is_image_space(model.observation_space):
            yield flatten_vectors(images, model.observation_space).cpu().numpy()
        else:  # five bits, as an autoencoder's by default
            yield ((images.div(8, rounding_mode="floor") + 0.5) / 32 - 0.5).cpu().numpy()


def mean_target(model: CuReSAC, episodes: Sequence[Episode]) -> np.ndarray:
    """Mean image of all steps.

    :param model: A model, whose autoencoder defines the targets
    :param episodes: Episodes with observations
    :return: The image in the scale of the autoencoder's target
    """
    sums = [part.sum(axis=0) for each in episodes for part in _targets(model, each.observations)]
    return np.sum(sums, axis=0) / sum(len(each.observations) for each in episodes)


def constant_errors(model: CuReSAC, observations: np.ndarray, image: np.ndarray) -> np.ndarray:
    """Errors of a constant prediction.

    :param model: A model, whose autoencoder defines the targets
    :param observations: Images in 0-255, [n, *shape]
    :param image: The prediction, in the scale of the autoencoder's target
    :return: Error of each observation, [n]
    """
    parts = [np.square(part - image).reshape(len(part), -1).mean(axis=1) for part in _targets(model, observations)]
    return np.concatenate(parts)


def visit_row(actor: str, head: str, number: int, errors: np.ndarray, episode: Episode) -> Row:
    """A row of ``visitation.csv``.

    :param actor: Policy that acted
    :param head: Head that the errors are measured by
    :param number: Number of the episode
    :param errors: SRL error of each step
    :param episode: The episode
    :return: The row
    """
    numbers = map(float, (errors.min(), errors.mean(), errors.max(), episode.total_reward))
    return dict(zip(COLUMNS, (actor, head, number, *numbers), strict=True))
