"""Grid files: what they hold, and that what cannot be run is refused before the first cell."""

import json
import random
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
import yaml
from envs_for_tests import PixelBox
from grids_for_tests import DMC_TASK, TASK, method, write_grid

from sb3_cure.cli.main import main
from sb3_cure.cli.usage import UsageError
from sb3_cure.experiments import run
from sb3_cure.experiments.grid import Cell, check_arms, load_grid

GRIDS = Path(__file__).parents[2] / "zoo_configs" / "experiments"


def test_grid_is_every_task_method_and_seed(tmp_path: Path) -> None:
    """Seeds are outermost: an interrupted grid holds whole comparisons. Overrides beat the zoo's entry."""
    methods = {"a": {"config": "zoo.yml"}, "b": method(curiosity_prob=0.7, train_freq=[1, "episode"])}
    path = write_grid(tmp_path, methods=methods, seeds=[3, 5], baseline="b")
    grid = load_grid(path)
    assert [(cell.seed, cell.method) for cell in grid.cells] == [(3, "a"), (3, "b"), (5, "a"), (5, "b")]
    assert [cell.arguments.get("curiosity_prob") for cell in grid.cells[:2]] == [None, 0.7]
    assert grid.cells[1].build_arguments()["train_freq"] == (1, "episode"), "YAML knows no pairs"
    assert grid.cells[0].folder == Path("tiny", "PixelBox", "a", "seed3")
    assert all(cell.arguments["batch_size"] == 8 and "env_kwargs" not in cell.arguments for cell in grid.cells)
    with pytest.raises(UsageError, match=r"--seeds is -1, but .* lists 2"):
        load_grid(path, seeds=-1)
    few = load_grid(path, seeds=[5], methods=["b"], tasks=["PixelBox"], budget=40)
    assert [(cell.seed, cell.method, cell.budget) for cell in few.cells] == [(5, "b", 40)]
    assert few.description["methods"].keys() == {"a", "b"}, "what was not chosen is still part of the experiment"
    assert few.description["seeds"] == [3, 5] and few.description["baseline"] == "b"


def test_grids_and_settings_of_the_package_by_name(tmp_path: Path) -> None:
    """The same cells as by path; names that there are not are told from those that there are."""
    assert load_grid("fast/curves") == load_grid(GRIDS / "fast" / "curves.yml")
    methods = {"a": {"config": "fast/sac_ae"}}
    (cell,) = load_grid(write_grid(tmp_path, methods=methods, tasks=[DMC_TASK], seeds=1)).cells
    assert (cell.arguments["policy"], cell.env_kwargs["renderer"]) == ("CnnPolicy", "fast")
    with pytest.raises(UsageError, match=r"'fast/curve' is neither .* did you mean fast/curves"):
        load_grid("fast/curve")
    with pytest.raises(UsageError, match=r"'sac' is neither .* did you mean sac_ae"):
        load_grid(write_grid(tmp_path, methods={"a": {"config": "sac"}}))


@pytest.mark.parametrize(
    ("own", "asked", "expected"),
    [(400, 400, (400, 100)), (400, 40, (40, 10)), (400, 1, (1, 1)), (300, 1000, (1000, 333))],
)
def test_another_budget_scales_pretraining(tmp_path: Path, own: int, asked: int, expected: tuple[int, int]) -> None:
    """In proportion, at least a step, in cells and in the description; a method that does not pretrain has no phase."""
    pretrain = {"collector": "random", "budget": 100}
    methods = {
        "none": {"config": "zoo.yml"},
        "both": {"config": "zoo.yml", "pretrain": pretrain},
        "alone": {"config": "zoo.yml", "pretrain": pretrain, "train": False},
    }
    path = write_grid(tmp_path, budget=own, methods=methods)
    grid = load_grid(path, budget=asked)
    budgets = [(cell.budget, cell.pretrain.budget if cell.pretrain else 0) for cell in grid.cells]
    assert budgets == [(asked, 0), expected, (0, expected[1])]
    described = grid.description["methods"]
    assert "pretrain" not in described["none"] and grid.description["budget"] == asked
    assert described["both"]["pretrain"] == {"collector": "random", "budget": expected[1]}
    unscaled = load_grid(path).description["methods"]
    assert all(unscaled[name].get("pretrain") == method.get("pretrain") for name, method in methods.items())
    counted = write_grid(tmp_path, budget=own, coverage=dict(widths=dict(place=1.0), at=[100, own]))
    assert load_grid(counted, budget=asked).cells[0].coverage.at == sorted({expected[1], asked})  # type: ignore[union-attr]


