"""Common heads: by them all policies of a seed are judged alike, as their own heads differ from run to run.

The common head of a seed is an autoencoder that is fitted to an even mix of what the random, task and curious policies
of the task's *other* seeds saw. It is a unit of work like a cell, with a folder of its own.
"""

import json
import shutil
import time
from collections.abc import Container, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.type_aliases import ReplayBufferSamples

from sb3_cure.cure_sac import CuReSAC
from sb3_cure.evaluation import Episode, srl_errors
from sb3_cure.experiments.cells import ERROR, PROGRESS_SECONDS, alone_in, check_settings, write_progress
from sb3_cure.experiments.files import describe_run, read_rows, write_csv, write_json
from sb3_cure.experiments.grid import DONE, Cell, Grid, GridError, read_kept, short_name
from sb3_cure.experiments.visitation import COLUMNS, roll_out, visit_row, visiting_actors
from sb3_cure.persistence import is_pickled_model
from sb3_cure.persistence.files import replacing

#: Updates of a common head: an autoencoder tells little before some thousands of them
COMMON_UPDATES = 3000
#: Observations per policy in the mix to which a common head is fitted
COMMON_SHARE = 1000
#: Whose observations these are: with further arms of the same kind, such as variants, it would outweigh the others
POLICIES = "random, task and curious, each of the first arm that has it"
#: The file that tells that a common head is finished, and of what it was made
RECORD = "common_head.json"


@dataclass(frozen=True)
class CommonHead:
    """The common head that judges the policies of one seed.

    :param task: Gymnasium id
    :param seed: Seed of the policies that it judges
    :param cells: The task's cells of this seed, and of those whose policies it is fitted to
    :param finished: When each of the cells was finished, by folder; None for those that are still to be
    :param updates: How many fit it
    :param share: Observations of each policy of a seed in the mix
    """

    task: str
    seed: int
    cells: tuple[Cell, ...]
    finished: dict[str, str | None]
    updates: int
    share: int

    #: As in tables beside cells
    method = "common head"

    @property
    def folder(self) -> Path:
        """Where it lies below the folder of results."""
        return Path(self.cells[0].experiment, short_name(self.task), "common_heads", f"for_seed{self.seed}")

    @property
    def seeds(self) -> list[int]:
        """Of its cells."""
        return sorted({cell.seed for cell in self.cells})

    def cells_of(self, seed: int) -> list[Cell]:
        """
        :param seed: One of ``seeds``
        :return: The arms of the seed
        """
        return [cell for cell in self.cells if cell.seed == seed]

    def config(self) -> dict[str, Any]:
        """What its ``config.json`` holds."""
        settings = {"updates": self.updates, "observations_per_policy": self.share, "policies": POLICIES}
        return {"task": self.task, "seed": self.seed, **settings}

    def is_done(self, results: Path) -> bool:
        """
        :param results: Folder of all results
        :return: Whether it has been made of these very cells (and perhaps of others, by a process that knew more):
            further seeds or arms, or a cell that was run again, ask for another
        """
        path = results / self.folder / RECORD
        if not path.exists():
            return False
        made_of = read_kept(path, "cells")["cells"]
        if made_of == self.finished:
            return True
        of_more = self.finished.items() <= made_of.items()
        return of_more and all(_finished_at(results / folder) == finished for folder, finished in made_of.items())


Unit: TypeAlias = Cell | CommonHead


def common_heads(grid: Grid, results: Path, coming: Sequence[Cell] = ()) -> list[CommonHead]:
    """The common heads of the grid's tasks, whichever of its seeds and arms this call has chosen.

    :param grid: A grid
    :param results: Folder of all results
    :param coming: Cells that are to be regarded as finished
    :return: One per task and seed of which all arms are finished; none for tasks with fewer than two such seeds, for
        those whose heads are not made and cannot be (see ``without_model``), and for grids of another kind than
        ``"visitation"``
    """
    heads = []
    for cells in _cells_by_task(grid, results):
        finished = {cell.folder: _finished_at(results / cell.folder) for cell in cells}
        missing = {cell.seed for cell in cells if finished[cell.folder] is None and cell not in coming}
        complete = tuple(cell for cell in cells if cell.seed not in missing)
        of = {str(cell.folder): finished[cell.folder] for cell in complete}
        seeds = sorted({cell.seed for cell in complete})
        of_task = [CommonHead(cells[0].task, seed, complete, of, COMMON_UPDATES, COMMON_SHARE) for seed in seeds]
        can_be_made = not any(finished[cell.folder] and _lacks_model(cell, results) for cell in complete)
        if len(seeds) > 1 and (can_be_made or all(head.is_done(results) for head in of_task)):
            heads += of_task
    return heads


def without_model(grid: Grid, results: Path) -> dict[str, Cell]:
    """
    :param grid: A grid
    :param results: Folder of all results
    :return: By task, the first finished cell without ``model.zip``, such as those of a repository that does not keep
        them. Heads made of the others alone would judge these by another measure
    """
    cells = [cell for of_task in _cells_by_task(grid, results) for cell in of_task]
    lacking = [cell for cell in cells if _finished_at(results / cell.folder) and _lacks_model(cell, results)]
    return {cell.task: cell for cell in reversed(lacking)}


