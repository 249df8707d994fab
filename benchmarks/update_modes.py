"""Sequential against joint updates on cartpole-swingup from pixels: paired seeds, SRL loss and return.

    python -m benchmarks.update_modes --out results/update_modes

Both arms of a seed start from the same weights and the same random warm-up. Each cell (head, mode, seed) is one CSV
file; a cell whose file exists is not run again, so that several processes can share the work (``--srl``, ``--seeds``).
At the end ``curves.png`` and ``table.md`` are drawn from all cells in the folder. Settings are the demo's, with the
paper's reward.
"""

import argparse
import csv
import json
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

import sb3_cure
from sb3_cure import CuReSAC, make_dmc_env, recipe
from sb3_cure.evaluation.callbacks import EvalBothCallback
from sb3_cure.evaluation.plots import in_style, save
from sb3_cure.evaluation.result_files import describe_run, write_csv
from sb3_cure.evaluation.rollouts import run_episodes
from sb3_cure.experiments.demo import DOMAIN, ENV_KWARGS, ID, TASK

MODES = ("sequential", "joint")
SETTINGS = recipe("fast/curl", ID) | dict(curiosity="separate", intrinsic="srl_error", curiosity_encoder_grad=False)
HEADS: dict[str, dict[str, Any]] = {
    "curl": {},
    # As in SAC-AE: no augmentation, and the burst of 1000 updates after the warm-up.
    "rae": dict(srl="rae", srl_kwargs={}, warmup_updates=None),
}
EVALUATIONS = 10
EPISODES = 3
#: The numbers of one arm: column of the CSV, its name, decimals
MEASURES = {
    "task_return": ("return", 0),
    "srl_loss": ("SRL loss", 5),
    "random_srl_error": ("SRL error, random policy", 5),
}

Rows = list[dict[str, float]]


