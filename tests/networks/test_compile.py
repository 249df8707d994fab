"""``compile=True`` computes the same, compiles once, and runs eagerly where torch.compile does not work."""

import copy
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from envs_for_tests import PixelBox, VectorBox, differences, gradients_of_an_update, state_of, tiny_model
from torch._dynamo.utils import counters

from sb3_cure import CuReSAC
from sb3_cure.networks.layers import Conv2dReLU, ConvTranspose2dReLU, Projection

needs_compiler = pytest.mark.skipif(
    shutil.which(os.environ.get("CXX", "g++")) is None, reason="torch.compile needs a C++ compiler"
)
IMAGES = np.random.default_rng(0).integers(0, 256, (3, 6, 36, 36), dtype=np.uint8)
#: What an eager update runs in Python
FORWARDS = {cls.forward.__code__: cls.__name__ for cls in (Conv2dReLU, ConvTranspose2dReLU, Projection)}


def run_in_python(model: CuReSAC) -> set[str]:
    """Names of the modules whose ``forward`` Python runs in an update."""
    seen = set()
    sys.setprofile(lambda frame, event, _: seen.add(frame.f_code))
    try:
        model.train(2, 128)
    finally:
        sys.setprofile(None)
    return {FORWARDS[code] for code in seen & FORWARDS.keys()}


def twin(model: CuReSAC, **arguments: Any) -> CuReSAC:
    """A model of the same networks and buffer, with arguments of its own."""
    other = tiny_model("CnnPolicy", PixelBox(), **arguments)
    other.set_logger(model.logger)
    other.set_parameters(copy.deepcopy(model.get_parameters()))
    other.replay_buffer = model.replay_buffer
    return other


@pytest.fixture(scope="module")
def trained() -> CuReSAC:
    """An eager model in fp32 to start from."""
    return tiny_model("CnnPolicy", PixelBox(), batch_size=128).learn(60)


@pytest.fixture(scope="module")
def first_update(trained: CuReSAC) -> tuple[CuReSAC, dict[str, th.Tensor]]:
    """The same, compiled in its first update, and the gradients of that."""
    model = twin(trained, compile=True, batch_size=128)
    return model, gradients_of_an_update(model, seed=5)


@pytest.fixture
def compiled(first_update: tuple[CuReSAC, dict[str, th.Tensor]]) -> CuReSAC:
    """A compiled model."""
    return first_update[0]


@needs_compiler
def test_compiled_gradients_are_those_of_eager_networks(
    trained: CuReSAC, first_update: tuple[CuReSAC, dict[str, th.Tensor]]
) -> None:
    """One state, one batch, one stream of random numbers: in float32 the same for every part of the agent."""
    _, found = first_update
    expected = gradients_of_an_update(twin(trained), seed=5)
    assert expected.keys() == found.keys() and len(expected) == 6
    for name, gradient in expected.items():
        assert float((found[name] - gradient).norm() / gradient.norm()) < 3e-5, name


@needs_compiler
def test_networks_are_compiled_once(trained: CuReSAC, compiled: CuReSAC) -> None:
    """Updates run no Python within the networks; neither they nor acting compile anything anew."""
    compiled.train(2, 128)
    n_graphs = counters["stats"]["unique_graphs"]
    assert run_in_python(trained) == set(FORWARDS.values())
    assert run_in_python(compiled) == set()
    compiled.learn(20, reset_num_timesteps=False)
    compiled.predict(IMAGES)
    compiled.predict_curious(IMAGES[:2])
    compiled.train(4, 128)
    assert counters["stats"]["unique_graphs"] == n_graphs


@needs_compiler
def test_compiled_models_are_saved_loaded_and_copied(compiled: CuReSAC, tmp_path: Path) -> None:
    """The archive knows nothing of it: it loads compiled or not, and acts alike. Copies are of their own."""
    compiled.save(tmp_path / "model")
    eager = CuReSAC.load(tmp_path / "model", env=PixelBox(), compile=False)
    again = CuReSAC.load(tmp_path / "model", env=PixelBox())
    policy = copy.deepcopy(compiled.policy)
    state = state_of(compiled)
    assert (eager.compile, again.compile) == (False, True)
    for loaded in (eager, again):
        assert differences(state, state_of(loaded)) == []
        np.testing.assert_array_equal(
            loaded.predict(IMAGES, deterministic=True)[0], compiled.predict(IMAGES, deterministic=True)[0]
        )
    compiled.train(2, 128)
    assert differences(state, state_of(compiled))
    assert differences(state["policy"], dict(policy.state_dict())) == []
    eager.learn(12)
    assert set(FORWARDS.values()) == run_in_python(eager)


