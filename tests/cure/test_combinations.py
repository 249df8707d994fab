"""Algorithms, heads, rewards and sensors in all their combinations: each trains, is saved and goes on, or is refused.

`make test` trains a set of cells in which every two values of two factors meet that can, and sees one refused for each
reason; `make test-all` runs all of them.
"""

import copy
import itertools
import os
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from dictionaries_for_tests import SensorBox, sensor_model
from envs_for_tests import PixelBox, VectorBox, differences, state_of, tiny_model

from sb3_cure import CuReSAC, CuReTQC
from sb3_cure.intrinsic import INTRINSIC_REWARDS, get_intrinsic_class
from sb3_cure.srl import SRL_HEADS, SRLHead, get_srl_class

ALGORITHMS: dict[str, Any] = {"sac": CuReSAC, "tqc": CuReTQC}
REWARDS: dict[str, tuple[str, dict[str, Any]]] = {name: (name, {}) for name in INTRINSIC_REWARDS} | {
    "srl_error per pixel": ("srl_error", {"per_pixel": True}),
    "icm, own encoder": ("icm", {"encoder": "own"}),
    "particle of latents": ("particle", {"space": "latents"}),
}
SENSORS = ("image", "vector", "dictionary")
FACTORS: tuple[tuple[Any, ...], ...] = (tuple(ALGORITHMS), (None, *SRL_HEADS), tuple(REWARDS), SENSORS)
PRODUCT = list(itertools.product(*FACTORS))


def refusal(head: str | None, reward: str, sensors: str) -> str | None:
    """What the parts declare: a word of the sentence with which a cell is refused; None: it is legal."""
    intrinsic, arguments = REWARDS[reward]
    if head is None:  # "shuffled" wraps the SRL error by default
        return "srl is None" if intrinsic == "shuffled" or get_intrinsic_class(intrinsic).needs_srl else None
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
    """Few legal cells in which every two values of two factors meet: greedily the one with most pairs that are new."""
    missing = set().union(*map(pairs, LEGAL))
    chosen = []
    while missing:
        chosen.append(max(LEGAL, key=lambda cell: len(pairs(cell) & missing)))
        missing -= pairs(chosen[-1])
    return chosen


ONE_OF_EACH_REFUSAL = list({refusal(*cell[1:]): cell for cell in REFUSED}.values())
CELLS = PRODUCT if os.environ.get("SB3_CURE_TEST_ALL") else [*pairwise(), *ONE_OF_EACH_REFUSAL]


def make(algorithm: str, head: str | None, reward: str, sensors: str) -> CuReSAC:
    intrinsic, arguments = REWARDS[reward]
    settings: dict[str, Any] = dict(
        srl=head, intrinsic=intrinsic, intrinsic_kwargs=arguments, algorithm=ALGORITHMS[algorithm], curiosity_prob=0.5
    )
    if algorithm == "tqc":
        settings["policy_kwargs"] = {"n_quantiles": 5}
    if sensors == "dictionary":
        return sensor_model(SensorBox(), **settings)
    policy, env = ("CnnPolicy", PixelBox()) if sensors == "image" else ("MlpPolicy", VectorBox())
    return tiny_model(policy, env, **settings)


def update(model: CuReSAC) -> dict[str, Any]:
    """One update with random numbers that depend on nothing else."""
    np.random.seed(1)
    th.manual_seed(1)
    model.train(1, 8)
    return state_of(model)


@pytest.mark.parametrize(("algorithm", "head", "reward", "sensors"), CELLS)
def test_a_cell_trains_and_goes_on_or_is_refused(
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
    before = state_of(model)
    model.learn(30)
    assert model._n_updates == 20
    moved = {name.split(".")[1] for name in differences(before["policy"], state_of(model)["policy"], "")}
    assert any(name.startswith("curious") for name in moved), moved

    model.save(tmp_path / "model")
    loaded = ALGORITHMS[algorithm].load(tmp_path / "model", env=model.get_env())
    observations = model.replay_buffer.sample(4).observations  # type: ignore[union-attr]
    seen: Any = (
        {key: part.numpy() for key, part in observations.items()}
        if isinstance(observations, dict)
        else observations.numpy()
    )
    for actor in ("task", "curious"):
        with model.policy.acting(actor), loaded.policy.acting(actor):
            here, there = (each.predict(seen, deterministic=True)[0] for each in (model, loaded))
        np.testing.assert_array_equal(here, there)
    loaded.replay_buffer = copy.deepcopy(model.replay_buffer)
    loaded.set_logger(model.logger)
    assert differences(update(model), update(loaded)) == []


def test_pairs_that_never_meet_are_those_that_are_refused() -> None:
    """Of two values of two factors no more than these are never trained together."""
    met = set().union(*map(pairs, pairwise()))
    never = {frozenset(value for _, value in pair) for cell in PRODUCT for pair in pairs(cell) - met}
    needs_head = {frozenset({None, reward}) for reward in ("srl_error", "shuffled", "srl_error per pixel")}
    draws_nothing = {frozenset({head, "srl_error per pixel"}) for head in ("curl", "spr", "forward", "inverse")}
    assert never == needs_head | draws_nothing | {frozenset({"curl", "vector"})}
    assert len(pairwise()) < 80
