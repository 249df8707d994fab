"""What decoders err that learn nothing of the state, in the pictures of whichever MuJoCo is installed.

    python -m venv older
    older/bin/pip install --only-binary mujoco,labmaze,dm-tree,lxml dm-control==1.0.9 mujoco==2.3.2 'numpy<2'
    MUJOCO_GL=egl older/bin/python benchmarks/zero_decoder.py --out results/yardsticks

Three of them: one that always draws the middle grey (zero, which is what an untrained autoencoder draws), one that
always draws the best constant colour (its output bias has learned, and nothing else), and one that draws some frame of
the episode, but another than the one that it sees. MuJoCo 3.12 changed how floors are drawn, so that numbers published
before belong to other pictures of the same tasks. This file needs dm-control and NumPy alone and runs where MuJoCo is
older than sb3_cure takes. It adds its rows to ``zero_decoder.csv``; ``python -m benchmarks.yardsticks`` then shows
them.
"""

import argparse
import csv
import platform
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

import mujoco
import numpy as np

#: Domain, task and action repeat
TASKS = (
    ("cartpole", "swingup", 8),
    ("finger", "spin", 2),
    ("finger", "turn_easy", 2),
    ("ball_in_cup", "catch", 4),
    ("reacher", "easy", 4),
    ("reacher", "hard", 4),
)
COLUMNS = ("mujoco", "dm_control", "machine", "task", "seed", "predictor", "error_min", "error_mean", "error_max")


def targets(domain: str, task: str, action_repeat: int, seed: int, steps: int = 120) -> np.ndarray:
    """Targets of an autoencoder in random episodes.

    :param domain: Of the DeepMind Control suite
    :param task: Of the domain
    :param action_repeat: For how long each random action is held
    :param seed: Of the episode and its actions
    :param steps: Pictures, evenly spread over the episode
    :return: What the autoencoder is to draw: pictures in 5 bits, in [-0.5, 0.5], float64 [steps, 84, 84, 3]
    """
    from dm_control import suite  # loads OpenGL, which `python -m benchmarks.yardsticks` does in its own way

    env = suite.load(domain, task, task_kwargs={"random": seed})
    env.reset()
    bounds, rng = env.action_spec(), np.random.default_rng(seed)
    shown = set(np.linspace(0, 1000 // action_repeat - 1, steps).astype(int))
    pictures = []
    for step in range(1000 // action_repeat):
        if step in shown:
            pictures.append(env.physics.render(84, 84, camera_id=0))
        action = rng.uniform(bounds.minimum, bounds.maximum)
        for _ in range(action_repeat):
            env.step(action)
    return (np.stack(pictures) // 8 + 0.5) / 32 - 0.5


def constant_errors(drawn: np.ndarray) -> dict[str, np.ndarray]:
    """Errors of constant predictions.

    :param drawn: What is to be drawn, [n, H, W, C]
    :return: Mean squared errors: of zero and of the best constant colour for each picture [n]; of drawing one of the
        pictures where another one is seen, for each pair [n * (n - 1)]
    """
    colour = drawn.mean(axis=(0, 1, 2))
    flat = (drawn - colour).reshape(len(drawn), -1)
    squares, products = np.square(flat).mean(axis=1), flat @ flat.T / flat.shape[1]
    pairs = squares[:, None] + squares[None] - 2 * products
    return {
        "zero": np.square(drawn).mean(axis=(1, 2, 3)),
        "constant colour": squares,
        "another frame": pairs[~np.eye(len(drawn), dtype=bool)],
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure all tasks, replacing what this version of MuJoCo gave before.

    :param arguments: Command line, ``sys.argv`` by default
    :return: 0
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("yardsticks"), help="folder (default: yardsticks)")
    parser.add_argument("--seeds", type=int, default=3, help="episodes of each task (default: 3)")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    path = options.out / "zero_decoder.csv"
    here = (mujoco.__version__, version("dm_control"), f"{platform.system()} {platform.machine()}")
    rows: list[dict[str, object]] = []
    if path.exists():
        with path.open(newline="") as file:
            rows = [dict(row) for row in csv.DictReader(file) if row["mujoco"] != mujoco.__version__]
    for domain, task, action_repeat in TASKS:
        for seed in range(options.seeds):
            for predictor, errors in constant_errors(targets(domain, task, action_repeat, seed)).items():
                numbers = [round(float(value), 7) for value in (errors.min(), errors.mean(), errors.max())]
                rows.append(dict(zip(COLUMNS, (*here, f"{domain}-{task}", seed, predictor, *numbers), strict=True)))
                print(f"MuJoCo {here[0]}, {domain}-{task}, seed {seed}, {predictor}: {numbers[1]:.4f}", flush=True)
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows(rows)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
