"""What latents tell of the true state."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.utils import obs_as_tensor

from sb3_cure.data.observations import rows_of
from sb3_cure.evaluation.encoders import encoder_of
from sb3_cure.evaluation.rollouts import Episode, as_trained, chunks


def state_probe(
    model: BaseAlgorithm,
    episodes: Iterable[Episode],
    names: Sequence[str],
    units: Sequence[str] | None = None,
    ridge: float = 1e-3,
) -> dict[str, float]:
    """R² of each coordinate of the true state, predicted from the latents by ridge regression.

    Each episode is predicted by the regression on all other episodes: neighbouring steps would give the answer away. An
    angle is predicted as sine and cosine with one R² for both: as a number it would jump by a turn. R² is 1 for perfect
    predictions, 0 for the mean of all states, and below 0 for worse.

    :param model: A model of any SB3 algorithm with an encoder (``encoders.encoder_of``); compare models on the same
        episodes, such as those of random actions with a seed
    :param episodes: Two or more, of ``run_episodes(..., states=True)``
    :param names: Names of the state's coordinates, [d], as for ``sb3_cure.envs.physics_state_names``
    :param units: Their units, [d], as for ``physics_state_units``: ``"rad"`` marks angles. None: no angles
    :param ridge: Penalty of the squared weights for latents of variance 1, as a share of the number of observations
    :return: R² by name; NaN for coordinates that never change
    :raises ValueError: if the model has no encoder, episodes have no states, or there are fewer than two
    """
    policy: Any = model.policy
    encode = encoder_of(policy)
    if encode is None:
        raise ValueError(f"state_probe needs a policy with an encoder, which {type(policy).__name__} does not have.")
    policy.set_training_mode(False)
    latents, states = [], []
    for episode in episodes:
        if len(episode.states) != len(episode.rewards):
            raise ValueError("the episodes have no true states: make them by run_episodes(..., states=True).")
        seen = obs_as_tensor(as_trained(model, episode.observations), model.device)
        parts = [rows_of(seen, chunk) for chunk in chunks(len(episode.states))]
        with th.no_grad():
            latents.append(np.concatenate([encode(part).double().cpu().numpy() for part in parts]))
        states.append(episode.states)
    if len(states) < 2:
        raise ValueError("state_probe needs two episodes at least: it predicts each from the others.")

    targets = [
        np.stack([np.sin(column), np.cos(column)], axis=1) if unit == "rad" else column[:, None]
        for column, unit in zip(np.concatenate(states).T, units or [""] * len(names), strict=True)
    ]
    inputs, outputs = np.concatenate(latents), np.concatenate(targets, axis=1)
    owners = np.repeat(np.arange(len(states)), [len(each) for each in states])
    predicted = np.empty_like(outputs)
    for own in (owners == owner for owner in range(len(states))):
        predicted[own] = _ridge(inputs[~own], outputs[~own], inputs[own], ridge)
    ends = np.cumsum([target.shape[1] for target in targets])[:-1]
    result = {}
    for name, target, guess in zip(names, targets, np.split(predicted, ends, axis=1), strict=True):
        spread = np.square(target - target.mean(axis=0)).sum()
        varies = spread > 1e-9 * len(target)
        result[name] = float(1 - np.square(guess - target).sum() / spread) if varies else float("nan")
    return result


def _ridge(inputs: np.ndarray, targets: np.ndarray, new_inputs: np.ndarray, penalty: float) -> np.ndarray:
    """Predict targets of new inputs by ridge regression on standardised inputs."""
    mean, deviation, middle = inputs.mean(axis=0), inputs.std(axis=0) + 1e-12, targets.mean(axis=0)
    design = (inputs - mean) / deviation
    gram = design.T @ design + penalty * len(design) * np.eye(design.shape[1])
    weights = np.linalg.solve(gram, design.T @ (targets - middle))
    return (new_inputs - mean) / deviation @ weights + middle
