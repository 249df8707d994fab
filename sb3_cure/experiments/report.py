"""Write one HTML file about all experiments in a folder, and their tables as Markdown.

    sb3-cure report results

Writes ``report.html`` (self-contained: pictures and videos are inside, no script, nothing is loaded from elsewhere) and
``summary.md`` into the folder, and ``table.md`` with the plots into the folder of each experiment, to be committed.
"""

import argparse
import io
import itertools
import math
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from PIL import Image

import sb3_cure
from sb3_cure.cli.usage import missing_file
from sb3_cure.evaluation import plots
from sb3_cure.experiments import statistics, tables
from sb3_cure.experiments.results import CellResult, Experiment, ResultsError, read_results
from sb3_cure.experiments.tables import (
    NONE,
    Table,
    interval_text,
    number_text,
    plural,
    ratio_text,
    render_text,
    tasks_text,
)
from sb3_cure.experiments.visit_statistics import HEADS, ErrorSummary, Measured, state_coverage, summarise_errors

THRESHOLDS = (250.0, 500.0, 750.0)
#: Optional files of a cell
MEDIA = ("task_policy.mp4", "curious_policy.mp4", "reconstructions.png", "uncomfortable.png", "curiosity_map.png")

#: Environment steps [n] and values [seeds, n]
Curves: TypeAlias = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Figure:
    """A plot, or a picture or video of a cell.

    :param name: Name of its file
    :param caption: What it shows, also for those who cannot see it
    :param content: The file: PNG or MP4
    """

    name: str
    caption: str
    content: bytes

    @property
    def size(self) -> tuple[int, int] | None:
        """Width and height of a picture; None of a video."""
        if self.name.endswith(".mp4"):
            return None
        with Image.open(io.BytesIO(self.content), formats=["PNG"]) as image:
            return image.size


Part: TypeAlias = Table | Figure


@dataclass(frozen=True)
class Section:
    """An experiment in the report: text and parts in reading order."""

    experiment: Experiment
    headlines: Sequence[str]
    parts: Sequence[Part]
    media: Sequence[tuple[CellResult, Sequence[Part]]] = ()

    @property
    def facts(self) -> str:
        return render_text("facts", self.experiment)

    @property
    def progress(self) -> str:
        return render_text("progress", self.experiment)

    @property
    def summary(self) -> str:
        """The first headline, for the overview."""
        more = len(self.headlines) - 1
        return (*self.headlines, NONE)[0] + (f" (And {plural(more, 'line')} more.)" if more > 0 else "")


def _figure(name: str, caption: str, draw: Callable[..., None], *arguments: Any) -> Figure:
    file = io.BytesIO()
    draw(file, *arguments)
    return Figure(f"{name}.png", caption, file.getvalue())


# Sections


def describe(experiment: Experiment, thresholds: Sequence[float], media: str = "none") -> Section:
    """Describe an experiment.

    :param experiment: An experiment
    :param thresholds: Returns, for the steps to reach them
    :param media: See ``media_of``
    :return: Its part of the report
    :raises ResultsError: if a file of it cannot be read
    """
    status = tables.status_table(experiment)
    if not experiment.finished:
        return Section(experiment, ["Not run: no cell is done."], [status])
    colors = plots.arm_colors(experiment.methods, experiment.baseline)
    headlines: list[str] = []
    parts: list[Part] = []
    if experiment.kind == "visitation":
        headlines, parts = _visitation(experiment)
    updates = np.concatenate([cell.curve("updates")[1] for cell in experiment.finished])
    if len(updates) and not updates.any():
        headlines.insert(0, render_text("untrained"))
    parts += curve_figures(experiment, colors)
    if explored := _stacked(experiment, "cells", at_least=1):
        parts.append(tables.cells_reached_table(experiment, explored))
        headlines += _exploration_headlines(experiment, list(explored))
    if experiment.kind != "visitation" and any(len(cell.curve()[0]) > 1 for cell in experiment.finished):
        compared, more = _comparison(experiment, colors, thresholds)
        # "Nothing to compare" is about returns alone
        headlines += compared if compared or headlines else [_why_no_comparison(experiment)]
        if experiment.kind == "pretraining":
            parts.insert(0, tables.pretraining_table(experiment))
        parts += more
    parts += [status, tables.conditions_table(experiment)]
    return Section(experiment, headlines, parts, list(media_of(experiment, media)))


def curve_figures(experiment: Experiment, colors: Mapping[str, str]) -> Iterator[Figure]:
    """Draw cells reached, return and SRL error of the policies over training.

    :param experiment: An experiment
    :param colors: By arm
    :return: Figures of those that were recorded
    """
    error = "error of the representation (SRL)\nof what the {} policy sees"
    for column, name, label, logarithmic in (
        ("cells", "cells_reached", "cells of the true state\nreached in training", False),
        ("return_mean", "learning_curves", "episode return\n(deterministic actions)", False),
        ("task_srl_error", "task_srl_error", error.format("task"), True),
        ("curious_srl_error", "curious_srl_error", error.format("curious"), True),
    ):
        if curves := _stacked(experiment, column):
            if "srl" in column:
                curves = _one_unit_each(experiment, curves)
            caption = render_text(name, list(curves))
            yield _figure(name, caption, plots.learning_curves, curves, colors, label, logarithmic)


