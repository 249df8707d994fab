"""Run one cell of a grid: train, evaluate, write the results. Started again, it continues at its last checkpoint."""

import contextlib
import json
import shutil
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import filelock
import gymnasium as gym
import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env

from sb3_cure.cli.progress import TimeLeft
from sb3_cure.cli.usage import UsageError
from sb3_cure.cli.zoo_files import ALGORITHMS
from sb3_cure.cure.algorithms import CuReSAC
from sb3_cure.envs.wrappers import action_repeat_of
from sb3_cure.evaluation.result_files import Row, describe_run, write_csv, write_json, write_text
from sb3_cure.evaluation.rollouts import returns_and_errors, run_episodes, trained_actors, untouched_randomness
from sb3_cure.experiments import rewards_met
from sb3_cure.experiments.coverage import CoverageRecorder
from sb3_cure.experiments.grid import DONE, ERROR, SETTINGS, Cell, first_difference, read_json
from sb3_cure.experiments.media import draw_cell, reconstruction_callbacks
from sb3_cure.experiments.visitation import measure_visits
from sb3_cure.persistence import ExactCheckpoint
from sb3_cure.persistence.files import locked

#: Seed of evaluations, which start from the same states in all cells, see ``run_episodes``
EVAL_SEED = 10_000
_EVAL_COLUMNS = (
    "environment_steps", "agent_steps", "updates", "seconds", "cpu_seconds", "return_mean", "return_std",
    "task_srl_error", "curious_return_mean", "curious_srl_error", *rewards_met.COLUMNS,
)  # fmt: skip
_EPISODE_COLUMNS = ("environment_steps", "actor", "episode", "return")


def run_cell(cell: Cell, results: str | Path, checkpoint_minutes: float = 10.0, pictures: bool = True) -> Path:
    """Train and measure one cell, unless that is done.

    Writes ``config.json``, ``eval.csv``, ``episodes.csv``, ``run.json``, ``model.zip`` (and ``pretrained.zip``, the
    model before the task) and pictures into the cell's folder; ``DONE`` comes last. A cell that was interrupted
    continues at its last checkpoint; rows that it wrote after the checkpoint are dropped, so that no row appears twice.

    :param cell: The cell
    :param results: Folder of all results
    :param checkpoint_minutes: Minutes between two checkpoints, the most that an interruption loses
    :param pictures: Whether to draw and to film as well
    :return: The cell's folder
    :raises UsageError: if the folder holds the same cell with other settings
    :raises CellIsRunning: if another process is running it
    """
    folder = Path(results) / cell.folder
    check_cell(folder, cell)
    folder.mkdir(parents=True, exist_ok=True)
    with alone_in(folder):
        if not (folder / DONE).exists():
            (folder / ERROR).unlink(missing_ok=True)
            _run(cell, folder, checkpoint_minutes, pictures)
        shutil.rmtree(folder / "checkpoint", ignore_errors=True)
    return folder


def check_cell(folder: Path, cell: Cell) -> None:
    """Refuse a folder that holds results of other settings.

    :param folder: The cell's folder, whether it exists or not
    :param cell: The cell
    :raises UsageError: if they differ
    """
    check_settings(folder / "config.json", {key: value for key, value in asdict(cell).items() if key in SETTINGS})


def check_settings(path: Path, settings: dict[str, Any]) -> None:
    """Refuse a file of settings that differ from the given ones.

    :param path: A JSON file, which may be missing
    :param settings: Settings of this run
    :raises UsageError: if they differ
    """
    before = read_json(path) if path.exists() else {}
    now = json.loads(json.dumps(settings, default=str))
    if before and (difference := first_difference(before, now, now)):
        key, was, is_now = difference
        while isinstance(was, dict) and isinstance(is_now, dict):
            absent = "left out"
            inner = next(each for each in (*was, *is_now) if was.get(each, absent) != is_now.get(each, absent))
            key, was, is_now = f"{key}.{inner}", was.get(inner, absent), is_now.get(inner, absent)
        raise UsageError(
            f"{path.parent} was run with other settings: {key} was {was!r} and is {is_now!r} now. Choose another "
            "--out, or remove that folder."
        )


