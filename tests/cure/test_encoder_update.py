"""How the sources' gradients move the encoder, against hand-written optimisers."""

import copy
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch as th
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

from sb3_cure.cure.encoder_update import SHARE_INTERVAL, EncoderUpdate

LR = 1e-2
SOURCES = ("srl", "task", "curious")
MODES = pytest.mark.parametrize("mode", ["sequential", "joint"])
# Sizes as different as an autoencoder's and a critic's gradients.
LOSSES: dict[str, Callable[[th.Tensor], th.Tensor]] = {
    "srl": lambda latents: 1e-4 * (latents - 1).square().mean(),
    "task": lambda latents: (latents.sum(dim=1) - 2).square().mean(),
    "curious": lambda latents: 1e3 * latents[:, 0].abs().mean(),
}


class Linear(nn.Module):
    """The least that has a trunk and a projection."""

    def __init__(self, bias: bool = True, inputs: int = 4, outputs: int = 3):
        super().__init__()
        th.manual_seed(0)
        self.trunk = nn.Sequential(nn.Linear(inputs, 6, bias=bias), nn.Tanh())
        self.projection = nn.Linear(6, outputs, bias=bias)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return self.projection(self.trunk(observations))


def with_gradient(gradient: th.Tensor) -> th.Tensor:
    """What a loss has read, with the gradient that it left there."""
    copy = th.zeros_like(gradient)
    copy.grad = gradient
    return copy


def inputs(step: int) -> th.Tensor:
    return th.randn(5, 4, generator=th.Generator().manual_seed(step))


def gradient(source: str, latents: th.Tensor, scale: float = 1.0) -> th.Tensor:
    """The gradient of a source's loss with respect to the latents."""
    leaf = latents.detach().requires_grad_()
    (scale * LOSSES[source](leaf)).backward()
    return leaf.grad  # type: ignore[return-value]


def optimize(name: str, loss: th.Tensor, optimizer: th.optim.Optimizer) -> None:
    """What the agent does, without a look at the values."""
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()


def give(update: EncoderUpdate, source: str, scale: float = 1.0) -> None:
    """A source's gradient, with the step that follows in sequential mode."""
    latents = update.run().latents
    update.backward(source, [(latents, with_gradient(gradient(source, latents, scale)))])
    if update.mode == "sequential":
        update.step(optimize)


def whole(update: EncoderUpdate, step: int, scales: dict[str, float] | None = None) -> dict[str, th.Tensor]:
    """One update of all sources.

    :return: What is logged
    """
    update.begin(inputs(step), inputs(step + 10_000))
    for source in update.weights:
        give(update, source, (scales or {}).get(source, 1.0))
    update.step(optimize)
    return update.end()


def make(mode: str, sources: tuple[str, ...] = SOURCES, **kwargs: Any) -> tuple[Any, EncoderUpdate]:
    encoder = Linear()
    kwargs = {"optimizer_class": th.optim.Adam, "lr": LR, **kwargs}
    return encoder, EncoderUpdate(encoder, sources, mode, **kwargs)  # type: ignore[arg-type]


def values(encoder: nn.Module) -> th.Tensor:
    return th.cat([parameter.detach().flatten() for parameter in encoder.parameters()])


def shares(logged: dict[str, th.Tensor]) -> dict[str, float]:
    prefix = "encoder_share_"
    return {name.removeprefix(prefix): float(value) for name, value in logged.items() if name.startswith(prefix)}


# ---------------------------------------------------------------- steps


def test_sequential_is_one_adam_per_source_in_turn() -> None:
    """Bit for bit what three losses do, each backpropagated and stepped by an Adam of its own."""
    encoder, update = make("sequential")
    expected = Linear()
    adams = {source: th.optim.Adam(expected.parameters(), lr=LR) for source in SOURCES}
    for step in range(SHARE_INTERVAL + 2):
        update.begin(inputs(step), inputs(step))
        for source in SOURCES:
            give(update, source)
            adams[source].zero_grad()
            LOSSES[source](expected(inputs(step))).backward()
            adams[source].step()
            assert th.equal(values(encoder), values(expected)), (step, source)
        update.step(optimize)
        update.end()
        assert th.equal(values(encoder), values(expected)), step


