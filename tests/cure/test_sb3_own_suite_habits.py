"""What SB3's own tests ask of its SAC, and a user of SB3 hence expects of ours; with the extras on and off."""

import io
from typing import Any

import gymnasium as gym
import pytest
import torch as th
from envs_for_tests import PixelBox, VectorBox, tiny_model
from gymnasium import spaces
from stable_baselines3 import SAC

from sb3_cure import CuReSAC

EXTRAS: dict[str, dict[str, Any]] = {"on": {}, "off": {"srl": None, "curiosity": None}}
on_and_off = pytest.mark.parametrize("extras", EXTRAS.values(), ids=EXTRAS.keys())


@on_and_off
@pytest.mark.parametrize("action_space", [spaces.Discrete(3), spaces.MultiDiscrete([2, 3]), spaces.MultiBinary(4)])
def test_discrete_actions_raise_what_sb3_raises(action_space: spaces.Space, extras: dict[str, Any]) -> None:
    """An AssertionError, with SB3's words."""
    env: gym.Env = VectorBox()
    env.action_space = action_space
    with pytest.raises(AssertionError) as of_sb3:
        SAC("MlpPolicy", env)
    with pytest.raises(AssertionError) as ours:
        CuReSAC("MlpPolicy", env, **extras)
    assert str(ours.value) == str(of_sb3.value)


@on_and_off
@pytest.mark.parametrize("policy, env", [("MlpPolicy", VectorBox), ("CnnPolicy", PixelBox)])
def test_a_loaded_buffer_samples_on_the_models_device(policy: str, env: Any, extras: dict[str, Any]) -> None:
    """Whatever device that is by then; one without hardware here, as SB3's own test has it."""
    model = tiny_model(policy, env(), **extras).learn(12)
    file = io.BytesIO()
    model.save_replay_buffer(file)
    for device in ("cpu", "cuda", "meta"):
        model.device = th.device(device)
        model.load_replay_buffer(io.BytesIO(file.getvalue()))
        assert model.replay_buffer.device == model.device
    # "meta" tensors have no values, hence any machine can make them.
    assert model.replay_buffer.sample(4).actions.device.type == "meta"