def _run(cell: Cell, folder: Path, checkpoint_minutes: float, pictures: bool) -> None:
    """Make an attempt at a cell."""
    # A function and no id: SB3 would pass render_mode="rgb_array" with an id, which not every environment accepts.
    with (
        contextlib.closing(cell.make_eval_env()) as eval_env,
        contextlib.closing(make_vec_env(cell.make_env, n_envs=cell.n_envs)) as env,
    ):
        record = _Record(cell, folder, eval_env)
        write_json(folder / "config.json", {**asdict(cell), "action_repeat": record.action_repeat})
        checkpoints = _TimedCheckpoint(folder / "checkpoint", checkpoint_minutes)
        if ExactCheckpoint.exists(checkpoints.path):  # the newest complete one
            objects, device = cell.custom_objects(), cell.arguments.get("device", "auto")  # archives have no device
            model = ALGORITHMS[cell.algo].resume(checkpoints.path, env, device, custom_objects=objects)
            pretrain = cell.pretrain if model.is_pretraining else None
        else:
            model, pretrain = cell.make_model(env), cell.pretrain
        # The same calls in every attempt: a resumed model does what is left of them.
        if pretrain is not None:
            model.pretrain(
                record.agent_steps(pretrain.budget),
                pretrain.collector,
                callback=[record, checkpoints, TimeLeft(f"{cell.folder} (pretraining)")],
                keep_replay_buffer=cell.keep_replay_buffer,
            )
            model.save(folder / "pretrained.zip")
        record.evaluates = True
        if cell.budget > 0:
            clock = TimeLeft(str(cell.folder), best_return=record.best_return)
            callbacks: list[BaseCallback] = [record.rewards, record, checkpoints, clock]
            if cell.coverage is not None:
                path = folder / "coverage.csv"
                callbacks.append(CoverageRecorder(cell.coverage.at, record.action_repeat, path))
            if pictures:
                callbacks += reconstruction_callbacks(cell, record.action_repeat, folder)
            model.learn(record.agent_steps(cell.budget), callback=callbacks)
        _write_results(cell, folder, model, record, pictures)


def _write_results(cell: Cell, folder: Path, model: CuReSAC, record: "_Record", pictures: bool) -> None:
    model.save(folder / "model.zip")
    if cell.kind == "visitation":
        measure_visits(model, cell, folder)
    if pictures:
        try:
            draw_cell(model, cell, folder)
        except Exception as error:  # the results are complete without them
            print(f"{cell.folder} lacks some of its pictures: {type(error).__name__}: {error}")
    record.write_tables()
    write_json(folder / "run.json", record.conditions(model))
    write_text(folder / DONE, "")


class _TimedCheckpoint(ExactCheckpoint):
    """Checkpoints by the clock, because cells differ in speed.

    :param path: Folder of the checkpoints
    :param minutes: Minutes between two checkpoints
    """

    def __init__(self, path: Path, minutes: float):
        super().__init__(save_freq=1, path=path, keep=2)
        self.seconds = 60 * minutes
        self._due_at = np.inf

    def _on_training_start(self) -> None:
        super()._on_training_start()
        self._due_at = time.monotonic() + self.seconds

    def is_due(self) -> bool:
        if time.monotonic() < self._due_at:
            return False
        self._due_at = time.monotonic() + self.seconds
        return super().is_due()


