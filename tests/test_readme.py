"""The README's code does what it says."""

import re
from pathlib import Path

import numpy as np
from envs_for_tests import PixelBox, tiny_model

from sb3_cure import CuReSAC

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()


def test_readmes_own_head_trains_saves_and_loads(tmp_path: Path) -> None:
    """The class as it stands in the README: its error falls, both policies survive an archive, it draws images."""
    block = next(block for block in re.findall(r"```python\n(.*?)```", README, re.S) if "class Denoising" in block)
    source = block[: block.index("model = CuReSAC")]
    namespace: dict = {"__name__": "readme"}
    exec(compile(source, "README.md", "exec"), namespace)
    head = namespace["Denoising"]
    env = PixelBox(frame_stack=1)
    model = tiny_model("CnnPolicy", env, srl=head, srl_kwargs=dict(dropped=0.5)).learn(40)
    batch = model.replay_buffer.sample(16)

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


def test_table_of_arguments_gives_the_constructors_defaults() -> None:
    """Every argument of the table exists with the default that the table says, and none of ours is missing."""
    import inspect

    parameters = inspect.signature(CuReSAC.__init__).parameters
    rows = dict(re.findall(r"^\| `(\w+)` \| ([^|]+) \|", README, re.M))
    ours = {name for name, p in parameters.items() if p.kind is p.KEYWORD_ONLY and not name.startswith("_")}
    assert ours <= rows.keys() | {"srl_period"}
    for name, text in rows.items():
        if name not in parameters:
            continue
        default = parameters[name].default
        shown = text.replace("`", "").replace(" ", "").strip()
        expected = {"{}"} if name == "srl_kwargs" else {repr(default).replace("'", '"')}
        if isinstance(default, int | float) and not isinstance(default, bool):
            assert float(shown.replace("_", "")) == default, name
        else:
            assert shown in expected, name