@pytest.mark.long
@needs_compiler
def test_compiled_bfloat16_gradients_point_where_those_of_float32_do() -> None:
    """Cosine of at least 0.99 for every part of the agent, compiled in bfloat16 against eager in float32."""
    arguments: dict[str, Any] = dict(
        policy_kwargs=dict(net_arch=[64], features_extractor_kwargs=dict(n_filters=16, n_layers=2))
    )
    trained = tiny_model("CnnPolicy", PixelBox(), **arguments).learn(60)
    expected = gradients_of_an_update(twin(trained, **arguments), seed=5)
    found = gradients_of_an_update(twin(trained, compile=True, precision="bf16", **arguments), seed=5)
    assert expected.keys() == found.keys() and len(expected) == 6
    for name, gradient in expected.items():
        assert float(th.cosine_similarity(gradient, found[name], dim=0)) >= 0.99, name


@needs_compiler
def test_pretraining_compiles_its_curious_agent() -> None:
    """Also the curious agent that is built for the purpose; contrastive head, sequential updates."""
    model = tiny_model(
        "CnnPolicy", PixelBox(), srl="curl", curiosity=None, update="sequential", compile=True, batch_size=128
    )
    seen: list[set[str]] = []

    def watch(locals_: dict[str, Any], _: Any) -> bool:
        if model.num_timesteps == 14:
            n_updates = model._n_updates
            seen.append(run_in_python(model))
            model._n_updates = n_updates
        return True

    model.pretrain(15, callback=watch)
    assert seen == [set()]
    model.learn(12)
    assert run_in_python(model) == set()


WITHOUT_COMPILER = """
import warnings
from envs_for_tests import PixelBox, tiny_model
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    tiny_model("CnnPolicy", PixelBox(), compile=True, verbose=1).learn(12)
    tiny_model("CnnPolicy", PixelBox(), compile=True)
print([str(each.message) for each in caught if "compile" in str(each.message)])
"""


def test_without_a_compiler_networks_run_eagerly(tmp_path: Path) -> None:
    """One sentence instead of a failure in the first update, although an earlier compiler's results may be cached."""
    environment = {**os.environ, "CXX": "missing", "PATH": str(tmp_path), "PYTHONPATH": str(Path(__file__).parents[1])}
    result = subprocess.run([sys.executable, "-c", WITHOUT_COMPILER], env=environment, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    assert "Networks run eagerly: compile=True, but torch.compile does not work here (" in result.stdout
    warning = result.stdout.splitlines()[-1]
    assert "install what is missing, or leave compile='auto'" in warning


@pytest.mark.parametrize("policy, env", [("CnnPolicy", PixelBox), ("MlpPolicy", VectorBox)])
def test_auto_is_eager_and_says_why(policy: str, env: type, capsys: pytest.CaptureFixture[str]) -> None:
    """One sentence, for those who ask for any; none without."""
    model = tiny_model(policy, env(), verbose=1)
    assert (
        "Networks run eagerly (compile='auto': compiled updates were slower on the CPU they were measured on"
        in capsys.readouterr().out
    )
    assert not any(module._compiled_call_impl for module in model.policy.modules())
    tiny_model(policy, env())
    assert capsys.readouterr().out == ""


def test_plain_sac_is_never_compiled(capsys: pytest.CaptureFixture[str]) -> None:
    """``srl=None, curiosity=None`` is SB3's SAC, eager whatever is asked."""
    model = tiny_model("MlpPolicy", VectorBox(), srl=None, curiosity=None, compile=True, verbose=1).learn(12)
    assert not any(module._compiled_call_impl for module in model.policy.modules())
    assert "compile" not in capsys.readouterr().out
