"""One cell of a grid: train, evaluate, keep the results. Begun anew, it goes on from its last checkpoint."""

import fcntl
import json
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env

from sb3_cure.cure_sac import CuReSAC
from sb3_cure.evaluation import run_episodes, trained_actors
from sb3_cure.experiments.files import Row, describe_run, read_rows, write_csv, write_json, write_text
from sb3_cure.experiments.grid import Cell, GridError
from sb3_cure.experiments.media import draw_cell, watch_reconstructions
from sb3_cure.experiments.visitation import measure_visits
from sb3_cure.files import flush_to_disk

#: Evaluations start from the same states in all cells
EVAL_SEED = 10_000
#: The file that tells that a cell is finished
DONE = "DONE"
#: The file that tells why a cell failed, until it is begun again
ERROR = "error.txt"
_PROGRESS_SECONDS = 2.0
_EVAL_COLUMNS = (
    "environment_steps", "agent_steps", "updates", "seconds", "return_mean", "return_std", "srl_loss",
    "task_srl_error", "curious_return_mean", "curious_srl_error",
)  # fmt: skip
_EPISODE_COLUMNS = ("environment_steps", "actor", "episode", "return")


def run_cell(cell: Cell, results: str | Path, checkpoint_minutes: float = 10.0, pictures: bool = True) -> Path:
    """Train and measure one cell, unless that is done.

    Writes ``config.json``, ``eval.csv``, ``episodes.csv``, ``run.json``, ``model.zip`` and pictures into the cell's
    folder; ``DONE`` comes last. A cell that was interrupted goes on from its last checkpoint, and what its files
    hold from after the checkpoint is dropped, so that no row appears twice.

    :param cell: What to run
    :param results: Folder of all results
    :param checkpoint_minutes: Minutes between two checkpoints: at most so much is lost by an interruption
    :param pictures: Whether to draw and to film as well
    :return: The cell's folder
    :raises GridError: if the folder holds the same cell with other settings
    :raises CellIsRunning: if another process is running it
    """
    folder = Path(results) / cell.folder
    check_settings(cell, results)
    folder.mkdir(parents=True, exist_ok=True)
    with _alone_in(folder):
        if not (folder / DONE).exists():
            (folder / ERROR).unlink(missing_ok=True)
            _keep_config(cell, folder)
            _CellRun(cell, folder, checkpoint_minutes, pictures).finish()
        shutil.rmtree(folder / "checkpoint", ignore_errors=True)
    return folder


def check_settings(cell: Cell, results: str | Path) -> None:
    """
    :param cell: A cell that is to be run, or that has been run
    :param results: Folder of all results
    :raises GridError: if its folder holds results of other settings
    """
    path = Path(results) / cell.folder / "config.json"
    if not path.exists():
        return
    begun, now = json.loads(path.read_text()), _plain(cell.config())
    for key in now:
        if begun.get(key) != now[key]:
            raise GridError(
                f"{path.parent} was run with other settings: {key} is {begun.get(key)!r} there and {now[key]!r} now. "
                "Choose another --out, or remove that folder."
            )