def test_most_specific_zoo_entry_counts(tmp_path: Path) -> None:
    """A task's own, with or without its module, then its namespace's, then the default."""
    path = write_grid(tmp_path, tasks=[DMC_TASK, "dmc_pixels/reacher-easy-v0", TASK])
    entries = {DMC_TASK: {"gamma": 0.1}, "dmc_pixels": {"gamma": 0.2}, "default": {"gamma": 0.3}}
    (tmp_path / "zoo.yml").write_text(yaml.safe_dump(entries))
    assert [cell.arguments["gamma"] for cell in load_grid(path).cells] == [0.1, 0.2, 0.3]


def test_numbers_with_exponents_alone_are_numbers(tmp_path: Path) -> None:
    """YAML 1.1 takes 1e-6 for a text, which would end the cell in its first update."""
    path = write_grid(tmp_path)
    (tmp_path / "zoo.yml").write_text(
        "default: {tau: 1e-2, beta: -1E+3, gamma: .5e0, name: 1e, folder: e5, share: 0.5}"
    )
    [cell] = load_grid(path).cells
    expected = {"tau": 0.01, "beta": -1000.0, "gamma": 0.5, "name": "1e", "folder": "e5", "share": 0.5}
    assert {name: cell.arguments[name] for name in expected} == expected


WRONG: dict[str, tuple[dict[str, Any], str]] = {
    "an unknown kind": (dict(kind="curve"), "kind: Input should be 'curves' or 'visitation'"),
    "an unknown key": (dict(budgets=3), "budgets is no key of a grid; did you mean budget"),
    "no seeds": (dict(seeds=0), "seeds: .*at least 1 item"),
    "an unknown task": (
        dict(tasks=["dmc_pixels/cartpole-swing-v0"]),
        "tasks.0: .*did you mean dmc_pixels/cartpole-swingup-v0",
    ),
    "no module": (dict(tasks=["no_camera:tests/Camera-v0"]), "tasks.0: there is no module 'no_camera'"),
    "tasks of one folder": (dict(tasks=["CartPole-v0", "CartPole-v1"]), "two tasks would share a folder"),
    "no folder": (dict(experiment="../elsewhere"), "experiment: String should match pattern"),
    "a method that is no folder": (dict(methods={"a/b": {"config": "zoo.yml"}}), "methods.a/b.*should match pattern"),
    "no zoo file": (
        dict(methods={"a": {"config": "no.yml"}}),
        "there is no .*no.yml",
    ),
    "neither of both": (dict(methods={"a": {"config": "zoo.yml", "train": False}}), "'a' neither trains nor"),
    "cells that are counted too late": (
        dict(budget=100, coverage=dict(widths=dict(place=1.0), at=[100, 120])),
        "coverage.at has 120, after the end of a training of 100",
    ),
    "a setting of rl-zoo3's programs": (
        dict(methods={"a": method(frame_stack=3)}),
        "method 'a' of .* has frame_stack, which `train` knows and grids do not: env_wrapper stacks",
    ),
    "a length of rl-zoo3's": (dict(methods={"a": method(n_timesteps=9)}), "overrides n_timesteps: the grid's budget"),
    "an unknown baseline": (dict(baseline="sac"), "baseline is 'sac', but the methods are cure"),
    "pictures that heads cannot judge alike": (
        dict(kind="visitation", methods={str(n): method(env_kwargs={"frame_stack": n}) for n in (2, 3)}),
        "differ in env_kwargs .*, but common heads judge all alike",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_grid_is_one_sentence(tmp_path: Path, name: str) -> None:
    changes, sentence = WRONG[name]
    with pytest.raises(UsageError, match=sentence) as refusal:
        load_grid(write_grid(tmp_path, **changes))
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    "overrides",
    [
        {"curiosity_prob": 1.4},
        {"prob": 1},
        {"policy_kwargs": "dict(net_arch=[1])"},
        {"srl": "my_heads.Nowhere"},
        {"env_kwargs": {"imagesize": 36}},
        {"policy_kwargs": {"features_extractor_kwargs": {"n_layers": 12}}},
    ],
    ids=lambda overrides: next(iter(overrides)),
)
def test_settings_that_cannot_work_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture, overrides: dict[str, Any]
) -> None:
    """By a dry run as by a run, before anything is written."""
    path = write_grid(tmp_path, methods={"right": {"config": "zoo.yml"}, "wrong": method(**overrides)})
    for more in ([], ["--dry-run"]):
        assert main(["experiment", str(path), "--out", str(tmp_path / "out"), *more]) == 2
        assert f"method 'wrong' on {TASK} cannot be built: " in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_statistics_that_evaluations_lack_are_refused(tmp_path: Path) -> None:
    """Each environment would standardise observations by what it has seen itself."""
    wrapped = method(policy="MlpPolicy", env_wrapper="gymnasium.wrappers.NormalizeObservation")
    grid = load_grid(write_grid(tmp_path, methods={"a": wrapped}, tasks=["Pendulum-v1"]))
    with pytest.raises(UsageError, match="evaluations would not share NormalizeObservation's statistics"):
        check_arms(grid.cells)


