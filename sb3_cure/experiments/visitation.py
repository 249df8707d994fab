"""What policies visit: the SRL error they meet (paper, Figure 2), and the true states they reach.

A policy's own head is one yardstick, but heads differ from run to run. Common heads are fitted to an even mix of what
the policies of *other* seeds saw, and judge all policies of a seed alike.
"""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.type_aliases import ReplayBufferSamples

from sb3_cure.cure_sac import CuReSAC
from sb3_cure.envs import physics_state_names
from sb3_cure.evaluation import Episode, even_negatives, run_episodes, srl_errors, trained_actors
from sb3_cure.experiments.files import Row, read_rows, write_csv, write_json
from sb3_cure.experiments.grid import Cell, Grid, short_name
from sb3_cure.srl import RAE

#: Plus the cell's seed: the arms of a seed start from the same states, another seed from others
VISIT_SEED = 20_000
#: Updates of a common head: an autoencoder tells little before some thousands of them
COMMON_UPDATES = 3000
#: Observations per policy in the mix to which a common head is fitted
COMMON_SHARE = 1000
COLUMNS = ("actor", "head", "episode", "error_min", "error_mean", "error_max", "return")


def visiting_actors(model: CuReSAC, cell: Cell) -> list[str]:
    """
    :param model: The cell's model
    :param cell: A cell
    :return: The policies to measure: those that it has trained (none if it was only pretrained), and the random one
    """
    return [*(trained_actors(model) if cell.budget > 0 else []), "random"]


def measure_visits(model: CuReSAC, cell: Cell, folder: Path) -> None:
    """Roll out each policy, as it acts in training, and write ``visitation.csv`` and ``visits.npz``.

    Errors are those of the model's own head, and of two predictions that know nothing: ``zero``, the middle grey,
    and ``mean_image``, the mean of everything that the policies saw in these episodes.

    :param model: A trained model
    :param cell: Its cell
    :param folder: Where to write
    """
    env = gym.make(cell.task, **cell.env_kwargs)
    even_negatives(model, env, seed=VISIT_SEED - 1)
    has_physics = env.has_wrapper_attr("physics")
    arrays: dict[str, np.ndarray] = {}
    if has_physics:
        arrays["state_names"] = np.array(physics_state_names(env))
    episodes = {}
    for actor in visiting_actors(model, cell):
        episodes[actor] = _roll_out(model, cell, env, actor, has_physics)
        arrays[f"{actor}_errors"] = np.concatenate([each.srl_errors for each in episodes[actor]]).astype(np.float32)
        if has_physics:
            states = np.concatenate([each.states for each in episodes[actor]])
            arrays[f"{actor}_states"] = states.astype(np.float32)
    mean_image = np.mean([mean_target(model, seen) for seen in episodes.values()], axis=0)
    rows: list[Row] = []
    for actor, seen in episodes.items():
        for number, each in enumerate(seen):
            constant = {"zero": np.zeros_like(mean_image), "mean_image": mean_image}
            errors = {head: constant_errors(model, each.observations, image) for head, image in constant.items()}
            own = {"own": each.srl_errors} if len(each.srl_errors) else {}  # none without a head
            for head, values in {**own, **errors}.items():
                rows.append(_row(actor, head, number, values, each))
    env.close()
    np.savez_compressed(folder / "visits.npz", **arrays)  # type: ignore[arg-type]
    write_csv(folder / "visitation.csv", COLUMNS, rows)


def measure_common_heads(grid: Grid, results: Path) -> list[str]:
    """Fit common heads and add their rows to the ``visitation.csv`` of all seeds whose arms are all finished.

    For each task and seed an autoencoder is fitted to an even mix of what the random, task and curious policies of
    the other seeds saw, whichever cells this call of the grid has chosen. Policies are rolled out anew from each cell's
    ``model.zip``: the same episodes as before. Done again only when more seeds are finished.

    :param grid: The grid, of kind ``"visitation"``
    :param results: Folder of all results
    :return: What was left out, one sentence each
    """
    left_out = []
    for task in dict.fromkeys(cell.task for cell in grid.cells):
        of_task = [cell for cell in grid.complete if cell.task == task]
        unfinished = {cell.seed for cell in of_task if not _is_measurable(cell, results)}
        seeds = sorted({cell.seed for cell in of_task} - unfinished)
        if len(seeds) < 2:
            left_out.append(f"{task}: they need two seeds of which all methods are finished, with their model.zip")
            continue
        record = results / grid.experiment / short_name(task) / "common_heads.json"
        if record.exists() and json.loads(record.read_text())["seeds"] == seeds:
            continue
        cells = {seed: [cell for cell in of_task if cell.seed == seed] for seed in seeds}
        mixes = {seed: _mix(cells[seed], results) for seed in seeds}
        for seed in seeds:
            print(f"{task}: a common head for seed {seed}, of what the policies of the other seeds saw", flush=True)
            others = np.concatenate([mixes[other] for other in seeds if other != seed])
            judge = _fit_common_head(cells[seed][0], others)
            for cell in cells[seed]:
                _add_common_rows(judge, cell, results)
        write_json(record, {"seeds": seeds, "updates": COMMON_UPDATES, "observations_per_policy": COMMON_SHARE})
    return left_out


def _is_measurable(cell: Cell, results: Path) -> bool:
    folder = results / cell.folder
    return (folder / "DONE").exists() and (folder / "model.zip").exists()


def _roll_out(model: CuReSAC, cell: Cell, env: gym.Env, actor: str, states: bool = False) -> list[Episode]:
    """Episodes of a policy as it acts in training, with sampled actions; always the same ones."""
    seed = VISIT_SEED + cell.seed
    with th.random.fork_rng():
        th.manual_seed(seed)
        return list(run_episodes(model, env, cell.eval_episodes, actor, deterministic=False, seed=seed, states=states))


