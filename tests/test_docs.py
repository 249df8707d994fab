"""The code of README and documentation does what they say, links lead somewhere, and the reference is complete."""

import importlib
import inspect
import json
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from envs_for_tests import PixelBox, tiny_model

from sb3_cure import CuReSAC
from sb3_cure.cli.main import COMMANDS
from sb3_cure.data.samples import Samples

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
#: What docs/conf.py copies or builds is no page of its own
PAGES = [
    ROOT / "README.md",
    *sorted((ROOT / "results").glob("*.md")),
    *(p for p in sorted(DOCS.rglob("*.md")) if not {"_build", "notebooks", "results"} & set(p.relative_to(DOCS).parts)),
]
#: Modules whose public names users write in their own code; what is not in them is internal
PUBLIC = """buffers callbacks datasets deployment envs evaluation intrinsic persistence reconstructions srl vec_env
""".split()


def blocks(page: str | Path) -> list[str]:
    """The page's blocks of Python.

    :param page: Path in the repository
    """
    return re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(), re.S)


def without_model(block: str) -> str:
    """The block but for the lines that make an environment and a model of it."""
    return re.sub(r"^(env|model) =.*\n", "", block, flags=re.M)


def class_of(page: str, name: str) -> Any:
    """The class as it stands in the page."""
    block = next(block for block in blocks(page) if f"class {name}" in block)
    namespace: dict = {"__name__": "page"}
    exec(compile(without_model(block), page, "exec"), namespace)
    return namespace[name]


@pytest.mark.parametrize("half", [0, 1])
def test_snippets_run_when_pasted(half: int, tmp_path: Path) -> None:
    """Each page's, one after the other, in a fresh namespace, with fewer steps, smaller networks and smaller images."""
    folders = []
    for page in PAGES[half::2]:
        if page.parent.name != "results" and blocks(page):
            folders.append(tmp_path / page.relative_to(ROOT).with_suffix(""))
            folders[-1].mkdir(parents=True)
            (folders[-1] / "page.py").write_text("\n".join(blocks(page)))
    program = [sys.executable, Path(__file__).parent / "snippets_for_tests.py", *folders]
    run = subprocess.run(program, capture_output=True, text=True, timeout=900)
    assert len(folders) > 5
    assert run.returncode == 0, run.stderr


def test_own_head_of_the_guide_trains_saves_and_loads(tmp_path: Path) -> None:
    """Its error falls, both policies survive an archive, it draws images."""
    head = class_of("docs/guide/heads.md", "DropoutAutoencoder")
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


def test_own_reward_of_the_guide_falls_as_it_is_learned() -> None:
    reward = class_of("docs/guide/rewards.md", "Distillation")
    model = tiny_model("CnnPolicy", PixelBox(), intrinsic=reward, learning_starts=40).learn(40)
    rewards = []
    for _ in range(100):
        model.train(1, batch_size=32)
        rewards.append(model.logger.name_to_value["train/curious_reward_raw_mean"])
        model.logger.dump()  # or it would be the mean of all updates
    assert 0 < rewards[-1] < 0.5 * rewards[0]


