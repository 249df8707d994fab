"""The README's code does what it says."""

import inspect
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from envs_for_tests import PixelBox, tiny_model

from sb3_cure import CuReSAC
from sb3_cure.buffers import Samples

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()


def class_of_readme(name: str) -> Any:
    """The class as it stands in the README."""
    block = next(block for block in re.findall(r"```python\n(.*?)```", README, re.S) if f"class {name}" in block)
    namespace: dict = {"__name__": "readme"}
    exec(compile(block[: block.index("model = CuReSAC")], "README.md", "exec"), namespace)
    return namespace[name]


def test_readmes_own_head_trains_saves_and_loads(tmp_path: Path) -> None:
    """Its error falls, both policies survive an archive, it draws images."""
    head = class_of_readme("DropoutAutoencoder")
    env = PixelBox(frame_stack=1)
    model = tiny_model("CnnPolicy", env, srl=head, srl_kwargs=dict(dropped=0.5)).learn(40)
    sampled = model.replay_buffer.sample(16)
    batch = Samples(**sampled._asdict(), views=sampled.observations)

    def error() -> float:
        return float(model.policy.srl.error(batch, model.policy.encode(batch.observations)).mean())

    before = error()
    model.train(60, batch_size=8)
    assert error() < 0.8 * before
    model.save(tmp_path / "model.zip")
    loaded = CuReSAC.load(tmp_path / "model.zip", custom_objects={"srl": head})
    observation, _ = env.reset(seed=0)
    for ours, theirs in ((model.predict, loaded.predict), (model.predict_curious, loaded.predict_curious)):
        np.testing.assert_array_equal(
            ours(observation, deterministic=True)[0], theirs(observation, deterministic=True)[0]
        )
    drawn = loaded.policy.srl.reconstruct(loaded.policy.encode(batch.observations))
    assert drawn.shape == batch.observations.shape and drawn.dtype == batch.observations.dtype


def test_readmes_own_reward_falls_as_it_is_learned() -> None:
    model = tiny_model("CnnPolicy", PixelBox(), intrinsic=class_of_readme("Distillation")).learn(40)
    assert model.policy.intrinsic is not None
    batch = model.replay_buffer.sample(32)
    latents = model.policy.encode(batch.next_observations)
    rewards = []
    for _ in range(100):
        loss, reward = model.policy.intrinsic.loss(batch, latents, latents, None)
        model._optimize("intrinsic reward", loss, model.policy.intrinsic.optimizer)
        rewards.append(float(reward.mean()))
    assert 0 < rewards[-1] < 0.5 * rewards[0]


def test_a_policy_leaves_for_the_robot_as_the_readme_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The file that its lines write gives the actions of ``predict``."""
    block = next(block for block in re.findall(r"```python\n(.*?)```", README, re.S) if "DeterministicActor" in block)
    monkeypatch.chdir(tmp_path)
    model = tiny_model("CnnPolicy", PixelBox(low=-0.5, high=2.0))
    names: dict = {"model": model}
    exec(compile(block, "README.md", "exec"), names)
    actions, _ = model.predict(names["images"].numpy(), deterministic=True)
    for given in (names["actions"], th.export.load("policy.pt2").module()(names["images"])):
        np.testing.assert_allclose(given.detach(), actions, atol=1e-5)


def test_links_lead_somewhere() -> None:
    """Headings of the page, files of the repository."""
    for page in (ROOT / "README.md", ROOT / "results" / "README.md"):
        text = page.read_text()
        headings = re.findall(r"^#+ (.+)$", re.sub(r"```.*?```", "", text, flags=re.S), re.M)
        anchors = {re.sub(r"[^\w\- ]", "", heading).strip().lower().replace(" ", "-") for heading in headings}
        for target in re.findall(r"\]\(([^)\s]+)\)", re.sub(r"```.*?```", "", text, flags=re.S)):
            if target.startswith("#"):
                assert target[1:] in anchors, (page.name, target)
            elif not target.startswith("http"):
                assert (page.parent / target.partition("#")[0]).exists(), (page.name, target)


def test_table_of_arguments_gives_the_constructors_defaults() -> None:
    """Every argument of the table exists with the default that the table says, and none of ours is missing."""
    parameters = inspect.signature(CuReSAC).parameters
    rows = dict(re.findall(r"^\| `(\w+)` \| ([^|]+) \|", README, re.M))
    ours = {name for name, p in parameters.items() if p.kind is p.KEYWORD_ONLY and not name.startswith("_")}
    assert ours <= rows.keys()
    for name, text in rows.items():
        if name not in parameters:
            continue
        default = parameters[name].default
        shown = text.replace("`", "").replace(" ", "").strip()
        expected = {"{}"} if name.endswith("_kwargs") else {repr(default).replace("'", '"')}
        if isinstance(default, int | float) and not isinstance(default, bool):
            assert float(shown.replace("_", "")) == default, name
        else:
            assert shown in expected, name