def _episodes(cell: Cell, results: Path) -> Iterator[tuple[str, list[Episode]]]:
    """The episodes of ``measure_visits`` again, by policy."""
    objects = {**cell.custom_objects(), "buffer_size": 1}
    model = CuReSAC.load(results / cell.folder / "model.zip", custom_objects=objects)
    env = gym.make(cell.task, **cell.env_kwargs)
    for actor in visiting_actors(model, cell):
        yield actor, _roll_out(model, cell, env, actor)
    env.close()


def _mix(cells: Sequence[Cell], results: Path) -> np.ndarray:
    """Observations of one seed's policies, as many of each of random, task and curious."""
    seen: dict[str, list[np.ndarray]] = {}
    for cell in cells:
        for actor, episodes in _episodes(cell, results):
            seen.setdefault(actor, []).append(np.concatenate([episode.observations for episode in episodes]))
    evenly = []
    for parts in seen.values():
        observations = np.concatenate(parts)
        evenly.append(observations[np.linspace(0, len(observations) - 1, COMMON_SHARE).astype(int)])
    return np.concatenate(evenly)


def _fit_common_head(cell: Cell, observations: np.ndarray) -> CuReSAC:
    """An autoencoder with the cell's networks, fitted to given observations alone."""
    env = gym.make(cell.task, **cell.env_kwargs)
    model = CuReSAC(
        cell.arguments.get("policy", "CnnPolicy"),
        env,
        srl="rae",
        srl_kwargs=cell.arguments.get("srl_kwargs", {}) if cell.arguments.get("srl", "rae") == "rae" else {},
        curiosity=None,
        policy_kwargs=dict(cell.arguments.get("policy_kwargs", {})),
        buffer_size=1,
        seed=1000 + cell.seed,
    )
    env.close()
    for _ in fit_head(model, observations, COMMON_UPDATES):
        pass
    return model


def fit_head(model: CuReSAC, observations: np.ndarray, updates: int) -> Iterator[int]:
    """Train encoder and autoencoder on given observations alone, with neither rewards nor actions.

    :param model: A model with an autoencoder; what it has learned so far is the start
    :param observations: Images in 0-255, [n, *shape]
    :param updates: Updates, of 128 observations and with Adam at 1e-3
    :return: After each update, its number (from 1)
    """
    policy = model.policy
    head: Any = policy.srl
    optimizer = th.optim.Adam([*policy.encoder.parameters(), *head.parameters()], lr=1e-3)
    random = np.random.default_rng(model.seed)
    for number in range(1, updates + 1):
        policy.set_training_mode(True)
        batch = observation_batch(observations[random.integers(len(observations), size=128)], model.device)
        with model._autocast():
            latents = policy.encoder(policy.augment(batch.observations))
            loss = head.loss(batch, latents).loss
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        yield number


def _add_common_rows(judge: CuReSAC, cell: Cell, results: Path) -> None:
    path = results / cell.folder / "visitation.csv"
    rows = [row for row in read_rows(path) if row["head"] != "common"]
    for actor, episodes in _episodes(cell, results):
        for number, episode in enumerate(episodes):
            errors = srl_errors(judge, observation_batch(episode.observations, judge.device))
            rows.append(_row(actor, "common", number, errors, episode))
    write_csv(path, COLUMNS, rows)


def observation_batch(observations: np.ndarray, device: th.device) -> ReplayBufferSamples:
    """
    :param observations: Images in 0-255, [n, *shape]
    :param device: Where the batch is to be
    :return: A batch with observations alone, which are all that an autoencoder reads
    """
    images = th.as_tensor(observations, device=device)
    nothing = th.zeros((len(images), 1), device=device)
    return ReplayBufferSamples(images, nothing, images, nothing, nothing)


def _targets(model: CuReSAC, observations: np.ndarray) -> Iterator[np.ndarray]:
    """What an autoencoder is to draw of observations, float32 [n, ...], some at a time."""
    head = getattr(model.policy, "srl", None)
    for start in range(0, len(observations), 128):
        images = th.as_tensor(observations[start : start + 128], device=model.device)
        if isinstance(head, RAE):
            yield head.target(images, dither=False).cpu().numpy()
        else:
            yield ((images.div(8, rounding_mode="floor") + 0.5) / 32 - 0.5).cpu().numpy()


def mean_target(model: CuReSAC, episodes: Sequence[Episode]) -> np.ndarray:
    """
    :param model: A model, whose autoencoder says what is to be drawn
    :param episodes: Episodes with observations
    :return: The mean image of all steps, in the scale of the autoencoder's target
    """
    sums = [part.sum(axis=0) for each in episodes for part in _targets(model, each.observations)]
    return np.sum(sums, axis=0) / sum(len(each.observations) for each in episodes)


def constant_errors(model: CuReSAC, observations: np.ndarray, image: np.ndarray) -> np.ndarray:
    """
    :param model: A model, whose autoencoder says what is to be drawn
    :param observations: Images in 0-255, [n, *shape]
    :param image: What is drawn, whatever is seen, in the scale of the autoencoder's target
    :return: Error of each observation, [n]
    """
    parts = [np.square(part - image).reshape(len(part), -1).mean(axis=1) for part in _targets(model, observations)]
    return np.concatenate(parts)


def _row(actor: str, head: str, number: int, errors: np.ndarray, episode: Episode) -> Row:
    return {
        "actor": actor,
        "head": head,
        "episode": number,
        "error_min": float(errors.min()),
        "error_mean": float(errors.mean()),
        "error_max": float(errors.max()),
        "return": episode.total_reward,
    }
