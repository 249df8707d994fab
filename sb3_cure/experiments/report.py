"""Write one HTML file about all experiments in a folder, and their tables as Markdown.

    sb3-cure report results

Writes ``report.html`` (self-contained: pictures and videos are inside, no script, nothing is loaded from elsewhere) and
``summary.md`` into the folder, and ``table.md`` with the plots into the folder of each experiment, to be committed.
"""

import argparse
import io
import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from PIL import Image

import sb3_cure
from sb3_cure.cli.usage import UsageError, missing_file
from sb3_cure.evaluation import plots
from sb3_cure.experiments import statistics, tables
from sb3_cure.experiments.results import CellResult, Experiment, read_results
from sb3_cure.experiments.statistics import Curves
from sb3_cure.experiments.tables import (
    NONE,
    Table,
    interval_text,
    number_text,
    plural,
    render_text,
    value_and_interval,
)
from sb3_cure.experiments.visit_statistics import HEADS, ErrorSummary, Measured, state_coverage, summarise_errors

THRESHOLDS = (250.0, 500.0, 750.0)
#: Optional files of a cell
MEDIA = ("task_policy.mp4", "curious_policy.mp4", "reconstructions.png", "uncomfortable.png", "curiosity_map.png")
_ERROR = "state representation (SRL) error\nthat the {} policy meets\n({})".format
#: Columns of evaluations, files of their pictures, names in tables and labels of axes
_CURVES = (
    ("cells", "cells_reached", "cells", "cells of the true state\nreached in training\n(more: explores wider)"),
    ("return_mean", "learning_curves", "return", "episode return,\ndeterministic actions\n(higher: better)"),
    ("task_srl_error", "task_srl_error", "SRL error, task policy", _ERROR("task", "lower: better")),
    (
        "curious_srl_error",
        "curious_srl_error",
        "SRL error, curious policy",
        _ERROR("curious", "higher: represented worse"),
    ),
)
#: Least number of visible evaluations for which lines are drawn; a table shows fewer
LEAST_POINTS = 4


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
        environments: dict[str, dict[str, None]] = {}
        for cell in self.experiment.finished:
            kwargs = ", ".join(f"{name} {value}" for name, value in sorted(cell.config["env_kwargs"].items()))
            environments.setdefault(kwargs or "as registered", {})[cell.task] = None
        return render_text("facts", self.experiment, self.progress, environments)

    @property
    def progress(self) -> str:
        return f"{len(self.experiment.finished)} of {len(self.experiment.cells)}"

    @property
    def summary(self) -> str:
        """The first headline, for the overview."""
        first, *others = self.headlines or [NONE]
        return first + (f" (And {plural(len(others), 'line')} more.)" if others else "")


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
    """
    status = tables.status_table(experiment)
    if not experiment.finished:
        return Section(experiment, ["Not run: no cell is done."], [status])
    colors = plots.arm_colors(experiment.methods, experiment.baseline)
    headlines: list[str] = []
    parts: list[Part] = []
    if experiment.kind == "visitation":
        headlines, parts = _visitation(experiment)
    parts += curve_parts(experiment, colors)
    headlines += _exploration_headlines(experiment)
    if experiment.kind != "visitation" and any(len(cell.curve()[0]) > 1 for cell in experiment.finished):
        compared, more = _comparison(experiment, colors, thresholds)
        headlines += compared
        if not headlines:  # no cells that could be compared either
            several = len(experiment.methods) > 1
            headlines = [render_text("nothing_shared", experiment.baseline) if several else render_text("one_arm")]
        parts += more
    if untrained := [f"{arm} on {task}" for task, arm in experiment.arms if _is_untrained(experiment, task, arm)]:
        place = 0 if len(untrained) == len(experiment.arms) else len(headlines)
        headlines.insert(place, render_text("untrained", untrained))
    parts += [status, tables.conditions_table(experiment)]
    return Section(experiment, headlines, parts, list(media_of(experiment, media)))


def _is_untrained(experiment: Experiment, task: str, method: str) -> bool:
    updates = [cell.curve("updates")[1] for cell in experiment.finished_cells(task, method).values()]
    return any(len(each) for each in updates) and not any(each.any() for each in updates)


def curve_parts(experiment: Experiment, colors: Mapping[str, str]) -> Iterator[Part]:
    """Show cells reached, return and SRL error of the policies over training.

    :param experiment: An experiment
    :param colors: By arm
    :return: Figures of those that were recorded, and a table of those with few evaluations
    """
    few = {}
    for column, name, measure, label in _CURVES:
        curves, is_error = statistics.stack_curves(experiment, column), "srl" in column
        if is_error:
            curves = _one_unit_each(experiment, curves)
        means = [values.mean(axis=0) for arms in curves.values() for _, values in arms.values()]
        # A logarithmic axis has no place for zeros, which contrastive errors begin with
        visible = [(mean > 0).sum() if is_error else len(mean) for mean in means]
        is_drawn = max(visible, default=0) >= LEAST_POINTS
        if is_drawn:
            caption = render_text(name, list(curves))
            yield _figure(name, caption, plots.learning_curves, curves, colors, label, is_error)
        if curves and column == "cells":  # which have a table in any case
            yield tables.measured_table("Cells of the true state", {measure: curves}, render_text("cells_counted"))
        elif curves and not is_drawn:
            few[measure] = curves
    if few:
        yield tables.measured_table("Evaluations", few, render_text("evaluations"))


def _one_unit_each(experiment: Experiment, curves: Curves) -> Curves:
    """Split panels of errors so that each has one unit."""
    panels: Curves = {}
    for task, arms in curves.items():
        names = _panels_of_errors(experiment, task, arms)
        for arm, found in arms.items():
            panels.setdefault(names[arm], {})[arm] = found
    return panels


def _panels_of_errors(experiment: Experiment, task: str, arms: Iterable[str]) -> dict[str, str]:
    """Titles by arm: errors of different heads, and errors per pixel, differ in their unit, and share no axis."""
    units = {arm: statistics.unit_of_errors(experiment, task, arm) for arm in arms}
    return {arm: f"{task}, {unit}" if len(set(units.values())) > 1 else task for arm, unit in units.items()}


def _visitation(experiment: Experiment) -> tuple[list[str], list[Part]]:
    coverage, errors = state_coverage(experiment), summarise_errors(experiment)
    parts: list[Part] = []
    if coverage:
        bars, lines = _bars(coverage)
        if bars:
            label = "occupied cells of the true state\n(more: goes wider; \N{MULTIPLICATION SIGN}: times random)"
            parts.append(_figure("coverage", render_text("coverage_bars"), plots.actor_bars, bars, label, lines))
        parts.append(tables.coverage_table(experiment, coverage))
    parts += [*_error_figure(list(_by_unit(experiment, errors)), "own"), *_error_figure(errors, "common")]
    if errors:
        parts.append(tables.error_table(experiment, errors))
    measures: list[tuple[Measured, str]] = [(row, "as many cells of the true state space") for row in coverage]
    measures += [(row, f"the SRL error under the {row.head} head") for row in errors if row.head in HEADS]
    return list(_visitation_headlines(experiment, measures)), parts


def _by_unit(experiment: Experiment, errors: Sequence[ErrorSummary]) -> Iterator[ErrorSummary]:
    """Errors under own heads, with a panel of one unit as their task, and yardsticks where they have that unit."""
    for task in experiment.tasks:
        of_task = [row for row in errors if row.task == task]
        titles = _panels_of_errors(experiment, task, [row.method for row in of_task if row.head == "own"])
        for row in of_task:
            unit = statistics.unit_of_errors(experiment, task, row.method)
            if row.method in titles and (row.head == "own" or unit == "rae"):
                yield replace(row, task=titles[row.method])


def _error_figure(errors: Sequence[ErrorSummary], head: str) -> Iterator[Figure]:
    bars, lines = _bars([row for row in errors if row.head == head], shares_random=head != "own")
    for task, values in lines.items():
        for other, label in (("zero", "always drawing grey"), ("mean_image", "always drawing the mean image")):
            if means := [row.mean for row in errors if (row.task, row.head) == (task, other)]:
                values[label] = float(np.mean(means))
    if bars:
        caption = render_text("visitation_bars", head, {label for values in lines.values() for label in values})
        yield _figure(f"visitation_{head}", caption, plots.visitation_bars, bars, lines)


def _bars(
    rows: Sequence[Measured], shares_random: bool = True
) -> tuple[dict[str, list[plots.Bar]], dict[str, dict[str, np.ndarray | float]]]:
    """Bars by task, and values to compare with: the random policy's, if they are the same for all arms."""
    bars: dict[str, list[plots.Bar]] = {}
    lines: dict[str, dict[str, Any]] = {}
    for row in rows:
        compared = lines.setdefault(row.task, {})
        if row.actor == "random" and shares_random:
            compared["random"] = max(compared.get("random", row.values), row.values, key=len)  # of most seeds
            continue
        text = f"{number_text(row.ratio.value, 2)}\N{MULTIPLICATION SIGN}" if math.isfinite(row.ratio.value) else ""
        text += "" if row.ratio.low is None else f"\n{interval_text(row.ratio, 1)}"
        ends = (row.error_min, row.error_max) if isinstance(row, ErrorSummary) else None
        bars.setdefault(row.task, []).append(plots.Bar(row.method, row.actor, row.values, text, ends))
    return bars, lines


