"""Colours that mean the same in all figures, and what must be seen in them."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from PIL import Image

from sb3_cure.evaluation import plots
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


def test_few_pixels_keep_their_colour(tmp_path: Path) -> None:
    """A small orange ball in a blue sky: a palette by frequency alone makes it grey."""
    sky = np.linspace([20, 40, 60], [80, 130, 180], 80)[:, None] + np.random.default_rng(0).normal(0, 6, (80, 80, 1))
    picture = sky.clip(0, 255) / 255
    picture[38:42, 39:43] = np.linspace(0.5, 1, 4)[:, None, None] * np.array([247, 140, 70]) / 255
    figure = Figure((0.8, 0.8))
    figure.figimage(picture)
    plots.save(figure, tmp_path / "ball.png", dpi=100)
    with Image.open(tmp_path / "ball.png") as image:
        ball = np.asarray(image.convert("RGB"), dtype=int)[41, 41]
    assert np.abs(ball - [247, 140, 70]).max() < 12


def test_line_to_an_error_of_zero_leaves_the_picture_at_its_bottom(tmp_path: Path) -> None:
    """On a logarithmic axis, as of contrastive errors; else the line to the greatest error would be gone, too."""
    ends = []
    for low in (1e-4, 0.0):
        bar = plots.Bar("cure", "curious", np.array([0.1, 0.12]), "", (low, 1.0))
        plots.visitation_bars(tmp_path / "bars.png", {"task": [bar]}, {})
        with Image.open(tmp_path / "bars.png") as image:
            red = np.abs(np.asarray(image.convert("RGB"), dtype=int) - [0xD6, 0x27, 0x28]).sum(axis=-1) < 60
        rows = np.flatnonzero(red.any(axis=1))
        ends.append((rows.min(), rows.max()))
    (top, bottom), (top_to_zero, bottom_to_zero) = ends
    assert top_to_zero <= top and bottom_to_zero == bottom