def _stacked(experiment: Experiment, column: str, at_least: int = 2) -> dict[str, dict[str, Curves]]:
    """Curves by task and arm, where there are at least so many evaluations with a value in the column."""
    curves: dict[str, dict[str, Curves]] = {}
    for task, method in experiment.arms:
        steps, values = statistics.stack_curves(list(experiment.done(task, method).values()), column)
        if len(steps) >= at_least:
            curves.setdefault(task, {})[method] = steps, values
    return curves


def _one_unit_each(experiment: Experiment, curves: Mapping[str, Mapping[str, Curves]]) -> dict[str, dict[str, Curves]]:
    """Panels of errors of one unit each: those of different heads, and errors per pixel, differ in it."""
    panels: dict[str, dict[str, Curves]] = {}
    for task, arms in curves.items():
        units = {arm: _unit_of_errors(next(iter(experiment.done(task, arm).values()))) for arm in arms}
        for arm, found in arms.items():
            name = f"{task}, {units[arm]}" if len(set(units.values())) > 1 else task
            panels.setdefault(name, {})[arm] = found
    return panels


def _unit_of_errors(cell: CellResult) -> str:
    arguments = cell.config["arguments"]
    per_pixel = arguments.get("intrinsic_kwargs", {}).get("per_pixel")
    return f"{arguments.get('srl', 'rae')}{', per pixel' if per_pixel else ''}"


def _visitation(experiment: Experiment) -> tuple[list[str], list[Part]]:
    coverage, errors = state_coverage(experiment), summarise_errors(experiment)
    parts: list[Part] = []
    if coverage:
        caption, label = render_text("coverage_bars"), "occupied cells of the true state"
        parts.append(_figure("coverage", caption, plots.actor_bars, _bars(coverage), label))
        parts.append(tables.coverage_table(experiment, coverage))
    for head in HEADS:
        bars = _bars([row for row in errors if row.head == head])
        lines: dict[str, dict[str, float]] = {task: {} for task in bars}
        for task, values in lines.items():
            for other, label in (("zero", "always zero"), ("mean_image", "mean image")):
                if means := [row.mean for row in errors if (row.task, row.head) == (task, other)]:
                    values[label] = float(np.mean(means))
        if bars:
            caption = render_text("visitation_bars", head, {label for values in lines.values() for label in values})
            parts.append(_figure(f"visitation_{head}", caption, plots.visitation_bars, bars, lines))
    if errors:
        parts.append(tables.error_table(experiment, errors))
    measures: list[tuple[Measured, str]] = [(row, "as many cells of the true state space") for row in coverage]
    measures += [(row, f"the SRL error under the {row.head} head") for row in errors if row.head in HEADS]
    return list(_visitation_headlines(experiment, measures)), parts


def _bars(rows: Sequence[Measured]) -> dict[str, list[plots.Bar]]:
    """Bars by task."""
    panels: dict[str, list[plots.Bar]] = {}
    for row in rows:
        text = f"{number_text(row.ratio.value, 2)}\N{MULTIPLICATION SIGN}" if math.isfinite(row.ratio.value) else ""
        text += "" if row.ratio.low is None else f"\n{interval_text(row.ratio, 1)}"
        ends = (row.error_min, row.error_max) if isinstance(row, ErrorSummary) else None
        panels.setdefault(row.task, []).append((row.method, row.actor, ends, row.values, text))
    return panels


def _visitation_headlines(experiment: Experiment, measures: Sequence[tuple[Measured, str]]) -> Iterator[str]:
    """A sentence on each curious policy against the random policy, and one against the task policy."""
    for (task, method), other in itertools.product(experiment.arms, ("ratio", "task_ratio")):
        rows = [(row, what) for row, what in measures if (row.task, row.method, row.actor) == (task, method, "curious")]
        ratios = [(getattr(row, other), what) for row, what in rows]
        found = [(ratio_text(ratio), what, ratio.n) for ratio, what in ratios if math.isfinite(ratio.value)]
        if found:
            policy = "random policy" if other == "ratio" else f"task policy of {experiment.baseline_of(method)}"
            yield render_text("visits", method, task, policy, found)


def _exploration_headlines(experiment: Experiment, tasks: Sequence[str]) -> Iterator[str]:
    """A sentence on each arm: its cells over those of its baseline."""
    for task, method in itertools.product(tasks, experiment.methods):
        baseline, ratio = experiment.baseline_of(method), statistics.cells_ratio(experiment, task, method)
        if method != baseline and ratio.n:
            yield render_text("explores", method, task, baseline, ratio_text(ratio), ratio.n)


