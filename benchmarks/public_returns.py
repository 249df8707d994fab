"""Train the public implementation of SAC-AE beside ours: the same environment, settings, budget and evaluations.

    git clone https://github.com/denisyarats/pytorch_sac_ae
    python -m benchmarks.public_returns pytorch_sac_ae --out results
    sb3-cure report results

Our arms are those of ``zoo_configs/experiments/fast/public_sac_ae.yml``; the public one is the baseline. What is done
is not run again. The arms of a seed share the evaluations' starts, but not initial weights and warm-up.
"""

import argparse
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th

from benchmarks.public_sac_ae import ARGUMENTS, Log, checkout_argument, import_public, public_agent
from sb3_cure.cli.usage import UsageError
from sb3_cure.envs.wrappers import action_repeat_of
from sb3_cure.evaluation.result_files import Row, checkout_commit, describe_run, write_csv, write_json, write_text
from sb3_cure.experiments.cells import EVAL_SEED, alone_in, check_cell, is_evaluation_due, run_cell
from sb3_cure.experiments.grid import DONE, Cell, load_grid
from sb3_cure.networks.allocator import tune_allocator

GRID = Path(__file__).parent.parent / "zoo_configs" / "experiments" / "fast" / "public_sac_ae.yml"
ARM, SOURCE = "public", "https://github.com/denisyarats/pytorch_sac_ae"
_EVAL_COLUMNS = ("environment_steps", "agent_steps", "updates", "seconds", "return_mean", "return_std", "srl_loss")


def public_cell(cell: Cell) -> Cell:
    """Cell of the public implementation that matches one of ours.

    :param cell: One of ours, in SAC-AE's settings
    :return: The public implementation's with the same environment, seed and budget
    """
    ours = cell.arguments
    (width, *_), filters = ours["policy_kwargs"]["net_arch"], ours["policy_kwargs"]["features_extractor_kwargs"]
    settings = {**ARGUMENTS, "hidden_dim": width, "num_filters": filters["n_filters"], "discount": ours["gamma"]}
    shared = {key: ours[key] for key in ("srl", "curiosity", "learning_starts", "batch_size", "buffer_size")}
    return replace(cell, method=ARM, arguments={"implementation": SOURCE, **shared, **settings})


