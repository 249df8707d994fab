"""Windows of `enjoy` and `render_mode="human"`, on a real display (Xvfb)."""

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from programs_for_tests import find_program

#: Steps an environment in a window, and notes observations, frames and what the display then shows
PROGRAM = """
import sys
import gymnasium as gym, numpy as np
import sb3_cure

found = {"rgb_array": [], "human": [], "frames": [], "shown": []}
for mode in ("rgb_array", "human"):
    env = gym.make("dmc_pixels/cartpole-swingup-v0", image_size=36, renderer="fast", render_mode=mode)
    env.action_space.seed(0)
    found[mode].append(env.reset(seed=0)[0])
    for _ in range(4):
        found[mode].append(env.step(env.action_space.sample())[0])
        if mode == "human":
            found["frames"].append(env.env.render())
            found["shown"].append(np.frombuffer(open(sys.argv[2], "rb").read(), np.uint8))
    env.close()
np.savez(sys.argv[1], **{name: np.stack(values) for name, values in found.items()})
"""
SIZE = 320


@pytest.fixture
def display(tmp_path: Path) -> Iterator[tuple[str, Path]]:
    """Name of a display, and the file that holds what it shows."""
    command = [
        find_program("Xvfb", package="xvfb"),
        "-displayfd",
        "1",
        "-screen",
        "0",
        f"{SIZE}x{SIZE}x24",
        "-fbdir",
        str(tmp_path),
    ]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as server:
        assert server.stdout is not None
        yield f":{server.stdout.readline().strip()}", tmp_path / "Xvfb_screen0"
        server.terminate()


@pytest.mark.parametrize("backend", ["egl", "glfw"])
def test_window_shows_frames_and_leaves_observations_alone(
    backend: str, display: tuple[str, Path], tmp_path: Path
) -> None:
    """Windows that draw with OpenGL take the renderer's: no process, or the first frame for ever."""
    name, screen = display
    environment = {**os.environ, "DISPLAY": name, "MUJOCO_GL": backend, "SDL_VIDEO_WINDOW_POS": "0,0"}
    environment.pop("SDL_VIDEODRIVER", None)
    command = [sys.executable, "-c", PROGRAM, str(tmp_path / "found.npz"), str(screen)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
    with np.load(tmp_path / "found.npz") as file:
        found = dict(file)
    np.testing.assert_array_equal(found["human"], found["rgb_array"])
    frames = found["frames"]
    assert all((frames[i] != frames[i + 1]).any() for i in range(len(frames) - 1))
    # The display's memory: a header, then rows of blue, green, red and a byte that says nothing.
    shown = found["shown"][:, -SIZE * SIZE * 4 :].reshape(-1, SIZE, SIZE, 4)
    height, width = frames.shape[1:3]
    np.testing.assert_array_equal(shown[:, :height, :width, 2::-1], frames)
