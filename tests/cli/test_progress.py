"""Lines about a training's progress."""

import pytest
from envs_for_tests import VectorBox, tiny_model

from sb3_cure.cli.progress import TimeLeft, time_text


def test_time_left_is_printed_at_the_speed_of_late(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Ten steps took no time; each of the others takes a quarter of a minute, at which speed the rest counts."""
    model = tiny_model("MlpPolicy", VectorBox(), srl=None, curiosity=None)
    monkeypatch.setattr("time.monotonic", lambda: 15.0 * max(model.num_timesteps - 10, 0))
    model.learn(20, callback=TimeLeft("mine", seconds=30))
    lines = capsys.readouterr().out.splitlines()
    assert lines[1] == "mine: step 14 of 20, 0.1 steps/s, about 2 min left" and len(lines) == 5


@pytest.mark.parametrize(
    ("seconds", "text"), [(0, "1 s"), (5, "5 s"), (59.7, "1 min"), (3599, "1 h 00 min"), (12_000, "3 h 20 min")]
)
def test_time_is_rounded(seconds: float, text: str) -> None:
    assert time_text(seconds) == text
