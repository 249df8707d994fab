"""How the sources' gradients move the encoder, against hand-written optimisers."""

import copy
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch as th
from torch import nn

from sb3_cure.encoder_optimizer import SHARE_INTERVAL, EncoderOptimizer

LR = 1e-2
SOURCES = ("srl", "task", "curious")
# Sizes as different as an autoencoder's and a critic's gradients.
LOSSES: dict[str, Callable[[th.Tensor], th.Tensor]] = {
    "srl": lambda latents: 1e-4 * (latents - 1).square().mean(),
    "task": lambda latents: (latents.sum(dim=1) - 2).square().mean(),
    "curious": lambda latents: 1e3 * latents[:, 0].abs().mean(),
}


def make_encoder() -> nn.Module:
    th.manual_seed(0)
    return nn.Sequential(nn.Linear(4, 6), nn.Tanh(), nn.Linear(6, 3))


def inputs(step: int) -> th.Tensor:
    return th.randn(5, 4, generator=th.Generator().manual_seed(step))


def gradient(source: str, latents: th.Tensor, scale: float = 1.0) -> th.Tensor:
    """The gradient of a source's loss with respect to the latents."""
    leaf = latents.detach().requires_grad_()
    (scale * LOSSES[source](leaf)).backward()
    return leaf.grad


def update(optimizer: EncoderOptimizer, encoder: nn.Module, step: int, scales: dict[str, float] | None = None) -> None:
    """One update as the agent makes it: a pass per source (sequential), or one pass for all (joint)."""
    shared = encoder(inputs(step))
    for source in optimizer.weights:
        latents = shared if optimizer.mode == "joint" else encoder(inputs(step))
        optimizer.pull(source, latents, gradient(source, latents, (scales or {}).get(source, 1.0)))
    optimizer.step()


def make(mode: str, sources: tuple[str, ...] = SOURCES, **kwargs: Any) -> tuple[nn.Module, EncoderOptimizer]:
    encoder = make_encoder()
    kwargs = {"optimizer_class": th.optim.Adam, "lr": LR, **kwargs}
    return encoder, EncoderOptimizer(encoder, sources, mode, **kwargs)


def values(encoder: nn.Module) -> th.Tensor:
    return th.cat([parameter.detach().flatten() for parameter in encoder.parameters()])


def test_sequential_is_one_adam_per_source_in_turn() -> None:
    """Bit for bit what three losses, each backpropagated and stepped by an Adam of its own, do; before ``step``."""
    encoder, optimizer = make("sequential")
    expected = make_encoder()
    adams = {source: th.optim.Adam(expected.parameters(), lr=LR) for source in SOURCES}
    for step in range(SHARE_INTERVAL + 2):
        for source in SOURCES:
            latents = encoder(inputs(step))
            optimizer.pull(source, latents, gradient(source, latents))
            adams[source].zero_grad()
            LOSSES[source](expected(inputs(step))).backward()
            adams[source].step()
            assert th.equal(values(encoder), values(expected)), (step, source)
        optimizer.step()
        assert th.equal(values(encoder), values(expected)), step


def test_joint_is_one_adam_on_gradients_of_equal_size() -> None:
    """The gradients at the latents, each divided by its root-mean-square norm so far (recent ones count more).

    Adam divides by the norm of the sum of three, about sqrt(3) times one's: the learning rate makes up for that.
    """
    encoder, optimizer = make("joint")
    expected = make_encoder()
    adam = th.optim.Adam(expected.parameters(), lr=LR * 3**0.5)
    squares: dict[str, list[float]] = {source: [] for source in SOURCES}
    for step in range(60):
        update(optimizer, encoder, step)
        latents = expected(inputs(step))
        total = th.zeros_like(latents)
        for source in SOURCES:
            (grad,) = th.autograd.grad(LOSSES[source](latents), latents, retain_graph=True)
            squares[source].append(float(grad.double().square().sum()))
            ages = range(step, -1, -1)
            mean_square = sum(0.99**age * s for age, s in zip(ages, squares[source], strict=True))
            mean_square /= sum(0.99**age for age in ages)
            total += grad / mean_square**0.5
        adam.zero_grad()
        latents.backward(total)
        adam.step()
        th.testing.assert_close(values(encoder), values(expected), rtol=1e-4, atol=1e-5)
    assert float((values(expected) - values(make_encoder())).norm()) > 0.1


def test_joint_moves_nothing_before_step() -> None:
    """All sources share one pass, so that the encoder must stand still until the last has pulled."""
    encoder, optimizer = make("joint")
    before = values(encoder)
    latents = encoder(inputs(0))
    for source in SOURCES:
        optimizer.pull(source, latents, gradient(source, latents))
        assert th.equal(values(encoder), before)
    optimizer.step()
    moved = values(encoder)
    assert not th.equal(moved, before)
    optimizer.step()
    assert th.equal(values(encoder), moved)