class PublicTraining:
    """Training loop of the public implementation, on one of our environments.

    :param checkout: Folder that holds the public implementation's files
    :param cell: What to run
    """

    def __init__(self, checkout: Path, cell: Cell):
        self.cell, self.settings = cell, cell.arguments
        self.env = gym.make(cell.task, **cell.env_kwargs)
        self.action_repeat = action_repeat_of(self.env)
        self.env.action_space.seed(cell.seed)
        utils = import_public(checkout, "utils")
        utils.set_seed_everywhere(cell.seed)
        shape, actions = self.env.observation_space.shape, self.env.action_space
        assert isinstance(actions, gym.spaces.Box) and shape is not None and shape[0] < shape[1]
        assert (actions.low == -1).all() and (actions.high == 1).all()
        #: Updates after the warm-up's last step. The step's number decides on the actor: all of these updates train it
        self.first_updates = self.settings["learning_starts"]
        self.log, self.losses = Log(), list[float]()
        self.updates = 0
        self._set_up(checkout, utils, shape, actions.shape)

    def _set_up(self, checkout: Path, utils: Any, shape: tuple[int, ...], action_shape: tuple[int, ...]) -> None:
        """Make agent and replay buffer."""
        arguments = {key: value for key, value in self.settings.items() if key in (*ARGUMENTS, "discount")}
        self.agent = public_agent(checkout, shape, action_shape[0], **arguments)
        sizes = self.settings["buffer_size"], self.settings["batch_size"]
        self.buffer = utils.ReplayBuffer(shape, action_shape, *sizes, th.device("cpu"))

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Act deterministically.

        :param observation: Observation of the environment
        :return: Action
        """
        return self.agent.select_action(observation)

    def steps(self) -> Iterator[int]:
        """Train step by step.

        :return: Agent steps so far, before each step and after the last: between two of them one is made
        """
        warmup, total = self.settings["learning_starts"], -(-self.cell.budget // self.action_repeat)
        observation, _ = self.env.reset(seed=self.cell.seed)
        for step in range(total):
            yield step
            if step < warmup:
                action = self.env.action_space.sample()
            else:
                action = self.agent.sample_action(observation)
                for _ in range(self.first_updates if step == warmup else 1):
                    self.agent.update(self.buffer, self.log, step)
                    self.updates += 1
                    if "decoder" in self.log.losses:
                        self.losses.append(self.log.losses["decoder"])
            next_observation, reward, terminated, truncated, _ = self.env.step(action)
            self.buffer.add(observation, action, reward, next_observation, terminated)
            observation = next_observation
            if terminated or truncated:
                observation, _ = self.env.reset()
        yield total


class _PublicRun(PublicTraining):
    """Its training with evaluations of ours."""

    def __init__(self, checkout: Path, cell: Cell):
        self.eval_env = gym.make(cell.task, **cell.env_kwargs)
        super().__init__(checkout, cell)
        self.evaluations: list[Row] = []
        self.began = time.monotonic()

    def learn(self) -> list[Row]:
        """Train and evaluate.

        :return: Rows of ``eval.csv``
        """
        for step in self.steps():
            self._evaluate_if_due(step)
        self._evaluate_if_due(step, finished=True)
        return self.evaluations

    def _evaluate_if_due(self, step: int, finished: bool = False) -> None:
        steps = step * self.action_repeat
        if not is_evaluation_due(self.evaluations, steps, self.cell.eval_every, finished):
            return
        seeds = [EVAL_SEED, *[None] * (self.cell.eval_episodes - 1)]
        returns = [episode_return(self.eval_env, self.act, seed) for seed in seeds]
        row = (
            *(steps, step, self.updates, round(time.monotonic() - self.began, 1)),
            *(float(np.mean(returns)), float(np.std(returns)), float(np.mean(self.losses)) if self.losses else ""),
        )
        self.losses.clear()
        self.evaluations.append(dict(zip(_EVAL_COLUMNS, row, strict=True)))
        print(f"{self.cell.folder}: {steps} environment steps, return {np.mean(returns):.1f}", flush=True)


def episode_return(env: gym.Env, act: Callable[[np.ndarray], np.ndarray], seed: int | None) -> float:
    """Play one episode.

    :param env: One (not vectorised) environment
    :param act: From an observation to an action
    :param seed: Of the reset
    :return: Undiscounted return of one episode
    """
    observation, _ = env.reset(seed=seed)
    total, done = 0.0, False
    while not done:
        observation, reward, terminated, truncated, _ = env.step(act(observation))
        total, done = total + float(reward), terminated or truncated
    return total


def run_public(checkout: Path, cell: Cell, results: Path) -> None:
    """Train and evaluate one cell, from its beginning, unless that is done.

    :param checkout: Folder that holds the public implementation's files
    :param cell: From ``public_cell``
    :param results: Folder of all results
    """
    tune_allocator()
    folder = results / cell.folder
    check_cell(folder, cell)
    folder.mkdir(parents=True, exist_ok=True)
    with alone_in(folder):
        if (folder / DONE).exists():
            return
        commit = checkout_commit(checkout)  # of what runs: later the checkout may have moved on
        run = _PublicRun(checkout, cell)
        write_json(folder / "config.json", {**asdict(cell), "action_repeat": run.action_repeat})
        write_csv(folder / "eval.csv", _EVAL_COLUMNS, run.learn())
        conditions = {
            "device": "cpu",
            "precision": "fp32",
            "seconds": run.evaluations[-1]["seconds"],
            "attempts": 1,
            "implementation": {"source": SOURCE, "commit": commit},
        }
        write_json(folder / "run.json", {**describe_run(), **conditions})
        write_text(folder / DONE, "")


def main(arguments: Sequence[str] | None = None) -> None:
    """Run all arms, seed by seed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    checkout_argument(parser)
    parser.add_argument("--out", type=Path, default=Path("results"), help="folder of results (default: results)")
    parser.add_argument("--seeds", type=int, help="how many (default: as the grid says)")
    parser.add_argument("--budget", type=int, help="environment steps (default: as the grid says)")
    options = parser.parse_args(arguments)
    tune_allocator()
    grid = load_grid(GRID, seeds=options.seeds, budget=options.budget)
    methods = {ARM: {"implementation": SOURCE}, **grid.description["methods"]}
    (options.out / grid.experiment).mkdir(parents=True, exist_ok=True)
    description = {**grid.description, "methods": methods, "baseline": ARM}
    write_json(options.out / grid.experiment / "grid.json", description)
    for seed in dict.fromkeys(cell.seed for cell in grid.cells):
        cells = [cell for cell in grid.cells if cell.seed == seed]
        try:
            # In a process of its own, with its modules of common names (utils, logger).
            with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as process:
                process.submit(run_public, options.checkout, public_cell(cells[0]), options.out).result()
            for cell in cells:
                run_cell(cell, options.out)
        except UsageError as error:
            parser.error(str(error))


if __name__ == "__main__":
    main()
