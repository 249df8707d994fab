"""One HTML file about all experiments in a folder, with the tables as Markdown beside it.

    sb3-cure report results

Writes ``report.html`` (self-contained: pictures and videos are inside, no script, nothing is loaded from elsewhere) and
``summary.md`` into the folder, and ``table.md`` with the plots into the folder of each experiment, to be committed.
"""

import argparse
import base64
import io
import json
import math
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from datetime import UTC, datetime
from html import escape
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from PIL import Image

import sb3_cure
from sb3_cure.experiments import plots, published, statistics, tables
from sb3_cure.experiments.results import Experiment, ResultsError, read_results
from sb3_cure.experiments.tables import (
    Table,
    difference_label,
    interval_text,
    markdown_text,
    number_text,
    of_tasks,
    plural,
    ratio_text,
)
from sb3_cure.experiments.visit_statistics import HEADS, Coverage, ErrorSummary, state_coverage, summarise_errors
from sb3_cure.persistence.files import replacing

THRESHOLDS = (250.0, 500.0, 750.0)
#: With more arms than these, each is compared with the baseline only
PAIRS_UP_TO = 5
#: Lines across the plots of SRL error: whose mean error each of them is
_YARDSTICKS = {
    "always zero": "always predicting zero",
    "mean image": "always predicting the mean image",
    "paper's cure": "the paper's curious policy",
}
_FILM = "deterministic actions; below the picture the return and, with an SRL head, the SRL error so far"
#: Optional files of a cell: caption
MEDIA = {
    "task_policy.mp4": f"the task policy: {_FILM}",
    "curious_policy.mp4": f"the curious policy: {_FILM}",
    "reconstructions.png": "reconstructions over training, of the same observations of random actions in all arms (in "
    "cells of former versions: of each agent's own replay buffer)",
    "uncomfortable.png": "what the agent finds uncomfortable: frames of the replay buffer with the highest SRL error, "
    "met in training with sampled actions",
    "curiosity_map.png": "visits and SRL error over the true state, by policy: sampled actions, as in training",
}


#: Environment steps [n] and values [seeds, n]
Curves: TypeAlias = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Figure:
    """A plot.

    :param name: Name of its file, without extension
    :param caption: What it shows, also for those who cannot see it
    :param png: The file
    """

    name: str
    caption: str
    png: bytes

    def html(self) -> str:
        return _picture_html(self.png, self.caption)


@dataclass(frozen=True)
class Section:
    """An experiment in the report: text and parts in reading order."""

    experiment: Experiment
    headlines: Sequence[str]
    parts: Sequence[Table | Figure | str]


# Figures


def _figure(name: str, caption: str, draw: Callable[..., None], *arguments: Any) -> Figure:
    file = io.BytesIO()
    draw(file, *arguments)
    return Figure(name, caption, file.getvalue())


def curve_figures(experiment: Experiment, colors: Mapping[str, str]) -> Iterator[Figure]:
    """
    :param experiment: An experiment
    :param colors: By arm
    :return: Return, SRL loss and SRL error of the policies over training, where there is anything to draw
    """
    columns = {
        "return_mean": ("learning_curves", "episode return\n(deterministic actions)", False,
                        "Return of the task policy, which acts deterministically,"),
        "srl_loss": ("srl_loss", "SRL loss", True, "SRL loss of the batches of training"),
    }  # fmt: skip
    for column, (name, label, logarithmic, caption) in columns.items():
        curves = _stacked(experiment, column)
        if curves:
            yield _figure(name, _of(caption, curves), plots.learning_curves, curves, colors, label, logarithmic)
    errors: dict[str, dict[tuple[str, str], Curves]] = {}
    for actor in ("task", "curious"):
        for task, arms in _stacked(experiment, f"{actor}_srl_error").items():
            errors.setdefault(task, {}).update({(arm, actor): lines for arm, lines in arms.items()})
    if errors:
        drawn = {actor for lines in errors.values() for _, actor in lines}
        names = {"task": "the task policy (solid lines)", "curious": "the curious policy (dashed lines)"}
        who = " and ".join(name for actor, name in names.items() if actor in drawn)
        caption = _of(
            f"SRL error, under the agent's own head, met by {who}, acting alone and deterministically,", errors
        )
        label = "SRL error\n(deterministic actions)"
        yield _figure("srl_error", caption, plots.srl_error_curves, errors, colors, label)


