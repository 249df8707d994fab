"""Cumulative coverage of all collected transitions, as cells of a grid record it."""

import contextlib
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from grids_for_tests import DMC_TASK, TASK, method, write_grid

from sb3_cure.cli.usage import UsageError
from sb3_cure.envs import physics_state, physics_state_names, rendering
from sb3_cure.envs.counting import TASK_REWARD, CellInfo
from sb3_cure.envs.wrappers import action_repeat_of
from sb3_cure.evaluation.result_files import read_rows
from sb3_cure.experiments.cells import run_cell
from sb3_cure.experiments.grid import check_arms, load_grid

WIDTHS = {"slider": 0.1, "hinge_1": 0.2}
ORACLE = {"sb3_cure.envs.counting.CountReward": {"widths": {"slider": 0.15, "hinge_1": 0.5}}}
QUICK: dict[str, Any] = dict(train_freq=50, gradient_steps=1, learning_starts=100, warmup_updates=0)


@pytest.fixture(scope="module", autouse=True)
def _gl() -> None:
    try:
        rendering.load_gl()
    except rendering.GLUnavailableError as error:
        pytest.skip(str(error))


def grid(folder: Path, **changes: Any) -> Any:
    methods = {"oracle": method(env_wrapper=[ORACLE], curiosity=None, **QUICK)}
    coverage = dict(widths=WIDTHS, at=[2000, 6000])
    arguments = dict(tasks=[DMC_TASK], methods=methods, budget=6000, evaluation=dict(every=6000, episodes=1))
    return load_grid(write_grid(folder, **{**arguments, "coverage": coverage, **changes}))


def test_cells_of_all_collected_states_are_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """At the stated steps, by other cells than the oracle's, whose reward is trained on and not evaluated by."""
    states, step = [], CellInfo.step

    def noted(self: CellInfo, action: np.ndarray) -> Any:
        result = step(self, action)
        states.append(physics_state(self))
        return result

    monkeypatch.setattr(CellInfo, "step", noted)
    [cell] = grid(tmp_path).cells
    folder = run_cell(cell, tmp_path / "out", pictures=False)
    rows = read_rows(folder / "coverage.csv")
    assert [(row["environment_steps"], row["agent_steps"]) for row in rows] == [(2000, 50), (6000, 150)]
    assert len(states) == 150
    names = physics_state_names(cell.make_env())
    seen = np.array(states)[:, [names.index(name) for name in WIDTHS]]
    for row in rows:
        cells = np.floor(seen[: row["agent_steps"]] / list(WIDTHS.values()))
        assert row["cells"] == len(np.unique(cells, axis=0)) > 3


def test_oracle_rewards_training_alone(tmp_path: Path) -> None:
    """Evaluations are of the task, whatever an arm trains on."""
    [cell] = grid(tmp_path).cells
    rewards = []
    for env in (cell.make_env(), cell.make_eval_env()):
        env.reset(seed=0)
        *_, reward, _, _, info = env.step(np.zeros(1, np.float32))
        rewards.append((reward, info[TASK_REWARD]))
        env.close()
    (oracle, met), (paid, task) = rewards
    assert oracle == 1 and met == task == paid < 0.1
    folder = run_cell(cell, tmp_path / "out", pictures=False)
    last = read_rows(folder / "eval.csv")[-1]
    assert last["rewards_met"] > last["agent_steps"], "the task's: the oracle's are at most 1 a step"


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_any_wrapper_may_change_rewards(order: tuple[int, int], tmp_path: Path) -> None:
    """In whatever class, and inside or outside of repeated actions, whose rewards are summed."""
    wrappers = ["grids_for_tests.Shaped", {"sb3_cure.envs.ActionRepeat": {"num_repeats": 3}}]
    arm = method(env_wrapper=[wrappers[index] for index in order])
    [cell] = load_grid(write_grid(tmp_path, methods={"shaped": arm})).cells
    plain, trained, measured = gym.make(TASK), cell.make_env(), cell.make_eval_env()
    for env in (plain, trained, measured):
        env.reset(seed=0)
        env.action_space.seed(0)
    for _ in range(3):
        action = trained.action_space.sample()
        met = sum(plain.step(action)[1] for _ in range(3))
        for env, shaping in ((trained, 100 * (3 if order == (0, 1) else 1)), (measured, 0)):
            *_, reward, _, _, info = env.step(action)
            assert info[TASK_REWARD] == pytest.approx(met) and reward == pytest.approx(met + shaping)


def test_policies_are_measured_in_the_wrappers_they_are_trained_in(tmp_path: Path) -> None:
    """Steps are counted as training makes them, of observations that it sees."""
    repeat = {"sb3_cure.envs.ActionRepeat": {"num_repeats": 2}}
    arm = method(env_wrapper=[repeat, ORACLE, "gymnasium.wrappers.NormalizeReward"], **QUICK)
    [cell] = grid(tmp_path, methods={"slow": arm}, coverage=None).cells
    with contextlib.closing(cell.make_env()) as env, contextlib.closing(cell.make_eval_env()) as measured:
        assert action_repeat_of(measured) == action_repeat_of(env) == 2 * 40
    folder = run_cell(cell, tmp_path / "out", pictures=False)
    last = read_rows(folder / "eval.csv")[-1]
    assert last["environment_steps"] == 2 * 40 * last["agent_steps"]


def test_coverage_goes_on_after_a_kill(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    [cell] = grid(tmp_path).cells
    whole = run_cell(cell, tmp_path / "whole", pictures=False)
    step, n_left = CellInfo.step, [105]

    def failing(self: CellInfo, action: np.ndarray) -> Any:
        n_left[0] -= 1
        if n_left[0] == 0:
            raise RuntimeError("the power went")
        return step(self, action)

    monkeypatch.setattr(CellInfo, "step", failing)
    with pytest.raises(RuntimeError, match="the power went"):
        run_cell(cell, tmp_path / "killed", 0, pictures=False)
    killed = run_cell(cell, tmp_path / "killed", 0, pictures=False)
    for name in ("coverage.csv", "episodes.csv"):
        assert (whole / name).read_text() == (killed / name).read_text()


def test_unknown_coordinates_are_found_before_anything_runs(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="widths must be > 0, for some of slider, hinge_1"):
        check_arms(grid(tmp_path, coverage=dict(widths={"elbow": 1.0}, at=[400])).cells)
    with pytest.raises(UsageError, match=r"coverage\.at"):
        grid(tmp_path, coverage=dict(widths=WIDTHS, at=[]))
