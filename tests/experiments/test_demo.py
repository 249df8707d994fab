"""The demo writes what it promises, from real pixels."""

import csv
import itertools
import json
from pathlib import Path
from types import SimpleNamespace

import imageio.v2 as imageio
import numpy as np
import pytest
from envs_for_tests import PixelBox, tiny_model
from PIL import Image

from sb3_cure import CuReSAC
from sb3_cure.experiments import demo


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a short demo, which exits with 0 whatever it learned."""
    folder = tmp_path_factory.mktemp("demo")
    with pytest.MonkeyPatch.context() as few:
        small = dict(learning_starts=150, warmup_updates=5, batch_size=8)
        few.setattr(demo, "SETTINGS", {**demo.SETTINGS, **small})
        for name, value in (("EVALUATIONS", 1), ("ROWS", 2), ("EPISODES", 2)):
            few.setattr(demo, name, value)
        assert demo.main(["--out", str(folder), "--steps", "170", "--minutes", "5"]) == 0
    return folder


def test_demo_reports_returns_and_errors(written: Path) -> None:
    """The numbers of the summary are those of the tables."""
    summary = json.loads((written / "summary.json").read_text())
    assert summary["agent_steps"] == 170 and summary["environment_steps"] == 1360
    assert summary["updates"] == 5 + 20 // 2
    assert summary["ratio"] == pytest.approx(summary["final_return_mean"] / summary["random_return_mean"], abs=0.01)
    rows = list(csv.DictReader((written / "learning_curve.csv").open()))
    assert [int(row["agent_steps"]) for row in rows] == [170]
    errors = list(csv.DictReader((written / "errors.csv").open()))
    for policy in ("random", "task", "curious"):
        own = [float(row["mean_error"]) for row in errors if row["policy"] == policy]
        assert len(own) == 2
        assert summary["errors"][policy] == pytest.approx(np.mean(own), abs=2e-5)
    assert CuReSAC.load(written / "model.zip").num_timesteps == 170


def test_demo_draws_pictures_and_a_video(written: Path) -> None:
    for name in ("learning_curve", "errors", "sees_and_holds", "curiosity_map"):
        picture = np.asarray(Image.open(written / f"{name}.png").convert("L"))
        assert picture.std() > 5, f"{name}.png is blank"
    frames = imageio.mimread(written / "policies.mp4", memtest=False)
    assert len(frames) == 126
    # Two policies side by side; below each the curve of its error grows from the first to the last frame.
    width = frames[0].shape[1] // 2
    for left in (0, width):
        panels = [frame[width:, left : left + width] for frame in (frames[1], frames[-1])]
        red = [((panel[..., 0] > 150) & (panel[..., 1] < 120)).sum() for panel in panels]
        assert red[1] > red[0]


def test_demo_draws_the_agent_beside_what_it_sees(written: Path) -> None:
    """A step of 8 environment steps lasts .08 s; the camera's picture is in colour, the agent's of 36 grey pixels."""
    with Image.open(written / "agent.gif") as gif:
        assert (gif.n_frames, gif.info["duration"]) == (125, 80)  # type: ignore[attr-defined]
        picture = np.asarray(gif.convert("RGB"))
    camera, seen = picture[:, :128], picture[:, -128:]
    colourful = [np.ptp(half.astype(int), axis=2).mean() for half in (camera, seen)]
    assert colourful[0] > 20 and colourful[1] < 10
    assert len(np.unique(seen, axis=0)) <= 36 and seen.std() > 5 and (written / "agent.gif").stat().st_size < 1e6


def test_time_limit_in_the_first_evaluation_leaves_a_picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a slow machine, whose time is over before the first row of reconstructions; here a step takes a second."""
    monkeypatch.setattr(demo, "time", SimpleNamespace(monotonic=itertools.count().__next__))
    for name, result in (("EVALUATIONS", 2), ("ROWS", 1)):
        monkeypatch.setattr(demo, name, result)
    for name, result in (("_returns", np.ones(1)), ("_draw_curiosity", {}), ("_film", None)):
        monkeypatch.setattr(demo, name, lambda *_, result=result: result)
    assert demo.main(["--out", str(tmp_path), "--steps", "40", "--minutes", "0.388"]) == 0
    assert json.loads((tmp_path / "summary.json").read_text())["agent_steps"] == 20
    assert np.asarray(Image.open(tmp_path / "sees_and_holds.png").convert("L")).std() > 5


def test_demo_ends_at_the_time_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Training and schedules stop when its share of the minutes is over; here a step takes a second."""
    monkeypatch.setattr(demo, "time", SimpleNamespace(monotonic=itertools.count().__next__))
    model = tiny_model("CnnPolicy", PixelBox())
    progress = demo.Progress(demo.make_dmc_env(demo.DOMAIN, demo.TASK, **demo.ENV_KWARGS), 10_000, seconds=50)
    model.learn(10_000, callback=progress)
    assert model.num_timesteps == 50
    assert model._current_progress_remaining == pytest.approx(1 / 50)