def test_joint_is_one_adam_on_gradients_of_equal_size() -> None:
    """The gradients at the latents, each divided by its root-mean-square norm so far (recent ones count more).

    Adam divides by the norm of the sum of three, about sqrt(3) times one's: the learning rate makes up for that.
    """
    encoder, update = make("joint")
    expected = Linear()
    adam = th.optim.Adam(expected.parameters(), lr=LR * 3**0.5)
    squares: dict[str, list[float]] = {source: [] for source in SOURCES}
    for step in range(60):
        whole(update, step)
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
    assert float((values(expected) - values(Linear())).norm()) > 0.1


def test_joint_moves_nothing_before_step() -> None:
    """All sources share one run, so that the encoder must stand still until the last has given its gradient."""
    encoder, update = make("joint")
    before = values(encoder)
    update.begin(inputs(0), inputs(1))
    for source in SOURCES:
        give(update, source)
        assert th.equal(values(encoder), before)
    update.step(optimize)
    moved = values(encoder)
    assert not th.equal(moved, before)
    update.step(optimize)  # of nothing
    assert th.equal(values(encoder), moved)


def test_joint_step_is_as_long_as_sequential_steps() -> None:
    """Uncorrelated gradients of very different sizes: each source moves the encoder as far as its own Adam would."""
    n_steps, sizes = 300, {"srl": 1e-4, "task": 1.0, "curious": 30.0}
    moved = {}
    for mode in ("sequential", "joint"):
        encoder = Linear()
        encoder.trunk, encoder.projection = nn.Sequential(), nn.Linear(1, 64, bias=False)
        nn.init.zeros_(encoder.projection.weight)
        update = EncoderUpdate(encoder, tuple(sizes), mode, th.optim.Adam, lr=LR)  # type: ignore[arg-type]
        noise = th.Generator().manual_seed(0)
        lengths = []
        for _ in range(n_steps):
            before = values(encoder)
            update.begin(th.ones(1, 1), th.ones(1, 1))
            for source, size in sizes.items():
                update.backward(
                    source, [(update.run().latents, with_gradient(size * th.randn(1, 64, generator=noise)))]
                )
                if mode == "sequential":
                    update.step(optimize)
            update.step(optimize)
            update.end()
            lengths.append(float((values(encoder) - before).norm()))
        moved[mode] = np.mean(lengths[50:])
    assert moved["joint"] == pytest.approx(moved["sequential"], rel=0.05)


def test_joint_rate_counts_the_sources_that_take_part() -> None:
    """In a phase of one source alone its step is an Adam's own, however many others there are."""
    moved = []
    for sources in (("srl",), SOURCES):
        encoder, update = make("joint", sources)
        for step in range(5):
            update.begin(inputs(step), inputs(step))
            give(update, "srl")
            update.step(optimize)
        moved.append(values(encoder))
    assert th.equal(moved[0], moved[1])


@MODES
def test_gradients_through_next_latents_count(mode: str) -> None:
    """A source that read both runs is one loss: its gradients are added, and normalised together."""
    encoder, update = make(mode, ("srl",), optimizer_class=th.optim.SGD)
    expected = Linear()
    update.begin(inputs(0), inputs(1))
    runs = [update.run(), update.next_run()]
    given = [gradient("task", run.latents) for run in runs]
    update.backward("srl", [(run.latents, with_gradient(grad)) for run, grad in zip(runs, given, strict=True)])
    update.step(optimize)
    loss = LOSSES["task"](expected(inputs(0))) + LOSSES["task"](expected(inputs(1)))
    size = 1.0 if mode == "sequential" else float(th.stack([grad.square().sum() for grad in given]).sum().sqrt())
    gradients = th.autograd.grad(loss, list(expected.parameters()))
    with th.no_grad():
        for parameter, grad in zip(expected.parameters(), gradients, strict=True):
            parameter.sub_(LR * grad / size)
    th.testing.assert_close(values(encoder), values(expected))


