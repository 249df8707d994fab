"""Colours that mean the same in all figures."""

from sb3_cure.evaluation.plots import COLORS, arm_colors


def test_shared_arms_keep_their_colour() -> None:
    """Whatever the baseline and the order of the arms."""
    one = arm_colors(["random", "sac_ae", "cure", "mine"], "sac_ae")
    other = arm_colors(["other", "mine", "cure", "random", "sac_ae"], "other")
    for arm, policy in {"random": "random", "sac_ae": "task", "cure": "curious"}.items():
        assert one[arm] == other[arm] == COLORS[policy]


def test_arms_of_an_experiment_differ_in_colour() -> None:
    """Also two that share a colour elsewhere, and a baseline without one."""
    arms = ["cure", "cure_sac_ae", "curl", "drq", "random", *map(str, range(8))]
    colors = arm_colors(arms, "0")
    assert set(colors) == set(arms) and len(set(colors.values())) == len(arms)
