"""Algorithms, heads, rewards and sensors combined: each cell trains, is saved and continues, or is refused.

``make test`` trains cells in which every two values of two factors meet that can, and sees one refused for each reason;
``make test-all`` runs all of them. The same cells make an update on a device without memory, which any machine has.
"""

import copy
import functools
import itertools
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from dictionaries_for_tests import SensorBox, sensor_model
from envs_for_tests import PixelBox, VectorBox, differences, state_of, tiny_model

from sb3_cure import CuReSAC, CuReTQC
from sb3_cure.data.observations import by_key
from sb3_cure.intrinsic import INTRINSIC_REWARDS, get_intrinsic_class
from sb3_cure.srl import SRL_HEADS, SRLHead, get_srl_class

ALGORITHMS: dict[str, Any] = {"sac": CuReSAC, "tqc": CuReTQC}
REWARDS: dict[str, tuple[str, dict[str, Any]]] = {name: (name, {}) for name in INTRINSIC_REWARDS} | {
    "srl_error per pixel": ("srl_error", {"per_pixel": True}),
    "icm, own encoder": ("icm", {"encoder": "own"}),
}
SENSORS = ("image", "vector", "dictionary")
FACTORS: tuple[tuple[Any, ...], ...] = (tuple(ALGORITHMS), (None, *SRL_HEADS), tuple(REWARDS), SENSORS)
PRODUCT = list(itertools.product(*FACTORS))


def refusal(head: str | None, reward: str, sensors: str) -> str | None:
    """Words of the sentence that refuses a cell, by what its parts declare; None: it is legal."""
    intrinsic, arguments = REWARDS[reward]
    if head is None:
        return "srl is None" if get_intrinsic_class(intrinsic, None).needs_srl else None
    head_class = get_srl_class(head)
    if head == "curl" and sensors == "vector":
        return "two views of one image"
    if arguments.get("per_pixel") and head_class.reconstruct is SRLHead.reconstruct:
        return "does not draw"
    return None


LEGAL = [cell for cell in PRODUCT if refusal(*cell[1:]) is None]
REFUSED = [cell for cell in PRODUCT if cell not in LEGAL]


def pairs(cell: tuple[Any, ...]) -> set[Any]:
    return set(itertools.combinations(enumerate(cell), 2))


def pairwise() -> list[tuple[Any, ...]]:
    """Choose few legal cells in which every two values of two factors meet: greedily, by their new pairs."""
    missing = set().union(*map(pairs, LEGAL))
    chosen = []
    while missing:
        chosen.append(max(LEGAL, key=lambda cell: len(pairs(cell) & missing)))
        missing -= pairs(chosen[-1])
    return chosen


ONE_OF_EACH_REFUSAL = list({refusal(*cell[1:]): cell for cell in REFUSED}.values())
TRAINED, CHECKED = (LEGAL, REFUSED) if os.environ.get("SB3_CURE_TEST_ALL") else (pairwise(), ONE_OF_EACH_REFUSAL)
CELLS = [*TRAINED, *CHECKED]


def make(algorithm: str, head: str | None, reward: str, sensors: str, **settings: Any) -> CuReSAC:
    intrinsic, arguments = REWARDS[reward]
    settings |= dict(
        srl=head, intrinsic=intrinsic, intrinsic_kwargs=arguments, algorithm=ALGORITHMS[algorithm], curiosity_prob=0.5
    )
    if algorithm == "tqc":
        settings["policy_kwargs"] = {"n_quantiles": 5}
    if sensors == "dictionary":
        return sensor_model(SensorBox(episode_length=7), **settings)
    policy, box = ("CnnPolicy", PixelBox) if sensors == "image" else ("MlpPolicy", VectorBox)
    env = box(episode_length=7)  # so that few steps hold ends of episodes
    return tiny_model(policy, env, **settings)


def update(model: CuReSAC) -> dict[str, Any]:
    """One update with random numbers that depend on nothing else."""
    np.random.seed(1)
    th.manual_seed(1)
    model.train(1, 8)
    return state_of(model)