def test_joint_step_is_as_long_as_the_steps_of_an_adam_per_source() -> None:
    """Uncorrelated gradients of very different sizes: each source moves the encoder as far as its own Adam would."""
    n_steps, sizes = 400, {"srl": 1e-4, "task": 1.0, "curious": 30.0}
    moved = {}
    for mode in ("sequential", "joint"):
        weight = nn.Linear(1, 64, bias=False)
        with th.no_grad():
            weight.weight.zero_()
        optimizer = EncoderOptimizer(weight, tuple(sizes), mode, th.optim.Adam, lr=LR)
        noise = th.Generator().manual_seed(0)
        lengths = []
        for _ in range(n_steps):
            before = weight.weight.detach().clone()
            shared = weight(th.ones(1, 1))
            for source, size in sizes.items():
                latents = shared if mode == "joint" else weight(th.ones(1, 1))
                optimizer.pull(source, latents, size * th.randn(1, 64, generator=noise))
            optimizer.step()
            lengths.append(float((weight.weight.detach() - before).norm()))
        moved[mode] = np.mean(lengths[50:])
    assert moved["joint"] == pytest.approx(moved["sequential"], rel=0.05)


def test_joint_rate_counts_the_sources_that_pull() -> None:
    """In a phase where one source pulls alone, its step is an Adam's own, however many others there are."""
    moved = []
    for sources in (("srl",), SOURCES):
        encoder, optimizer = make("joint", sources)
        for step in range(5):
            latents = encoder(inputs(step))
            optimizer.pull("srl", latents, gradient("srl", latents))
            optimizer.step()
        moved.append(values(encoder))
    assert th.equal(moved[0], moved[1])


@pytest.mark.parametrize("mode", ["sequential", "joint"])
def test_other_optimizers_and_their_arguments(mode: str) -> None:
    """The class and all of its arguments are those given: weight decay alone shrinks an encoder without gradients."""
    encoder, optimizer = make(mode, ("task",), optimizer_class=th.optim.SGD, weight_decay=0.5)
    before = values(encoder)
    latents = encoder(inputs(0))
    optimizer.pull("task", latents, th.zeros_like(latents))
    optimizer.step()
    th.testing.assert_close(values(encoder), before * (1 - LR * 0.5))


@pytest.mark.parametrize("mode", ["sequential", "joint"])
def test_learning_rate(mode: str) -> None:
    """It reaches every source's optimiser: at 0 the encoder stands still."""
    encoder, optimizer = make(mode)
    update(optimizer, encoder, 0)
    optimizer.set_learning_rate(0.0)
    before = values(encoder)
    update(optimizer, encoder, 1)
    assert th.equal(values(encoder), before)


@pytest.mark.parametrize("mode", ["sequential", "joint"])
def test_state_dict_gives_the_same_next_updates(mode: str) -> None:
    """Moments, running sizes and the clock of the shares are restored."""
    encoder, optimizer = make(mode)
    for step in range(SHARE_INTERVAL - 1):
        update(optimizer, encoder, step)
    state = copy.deepcopy(optimizer.state_dict())
    copied, restored = make(mode)
    copied.load_state_dict(encoder.state_dict())
    restored.load_state_dict(copy.deepcopy(state))
    for step in range(SHARE_INTERVAL - 1, SHARE_INTERVAL + 2):
        update(restored, copied, step)
        update(optimizer, encoder, step)
        assert th.equal(values(copied), values(encoder))
    assert restored.shares.keys() == set(SOURCES)
    assert {k: float(v) for k, v in restored.shares.items()} == {k: float(v) for k, v in optimizer.shares.items()}
    untrained = make(mode)[1]
    untrained.load_state_dict(state)
    assert str(untrained.state_dict()) == str(state)


@pytest.mark.parametrize("sources, mode", [(("srl", "task"), "sequential"), (SOURCES, "joint"), (("task",), "joint")])
def test_a_state_of_another_kind_is_refused(sources: tuple[str, ...], mode: str) -> None:
    """One sentence names both sides; with ``strict=False`` nothing changes."""
    other_encoder, other = make(mode, sources)
    update(other, other_encoder, 0)
    encoder, optimizer = make("sequential")
    update(optimizer, encoder, 0)
    before = str(optimizer.state_dict())
    sentence = r"the saved encoder was trained by \[.*\] with .*, but this model has .*: load with the update=, srl="
    with pytest.raises(RuntimeError, match=sentence):
        optimizer.load_state_dict(other.state_dict())
    assert str(optimizer.state_dict()) == before
    optimizer.load_state_dict(other.state_dict(), strict=False)
    assert str(optimizer.state_dict()) == before


