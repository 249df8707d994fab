"""Tables of reports: statistics in words and numbers. How they look, and what is said about them, is in templates."""

import base64
import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jinja2
import numpy as np
import pandas as pd

from sb3_cure.experiments import published, statistics
from sb3_cure.experiments.results import NOT_RUN, CellResult, Experiment
from sb3_cure.experiments.statistics import Estimate, PairedDifference
from sb3_cure.experiments.visit_statistics import GRID_INTERVALS, Coverage, ErrorSummary

NONE = "\N{EN DASH}"
_RATIOS = (">/ random's [95 %]", ">/ baseline's task policy's [95 %]")


@dataclass(frozen=True)
class Table:
    """A table of a report.

    :param title: Heading
    :param rows: Plain text; columns that begin with ``>`` hold numbers and are aligned to the right
    :param note: What to know when reading it
    """

    title: str
    rows: pd.DataFrame
    note: str = ""

    def markdown(self) -> str:
        """
        :return: Title, table and note in Markdown
        """
        return render("table.md.j2", table=self)


def _table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]], note: str = "") -> Table:
    return Table(title, pd.DataFrame(rows, columns=list(columns), dtype=object), note)


# Templates


def markdown_text(text: str) -> str:
    """
    :param text: Plain text
    :return: The same in Markdown: nothing of it ends a cell of a table, or becomes HTML, a link or a picture
    """
    text = re.sub(r"([\\`*_{}\[\]|!#~])", r"\\\1", " ".join(str(text).split()))
    return text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")


_TEMPLATES = jinja2.Environment(
    loader=jinja2.PackageLoader("sb3_cure.experiments"),
    autoescape=lambda name: name is not None and ".html" in name,
    undefined=jinja2.StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
    keep_trailing_newline=True,
)
_TEMPLATES.filters |= {
    "md": markdown_text,
    "heading": lambda name: name.removeprefix(">"),
    "json": lambda value: json.dumps(value, indent=2, ensure_ascii=False),
    "base64": lambda content: base64.b64encode(content).decode(),
}


def render(template: str, **facts: Any) -> str:
    """
    :param template: A file in ``templates``
    :param facts: What it shows
    :return: Its text
    """
    return _TEMPLATES.get_template(template).render(**facts)


def words(name: str, *facts: Any) -> str:
    """
    :param name: A macro of ``templates/words.j2``
    :param facts: Its arguments
    :return: What it says, in one line
    """
    return " ".join(str(getattr(_TEMPLATES.get_template("words.j2").module, name)(*facts)).split())


# Numbers in words


def number_text(value: float, digits: int = 0) -> str:
    """
    :param value: A number
    :param digits: Behind the point
    :return: With a true minus sign; a dash for what is not finite
    """
    if not math.isfinite(value):
        return NONE
    return f"{round(value, digits) + 0.0:,.{digits}f}".replace("-", "\N{MINUS SIGN}")


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
    std = f" ± {number_text(float(values.std(ddof=1)), digits)}" if len(values) > 1 else ""
    return f"{number_text(float(values.mean()), digits)}{std}" if len(values) else ""


def interval_text(estimate: Estimate, digits: int = 0) -> str:
    """
    :param estimate: A number
    :param digits: Behind the point
    :return: Its interval, or why there is none
    """
    if estimate.low is None or estimate.high is None:
        return "one seed: no interval" if estimate.n else NONE
    return f"[{number_text(estimate.low, digits)}, {number_text(estimate.high, digits)}]"


def _value_and_interval(estimate: Estimate, digits: int) -> tuple[str, str]:
    return number_text(estimate.value, digits), interval_text(estimate, digits)


def ratio_text(estimate: Estimate) -> str:
    """
    :param estimate: A ratio
    :return: It and its interval
    """
    shown = "(one seed)" if estimate.low is None else interval_text(estimate, 2)
    return f"{number_text(estimate.value, 2)} {shown}" if math.isfinite(estimate.value) else NONE


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


def _list(values: Iterable[Any]) -> str:
    return ", ".join(dict.fromkeys(str(value) for value in values if value not in (None, ""))) or NONE


def _duration(seconds: Any) -> str:
    if not isinstance(seconds, int | float):
        return NONE
    if seconds < 60:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 3600 else f"{seconds / 3600:.1f} h"


# Tables


def _arms(experiment: Experiment) -> list[tuple[str, str]]:
    return [(task, method) for task in experiment.tasks for method in experiment.methods]