def _of(what: str, curves: Mapping[str, object]) -> str:
    return f"{what} over environment steps: mean over seeds ± standard deviation ({', '.join(curves)})."


def _stacked(experiment: Experiment, column: str) -> dict[str, dict[str, Curves]]:
    """By task and arm, where there are two evaluations or more with a value in the column."""
    curves: dict[str, dict[str, Curves]] = {}
    for task in experiment.tasks:
        for method in experiment.methods:
            steps, values = statistics.stack_curves(list(experiment.done(task, method).values()), column)
            if len(steps) > 1:
                curves.setdefault(task, {})[method] = steps, values
    return curves


def difference_figure(
    experiment: Experiment, rows: Sequence[statistics.PairedDifference], colors: Mapping[str, str]
) -> Figure:
    """
    :param experiment: An experiment
    :param rows: Its paired differences in area
    :param colors: By arm
    :return: The differences with their t intervals
    """
    lines = [
        (
            row.method,
            f"{difference_label(row, experiment)}, {of_tasks(row)}",
            np.concatenate(list(row.differences.values())),
            (row.t.value, row.t.low, row.t.high),
        )
        for row in rows
    ]
    return _figure(
        "paired_difference",
        f"Area under the curve minus that of {tables.compared_with(rows, experiment)}: mean (diamond) with 95 % t "
        "interval (line; it may leave the picture), and each pair of seeds (dots).",
        plots.paired_differences,
        lines,
        colors,
        "difference in area under the curve (return)",
    )


# Sections


def describe(experiment: Experiment, thresholds: Sequence[float]) -> Section:
    """
    :param experiment: An experiment
    :param thresholds: Returns, for the steps to reach them
    :return: Its part of the report
    :raises ResultsError: if a file of it cannot be read
    """
    colors = plots.arm_colors(experiment.methods, experiment.baseline)
    if not any(cell.done for cell in experiment.cells.values()):
        return Section(experiment, ["Not run: no cell is done."], [tables.status_table(experiment)])
    headlines, parts = _visitation(experiment) if experiment.kind == "visitation" else ([], [])
    more_headlines, more_parts = _curves(experiment, colors, thresholds)
    conditions: list[Table | Figure | str] = [tables.status_table(experiment), tables.conditions_table(experiment)]
    return Section(experiment, [*headlines, *more_headlines], [*parts, *more_parts, *conditions])


def _visitation(experiment: Experiment) -> tuple[list[str], list[Table | Figure | str]]:
    coverage, errors = state_coverage(experiment), summarise_errors(experiment)
    parts: list[Table | Figure | str] = []
    if coverage:
        panels = {
            task: [
                (row.method, row.actor, row.occupied, _times_random(row.ratio)) for row in coverage if row.task == task
            ]
            for task in dict.fromkeys(row.task for row in coverage)
        }
        caption = (
            "Occupied cells of a grid over two coordinates of the true physics state, mean over all pairs of them, by "
            "policy (sampled actions): mean over seeds, each seed a dot; above, how many times the random policy's, "
            "with its 95 % interval."
        )
        parts.append(_figure("coverage", caption, plots.coverage_bars, panels, "occupied cells of the true state"))
        parts.append(tables.coverage_table(experiment, coverage))
    for head in [head for head in HEADS if any(row.head == head for row in errors)]:
        judged = [row for row in errors if row.head == head]
        bars = {
            task: [
                (row.method, row.actor, (row.error_min, row.error_max), row.means, _times_random(row.ratio))
                for row in judged
                if row.task == task
            ]
            for task in dict.fromkeys(row.task for row in judged)
        }
        lines = {task: _yardsticks(experiment, task, errors) for task in bars}
        caption = (
            f"SRL error per step under the {head} head, by policy (sampled actions): mean over seeds (bar), each seed "
            "(dot), lowest and highest of all steps (line), and how many times the random policy's, with its 95 % "
            "interval."
        )
        shown = [text for label, text in _YARDSTICKS.items() if any(label in each for each in lines.values())]
        if shown:
            caption += f" Lines across: the mean error of {', '.join(shown)}."
        parts.append(_figure(f"visitation_{head}", caption, plots.visitation_bars, bars, lines))
    if errors:
        parts.append(tables.error_table(experiment, errors))
    return list(_visitation_headlines(experiment, coverage, errors)), parts