def _visitation_headlines(experiment: Experiment, measures: Sequence[tuple[Measured, str]]) -> Iterator[str]:
    """A sentence on each curious policy against the random policy, and one against the task policy."""
    for (task, method), other in itertools.product(experiment.arms, ("ratio", "task_ratio")):
        rows = [(row, what) for row, what in measures if (row.task, row.method, row.actor) == (task, method, "curious")]
        ratios = [(getattr(row, other), what) for row, what in rows]
        found = [(value_and_interval(ratio), what, ratio.n) for ratio, what in ratios if math.isfinite(ratio.value)]
        if found:
            policy = "random policy" if other == "ratio" else f"task policy of {experiment.baseline_of(method)}"
            yield render_text("visits", method, task, policy, found)


def _exploration_headlines(experiment: Experiment) -> Iterator[str]:
    """A sentence on each arm: its cells over those of its baseline."""
    for task, method in experiment.arms:
        baseline, ratio = experiment.baseline_of(method), statistics.cells_ratio(experiment, task, method)
        if method != baseline and ratio.n:
            yield render_text("explores", method, task, baseline, value_and_interval(ratio), ratio.n)


def _comparison(
    experiment: Experiment, colors: Mapping[str, str], thresholds: Sequence[float]
) -> tuple[list[str], list[Part]]:
    """Headlines and tables of returns."""
    differences = statistics.paired_differences(experiment)
    more = tables.reached_table(experiment, thresholds), tables.rewards_met_table(experiment)
    parts: list[Part] = [tables.curves_table(experiment), *(table for table in more if len(table.rows))]
    headlines = []
    for row in differences:
        digits = tables.difference_digits(row, experiment)
        value, interval = number_text(row.t.value, digits), interval_text(row.t, digits)
        headlines.append(render_text("difference", row, value, interval))
    if differences:
        parts += _difference_parts(experiment, differences, colors)
    return headlines, parts