def _comparison(
    experiment: Experiment, colors: Mapping[str, str], thresholds: Sequence[float]
) -> tuple[list[str], list[Part]]:
    """Headlines and tables of returns."""
    differences = statistics.paired_differences(experiment)
    more = tables.reached_table(experiment, thresholds), tables.rewards_met_table(experiment)
    parts: list[Part] = [tables.curves_table(experiment), *(table for table in more if len(table.rows))]
    several = {row.method for row in differences if row.task is None}
    headlines = []
    for row in differences:
        if row.task is None or row.method not in several:
            digits = tables.difference_digits(row, experiment)
            value, interval = number_text(row.t.value, digits), interval_text(row.t, digits)
            headlines.append(render_text("difference", row, value, interval, tasks_text(row)))
    if differences:
        parts += _difference_parts(experiment, differences, colors)
    return headlines, parts


def _why_no_comparison(experiment: Experiment) -> str:
    several = len(experiment.methods) > 1
    return render_text("nothing_shared", experiment.baseline) if several else render_text("one_arm")


def _difference_parts(
    experiment: Experiment, differences: Sequence[statistics.PairedDifference], colors: Mapping[str, str]
) -> Iterator[Part]:
    lines = [
        (
            row.method,
            f"{tables.difference_label(row, experiment.baseline)}, {tasks_text(row)}",
            np.concatenate(list(row.differences.values())),
            (row.t.value, row.t.low, row.t.high),
        )
        for row in differences
    ]
    caption = render_text("paired_difference", tables.compared_with(differences, experiment))
    label = "mean return over training: difference from the baseline"
    yield _figure("paired_difference", caption, plots.paired_differences, lines, colors, label)
    yield tables.difference_table(experiment, differences)
    finals = statistics.paired_differences(experiment, "finals")
    yield tables.difference_table(experiment, finals, "final return", "As above.")


def media_of(experiment: Experiment, which: str) -> Iterator[tuple[CellResult, list[Part]]]:
    """Cells with their pictures and videos.

    :param experiment: An experiment
    :param which: ``"all"`` seeds, of each arm the ``"first"`` one that has some, or ``"none"``
    :return: Cells and what to show of them
    """
    for task, method in experiment.arms if which != "none" else ():
        for cell in experiment.done(task, method).values():
            if files := [cell.folder / name for name in MEDIA if (cell.folder / name).exists()]:
                yield cell, [Figure(path.name, render_text("media", path.name), path.read_bytes()) for path in files]
                if which == "first":
                    break


# Files


def write_report(
    results: Path, out: Path, thresholds: Sequence[float] = THRESHOLDS, media: str = "first"
) -> list[Path]:
    """Write the report of a folder.

    :param results: Folder of results
    :param out: HTML file
    :param thresholds: Returns, for the steps to reach them
    :param media: Of which seeds: ``"first"``, ``"all"`` or ``"none"``
    :return: The files that were written
    :raises ResultsError: with one sentence that names the file and what is wrong
    """
    sections = [describe(experiment, thresholds, media) for experiment in read_results(results)]
    facts = {"title": results.resolve().name, "sections": sections, "media": media}
    facts |= {"version": sb3_cure.__version__, "now": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")}
    texts = {
        out: tables.render("report.html.j2", **facts),
        results / "summary.md": tables.render("summary.md.j2", **facts),
    }
    files = {path: text.encode() for path, text in texts.items()}
    for section in sections:
        folder = section.experiment.folder
        text = tables.render("experiment.md.j2", section=section, level=1, plots_beside=True)
        files[folder / "table.md"] = text.encode()
        files |= {folder / part.name: part.content for part in section.parts if isinstance(part, Figure)}
    for path, content in files.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    return list(files)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command ``sb3-cure report``.

    :param argv: Command line, ``sys.argv`` by default
    :return: 0, 1 if the results cannot be read, or 2 if there are none
    """
    parser = argparse.ArgumentParser(
        prog="sb3-cure report", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("results", type=Path, help="folder that `sb3-cure experiment` wrote, or one experiment in it")
    parser.add_argument("--out", type=Path, help="HTML file (default: report.html in the folder)")
    returns_help = "returns for which the steps to reach them are shown (default: 250,500,750)"
    parser.add_argument("--thresholds", type=returns, default=THRESHOLDS, help=returns_help)
    media_help = "seeds with videos and pictures (default: of each arm the first that has some)"
    parser.add_argument("--media", choices=("first", "all", "none"), default="first", help=media_help)
    options = parser.parse_args(argv)
    if not options.results.is_dir():
        print(f"{parser.prog}: {missing_file(options.results)}", file=sys.stderr)
        return 2
    try:
        written = write_report(
            options.results, options.out or options.results / "report.html", options.thresholds, options.media
        )
    except ResultsError as error:
        print(f"sb3-cure report: {error}", file=sys.stderr)
        return 1
    size = written[0].stat().st_size / 2**20
    print(f"Wrote {written[0]} ({size:.1f} MB), and {len(written) - 1} tables and plots")
    return 0


def returns(text: str) -> list[float]:
    """Parse returns, separated by commas (argparse shows this function's name in errors).

    :param text: Such as ``"250,500"``
    :return: The returns
    """
    return [float(number) for number in text.split(",")]


if __name__ == "__main__":
    raise SystemExit(main())
