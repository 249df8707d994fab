"""Pictures and video of a finished cell."""

from pathlib import Path

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.preprocessing import is_image_space

from sb3_cure.callbacks import ReconstructionCallback
from sb3_cure.cure_sac import CuReSAC
from sb3_cure.envs import physics_state_names, physics_state_units
from sb3_cure.evaluation import evenly_measured, most_uncomfortable, run_episodes, trained_actors
from sb3_cure.experiments import plots
from sb3_cure.experiments.grid import Cell
from sb3_cure.experiments.probe import reconstruct_with_probe
from sb3_cure.experiments.video import write_video

FILM_SEED = 30_000
FRAMES = 16
ROWS_OF_RECONSTRUCTIONS = 8
PROBE_UPDATES = 500


def watch_reconstructions(cell: Cell, action_repeat: int, folder: Path) -> list[BaseCallback]:
    """
    :param cell: A cell that is about to be trained
    :param action_repeat: Environment steps per agent step
    :param folder: Where to write ``reconstructions.png``, one row per time
    :return: Callbacks that draw it during training
    """
    every = max(cell.budget // action_repeat // ROWS_OF_RECONSTRUCTIONS, 1)
    learns_from_images = cell.arguments["policy"] == "CnnPolicy" and cell.arguments.get("srl", "rae") is not None
    return [ReconstructionCallback(folder, every)] if learns_from_images else []


def draw_cell(model: CuReSAC, cell: Cell, folder: Path) -> None:
    """Write ``policy.mp4``, ``reconstructions.png``, ``uncomfortable.png`` and ``curiosity_map.png``.

    Each is left out where there is nothing to show: no frames to film, no images or head to reconstruct with, no SRL
    error, no true state, or no policy that was trained.

    :param model: The cell's model, with its replay buffer
    :param cell: The cell
    :param folder: Where to write
    """
    name = f"{cell.folder.parts[1]}, {cell.method}, seed {cell.seed}"
    head = getattr(model.policy, "srl", None)
    actors = trained_actors(model) if cell.budget > 0 else []
    probe = gym.make(cell.task, **cell.env_kwargs)
    can_film, has_physics = "rgb_array" in probe.metadata.get("render_modes", []), probe.has_wrapper_attr("physics")
    frame_stack = probe.get_wrapper_attr("frame_stack") if probe.has_wrapper_attr("frame_stack") else 1
    repeat = probe.get_wrapper_attr("action_repeat") if probe.has_wrapper_attr("action_repeat") else 1
    if actors and has_physics:
        _draw_map(model, probe, actors, folder / "curiosity_map.png", name)
    probe.close()
    if actors and can_film:
        env = gym.make(cell.task, **{**cell.env_kwargs, "render_mode": "rgb_array"})
        episode = next(run_episodes(model, env, 1, actors[0], seed=FILM_SEED, render=True))
        fps = max(round(env.metadata.get("render_fps") or 30), 1)
        write_video(folder / "policy.mp4", episode, fps, repeat, f"{actors[0]} policy: {name}")
        env.close()
    if head is not None and is_image_space(model.observation_space) and model.replay_buffer.size() > 0:  # type: ignore[union-attr]
        is_drawn = (folder / "reconstructions.png").exists()  # by `watch_reconstructions`
        strip = None if is_drawn else reconstruct_with_probe(model, frame_stack, PROBE_UPDATES)
        if strip is not None:
            title = f"What the latents know of the image: {name}"
            plots.reconstruction_grid(folder / "reconstructions.png", strip, title)
        found = most_uncomfortable(model, FRAMES)
        with th.no_grad():
            latents = model.policy.encode(th.as_tensor(found.observations, device=model.device))
            drawn = head.reconstruct(latents)
        plots.uncomfortable_frames(
            folder / "uncomfortable.png",
            found,
            frame_stack,
            f"What the agent finds uncomfortable: {name}",
            None if drawn is None else drawn.cpu().numpy(),
        )


def _draw_map(model: CuReSAC, env: gym.Env, actors: list[str], path: Path, name: str, n_episodes: int = 5) -> None:
    visits = {}
    with evenly_measured(model, env, FILM_SEED - 1):
        for actor in actors:
            seen = [
                (each.states, each.srl_errors)
                for each in run_episodes(model, env, n_episodes, actor, seed=FILM_SEED, states=True)
            ]
            states, errors = zip(*seen, strict=True)
            visits[actor] = np.concatenate(states), np.concatenate(errors)
    title = f"Where policies go: {name}"
    plots.curiosity_map(path, visits, physics_state_names(env), title, units=physics_state_units(env))
