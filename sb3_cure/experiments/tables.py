"""Tables of reports: statistics in words and numbers, as HTML or Markdown. Names come from files and are escaped."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np

from sb3_cure.experiments import published, statistics
from sb3_cure.experiments.results import FAILED, NOT_RUN, UNFINISHED, CellResult, Experiment
from sb3_cure.experiments.statistics import Estimate
from sb3_cure.experiments.visit_statistics import GRID_INTERVALS, Coverage, ErrorSummary

NONE = "\N{EN DASH}"
DIFFERENCES = (
    "Arm minus baseline, seed by seed: the arms of a seed share evaluation starts, and where nothing but the method "
    "differs initial weights and warm-up data, too (same start: in how many pairs both earn the same before training; "
    "not so after pretraining, with other networks, or with another implementation). The t interval, which gives the "
    "verdict, draws each task's mean from Student's t around the mean of its pairs and weighs tasks evenly; with one "
    "task it is the paired t interval. The percentile bootstrap resamples seeds within tasks; with two to five of "
    "them it is too narrow (it covers the truth in about 50 to 85 % of cases), and is here for comparison. Above: in "
    "how many pairs the arm is above. Verdicts are not corrected for the number of arms and tasks."
)


@dataclass(frozen=True)
class Table:
    """A table in either language.

    :param title: Heading
    :param columns: Header; those that begin with ``>`` hold numbers and are aligned to the right
    :param rows: Plain text
    :param note: What to know when reading it
    """

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str = ""

    def markdown(self) -> str:
        names = [markdown_text(column.removeprefix(">")) for column in self.columns]
        rules = ["---:" if column.startswith(">") else "---" for column in self.columns]
        lines = [f"| {' | '.join(names)} |", f"|{'|'.join(rules)}|"]
        lines += [f"| {' | '.join(map(markdown_text, row))} |" for row in self.rows]
        note = ["", markdown_text(self.note)] if self.note else []
        return "\n".join([f"### {markdown_text(self.title)}", "", *lines, *note])

    def html(self) -> str:
        kinds = [' class="number"' if column.startswith(">") else "" for column in self.columns]
        names = [escape(column.removeprefix(">")) for column in self.columns]
        head = "".join(f'<th scope="col"{kind}>{name}</th>' for kind, name in zip(kinds, names, strict=True))
        body = "".join(f"<tr>{''.join(map(_table_cell, self.columns, kinds, row))}</tr>\n" for row in self.rows)
        note = f'<p class="note">{escape(self.note)}</p>' if self.note else ""
        return (
            f"<h3>{escape(self.title)}</h3>\n<div class='wide'><table>\n<thead><tr>{head}</tr></thead>\n"
            f"<tbody>\n{body}</tbody></table></div>\n{note}\n"
        )


# Words and numbers


def markdown_text(text: str) -> str:
    """
    :param text: Plain text
    :return: The same in Markdown: nothing of it ends a cell of a table, or becomes HTML, a link or a picture
    """
    text = re.sub(r"([\\`*_{}\[\]|!#~])", r"\\\1", " ".join(text.split()))
    return text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")


def _table_cell(column: str, kind: str, text: str) -> str:
    marks = {"suspected bug": "bad", "worse": "bad", "better": "good"}
    marks |= {FAILED: "bad", NOT_RUN: "absent", UNFINISHED: "absent"}
    names = column in ("arm", "arms", "task", "experiment")
    mark = "" if names else next((name for word, name in marks.items() if text.startswith(word)), "")
    content = escape(text)
    return f"<td{kind}>{f'<span class={mark!r}>{content}</span>' if mark else content}</td>"


def number_text(value: float, digits: int = 0) -> str:
    """
    :param value: A number
    :param digits: Behind the point
    :return: With a true minus sign; a dash for what is not finite
    """
    if not math.isfinite(value):
        return NONE
    return f"{round(value, digits) + 0.0:,.{digits}f}".replace("-", "\N{MINUS SIGN}")


def _error(value: float) -> str:
    return f"{value:.2e}" if math.isfinite(value) else NONE


def return_digits(experiment: Experiment, task: str | None = None) -> int:
    """
    :param experiment: An experiment
    :param task: Short name, or None for all tasks
    :return: How many digits behind the point its returns need: none from 10 on, else three significant ones
    """
    cells = [cell for cell in experiment.cells.values() if task in (None, cell.task)]
    highest = max((float(np.abs(cell.curve()[1]).max(initial=0)) for cell in cells), default=0.0)
    return 2 - math.floor(math.log10(highest)) if 0 < highest < 10 else 0


def _mean_std(values: np.ndarray, digits: int = 0) -> str:
    if not len(values):
        return ""
    std = f" ± {number_text(float(values.std(ddof=1)), digits)}" if len(values) > 1 else ""
    return f"{number_text(float(values.mean()), digits)}{std}"


def interval_text(estimate: Estimate, digits: int = 0) -> str:
    """
    :param estimate: A number
    :param digits: Behind the point
    :return: Its interval, or why there is none
    """
    if estimate.low is None or estimate.high is None:
        return "one seed: no interval" if estimate.n else NONE
    return f"[{number_text(estimate.low, digits)}, {number_text(estimate.high, digits)}]"


def _published(value: published.MeanStd | None) -> str:
    if value is None:
        return NONE
    return number_text(value.mean) + (f" ± {number_text(value.std)}" if value.std is not None else "")


def plural(count: int, noun: str) -> str:
    """
    :param count: How many
    :param noun: In the singular
    :return: ``"1 seed"``, ``"2 seeds"``
    """
    return f"{count} {noun}{'' if count == 1 else 's'}"


def _list(values: Sequence[Any]) -> str:
    return ", ".join(dict.fromkeys(str(value) for value in values if value not in (None, ""))) or NONE


def _duration(seconds: Any) -> str:
    if not isinstance(seconds, int | float):
        return NONE
    if seconds < 60:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 3600 else f"{seconds / 3600:.1f} h"


# Tables


def status_table(experiment: Experiment) -> Table:
    """
    :param experiment: An experiment
    :return: Which cells are done
    """
    rows = [[task, *(_state(experiment, task, method) for method in experiment.methods)] for task in experiment.tasks]
    note = "Numbers are seeds. Only cells that are done enter statistics and plots."
    return Table("Cells", ["task", *experiment.methods], rows, note)


def _state(experiment: Experiment, task: str, method: str) -> str:
    state = experiment.state(task, method)
    if set(state) <= {NOT_RUN}:
        return NOT_RUN
    return "; ".join(f"{status}: {', '.join(map(str, seeds))}" for status, seeds in state.items())


def curves_table(experiment: Experiment, thresholds: Sequence[float]) -> Table:
    """
    :param experiment: An experiment
    :param thresholds: Returns, for the steps to reach them
    :return: Area under the curve, final return, spread over seeds, steps to thresholds
    """
    columns = ["task", "arm", ">seeds", ">area under curve", ">final return", ">IQR, final", ">IQR, curve"]
    columns += [f">steps to {limit:,.15g}".replace("-", "\N{MINUS SIGN}") for limit in thresholds]
    rows = []
    for task in experiment.tasks:
        digits = return_digits(experiment, task)
        for method in experiment.methods:
            arm = statistics.summarise_arm(experiment, task, method, thresholds)
            row = [task, method, str(len(arm.seeds))]
            row += [_mean_std(values, digits) or _state(experiment, task, method) for values in (arm.areas, arm.finals)]
            spreads = statistics.interquartile_range(arm.finals), arm.curve_iqr
            row += [number_text(spread, digits) for spread in spreads]
            rows.append(row + [_reached(arm.reached[limit], experiment.budget) for limit in thresholds])
    return Table(
        "Learning curves",
        columns,
        rows,
        "Mean ± standard deviation (n - 1) over seeds. Area under the curve: mean return over the environment steps of "
        "training. IQR: interquartile range over seeds, of the final return and averaged over the curve. Steps: of the "
        "first evaluation with the return, median over all seeds (those that never get there count as later than the "
        "end of training), and how many of them get there.",
    )


def _reached(steps: np.ndarray, budget: int) -> str:
    if not len(steps):
        return NONE
    count = int(np.isfinite(steps).sum())
    if not count:
        return "not reached"
    median = float(np.median(steps))
    shown = number_text(median) if np.isfinite(median) else f"> {number_text(budget)}"
    return f"{shown} ({count} of {len(steps)})"


def difference_table(
    experiment: Experiment,
    rows: Sequence[statistics.PairedDifference],
    measure: str = "area under the curve",
    note: str = DIFFERENCES,
) -> Table:
    """
    :param experiment: An experiment
    :param rows: Its paired differences
    :param measure: Of what
    :param note: What to know about them
    :return: The differences with both intervals
    """
    texts = [[difference_label(row, experiment), of_tasks(row), *_difference(row, experiment)] for row in rows]
    columns = ["arm", "task", *_DIFFERENCE_COLUMNS]
    return Table(f"Paired difference from {compared_with(rows, experiment)}: {measure}", columns, texts, note)


def difference_label(row: statistics.PairedDifference, experiment: Experiment) -> str:
    """
    :param row: A paired difference
    :param experiment: Of which experiment
    :return: The arm, and what it is compared with if that is another than the experiment's baseline
    """
    return row.method if row.other == experiment.baseline else f"{row.method} minus {row.other}"


def compared_with(rows: Sequence[statistics.PairedDifference], experiment: Experiment) -> str:
    """
    :param rows: Paired differences, each with its ``difference_label``
    :param experiment: Of which experiment
    :return: The baseline, and where to find the others
    """
    has_others = any(row.other != experiment.baseline for row in rows)
    return experiment.baseline + (', or the arm after "minus"' if has_others else "")


def pairs_table(experiment: Experiment, rows: Sequence[statistics.PairedDifference]) -> Table:
    """
    :param experiment: An experiment
    :param rows: Its paired differences in area between any two arms
    :return: One row for each
    """
    texts = [[f"{row.method} minus {row.other}", of_tasks(row), *_difference(row, experiment)] for row in rows]
    title = "Paired difference between any two arms: area under the curve"
    return Table(title, ["arms", "task", *_DIFFERENCE_COLUMNS], texts, "As above, over all tasks.")


_DIFFERENCE_COLUMNS = (">pairs", ">same start", ">difference", ">95 % t", ">95 % percentile", ">above", "verdict")


def difference_digits(row: statistics.PairedDifference, experiment: Experiment) -> int:
    """
    :param row: A paired difference in return
    :param experiment: Of which experiment
    :return: How many digits behind the point it needs, at least one
    """
    return max(1, return_digits(experiment, row.task))


def _difference(row: statistics.PairedDifference, experiment: Experiment) -> list[str]:
    digits = difference_digits(row, experiment)
    numbers = [str(row.pairs), str(row.same_starts), number_text(row.t.value, digits)]
    intervals = [interval_text(each, digits) for each in (row.t, row.percentile)]
    return [*numbers, *intervals, str(row.wins), row.t.verdict]


def of_tasks(row: statistics.PairedDifference) -> str:
    """
    :param row: A paired difference
    :return: Of which task, or of how many
    """
    if row.task is not None:
        return row.task
    left_out = f" (left out, with a single pair: {', '.join(row.left_out)})" if row.left_out else ""
    return plural(len(row.differences), "task") + left_out


def aggregate_table(experiment: Experiment, found: statistics.Aggregates) -> Table:
    """
    :param experiment: An experiment
    :param found: Its aggregates
    :return: Interquartile means and probabilities of improvement
    """
    rows = [
        [
            method,
            number_text(iqm.value, 3),
            interval_text(iqm, 3),
            number_text(found.improvement[method].value, 2) if method in found.improvement else NONE,
            interval_text(found.improvement[method], 2) if method in found.improvement else NONE,
        ]
        for method, iqm in found.iqm.items()
    ]
    varied = any(experiment.baseline_of(method) != experiment.baseline for method in found.improvement)
    compared = "its baseline" if varied else experiment.baseline
    return Table(
        "Aggregates over tasks (rliable)",
        ["arm", ">IQM", ">95 %", f">P(arm > {compared})", ">95 %"],
        rows,
        f"Scores: final return / {statistics.HIGHEST_RETURN:.0f}. {plural(len(found.tasks), 'task')} "
        f"({', '.join(found.tasks)}), {found.seeds} seeds each: those that all arms have done. Stratified percentile "
        "bootstrap over seeds: too narrow for few of them. The probability of improvement does not pair seeds."
        + (f" Baseline: {_baselines(experiment)}." if varied else ""),
    )


def error_table(experiment: Experiment, summaries: Sequence[ErrorSummary]) -> Table:
    """
    :param experiment: An experiment
    :param summaries: What its policies meet
    :return: SRL error by policy and head, beside the paper's
    """
    rows = []
    compares = experiment.sees_published_pixels
    unlike = [task for task in experiment.tasks if experiment.has_unlike_heads(task)]
    again = f" Not all common heads of {_list(unlike)} were made of the same cells: run the grid again."
    for row in summaries:
        theirs = published.SRL_ERROR.get(published.task_key(row.task), {}).get(row.actor) if compares else None
        shown = NONE if theirs is None or row.head != "own" else " / ".join(f"{value:.4f}" for value in theirs)
        errors = [_error(value) for value in (row.error_min, row.error_mean, row.error_max)]
        head = row.head.replace("_", " ")
        ratios = [ratio_text(row.ratio), ratio_text(row.task_ratio)]
        rows.append([row.task, row.method, head, row.actor, str(len(row.means)), *errors, *ratios, shown])
    return Table(
        "SRL error per step",
        ["task", "arm", "head", "actor", ">seeds", ">min", ">mean", ">max", *_RATIO_COLUMNS, ">paper"],
        rows,
        "Actions are sampled, as in training. Heads: own, the arm's own; common, one fitted to an even mix of frames "
        "of the random, task and curious policies (each of the first arm that has it) from other seeds; zero and mean "
        "image, yardsticks that always predict the same. Errors are measured against the mean of the dither: "
        f"an autoencoder's error is its excess over the dither floor already ({published.DITHER_FLOOR:.1e} of the "
        "training loss), and the ratios those of the excesses: over the random actor's under the same head, and over "
        f"that of the task policy of the baseline ({_baselines(experiment)}) with the same seed (not under own heads, "
        "which differ); "
        "geometric mean over seeds, t interval of the logarithms. Paper: min / mean / max of the last table of "
        f"{published.PAPER}{'' if compares else ' (not given: these cells see other pixels)'}."
        + (again if unlike else ""),
    )


_RATIO_COLUMNS = (">/ random's [95 %]", ">/ baseline's task policy's [95 %]")


def _baselines(experiment: Experiment) -> str:
    own = [name for name in experiment.methods if experiment.baseline_of(name) != experiment.baseline]
    return _list([experiment.baseline, *(f"of {name} {experiment.baseline_of(name)}" for name in own)])


def ratio_text(estimate: Estimate) -> str:
    """
    :param estimate: A ratio
    :return: It and its interval
    """
    if not math.isfinite(estimate.value):
        return NONE
    shown = "(one seed)" if estimate.low is None else interval_text(estimate, 2)
    return f"{number_text(estimate.value, 2)} {shown}"


def coverage_table(experiment: Experiment, rows: Sequence[Coverage]) -> Table:
    """
    :param experiment: An experiment
    :param rows: Coverage by actor
    :return: Occupied cells and entropy
    """
    dimensions = _list([f"{row.task}: {row.dimensions}" for row in rows])
    columns = ["task", "arm", "actor", ">seeds", ">states", ">occupied cells"]
    shown = []
    for row in rows:
        numbers = [str(len(row.occupied)), number_text(row.steps), _mean_std(row.occupied)]
        entropy = number_text(float(row.entropy.mean()), 2)
        shown.append(
            [row.task, row.method, row.actor, *numbers, ratio_text(row.ratio), ratio_text(row.task_ratio), entropy]
        )
    return Table(
        "Coverage of the true state space",
        [*columns, *_RATIO_COLUMNS, ">entropy, bits"],
        shown,
        f"Positions and velocities of the simulator ({dimensions}), of which the agents see only images; actions are "
        "sampled, as in training. Cells are those of a grid over two coordinates, mean over all pairs of them: "
        f"{GRID_INTERVALS} intervals between the random policy's 1st and 99th percentile (of angles: on the "
        "circle), and cells of that size beyond. Equally many states are counted of each actor and seed. Ratios "
        f"(baseline: {_baselines(experiment)}): geometric mean over seeds, t interval of the logarithms.",
    )


def pretraining_table(experiment: Experiment) -> Table:
    """
    :param experiment: An experiment of kind ``"pretraining"``
    :return: Final returns beside the paper's
    """
    rows = []
    compares = experiment.sees_published_pixels
    for task in experiment.tasks:
        for method in experiment.methods:
            finals = statistics.summarise_arm(experiment, task, method).finals
            theirs = _papers_arm(method).get(published.task_key(task)) if compares else None
            difference = NONE
            if len(finals) and theirs is not None:
                difference = number_text(float(finals.mean()) - theirs.mean)
            ours = _mean_std(finals, return_digits(experiment, task)) or _state(experiment, task, method)
            rows.append([task, method, str(len(finals)), ours, _published(theirs), difference])
    return Table(
        "Final return after pretraining, beside the paper's",
        ["task", "arm", ">seeds", ">ours", ">paper", ">difference"],
        rows,
        f"Paper: {published.PAPER}, Table I, after training of unstated length; ours after {experiment.budget:,} "
        "environment steps, so that differences in level say little: compare the order of the arms."
        + ("" if compares else " Not given: these cells see other pixels."),
    )


def _papers_arm(method: str) -> Mapping[str, published.MeanStd]:
    return published.PRETRAINING.get(method.lower().replace("-", "_"), {})


def published_table(comparisons: Sequence[published.Comparison]) -> Table:
    """
    :param comparisons: Arms beside published numbers
    :return: Ours, theirs, difference
    """
    rows = []
    for row in comparisons:
        ours = number_text(row.ours) + (f" ± {number_text(row.std)}" if math.isfinite(row.std) else "")
        others = [
            f"{name} {_published(value)}"
            for name, tables in published.RETURNS.items()
            if name != row.published_as and (value := tables[row.steps].get(published.task_key(row.task)))
        ]
        theirs, difference, ratio, judgement = NONE, NONE, NONE, "not published"
        if row.theirs is not None:
            theirs = f"{row.published_as} {_published(row.theirs)}"
            difference, ratio = number_text(row.ours - row.theirs.mean), f"{row.ours / row.theirs.mean:.3f}"
            judgement = "ok" if row.same_method else "adds curiosity, or changes settings: not judged"
        if row.suspect:
            judgement = f"suspected bug: below {published.SUSPECT_BELOW} x published"
        run = [row.experiment, row.task, row.method, number_text(row.steps), str(row.seeds), ours]
        rows.append([*run, theirs, difference, ratio, judgement, "; ".join(others) or NONE])
    sources = "; ".join(f"{name}: {source}" for name, source in published.SOURCES.items())
    columns = ["experiment", "task", "arm", ">steps", ">seeds", ">ours", ">theirs", ">difference", ">ratio"]
    return Table(
        "Beside published returns",
        [*columns, "judgement", "other methods"],
        rows,
        f"At the same environment steps. {sources}. Independent reruns land 5 to 25 % lower than published; below "
        f"{published.SUSPECT_BELOW} of the published mean a bug of ours is suspected until shown otherwise. Published "
        "returns are from pictures of MuJoCo before 3.12, which drew floors in another way.",
    )


def conditions_table(experiment: Experiment) -> Table:
    """
    :param experiment: An experiment
    :return: Under which conditions each curve was obtained; seeds of an arm that had the same ones share a row
    """
    letters: dict[str, str] = {}
    rows: dict[tuple[str, ...], list[CellResult]] = {}
    commits: dict[tuple[str, int], set[str]] = {}
    for cell in experiment.cells.values():
        if not cell.done:
            continue
        versions = cell.run.get("versions")
        packages = ", ".join(f"{name} {number}" for name, number in versions.items()) if versions else ""
        letter = letters.setdefault(packages, _letters(len(letters))) if packages else NONE
        conditions = [str(cell.run.get(key) or NONE) for key in ("device", "precision", "machine")]
        conditions += [_commits(cell.run), str(cell.run.get("attempts") or NONE)]
        key = (cell.task, cell.method, _steps(cell), _pretraining(cell), *conditions[:3], letter, *conditions[3:])
        rows.setdefault(key, []).append(cell)
        commits.setdefault((cell.task, cell.seed), set()).add(conditions[3])
    shown = []
    for alike, cells in rows.items():
        task, method, steps, pretraining, *conditions = alike
        seeds = ", ".join(str(cell.seed) for cell in cells)
        times = ", ".join(_duration(cell.run.get("seconds")) for cell in cells)
        shown.append([task, method, seeds, steps, pretraining, times, *conditions])
    note = " ".join(f"Versions {letter}: {packages}." for packages, letter in letters.items())
    mixed = sorted(f"{task} seed {seed}" for (task, seed), found in commits.items() if len(found) > 1)
    if mixed:
        note += f" Arms of one seed that were run at different commits: {', '.join(mixed)}."
    columns = ["task", "arm", "seeds", ">environment steps", ">pretraining steps", ">wall-clock", "device", "precision"]
    return Table("Run conditions", [*columns, "machine", "versions", "commit", ">attempts"], shown, note)


def _commits(run: Mapping[str, Any]) -> str:
    """Of all attempts at a cell, and of what measured it in the end."""
    attempts = [each.get("commit") or "unknown" for each in run.get("history", ())]
    return _list([*attempts, run.get("commit")])


def _letters(index: int) -> str:
    return chr(ord("A") + index) if index < 26 else f"Z{index - 25}"


def _steps(cell: CellResult) -> str:
    steps, _ = cell.curve("environment_steps")
    return number_text(float(steps[-1])) if len(steps) else NONE


def _pretraining(cell: CellResult) -> str:
    phase = cell.config.get("pretrain")
    return f"{number_text(phase['budget'])} ({phase['collector']})" if phase else NONE
