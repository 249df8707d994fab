"""Figures of the experiments. Each function takes numbers and writes one picture."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib

matplotlib.use("Agg")  # Files only: works without a screen.
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.ticker import EngFormatter

COLORS = {"random": "#888888", "task": "#1f77b4", "curious": "#d62728"}


def learning_curve(path: Path, rows: Sequence[Mapping[str, float]], random_return: float, title: str) -> None:
    """Return of both policies over environment steps, with the random policy as a line.

    :param path: File to write
    :param rows: Evaluations with ``environment_steps``, ``task_return`` and ``curious_return``
    :param random_return: Mean return of uniformly random actions
    :param title: Title of the figure
    """
    figure, axes = plt.subplots(figsize=(6, 4), layout="constrained")
    steps = [row["environment_steps"] for row in rows]
    for actor in ("task", "curious"):
        axes.plot(steps, [row[f"{actor}_return"] for row in rows], "o-", color=COLORS[actor], label=f"{actor} policy")
    axes.axhline(random_return, color=COLORS["random"], linestyle="--", label="random policy")
    axes.set(xlabel="environment steps", ylabel="return of an episode", title=title, ylim=(0, None))
    axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(path, dpi=150)
    plt.close(figure)


def srl_error_bars(path: Path, errors: Mapping[str, np.ndarray], title: str) -> None:
    """SRL error per step met by different policies: mean, with minimum and maximum as error bars (paper, Figure 2).

    :param path: File to write
    :param errors: Errors of all steps, by policy
    :param title: Title of the figure
    """
    figure, axes = plt.subplots(figsize=(4.5, 4), layout="constrained")
    for position, (actor, values) in enumerate(errors.items()):
        mean = values.mean()
        spread = [[mean - values.min()], [values.max() - mean]]
        axes.bar(position, mean, 0.6, yerr=spread, capsize=6, color=COLORS[actor], label=actor)
    axes.set_xticks(range(len(errors)), list(errors))
    axes.set(ylabel="SRL error per step (mean, min, max)", title=title, ylim=(0, None))
    axes.grid(axis="y", alpha=0.3)
    figure.savefig(path, dpi=150)
    plt.close(figure)


def reconstruction_grid(path: Path, strip: np.ndarray, title: str) -> None:
    """Observations (upper row) and their reconstructions (lower row).

    :param path: File to write
    :param strip: uint8 image (C, 2 * H, columns * W) as of ``sb3_cure.metrics.reconstruction_strip``
    :param title: Title of the figure
    """
    image = strip.transpose(1, 2, 0)
    height, width = image.shape[:2]
    figure, axes = plt.subplots(figsize=(10, 10 * height / width + 0.8), layout="constrained")
    axes.imshow(image.squeeze(), cmap="gray" if image.shape[2] == 1 else None, interpolation="nearest")
    axes.set_yticks([height * 0.25, height * 0.75], ["observed", "reconstructed"], rotation=90, va="center")
    axes.set_xticks([])
    axes.set_title(title)
    figure.savefig(path, dpi=120)
    plt.close(figure)


def update_modes(
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
    figure, grid = plt.subplots(len(heads), len(measures), figsize=size, layout="constrained", squeeze=False)
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
            axes.grid(alpha=0.3)
    for axes in grid.flat:
        axes.set_ylim(0, None)  # last: it stops the upper limit from following the curves
    grid[0, 0].legend()
    figure.savefig(path, dpi=120)
    plt.close(figure)
