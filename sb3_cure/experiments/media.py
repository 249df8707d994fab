"""Pictures and videos of a cell."""

import contextlib
from pathlib import Path

import numpy as np
import torch as th
from stable_baselines3.common.preprocessing import is_image_space

from sb3_cure.cure.algorithms import CuReSAC
from sb3_cure.data.buffers import frame_stack_of
from sb3_cure.envs import physics_state_names, physics_state_units
from sb3_cure.envs.wrappers import action_repeat_of
from sb3_cure.evaluation import plots
from sb3_cure.evaluation.callbacks import ReconstructionCallback
from sb3_cure.evaluation.rollouts import evenly_measured, highest_errors, run_episodes, trained_actors
from sb3_cure.evaluation.video import write_video
from sb3_cure.experiments.grid import Cell
from sb3_cure.experiments.visitation import VISIT_SEED, roll_out, visiting_actors

#: Films and reconstructed observations are the same in all cells of a task, as far as the policies let them
FILM_SEED = 30_000
FRAMES = 16
ROWS_OF_RECONSTRUCTIONS = 8
#: Reconstructed observations, and how many random agent steps lie between two of them
RECONSTRUCTED, STEPS_APART = 8, 50


def watch_reconstructions(cell: Cell, action_repeat: int, folder: Path) -> list[ReconstructionCallback]:
    """
    :param cell: A cell that is about to be trained
    :param action_repeat: Environment steps per agent step
    :param folder: Where to write ``reconstructions.png``, one row per time, of the same observations in all cells of
        the task (that have the same ``env_kwargs``)
    :return: Callbacks that draw it during training
    """
    if cell.arguments["policy"] != "CnnPolicy" or cell.arguments.get("srl", "rae") is None:
        return []
    every = max(cell.budget // action_repeat // ROWS_OF_RECONSTRUCTIONS, 1)
    return [ReconstructionCallback(folder, every, _random_observations(cell), title=name_of(cell))]


def name_of(cell: Cell) -> str:
    """
    :param cell: A cell
    :return: What its pictures are called
    """
    return f"{cell.folder.parts[1]}, {cell.method}, seed {cell.seed}"


def _random_observations(cell: Cell) -> np.ndarray:
    """Of episodes with random actions, [n, *shape]."""
    env = cell.make_eval_env()
    env.action_space.seed(FILM_SEED)
    observation, _ = env.reset(seed=FILM_SEED)
    chosen = []
    for step in range(1, RECONSTRUCTED * STEPS_APART + 1):
        observation, _, terminated, truncated, _ = env.step(env.action_space.sample())
        if terminated or truncated:
            observation, _ = env.reset()
        if step % STEPS_APART == 0:
            chosen.append(observation)
    env.close()
    return np.stack(chosen)


def draw_cell(model: CuReSAC, cell: Cell, folder: Path) -> None:
    """Write ``<actor>_policy.mp4``, ``reconstructions.png``, ``uncomfortable.png`` and ``curiosity_map.png``.

    Each is left out where there is nothing to show: no policy that was trained or no frames to film, no images or head
    to reconstruct with, no SRL error, no true state. Videos have deterministic actions; the map is that of the visits
    of ``measure_visits``, with sampled ones.

    :param model: The cell's model, with its replay buffer
    :param cell: The cell
    :param folder: Where to write
    """
    name = name_of(cell)
    with contextlib.closing(cell.make_eval_env()) as env:
        repeat = action_repeat_of(env)
        can_film = cell.budget > 0 and "rgb_array" in env.metadata.get("render_modes", [])
        actors = visiting_actors(model, cell)
        if env.has_wrapper_attr("physics") and actors != ["random"]:
            visits = {}
            with evenly_measured(model, env, VISIT_SEED - 1):
                for actor in actors:
                    episodes = roll_out(model, cell, env, actor, states=True)
                    states, errors = zip(*[(each.states, each.srl_errors) for each in episodes], strict=True)
                    visits[actor] = np.concatenate(states), np.concatenate(errors)
            title = f"Where policies go with sampled actions: {name}"
            names, units = physics_state_names(env), physics_state_units(env)
            plots.curiosity_map(folder / "curiosity_map.png", visits, names, title, units=units)
    if can_film:
        with contextlib.closing(cell.make_eval_env(render_mode="rgb_array")) as env:
            fps = max(round(env.metadata.get("render_fps") or 30), 1)
            for actor in trained_actors(model):
                (episode,) = run_episodes(model, env, 1, actor, seed=FILM_SEED, render=True)
                title = f"{actor} policy, deterministic actions: {name}"
                write_video(folder / f"{actor}_policy.mp4", episode, fps, repeat, title)
    measures = getattr(model.policy, "measures_errors", False)
    if not measures or not is_image_space(model.observation_space) or model.replay_buffer.size() == 0:  # type: ignore[union-attr]
        return
    if not (folder / "reconstructions.png").exists():  # not drawn in training
        for callback in watch_reconstructions(cell, repeat, folder):
            callback.draw(model)
    found = highest_errors(model, FRAMES)
    with th.no_grad():
        pair = model.policy.reconstruct(th.as_tensor(found.observations, device=model.device))
    title, drawn = f"What the agent finds uncomfortable: {name}", None if pair is None else pair[1].cpu().numpy()
    plots.highest_error_frames(folder / "uncomfortable.png", found, _frames_per_observation(model), title, drawn)


def _frames_per_observation(model: CuReSAC) -> int:
    """As the environments tell, if frames then are grey or in colour; else each channel counts as a frame."""
    told, (channels, *_) = frame_stack_of(model.env), model.observation_space.shape  # type: ignore[arg-type, misc]
    return told if channels in (told, 3 * told) else channels
