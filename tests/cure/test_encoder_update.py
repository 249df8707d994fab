"""Steps of the encoder against hand-written optimisers, their states and what is logged of them."""

import copy
from collections.abc import Callable
from typing import Any

import pytest
import torch as th
from torch import nn

from sb3_cure.cure import encoder_update
from sb3_cure.cure.encoder_update import MEASURE_INTERVAL, EncoderUpdate

LR = 1e-2
SOURCES = ("srl", "task", "curious")
MODES = pytest.mark.parametrize("mode", ["sequential", "joint"])
# Sizes as different as an autoencoder's and a critic's gradients.
LOSSES: dict[str, Callable[[th.Tensor], th.Tensor]] = {
    "srl": lambda latents: 1e-6 * (latents - 1).square().mean(),
    "task": lambda latents: (latents.sum(dim=1) - 2).square().mean(),
    "curious": lambda latents: 1e3 * latents[:, 0].abs().mean(),
}
#: Views that each loss reads
READS = {"srl": ("observations", "next_observations"), "task": ("observations",), "curious": ("centred",)}


class Tiny(nn.Module):
    """The least that has a trunk and a projection."""

    def __init__(self) -> None:
        super().__init__()
        th.manual_seed(0)
        self.trunk = nn.Sequential(nn.Linear(4, 6), nn.Tanh())
        self.projection = nn.Linear(6, 3)

    def forward(self, views: th.Tensor) -> th.Tensor:
        return self.projection(self.trunk(views))


def make(mode: str, sources: tuple[str, ...] = SOURCES, encoder: Any = None, **kwargs: Any) -> tuple[Any, Any]:
    encoder = Tiny() if encoder is None else encoder
    arguments = {"optimizer_class": th.optim.Adam, "lr": LR, **kwargs}
    return encoder, EncoderUpdate(encoder, copy.deepcopy(encoder), sources, mode, **arguments)


def views(step: int) -> dict[str, th.Tensor]:
    generator = th.Generator().manual_seed(step)
    names = ("observations", "next_observations", "centred")
    return {name: th.randn(5, 4, generator=generator) for name in names}


def makers(step: int) -> dict[str, Callable[[], th.Tensor]]:
    return {name: lambda view=view: view for name, view in views(step).items()}  # type: ignore[misc]


def begin(update: EncoderUpdate, step: int) -> None:
    update.begin(makers(step), lambda name, gradients: None)


def learn(update: EncoderUpdate, source: str, scale: float = 1.0) -> None:
    loss = sum(LOSSES[source](update.latents(source, name)) for name in READS[source])
    (scale * loss).backward()
    update.collect(source)


def whole(update: EncoderUpdate, step: int, **scales: float) -> dict[str, float]:
    """One update of all sources.

    :return: What is logged
    """
    begin(update, step)
    for source in update.total_weights:
        learn(update, source, scales.get(source, 1.0))
    update.finish()
    return {name: float(value) for name, value in update.metrics.items()}


def values(encoder: nn.Module) -> th.Tensor:
    return th.cat([parameter.detach().flatten() for parameter in encoder.parameters()])


def norm(tensors: Any) -> float:
    return float(th.cat([tensor.flatten() for tensor in tensors]).norm())


# ---------------------------------------------------------------- steps


def test_sequential_is_one_adam_per_source_in_turn() -> None:
    encoder, update = make("sequential")
    expected = Tiny()
    adams = {source: th.optim.Adam(expected.parameters(), lr=LR) for source in SOURCES}
    for step in range(5):
        begin(update, step)
        for source in SOURCES:
            learn(update, source)
            adams[source].zero_grad()
            sum(LOSSES[source](expected(views(step)[name])) for name in READS[source]).backward()  # type: ignore[union-attr]
            adams[source].step()
            th.testing.assert_close(values(encoder), values(expected), rtol=1e-4, atol=1e-6)
        update.finish()
        th.testing.assert_close(values(encoder), values(expected), rtol=1e-4, atol=1e-6)