def test_wrong_command_line_is_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """The options of ``sb3-cure experiment``, before anything is written."""
    path = str(write_grid(tmp_path))
    for wrong, sentence in {
        "--tasks finger": "'finger' is not in",
        "--methods none": "'none' is not in",
        "--budget 10m": "'10m' is no number of steps",
        "--seeds x": "argument --seeds: invalid",
        "--seeds=": "argument --seeds: invalid",
        "--seeds ,": "seeds: List should have at least 1 item",
        "--tasks ,": "'' is not in",
        "--seeds 0": "seeds: List should have at least 1 item",
    }.items():
        try:
            status = main(["experiment", path, "--out", str(tmp_path / "out"), *wrong.split()])
        except SystemExit as stop:  # argparse's
            status = stop.code  # type: ignore[assignment]
        assert status == 2
        assert sentence in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_checking_arms_leaves_randomness_and_memory_alone(tmp_path: Path) -> None:
    """Their networks are built, without the replay buffer."""
    grid = load_grid(write_grid(tmp_path, methods={"a": method(buffer_size=10**12)}))
    before = th.get_rng_state(), np.random.get_state()[1].tolist(), random.getstate()  # type: ignore[index, union-attr]
    check_arms(grid.cells)
    assert th.equal(th.get_rng_state(), before[0])
    assert (np.random.get_state()[1].tolist(), random.getstate()) == before[1:]  # type: ignore[index, union-attr]


def project_cells() -> list[Cell]:
    """A cell of each arm of the project's grids, those of other tasks and budgets left out."""
    arms: dict[str, Cell] = {}
    for path in sorted(GRIDS.rglob("*.yml")):
        grid = load_grid(path, seeds=1)
        assert grid.experiment == ("fast_" if path.parent.name == "fast" else "") + path.stem
        for cell in grid.cells:
            collector = cell.pretrain and cell.pretrain.collector
            size = cell.env_kwargs.get("image_size", 84)
            arms.setdefault(f"{cell.arguments} {size} {collector} {cell.budget > 0}", cell)
    return list(arms.values())


def test_project_grids_can_be_built() -> None:
    """Every arm's arguments are accepted in spaces like the task's, with the agents that they ask for."""
    kwargs = {"net_arch": [8], "features_extractor_kwargs": {"n_filters": 2}}
    arms = project_cells()
    assert len(arms) > 20
    for cell in arms:
        env = PixelBox(3, size=cell.env_kwargs.get("image_size", 84))
        model = cell.make_model(env, policy_kwargs=kwargs, buffer_size=1, device="cpu")
        assert (model.policy.srl is None) == (cell.arguments.get("srl", "rae") is None)
        assert hasattr(model.policy, "encoder") and model.seed == cell.seed


def test_project_pretraining_trains_in_miniature() -> None:
    """Each collector pretrains for 40 steps in the project's own settings, then the task is learned."""
    few = {"buffer_size": 50, "learning_starts": 30, "warmup_updates": 2, "batch_size": 4}
    few["policy_kwargs"] = {"net_arch": [8], "features_extractor_kwargs": {"n_filters": 2}}
    for collector in ("random", "curious"):
        cell = next(cell for cell in project_cells() if cell.pretrain and cell.pretrain.collector == collector)
        model = cell.make_model(PixelBox(3, size=48), device="cpu", **few)
        model.pretrain(40, collector)
        model.learn(40)
        assert model.num_timesteps == 40
        assert float(model.logger.name_to_value["train/srl_loss"]) > 0


def test_folders_of_earlier_versions_are_continued(tmp_path: Path) -> None:
    """Their config.json lacks newer keys: those cells had the defaults, and nothing else."""
    grid = load_grid(write_grid(tmp_path))
    (cell,) = grid.cells
    folder = tmp_path / cell.folder
    folder.mkdir(parents=True)
    (tmp_path / "tiny" / "grid.json").write_text(json.dumps(grid.description))
    earlier = {key: value for key, value in asdict(cell).items() if key not in ("algo", "eval_curious", "coverage")}
    (folder / "config.json").write_text(json.dumps(earlier))
    (folder / "DONE").touch()
    run.check_grid(grid, tmp_path)
    for changed, key in ((replace(cell, algo="cure_tqc"), "algo"), (replace(cell, eval_curious="end"), "eval_curious")):
        with pytest.raises(UsageError, match=f"run with other settings: {key} was"):
            run.check_grid(replace(grid, cells=(changed,), arms=(changed,)), tmp_path)