def status_table(experiment: Experiment) -> Table:
    """
    :param experiment: An experiment
    :return: Which cells are done
    """
    rows = [[task, *(_state(experiment, task, method) for method in experiment.methods)] for task in experiment.tasks]
    return _table("Cells", ["task", *experiment.methods], rows, words("cells"))


def _state(experiment: Experiment, task: str, method: str) -> str:
    """Seeds of an arm by the status of their cells."""
    seeds: dict[str, list[str]] = {}
    for seed, cell in experiment.of_arm(task, method).items():
        seeds.setdefault(cell.status, []).append(str(seed))
    if set(seeds) <= {NOT_RUN}:
        return NOT_RUN
    return "; ".join(f"{status}: {', '.join(found)}" for status, found in seeds.items())


def curves_table(experiment: Experiment, thresholds: Sequence[float]) -> Table:
    """
    :param experiment: An experiment
    :param thresholds: Returns, for the steps to reach them
    :return: Area under the curve, final return, spread over seeds, steps to thresholds
    """
    columns = ["task", "arm", ">seeds", ">area under curve", ">final return", ">IQR, final", ">IQR, curve"]
    columns += [f">steps to {limit:,.15g}".replace("-", "\N{MINUS SIGN}") for limit in thresholds]
    rows = []
    for task, method in _arms(experiment):
        digits = return_digits(experiment, task)
        arm = statistics.summarise_arm(experiment, task, method, thresholds)
        row = [_mean_std(values, digits) or _state(experiment, task, method) for values in (arm.areas, arm.finals)]
        spreads = statistics.interquartile_range(arm.finals), arm.curve_iqr
        row += [number_text(spread, digits) for spread in spreads]
        row += [_reached(arm.reached[limit], experiment.budget) for limit in thresholds]
        rows.append([task, method, str(len(arm.seeds)), *row])
    return _table("Learning curves", columns, rows, words("curves"))


def _reached(steps: np.ndarray, budget: int) -> str:
    count = int(np.isfinite(steps).sum())
    if not count:
        return "not reached" if len(steps) else NONE
    median = float(np.median(steps))
    shown = number_text(median) if np.isfinite(median) else f"> {number_text(budget)}"
    return f"{shown} ({count} of {len(steps)})"


def difference_table(
    experiment: Experiment,
    rows: Sequence[PairedDifference],
    measure: str = "area under the curve",
    note: str | None = None,
    compared: str | None = None,
) -> Table:
    """
    :param experiment: An experiment
    :param rows: Its paired differences
    :param measure: Of what
    :param note: What to know about them, by default everything
    :param compared: From which arm: by default the baseline; each row of another one names it
    :return: The differences with both intervals
    """
    columns = "arm; task; >pairs; >same start; >difference; >95 % t; >95 % percentile; >above; verdict".split("; ")
    shown = []
    for row in rows:
        digits = difference_digits(row, experiment)
        label = difference_label(row, None if compared else experiment.baseline)
        numbers = [str(row.pairs), str(row.same_starts), *_value_and_interval(row.t, digits)]
        numbers += [interval_text(row.percentile, digits), str(row.wins)]
        shown.append([label, of_tasks(row), *numbers, row.t.verdict])
    title = f"Paired difference {compared or f'from {compared_with(rows, experiment)}'}: {measure}"
    return _table(title, columns, shown, words("differences") if note is None else note)


def difference_label(row: PairedDifference, baseline: str | None) -> str:
    """
    :param row: A paired difference
    :param baseline: What goes without saying
    :return: The arm, and what it is compared with if that is another than the baseline
    """
    return row.method if row.other == baseline else f"{row.method} minus {row.other}"


def compared_with(rows: Sequence[PairedDifference], experiment: Experiment) -> str:
    """
    :param rows: Paired differences, each with its ``difference_label``
    :param experiment: Of which experiment
    :return: The baseline, and where to find the others
    """
    has_others = any(row.other != experiment.baseline for row in rows)
    return experiment.baseline + (', or the arm after "minus"' if has_others else "")


def difference_digits(row: PairedDifference, experiment: Experiment) -> int:
    """
    :param row: A paired difference in return
    :param experiment: Of which experiment
    :return: How many digits behind the point it needs, at least one
    """
    return max(1, return_digits(experiment, row.task))


def of_tasks(row: PairedDifference) -> str:
    """
    :param row: A paired difference
    :return: Of which task, or of how many
    """
    left_out = f" (left out, with a single pair: {', '.join(row.left_out)})" if row.left_out else ""
    return row.task or plural(len(row.differences), "task") + left_out


