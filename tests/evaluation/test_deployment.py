"""A policy as a plain module: the actions of ``predict``, also when it was traced or exported."""

import io
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import pytest
import torch as th
from dictionaries_for_tests import Goal, sensor_model
from envs_for_tests import PixelBox, VectorBox, tiny_model
from stable_baselines3.common.utils import obs_as_tensor

from sb3_cure.data.observations import stacked
from sb3_cure.evaluation.deployment import DeterministicActor

MODELS: dict[str, Any] = {
    "rae": lambda: tiny_model("CnnPolicy", PixelBox(low=-0.5, high=2.0)),
    "curl": lambda: tiny_model("CnnPolicy", PixelBox(low=-0.5, high=2.0), srl="curl"),
    "vectors": lambda: tiny_model("MlpPolicy", VectorBox()),
    "curious alone": lambda: tiny_model("CnnPolicy", PixelBox(), task=False),
    "images by key": lambda: sensor_model(),
    "vectors by key": lambda: tiny_model("MultiInputPolicy", Goal()),
    "SB3's SAC": lambda: tiny_model("CnnPolicy", PixelBox(low=-0.5, high=2.0), srl=None, curiosity=None),
}


@pytest.mark.parametrize("name", MODELS)
def test_actions_are_those_of_predict(name: str) -> None:
    """In the environment's units, for both policies, whichever tool has followed the computation."""
    model = MODELS[name]().learn(14)
    observations: Any = stacked([model.observation_space.sample() for _ in range(3)])
    batch = obs_as_tensor(observations, model.device)
    policies: dict[str | None, Any] = {None: model.predict}
    if model.curiosity is not None:
        policies["curious"] = model.predict_curious
    for actor, predict in policies.items():
        expected, _ = predict(observations, deterministic=True)
        module = DeterministicActor(model, actor)
        file = io.BytesIO()
        th.jit.save(th.jit.trace(module, batch), file)
        file.seek(0)
        traced = th.jit.load(file)
        exported = th.export.export(module, (batch,)).module()
        for follow in (module, traced, exported):
            with th.no_grad():
                np.testing.assert_allclose(follow(batch).numpy(), expected, atol=1e-5)


def test_onnx_of_a_dictionary(tmp_path: Path) -> None:
    """Another runtime acts as ``predict`` does, with the guide's names of inputs."""
    model, file = sensor_model(srl="curl").learn(14), tmp_path / "policy.onnx"
    observation: Any = model.observation_space.sample()
    batch = {key: part[None] for key, part in observation.items()}
    th.onnx.export(DeterministicActor(model), ({key: th.as_tensor(part) for key, part in batch.items()}, {}), file)
    inputs = {f"observations_{key}": part for key, part in batch.items()}
    (actions,) = onnxruntime.InferenceSession(file).run(None, inputs)
    np.testing.assert_allclose(actions, model.predict(batch, deterministic=True)[0], atol=1e-5)


def test_only_acting_networks_are_exported() -> None:
    """No critics, decoder or target networks; and the networks stay the model's own."""
    model = tiny_model("CnnPolicy", PixelBox())
    module = DeterministicActor(model)
    parts = [*model.policy.encoder.trunk.parameters(), *model.policy.actor.parameters()]
    assert {id(parameter) for parameter in module.parameters()} == {id(parameter) for parameter in parts}
    exported = th.export.export(module, (th.zeros(1, *model.observation_space.shape, dtype=th.uint8),))
    assert sum(value.numel() for value in exported.state_dict.values()) == sum(map(th.numel, parts)) + 4  # two bounds


def test_actions_follow_further_training() -> None:
    """Actions are still those of ``predict``, also of networks in training mode."""
    model = tiny_model("CnnPolicy", PixelBox())
    model.policy.encoder.trunk.append(th.nn.Dropout())
    module = DeterministicActor(model)
    model.learn(14)
    model.policy.set_training_mode(True)
    batch = th.as_tensor(model.observation_space.sample()[None])
    exported = th.export.export(module, (batch,)).module()
    for follow in (module, exported):
        actions = follow(batch).detach().numpy()
        np.testing.assert_allclose(actions, model.predict(batch.numpy(), deterministic=True)[0], atol=1e-5)


def test_wrong_actors_and_scaled_images_are_refused() -> None:
    """Floats in [0, 1] would be divided by 255 once more, and give actions all the same."""
    model = tiny_model("CnnPolicy", PixelBox(), curiosity=None)
    with pytest.raises(ValueError, match=r"actor must be one of \['task'\] that this model trains, not 'curious'"):
        DeterministicActor(model, "curious")
    with pytest.raises(ValueError, match=r"images must be uint8, not torch.float32"):
        DeterministicActor(model)(th.rand(1, 6, 36, 36))