def test_joint_is_one_adam_on_gradients_of_equal_size() -> None:
    """Each is divided by its root-mean-square norm so far, over all latents that its loss read; recent ones count more.

    Adam divides by the norm of the sum of three, about sqrt(3) times one's: the learning rate makes up for that.
    """
    encoder, update = make("joint")
    expected = Tiny()
    adam = th.optim.Adam(expected.parameters(), lr=LR * 3**0.5)
    squares: dict[str, list[float]] = {source: [] for source in SOURCES}
    for step in range(20):
        whole(update, step)
        loss: Any = 0.0
        for source in SOURCES:
            latents = [expected(views(step)[name]) for name in READS[source]]
            own: Any = sum(map(LOSSES[source], latents))
            squares[source].append(norm(th.autograd.grad(own, latents, retain_graph=True)) ** 2)
            weights = [0.99**age for age in range(step, -1, -1)]
            mean_square = sum(w * s for w, s in zip(weights, squares[source], strict=True)) / sum(weights)
            loss = loss + own / mean_square**0.5
        adam.zero_grad()
        loss.backward()
        adam.step()
        th.testing.assert_close(values(encoder), values(expected), rtol=1e-4, atol=1e-5)
    assert float((values(expected) - values(Tiny())).norm()) > 0.1


def test_joint_encoder_stands_still_until_it_is_finished() -> None:
    encoder, update = make("joint")
    before = values(encoder)
    begin(update, 0)
    for source in SOURCES:
        learn(update, source)
        assert th.equal(values(encoder), before)
    update.finish()
    moved = values(encoder)
    assert not th.equal(moved, before)
    update.finish()  # of nothing
    assert th.equal(values(encoder), moved)


def test_joint_rate_counts_the_sources_that_take_part() -> None:
    """In a phase of one source alone its step is an Adam's own, however many others there are."""
    moved = []
    for sources in (("srl",), SOURCES):
        encoder, update = make("joint", sources)
        for step in range(5):
            begin(update, step)
            learn(update, "srl")
            update.finish()
        moved.append(values(encoder))
    assert th.equal(*moved)


def test_interrupted_update_is_forgotten() -> None:
    """After an exception, gradients of the last update do not move the encoder in the next one."""
    (encoder, update), (expected, fresh) = make("joint"), make("joint")
    state = update.state_dict()
    begin(update, 0)
    learn(update, "task")
    update.load_state_dict(state)
    begin(fresh, 0)
    for each in (update, fresh):  # without a loss that would replace the gradient of the last update
        begin(each, 1)
        learn(each, "srl")
        each.finish()
    assert th.equal(values(encoder), values(expected))


@MODES
def test_optimizer_arguments_and_learning_rate_are_used(mode: str) -> None:
    """Weight decay alone shrinks an encoder whose gradient is zero."""
    encoder, update = make(mode, ("task",), optimizer_class=th.optim.SGD, weight_decay=0.5)
    before = values(encoder)
    update.learning_rate = 0.1
    begin(update, 0)
    update.latents("task").grad = th.zeros(5, 3)
    update.collect("task")
    update.finish()
    th.testing.assert_close(values(encoder), before * (1 - 0.1 * 0.5))


@MODES
def test_frozen_and_unused_parts_of_the_encoder_stay(mode: str) -> None:
    """As of a pretrained extractor with a head for another task; the rest moves and is measured."""
    encoder: Any = Tiny()
    encoder.trunk.requires_grad_(False)
    encoder.other = nn.Linear(6, 2)
    before = copy.deepcopy(encoder)
    logged = whole(make(mode, encoder=encoder)[1], 0)
    assert th.equal(values(encoder.trunk), values(before.trunk))
    assert th.equal(values(encoder.other), values(before.other))
    assert not th.equal(values(encoder.projection), values(before.projection))
    measured = [value for name, value in logged.items() if name.startswith("encoder_grad_norm")]
    assert len(measured) == 3 * (mode == "joint") and min(measured, default=1) > 0


