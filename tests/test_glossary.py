"""The glossary names what there is: arguments of the constructor, and all that a training logs."""

import re
from pathlib import Path

import pytest
from envs_for_tests import PixelBox, tiny_model
from logs_for_tests import KeptRows
from stable_baselines3.common.logger import Logger

from sb3_cure.evaluation import diagnostics
from sb3_cure.evaluation.callbacks import DiagnosticsCallback, EvalBothCallback

GLOSSARY = (Path(__file__).parents[1] / "docs" / "glossary.md").read_text(encoding="utf-8")
NAMES = set(re.findall(r"`((?:train|rollout|time|eval|diagnostics)/[\w<>]+)`", GLOSSARY))


def as_in_glossary(name: str) -> str:
    name = re.sub(r"^(eval)/(task|curious|random)_", r"\1/<actor>_", name)
    return re.sub(r"(norm|share)_(srl|task|curious|intrinsic)$", r"\1_<source>", name)


@pytest.fixture(scope="module")
def logged() -> set[str]:
    model, kept = tiny_model("CnnPolicy", PixelBox(), intrinsic="icm"), KeptRows()
    model.set_logger(Logger(None, [kept]))
    watching = [EvalBothCallback(PixelBox(), 40, 1), DiagnosticsCallback(every=40)]
    with pytest.MonkeyPatch.context() as early:
        early.setattr(diagnostics, "MIN_UPDATES", 1)
        model.learn(80, callback=watching, log_interval=1)
    return {as_in_glossary(name) for row in kept.rows for name in row.keys() - {"step"}}


def test_all_that_is_logged_is_explained(logged: set[str]) -> None:
    assert logged <= NAMES


def test_nothing_else_is_said_to_be_logged(logged: set[str]) -> None:
    assert NAMES <= logged