@MODES
def test_update_that_was_broken_off_is_forgotten(mode: str) -> None:
    """As after an exception: what was given before does not move the encoder in the next update."""
    encoder, update = make(mode)
    other, fresh = make(mode)
    update.begin(inputs(0), inputs(0))
    update.backward("task", [(update.run().latents, with_gradient(th.ones(5, 3)))])
    update.mean_squares["task"], update.weights["task"] = th.zeros(()), 0.0
    whole(update, 1)
    whole(fresh, 1)
    assert th.equal(values(encoder), values(other))


@MODES
def test_other_optimizers_and_their_arguments(mode: str) -> None:
    """The class and all of its arguments are those given: weight decay alone shrinks an encoder without gradients."""
    encoder, update = make(mode, ("task",), optimizer_class=th.optim.SGD, weight_decay=0.5)
    before = values(encoder)
    update.begin(inputs(0), inputs(0))
    update.backward("task", [(update.run().latents, with_gradient(th.zeros(5, 3)))])
    update.step(optimize)
    th.testing.assert_close(values(encoder), before * (1 - LR * 0.5))


@MODES
def test_learning_rate_reaches_every_source(mode: str) -> None:
    """At 0 the encoder stands still, at twice the rate it moves twice as far."""
    moved = []
    for rate in (0.0, LR, 2 * LR):
        encoder, update = make(mode, optimizer_class=th.optim.SGD)
        update.learning_rate = rate
        before = values(encoder)
        update.begin(inputs(0), inputs(0))
        give(update, "task")
        update.step(optimize)
        moved.append(values(encoder) - before)
    assert not moved[0].any() and moved[1].any()
    th.testing.assert_close(moved[2], 2 * moved[1], rtol=1e-3, atol=1e-7)


@MODES
def test_frozen_part_of_the_encoder_stays(mode: str) -> None:
    """As of a pretrained extractor: the rest is trained, and shares are measured all the same."""
    encoder, update = make(mode)
    encoder.trunk.requires_grad_(False)
    frozen, before = values(encoder.trunk), values(encoder.projection)
    logged = whole(update, 0)
    assert th.equal(values(encoder.trunk), frozen)
    assert not th.equal(values(encoder.projection), before)
    assert sum(shares(logged).values()) == pytest.approx(1)


@MODES
def test_part_of_the_encoder_that_latents_do_not_depend_on_stays(mode: str) -> None:
    """As an extractor's head for another task: the rest moves, and its shares are measured, as without that part."""
    plain, expected = make(mode)
    encoder: Any = Linear()
    encoder.other = nn.Linear(6, 2)
    update = EncoderUpdate(encoder, SOURCES, mode, th.optim.Adam, lr=LR)
    before = values(encoder.other)
    assert shares(whole(update, 0)) == shares(whole(expected, 0))
    assert th.equal(values(encoder.other), before)
    assert th.equal(values(encoder.trunk), values(plain.trunk))


# ---------------------------------------------------------------- who reads which encoder


@MODES
def test_runs_show_the_encoder_as_it_is(mode: str) -> None:
    """One run for all while the encoder stands still; a new one, also of next observations, once it has moved."""
    encoder, update = make(mode)
    calls: list[int] = []
    encoder.trunk.register_forward_hook(lambda *_: calls.append(1))
    update.begin(inputs(0), inputs(1))
    for source in SOURCES:
        run, following = update.run(), update.next_features()
        assert run.latents.requires_grad and not following.requires_grad
        assert update.run() is run and update.next_features() is following
        with th.no_grad():
            features = encoder.trunk[1](encoder.trunk[0](inputs(0)))
            th.testing.assert_close(run.features.detach(), features, rtol=0, atol=0)
            th.testing.assert_close(run.latents.detach(), encoder.projection(features), rtol=0, atol=0)
            later = encoder.trunk[1](encoder.trunk[0](inputs(1)))
            th.testing.assert_close(following, later, rtol=0, atol=0)
        give(update, source)
    assert len(calls) == (2 if mode == "joint" else 6)


