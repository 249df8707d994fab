"""Published numbers (``published.json``, each with its source), and results beside them. Anchors, not gates."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import NamedTuple

import numpy as np

from sb3_cure.experiments.results import Experiment
from sb3_cure.experiments.statistics import stack_curves

#: Below this part of a published mean, a return is suspected to be a bug of ours.
SUSPECT_BELOW = 0.75
#: What uniform dither of 1/32 adds to a mean squared error: the least that RAE's *training* loss can be. The error that
#: sb3_cure measures is against the dither's mean, so it is the excess over this floor already.
DITHER_FLOOR = (1 / 32) ** 2 / 12


class MeanStd(NamedTuple):
    """A published value.

    :param mean: Mean over seeds
    :param std: Standard deviation over seeds, None where none is published
    """

    mean: float
    std: float | None = None


class MinMeanMax(NamedTuple):
    """SRL error per step met by a policy.

    :param min: Smallest of all steps
    :param mean: Mean over them
    :param max: Largest of all steps
    """

    min: float
    mean: float
    max: float


_NUMBERS = json.loads((files(__package__) / "published.json").read_text(encoding="utf-8"))
PAPER: str = _NUMBERS["paper"]
SOURCES: dict[str, str] = {method: entry["source"] for method, entry in _NUMBERS["returns"].items()}
#: Episode returns: method -> environment steps -> task (domain_task)
RETURNS: dict[str, dict[int, dict[str, MeanStd]]] = {
    method: {
        int(steps): {task: MeanStd(*value) for task, value in tasks.items()} for steps, tasks in entry["steps"].items()
    }
    for method, entry in _NUMBERS["returns"].items()
}
#: Returns after pretraining of sac_ae: arm -> task; PAPER, Table I. The steps of training are not stated there.
#: "ball_in_cup" and "finger_turn" are taken for ball_in_cup_catch and finger_turn_easy, the suite's tasks of that name.
PRETRAINING: dict[str, dict[str, MeanStd]] = {
    arm: {task: MeanStd(*value) for task, value in tasks.items()} for arm, tasks in _NUMBERS["pretraining"].items()
}
#: SRL error per step: task -> policy; PAPER, last table of the appendix.
SRL_ERROR: dict[str, dict[str, MinMeanMax]] = {
    task: {actor: MinMeanMax(*value) for actor, value in actors.items()}
    for task, actors in _NUMBERS["srl_error"].items()
}

#: What makes a method, beside its head: the published settings
SETTINGS = {
    "batch_size": 128,
    "gamma": 0.99,
    "learning_rate": 1e-3,
    "tau": 0.01,
    "encoder_tau": 0.05,
    "target_update_interval": 2,
    "actor_update_interval": 2,
    "ent_coef": "auto_0.1",
    "train_freq": 1,
    "gradient_steps": -1,
    "srl_schedule": "simultaneous",
    "learning_starts": 1000,
    "policy_kwargs": {"net_arch": [1024, 1024]},
}
#: Updates after the warm-up by published method
WARMUP_UPDATES = {"SAC-AE": 1000, "CURL": 0}
#: What an arm may choose without becoming another method; its head, augmentation and curiosity are looked at
FREE = {
    *("policy", "srl", "srl_kwargs", "augmentation", "augmentation_kwargs", "curiosity"),
    *("buffer_size", "replay_buffer_kwargs", "precision", "update", "overlap", "device", "verbose"),
}


def task_key(task: str) -> str:
    """
    :param task: A task as results name it (``"cartpole-swingup"``, ``"finger-turn_easy"``)
    :return: As the tables above name it (``"cartpole_swingup"``, ``"finger_turn_easy"``)
    """
    return task.replace("-", "_")


def published_method(config: dict) -> tuple[str | None, bool]:
    """Which published method an arm is.

    :param config: Its ``config.json``
    :return: The method that it is or builds upon, None for a head without published numbers; and whether it is that
        method, in its settings and without curiosity
    """
    arguments = config.get("arguments", {})
    base = {"rae": "SAC-AE", "curl": "CURL"}.get(str(arguments.get("srl", "rae")))
    head = dict(arguments.get("srl_kwargs", {}))
    augmentation = arguments.get("augmentation") or head.pop("augmentation", "none")
    usual = ("crop",) if base == "CURL" else ("none", "auto")  # auto: what the head asks for, nothing with "rae"
    settings = {**SETTINGS, "warmup_updates": WARMUP_UPDATES.get(str(base))}
    is_usual = augmentation in usual and all(key in FREE or settings.get(key) == arguments[key] for key in arguments)
    is_plain = config.get("algo", "cure_sac") == "cure_sac" and arguments.get("curiosity", "separate") is None
    return base, is_usual and is_plain and not head


@dataclass(frozen=True)
class Comparison:
    """An arm beside a published number at the same environment steps.

    :param experiment: Name of the experiment
    :param task: As of ``task_key``
    :param method: Name of the arm
    :param steps: Environment steps
    :param seeds: Number of seeds that have got there
    :param ours: Mean return of the seeds at that step
    :param std: Standard deviation over seeds; nan with one
    :param theirs: The published value of the method that the arm is, or builds upon; None if there is none
    :param published_as: Name of that method
    :param same_method: Whether the arm is that method, rather than adding curiosity to it or changing its settings
    """

    experiment: str
    task: str
    method: str
    steps: int
    seeds: int
    ours: float
    std: float
    theirs: MeanStd | None
    published_as: str
    same_method: bool

    @property
    def suspect(self) -> bool:
        """Whether the return is so far below the published one that a bug of ours is suspected."""
        return self.same_method and self.theirs is not None and self.ours < SUSPECT_BELOW * self.theirs.mean


def compare_with_published(experiments: Sequence[Experiment]) -> list[Comparison]:
    """
    :param experiments: Experiments; those about visitation have no returns to compare
    :return: Every arm at every published step that its curves reach, of those that see the published pixels
    """
    rows = []
    arms = [
        (experiment, task, method)
        for experiment in experiments
        if experiment.kind != "visitation"
        for task in experiment.tasks
        for method in experiment.methods
    ]
    for experiment, task, method in arms:
        cells = [cell for cell in experiment.done(task, method).values() if len(cell.curve()[0]) > 1]
        if not cells or cells[0].config.get("pretrain") or not all(cell.sees_published_pixels for cell in cells):
            continue
        base, same_method = published_method(cells[0].config)
        if base is None:
            continue
        steps, stacked = stack_curves(cells)
        for at, table in RETURNS[base].items() if len(steps) > 1 else ():
            # An agent step may be worth up to 8 environment steps, in several environments at once.
            if steps[-1] >= 0.99 * at:
                values = np.array([np.interp(at, steps, curve) for curve in stacked])
                std = float(values.std(ddof=1)) if len(values) > 1 else float("nan")
                ours = (len(cells), float(values.mean()), std)
                theirs = table.get(task_key(task))
                rows.append(Comparison(experiment.name, task, method, at, *ours, theirs, base, same_method))
    return rows
