"""Common heads: they judge all policies of a seed alike, whereas each run's own head differs.

The common head of a seed is an autoencoder that is fitted to an even mix of the observations of the random, task and
curious policies of the task's *other* seeds. The heads of a task are a unit of work like a cell, with their own folder.
"""

import contextlib
from collections.abc import Container, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import torch as th

from sb3_cure.cli.zoo_files import ALGORITHMS
from sb3_cure.cure.algorithms import CuReSAC
from sb3_cure.data.samples import Samples
from sb3_cure.evaluation.result_files import Row, describe_run, read_rows, write_csv, write_json
from sb3_cure.evaluation.rollouts import Episode, srl_errors
from sb3_cure.experiments.cells import alone_in
from sb3_cure.experiments.grid import ERROR, Cell, Grid, read_json, short_name
from sb3_cure.experiments.visitation import COLUMNS, roll_out, visit_row, visiting_actors

#: Updates of a common head
COMMON_UPDATES = 3000
#: Observations per policy in the mix to which a common head is fitted
COMMON_SHARE = 1000
#: File of finished common heads, with what they were fitted to
RECORD = "common_head.json"


@dataclass(frozen=True)
class CommonHeads:
    """Common heads of a task, one for each of its seeds of which all arms are finished.

    :param grid: The grid, whichever of its seeds and arms are chosen
    :param task: Gymnasium id
    """

    grid: Grid
    task: str

    @property
    def folder(self) -> Path:
        """Their folder below the folder of results."""
        return Path(self.grid.experiment, short_name(self.task), "common_heads")

    def seeds(self, results: Path) -> dict[int, list[Cell]]:
        """All arms by seed, for the seeds whose arms are all finished and have kept their models.

        :param results: Folder of all results
        :return: Cells by seed
        """
        arms: dict[int, list[Cell]] = {}
        for cell in self.grid.with_seeds_in(results):
            if cell.task == self.task:
                arms.setdefault(cell.seed, []).append(cell)

        def is_ready(cell: Cell) -> bool:
            return cell.is_done(results) and (results / cell.folder / "model.zip").exists()

        return {seed: cells for seed, cells in arms.items() if all(map(is_ready, cells))}

    def fingerprint(self, results: Path) -> dict[str, Any]:
        """Content of their record; it changes with further seeds or a cell run again, and they are fitted anew then."""
        finished = {
            str(cell.folder): read_json(results / cell.folder / "run.json")["finished"]
            for cells in self.seeds(results).values()
            for cell in cells
        }
        return {"cells": finished, "updates": COMMON_UPDATES, "share": COMMON_SHARE}

    def is_done(self, results: Path) -> bool:
        """Whether they were fitted to all seeds that are finished now.

        :param results: Folder of all results
        """
        path = results / self.folder / RECORD
        return path.exists() and self.fingerprint(results).items() <= read_json(path).items()


Unit: TypeAlias = Cell | CommonHeads


def common_heads(grid: Grid, results: Path) -> list[CommonHeads]:
    """Common heads of the chosen tasks that have two seeds to fit them to.

    :param grid: A grid
    :param results: Folder of all results
    :return: One for each such task; none in grids of another kind than ``"visitation"``
    """
    tasks = dict.fromkeys(cell.task for cell in grid.cells if grid.kind == "visitation")
    every = [CommonHeads(grid, task) for task in tasks]
    return [heads for heads in every if len(heads.seeds(results)) > 1]