def test_features_of_next_observations_come_from_their_run() -> None:
    """If there is one: a head that reads next latents runs the encoder with its graph, which serves the actors, too."""
    encoder, update = make("joint")
    update.begin(inputs(0), inputs(1))
    alone, run = update.next_features(), update.next_run()
    assert run.latents.requires_grad and update.next_run() is run and update.next_features() is run.features
    th.testing.assert_close(run.features.detach(), alone, rtol=0, atol=0)
    with th.no_grad():
        th.testing.assert_close(run.latents, encoder.projection(alone), rtol=0, atol=0)


# ---------------------------------------------------------------- states


@MODES
def test_state_dict_gives_the_same_next_updates(mode: str) -> None:
    """Moments, running sizes and the clock of the shares are restored."""
    encoder, update = make(mode)
    for step in range(SHARE_INTERVAL - 1):
        whole(update, step)
    state = copy.deepcopy(update.state_dict())
    copied, restored = make(mode)
    copied.load_state_dict(encoder.state_dict())
    restored.load_state_dict(copy.deepcopy(state))
    measured = []
    for step in range(SHARE_INTERVAL - 1, SHARE_INTERVAL + 2):
        first, second = whole(restored, step), whole(update, step)
        assert th.equal(values(copied), values(encoder))
        assert first.keys() == second.keys() and all(th.equal(first[name], second[name]) for name in first)
        measured.append(tuple(shares(first).values()))
    assert measured[0] != measured[1] == measured[2]
    untrained = make(mode)[1]
    untrained.load_state_dict(state)
    assert str(untrained.state_dict()) == str(state)


@pytest.mark.parametrize("sources, mode", [(("srl", "task"), "sequential"), (SOURCES, "joint"), (("task",), "joint")])
def test_state_of_another_kind_is_refused(sources: tuple[str, ...], mode: str) -> None:
    """With ``strict=False`` nothing changes."""
    _, other = make(mode, sources)
    whole(other, 0)
    _, update = make("sequential")
    whole(update, 0)
    before = str(update.state_dict())
    with pytest.raises(RuntimeError, match=r"the saved encoder was trained by \[.*\] with .*: load with the update="):
        update.load_state_dict(other.state_dict())
    assert str(update.state_dict()) == before
    update.load_state_dict(other.state_dict(), strict=False)
    assert str(update.state_dict()) == before


@MODES
def test_sources_come_and_go(mode: str) -> None:
    """A source added later starts from nothing; one removed leaves no trace in states, norms and shares."""
    _, update = make(mode, ("srl", "task"))
    whole(update, 0)
    kind = {name: value.keys() for name, value in update.state_dict().items() if isinstance(value, dict)}
    before = copy.deepcopy(update.optimizers)
    update.add_source("curious")
    assert update.weights["curious"] == 0
    for name, kept in before.items():
        assert str(update.optimizers[name].state_dict()) == str(kept.state_dict())
    for step in range(1, SHARE_INTERVAL + 1):
        logged = whole(update, step)
    assert update.gradient_norms.keys() == shares(logged).keys() == set(SOURCES)
    update.remove_source("curious")
    for step in range(SHARE_INTERVAL + 1, 2 * SHARE_INTERVAL + 1):
        logged = whole(update, step)
    assert update.gradient_norms.keys() == shares(logged).keys() == {"srl", "task"}
    assert {n: v.keys() for n, v in update.state_dict().items() if isinstance(v, dict)} == kind


