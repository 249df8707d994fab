"""The demo writes what it promises, from real pixels."""

import csv
import json
from pathlib import Path

import imageio.v2 as imageio
import numpy as np
import pytest
from envs_for_tests import PixelBox, tiny_model
from PIL import Image

from sb3_cure import CuReSAC
from sb3_cure.experiments import demo


def test_demo_writes_curve_pictures_video_and_model(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every promised file is there and holds what its name says; the exit status tells whether the bar was met."""
    monkeypatch.setattr(
        demo, "SETTINGS", {**demo.SETTINGS, "learning_starts": 150, "warmup_updates": 5, "batch_size": 8}
    )
    for name, few in (("EVALUATIONS", 1), ("EPISODES", 2), ("PROBE_UPDATES", 20)):
        monkeypatch.setattr(demo, name, few)
    status = demo.main(["--out", str(tmp_path), "--steps", "170", "--minutes", "5"])

    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["agent_steps"] == 170 and summary["environment_steps"] == 1360
    assert summary["updates"] == 5 + 20
    assert status == int(summary["ratio"] < 3)
    rows = list(csv.DictReader((tmp_path / "learning_curve.csv").open()))
    assert [int(row["agent_steps"]) for row in rows][-1] == 170
    assert all(float(row["task_return"]) >= 0 for row in rows)
    bars = {row["policy"]: row for row in csv.DictReader((tmp_path / "srl_error.csv").open())}
    assert list(bars) == ["random", "task", "curious"]
    assert all(float(bar["min"]) <= float(bar["mean"]) <= float(bar["max"]) for bar in bars.values())
    for name in ("learning_curve", "srl_error", "reconstructions"):
        picture = np.asarray(Image.open(tmp_path / f"{name}.png").convert("L"))
        assert picture.std() > 5, f"{name}.png is blank"
    frames = imageio.mimread(tmp_path / "policy.mp4", memtest=False)
    assert len(frames) == 125
    # The panel below the camera's picture: the curve of the SRL error grows from the first to the last frame.
    panels = [frame[frames[0].shape[1] :] for frame in (frames[1], frames[-1])]
    red = [((panel[..., 0] > 150) & (panel[..., 1] < 120)).sum() for panel in panels]
    assert red[1] > red[0]
    loaded = CuReSAC.load(tmp_path / "model.zip")
    assert loaded.num_timesteps == 170


def test_demo_ends_at_the_time_limit() -> None:
    """Training stops when the minutes are over."""
    model = tiny_model("CnnPolicy", PixelBox()).learn(10_000, callback=demo.TimeLimit(0.02))
    assert 0 < model.num_timesteps < 10_000


def test_demo_refuses_nonsense(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """A negative time limit is one sentence, and nothing is written."""
    with pytest.raises(SystemExit):
        demo.main(["--out", str(tmp_path / "demo"), "--minutes", "-1"])
    assert "--minutes is -1.0" in capsys.readouterr().err
    assert not (tmp_path / "demo").exists()
