"""Pictures and videos of a cell."""

import contextlib
from pathlib import Path

import gymnasium as gym
import torch as th
from stable_baselines3.common.preprocessing import is_image_space

from sb3_cure.cure.algorithms import CuReSAC
from sb3_cure.data.buffers import frame_stacks
from sb3_cure.envs import physics_state_names, physics_state_units
from sb3_cure.envs.wrappers import action_repeat_of
from sb3_cure.evaluation import plots
from sb3_cure.evaluation.callbacks import ReconstructionCallback
from sb3_cure.evaluation.rollouts import (
    balanced_negatives,
    highest_errors,
    run_episodes,
    states_and_errors,
    trained_actors,
)
from sb3_cure.evaluation.video import frame_rate, write_video
from sb3_cure.experiments.grid import Cell
from sb3_cure.experiments.visitation import VISIT_SEED, roll_out, visiting_actors

#: Seed of films, the same in all cells of a task
FILM_SEED = 30_000
FRAMES = 16
ROWS_OF_RECONSTRUCTIONS = 8


def reconstruction_callbacks(cell: Cell, action_repeat: int, folder: Path) -> list[ReconstructionCallback]:
    """Callbacks that draw reconstructions during training.

    :param cell: A cell that is about to be trained
    :param action_repeat: Environment steps per agent step
    :param folder: Where to write ``reconstructions.png``, one row per time
    :return: The callbacks; none without an SRL head, or for other policies than ``"CnnPolicy"``
    """
    if cell.arguments["policy"] != "CnnPolicy" or cell.arguments.get("srl", "rae") is None:
        return []
    every = max(cell.budget // action_repeat // ROWS_OF_RECONSTRUCTIONS, 1)
    return [ReconstructionCallback(folder, every, title=_title(cell))]


def _title(cell: Cell) -> str:
    return f"{cell.folder.parts[1]}, {cell.method}, seed {cell.seed}"


def draw_cell(model: CuReSAC, cell: Cell, folder: Path) -> None:
    """Write ``<actor>_policy.mp4``, ``uncomfortable.png`` and ``curiosity_map.png``.

    Those for which a cell lacks images, a trained policy, a head or true states are left out. Videos have
    deterministic actions; the map shows the visits of ``measure_visits``, with sampled ones.

    :param model: The cell's model, with its replay buffer
    :param cell: The cell
    :param folder: Where to write
    """
    is_trained = cell.budget > 0
    with contextlib.closing(cell.make_eval_env()) as env:
        repeat, can_film = action_repeat_of(env), "rgb_array" in env.metadata.get("render_modes", [])
        if is_trained and env.has_wrapper_attr("physics"):
            _draw_map(model, cell, env, folder)
    if is_trained and can_film:
        _film(model, cell, repeat, folder)
    if getattr(model.policy, "measures_errors", False) and is_image_space(model.observation_space):
        _draw_replay_buffer(model, cell, folder)


def _draw_map(model: CuReSAC, cell: Cell, env: gym.Env, folder: Path) -> None:
    visits = {}
    with balanced_negatives(model, env, VISIT_SEED - 1):
        for actor in visiting_actors(model, cell):
            visits[actor] = states_and_errors(roll_out(model, cell, env, actor, states=True))
    title = f"Where policies go with sampled actions: {_title(cell)}"
    names, units = physics_state_names(env), physics_state_units(env)
    plots.curiosity_map(folder / "curiosity_map.png", visits, names, title, units=units)


def _film(model: CuReSAC, cell: Cell, repeat: int, folder: Path) -> None:
    with contextlib.closing(cell.make_eval_env(render_mode="rgb_array")) as env:
        for actor in trained_actors(model):
            (episode,) = run_episodes(model, env, 1, actor, seed=FILM_SEED, render=True)
            title = f"{actor} policy, deterministic actions: {_title(cell)}"
            write_video(folder / f"{actor}_policy.mp4", {title: episode}, frame_rate(env), repeat)


def _draw_replay_buffer(model: CuReSAC, cell: Cell, folder: Path) -> None:
    if model.replay_buffer.size() == 0:  # type: ignore[union-attr]
        return
    found = highest_errors(model, FRAMES)
    with th.no_grad():
        pair = model.policy.reconstruct(th.as_tensor(found.observations, device=model.device))
    title, drawn = f"Highest SRL errors: {_title(cell)}", None
    if pair is not None:
        seen, drawn = (images.cpu().numpy() for images in pair)
        found = found._replace(observations=seen)  # what was to be drawn, such as a crop
    plots.highest_error_frames(folder / "uncomfortable.png", found, frame_stacks(model)[""], title, drawn)