@MODES
def test_encoder_without_parameters_makes_no_step(mode: str) -> None:
    """As SB3's FlattenExtractor."""
    encoder: Any = nn.Module()
    encoder.trunk = encoder.projection = nn.Identity()
    _, update = make(mode, encoder=encoder)
    begin(update, 0)
    assert th.equal(update.latents("task"), views(0)["observations"]) and update.leaves("task") == []
    update.collect("task")
    update.finish()
    assert update.metrics == {} and update.optimizers == {}


@MODES
def test_gradients_are_checked_before_the_step(mode: str) -> None:
    """The check gets the gradients of the parameters; if it raises, they have not moved."""
    encoder, update = make(mode)
    before, seen = values(encoder), []

    def check(name: str, gradients: list[th.Tensor]) -> None:
        seen.append((name, [gradient.shape for gradient in gradients]))
        raise ArithmeticError

    update.begin(makers(0), check)
    with pytest.raises(ArithmeticError):
        learn(update, "task")
        update.finish()
    assert seen == [("encoder", [parameter.shape for parameter in encoder.parameters()])]
    assert th.equal(values(encoder), before)


# ---------------------------------------------------------------- states


@MODES
def test_state_dict_gives_the_same_next_updates(mode: str) -> None:
    """Moments, running sizes and the count of updates, by which norms are measured, are restored."""
    encoder, update = make(mode)
    for step in range(MEASURE_INTERVAL - 1):
        whole(update, step)
    copied, restored = make(mode)
    copied.load_state_dict(encoder.state_dict())
    restored.load_state_dict(copy.deepcopy(update.state_dict()))
    restored.metrics = dict(update.metrics)
    for step in range(MEASURE_INTERVAL - 1, MEASURE_INTERVAL + 2):
        assert whole(restored, step) == whole(update, step)
        assert th.equal(values(copied), values(encoder))


@pytest.mark.parametrize("sources, mode", [(("srl", "task"), "sequential"), (SOURCES, "joint"), (("task",), "joint")])
def test_state_of_another_kind_is_refused(sources: tuple[str, ...], mode: str) -> None:
    """With ``strict=False`` nothing changes."""
    _, other = make(mode, sources)
    whole(other, 0)
    _, update = make("sequential")
    before = str(update.state_dict())
    with pytest.raises(RuntimeError, match="load with the update="):
        update.load_state_dict(other.state_dict())
    update.load_state_dict(other.state_dict(), strict=False)
    assert str(update.state_dict()) == before


@MODES
def test_sources_come_and_go(mode: str) -> None:
    """One added later starts from nothing, and leaves the others alone; one removed leaves no trace."""
    _, update = make(mode, ("srl", "task"))
    whole(update, 0)
    before = str(update.state_dict())
    update.set_sources(("srl", "task", "curious"))
    assert update.total_weights["curious"] == 0
    assert {"latent_grad_norm_curious", "latent_grad_norm_task"} <= whole(update, 1).keys()
    update.set_sources(("srl", "task"))
    kept = [*update.state_dict()["total_weights"], *update.optimizers, *update.metrics]
    assert not any("curious" in name for name in kept)
    other = make(mode, ("srl", "task"))[1]
    other.load_state_dict(update.state_dict())
    _, again = make(mode, ("srl", "task"))
    whole(again, 0)
    again.set_sources(("srl", "task", "curious"))
    again.set_sources(("srl", "task"))
    assert str(again.state_dict()) == before


# ---------------------------------------------------------------- what is logged


@MODES
def test_latent_gradient_norms_are_unscaled(mode: str) -> None:
    """Of all latents that the loss has read together; of this update's losses alone."""
    _, update = make(mode)
    whole(update, 0)
    begin(update, 1)
    latents = [update.encoder(views(1)[name]).detach().requires_grad_() for name in READS["srl"]]
    expected = norm(th.autograd.grad(sum(map(LOSSES["srl"], latents)), latents))  # type: ignore[arg-type]
    learn(update, "srl")
    logged = {name: float(value) for name, value in update.metrics.items() if name.startswith("latent_")}
    assert logged == pytest.approx({"latent_grad_norm_srl": expected})