class RecordCurve(EvalBothCallback):
    """Evaluates both policies and keeps the rows of the learning curve."""

    def __init__(self, *args: Any, action_repeat: int, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.action_repeat = action_repeat
        self.rows: list[dict[str, float]] = []
        self.start = time.monotonic()

    def evaluate(self) -> dict[str, float]:
        row = super().evaluate()
        self.rows.append(
            {
                "agent_steps": self.num_timesteps,
                "environment_steps": self.num_timesteps * self.action_repeat,
                "seconds": round(time.monotonic() - self.start, 1),
                "task_return": row["eval/task_reward"],
                "curious_return": row["eval/curious_reward"],
                "task_srl_error": row["eval/task_srl_error"],
                "curious_srl_error": row["eval/curious_srl_error"],
            }
        )
        return row


class RecordUpdates(RecordCurve):
    """That curve, with the training loss of the head and its error on frames that no arm chose.

    ``srl_loss`` is the mean over the updates since the row before (nan if there were none); ``random_srl_error`` the
    noise-free error on episodes of the random policy, the same ones for all arms and seeds.
    """

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self._losses: list[th.Tensor] = []

    def _on_step(self) -> bool:
        loss = self.logger.name_to_value.get("train/srl_loss")
        if loss is not None:
            self._losses.append(th.as_tensor(loss))
        return super()._on_step()

    def evaluate(self) -> dict[str, float]:
        row = super().evaluate()
        episodes = run_episodes(self.model, self.eval_env, EPISODES, "random", seed=50_000)  # type: ignore[arg-type]
        self.rows[-1]["srl_loss"] = float(th.stack(self._losses).mean()) if self._losses else float("nan")
        self.rows[-1]["random_srl_error"] = float(np.concatenate([episode.srl_errors for episode in episodes]).mean())
        self._losses.clear()
        return row


def settings_of(srl: str, steps: int) -> dict[str, Any]:
    """Settings of an arm.

    :param srl: A key of ``HEADS``
    :param steps: Agent steps of each cell
    :return: What all cells of a head have in common
    """
    return {
        "task": f"{DOMAIN}-{TASK}",
        "environment": ENV_KWARGS,
        "agent_steps": steps,
        "arguments": {**SETTINGS, **HEADS[srl]},
        "version": sb3_cure.__version__,
    }


def run_cell(path: Path, srl: str, update: str, seed: int, steps: int) -> None:
    """Train one arm with one seed.

    :param path: CSV file to write, once all is measured
    :param srl: A key of ``HEADS``
    :param update: ``"sequential"`` or ``"joint"``
    :param seed: Seed of weights, warm-up and environment
    :param steps: Agent steps
    """
    env = make_dmc_env(DOMAIN, TASK, seed=seed, **ENV_KWARGS)
    model = CuReSAC("CnnPolicy", env, seed=seed, **{**SETTINGS, **HEADS[srl], "update": update})
    curve = RecordUpdates(
        make_dmc_env(DOMAIN, TASK, **ENV_KWARGS),
        max(steps // EVALUATIONS, 1),
        n_episodes=EPISODES,
        seed=10_000,
        action_repeat=env.get_wrapper_attr("action_repeat"),
    )
    model.learn(steps, callback=curve)
    path.with_suffix(".json").write_text(json.dumps({"seed": seed, **describe_run()}, indent=2) + "\n")
    write_csv(path, list(curve.rows[0]), curve.rows)


def read_cells(folder: Path) -> dict[tuple[str, str], dict[int, Rows]]:
    """Read the curves of all cells.

    :param folder: Where the cells lie
    :return: Rows by (head, mode), by seed
    """
    cells: dict[tuple[str, str], dict[int, Rows]] = {}
    for srl in HEADS:
        for mode in MODES:
            for path in sorted((folder / srl / mode).glob("seed*.csv")):
                with path.open(newline="") as file:
                    rows = [{key: float(value) for key, value in row.items()} for row in csv.DictReader(file)]
                cells.setdefault((srl, mode), {})[int(path.stem.removeprefix("seed"))] = rows
    return cells


def summarise(cells: Mapping[tuple[str, str], Mapping[int, Rows]]) -> list[str]:
    """Means of the last third of each run, arm beside arm, seed by seed.

    :param cells: Result of ``read_cells``
    :return: Lines of a Markdown table
    """
    names = [name for name, _ in MEASURES.values()]
    lines = [
        "| head | seed | " + " | ".join(f"{name}, {mode}" for name in names for mode in MODES) + " |",
        "|---|---|" + "---|" * len(names) * len(MODES),
    ]
    for srl in HEADS:
        arms = [cells.get((srl, mode), {}) for mode in MODES]
        seeds = sorted(set(arms[0]) & set(arms[1]))
        values = {seed: [_late_mean(arm[seed], column) for column in MEASURES for arm in arms] for seed in seeds}
        if len(seeds) > 1:
            values["mean"] = list(np.mean(list(values.values()), axis=0))  # type: ignore[index]
        digits = [decimals for _, decimals in MEASURES.values() for _ in MODES]
        for name, row in values.items():
            shown = " | ".join(f"{value:.{digit}f}" for value, digit in zip(row, digits, strict=True))
            lines.append(f"| {srl} | {name} | {shown} |")
    return lines


def compare_policies(cells: Mapping[tuple[str, str], Mapping[int, Rows]]) -> list[str]:
    """SRL error of the trained policies over the random policy's (last third, mean over seeds), and the time taken.

    :param cells: Result of ``read_cells``
    :return: Lines of a Markdown table
    """
    lines = [
        "| head | mode | error, curious / random | task / random | evaluations with curious > random | seconds |",
        "|---|---|---|---|---|---|",
    ]
    for (srl, mode), runs in cells.items():
        errors = {
            actor: np.array([_late_mean(rows, f"{actor}_srl_error") for rows in runs.values()])
            for actor in ("curious", "task", "random")
        }
        ratios = [np.mean(errors[actor] / errors["random"]) for actor in ("curious", "task")]
        above = [row["curious_srl_error"] > row["random_srl_error"] for rows in runs.values() for row in rows]
        seconds = np.mean([rows[-1]["seconds"] for rows in runs.values()])
        shown = " | ".join(f"{ratio:.2f}" for ratio in ratios)
        lines.append(f"| {srl} | {mode} | {shown} | {sum(above)} of {len(above)} | {seconds:.0f} |")
    return lines


@in_style
def draw_curves(
    path: Path,
    cells: Mapping[tuple[str, str], Mapping[int, Sequence[Mapping[str, float]]]],
    measures: Mapping[str, str],
) -> None:
    """Curves of both update modes: one row per head, one column per measure; thin lines are seeds, thick ones means.

    :param path: File to write
    :param cells: Rows by (head, mode), by seed
    :param measures: Column of the rows -> label of the axis
    """
    heads = list(dict.fromkeys(head for head, _ in cells))
    size = (4 * len(measures), 3.2 * len(heads))
    figure = Figure(figsize=size)
    grid = figure.subplots(len(heads), len(measures), squeeze=False)
    colors = {"sequential": "#1f77b4", "joint": "#ff7f0e"}
    for (head, mode), seeds in cells.items():
        for axes, (column, label) in zip(grid[heads.index(head)], measures.items(), strict=True):
            for rows in seeds.values():
                steps = [row["environment_steps"] for row in rows]
                axes.plot(steps, [row[column] for row in rows], color=colors[mode], alpha=0.3, linewidth=0.8)
            mean = np.mean([[row[column] for row in rows] for rows in seeds.values()], axis=0)
            axes.plot(steps, mean, color=colors[mode], linewidth=2, label=f"{mode} (n={len(seeds)})")
            axes.set(xlabel="environment steps", ylabel=label, title=head)
            axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    for axes in grid.flat:
        axes.set_ylim(0, None)  # last: it stops the upper limit from following the curves
    grid[0, 0].legend()
    save(figure, path, 120)


def _late_mean(rows: Rows, column: str) -> float:
    return float(np.mean([row[column] for row in rows[-max(len(rows) // 3, 1) :]]))


def _numbers(text: str) -> list[int]:
    return [int(number) for number in text.split(",")]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the cells that are missing, then draw all.

    :param arguments: Command line, ``sys.argv`` by default
    :return: 0
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("update_modes"), help="folder (default: update_modes)")
    parser.add_argument("--srl", choices=sorted(HEADS), help="one head only (default: both)")
    parser.add_argument("--seeds", type=_numbers, default=[0, 1, 2], help="for example 0,1,2 (the default)")
    parser.add_argument("--steps", type=int, default=8000, help="agent steps of each cell (environment steps / 8)")
    options = parser.parse_args(arguments)
    if options.steps < EVALUATIONS:
        parser.error(f"--steps is {options.steps}, but the curve has {EVALUATIONS} points: give at least as many steps")
    heads: Iterable[str] = [options.srl] if options.srl else HEADS
    for srl in heads:
        settings = json.dumps(settings_of(srl, options.steps), indent=2) + "\n"
        path = options.out / srl / "settings.json"
        if path.exists() and path.read_text() != settings:
            parser.error(
                f"the cells of {path.parent} were run with other settings (see {path.name}), so that further ones "
                "would not compare: choose another --out, or the --steps they were run with"
            )
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(settings)
        for seed in options.seeds:
            for mode in MODES:
                path = options.out / srl / mode / f"seed{seed}.csv"
                if not path.exists():
                    print(f"{srl}, {mode}, seed {seed}: {options.steps} agent steps", flush=True)
                    run_cell(path, srl, mode, seed, options.steps)
    cells = read_cells(options.out)
    draw_curves(options.out / "curves.png", cells, {column: name for column, (name, _) in MEASURES.items()})
    table = [*summarise(cells), "", *compare_policies(cells)]
    (options.out / "table.md").write_text("\n".join(table) + "\n")
    print("\n".join(table))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
