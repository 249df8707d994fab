"""Summaries of ``time_to_return.py``: censored times, tables and the picture."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from scipy import stats

from benchmarks.peers import is_trial, trial_arms
from sb3_cure.cli.usage import UsageError
from sb3_cure.evaluation.plots import arm_colors, in_style, save
from sb3_cure.evaluation.result_files import Row, read_rows, write_csv, write_text
from sb3_cure.experiments.grid import read_json
from sb3_cure.experiments.statistics import area_under_curve
from sb3_cure.experiments.tables import NONE, Table, mean_std_text

#: The arm that the others are compared with
OURS = "best"
#: What arms are called in the picture
NAMES = {
    "best": "fast/best (ours)",
    "public_curl": "CURL's code",
    "public_curl_own": "CURL's code as it is",
    "drqv2": "DrQ-v2's code",
    "drqv2_own": "DrQ-v2's code as it is",
}
TRIAL_TASK, TRIAL_SEEDS = "cartpole-swingup", (0,)
TARGETS = (300, 500, 700)
#: Minutes after which returns are shown
TIMES = (5, 10, 15)
COLUMNS = ("agent_steps", "environment_steps", "training_seconds", "return_mean", "return_std", "episodes", "limit")
SUMMARY_COLUMNS = ("task", "arm", "target", "seeds", "reached", "median_minutes", "p_value", "minutes")
#: Of the JSON files: conditions that the table names
CONDITIONS = ("minutes", "budget", "eval_every", "eval_episodes", "machine", "commit")


@dataclass(frozen=True)
class Run:
    """One finished cell.

    :param rows: Of its CSV file
    :param details: Its JSON file
    """

    rows: list[Row]
    details: dict[str, Any]

    @property
    def limit(self) -> float:
        """Limit in minutes of training."""
        return self.details["minutes"]

    @property
    def minutes(self) -> np.ndarray:
        """Minutes of training at each evaluation; the last one may come a step after the limit."""
        return np.minimum([row["training_seconds"] / 60 for row in self.rows], self.limit)

    @property
    def returns(self) -> np.ndarray:
        """Mean return of each evaluation."""
        return np.array([row["return_mean"] for row in self.rows])

    @property
    def mean_over_time(self) -> float:
        """Mean return over the minutes from 0 to the limit; the last evaluation holds where steps ended it before."""
        minutes, returns = [0, *self.minutes, self.limit], [self.returns[0], *self.returns, self.returns[-1]]
        return area_under_curve(np.array(minutes), np.array(returns))

    def minutes_to(self, target: float) -> float | None:
        """Find when a return is reached.

        :param target: A return
        :return: Minutes of training until the first evaluation that reaches it; None: not within the limits
        """
        reached = self.minutes[self.returns >= target]
        return float(reached[0]) if len(reached) else None

    def return_after(self, minutes: float) -> float:
        """Find the return of the last evaluation until then.

        :param minutes: Minutes of training
        :return: Its mean; nan beyond the limit
        """
        return float(self.returns[self.minutes <= minutes][-1]) if minutes <= self.limit else float("nan")

    def time_text(self, target: float) -> str:
        """Format the minutes until a return is reached, or else the limit that ended training."""
        minutes = self.minutes_to(target)
        return f">{self.minutes[-1]:.1f} ({self.details['stopped_by']})" if minutes is None else f"{minutes:.1f}"


#: Runs by seed, those by arm, and those by task
Seeds = dict[int, Run]
Runs = dict[str, dict[str, Seeds]]


def read_runs(out: Path) -> Runs:
    """Read the finished cells.

    :param out: Folder of all results
    :return: Runs by task, arm and seed
    :raises UsageError: if they come from several kinds of machine
    """
    runs: Runs = {}
    machines: dict[str, Path] = {}
    for path in sorted(out.glob("*/*/seed*.json")):
        details, (task, arm) = read_json(path), path.parts[-3:-1]
        run = Run(read_rows(path.with_suffix(".csv")), details)
        runs.setdefault(task, {}).setdefault(arm, {})[details["seed"]] = run
        machines[details["machine"]] = path
    if len(machines) > 1:
        raise UsageError(f"{out} mixes minutes of several machines, as in {' and '.join(map(str, machines.values()))}.")
    return runs


def best_trial(out: Path, peer: str) -> str:
    """Choose a peer's settings.

    :param out: Folder of all results
    :param peer: A key of ``PEERS``
    :return: The trial with the highest mean return over the minutes of training
    :raises UsageError: if a trial is missing
    """
    runs = read_runs(out).get(TRIAL_TASK, {})
    trials = {arm: [runs.get(arm, {}).get(seed) for seed in TRIAL_SEEDS] for arm in trial_arms(peer)}
    if missing := [arm for arm, seeds in trials.items() if None in seeds]:
        raise UsageError(
            f"{peer} is the best of its trials, of which {', '.join(missing)} are missing: run these first on "
            f"{TRIAL_TASK} with seeds {' '.join(map(str, TRIAL_SEEDS))}."
        )
    return max(trials, key=lambda arm: np.mean([run.mean_over_time for run in trials[arm] if run]))


def times_to(seeds: Seeds, target: float) -> stats.CensoredData:
    """Collect the minutes until a return is reached.

    :param seeds: Runs of an arm
    :param target: A return
    :return: Times by seed, censored at the limit of minutes where it is not reached
    """
    minutes = [run.minutes_to(target) for run in seeds.values()]
    times = [run.limit if each is None else each for run, each in zip(seeds.values(), minutes, strict=True)]
    return stats.CensoredData.right_censored(times, [each is None for each in minutes])


def median_time(data: stats.CensoredData) -> float | None:
    """Estimate when half of the seeds have reached a return, by Kaplan and Meier's curve.

    :param data: From ``times_to``
    :return: Minutes; None if fewer than half reach it
    """
    curve = stats.ecdf(data).sf
    reached = curve.quantiles[curve.probabilities <= 0.5 + 1e-9]
    return float(reached[0]) if len(reached) else None


def compare(ours: stats.CensoredData, theirs: stats.CensoredData) -> float:
    """Test whether two arms differ in the times until they reach a return.

    :param ours: From ``times_to``
    :param theirs: Those of another arm
    :return: p value of a log-rank test; 1 if no seed of either reaches it
    """
    if ours.num_censored() == len(ours) and theirs.num_censored() == len(theirs):
        return 1.0
    return float(stats.logrank(ours, theirs).pvalue)


def summarise(runs: Runs) -> list[Row]:
    """Summarise each arm on each task.

    :param runs: Result of ``read_runs``
    :return: Rows of ``summary.csv``
    """
    rows = []
    for task, arms in runs.items():
        for arm, seeds in arms.items():
            for target in TARGETS:
                data = times_to(seeds, target)
                median, compares = median_time(data), OURS in arms and arm != OURS and not is_trial(arm)
                values = (
                    *(task, arm, target, len(data), len(data) - data.num_censored()),
                    "not reached" if median is None else round(median, 2),
                    float(f"{compare(times_to(arms[OURS], target), data):.2g}") if compares else "",
                    "; ".join(f"seed {seed}: {run.time_text(target)}" for seed, run in seeds.items()),
                )
                rows.append(dict(zip(SUMMARY_COLUMNS, values, strict=True)))
    return rows


def tables(runs: Runs) -> str:
    """Write the tables.

    :param runs: Result of ``read_runs``
    :return: Medians and returns by arm, trials, minutes of each seed, and conditions, in Markdown
    """
    rows = summarise(runs)
    arms = [(task, arm, seeds) for task in runs for arm, seeds in runs[task].items()]
    by_arm = [_arm_row(rows, *each) for each in arms if not is_trial(each[1])]
    trials = [
        [arm, _seeds_text(seeds), f"{np.mean([run.mean_over_time for run in seeds.values()]):.1f}"]
        for _, arm, seeds in arms
        if is_trial(arm)
    ]
    by_seed = [[row["task"], row["arm"], str(row["target"]), row["minutes"]] for row in rows]
    columns = ["task", "arm", "seeds", *(f">{target}" for target in TARGETS)]
    columns += [*(f">after {minutes} min" for minutes in TIMES), ">ms per agent step", ">CPU minutes", ">wall minutes"]
    note = (
        "Median over seeds of the CPU minutes of training until the return is reached, how many seeds reach it, and "
        f"the p value of a log-rank test against {OURS}. Then mean and deviation over seeds of the return after so "
        "many minutes, and the times of training, means over seeds: of an agent step (warm-up included), and of all."
    )
    details = [run.details for *_, seeds in arms for run in seeds.values()]
    conditions = [f"{key}: {', '.join(sorted({str(each[key]) for each in details}))}" for key in CONDITIONS]
    chosen = "The best of each peer's has the peer's name in the other tables."
    parts = [
        Table("Minutes to a return", pd.DataFrame(by_arm, columns=columns), note),
        Table("Trials", pd.DataFrame(trials, columns=["arm", "seeds", ">mean return over the minutes"]), chosen),
        Table("Each seed", pd.DataFrame(by_seed, columns=["task", "arm", ">return", "minutes"]), "; ".join(conditions)),
    ]
    head = "# Time to a return\n\n![Return over minutes of training](time_to_return.png)\n"
    return "\n".join((head, *(each.markdown() for each in parts if len(each.rows))))


def _arm_row(rows: Sequence[Row], task: str, arm: str, seeds: Seeds) -> list[str]:
    """Texts of an arm in the first table."""
    texts = [_median_text(row) for row in rows if (row["task"], row["arm"]) == (task, arm)]
    for minutes in TIMES:
        returns = np.array([run.return_after(minutes) for run in seeds.values()])
        texts.append(NONE if np.isnan(returns).any() else mean_std_text(returns))
    steps, cpu, wall = np.mean(
        [
            (run.rows[-1]["agent_steps"], run.details["training_seconds"], run.details["training_wall_seconds"])
            for run in seeds.values()
        ],
        axis=0,
    )
    return [task, arm, _seeds_text(seeds), *texts, f"{1e3 * cpu / steps:.0f}", f"{cpu / 60:.1f}", f"{wall / 60:.1f}"]


def _seeds_text(seeds: Seeds) -> str:
    return ", ".join(map(str, seeds))


def _median_text(row: Row) -> str:
    text = f"{row['median_minutes']} ({row['reached']} of {row['seeds']})"
    return text if row["p_value"] == "" else f"{text}, p {row['p_value']:.2g}"


@in_style
def draw(path: Path, runs: Runs) -> None:
    """Draw the return over minutes of training: thin lines are seeds, thick ones their mean while all of them train.

    :param path: File to write
    :param runs: Result of ``read_runs``
    """
    figure = Figure(figsize=(1 + 5 * len(runs), 4.8))
    shown = {task: {arm: seeds for arm, seeds in arms.items() if not is_trial(arm)} for task, arms in runs.items()}
    colors = arm_colors(list(dict.fromkeys(arm for arms in shown.values() for arm in arms)), OURS)
    handles = {}
    for axes, (task, arms) in zip(figure.subplots(1, len(runs), squeeze=False).flat, shown.items(), strict=True):
        for arm, seeds in arms.items():
            for run in seeds.values():
                axes.plot(run.minutes, run.returns, color=colors[arm], alpha=0.35, linewidth=0.7)
            first, last = max(run.minutes[0] for run in seeds.values()), min(run.minutes[-1] for run in seeds.values())
            grid = np.linspace(first, last, 400)
            mean = np.mean([np.interp(grid, run.minutes, run.returns) for run in seeds.values()], axis=0)
            (handles[NAMES.get(arm, arm)],) = axes.plot(grid, mean, color=colors[arm], linewidth=2.4)
        for target in TARGETS:
            axes.axhline(target, color="#333333", linestyle="--", linewidth=0.9, alpha=0.7, zorder=1)
        labels = {"xlabel": "CPU minutes of training", "ylabel": "return of ten episodes (higher: better)"}
        axes.set(title=f"{task}, one thread", **labels, xlim=(0, None), ylim=(0, None))
    marks = "thin lines: seeds; thick ones: their means; dashed: the returns of the table"
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=min(len(handles), 3), title=marks)
    save(figure, path, 120)


def write_summary(out: Path, runs: Runs) -> str:
    """Write ``summary.csv``, ``table.md`` and ``time_to_return.png``.

    :param out: Folder of all results
    :param runs: Result of ``read_runs``
    :return: The tables
    """
    text = tables(runs)
    write_csv(out / "summary.csv", SUMMARY_COLUMNS, summarise(runs))
    write_text(out / "table.md", text)
    draw(out / "time_to_return.png", runs)
    return text
