"""Published numbers (``published.json``, each with its source), and results compared with them."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Any, NamedTuple

import numpy as np

from sb3_cure.experiments.results import Experiment
from sb3_cure.experiments.statistics import stack_curves

#: Below this part of a published mean, a return is suspected to be a bug of ours.
SUSPECT_BELOW = 0.75
#: Mean squared error that uniform dither of 1/32 adds, the least value of RAE's *training* loss. The measured SRL error
#: is against the dither's mean, so it is the excess over this floor already.
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


def _convert(numbers: dict[str, Any], kind: Callable[..., Any]) -> dict[Any, Any]:
    """Nested tables with rows of type ``kind``, and steps as integers."""
    keys = {name: int(name) if name.isdecimal() else name for name in numbers}
    return {
        keys[name]: kind(*value) if isinstance(value, list) else _convert(value, kind)
        for name, value in numbers.items()
    }


#: Episode returns: method -> environment steps -> task (domain_task)
RETURNS: dict[str, dict[int, dict[str, MeanStd]]] = {
    method: _convert(entry["steps"], MeanStd) for method, entry in _NUMBERS["returns"].items()
}
#: Returns after pretraining of sac_ae: arm -> task; PAPER, Table I. The steps of training are not stated there.
#: "ball_in_cup" and "finger_turn" are taken for ball_in_cup_catch and finger_turn_easy, the suite's tasks of that name.
PRETRAINING: dict[str, dict[str, MeanStd]] = _convert(_NUMBERS["pretraining"], MeanStd)
#: SRL error per step: task -> policy; PAPER, last table of the appendix.
SRL_ERROR: dict[str, dict[str, MinMeanMax]] = _convert(_NUMBERS["srl_error"], MinMeanMax)

#: The published settings of all methods
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
#: Arguments that may differ without making an arm another method; head, augmentation and curiosity are judged apart
FREE = {
    *("policy", "srl", "srl_kwargs", "augmentation", "augmentation_kwargs", "curiosity"),
    *("buffer_size", "replay_buffer_kwargs", "precision", "update", "overlap", "device", "verbose"),
}


def task_key(task: str) -> str:
    """Name of a task in the tables above.

    :param task: A task as results name it (``"cartpole-swingup"``, ``"finger-turn_easy"``)
    :return: Its key (``"cartpole_swingup"``, ``"finger_turn_easy"``)
    """
    return task.replace("-", "_")


def published_method(config: dict[str, Any]) -> tuple[str | None, bool]:
    """Published method that an arm is or builds upon.

    :param config: Its ``config.json``
    :return: The method, None for a head without published numbers; and whether the arm is that method, in its settings
        and without curiosity
    """
    arguments = config["arguments"]
    base = {"rae": "SAC-AE", "curl": "CURL"}.get(str(arguments.get("srl", "rae")))
    usual = ("crop",) if base == "CURL" else (None, "auto")  # auto: no augmentation with "rae"
    settings = {**SETTINGS, "warmup_updates": WARMUP_UPDATES.get(str(base))}
    is_usual = all(key in FREE or settings.get(key) == arguments[key] for key in arguments)
    is_plain = config.get("algo", "cure_sac") == "cure_sac" and arguments.get("curiosity", "separate") is None
    has_usual_views = arguments.get("augmentation") in usual and not arguments.get("srl_kwargs")
    return base, is_usual and is_plain and has_usual_views


@dataclass(frozen=True)
class Comparison:
    """An arm compared with a published number at the same environment steps.

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
    """Compare arms with published returns.

    :param experiments: Experiments; those about visitation have no returns to compare
    :return: Every arm at every published step that its curves reach, of those that see the published pixels
    """
    rows = []
    curves = [each for each in experiments if each.kind != "visitation"]
    for experiment, (task, method) in [(each, arm) for each in curves for arm in each.arms]:
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
