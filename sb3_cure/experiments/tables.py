"""Tables of reports. Their notes, and how they look, are in templates."""

import base64
import itertools
import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jinja2
import numpy as np
import pandas as pd

from sb3_cure.cli.progress import time_text
from sb3_cure.experiments import statistics
from sb3_cure.experiments.results import NOT_RUN, CellResult, Experiment
from sb3_cure.experiments.statistics import Curves, Estimate, PairedDifference
from sb3_cure.experiments.visit_statistics import GRID_INTERVALS, ErrorSummary, Occupancy

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
        """Title, table and note in Markdown.

        :return: The text
        """
        return render("table.md.j2", table=self)


def _table(title: str, columns: str, rows: Sequence[Sequence[str]], note: str = "") -> Table:
    return Table(title, pd.DataFrame(rows, columns=columns.split("; "), dtype=object), note)


# Templates


def plural(count: int, noun: str) -> str:
    """Count and noun: ``"1 seed"``, ``"2 seeds"``.

    :param count: Number of things
    :param noun: In the singular
    :return: The text
    """
    return f"{count} {noun}{'' if count == 1 else 's'}"


def markdown_text(text: str) -> str:
    """Escape plain text for Markdown: nothing of it ends a cell of a table, or becomes HTML, a link or a picture.

    :param text: Plain text
    :return: Markdown
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
    "plural": plural,
    "heading": lambda name: name.removeprefix(">"),
    "json": lambda value: json.dumps(value, indent=2, ensure_ascii=False),
    "base64": lambda content: base64.b64encode(content).decode(),
}


def render(template: str, **facts: Any) -> str:
    """Render a file of ``templates``.

    :param template: Its name
    :param facts: Its variables
    :return: Its text
    """
    return _TEMPLATES.get_template(template).render(**facts)


def render_text(name: str, *facts: Any) -> str:
    """Render a macro of ``templates/words.j2`` in one line.

    :param name: Name of the macro
    :param facts: Its arguments
    :return: Its text
    """
    return " ".join(str(getattr(_TEMPLATES.get_template("words.j2").module, name)(*facts)).split())


# Numbers as text


def number_text(value: float, digits: int = 0) -> str:
    """Format a number with a true minus sign; a dash for one that is not finite.

    :param value: A number
    :param digits: Digits after the point
    :return: Its text
    """
    if not math.isfinite(value):
        return NONE
    return f"{value:z,.{digits}f}".replace("-", "\N{MINUS SIGN}")


def return_digits(experiment: Experiment, task: str) -> int:
    """Decimal places that returns need: none from 10 on, else three significant ones.

    :param experiment: An experiment
    :param task: Short name of a task
    :return: Number of digits
    """
    cells = [cell for cell in experiment.cells.values() if cell.task == task]
    return _digits(max((float(np.abs(cell.curve()[1]).max(initial=0)) for cell in cells), default=0.0))


def _digits(value: float) -> int:
    return 2 - math.floor(math.log10(value)) if 0 < value < 10 else 0


def mean_std_text(values: np.ndarray, digits: int = 0) -> str:
    """Format a mean and, of several values, their standard deviation (n - 1).

    :param values: [n]
    :param digits: Digits after the point
    :return: The text; of no values ``""``
    """
    std = f" ± {number_text(float(values.std(ddof=1)), digits)}" if len(values) > 1 else ""
    return f"{number_text(float(values.mean()), digits)}{std}" if len(values) else ""


def interval_text(estimate: Estimate, digits: int = 0) -> str:
    """Format an interval, or say why there is none.

    :param estimate: A number
    :param digits: Digits after the point
    :return: The text
    """
    if estimate.low is None or estimate.high is None:
        return "one seed: no interval" if estimate.n else NONE
    return f"[{number_text(estimate.low, digits)}, {number_text(estimate.high, digits)}]"


def value_and_interval(estimate: Estimate) -> str:
    """Format a number and its interval.

    :param estimate: A ratio, or a difference of logarithms
    :return: The text
    """
    shown = "(one seed)" if estimate.low is None else interval_text(estimate, 2)
    return f"{number_text(estimate.value, 2)} {shown}" if math.isfinite(estimate.value) else NONE


def _joined(values: Iterable[Any]) -> str:
    return ", ".join(dict.fromkeys(str(value) for value in values if value not in (None, ""))) or NONE


# Tables


def status_table(experiment: Experiment) -> Table:
    """Which cells are done.

    :param experiment: An experiment
    :return: The table
    """
    rows = [[task, *(_state(experiment, task, method) for method in experiment.methods)] for task in experiment.tasks]
    return Table("Cells", pd.DataFrame(rows, columns=["task", *experiment.methods]), render_text("cells"))


def _state(experiment: Experiment, task: str, method: str) -> str:
    """Seeds of an arm by the status of their cells."""
    seeds: dict[str, list[str]] = {}
    for seed, cell in experiment.of_arm(task, method).items():
        seeds.setdefault(cell.status, []).append(str(seed))
    if set(seeds) <= {NOT_RUN}:
        return NOT_RUN
    return "; ".join(f"{status}: {', '.join(found)}" for status, found in seeds.items())


def curves_table(experiment: Experiment) -> Table:
    """Area under the curve and final return; of arms without returns, such as those without a task, a dash.

    :param experiment: An experiment
    :return: The table
    """
    rows = []
    for task, method in experiment.arms:
        digits, arm = return_digits(experiment, task), statistics.summarise_arm(experiment, task, method)
        missing = NONE if experiment.finished_cells(task, method) else _state(experiment, task, method)
        row = [mean_std_text(arm[measure].to_numpy(), digits) or missing for measure in ("area", "final")]
        rows.append([task, method, str(len(arm)), *row])
    return _table("Learning curves", "task; arm; >seeds; >area under curve; >final return", rows, render_text("curves"))


def measured_table(title: str, measured: Mapping[str, Curves], note: str) -> Table:
    """What was measured at a few steps.

    :param title: Its heading
    :param measured: By measure
    :param note: What to know when reading it
    :return: The table
    """
    rows = {}
    for measure, tasks in measured.items():
        for task, arms in tasks.items():
            for method, (steps, values) in arms.items():
                texts = [mean_std_text(each, _digits(abs(each.mean()))) for each in values.T]
                rows[measure, task, method, str(len(values))] = dict(zip(steps, texts, strict=True))
    numbers = pd.DataFrame(list(rows.values())).sort_index(axis=1).fillna(NONE)
    numbers.columns = [f">at {number_text(step)}" for step in numbers]
    names = pd.DataFrame(list(rows), columns=["measure", "task", "arm", ">seeds"])
    return Table(title, names.join(numbers), note)


def reached_table(experiment: Experiment, thresholds: Sequence[float]) -> Table:
    """How many seeds reach and solve returns, and the steps until then.

    :param experiment: An experiment
    :param thresholds: Returns
    :return: The table; without rows for a return that no arm reaches on a task
    """
    rows = []
    lasts = {arm: statistics.summarise_arm(experiment, *arm)["last"] for arm in experiment.arms}
    for task, limit in itertools.product(experiment.tasks, thresholds):
        arms = {arm: statistics.steps_to_return(experiment, task, arm, limit) for arm in experiment.methods}
        if not any(np.isfinite(steps).any() for steps in arms.values()):
            continue
        for method, steps in arms.items():
            if n := len(steps):
                counts = [f"{int(found.sum())} of {n}" for found in (np.isfinite(steps), lasts[task, method] >= limit)]
                median, shown = float(np.median(steps)), f"{limit:,.15g}".replace("-", "\N{MINUS SIGN}")
                until = number_text(median) if np.isfinite(median) else f"> {number_text(experiment.budget)}"
                # Unlike a median it uses all seeds, and unlike a mean of those that got there it favours no arm
                restricted = number_text(float(np.minimum(steps, experiment.budget).mean()))
                rows.append([task, shown, method, *counts, until, restricted])
    columns = "task; >return; arm; >reached; >solved; >steps, median; >steps, restricted mean"
    return _table("Returns reached", columns, rows, render_text("reached"))


def difference_table(
    experiment: Experiment,
    rows: Sequence[PairedDifference],
    measure: str = "area under the curve",
    note: str | None = None,
) -> Table:
    """Paired differences with their intervals.

    :param experiment: An experiment
    :param rows: Its paired differences
    :param measure: Of what
    :param note: What to know about them, by default everything
    :return: The table
    """
    columns = "arm; task; >pairs; >same start; >difference; >95 % t; >above; >p; >p, Holm; verdict"
    shown = []
    ps = [row.p for row in rows]
    for row, p, corrected in zip(rows, ps, statistics.holm(ps), strict=True):
        digits = difference_digits(row, experiment)
        numbers = [str(row.pairs), str(row.same_starts), number_text(row.t.value, digits), interval_text(row.t, digits)]
        numbers += [str(row.wins), _p_text(p), _p_text(corrected)]
        shown.append([difference_label(row, experiment.baseline), row.task, *numbers, row.t.verdict])
    title = f"Paired difference from {compared_with(rows, experiment)}: {measure}"
    return _table(title, columns, shown, render_text("differences") if note is None else note)


def _p_text(p: float) -> str:
    return f"{p:.3f}" if p >= 0.001 else f"{p:.1e}"


def difference_label(row: PairedDifference, baseline: str) -> str:
    """The arm, and the arm that it is compared with unless that is the baseline.

    :param row: A paired difference
    :param baseline: The arm that needs no name
    :return: The label
    """
    return row.method if row.other == baseline else f"{row.method} minus {row.other}"


def compared_with(rows: Sequence[PairedDifference], experiment: Experiment) -> str:
    """The baseline, and where to find the others.

    :param rows: Paired differences, each with its ``difference_label``
    :param experiment: Of which experiment
    :return: The text
    """
    has_others = any(row.other != experiment.baseline for row in rows)
    return experiment.baseline + (', or the arm after "minus"' if has_others else "")


def difference_digits(row: PairedDifference, experiment: Experiment) -> int:
    """Decimal places that a difference in return needs, at least one.

    :param row: A paired difference
    :param experiment: Of which experiment
    :return: Number of digits
    """
    return max(1, return_digits(experiment, row.task))


def error_table(experiment: Experiment, summaries: Sequence[ErrorSummary]) -> Table:
    """SRL error by policy and head.

    :param experiment: An experiment
    :param summaries: SRL errors that its policies meet
    :return: The table
    """
    rows = []
    for row in summaries:
        policy = [row.task, row.method, row.head.replace("_", " "), row.actor, str(len(row.values))]
        errors = [f"{value:.2e}" for value in (row.error_min, row.mean, row.error_max)]
        rows.append([*policy, *errors, value_and_interval(row.ratio), value_and_interval(row.task_ratio)])
    columns = "; ".join(["task; arm; head; actor; >seeds; >min; >mean; >max", *_RATIOS])
    return _table("SRL error per step", columns, rows, render_text("errors", _baselines(experiment)))


def _baselines(experiment: Experiment) -> str:
    own = [name for name in experiment.methods if experiment.baseline_of(name) != experiment.baseline]
    return _joined([experiment.baseline, *(f"of {name} {experiment.baseline_of(name)}" for name in own)])


def coverage_table(experiment: Experiment, rows: Sequence[Occupancy]) -> Table:
    """Occupied cells.

    :param experiment: An experiment
    :param rows: Coverage by actor
    :return: The table
    """
    shown = []
    for row in rows:
        numbers = [
            str(len(row.values)),
            number_text(row.steps),
            mean_std_text(row.values),
            value_and_interval(row.ratio),
        ]
        shown.append([row.task, row.method, row.actor, *numbers, value_and_interval(row.task_ratio)])
    columns = "; ".join(["task; arm; actor; >seeds; >states; >occupied cells", *_RATIOS])
    dimensions = _joined(f"{row.task}: {row.dimensions}" for row in rows)
    note = render_text("coverage", dimensions, GRID_INTERVALS, _baselines(experiment))
    return _table("Coverage of the true state space", columns, shown, note)


def rewards_met_table(experiment: Experiment) -> Table:
    """Rewards that training met, and the difference of their logarithm from the baseline's.

    :param experiment: An experiment
    :return: The table; without a row where rewards were not recorded or are negative
    """

    def final(task: str, method: str, column: str) -> np.ndarray:
        return np.array(list(statistics.final_values(experiment, task, method, column).values()))

    def text(values: np.ndarray) -> str:
        return mean_std_text(values, _digits(float(values.sum()) / max(len(values), 1)))

    shown = []
    for task, method in experiment.arms:
        met = final(task, method, "rewards_met")
        if len(met) == 0 or (met < 0).any():
            continue
        parts = [final(task, method, f"rewards_met_{part}") for part in ("task", "curious", "late")]
        numbers = [text(met), *(text(part) or NONE for part in parts), f"{np.log1p(met).mean():.2f}"]
        difference = NONE
        if method != experiment.baseline_of(method):
            difference = value_and_interval(statistics.rewards_met_difference(experiment, task, method))
        shown.append([task, method, str(len(met)), *numbers, difference])
    columns = "task; arm; >seeds; >rewards met, c; >by task policy; >by second actor; >late; >log(1 + c)"
    columns += "; >minus baseline's"
    return _table("Rewards met in training", columns, shown, render_text("rewards_met", _baselines(experiment)))


def conditions_table(experiment: Experiment) -> Table:
    """Conditions of each curve; seeds of an arm that had the same ones share a row.

    :param experiment: An experiment
    :return: The table
    """
    letters: dict[str, str] = {}
    rows = []
    for cell in experiment.finished:
        run, phase, steps = cell.run, cell.config.get("pretrain"), cell.curve("environment_steps")[0]
        attempts: list[dict[str, Any]] = [*run.get("history", ()), run]
        versions = [each["versions"] for each in attempts if each.get("versions")]
        packages = [", ".join(f"{name} {number}" for name, number in each.items()) for each in versions]
        named = _joined(letters.setdefault(each, chr(ord("A") + len(letters))) for each in packages)
        trained = number_text(float(steps[-1])) if len(steps) else NONE
        pretrained = f"{number_text(phase['budget'])} ({phase['collector']})" if phase else NONE
        machine = [_joined(each.get(key) for each in attempts) for key in ("device", "precision", "machine")]
        times = [NONE if run.get(key) is None else time_text(run[key]) for key in ("seconds", "cpu_seconds")]
        row = [cell.task, cell.method, str(cell.seed), trained, pretrained, *times, *machine]
        rows.append([*row, named, _commits(cell), str(run.get("attempts") or NONE)])
    columns = (
        "task; arm; seeds; >environment steps; >pretraining steps; >wall-clock; >CPU time; device; precision; machine"
    )
    frame = _table("", columns + "; versions; commit; >attempts", rows).rows
    commits = frame.groupby(["task", "seeds"], sort=False).commit.nunique()
    mixed = sorted(f"{task} seed {seed}" for (task, seed), count in commits.items() if count > 1)
    own = ["seeds", ">wall-clock", ">CPU time"]
    alike = frame.groupby([name for name in frame if name not in own], sort=False)
    merged = alike[own].agg(", ".join).reset_index()[list(frame)]
    return Table("Run conditions", merged, render_text("conditions", letters, mixed))


def _commits(cell: CellResult) -> str:
    """Commits of all attempts at a cell, and of its last measurement."""
    attempts: Sequence[Mapping[str, Any]] = cell.run.get("history", ())
    return _joined([*(each.get("commit") or "unknown" for each in attempts), cell.run.get("commit")])