@pytest.mark.parametrize("mode", ["sequential", "joint"])
def test_sources_come_and_go(mode: str) -> None:
    """A source added later starts from nothing; one removed leaves no trace in states, norms and shares."""
    encoder, optimizer = make(mode, ("srl", "task"))
    update(optimizer, encoder, 0)
    kind = {name: value.keys() for name, value in optimizer.state_dict().items() if isinstance(value, dict)}
    before = copy.deepcopy(optimizer.optimizers)
    optimizer.add_source("curious")
    assert optimizer.weights["curious"] == 0
    for name, kept in before.items():
        assert str(optimizer.optimizers[name].state_dict()) == str(kept.state_dict())
    for step in range(1, SHARE_INTERVAL + 1):
        update(optimizer, encoder, step)
    assert optimizer.gradient_norms.keys() == optimizer.shares.keys() == set(SOURCES)
    optimizer.remove_source("curious")
    for step in range(SHARE_INTERVAL + 1, 2 * SHARE_INTERVAL + 1):
        update(optimizer, encoder, step)
    assert optimizer.gradient_norms.keys() == optimizer.shares.keys() == {"srl", "task"}
    assert {n: v.keys() for n, v in optimizer.state_dict().items() if isinstance(v, dict)} == kind


@pytest.mark.parametrize("mode", ["sequential", "joint"])
def test_gradient_norms_are_of_the_last_update(mode: str) -> None:
    """The norms at the latents, unscaled; of a source that did not pull this time there is none."""
    encoder, optimizer = make(mode)
    update(optimizer, encoder, 0)
    latents = encoder(inputs(1))
    pulled = gradient("srl", latents)
    optimizer.pull("srl", latents, pulled)
    optimizer.step()
    assert {source: float(norm) for source, norm in optimizer.gradient_norms.items()} == {"srl": float(pulled.norm())}


@pytest.mark.parametrize("mode", ["sequential", "joint"])
def test_parameter_norms_are_measured_now_and_then(mode: str) -> None:
    """Those of each source's own gradient at the encoder's parameters; at once, then every so many updates."""
    encoder, optimizer = make(mode, optimizer_class=th.optim.SGD, lr=0.0)
    for step in range(SHARE_INTERVAL + 1):
        update(optimizer, encoder, step)
        measured = inputs(0 if step < SHARE_INTERVAL else SHARE_INTERVAL)
        for source in SOURCES:
            own = th.autograd.grad(LOSSES[source](encoder(measured)), list(encoder.parameters()))
            norm = float(th.cat([part.flatten() for part in own]).norm())
            assert float(optimizer.parameter_norms[source]) == pytest.approx(norm, rel=1e-4)


def test_shares_show_a_drowned_source() -> None:
    """Under plain gradient descent one source 1e4 times stronger than another leaves it no share of the steps."""
    encoder, optimizer = make("sequential", ("srl", "task"), optimizer_class=th.optim.SGD, lr=1e-9)
    update(optimizer, encoder, 0, scales={"task": 1e4})
    assert float(optimizer.shares["srl"]) < 1e-4
    assert sum(map(float, optimizer.shares.values())) == pytest.approx(1)


def test_shares_show_a_spike() -> None:
    """In joint mode a gradient 1e4 times its usual size takes the step almost for itself, and is seen to."""
    encoder, optimizer = make("joint", ("srl", "task"))
    for step in range(20):
        update(optimizer, encoder, step)
    update(optimizer, encoder, 20, scales={"task": 1e4})
    assert float(optimizer.shares["task"]) > 0.6
    assert sum(map(float, optimizer.shares.values())) == pytest.approx(1)


@pytest.mark.parametrize("mode", ["sequential", "joint"])
@pytest.mark.parametrize("scale", [1e4, 1e-4])
def test_no_source_drowns_another(mode: str, scale: float) -> None:
    """However much stronger one source is, the encoder moves as it would: Adam, or the running size, divides it out,
    but the shares, which are measured before, tell of it."""
    moved, shares = [], []
    for factor in (1.0, scale):
        encoder, optimizer = make(mode, ("srl", "task"))
        before = values(encoder)
        for step in range(SHARE_INTERVAL + 1):
            update(optimizer, encoder, step, scales={"task": factor})
        moved.append(values(encoder) - before)
        shares.append(float(optimizer.shares["task"] / optimizer.shares["srl"]))
    assert float((moved[1] - moved[0]).norm() / moved[0].norm()) < 0.1
    assert shares[1] == pytest.approx(scale * shares[0], rel=0.1)