class _Record(BaseCallback):
    """Evaluate between two agent steps, once all updates are made, and keep times and conditions.

    A resumed cell continues from its records.

    :param cell: The cell
    :param folder: Its folder
    :param eval_env: The environment to evaluate in
    """

    def __init__(self, cell: Cell, folder: Path, eval_env: gym.Env):
        super().__init__()
        self.cell, self.folder, self.eval_env = cell, folder, eval_env
        self.action_repeat = action_repeat_of(eval_env)
        #: Whether the task's reward is being learned from
        self.evaluates = False
        self.evaluations: list[Row] = []
        self.episodes: list[Row] = []
        #: Machine, versions, precision and CPU time of each attempt, this one last
        self.attempts: list[Row] = []
        #: Wall-clock time of all attempts, without what a kill undid
        self.seconds = 0.0
        self.rewards = rewards_met.RewardsMet()
        self._now, self._cpu_now = time.monotonic(), time.process_time()
        self._has_begun = False

    def state_dict(self) -> dict[str, Any]:
        """Get the records, without clocks.

        :return: Plain data
        """
        return {name: getattr(self, name) for name in ("evaluations", "episodes", "attempts", "seconds")}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the records.

        :param state: Result of ``state_dict``
        """
        vars(self).update(state)

    def agent_steps(self, environment_steps: int) -> int:
        return -(-environment_steps // self.action_repeat)

    def _on_training_start(self) -> None:
        if not self._has_begun:  # by pretraining; the records of earlier attempts are restored by now
            self._has_begun = True
            model: Any = self.model
            self.attempts.append({"started": _timestamp(), **_describe(model), "cpu_seconds": 0.0})

    def _on_step(self) -> bool:
        self._tick()
        return True

    def best_return(self) -> float | None:
        """Best mean return of the task policy in an evaluation; None before the first."""
        return max((row["return_mean"] for row in self.evaluations if row["return_mean"] != ""), default=None)

    def _on_rollout_start(self) -> None:
        self._evaluate_if_due(finished=False)

    def _on_training_end(self) -> None:
        self._evaluate_if_due(finished=True)

    def _tick(self) -> None:
        now, cpu_now = time.monotonic(), time.process_time()
        self.seconds += now - self._now
        self.attempts[-1]["cpu_seconds"] += cpu_now - self._cpu_now
        self._now, self._cpu_now = now, cpu_now

    @property
    def cpu_seconds(self) -> float:
        """CPU time of all attempts, without what a kill undid."""
        return round(sum(attempt["cpu_seconds"] for attempt in self.attempts), 1)

    def _evaluate_if_due(self, finished: bool) -> None:
        steps = self.num_timesteps * self.action_repeat
        if self.evaluates and is_evaluation_due(self.evaluations, steps, self.cell.eval_every, finished):
            self.evaluate(finished)
        self._tick()

    def evaluate(self, finished: bool) -> None:
        """Evaluate each policy over episodes that start alike in all cells, see ``run_episodes``.

        :param finished: Whether training has ended
        """
        model: Any = self.model
        steps, actors = model.num_timesteps, trained_actors(model)
        row: Row = dict.fromkeys(_EVAL_COLUMNS, "")
        row.update(environment_steps=steps * self.action_repeat, agent_steps=steps, updates=model._n_updates)
        self.evaluations.append(row)
        if "task" in actors:
            self._measure("task", row)
        if "curious" in actors and (finished or self.cell.eval_curious != "end"):
            self._measure("curious", row)
        self._tick()
        row.update(seconds=round(self.seconds, 1), cpu_seconds=self.cpu_seconds)
        row.update({name: round(value, 3) for name, value in self.rewards.sums.items()})
        self.write_tables()

    def _measure(self, actor: str, row: Row) -> None:
        """Evaluate one policy, and write its returns and SRL error into a row of ``eval.csv``."""
        model = self.model
        # Environments may draw from the global generators of Python or NumPy, as training does.
        with untouched_randomness(model.device, EVAL_SEED):
            episodes = run_episodes(model, self.eval_env, self.cell.eval_episodes, actor, seed=EVAL_SEED)
            returns, errors = returns_and_errors(episodes)
        totals = returns.tolist()
        if not np.isfinite(totals).all():
            raise ValueError(f"{self.cell.task} gave an evaluation the returns {totals}: correct its rewards.")
        for number, value in enumerate(totals):
            values = (row["environment_steps"], actor, number, value)
            self.episodes.append(dict(zip(_EPISODE_COLUMNS, values, strict=True)))
        if actor == "task":
            row.update(return_mean=float(returns.mean()), return_std=float(returns.std()))
        else:
            row["curious_return_mean"] = float(returns.mean())
        if len(errors) > 0:
            row[f"{actor}_srl_error"] = float(errors.mean())

    def write_tables(self) -> None:
        write_csv(self.folder / "eval.csv", _EVAL_COLUMNS, self.evaluations)
        write_csv(self.folder / "episodes.csv", _EPISODE_COLUMNS, self.episodes)

    def conditions(self, model: CuReSAC) -> dict[str, Any]:
        """Conditions under which the results were obtained.

        :param model: The cell's model
        :return: Versions, machine, times, attempts
        """
        return {
            **_describe(model),
            "started": self.attempts[0]["started"],
            "finished": _timestamp(),
            "seconds": round(self.seconds, 1),
            "cpu_seconds": self.cpu_seconds,
            "attempts": len(self.attempts),
            **({"history": self.attempts} if len(self.attempts) > 1 else {}),
        }


def is_evaluation_due(evaluations: Sequence[Row], steps: int, every: int, finished: bool) -> bool:
    """Whether to evaluate now.

    :param evaluations: Rows of ``eval.csv`` so far
    :param steps: Environment steps so far
    :param every: Environment steps between two evaluations
    :param finished: Whether training has ended: then the last row is due, whatever its step
    """
    if not evaluations:
        return True
    last = evaluations[-1]["environment_steps"]
    return steps > last and (finished or steps // every > last // every)


class CellIsRunning(UsageError):
    """Another process runs this cell."""


@contextlib.contextmanager
def alone_in(folder: Path, wait: bool = False) -> Iterator[None]:
    """Hold a folder's lock, which ends with the process.

    :param folder: A folder
    :param wait: Whether to wait for another process that holds it
    :raises CellIsRunning: if another process holds it
    """
    with contextlib.ExitStack() as stack:
        try:
            stack.enter_context(locked(folder, -1 if wait else 1))  # not 0: `is_held` holds it for a moment, too
        except filelock.Timeout:
            raise CellIsRunning(f"{folder} is being run by another process: wait, or choose another --out.") from None
        yield


def is_held(folder: Path) -> bool:
    """Whether a process holds a folder's lock; locks of other machines may be invisible.

    :param folder: Folder of a cell, whether it exists or not
    """
    try:
        if (folder / ".lock").exists():
            filelock.FileLock(folder / ".lock", fallback_to_soft=False).acquire(timeout=0).lock.release()
    except filelock.Timeout:
        return True
    except OSError:
        return False
    return False


def _describe(model: CuReSAC) -> dict[str, Any]:
    """Versions, machine and commit, and where and in which number format the model computes."""
    return {**describe_run(), "device": str(model.device), "precision": model._computed_precision}


def _timestamp() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