@pytest.mark.parametrize(("algorithm", "head", "reward", "sensors"), CELLS)
def test_cell_trains_and_continues_or_is_refused(
    algorithm: str, head: str | None, reward: str, sensors: str, tmp_path: Path
) -> None:
    """After saving and loading it acts alike, and makes an equal next update."""
    expected = refusal(head, reward, sensors)
    if expected is not None:
        with pytest.raises(ValueError, match=expected) as refused:
            make(algorithm, head, reward, sensors)
        assert re.fullmatch(r"[^\n]+\.", str(refused.value))
        return
    model = make(algorithm, head, reward, sensors)
    before = state_of(model)["policy"]
    model.learn(14)
    moved = {name.split(".")[1] for name in differences(before, state_of(model)["policy"])}
    assert {"encoder", "task", "curious"} <= moved and ("srl" in moved) == (head is not None)

    model.save(tmp_path / "model")
    loaded = ALGORITHMS[algorithm].load(tmp_path / "model", env=model.get_env())
    observations: Any = model.replay_buffer.sample(4).observations
    seen = {key: part.numpy() for key, part in by_key(observations).items()}
    for actor in ("task", "curious"):
        with model.policy.acting(actor), loaded.policy.acting(actor):
            here, there = (each.predict(seen.get("", seen), deterministic=True)[0] for each in (model, loaded))
        np.testing.assert_array_equal(here, there)
    loaded.replay_buffer = copy.deepcopy(model.replay_buffer)
    loaded.set_logger(model.logger)
    assert differences(update(model), update(loaded)) == []


@functools.cache
def collected(sensors: str) -> CuReSAC:
    """A model with transitions, which are the same for all cells of its sensors."""
    return make("sac", "rae", "rnd", sensors, gradient_steps=0).learn(12)


@pytest.fixture
def meta_device(monkeypatch: pytest.MonkeyPatch) -> Iterator[th.device]:
    """Torch's device of shapes without values, on which models can be built and optimised."""
    adam = th.optim.Adam.__init__  # its fused kernel has no such device
    monkeypatch.setattr(th.optim.Adam, "__init__", lambda *args, fused=None, **kwargs: adam(*args, **kwargs))
    before = th.__future__.get_swap_module_params_on_conversion()
    th.__future__.set_swap_module_params_on_conversion(True)  # so that optimisers follow, as from CPU to GPU
    yield th.device("meta")
    th.__future__.set_swap_module_params_on_conversion(before)


@pytest.mark.parametrize(("cell", "mode"), list(zip(TRAINED, itertools.cycle(["joint", "sequential"]), strict=False)))
def test_update_stays_on_its_device(cell: tuple[Any, ...], mode: str, meta_device: th.device) -> None:
    """It reads no value, for which a GPU would have to be waited for, and mixes no memory of the CPU with its own."""
    collector = collected(cell[3])
    model = make(*cell, device=meta_device, update=mode)
    model.replay_buffer = copy.deepcopy(collector.replay_buffer)
    model.replay_buffer.device = meta_device
    for part in model.policy.modules():  # what rewards and banks read once, when they begin
        if hasattr(part, "_is_measured"):
            part._is_measured = 0
    for _ in range(2):
        learns_srl, learns_rl, _ = model._plan()
        learners = model._learners() if learns_rl else []
        metrics = model._update(model._sample_batch(8, learners), learns_srl, learners)
        assert {value.device for value in metrics.values()} == {meta_device}


@pytest.mark.parametrize(("reward", "sensors"), sorted({cell[2:] for cell in LEGAL if cell[1] == "rae"}))
def test_curious_agent_added_later_is_on_the_device(reward: str, sensors: str, meta_device: th.device) -> None:
    """As for pretraining of an agent without curiosity."""
    policy = make("sac", "rae", reward, sensors, device=meta_device, curiosity=None).policy
    intrinsic, arguments = REWARDS[reward]
    policy.add_curious_agent(get_intrinsic_class(intrinsic, policy.srl), arguments)
    assert {each.device for each in (*policy.parameters(), *policy.buffers())} == {meta_device}


@pytest.mark.skipif(not th.cuda.is_available(), reason="needs a GPU, and CUDA_VISIBLE_DEVICES=0")
@pytest.mark.parametrize("cell", TRAINED)
def test_from_gpu_to_cpu_and_back(cell: tuple[Any, ...], tmp_path: Path) -> None:
    """Trained on one, loaded on the other, where it acts alike, and trained on."""
    model = make(*cell, device="cuda").learn(25)
    for device in ("cpu", "cuda"):
        model.save(tmp_path / "model")
        loaded = ALGORITHMS[cell[0]].load(tmp_path / "model", env=model.get_env(), device=device)
        observation = model.get_env().reset()  # type: ignore[union-attr]
        actions = [each.predict(observation, deterministic=True)[0] for each in (model, loaded)]
        np.testing.assert_allclose(*actions, atol=1e-2)  # convolutions may compute in TF32 there
        assert {each.device.type for each in loaded.policy.parameters()} == {device}
        model = loaded.learn(25, reset_num_timesteps=False)