def test_joint_logs_scaled_gradients_at_the_parameters() -> None:
    """Gradients of equal size at the latents may differ at the parameters: it is these that the step is made of."""
    encoder, update = make("joint", ("srl", "task"))
    with th.no_grad():
        encoder.projection.weight[1].mul_(1e3)  # what pulls at this latent moves the trunk far
    encoder.projection.requires_grad_(False)
    begin(update, 0)
    norms = {}
    for source, size in (("srl", 1e-6), ("task", 10.0)):
        leaf = update.latents(source)
        leaf.grad = th.zeros(5, 3)
        leaf.grad[:, 0 if source == "srl" else 1] = size
        scaled = leaf.grad / leaf.grad.norm()
        latents = encoder(views(0)["observations"])
        norms[source] = norm(th.autograd.grad(latents, list(encoder.trunk.parameters()), scaled))
        update.collect(source)
    update.finish()
    logged = {name: float(value) for name, value in update.metrics.items() if name.startswith("encoder_")}
    expected = {f"encoder_grad_norm_{source}": value for source, value in norms.items()}
    expected |= {f"encoder_share_{source}": value / sum(norms.values()) for source, value in norms.items()}
    assert logged == pytest.approx(expected, rel=1e-3)
    assert logged["encoder_share_srl"] < 0.02


def test_images_of_a_dictionary_have_sizes_of_their_own() -> None:
    """The gradients of a loss at a pale image's latents are as large as those at the other's."""
    encoder: Any = Tiny()
    encoder.slices = {"front": slice(0, 1), "pale": slice(1, 3)}
    before = encoder.projection.bias.detach().clone()
    _, update = make("joint", ("srl",), encoder, optimizer_class=th.optim.SGD)
    begin(update, 0)
    leaf = update.latents("srl")
    leaf.grad = th.tensor([1e3, 1e-3, 1e-3]).repeat(5, 1)
    update.collect("srl")
    update.finish()
    moved = (before - encoder.projection.bias.detach()) / LR
    th.testing.assert_close(moved, 5 / th.tensor([5.0, 10.0, 10.0]).sqrt(), rtol=1e-4, atol=0)
    assert float(update.metrics["latent_grad_norm_srl"]) == pytest.approx(1e3 * 5**0.5)


def test_source_that_takes_no_part_has_no_share() -> None:
    """As in phases without it: shares that are logged are those of one update."""
    _, update = make("joint", ("srl", "task"))
    whole(update, 0)
    for step in range(1, MEASURE_INTERVAL + 1):
        begin(update, step)
        learn(update, "srl")
        update.finish()
    assert [float(update.metrics[f"encoder_share_{name}"]) for name in ("srl", "task")] == [1, 0]


def test_shares_are_measured_now_and_then() -> None:
    """In the first update and every 101st, as it costs a pass per source."""
    _, update = make("joint")
    measured = [whole(update, step)["encoder_share_task"] for step in range(MEASURE_INTERVAL + 1)]
    assert len(set(measured[:-1])) == 1 and measured[-1] != measured[0]


@pytest.mark.parametrize("interval", [2, 3, 4, 5])
def test_shares_tell_of_sources_that_rest(interval: int) -> None:
    """A source that takes part in every k-th update has its share in every k-th measurement."""
    _, update = make("joint", ("srl", "task"))
    shares = []
    for step in range(2 * interval * MEASURE_INTERVAL):
        begin(update, step)
        for source in ("srl", "task")[: 1 + (step % interval == 0)]:
            learn(update, source)
        update.finish()
        if step % MEASURE_INTERVAL == 0:
            shares.append(float(update.metrics["encoder_share_task"]))
    assert sum(share > 0 for share in shares) == 2


def test_measuring_changes_no_training(monkeypatch: pytest.MonkeyPatch) -> None:
    after = []
    for interval in (1, 2):  # never, every second update
        monkeypatch.setattr(encoder_update, "MEASURE_INTERVAL", interval)
        encoder, update = make("joint")
        logged = [whole(update, step) for step in range(4)][-1]
        assert any("encoder_" in name for name in logged) == (interval == 2)
        after.append(values(encoder))
    assert th.equal(*after)