def aggregate_table(experiment: Experiment, found: statistics.Aggregates) -> Table:
    """
    :param experiment: An experiment
    :param found: Its aggregates
    :return: Interquartile means and probabilities of improvement
    """
    varied = any(experiment.baseline_of(method) != experiment.baseline for method in found.improvement)
    better = {method: found.improvement.get(method, Estimate(math.nan)) for method in found.iqm}
    columns = ["arm", ">IQM", ">95 %", f">P(arm > {'its baseline' if varied else experiment.baseline})", ">95 %"]
    rows = [
        [method, *_value_and_interval(iqm, 3), *_value_and_interval(better[method], 2)]
        for method, iqm in found.iqm.items()
    ]
    note = words("aggregates", found, statistics.HIGHEST_RETURN, _baselines(experiment) if varied else "")
    return _table("Aggregates over tasks (rliable)", columns, rows, note)


def error_table(experiment: Experiment, summaries: Sequence[ErrorSummary]) -> Table:
    """
    :param experiment: An experiment
    :param summaries: What its policies meet
    :return: SRL error by policy and head, beside the paper's
    """
    compares, rows = experiment.sees_published_pixels, []
    for row in summaries:
        theirs = published.SRL_ERROR.get(published.task_key(row.task), {}).get(row.actor)
        shown = " / ".join(f"{value:.4f}" for value in theirs) if theirs and compares and row.head == "own" else NONE
        errors = [f"{value:.2e}" for value in (row.error_min, row.mean, row.error_max)]
        policy = [row.task, row.method, row.head.replace("_", " "), row.actor, str(len(row.values))]
        rows.append([*policy, *errors, ratio_text(row.ratio), ratio_text(row.task_ratio), shown])
    columns = ["task", "arm", "head", "actor", ">seeds", ">min", ">mean", ">max", *_RATIOS, ">paper"]
    return _table("SRL error per step", columns, rows, words("errors", published, _baselines(experiment), compares))


def _baselines(experiment: Experiment) -> str:
    own = [name for name in experiment.methods if experiment.baseline_of(name) != experiment.baseline]
    return _list([experiment.baseline, *(f"of {name} {experiment.baseline_of(name)}" for name in own)])


def coverage_table(experiment: Experiment, rows: Sequence[Coverage]) -> Table:
    """
    :param experiment: An experiment
    :param rows: Coverage by actor
    :return: Occupied cells and entropy
    """
    columns = ["task", "arm", "actor", ">seeds", ">states", ">occupied cells", *_RATIOS, ">entropy, bits"]
    shown = []
    for row in rows:
        numbers = [str(len(row.values)), number_text(row.steps), _mean_std(row.values), ratio_text(row.ratio)]
        numbers += [ratio_text(row.task_ratio), number_text(float(row.entropy.mean()), 2)]
        shown.append([row.task, row.method, row.actor, *numbers])
    dimensions = _list(f"{row.task}: {row.dimensions}" for row in rows)
    note = words("coverage", dimensions, GRID_INTERVALS, _baselines(experiment))
    return _table("Coverage of the true state space", columns, shown, note)


def cells_reached_table(
    experiment: Experiment, curves: Mapping[str, Mapping[str, tuple[np.ndarray, np.ndarray]]]
) -> Table:
    """
    :param experiment: An experiment
    :param curves: By task and arm: environment steps [n], and cells reached until then [seeds, n]
    :return: Cells at these steps, and how many of the baseline's in the end
    """
    steps = next(iter(next(iter(curves.values())).values()))[0]
    columns = ["task", "arm", ">seeds", *(f">at {number_text(step)}" for step in steps), ">/ baseline"]
    shown = []
    for task, arms in curves.items():
        for method, (_, cells) in arms.items():
            ratio = NONE
            if method != experiment.baseline_of(method):
                ratio = ratio_text(statistics.cells_ratio(experiment, task, method))
            shown.append([task, method, str(len(cells)), *map(_mean_std, cells.T), ratio])
    return _table("Cells of the true state", columns, shown, words("cells_note", _baselines(experiment)))


def rewards_met_table(experiment: Experiment) -> Table:
    """
    :param experiment: An experiment
    :return: Rewards that training met, and their logarithm beside the baseline's; no row where they were not recorded
        or are negative
    """
    shown = []
    for task, method in _arms(experiment):
        met = np.array(list(statistics.final_values(experiment, task, method, "rewards_met").values()))
        if len(met) and (met >= 0).all():
            against = statistics.rewards_met_difference(experiment, task, method)
            text = NONE if method == experiment.baseline_of(method) else ratio_text(against)
            logarithms = f"{np.log1p(met).mean():.2f}"
            shown.append([task, method, str(len(met)), _mean_std(met), logarithms, text])
    columns = ["task", "arm", ">seeds", ">rewards met, c", ">log(1 + c)", ">minus baseline's"]
    return _table("Rewards met in training", columns, shown, words("rewards_met", _baselines(experiment)))