# ---------------------------------------------------------------- what is logged


@MODES
def test_gradient_norms_are_of_the_last_update(mode: str) -> None:
    """The norms at the latents, unscaled; of a source that gave none this time there is none."""
    _, update = make(mode)
    whole(update, 0)
    update.begin(inputs(1), inputs(1))
    expected = float(gradient("srl", update.run().latents).norm())
    give(update, "srl")
    update.step(optimize)
    logged = {name: float(norm) for name, norm in update.end().items() if name.startswith("latent_grad_norm")}
    assert logged == {"latent_grad_norm_srl": expected}


def test_shares_of_joint_steps_are_measured_at_the_parameters() -> None:
    """Gradients of equal size at the latents may differ at the parameters: it is these that move.

    One source pulls at a latent that hardly depends on the parameters, so that it is drowned.
    """
    encoder, update = make("joint", ("srl", "task"), optimizer_class=th.optim.SGD)
    with th.no_grad():
        encoder.projection.weight[1].mul_(1e3)  # what pulls at this latent moves the trunk far
    encoder.projection.requires_grad_(False)
    update.begin(inputs(0), inputs(0))
    latents = update.run().latents
    pulls = {"srl": th.zeros(5, 3), "task": th.zeros(5, 3)}
    pulls["srl"][:, 0] = pulls["task"][:, 1] = 1.0
    sizes = {}
    for source, pull in pulls.items():
        moved = th.autograd.grad(latents, list(encoder.trunk.parameters()), pull, retain_graph=True)
        sizes[source] = float(th.stack([part.square().sum() for part in moved]).sum().sqrt())
        update.backward(source, [(latents, with_gradient(pull))])
    update.step(optimize)
    logged = update.end()
    assert float(logged["latent_grad_norm_srl"]) == float(logged["latent_grad_norm_task"])
    found = shares(logged)
    assert found == pytest.approx({name: size / sum(sizes.values()) for name, size in sizes.items()}, rel=1e-3)
    assert found["srl"] < 0.02


def test_shares_show_a_drowned_source() -> None:
    """Under plain gradient descent one source 1e4 times stronger than another leaves it no share of the steps."""
    _, update = make("sequential", ("srl", "task"), optimizer_class=th.optim.SGD)
    found = shares(whole(update, 0, scales={"srl": 10.0, "task": 1.0}))
    assert found["srl"] < 0.01
    assert sum(found.values()) == pytest.approx(1)


def test_shares_show_a_spike() -> None:
    """In joint mode a gradient 1e4 times its usual size takes the step almost for itself, and is seen to."""
    _, update = make("joint", ("srl", "task"))
    for step in range(SHARE_INTERVAL):
        whole(update, step)
    found = shares(whole(update, SHARE_INTERVAL, scales={"task": 1e4}))
    assert found["task"] > 0.6
    assert sum(found.values()) == pytest.approx(1)


@given(st.lists(st.floats(1e-12, 1e12), min_size=1, max_size=4), st.integers(1, 3))
@settings(deadline=None, max_examples=30)
def test_joint_step_ignores_the_sizes_of_gradients(sizes: list[float], n_updates: int) -> None:
    """Of losses that keep their sizes, whatever these are, the encoder's way is the same."""
    ends = []
    for scales in ([1.0] * len(sizes), sizes):
        encoder, update = make("joint", tuple(f"source {i}" for i in range(len(sizes))), optimizer_class=th.optim.SGD)
        for step in range(n_updates):
            update.begin(inputs(step), inputs(step))
            latents = update.run().latents
            for i, (source, scale) in enumerate(zip(update.weights, scales, strict=True)):
                direction = th.randn(5, 3, generator=th.Generator().manual_seed(i))
                update.backward(source, [(latents, scale * direction)])
            update.step(optimize)
            update.end()
        ends.append(values(encoder))
    th.testing.assert_close(ends[0], ends[1], rtol=1e-4, atol=1e-5)
