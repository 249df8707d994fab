"""How well pretrained encoders tell the true state, by a linear probe, when they begin to learn the task.

    python -m benchmarks.pretrained_states fast/pretraining --out results

writes ``probe.csv`` beside the cells of a grid. The encoders of a seed are probed on the same episodes: of random
actions, and of sampled actions of the task policies that its arms end with, which reach states that random ones do not.
"""

import argparse
import contextlib
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path

from sb3_cure.envs import physics_state_names, physics_state_units
from sb3_cure.evaluation import Episode, run_episodes, state_probe
from sb3_cure.evaluation.result_files import Row, write_csv
from sb3_cure.experiments.cells import EVAL_SEED
from sb3_cure.experiments.grid import Cell, load_grid

#: Episodes of random actions, and of each final policy
EPISODES = 10
COLUMNS = ("task", "seed", "method", "episodes", "coordinate", "r2")


def probe_seed(cells: Sequence[Cell], results: Path) -> Iterator[Row]:
    """Probe the encoders of a seed's arms.

    :param cells: Its finished arms that were pretrained, of one task
    :param results: Folder of all results, with the ``pretrained.zip`` and ``model.zip`` of each cell
    :return: Rows of ``probe.csv``: R² of each coordinate of the true state
    """
    with contextlib.closing(cells[0].make_eval_env()) as env:

        def roll_out(cell: Cell, actor: str) -> list[Episode]:
            model = cell.load_model(results / cell.folder / "model.zip")
            return list(run_episodes(model, env, EPISODES, actor, deterministic=False, seed=EVAL_SEED, states=True))

        seen = {"random": roll_out(cells[0], "random"), "task": [e for c in cells for e in roll_out(c, "task")]}
        names, units = physics_state_names(env), physics_state_units(env)
    for cell in cells:
        model = cell.load_model(results / cell.folder / "pretrained.zip")
        for kind, episodes in seen.items():
            for name, r2 in state_probe(model, episodes, names, units).items():
                values = (cell.task, cell.seed, cell.method, kind, name, r2)
                yield dict(zip(COLUMNS, values, strict=True))


def main() -> None:
    """Probe the seeds of a grid of which all pretrained arms are finished and have kept their models."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("grid", help="grid file, or its name in zoo_configs/experiments")
    parser.add_argument("--methods", nargs="+", help="arms that are probed (default: all that were pretrained)")
    parser.add_argument("--out", type=Path, default=Path("results"), help="folder of all results")
    arguments = parser.parse_args()
    grid = load_grid(arguments.grid, methods=arguments.methods)
    seeds: dict[tuple[str, int], list[Cell]] = defaultdict(list)
    for cell in grid.cells:
        if cell.pretrain is not None:
            seeds[cell.task, cell.seed].append(cell)

    def is_ready(cell: Cell) -> bool:
        return cell.is_done(arguments.out) and (arguments.out / cell.folder / "pretrained.zip").exists()

    ready = [cells for cells in seeds.values() if all(map(is_ready, cells))]
    if not ready:
        parser.error(f"no seed of {arguments.grid} in {arguments.out} has all its arms with their pretrained.zip")
    rows = [row for cells in ready for row in probe_seed(cells, arguments.out)]
    write_csv(arguments.out / grid.experiment / "probe.csv", COLUMNS, rows)


if __name__ == "__main__":
    main()