def run_heads(heads: CommonHeads, results: Path) -> None:
    """Fit a task's common heads and add their rows to the ``visitation.csv`` of its cells, unless that is done.

    Policies are rolled out anew from each cell's ``model.zip``: the same episodes as before. If another process is
    fitting them, wait for it, as it may know of fewer cells.

    :param heads: The heads
    :param results: Folder of all results
    """
    folder = results / heads.folder
    folder.mkdir(parents=True, exist_ok=True)
    with alone_in(folder, wait=True):
        if heads.is_done(results):
            return
        (folder / ERROR).unlink(missing_ok=True)
        fingerprint, seeds = heads.fingerprint(results), heads.seeds(results)
        mixes = {seed: _mix(cells, results) for seed, cells in seeds.items()}
        tables: dict[Path, list[Row]] = {}
        for seed, cells in seeds.items():
            judge = _judge(cells[0])
            others = np.concatenate([mixes[other] for other in mixes if other != seed])
            for _ in fit_head(judge, others, COMMON_UPDATES):
                pass
            print(f"{heads.folder}: the head of seed {seed} is fitted", flush=True)
            for cell in cells:
                path = results / cell.folder / "visitation.csv"
                kept = [row for row in read_rows(path) if row["head"] != "common"]
                tables[path] = kept + list(_rows(judge, cell, results))
        for path, rows in tables.items():
            write_csv(path, COLUMNS, rows)
        write_json(folder / RECORD, {**fingerprint, **describe_run()})


def _episodes(cell: Cell, results: Path, known: Container[str] = ()) -> Iterator[tuple[str, list[Episode]]]:
    """Roll out the episodes of ``measure_visits`` again, by policy; policies in ``known`` are left out."""
    model = cell.load_model(results / cell.folder / "model.zip")
    with contextlib.closing(cell.make_eval_env()) as env:
        for actor in visiting_actors(model, cell):
            if actor not in known:
                yield actor, roll_out(model, cell, env, actor)


def _mix(cells: Sequence[Cell], results: Path) -> np.ndarray:
    """Equally many observations of each policy of a seed, those of the first arm that has it.

    Further arms of the same kind, such as variants, would outweigh the others.
    """
    seen: dict[str, np.ndarray] = {}
    for cell in cells:
        for actor, episodes in _episodes(cell, results, seen):
            observations = np.concatenate([episode.observations for episode in episodes])
            seen[actor] = observations[np.linspace(0, len(observations) - 1, COMMON_SHARE).astype(int)]
    return np.concatenate(list(seen.values()))


def _judge(cell: Cell) -> CuReSAC:
    """An untrained autoencoder with the networks of a seed's first cell."""
    arguments = cell.build_arguments()
    has_rae = arguments.get("srl", "rae") == "rae"
    with contextlib.closing(cell.make_eval_env()) as env:
        return ALGORITHMS[cell.algo](
            arguments["policy"],
            env,
            srl="rae",
            srl_kwargs=arguments.get("srl_kwargs", {}) if has_rae else {},
            curiosity=None,
            policy_kwargs=arguments.get("policy_kwargs", {}),
            buffer_size=1,
            seed=1000 + cell.seed,
        )


def fit_head(model: CuReSAC, observations: np.ndarray, updates: int) -> Iterator[int]:
    """Train encoder and autoencoder on given observations alone, without rewards and actions.

    :param model: A model with an autoencoder, which is trained further
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
        views = policy.augmentation(batch.observations)
        policy.encoder.update_statistics(views)
        loss = head.loss(batch._replace(views=views), policy.encoder(views)).loss
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        yield number


def observation_batch(observations: np.ndarray, device: th.device) -> Samples:
    """Samples with observations alone, which are all that an autoencoder reads.

    :param observations: Images in 0-255, [n, *shape]
    :param device: Device of the batch
    :return: The samples
    """
    return Samples(th.as_tensor(observations, device=device), None, None, None, None)  # type: ignore[arg-type]


def _rows(judge: CuReSAC, cell: Cell, results: Path) -> Iterator[Row]:
    """A common head's rows of ``visitation.csv``."""
    for actor, episodes in _episodes(cell, results):
        for number, episode in enumerate(episodes):
            errors = srl_errors(judge, observation_batch(episode.observations, judge.device))
            yield visit_row(actor, "common", number, errors, episode)