def _cells_by_task(grid: Grid, results: Path) -> Iterator[list[Cell]]:
    if grid.kind == "visitation":
        every = grid.with_seeds_in(results)
        for task in dict.fromkeys(cell.task for cell in grid.cells):
            yield [cell for cell in every if cell.task == task]


def _finished_at(folder: Path) -> str | None:
    """When the cell was finished; None if it is not."""
    if not all((folder / name).exists() for name in (DONE, "run.json")):
        return None
    return str(read_kept(folder / "run.json", "finished")["finished"])


def _lacks_model(cell: Cell, results: Path) -> bool:
    return not (results / cell.folder / "model.zip").exists()


def run_head(head: CommonHead, results: Path) -> None:
    """Fit a common head and add its rows to the ``visitation.csv`` of the cells that it judges, unless that is done.

    Policies are rolled out anew from each cell's ``model.zip``: the same episodes as before. Where another process is
    making it, that is waited for: it may know of fewer cells.

    :param head: Which, of finished cells
    :param results: Folder of all results
    :raises GridError: if its folder holds one with other settings, or a model cannot be loaded safely
    """
    folder = results / head.folder
    check_settings(folder, head.config())
    folder.mkdir(parents=True, exist_ok=True)
    with alone_in(folder, wait=True):
        if head.is_done(results):
            return
        (folder / ERROR).unlink(missing_ok=True)
        write_json(folder / "config.json", head.config())
        write_progress(folder, updates=0, seconds=0)
        judge = _fit(head, _mix_of_others(head, results), folder)
        for cell in head.cells_of(head.seed):
            _add_rows(judge, cell, results)
        write_json(folder / RECORD, {"cells": head.finished, **describe_run()})
        (folder / "progress.json").unlink(missing_ok=True)
    if all(replace(head, seed=seed).is_done(results) for seed in head.seeds):
        for seed in head.seeds:
            shutil.rmtree(_mix_folder(head, seed, results), ignore_errors=True)


def _episodes(cell: Cell, results: Path, known: Container[str] = ()) -> Iterator[tuple[str, list[Episode]]]:
    """The episodes of ``measure_visits`` again, by policy, but for those policies that are known."""
    path = results / cell.folder / "model.zip"
    if is_pickled_model(path):
        raise GridError(
            f"{path} was written by an older version, with pickle, which may run any code when it is loaded: if it is "
            f"your own, write it anew by CuReSAC.load({str(path)!r}, trusted=True).save({str(path)!r}), else remove "
            "the cell's folder, so that the cell is run again."
        )
    model = CuReSAC.load(path, custom_objects={**cell.custom_objects(), "buffer_size": 1})
    env = gym.make(cell.task, **cell.env_kwargs)
    for actor in visiting_actors(model, cell):
        if actor not in known:
            yield actor, roll_out(model, cell, env, actor)
    env.close()


def _mix_of_others(head: CommonHead, results: Path) -> np.ndarray:
    """What the policies of the other seeds saw, seed by seed."""
    # Heads that are made side by side begin with different seeds, so that each finds those after ready.
    order = sorted(head.seeds, key=lambda seed: (seed < head.seed, seed))[1:]
    mixes = {seed: _mix(head, seed, results) for seed in order}
    return np.concatenate([mixes[seed] for seed in sorted(order)])


def _mix_folder(head: CommonHead, seed: int, results: Path) -> Path:
    return results / head.folder.parent / f"mix_of_seed{seed}"


def _mix(head: CommonHead, seed: int, results: Path) -> np.ndarray:
    """Observations of one seed's policies, as many of each kind; kept for the other heads."""
    folder, cells = _mix_folder(head, seed, results), head.cells_of(seed)
    made_of = json.dumps([POLICIES, head.share, {str(cell.folder): head.finished[str(cell.folder)] for cell in cells}])
    folder.mkdir(exist_ok=True)
    with alone_in(folder, wait=True):
        path = folder / "mix.npz"
        if path.exists():
            with np.load(path) as kept:
                if kept["made_of"] == made_of:
                    return kept["observations"]
        seen: dict[str, np.ndarray] = {}
        for cell in cells:
            for actor, episodes in _episodes(cell, results, seen):
                observations = np.concatenate([episode.observations for episode in episodes])
                seen[actor] = observations[np.linspace(0, len(observations) - 1, head.share).astype(int)]
        mix = np.concatenate(list(seen.values()))
        with replacing(path) as beside, beside.open("wb") as file:
            np.savez_compressed(file, made_of=made_of, observations=mix)
        return mix


def _fit(head: CommonHead, observations: np.ndarray, folder: Path) -> CuReSAC:
    """An autoencoder with the networks of the seed's first cell, fitted to given observations alone."""
    cell = head.cells_of(head.seed)[0]
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
    begun = told = time.monotonic()
    for number in fit_head(model, observations, head.updates):
        if time.monotonic() - told > PROGRESS_SECONDS:
            told = time.monotonic()
            write_progress(folder, updates=number, seconds=told - begun)
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


def _add_rows(judge: CuReSAC, cell: Cell, results: Path) -> None:
    path = results / cell.folder / "visitation.csv"
    rows = [row for row in read_rows(path) if row["head"] != "common"]
    for actor, episodes in _episodes(cell, results):
        for number, episode in enumerate(episodes):
            errors = srl_errors(judge, observation_batch(episode.observations, judge.device))
            rows.append(visit_row(actor, "common", number, errors, episode))
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