class _CellRun:
    """What a cell needs while it runs; ``finish`` does what is left to do."""

    def __init__(self, cell: Cell, folder: Path, checkpoint_minutes: float, pictures: bool):
        self.cell, self.folder = cell, folder
        self.pictures = pictures
        self.checkpoint_seconds = 60 * checkpoint_minutes
        self.eval_env = gym.make(cell.task, **cell.env_kwargs)
        self.action_repeat = action_repeat_of(self.eval_env)
        # Tells whether the task's reward has been seen, and how long everything took in all attempts.
        self.state: dict[str, Any] = {"phase": "pretrain" if cell.pretrain else "train", "seconds": 0.0, "attempts": []}
        self.evaluations: list[Row] = []
        self.episodes: list[Row] = []
        self.model = self._restore() or self._begin()
        self.state["attempts"].append({"started": _now(), **describe_run(), "device": str(self.model.device)})
        self._resumed_at = time.monotonic()
        self._reported_at = self._kept_at = -np.inf

    @property
    def checkpoints(self) -> Path:
        return self.folder / "checkpoint"

    @property
    def seconds(self) -> float:
        """Wall-clock time of all attempts, without what a kill undid."""
        return self.state["seconds"] + time.monotonic() - self._resumed_at

    def agent_steps(self, environment_steps: int) -> int:
        return -(-environment_steps // self.action_repeat)

    # ------------------------------------------------------------------ phases

    def finish(self) -> None:
        try:
            self._train()
            self._keep_results()
        finally:
            self.eval_env.close()
            if self.model.env is not None:
                self.model.env.close()

    def _train(self) -> None:
        cell, pretrain = self.cell, self.cell.pretrain
        if self.state["phase"] == "pretrain" and pretrain is not None:
            left = self.agent_steps(pretrain.budget) - self.model.num_timesteps
            if left > 0:
                fresh = self.model.num_timesteps == 0
                self.model.pretrain(left, pretrain.collector, callback=_Watch(self), reset_num_timesteps=fresh)
            # Also where the checkpoint was the last step's: then nothing was left for `pretrain` to end.
            self.model._end_pretraining()
            self.state["phase"] = "train"
            self.keep()
        left = self.agent_steps(cell.budget) - self.model.num_timesteps
        if cell.budget > 0 and left > 0:
            fresh = self.model.num_timesteps == 0
            drawing = watch_reconstructions(cell, self.action_repeat, self.folder) if self.pictures else []
            self.model.learn(left, callback=[_Watch(self), *drawing], reset_num_timesteps=fresh)

    def _keep_results(self) -> None:
        cell = self.cell
        # Not among the results until everything else is: the state from here on can be made anew.
        self.model.save(self.folder / "model.zip")
        if cell.kind == "visitation":
            measure_visits(self.model, cell, self.folder)
        if self.pictures:
            draw_cell(self.model, cell, self.folder)
        self.write_tables()
        self._report(force=True)
        write_json(self.folder / "run.json", self._run_conditions())
        write_text(self.folder / DONE, "")

    def _make_env(self) -> Any:
        # By a function: of an id SB3 asks for render_mode="rgb_array", which not every environment knows.
        return make_vec_env(lambda: gym.make(self.cell.task, **self.cell.env_kwargs), n_envs=self.cell.n_envs)

    def _begin(self) -> CuReSAC:
        return CuReSAC(env=self._make_env(), seed=self.cell.seed, **self.cell.build_arguments())

    # -------------------------------------------------------------- evaluation

    def evaluate(self) -> None:
        """Evaluate each policy over episodes that start from the same states in all cells."""
        steps = self.model.num_timesteps
        row: Row = dict.fromkeys(_EVAL_COLUMNS, "")
        row.update(environment_steps=steps * self.action_repeat, agent_steps=steps, updates=self.model._n_updates)
        for actor in trained_actors(self.model):
            errors, returns = [], []
            for number, episode in enumerate(
                run_episodes(self.model, self.eval_env, self.cell.eval_episodes, actor, seed=EVAL_SEED)
            ):
                returns.append(episode.total_reward)
                errors.append(episode.srl_errors)
                values = (row["environment_steps"], actor, number, episode.total_reward)
                self.episodes.append(dict(zip(_EPISODE_COLUMNS, values, strict=True)))
            if actor == "task":
                row.update(return_mean=float(np.mean(returns)), return_std=float(np.std(returns)))
            else:
                row["curious_return_mean"] = float(np.mean(returns))
            if getattr(self.model.policy, "srl", None) is not None:
                row[f"{actor}_srl_error"] = float(np.concatenate(errors).mean())
        self.evaluations.append(row)

    def is_evaluation_due(self, finished: bool) -> bool:
        """
        :param finished: Whether training has ended: then the last row is due, whatever its step
        """
        steps = self.model.num_timesteps * self.action_repeat
        if not self.evaluations:
            return True
        last = self.evaluations[-1]["environment_steps"]
        every = self.cell.eval_every
        return steps > last and (finished or steps // every > last // every)

    def write_tables(self) -> None:
        write_csv(self.folder / "eval.csv", _EVAL_COLUMNS, self.evaluations)
        write_csv(self.folder / "episodes.csv", _EPISODE_COLUMNS, self.episodes)

    # ------------------------------------------------------------- checkpoints

    def keep(self) -> None:
        """Write a checkpoint beside the last one, then remove that: one of them is always whole."""
        unfinished = self.checkpoints / "unfinished"
        shutil.rmtree(unfinished, ignore_errors=True)
        unfinished.mkdir(parents=True)
        self.model.save(unfinished / "model.zip")
        self.model.save_replay_buffer(unfinished / "replay_buffer.pkl")
        state = {**self.state, "seconds": self.seconds, "agent_steps": self.model.num_timesteps}
        write_json(unfinished / "state.json", state)
        write_csv(unfinished / "eval.csv", _EVAL_COLUMNS, self.evaluations)
        write_csv(unfinished / "episodes.csv", _EPISODE_COLUMNS, self.episodes)
        for path in (*unfinished.iterdir(), unfinished):
            flush_to_disk(path)
        older = self._generations()
        unfinished.rename(self.checkpoints / str(older[-1] + 1 if older else 0))
        for number in older:
            shutil.rmtree(self.checkpoints / str(number))
        self.write_tables()
        self._kept_at = time.monotonic()

    def is_checkpoint_due(self) -> bool:
        since = max(self._kept_at, self._resumed_at)
        return time.monotonic() - since > self.checkpoint_seconds

    def _restore(self) -> CuReSAC | None:
        """The newest checkpoint that can be read, or None."""
        for number in reversed(self._generations()):
            try:
                return self._load(self.checkpoints / str(number))
            except Exception as error:
                print(f"The checkpoint {self.checkpoints / str(number)} cannot be read ({error}) and is left out.")
        return None

    def _load(self, newest: Path) -> CuReSAC:
        # Trusted: what an earlier version kept of an unfinished run is pickled, and lies in the run's own folder.
        model = CuReSAC.load(
            newest / "model.zip", env=self._make_env(), custom_objects=self.cell.custom_objects(), trusted=True
        )
        model.load_replay_buffer(newest / "replay_buffer.pkl", trusted=True)
        self.state = json.loads((newest / "state.json").read_text())
        self.evaluations = read_rows(newest / "eval.csv")
        self.episodes = read_rows(newest / "episodes.csv")
        # Loading starts all random streams from the cell's seed: without this each attempt would repeat the first's.
        model.set_random_seed(self.cell.seed + 1000 * len(self.state["attempts"]))
        return model

    def _generations(self) -> list[int]:
        if not self.checkpoints.exists():
            return []
        return sorted(int(path.name) for path in self.checkpoints.iterdir() if path.name.isdigit())

    # ---------------------------------------------------------------- progress

    def _report(self, force: bool = False) -> None:
        """Tell a display, which may be another process, how far this is."""
        if not force and time.monotonic() - self._reported_at < _PROGRESS_SECONDS:
            return
        self._reported_at = time.monotonic()
        returns = [row["return_mean"] for row in self.evaluations if row["return_mean"] != ""]
        write_json(
            self.folder / "progress.json",
            {
                "phase": self.state["phase"],
                "agent_steps": self.model.num_timesteps,
                "environment_steps": self.model.num_timesteps * self.action_repeat,
                "seconds": self.seconds,
                "best_return": max(returns, default=None),
                "time": time.time(),
            },
        )

    def report(self) -> None:
        self._report()

    def _run_conditions(self) -> dict[str, Any]:
        attempts = self.state["attempts"]
        return {
            **describe_run(),
            "device": str(self.model.device),
            "precision": getattr(self.model, "_computed_precision", "fp32"),
            "started": attempts[0]["started"],
            "finished": _now(),
            "seconds": round(self.seconds, 1),
            "attempts": len(attempts),
            # Where it was interrupted: what each attempt ran on
            **({"history": attempts} if len(attempts) > 1 else {}),
        }


class _Watch(BaseCallback):
    """Evaluates, keeps checkpoints and reports progress between two agent steps, when all updates are made."""

    def __init__(self, run: _CellRun):
        super().__init__()
        self.run = run
        self._losses: list[th.Tensor] = []

    def _on_step(self) -> bool:
        loss = self.logger.name_to_value.get("train/srl_loss")
        if loss is not None:
            self._losses.append(th.as_tensor(loss))
        self.run.report()
        return True

    def _on_rollout_start(self) -> None:
        self._look(finished=False)

    def _on_training_end(self) -> None:
        self._look(finished=True)

    def _look(self, finished: bool) -> None:
        run = self.run
        is_training = run.state["phase"] == "train"
        evaluates = is_training and run.is_evaluation_due(finished)
        if evaluates:
            run.evaluate()
            run.evaluations[-1]["srl_loss"] = float(th.stack(self._losses).mean()) if self._losses else ""
            run.evaluations[-1]["seconds"] = round(run.seconds, 1)
            self._losses.clear()
            run.write_tables()
        if run.is_checkpoint_due():
            run.keep()


def action_repeat_of(env: gym.Env) -> int:
    """
    :param env: Any environment
    :return: Environment steps per agent step: what it tells, else 1
    """
    return int(env.get_wrapper_attr("action_repeat")) if env.has_wrapper_attr("action_repeat") else 1


class CellIsRunning(GridError):
    """Another process is at this cell."""


@contextmanager
def _alone_in(folder: Path) -> Iterator[None]:
    """The lock goes with the process, however that ends."""
    with (folder / ".lock").open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise CellIsRunning(
                f"{folder} is being run by another process: wait for it, or choose another --out."
            ) from None
        except OSError as error:
            print(f"{folder} cannot be locked ({error.strerror}): take care that no other process runs this cell.")
        yield


def _keep_config(cell: Cell, folder: Path) -> None:
    env = gym.make(cell.task, **cell.env_kwargs)
    write_json(folder / "config.json", {**_plain(cell.config()), "action_repeat": action_repeat_of(env)})
    env.close()


def _plain(config: dict[str, Any]) -> dict[str, Any]:
    """As it comes back from a file."""
    return json.loads(json.dumps(config, default=repr))


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
