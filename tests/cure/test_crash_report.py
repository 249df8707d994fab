"""Losses and gradients that are not finite stop training, and their batch is written down."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from dictionaries_for_tests import sensor_model
from envs_for_tests import PixelBox, differences, state_of, tiny_model
from stable_baselines3.common.logger import configure

from sb3_cure import CuReSAC
from sb3_cure.cure.crash_report import LARGEST_NORM, FiniteGuard, NonFiniteError
from sb3_cure.data.buffers import transitions
from sb3_cure.data.samples import Samples
from sb3_cure.srl import RAE, SRLHead, SRLOutput

both_updates = pytest.mark.parametrize("update", ["joint", "sequential"])


class Poisonous(SRLHead):
    """One weight; loss and gradient are multiplied by ``poison``."""

    poison = 1.0

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.weight = th.nn.Parameter(th.ones(()))

    def loss(self, batch: Samples, latents: th.Tensor, next_latents: th.Tensor | None = None) -> SRLOutput:
        error = (latents * self.weight).square().mean(dim=1)
        return SRLOutput(error.mean() * type(self).poison, error.detach())


class Steep(Poisonous):
    """A finite loss whose gradient at the latents is infinite."""

    def loss(self, batch: Samples, latents: th.Tensor, next_latents: th.Tensor | None = None) -> SRLOutput:
        loss, error = super().loss(batch, latents)
        steep = (latents - latents.detach()).abs().sqrt().sum() if type(self).poison != 1 else 0
        return SRLOutput(loss.detach() * 0 + steep + 0 * self.weight, error)


def trained(**kwargs: Any) -> CuReSAC:
    return tiny_model("CnnPolicy", PixelBox(), **kwargs).learn(14)


@both_updates
def test_bad_reward_stops_before_its_critic(update: str) -> None:
    model = trained(update=update, normalize_curiosity=False)
    model.replay_buffer.rewards[:] = np.nan
    before = state_of(model)
    with pytest.raises(NonFiniteError, match="the task critic loss was nan") as caught:
        model.train(1, batch_size=8)
    assert caught.value.source == "task critic" and caught.value.update == model._n_updates == 4
    unchanged = ("task", "curious", "encoder_target") + (("encoder",) if update == "joint" else ())
    names = differences(before["policy"], state_of(model)["policy"])
    assert names and not [name for name in names if name.split(".")[1] in unchanged]


@both_updates
@pytest.mark.parametrize("head, poison", [(Poisonous, np.nan), (Poisonous, np.inf), (Steep, 2.0)])
def test_bad_head_changes_no_parameter(
    head: type[Poisonous], poison: float, update: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = trained(srl=head, update=update)
    before = state_of(model)
    monkeypatch.setattr(head, "poison", poison)
    with pytest.raises(NonFiniteError, match="the srl loss was"):
        model.train(1, batch_size=8)
    kept = ("scale.variance", "scale.weight", "n_updates")  # statistics of rewards, which are computed first
    assert [name for name in differences(before, state_of(model)) if not name.endswith(kept)] == []
    monkeypatch.undo()
    model.train(1, batch_size=8)
    assert differences(before, state_of(model)) != []


def test_deferred_error_forbids_saving(tmp_path: Path) -> None:
    """As on a GPU, where parameters have taken the step by the time that it is found, at the end of ``train``."""
    model = trained()
    model._guard = FiniteGuard(deferred=True)
    model.train(1, batch_size=8)
    model.replay_buffer.rewards[:] = np.nan
    with pytest.raises(NonFiniteError, match="the task critic loss was nan") as caught:
        model.train(2, batch_size=8)
    assert caught.value.update == 5 and model._n_updates == 7
    with pytest.raises(NonFiniteError, match="the task critic loss was nan"):
        model.save(tmp_path / "model")
    assert not list(tmp_path.iterdir())


def test_guard_keeps_a_step_without_parameters_on_the_device() -> None:
    """All values are read at once, from one device."""
    guard = FiniteGuard(deferred=True)
    guard.check("nothing to learn", [], th.ones((), device="meta"))
    assert guard._seen[0][2].device.type == "meta"


@pytest.mark.parametrize("deferred", [False, True])
@pytest.mark.parametrize(
    "loss, gradient, sound",
    [
        (1.0, 1.0, True),
        (None, 1.0, True),
        (np.nan, 1.0, False),
        (1.0, np.nan, False),
        (None, np.inf, False),
        (1.0, LARGEST_NORM, False),
    ],
)
def test_guard_finds_the_first_bad_step(loss: float | None, gradient: float, sound: bool, deferred: bool) -> None:
    """At once, or once the values are read and from then on; the norm is that of all gradients together."""
    guard = FiniteGuard(deferred)
    guard.update = 6
    guard.check("good", [th.ones(3)], th.tensor(1.0))
    guard.report()
    guard.update = 7
    with pytest.raises(NonFiniteError) if not sound else pytest.MonkeyPatch.context() as caught:
        guard.check(
            "some", [th.full((1,), gradient), th.full((2,), gradient)], None if loss is None else th.tensor(loss)
        )
        guard.check("later", [th.ones(3)], th.tensor(np.nan if deferred and not sound else 1.0))
        guard.report()
    if not sound:
        assert (caught.value.source, caught.value.update) == ("some", 7)
    if not sound and deferred:
        with pytest.raises(NonFiniteError, match="the some loss"):
            guard.report()


# ---------------------------------------------------------------- reports


def test_crash_report_holds_the_batch(tmp_path: Path) -> None:
    model = trained()
    model.set_logger(configure(str(tmp_path), []))
    model.replay_buffer.rewards[:] = np.inf
    with pytest.raises(NonFiniteError) as caught:
        model.train(1, batch_size=8)
    folder = Path(caught.value.crash_report)
    assert folder.parent == tmp_path and str(folder) in str(caught.value)
    report = json.loads((folder / "report.json").read_text())
    assert report["source"] == "task critic" and report["agent_steps"] == 14
    batch = np.load(folder / "batch.npz")
    stored = transitions(model.replay_buffer, np.array(report["rows"]), np.array(report["environments"]))
    np.testing.assert_array_equal(batch["observations"], stored.observations)
    assert np.isinf(batch["rewards"]).all()


def test_crash_report_holds_every_key_of_dictionaries() -> None:
    class Broken(RAE):
        def loss(self, batch: Samples, latents: th.Tensor, next_latents: th.Tensor | None = None) -> SRLOutput:
            loss, error = super().loss(batch, latents)
            return SRLOutput(loss * th.nan, error)

    with pytest.raises(NonFiniteError, match="the srl loss") as caught:
        sensor_model(srl=Broken).learn(14)
    names = {"observations.front", "observations.joints", "next_observations.wrist", "views.wrist", "rewards"}
    with np.load(Path(caught.value.crash_report) / "batch.npz") as arrays:
        assert names <= set(arrays)