def test_a_policy_leaves_for_the_robot_as_the_guide_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The files that its lines write, torch's and ONNX's, give the actions of ``predict``."""
    here, on_the_robot, onnx = blocks("docs/guide/robot.md")
    monkeypatch.chdir(tmp_path)
    model = tiny_model("CnnPolicy", PixelBox(low=-0.5, high=2.0))
    names: dict = {"model": model}
    for block in (here, on_the_robot):
        exec(compile(without_model(block), "robot.md", "exec"), names)
    actions, _ = model.predict(names["images"].numpy(), deterministic=True)
    np.testing.assert_allclose(names["actions"].detach(), actions, atol=1e-5)
    np.testing.assert_allclose(names["action"], actions[0], atol=1e-5)
    exec(compile(onnx, "robot.md", "exec"), names)
    np.testing.assert_allclose(names["action"], actions[0], atol=1e-5)


def without_code(page: Path) -> str:
    """The text of a page but for its blocks of code."""
    return re.sub(r"```.*?```", "", page.read_text(), flags=re.S)


def anchors(page: Path) -> set[str]:
    """What links into a page can name: its headings."""
    headings = re.findall(r"^#+ (.+)$", without_code(page), re.M)
    return {re.sub(r"[^\w\- ]", "", heading).strip().lower().replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    """To headings of pages, and files of the repository."""
    text = without_code(page)
    for target in re.findall(r"\]\(([^)\s]+)\)|^\[[\w-]+\]: (\S+)$", text, re.M):
        path, _, anchor = "".join(target).partition("#")
        if path.startswith("http"):
            continue
        leads_to = page.parent / path if path else page
        assert leads_to.exists(), target
        if anchor:
            assert anchor in anchors(leads_to), target
    for name in re.findall(r"\]\[([\w-]+)\]", text):
        assert f"\n[{name}]: http" in text, name


def test_commands_of_pages_exist() -> None:
    text = "\n".join(page.read_text() for page in [*PAGES, ROOT / "CONTRIBUTING.md"])
    commands = set(re.findall(r"^ *sb3-cure (\w+)", text, re.M))
    assert {"train", "experiment", "report"} <= commands <= COMMANDS.keys()
    modules = set(re.findall(r"python -m ((?:benchmarks|sb3_cure)[\w.]*)", text))
    assert "benchmarks.fuzz" in modules
    for name in modules:
        importlib.import_module(name)


def test_table_of_arguments_gives_the_constructors_defaults() -> None:
    """Every argument of the table exists with the default that the table says, and none of ours is missing."""
    parameters = inspect.signature(CuReSAC).parameters
    rows = dict(re.findall(r"^\| `(\w+)` \| ([^|]+) \|", (DOCS / "arguments.md").read_text(), re.M))
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


def public_names(module: str) -> list[str]:
    """Names that a module offers: ``__all__``, or what is defined in it."""
    found = importlib.import_module(module)
    if hasattr(found, "__all__"):
        return [name for name in found.__all__ if not name.startswith("_")]
    defined = (
        (name, value) for name, value in vars(found).items() if inspect.isclass(value) or inspect.isfunction(value)
    )
    return [name for name, value in defined if value.__module__ == module and not name.startswith("_")]


def documented() -> Iterator[tuple[str, str]]:
    """Module and name of each entry of the reference."""
    for page in (DOCS / "api").glob("*.md"):
        module = ""
        for directive, name in re.findall(r"^\.\. ([\w:]+):: (\S+)$", page.read_text(), re.M):
            if directive == "currentmodule":
                module = name
            else:
                yield module, name


REFERENCE = {(module, name): getattr(importlib.import_module(module), name) for module, name in documented()}


@pytest.mark.parametrize("module", ["sb3_cure", *(f"sb3_cure.{name}" for name in PUBLIC)])
def test_reference_misses_no_public_name(module: str) -> None:
    """Names that two modules share are described once."""
    described = {id(value) for value in REFERENCE.values()}
    names = public_names(module)
    assert names
    assert [name for name in names if id(getattr(importlib.import_module(module), name)) not in described] == []


def test_reference_has_what_pages_and_notebooks_import() -> None:
    code = [block for page in PAGES for block in re.findall(r"```python\n(.*?)```", page.read_text(), re.S)]
    for notebook in (ROOT / "notebooks").glob("*.ipynb"):
        code += ["".join(cell["source"]) for cell in json.loads(notebook.read_text())["cells"]]
    names = {name for _, name in REFERENCE}
    imports = re.findall(r"^from (sb3_cure[\w.]*) import ([\w, ]+)", "\n".join(code), re.M)
    assert len(imports) > 20
    for module, imported in imports:
        if module not in ("sb3_cure.experiments", "sb3_cure.evaluation"):  # modules are imported from these
            assert set(imported.replace(" ", "").split(",")) <= names, module
