"""Videos of a policy with its SRL error."""

import functools
import textwrap
from collections.abc import Iterator, Mapping
from pathlib import Path

import gymnasium as gym
import imageio.v2 as imageio
import imageio_ffmpeg  # type: ignore[import-untyped]  # noqa: F401  (imageio imports it late: at the first frame)
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from sb3_cure.evaluation.rollouts import Episode

MIN_WIDTH = 256
GIF_HEIGHT = 128
#: Characters of a line of the title; text grows with the picture, so that it holds as many at any width
LINE = 36
RED, GREY = "#d62728", "#bbbbbb"


def frame_rate(env: gym.Env) -> int:
    """Pictures per second of an environment's videos, one per agent step: its ``render_fps``, or 30.

    :param env: An environment
    :return: At least 1
    """
    return max(round(env.metadata.get("render_fps") or 30), 1)


def write_video(path: Path, episodes: Mapping[str, Episode], fps: int, action_repeat: int = 1) -> None:
    """Write episodes side by side as MP4: the camera's pictures above, the SRL errors so far below, on one scale.

    :param path: File to write, ``*.mp4``
    :param episodes: Episodes with ``frames`` (rendered with ``render=True``) by title; all end with the shortest.
        Without ``srl_errors`` none are drawn
    :param fps: Pictures per second, one per agent step
    :param action_repeat: Environment steps per agent step, for the captions
    """
    top = max(float(episode.srl_errors.max(initial=0)) for episode in episodes.values())
    columns = [annotated_frames(episode, action_repeat, title, top) for title, episode in episodes.items()]
    # Codecs want even sizes, which the pictures have; by default imageio rescales to multiples of 16.
    with imageio.get_writer(path, fps=fps, macro_block_size=2) as writer:
        for pictures in zip(*columns, strict=False):
            height = max(len(picture) for picture in pictures)
            padded = [np.pad(each, ((0, height - len(each)), (0, 0), (0, 0)), constant_values=255) for each in pictures]
            writer.append_data(np.concatenate(padded, axis=1))  # type: ignore[attr-defined]


def write_gif(path: Path, episode: Episode, fps: int, channels: int = 3) -> None:
    """Write an episode as a GIF: the camera's pictures beside the newest frame of what the agent sees.

    :param path: File to write, ``*.gif``
    :param episode: An episode of images with ``frames`` (rendered with ``render=True``)
    :param fps: Pictures per second, one per agent step
    :param channels: Of a frame that the agent sees: 3, or 1 if it is grey
    """
    pictures = []
    size = GIF_HEIGHT
    for frame, observation in zip(episode.frames[:-1], episode.observations, strict=True):
        seen = observation[-channels:].transpose(1, 2, 0).repeat(3 // channels, axis=2)
        rendered = Image.fromarray(frame).resize((size, size), Image.Resampling.LANCZOS)
        picture = Image.new("RGB", (2 * size + 4, size), "white")
        picture.paste(rendered, (0, 0))
        picture.paste(Image.fromarray(seen).resize((size, size), Image.Resampling.NEAREST), (size + 4, 0))
        pictures.append(picture)
    # Few colours, the same in all pictures: else the file is larger, and grounds flicker.
    some = np.concatenate([np.asarray(picture) for picture in pictures[:: max(len(pictures) // 8, 1)]])
    palette = Image.fromarray(some).quantize(40, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    first, *rest = (picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures)
    first.save(path, save_all=True, append_images=rest, duration=1000 // fps, loop=0)


def annotated_frames(episode: Episode, action_repeat: int, title: str, top: float) -> Iterator[np.ndarray]:
    """Draw the pictures of ``write_video``.

    :param episode: Episode with ``frames``
    :param action_repeat: Environment steps per agent step
    :param title: Put before the caption; wrapped if it is long
    :param top: Error at the upper end of the curve
    :return: RGB pictures, uint8 [height, width, 3] of even sizes; small frames are magnified
    """
    returns = np.concatenate([[0], episode.rewards.cumsum()])
    for step, frame in enumerate(episode.frames):
        caption = f"environment step {step * action_repeat}, return {returns[step]:.0f}"
        errors = episode.srl_errors[: step + 1]
        yield _with_panel(frame, title, caption, errors, len(episode.frames), top)


def _with_panel(frame: np.ndarray, title: str, caption: str, errors: np.ndarray, length: int, top: float) -> np.ndarray:
    """Draw the frame above a panel with text and, if there are errors, the latest as a number and all as a curve."""
    factor = -(-MIN_WIDTH // frame.shape[1])
    frame = frame.repeat(factor, axis=0).repeat(factor, axis=1)
    height, width = frame.shape[:2]
    unit = width // 64  # sizes follow the picture's
    line_height, curve_height = 4 * unit, 10 * unit if len(errors) else 0
    # Only the title may be wrapped, as it is constant: all pictures must have the same number of lines
    lines = [*textwrap.wrap(title, LINE, break_on_hyphens=False), caption]
    if len(errors):
        lines.append(f"SRL error {errors[-1]:.5f} (highest so far {errors.max():.5f})")
    size = (width + width % 2, height + line_height * len(lines) + curve_height + 2 * unit)
    picture = Image.new("RGB", (size[0], size[1] + size[1] % 2), "white")
    picture.paste(Image.fromarray(frame))
    draw = ImageDraw.Draw(picture)
    for index, line in enumerate(lines):
        color = RED if len(errors) and line is lines[-1] else "black"
        place = (unit, height + index * line_height + unit // 2)
        draw.text(place, line, fill=color, font=_font(_fitting_size(line, 3 * unit, width - 2 * unit)))
    if len(errors):
        left, right, bottom = unit, width - unit, picture.height - unit
        draw.line([(left, bottom), (right, bottom)], fill=GREY)
        points = [
            (left + (right - left) * index / max(length - 1, 1), bottom - curve_height * error / top if top else bottom)
            for index, error in enumerate(errors.tolist())
        ]
        draw.line(points, fill=RED, width=max(unit // 2, 1))
        x, y = points[-1]
        draw.ellipse((x - unit / 2, y - unit / 2, x + unit / 2, y + unit / 2), fill=RED)
    return np.asarray(picture)


#: Font by size, cached as loading takes longer than drawing a line
_font = functools.cache(ImageFont.load_default)


def _fitting_size(line: str, size: int, width: int) -> int:
    """Reduce a font size until the line fits, as it may contain long numbers."""
    while size > 1 and _font(size).getbbox(line)[2] > width:
        size -= 1
    return size