def pretraining_table(experiment: Experiment) -> Table:
    """
    :param experiment: An experiment of kind ``"pretraining"``
    :return: Final returns beside the paper's
    """
    rows, compares = [], experiment.sees_published_pixels
    for task, method in _arms(experiment):
        finals = statistics.summarise_arm(experiment, task, method).finals
        papers = published.PRETRAINING.get(method.lower().replace("-", "_"), {}) if compares else {}
        theirs = papers.get(published.task_key(task))
        difference = number_text(float(finals.mean()) - theirs.mean) if len(finals) and theirs else NONE
        ours = _mean_std(finals, return_digits(experiment, task)) or _state(experiment, task, method)
        rows.append([task, method, str(len(finals)), ours, _published(theirs), difference])
    columns = ["task", "arm", ">seeds", ">ours", ">paper", ">difference"]
    note = words("pretraining", published.PAPER, experiment.budget, compares)
    return _table("Final return after pretraining, beside the paper's", columns, rows, note)


def published_table(comparisons: Sequence[published.Comparison]) -> Table:
    """
    :param comparisons: Arms beside published numbers
    :return: Ours, theirs, difference
    """
    rows = []
    for row in comparisons:
        others = [
            f"{name} {_published(value)}"
            for name, tables in published.RETURNS.items()
            if name != row.published_as and (value := tables[row.steps].get(published.task_key(row.task)))
        ]
        ours = number_text(row.ours) + (f" ± {number_text(row.std)}" if math.isfinite(row.std) else "")
        beside = [NONE, NONE, NONE]
        if row.theirs is not None:
            beside = [f"{row.published_as} {_published(row.theirs)}", number_text(row.ours - row.theirs.mean)]
            beside.append(f"{row.ours / row.theirs.mean:.3f}")
        run = [row.experiment, row.task, row.method, number_text(row.steps), str(row.seeds), ours]
        rows.append([*run, *beside, words("judgement", row, published.SUSPECT_BELOW), "; ".join(others) or NONE])
    columns = ["experiment", "task", "arm", ">steps", ">seeds", ">ours", ">theirs", ">difference", ">ratio"]
    note = words("beside_published", published)
    return _table("Beside published returns", [*columns, "judgement", "other methods"], rows, note)


def conditions_table(experiment: Experiment) -> Table:
    """
    :param experiment: An experiment
    :return: Under which conditions each curve was obtained; seeds of an arm that had the same ones share a row
    """
    letters: dict[str, str] = {}
    rows = []
    for cell in experiment.finished:
        packages = ", ".join(f"{name} {number}" for name, number in (cell.run.get("versions") or {}).items())
        letter = letters.setdefault(packages, chr(ord("A") + len(letters))) if packages else NONE
        steps, phase = cell.curve("environment_steps")[0], cell.config.get("pretrain")
        trained = number_text(float(steps[-1])) if len(steps) else NONE
        pretrained = f"{number_text(phase['budget'])} ({phase['collector']})" if phase else NONE
        seconds, machine = cell.run.get("seconds"), [_told(cell, key) for key in ("device", "precision", "machine")]
        row = [cell.task, cell.method, str(cell.seed), trained, pretrained, _duration(seconds), *machine, letter]
        rows.append([*row, _commits(cell), _told(cell, "attempts")])
    columns = "task; arm; seeds; >environment steps; >pretraining steps; >wall-clock; device; precision; machine"
    frame = _table("", [*columns.split("; "), "versions", "commit", ">attempts"], rows).rows
    commits = frame.groupby(["task", "seeds"], sort=False).commit.nunique()
    mixed = sorted(f"{task} seed {seed}" for (task, seed), count in commits.items() if count > 1)
    own = ["seeds", ">wall-clock"]
    alike = frame.groupby([name for name in frame if name not in own], sort=False)
    merged = alike[own].agg(", ".join).reset_index()[list(frame)]
    return Table("Run conditions", merged, words("conditions", letters, mixed))


def _told(cell: CellResult, key: str) -> str:
    return str(cell.run.get(key) or NONE)


def _commits(cell: CellResult) -> str:
    """Of all attempts at a cell, and of what measured it in the end."""
    attempts: Sequence[Mapping[str, Any]] = cell.run.get("history", ())
    return _list([*(each.get("commit") or "unknown" for each in attempts), cell.run.get("commit")])
