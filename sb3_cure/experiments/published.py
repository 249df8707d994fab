"""SRL errors that the CuRe paper reports (Aljalbout, Ulmer and Triebel, Seeking Visual Discomfort)."""

import itertools
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


#: Task (domain_task) -> minimum, mean and maximum of the random, the task and the curious policy
_ROWS = {
    "reacher_easy": ((0.0001, 0.0002, 0.0003), (0.0001, 0.0004, 0.0007), (0.039, 0.0399, 0.0424)),
    "ball_in_cup_catch": ((0.0005, 0.0006, 0.0008), (0.0003, 0.0005, 0.0007), (0.0762, 0.0774, 0.0783)),
    "cartpole_swingup": ((0.0002, 0.0002, 0.0003), (0.0002, 0.0002, 0.0003), (0.0531, 0.054, 0.0548)),
    "finger_spin": ((0.0002, 0.0003, 0.0004), (0.0004, 0.0012, 0.0015), (0.0755, 0.0766, 0.0774)),
    "finger_turn_easy": ((0.0003, 0.0004, 0.0006), (0.0003, 0.0005, 0.0008), (0.0749, 0.0759, 0.0769)),
    "reacher_hard": ((0.0002, 0.0003, 0.0008), (0.0002, 0.0004, 0.0006), (0.0393, 0.0397, 0.0404)),
}
#: SRL error per step: task -> policy; last table of the paper's appendix
SRL_ERROR = {
    task: dict(zip(("random", "task", "curious"), itertools.starmap(MinMeanMax, row), strict=True))
    for task, row in _ROWS.items()
}