def _yardsticks(experiment: Experiment, task: str, errors: Sequence[ErrorSummary]) -> dict[str, float]:
    lines = {}
    for head, label in (("zero", "always zero"), ("mean_image", "mean image")):
        values = [row.error_mean for row in errors if (row.task, row.head) == (task, head)]
        if values:
            lines[label] = float(np.mean(values))
    theirs = published.SRL_ERROR.get(published.task_key(task)) if experiment.sees_published_pixels else None
    return {**lines, "paper's cure": theirs["curious"].mean} if theirs else lines


def _times_random(ratio: statistics.Estimate) -> str:
    if not math.isfinite(ratio.value):
        return ""
    interval = "" if ratio.low is None else f"\n{interval_text(ratio, 1)}"
    return f"{number_text(ratio.value, 2)}\N{MULTIPLICATION SIGN}{interval}"


def _visitation_headlines(
    experiment: Experiment, coverage: Sequence[Coverage], errors: Sequence[ErrorSummary]
) -> Iterator[str]:
    """Of each arm with a curious policy a sentence against the random policy, and one against the task policy."""
    for task in experiment.tasks:
        for method in experiment.methods:
            key = (task, method, "curious")
            rows: list[tuple[Any, str]] = [
                (row, "as many cells of the true state space")
                for row in coverage
                if (row.task, row.method, row.actor) == key
            ]
            rows += [
                (row, f"the SRL error under the {row.head} head")
                for row in errors
                if (row.task, row.method, row.actor) == key and row.head in HEADS
            ]
            others = {"random policy": "ratio", f"task policy of {experiment.baseline_of(method)}": "task_ratio"}
            for other, name in others.items():
                ratios = [(getattr(row, name), what) for row, what in rows if math.isfinite(getattr(row, name).value)]
                if ratios:
                    # Measures may rest on different seeds, such as those whose common heads are made.
                    counts = [plural(ratio.n, "seed") for ratio, _ in ratios]
                    alike = len(set(counts)) == 1
                    found = [
                        f"{ratio_text(ratio)} times {what}{'' if alike else f' ({count})'}"
                        for (ratio, what), count in zip(ratios, counts, strict=True)
                    ]
                    seeds = f", {counts[0]}" if alike else ""
                    compared = f"compared to the {other}, the curious one meets {', '.join(found)}"
                    yield f"{method} on {task}{seeds}: {compared}."


def _curves(
    experiment: Experiment, colors: Mapping[str, str], thresholds: Sequence[float]
) -> tuple[list[str], list[Table | Figure | str]]:
    parts: list[Table | Figure | str] = list(curve_figures(experiment, colors))
    has_curves = any(
        len(statistics.summarise_arm(experiment, task, method).seeds)
        for task in experiment.tasks
        for method in experiment.methods
    )
    if not has_curves or experiment.kind == "visitation":
        return [], parts
    headlines = []
    differences = statistics.paired_differences(experiment)
    several = {row.method for row in differences if row.task is None}
    for row in differences:
        if row.task is None or row.method not in several:
            alike = "" if row.same_starts == row.pairs else f", {row.same_starts} with the same start,"
            where = f"{plural(row.pairs, 'pair')} of seeds{alike} on {of_tasks(row)}"
            digits = tables.difference_digits(row, experiment)
            shown = f" {interval_text(row.t, digits)}" if row.t.low is not None else ""
            headlines.append(
                f"{row.method} minus {row.other}: area under the curve {number_text(row.t.value, digits)}"
                f"{shown}, {where}: {row.t.verdict}."
            )
    if not differences:
        headlines.append(
            f"No arm shares a seed that has returns with the baseline {experiment.baseline}: nothing to compare."
            if len(experiment.methods) > 1
            else "One arm: there is nothing to compare it with."
        )
    if experiment.kind == "pretraining":
        parts.insert(0, tables.pretraining_table(experiment))
    parts.append(tables.curves_table(experiment, thresholds))
    if differences:
        parts.append(difference_figure(experiment, differences, colors))
        parts.append(tables.difference_table(experiment, differences))
        finals = statistics.paired_differences(experiment, "finals")
        parts.append(tables.difference_table(experiment, finals, "final return", "As above."))
    pairs = list(_all_pairs(experiment)) if 2 < len(experiment.methods) <= PAIRS_UP_TO else []
    if pairs:
        parts.append(tables.pairs_table(experiment, pairs))
    try:
        found = statistics.aggregate(experiment)
    except ResultsError as error:
        parts.append(f"No aggregates: {error}")
        return headlines, parts
    if found is None:
        parts.append("No aggregates over tasks: they need two seeds or more that every arm has done.")
        return headlines, parts
    iqm = {method: (each.value, each.low or 0.0, each.high or 0.0) for method, each in found.iqm.items()}
    parts.append(
        _figure(
            "aggregates",
            "Interquartile mean of the final score (left) and performance profile (right) with 95 % intervals, by arm.",
            plots.aggregate_scores,
            iqm,
            found.taus,
            found.profiles,
            colors,
        )
    )
    parts.append(tables.aggregate_table(experiment, found))
    return headlines, parts