def _difference_parts(
    experiment: Experiment, differences: Sequence[statistics.PairedDifference], colors: Mapping[str, str]
) -> Iterator[Part]:
    lines = [
        plots.Difference(
            row.method,
            f"{tables.difference_label(row, experiment.baseline)}, {row.task}",
            row.differences,
            *(row.t.value, row.t.low, row.t.high),
        )
        for row in differences
    ]
    if any(row.pairs > 1 for row in differences):  # else the table has every pair
        compared = tables.compared_with(differences, experiment)
        caption = render_text("paired_difference", compared)
        label = f"mean return over training, minus that of {compared}\n(right of the line: better)"
        yield _figure("paired_difference", caption, plots.paired_differences, lines, colors, label)
    yield tables.difference_table(experiment, differences)
    finals = statistics.paired_differences(experiment, "final")
    yield tables.difference_table(experiment, finals, "final return", "As above.")


def media_of(experiment: Experiment, which: str) -> Iterator[tuple[CellResult, list[Part]]]:
    """Cells with their pictures and videos.

    :param experiment: An experiment
    :param which: ``"all"`` seeds, of each arm the ``"first"`` one that has some, or ``"none"``
    :return: Cells and what to show of them
    """
    for task, method in experiment.arms if which != "none" else ():
        for cell in experiment.finished_cells(task, method).values():
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
    :raises UsageError: with one sentence, if the results cannot be read
    """
    sections = [describe(experiment, thresholds, media) for experiment in read_results(results)]
    facts = {"title": results.resolve().name, "sections": sections, "results": results, "media": media}
    facts |= {"version": sb3_cure.__version__, "now": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")}
    texts = {
        out: tables.render("report.html.j2", **facts),
        results / "summary.md": tables.render("summary.md.j2", **facts),
    }
    files = {path: text.encode() for path, text in texts.items()}
    for section in sections:
        folder = section.experiment.folder
        text = tables.render("experiment.md.j2", section=section)
        files[folder / "table.md"] = text.encode()
        files |= {folder / part.name: part.content for part in section.parts if isinstance(part, Figure)}
    for path, content in files.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    return list(files)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command ``sb3-cure report``.

    :param argv: Command line, ``sys.argv`` by default
    :return: Exit status 0
    :raises UsageError: with one sentence, if the results cannot be read
    """
    parser = argparse.ArgumentParser(
        prog="sb3-cure report", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("results", type=Path, help="folder that `sb3-cure experiment` wrote, or one experiment in it")
    parser.add_argument("--out", type=Path, help="HTML file (default: report.html in the folder)")
    returns_help = "returns until which steps are counted (default: 250,500,750; below zero: --thresholds=-20,-10)"
    parser.add_argument("--thresholds", type=returns, default=THRESHOLDS, help=returns_help)
    media_help = "seeds with videos and pictures (default: of each arm the first that has some)"
    parser.add_argument("--media", choices=("first", "all", "none"), default="first", help=media_help)
    options = parser.parse_args(argv)
    if not options.results.is_dir():
        raise UsageError(missing_file(options.results))
    out = options.out or options.results / "report.html"
    written = write_report(options.results, out, options.thresholds, options.media)
    size = written[0].stat().st_size / 2**20
    print(f"Wrote {written[0]} ({size:.1f} MB), and {len(written) - 1} tables and plots")
    return 0


def returns(text: str) -> list[float]:
    """Parse returns, separated by commas (argparse shows this function's name in errors).

    :param text: Such as ``"250,500"``
    :return: The returns
    """
    return [float(number) for number in text.split(",")]
