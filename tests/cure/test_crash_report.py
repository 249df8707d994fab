"""What is not finite reaches no parameter, its source is named, and its batch is written down."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from envs_for_tests import PixelBox, differences, state_of, tiny_model
from stable_baselines3.common.logger import configure

from sb3_cure import CuReSAC
from sb3_cure.cure.crash_report import LARGEST_NORM, Guard, NonFiniteError
from sb3_cure.data.buffers import transitions
from sb3_cure.data.samples import Samples
from sb3_cure.srl import SRLHead, SRLOutput

both_updates = pytest.mark.parametrize("update", ["joint", "sequential"])


class Poisonous(SRLHead):
    """One weight; loss and gradient are what ``poison`` makes of them."""

    poison = 1.0

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.weight = th.nn.Parameter(th.ones(()))

    def loss(self, batch: Samples, latents: th.Tensor, next_latents: th.Tensor | None = None) -> SRLOutput:
        error = (latents * self.weight).square().mean(dim=1)
        return SRLOutput(error.mean() * type(self).poison, error.detach())


class Steep(Poisonous):
    """A finite loss whose gradient at the latents is not."""

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
    assert differences(before, state_of(model)) == []
    monkeypatch.undo()
    model.train(1, batch_size=8)
    assert differences(before, state_of(model)) != []


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


def parameter_with(gradient: float) -> tuple[th.nn.Parameter, th.optim.Adam]:
    parameter = th.nn.Parameter(th.ones(3))
    parameter.grad = th.full((3,), gradient)
    return parameter, th.optim.Adam([parameter], lr=0.1, fused=True)


@pytest.mark.parametrize("deferred", [False, True])
@pytest.mark.parametrize(
    "loss, gradient, sound",
    [(1.0, 1.0, True), (np.nan, 1.0, False), (1.0, np.nan, False), (1.0, LARGEST_NORM, False), (np.inf, 1.0, False)],
)
def test_guard_steps_along_sound_gradients_alone(loss: float, gradient: float, sound: bool, deferred: bool) -> None:
    parameter, optimizer = parameter_with(gradient)
    guard = Guard(deferred)
    guard.begin(7)
    try:
        guard.step("some", th.tensor(loss), optimizer, [parameter])
        guard.report()
        found = None
    except NonFiniteError as error:
        found = error
    assert (found is None) == sound and th.equal(parameter, th.ones(3)) == (not sound)
    if found is not None:
        assert (found.source, found.update) == ("some", 7)


def test_deferred_guard_skips_the_rest_of_the_update() -> None:
    guard = Guard(deferred=True)
    first, second, third = (parameter_with(1.0) for _ in range(3))
    guard.begin(1)
    guard.step("bad", th.tensor(np.nan), first[1], [first[0]])
    guard.step("good", th.tensor(1.0), second[1], [second[0]])
    assert th.equal(first[0], th.ones(3)) and th.equal(second[0], th.ones(3))
    assert float(guard.rate(0.5)) == 0
    guard.begin(2)
    guard.step("worse", th.tensor(np.inf), None, [])
    guard.begin(3)
    guard.step("good", th.tensor(1.0), third[1], [third[0]])
    assert guard.rate(0.5) == 0.5 and not th.equal(third[0], th.ones(3))
    with pytest.raises(NonFiniteError) as caught:
        guard.report()
    assert (caught.value.source, caught.value.update) == ("bad", 1)
    guard.report()  # told once


def test_deferred_guard_knows_other_optimizers() -> None:
    parameter = th.nn.Parameter(th.ones(3))
    parameter.grad = th.ones(3)
    optimizer = th.optim.SGD([parameter], lr=0.1)
    guard = Guard(deferred=True)
    guard.begin(1)
    guard.step("bad", th.tensor(np.nan), optimizer, [parameter])
    assert th.equal(parameter, th.ones(3))
    guard.begin(2)
    guard.step("good", th.tensor(1.0), optimizer, [parameter])
    assert not th.equal(parameter, th.ones(3))