def _all_pairs(experiment: Experiment) -> Iterator[statistics.PairedDifference]:
    """Any two arms, the later minus the earlier, over all tasks that both have."""
    for index, other in enumerate(experiment.methods):
        rows = statistics.paired_differences(experiment, baseline=other)
        for method in experiment.methods[index + 1 :]:
            yield from [row for row in rows if row.method == method][:1]


# HTML

STYLE = """
:root { --ink: #1c2430; --soft: #5b6675; --line: #dfe3e8; --wash: #f6f7f9; --accent: #1f5fa8; }
* { box-sizing: border-box; }
body { margin: 0; color: var(--ink); background: white; }
body { font: 15px/1.55 system-ui, "Segoe UI", "DejaVu Sans", sans-serif; }
main, header > div { max-width: 1160px; margin: 0 auto; padding: 0 28px; }
header { background: var(--ink); color: white; padding: 28px 0 22px; margin-bottom: 22px; }
header h1 { margin: 0 0 4px; font-size: 26px; font-weight: 650; }
header p { margin: 0; color: #c4ccd6; }
h2 { font-size: 21px; margin: 44px 0 6px; padding-top: 14px; border-top: 2px solid var(--ink); }
h1, h2, h3 { overflow-wrap: anywhere; }
h3 { font-size: 16px; margin: 30px 0 8px; }
td.says { max-width: 760px; }
nav { overflow-x: auto; }
a { color: var(--accent); }
.facts, .note, figcaption { color: var(--soft); font-size: 13px; }
.facts { margin: 0 0 12px; }
.note { max-width: 920px; margin: 6px 0 0; }
.headline { background: var(--wash); border-left: 4px solid var(--accent); margin: 14px 0; padding: 10px 18px; }
.headline p { margin: 3px 0; overflow-wrap: anywhere; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: 13px; font-variant-numeric: tabular-nums; }
th { text-align: left; font-weight: 600; color: var(--soft); vertical-align: bottom; }
th { border-bottom: 1.5px solid var(--ink); }
th, td { padding: 4px 14px 4px 0; }
td { border-bottom: 1px solid var(--line); vertical-align: top; overflow-wrap: break-word; max-width: 340px; }
.number { text-align: right; white-space: nowrap; }
.bad { color: #a61b1b; font-weight: 600; }
.good { color: #17692f; font-weight: 600; }
.absent { color: #8a5a00; font-style: italic; }
figure { margin: 18px 0; }
img, video { max-width: 100%; height: auto; display: block; }
.media { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(480px, 100%), 1fr)); gap: 16px 26px; }
.media figure { margin: 6px 0; }
.media .broad { grid-column: 1 / -1; }
.media video { width: 100%; max-width: 400px; background: #000; }
details { margin: 10px 0; }
details details { margin-left: 20px; }
summary { cursor: pointer; font-weight: 600; overflow-wrap: anywhere; }
pre { background: var(--wash); padding: 10px 14px; font-size: 12px; overflow-x: auto; white-space: pre-wrap; }
footer { color: var(--soft); font-size: 13px; margin: 50px 0 30px; }
@media print { header { background: white; color: black; } header p { color: #444; } body { font-size: 11px; }
  main { padding: 0; } nav, .wide { overflow: visible; } table { font-size: 9px; } th, td { padding-right: 8px; }
  figure, tr { break-inside: avoid; } h2, h3 { break-after: avoid; } figure:has(video) { display: none; } }
"""
# Whatever text from a results folder should manage to do, the page loads nothing and runs nothing.
POLICY = (
    "default-src 'none'; img-src data:; media-src data:; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'"
)


