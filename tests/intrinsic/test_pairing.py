"""Runs of one seed that differ in their reward alone draw alike: their arms are paired."""

from typing import Any

import numpy as np
import pytest
import torch as th
from envs_for_tests import PixelBox, differences, tiny_model
from updates_for_tests import ALGORITHMS

from sb3_cure.intrinsic import INTRINSIC_REWARDS


def streams(intrinsic: str, algorithm: str, seed: int = 0) -> dict[str, Any]:
    """All random streams but the reward's own, after some updates."""
    model = tiny_model("CnnPolicy", PixelBox(), ALGORITHMS[algorithm], intrinsic=intrinsic, seed=seed, curiosity_bout=3)
    model.learn(16)
    assert model._n_updates == 6
    return {
        "torch": th.get_rng_state(),
        "numpy": list(np.random.get_state()),
        "mixer": model._mixer.rng.bit_generator.state,
        "who acted": model._mixer.n_curious,
        "warm-up": model.action_space.np_random.bit_generator.state,
        "random actions": model.replay_buffer.actions[:10],
        "sampled rows": model.replay_buffer.last_sampled,
    }


@pytest.mark.parametrize("algorithm", list(ALGORITHMS))
@pytest.mark.parametrize("intrinsic", [name for name in INTRINSIC_REWARDS if name != "srl_error"])
def test_rewards_draw_from_generators_of_their_own(intrinsic: str, algorithm: str) -> None:
    expected = streams("srl_error", algorithm)
    assert differences(expected, streams(intrinsic, algorithm)) == []
    assert differences(expected, streams("srl_error", algorithm, seed=1)) != []
