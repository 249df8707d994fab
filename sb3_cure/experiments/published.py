"""Published numbers, each with its source, and results beside them. Anchors for sanity, not gates."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sb3_cure.experiments.results import Experiment
from sb3_cure.experiments.statistics import stack_curves

#: Below this part of a published mean, a return is suspected to be a bug of ours.
SUSPECT_BELOW = 0.75


class MeanStd(NamedTuple):
    """A published value.

    :param mean: Mean over seeds
    :param std: Standard deviation over seeds, None where none is published
    """

    mean: float
    std: float | None = None


class MinMeanMax(NamedTuple):
    """SRL error per step met by a policy."""

    min: float
    mean: float
    max: float


PAPER = "Aljalbout, Ulmer and Triebel, Seeking Visual Discomfort (the CuRe paper)"

SOURCES = {
    "SAC-AE": "Laskin et al. 2020 (CURL), Table 1",
    "CURL": "Laskin et al. 2020 (CURL), Table 1",
    "DrQ": "Kostrikov et al. 2020 (DrQ), Table 1",
    "DrQ-v2": "Yarats et al. 2021 (DrQ-v2)",
}

#: Episode returns: method -> environment steps -> task (domain_task)
RETURNS: dict[str, dict[int, dict[str, MeanStd]]] = {
    "SAC-AE": {
        100_000: {
            "cartpole_swingup": MeanStd(311, 11),
            "reacher_easy": MeanStd(274, 14),
            "ball_in_cup_catch": MeanStd(391, 82),
            "finger_spin": MeanStd(740, 64),
            "cheetah_run": MeanStd(267, 24),
            "walker_walk": MeanStd(394, 22),
        },
        500_000: {
            "cartpole_swingup": MeanStd(735, 63),
            "reacher_easy": MeanStd(627, 58),
            "ball_in_cup_catch": MeanStd(794, 58),
            "finger_spin": MeanStd(884, 128),
            "cheetah_run": MeanStd(550, 34),
            "walker_walk": MeanStd(847, 48),
        },
    },
    "CURL": {
        100_000: {
            "cartpole_swingup": MeanStd(582, 146),
            "reacher_easy": MeanStd(538, 233),
            "ball_in_cup_catch": MeanStd(769, 43),
            "finger_spin": MeanStd(767, 56),
            "cheetah_run": MeanStd(299, 48),
            "walker_walk": MeanStd(403, 24),
        },
        500_000: {
            "cartpole_swingup": MeanStd(841, 45),
            "reacher_easy": MeanStd(929, 44),
            "ball_in_cup_catch": MeanStd(959, 27),
            "finger_spin": MeanStd(926, 45),
            "cheetah_run": MeanStd(518, 28),
            "walker_walk": MeanStd(902, 43),
        },
    },
    "DrQ": {
        100_000: {
            "cartpole_swingup": MeanStd(759, 92),
            "reacher_easy": MeanStd(601, 213),
            "ball_in_cup_catch": MeanStd(913, 53),
            "finger_spin": MeanStd(901, 104),
            "cheetah_run": MeanStd(344, 67),
            "walker_walk": MeanStd(612, 164),
            "reacher_hard": MeanStd(202),
        },
        500_000: {
            "cartpole_swingup": MeanStd(868, 10),
            "reacher_easy": MeanStd(942, 71),
            "ball_in_cup_catch": MeanStd(963, 9),
            "finger_spin": MeanStd(938, 103),
            "cheetah_run": MeanStd(660, 96),
            "walker_walk": MeanStd(921, 45),
            "reacher_hard": MeanStd(824),
        },
    },
    "DrQ-v2": {
        100_000: {"finger_turn_easy": MeanStd(161), "reacher_hard": MeanStd(86)},
        500_000: {"finger_turn_easy": MeanStd(194), "reacher_hard": MeanStd(324)},
    },
}

#: Returns after pretraining of sac_ae: arm -> task; PAPER, Table I. The steps of training are not stated there.
#: "ball_in_cup" and "finger_turn" are taken for ball_in_cup_catch and finger_turn_easy, the suite's tasks of that name.
PRETRAINING: dict[str, dict[str, MeanStd]] = {
    "vanilla": {
        "cartpole_swingup": MeanStd(833, 27),
        "ball_in_cup_catch": MeanStd(953, 4),
        "finger_spin": MeanStd(820, 144),
        "reacher_easy": MeanStd(714, 113),
        "reacher_hard": MeanStd(169, 179),
        "finger_turn_easy": MeanStd(229, 135),
    },
    "random_pretraining": {
        "cartpole_swingup": MeanStd(784, 12),
        "ball_in_cup_catch": MeanStd(955, 10),
        "finger_spin": MeanStd(975, 3),
        "reacher_easy": MeanStd(615, 129),
        "reacher_hard": MeanStd(84, 33),
        "finger_turn_easy": MeanStd(256, 40),
    },
    "cure_pretraining": {
        "cartpole_swingup": MeanStd(846, 25),
        "ball_in_cup_catch": MeanStd(504, 187),
        "finger_spin": MeanStd(981, 7),
        "reacher_easy": MeanStd(804, 52),
        "reacher_hard": MeanStd(431, 40),
        "finger_turn_easy": MeanStd(402, 58),
    },
}

#: SRL error per step: task -> policy; PAPER, last table of the appendix.
SRL_ERROR: dict[str, dict[str, MinMeanMax]] = {
    "reacher_easy": {
        "random": MinMeanMax(0.0001, 0.0002, 0.0003),
        "task": MinMeanMax(0.0001, 0.0004, 0.0007),
        "curious": MinMeanMax(0.0390, 0.0399, 0.0424),
    },
    "ball_in_cup_catch": {
        "random": MinMeanMax(0.0005, 0.0006, 0.0008),
        "task": MinMeanMax(0.0003, 0.0005, 0.0007),
        "curious": MinMeanMax(0.0762, 0.0774, 0.0783),
    },
    "cartpole_swingup": {
        "random": MinMeanMax(0.0002, 0.0002, 0.0003),
        "task": MinMeanMax(0.0002, 0.0002, 0.0003),
        "curious": MinMeanMax(0.0531, 0.0540, 0.0548),
    },
    "finger_spin": {
        "random": MinMeanMax(0.0002, 0.0003, 0.0004),
        "task": MinMeanMax(0.0004, 0.0012, 0.0015),
        "curious": MinMeanMax(0.0755, 0.0766, 0.0774),
    },
    "finger_turn_easy": {
        "random": MinMeanMax(0.0003, 0.0004, 0.0006),
        "task": MinMeanMax(0.0003, 0.0005, 0.0008),
        "curious": MinMeanMax(0.0749, 0.0759, 0.0769),
    },
    "reacher_hard": {
        "random": MinMeanMax(0.0002, 0.0003, 0.0008),
        "task": MinMeanMax(0.0002, 0.0004, 0.0006),
        "curious": MinMeanMax(0.0393, 0.0397, 0.0404),
    },
}

#: What uniform dither of 1/32 adds to a mean squared error: the least that RAE's *training* loss can be. The error that
#: sb3_cure measures is against the dither's mean, so it is the excess over this floor already.
DITHER_FLOOR = (1 / 32) ** 2 / 12


def task_key(task: str) -> str:
    """
    :param task: A task as results name it (``"cartpole-swingup"``, ``"finger-turn_easy"``)
    :return: As the tables above name it (``"cartpole_swingup"``, ``"finger_turn_easy"``)
    """
    return task.replace("-", "_")


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
    "policy_kwargs": {"net_arch": [1024, 1024]},
}


def published_method(arguments: dict) -> tuple[str | None, bool]:
    """Which published method an arm is.

    :param arguments: CuReSAC's arguments, as ``config.json`` keeps them
    :return: The method that it is or builds upon, None for a head without published numbers; and whether it is that
        method, in its settings and without curiosity
    """
    base = {"rae": "SAC-AE", "curl": "CURL"}.get(str(arguments.get("srl", "rae")))
    augmentation = arguments.get("srl_kwargs", {}).get("augmentation", "none")
    is_usual = augmentation == ("crop" if base == "CURL" else "none")
    is_usual &= all(arguments.get(key, value) == value for key, value in SETTINGS.items())
    return base, is_usual and arguments.get("curiosity", "separate") is None


@dataclass(frozen=True)
class Comparison:
    """An arm beside a published number at the same environment steps.

    :param theirs: The published value of the method that the arm is, or builds upon; None if there is none
    :param published_as: Name of that method
    :param same_method: Whether the arm is that method, rather than adding curiosity to it or changing its settings
    :param ours: Mean return of the seeds at that step
    :param std: Standard deviation over seeds; nan with one
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
    for experiment in experiments:
        for task in experiment.tasks:
            for method in experiment.methods:
                cells = [cell for cell in experiment.done(task, method).values() if len(cell.curve()[0]) > 1]
                if not cells or experiment.kind == "visitation" or cells[0].config.get("pretrain"):
                    continue
                base, same_method = published_method(cells[0].config.get("arguments", {}))
                if base is None or not all(cell.sees_published_pixels for cell in cells):
                    continue
                steps, stacked = stack_curves(cells)
                for at, table in RETURNS[base].items():
                    # An agent step may be worth up to 8 environment steps, in several environments at once.
                    if len(steps) < 2 or steps[-1] < 0.99 * at:
                        continue
                    values = np.array([np.interp(at, steps, curve) for curve in stacked])
                    std = float(values.std(ddof=1)) if len(values) > 1 else float("nan")
                    theirs = table.get(task_key(task))
                    rows.append(
                        Comparison(
                            experiment.name,
                            task,
                            method,
                            at,
                            len(cells),
                            float(values.mean()),
                            std,
                            theirs,
                            base,
                            same_method,
                        )
                    )
    return rows