def _data(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def _picture_html(png: bytes, caption: str) -> str:
    with Image.open(io.BytesIO(png)) as image:
        width, height = image.size
    text, size = escape(caption), f'width="{width * 2 // 3}" height="{height * 2 // 3}"'
    image_html = f'<img src="{_data("image/png", png)}" {size} alt="{text}">'
    kind = ' class="broad"' if width > 1.3 * height else ""
    return f"<figure{kind}>{image_html}<figcaption>{text}</figcaption></figure>\n"


def _media_html(path: Path, caption: str) -> str:
    """A file of a cell, or a sentence about why it cannot be shown."""
    try:
        content = path.read_bytes()
        if path.suffix == ".png":
            with Image.open(io.BytesIO(content), formats=["PNG"]) as image:
                image.verify()
            return _picture_html(content, caption)
    except (OSError, SyntaxError, ValueError) as error:  # SyntaxError: Pillow's word for a broken PNG
        return f'<p class="note">{escape(path.name)} cannot be shown: {escape(str(error))}</p>'
    if content[4:8] != b"ftyp":
        return f'<p class="note">{escape(path.name)} cannot be shown: it is no MP4.</p>'
    text = escape(caption)
    video = f'<video controls muted preload="metadata" aria-label="{text}" src="{_data("video/mp4", content)}"></video>'
    return f"<figure>{video}<figcaption>{text}</figcaption></figure>\n"


def media_html(experiment: Experiment, which: str) -> str:
    """
    :param experiment: An experiment
    :param which: ``"all"`` seeds, of each arm the ``"first"`` one that has some, or ``"none"``
    :return: Pictures and videos of the cells that have some
    """
    blocks = []
    for task in experiment.tasks:
        for method in experiment.methods:
            cells = experiment.done(task, method).values() if which != "none" else []
            files = [[cell.folder / name for name in MEDIA if (cell.folder / name).exists()] for cell in cells]
            shown = [(cell, paths) for cell, paths in zip(cells, files, strict=True) if paths]
            for cell, paths in shown[:1] if which == "first" else shown:
                name = escape(f"{task}, {method}, seed {cell.seed}")
                is_open = " open" if task == experiment.tasks[0] else ""
                content = "".join(_media_html(path, MEDIA[path.name]) for path in paths)
                media = f'<div class="media">{content}</div>'
                blocks.append(f"<details{is_open}><summary>{name}</summary>{media}</details>\n")
    if not blocks:
        return ""
    seeds = "the first seed that has some" if which == "first" else "all seeds that have some"
    return f'<h3>Pictures and videos</h3>\n<p class="note">Of each arm: {seeds}.</p>\n{"".join(blocks)}'


def _configs_html(experiment: Experiment) -> str:
    """One configuration per task and arm: the seeds of an arm differ in nothing else."""
    blocks = []
    for task in experiment.tasks:
        for method in experiment.methods:
            cells = experiment.done(task, method)
            if cells:
                config = {key: value for key, value in next(iter(cells.values())).config.items() if key != "seed"}
                text = escape(json.dumps(config, indent=2, ensure_ascii=False))
                name = escape(f"{task}, {method}")
                blocks.append(f"<details><summary>{name}</summary><pre>{text}</pre></details>\n")
    grid = escape(json.dumps(experiment.grid, indent=2, ensure_ascii=False))
    blocks.insert(0, f"<details><summary>grid</summary><pre>{grid}</pre></details>\n")
    return f"<details><summary>Configurations</summary>\n{''.join(blocks)}</details>\n"


def _facts(experiment: Experiment) -> str:
    evaluation = experiment.grid.get("evaluation")
    every = ""
    if isinstance(evaluation, dict):
        every = f", evaluated every {evaluation.get('every')} of them (episodes: {evaluation.get('episodes')})"
    return (
        f"{experiment.kind}; {experiment.budget:,} environment steps{every}; {plural(len(experiment.tasks), 'task')}, "
        f"{plural(len(experiment.methods), 'arm')}, seeds {', '.join(map(str, experiment.seeds))}; "
        f"{_progress(experiment)} cells done; baseline {experiment.baseline}{_environment(experiment)}"
    )


def _progress(experiment: Experiment) -> str:
    return f"{sum(cell.done for cell in experiment.cells.values())} of {len(experiment.cells)}"


def _environment(experiment: Experiment) -> str:
    """What is asked of the environments beyond their names: it makes returns comparable or not."""
    tasks: dict[str, dict[str, None]] = {}
    for cell in experiment.cells.values():
        if cell.done:
            kwargs = cell.config.get("env_kwargs") or {}
            text = ", ".join(f"{key} {value}" for key, value in sorted(kwargs.items())) or "as registered"
            tasks.setdefault(text, {})[cell.task] = None
    shown = [text + (f" ({', '.join(names)})" if len(tasks) > 1 else "") for text, names in tasks.items()]
    return f"; environments: {'; '.join(shown)}" if shown else ""


def _overview(sections: Sequence[Section]) -> list[tuple[str, str, str]]:
    """Of each experiment its name, how many cells are done, and what it says first."""
    rows = []
    for section in sections:
        more = len(section.headlines) - 1
        says = (section.headlines or [tables.NONE])[0] + (f" (And {plural(more, 'line')} more.)" if more > 0 else "")
        rows.append((section.experiment.name, _progress(section.experiment), says))
    return rows


def render_html(sections: Sequence[Section], comparisons: Table | None, media: str, title: str) -> str:
    """
    :param sections: The experiments
    :param comparisons: Table of published numbers, if there is anything to compare
    :param media: See ``media_html``
    :param title: Name of the folder
    :return: The page
    """
    rows = "<tr><th>experiment</th><th>cells done</th><th>in short</th></tr>"
    rows += "".join(
        f'<tr><td><a href="#e{index}">{escape(name)}</a></td><td>{done}</td><td class="says">{escape(says)}</td></tr>'
        for index, (name, done, says) in enumerate(_overview(sections))
    )
    body = []
    for index, section in enumerate(sections):
        body.append(f'<section><h2 id="e{index}">{escape(section.experiment.name)}</h2>\n')
        body.append(f'<p class="facts">{escape(_facts(section.experiment))}</p>\n')
        if section.headlines:
            lines = "".join(f"<p>{escape(line)}</p>" for line in section.headlines)
            body.append(f'<div class="headline">{lines}</div>\n')
        body += [
            f'<p class="note">{escape(part)}</p>\n' if isinstance(part, str) else part.html() for part in section.parts
        ]
        body += [media_html(section.experiment, media), _configs_html(section.experiment), "</section>\n"]
    if comparisons is not None:
        rows += '<tr><td><a href="#published">Beside published returns</a></td><td></td><td></td></tr>'
        body.append(f'<section id="published">{comparisons.html().replace("h3>", "h2>")}</section>\n')
    now = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{escape(POLICY)}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<link rel="icon" href="data:,">
<title>{escape(title)}: experiments of sb3_cure</title>
<style>{STYLE}</style>
</head>
<body>
<header><div><h1>{escape(title)}</h1>
<p>{plural(len(sections), "experiment")}, sb3_cure {escape(sb3_cure.__version__)}, written {now}</p></div></header>
<main>
<nav aria-label="Experiments"><table>{rows}</table></nav>
{"".join(body)}<footer>Intervals are 95 %. The arms of an experiment are compared seed by seed.</footer>
</main>
</body>
</html>
"""


# Markdown


def render_markdown(section: Section, level: int = 1, plots_beside: bool = False) -> str:
    """
    :param section: An experiment
    :param level: Of its heading
    :param plots_beside: Whether the plots lie beside the text, and are shown
    :return: Its headlines and tables
    """
    title, facts = markdown_text(section.experiment.name), markdown_text(_facts(section.experiment))
    lines = [f"{'#' * level} {title}", "", facts, ""]
    lines += [f"- {markdown_text(line)}" for line in section.headlines]
    for part in section.parts:
        if isinstance(part, Table):
            lines += ["", part.markdown()]
        elif isinstance(part, str):
            lines += ["", markdown_text(part)]
        elif plots_beside:
            lines += ["", f"![{markdown_text(part.caption)}]({part.name}.png)"]
    return "\n".join(lines) + "\n"


def write_report(
    results: Path, out: Path, thresholds: Sequence[float] = THRESHOLDS, media: str = "first"
) -> list[Path]:
    """Write the report of a folder.

    :param results: Folder of results
    :param out: HTML file
    :param thresholds: Returns, for the steps to reach them
    :param media: Of which seeds: ``"first"``, ``"all"`` or ``"none"``
    :return: What was written
    :raises ResultsError: with one sentence that names the file and what is wrong
    """
    experiments = read_results(results)
    sections = [describe(experiment, thresholds) for experiment in experiments]
    comparisons = published.compare_with_published(experiments)
    table = tables.published_table(comparisons) if comparisons else None
    files: dict[Path, bytes] = {out: render_html(sections, table, media, results.resolve().name).encode()}
    title = markdown_text(results.resolve().name)
    overview = ["| experiment | cells done | in short |", "|---|---|---|"]
    overview += [f"| {' | '.join(map(markdown_text, row))} |" for row in _overview(sections)]
    summary = [f"# {title}\n", "\n".join(overview) + "\n", *(render_markdown(each, level=2) for each in sections)]
    summary += [table.markdown() + "\n"] if table else []
    files[results / "summary.md"] = "\n".join(summary).encode()
    for section in sections:
        files[section.experiment.folder / "table.md"] = render_markdown(section, plots_beside=True).encode()
        for part in section.parts:
            if isinstance(part, Figure):
                files[section.experiment.folder / f"{part.name}.png"] = part.png
    written: list[Path] = []
    failed: set[Path] = set()
    for path, content in files.items():
        if path.parent in failed:
            continue
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with nullcontext(path) if path == out else replacing(path) as file:
                file.write_bytes(content)
        except OSError as error:
            if path == out:
                raise ResultsError(f"{path} cannot be written ({error.strerror}): choose another --out.") from None
            # Others' results may be read-only, of some experiments or of all.
            print(f"{path.parent} cannot be written to ({error.strerror}): its tables and plots are in {out} alone.")
            failed.add(path.parent)
            continue
        written.append(path)
    return written


def main(argv: Sequence[str] | None = None) -> int:
    """The command ``sb3-cure report``.

    :param argv: Command line, ``sys.argv`` by default
    :return: 0, or 1 if the results cannot be read
    """
    parser = argparse.ArgumentParser(
        prog="sb3-cure report", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("results", type=Path, help="folder that `sb3-cure experiment` wrote, or one experiment in it")
    parser.add_argument("--out", type=Path, help="HTML file (default: report.html in the folder)")
    parser.add_argument(
        "--thresholds", type=_thresholds, default=THRESHOLDS, help="returns whose steps are told (default: 250,500,750)"
    )
    parser.add_argument(
        "--media",
        choices=("first", "all", "none"),
        default="first",
        help="videos and pictures of which seeds (default: of each arm the first that has some)",
    )
    options = parser.parse_args(argv)
    try:
        written = write_report(
            options.results, options.out or options.results / "report.html", options.thresholds, options.media
        )
    except ResultsError as error:
        print(f"sb3-cure report: {error}", file=sys.stderr)
        return 1
    size = written[0].stat().st_size / 2**20
    print(f"{written[0]} ({size:.1f} MB), and {len(written) - 1} tables and plots beside it and in the experiments")
    return 0


def _thresholds(text: str) -> list[float]:
    try:
        returns = [float(number) for number in text.split(",")]
    except ValueError:
        returns = [math.nan]
    if not all(map(math.isfinite, returns)):
        raise argparse.ArgumentTypeError(f"{text!r} is no list of returns such as 250,500,750")
    return returns


if __name__ == "__main__":
    raise SystemExit(main())
