"""Videos of a policy with its SRL error drawn in."""

from pathlib import Path

import imageio.v2 as imageio
import numpy as np
from PIL import Image, ImageDraw

from sb3_cure.evaluation import Episode

PANEL_HEIGHT = 64


def write_video(path: Path, episode: Episode, fps: int, action_repeat: int = 1) -> None:
    """One episode as MP4: the camera's picture above, the SRL error up to now below.

    :param path: File to write, ``*.mp4``
    :param episode: Episode with ``frames`` (rendered with ``render=True``)
    :param fps: Pictures per second, one per agent step
    :param action_repeat: Environment steps per agent step, for the caption
    """
    returns = episode.rewards.cumsum()
    top = float(episode.srl_errors.max()) if len(episode.srl_errors) else 0.0
    with imageio.get_writer(path, fps=fps, macro_block_size=16) as writer:
        for step, frame in enumerate(episode.frames):
            caption = f"environment step {(step + 1) * action_repeat}, return {returns[step]:.0f}"
            writer.append_data(  # type: ignore[attr-defined]
                _with_panel(frame, episode.srl_errors[: step + 1], len(episode.frames), top, caption)
            )


def _with_panel(frame: np.ndarray, errors: np.ndarray, length: int, top: float, caption: str) -> np.ndarray:
    height, width = frame.shape[:2]
    picture = Image.new("RGB", (width, height + PANEL_HEIGHT), "white")
    picture.paste(Image.fromarray(frame))
    draw = ImageDraw.Draw(picture)
    draw.text((4, height + 2), caption, fill="black")
    if len(errors) and top > 0:
        draw.text((4, height + 14), f"SRL error {errors[-1]:.5f}", fill="#d62728")
        plot_top, plot_height = height + 30, PANEL_HEIGHT - 34
        points = [
            (4 + (width - 8) * index / max(length - 1, 1), plot_top + plot_height * (1 - error / top))
            for index, error in enumerate(errors)
        ]
        if len(points) > 1:
            draw.line(points, fill="#d62728", width=2)
    return np.asarray(picture)
