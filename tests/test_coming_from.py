"""The settings on the page for users of other projects build."""

import inspect
import re
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from envs_for_tests import PixelBox
from stable_baselines3 import SAC

from sb3_cure import CuReSAC, make_dmc_env
from sb3_cure.networks.augmentations import Augmentation, RandomCrop, RandomShift

PAGE = (Path(__file__).parents[1] / "docs" / "coming_from.md").read_text(encoding="utf-8")
SNIPPETS = dict(re.findall(r"^## From (\S+?)\n.*?```python\n(.*?)```", PAGE, re.S | re.M))
SMALL: dict[str, Any] = dict(
    policy_kwargs=dict(net_arch=[8], features_extractor_kwargs=dict(n_filters=2)), buffer_size=100, device="cpu"
)


def build(project: str) -> CuReSAC:
    """The model of a project's lines, of small networks."""
    names: dict[str, Any] = {"env": PixelBox(), "make_dmc_env": make_dmc_env}
    lines = re.sub(r"buffer_size=[\d_]+,?", "", SNIPPETS[project].replace("from sb3_cure import", "# "))
    exec(lines, {**names, "CuReSAC": partial(CuReSAC, **SMALL)}, names)
    return names["model"]


def test_each_project_has_its_lines() -> None:
    assert list(SNIPPETS) == ["Stable-Baselines3", "SAC-AE", "CURL", "DrQ", "DrQ-v2"]


def test_sb3s_lines_have_sb3s_defaults() -> None:
    """Whatever differs from them is written there; our own rates are SB3's single one."""
    names: dict[str, Any] = {"make_dmc_env": lambda *_, **__: None, "CuReSAC": lambda policy, env, **given: given}
    exec(SNIPPETS["Stable-Baselines3"].replace("from sb3_cure import", "# "), names)
    ours = {name: each.default for name, each in inspect.signature(CuReSAC.__init__).parameters.items()}
    theirs = {name: each.default for name, each in inspect.signature(SAC.__init__).parameters.items()}
    given = {**ours, **names["model"]}
    assert given["update"] == "sequential" and given.pop("policy_kwargs") == {"net_arch": [256, 256]}
    assert given["encoder_tau"] == given["tau"] and given["ent_coef_lr_factor"] == given["actor_update_interval"] == 1
    for name, default in theirs.items():
        assert given.get(name, default) == default, name


@pytest.mark.parametrize(
    ("project", "augmentation"), [("SAC-AE", Augmentation), ("CURL", RandomCrop), ("DrQ", RandomShift)]
)
def test_lines_of_each_project_build(project: str, augmentation: type[Augmentation]) -> None:
    model = build(project)
    assert type(model.policy.augmentation) is augmentation
    assert model.policy.augmentation.view_space.shape == (9, 84, 84)
    assert model.policy.curious is None


def test_drq_v2s_recipe_builds() -> None:
    model = build("DrQ-v2")
    assert model.n_steps == 3 and model.learning_rate == 1e-4 and type(model.policy.augmentation) is RandomShift
