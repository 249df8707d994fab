"""SRL errors that the CuRe paper reports (Aljalbout, Ulmer and Triebel, Seeking Visual Discomfort)."""

from typing import NamedTuple


class MinMeanMax(NamedTuple):
    """SRL error per step met by a policy.

    :param min: Smallest of all steps
    :param mean: Mean over them
    :param max: Largest of all steps
    """

    min: float
    mean: float
    max: float


#: SRL error per step: task (domain_task) -> policy; last table of the paper's appendix
SRL_ERROR: dict[str, dict[str, MinMeanMax]] = {
    "reacher_easy": {
        "random": MinMeanMax(0.0001, 0.0002, 0.0003),
        "task": MinMeanMax(0.0001, 0.0004, 0.0007),
        "curious": MinMeanMax(0.039, 0.0399, 0.0424),
    },
    "ball_in_cup_catch": {
        "random": MinMeanMax(0.0005, 0.0006, 0.0008),
        "task": MinMeanMax(0.0003, 0.0005, 0.0007),
        "curious": MinMeanMax(0.0762, 0.0774, 0.0783),
    },
    "cartpole_swingup": {
        "random": MinMeanMax(0.0002, 0.0002, 0.0003),
        "task": MinMeanMax(0.0002, 0.0002, 0.0003),
        "curious": MinMeanMax(0.0531, 0.054, 0.0548),
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
