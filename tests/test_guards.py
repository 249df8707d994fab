"""What is not finite reaches neither parameters nor replay buffer; its source is named, a post-mortem is written."""

import contextlib
import copy
import errno
import functools
import itertools
import json
import pickle
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from envs_for_tests import PixelBox, VectorBox, differences, state_of, tiny_model
from gymnasium import spaces
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_cure import CuReSAC
from sb3_cure.buffers import SkippingReplayBuffer, transitions
from sb3_cure.encoder_optimizer import EncoderOptimizer
from sb3_cure.guards import Guard, NonFiniteError
from sb3_cure.srl import SRLHead, SRLOutput

NAN, INF = float("nan"), float("inf")


class OwnHead(SRLHead):
    """Predicts the observation, and keeps a running mean of its loss."""

    def __init__(self, encoder: Any, observation_space: spaces.Space):
        super().__init__(encoder, observation_space)
        self.linear = th.nn.Linear(encoder.features_dim, 2)
        self.register_buffer("mean_loss", th.zeros(()))

    def loss(self, batch: Any, latents: th.Tensor) -> SRLOutput:
        error = (self.linear(latents) - batch.observations).square().mean(dim=1)
        self.mean_loss.lerp_(error.detach().mean(), 0.1)
        return SRLOutput(error.mean(), error.detach())


@functools.cache
def trained(head: Any, update: str) -> CuReSAC:
    """A model of each kind, to which tests do no lasting harm."""
    arguments: dict[str, Any] = dict(srl=head, update=update, actor_update_interval=1, target_update_interval=1)
    if head is OwnHead:
        return tiny_model("MlpPolicy", VectorBox(), **arguments).learn(20)
    return tiny_model("CnnPolicy", PixelBox(size=24), **arguments).learn(20)


# --------------------------------------------------------------------- sources


@contextlib.contextmanager
def patched(owner: Any, name: str, function: Any) -> Iterator[None]:
    before = owner.__dict__.get(name)
    object.__setattr__(owner, name, function) if before is None else setattr(owner, name, function)
    try:
        yield
    finally:
        if before is None:
            owner.__dict__.pop(name)
        else:
            setattr(owner, name, before)


@contextlib.contextmanager
def bad_gradient(parameter: th.Tensor, value: float, call: int = 0) -> Iterator[None]:
    """Within this context this backward pass through the parameter gives a gradient that is not finite."""
    count = itertools.count()
    handle = parameter.register_hook(lambda g: th.full_like(g, value) if next(count) == call else g)
    try:
        yield
    finally:
        handle.remove()


@contextlib.contextmanager
def bad_output(module: th.nn.Module, value: float, call: int) -> Iterator[None]:
    count = itertools.count()
    handle = module.register_forward_hook(
        lambda m, i, out: tuple(q * value for q in out) if next(count) == call else out
    )
    try:
        yield
    finally:
        handle.remove()


def bad_head(model: CuReSAC, loss: float = 1.0, error: float = 1.0) -> Any:
    right = model.policy.srl.loss

    def wrong(batch: Any, latents: th.Tensor) -> SRLOutput:
        output = right(batch, latents)
        # As in a head that keeps running statistics
        for buffer in model.policy.srl.buffers():
            if buffer.is_floating_point():
                buffer.mul_(loss)
        return SRLOutput(output.loss * loss, output.error * error)

    return patched(model.policy.srl, "loss", wrong)


def bad_pull(model: CuReSAC, name: str, value: float) -> Any:
    pull = model.policy.encoder_optimizer.pull

    def wrong(source: str, latents: th.Tensor, gradient: th.Tensor) -> None:
        pull(source, latents, gradient * value if source == name else gradient)

    return patched(model.policy.encoder_optimizer, "pull", wrong)


@contextlib.contextmanager
def bad_entropy(model: CuReSAC, value: float, call: int) -> Iterator[None]:
    """Within this context the target entropy, read once for each agent, is not finite for one of them."""
    count, right = itertools.count(), model.target_entropy
    CuReSAC.target_entropy = property(lambda _: value if next(count) == call else right)  # type: ignore[assignment, method-assign]
    try:
        yield
    finally:
        del CuReSAC.target_entropy


def sources(model: CuReSAC) -> dict[str, Any]:
    """Every place at which something can go wrong: name in the sentence, and what makes it go wrong."""
    policy = model.policy
    first = lambda module: next(module.parameters())  # noqa: E731
    found: dict[str, Any] = {
        "SRL loss": lambda v: bad_head(model, loss=v),
        "SRL error": lambda v: bad_head(model, error=v),
        "gradient of the SRL loss": lambda v: bad_gradient(first(policy.srl), v),
    }
    agents = {"task": (policy.actor, policy.critic, model.log_ent_coef)}
    agents["curious"] = (policy.curious_actor, policy.curious_critic, model.curious_log_ent_coef)
    for i, (name, (actor, critic, log_ent_coef)) in enumerate(agents.items()):
        found |= {
            f"{name} critic's loss": functools.partial(bad_output, critic, call=0),
            f"gradient of the {name} critic's loss": functools.partial(bad_gradient, first(critic)),
            f"{name} actor's loss": functools.partial(bad_output, critic, call=1),
            f"gradient of the {name} actor's loss": functools.partial(bad_gradient, first(actor)),
            f"{name} temperature's loss": functools.partial(bad_entropy, model, call=i),
            f"gradient of the {name} temperature's loss": functools.partial(bad_gradient, log_ent_coef),
        }
    encoder = first(policy.encoder)
    for i, name in enumerate(("srl", "task", "curious")):
        if model.update == "joint":
            found[f"gradient of the {name} loss at the latents"] = functools.partial(bad_pull, model, name)
        else:
            found[f"gradient of the {name} loss at the encoder"] = functools.partial(bad_gradient, encoder, call=i)
    if model.update == "joint":
        found["gradient of the joint loss at the encoder"] = functools.partial(bad_gradient, encoder)
    return found


def live_state(model: CuReSAC) -> dict[str, Any]:
    """All that updates change, running statistics among them; not copied."""
    _, variables = model._get_torch_save_params()
    return {**model.get_parameters(), **{name: getattr(model, name) for name in variables}}


def weights(model: CuReSAC) -> dict[str, th.Tensor]:
    return {name: value.clone() for name, value in model.policy.state_dict().items()}


def not_finite(state: Any, path: str = "") -> list[str]:
    if isinstance(state, dict):
        return [bad for key, value in state.items() for bad in not_finite(value, f"{path}.{key}")]
    if isinstance(state, list | tuple):
        return [bad for i, value in enumerate(state) for bad in not_finite(value, f"{path}[{i}]")]
    finite = not isinstance(state, th.Tensor | float) or bool(th.as_tensor(state).isfinite().all())
    return [] if finite else [path]


def unreached(model: CuReSAC, source: str) -> tuple[str, ...]:
    """Prefixes in ``policy.state_dict()`` of what an update has not changed when this goes wrong in it."""
    targets = ["encoder_target.", "critic_target.", "curious_critic_target.", "curiosity."]
    # Jointly, the encoder steps last.
    last = ["encoder."] if model.update == "joint" else []
    order = ["srl.", "critic.", "actor.", "curious_critic.", "curious_actor."]
    stages = (("SRL loss", "srl loss"), ("SRL error", "task critic", "task loss"), ("task actor",))
    stages += (("task temperature", "curious critic", "curious loss"), ("curious actor",))
    start = next((i for i, words in enumerate(stages) if any(word in source for word in words)), len(order))
    return (*targets[: 3 + (start < 1)], *last, *order[start:])


@pytest.mark.parametrize("deferred", [False, True], ids=["at once", "deferred"])
@pytest.mark.parametrize("update", ["joint", "sequential"])
@pytest.mark.parametrize("head", ["rae", "curl", OwnHead])
def test_whatever_goes_bad_is_named_and_taken_by_nothing(
    head: Any, update: str, deferred: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every loss and gradient of every network: all stays finite, the source's network and all after it unchanged."""
    model = trained(head, update)
    monkeypatch.setattr(model._guard, "deferred", deferred)
    values = itertools.cycle((NAN, INF, -INF))
    for source, inject in sources(model).items():
        before, update_number = weights(model), model._n_updates
        with inject(next(values)), pytest.raises(NonFiniteError) as caught:
            model.train(1, 8)
            model._guard.report(model)
        assert caught.value.source == source
        assert f"the {source} was " in str(caught.value)
        assert caught.value.update == update_number
        assert not_finite([live_state(model), dict(model.policy.named_buffers())]) == []
        after = weights(model)
        unchanged = [key for key in before if key.startswith(unreached(model, source))]
        assert [key for key in unchanged if not th.equal(before[key], after[key])] == []
        # It is over: the next update is a good one, moves everything and is followed by no report.
        model.train(1, 8)
        model._guard.report(model)
        moved = [key for key, value in weights(model).items() if not th.equal(value, after[key])]
        assert {key.split(".")[0] for key in moved} >= {key.split(".")[0] for key in before}


@pytest.mark.parametrize("deferred", [False, True], ids=["at once", "deferred"])
@pytest.mark.parametrize("update", ["joint", "sequential"])
def test_a_bad_first_loss_leaves_everything_as_it_was(
    update: str, deferred: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not a parameter, moment, step count, temperature or running statistic takes part in that update."""
    model = trained(OwnHead, update)
    monkeypatch.setattr(model._guard, "deferred", deferred)
    before = state_of(model)
    totals = model.policy.encoder_optimizer.weights
    sizes = {k: v / totals[k] for k, v in before["policy.encoder_optimizer"]["mean_squares"].items() if totals[k] > 0}
    with bad_head(model, loss=NAN), pytest.raises(NonFiniteError):
        model.train(1, 8)
        model._guard.report(model)
    after = state_of(model)
    # While deferred the gradients' running sizes are brought forward by themselves: what they say stays.
    encoder_before, encoder_after = before.pop("policy.encoder_optimizer"), after.pop("policy.encoder_optimizer")
    assert differences(before, after) == []
    for name, optimizer in encoder_before["optimizers"].items():
        assert differences(optimizer["state"], encoder_after["optimizers"][name]["state"]) == []
    for name, size in sizes.items():
        assert float(encoder_after["mean_squares"][name]) == pytest.approx(float(size) * totals[name], rel=1e-5)


def test_a_gradient_whose_square_overflows_is_bad_too() -> None:
    """1e30 is finite, but what Adam keeps of it is not."""
    model = trained(OwnHead, "joint")
    parameter = model.log_ent_coef
    with bad_gradient(parameter, 1e30), pytest.raises(NonFiniteError, match="task temperature's loss was 1e\\+30"):
        model.train(1, 8)
    assert not_finite(state_of(model)) == []


@pytest.mark.parametrize("deferred", [False, True])
def test_optimizers_that_know_no_flag_are_kept_from_bad_steps(deferred: bool) -> None:
    """RMSprop for all networks: their parameters and moments are those before, and go on from there."""
    kwargs = dict(optimizer_class=th.optim.RMSprop)
    model = tiny_model("MlpPolicy", VectorBox(), srl="rae", policy_kwargs=kwargs).learn(14)
    model._guard.deferred = deferred
    before = state_of(model)
    with bad_head(model, loss=INF), pytest.raises(NonFiniteError, match="the SRL loss was inf in update 4"):
        model.train(1, 8)
        model._guard.report(model)
    assert differences(before["policy"], state_of(model)["policy"]) == []
    model.train(1, 8)
    assert not_finite(state_of(model)) == []


# -------------------------------------------------------------------- deferred


def test_deferred_the_first_source_is_reported_where_logs_are_written() -> None:
    """Good updates go on after a bad one; of two bad ones the first is told, with the losses of its update."""
    model = tiny_model("MlpPolicy", VectorBox(), srl="rae", actor_update_interval=1).learn(14)
    model._guard.deferred = True
    critic = next(model.policy.critic.parameters())
    model.train(2, 8)
    with bad_gradient(critic, NAN):
        model.train(1, 8)
    after_bad = state_of(model)
    model.train(2, 8)
    assert len(differences(after_bad["policy"], state_of(model)["policy"])) > 20
    with bad_head(model, loss=INF):
        model.train(1, 8)
    with pytest.raises(NonFiniteError, match=r"gradient of the task critic's loss was nan in update 6") as caught:
        model.dump_logs()
    report = json.loads((Path(caught.value.post_mortem) / "report.json").read_text())
    assert report["losses"]["task critic's loss"]["gradient_norm"] == "nan"
    assert isinstance(report["losses"]["SRL loss"]["loss"], float)
    assert not_finite(state_of(model)) == []
    model.dump_logs()


def test_deferred_the_flag_is_read_at_the_end_of_learn() -> None:
    """Also where no log is ever written; the environment steps after the bad update are made."""
    model = tiny_model("MlpPolicy", VectorBox(), srl="rae").learn(14)
    model._guard.deferred = True
    step, calls = model._gradient_step, itertools.count()

    def sometimes(batch: Any) -> None:
        with bad_head(model, loss=NAN) if next(calls) == 2 else contextlib.nullcontext():
            step(batch)

    model._gradient_step = sometimes  # type: ignore[method-assign]
    with pytest.raises(NonFiniteError, match="SRL loss was nan in update 6"):
        model.learn(10, reset_num_timesteps=False, log_interval=None)
    assert model.num_timesteps == 24


@pytest.mark.parametrize("update", ["joint", "sequential"])
def test_good_updates_are_the_same_however_they_are_guarded(update: str) -> None:
    """At once, deferred, and not at all: bit for bit."""

    class Off(Guard):
        def check(self, *args: Any, **kwargs: Any) -> None:
            pass

    states = []
    for guard in (Off(), Guard(), Guard(deferred=True)):
        model = tiny_model("CnnPolicy", PixelBox(size=24), srl="rae", update=update)
        model._guard = model.policy.encoder_optimizer.guard = guard
        states.append(state_of(model.learn(22)))
    assert differences(states[0], states[1]) == []
    assert differences(states[0], states[2]) == []


# ----------------------------------------------------------------- post-mortem


@pytest.mark.parametrize("deferred", [False, True], ids=["at once", "deferred"])
@pytest.mark.parametrize("pixels", [True, False], ids=["FrameStackReplayBuffer", "ReplayBuffer"])
def test_the_post_mortem_holds_batch_losses_and_settings(pixels: bool, deferred: bool, tmp_path: Path) -> None:
    """In the logger's folder, without pickle: rows and environments lead to the very batch that is kept."""
    venv = DummyVecEnv([functools.partial(PixelBox, size=24) if pixels else VectorBox] * 3)
    model = tiny_model("CnnPolicy" if pixels else "MlpPolicy", venv, srl="rae", curiosity_beta=2.5).learn(24)
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model._guard.deferred = deferred
    used: list[Any] = []
    step = model._gradient_step
    model._gradient_step = lambda batch: (used.append(batch), step(batch))  # type: ignore[method-assign, assignment]
    with bad_output(model.policy.critic, INF, call=0), pytest.raises(NonFiniteError) as caught:
        model.train(1, 8)
        model._guard.report(model)
    (folder,) = tmp_path.glob("post_mortem_*")
    assert str(folder) in str(caught.value) and caught.value.post_mortem == str(folder)
    report = json.loads((folder / "report.json").read_text(), parse_constant=pytest.fail)
    assert report["source"] == "task critic's loss" and report["value"] == "inf"
    assert report["update"] == model._n_updates - deferred and report["agent_steps"] == 24
    assert report["losses"]["task critic's loss"]["loss"] == "inf"
    assert report["losses"]["SRL loss"]["loss"] > 0 and report["losses"]["SRL loss"]["gradient_norm"] > 0
    assert ("curious critic's loss" in report["losses"]) == deferred
    assert report["config"]["curiosity_beta"] == 2.5 and report["config"]["seed"] == 0
    assert report["config"]["policy"] == f"sb3_cure.policies.{'Cnn' if pixels else 'Mlp'}Policy"
    assert "learning_rate" in report["config"] and "policy_kwargs" in report["config"]
    assert {"sb3_cure", "PyTorch", "Stable-Baselines3"} <= report["versions"].keys()
    rows, env_inds = np.array(report["rows"]), np.array(report["environments"])
    assert len(set(env_inds)) > 1
    again = transitions(model.replay_buffer, rows, env_inds)
    with np.load(folder / "batch.npz", allow_pickle=False) as batch:
        for name in ("observations", "actions", "next_observations", "dones", "rewards"):
            np.testing.assert_array_equal(batch[name], getattr(again, name).numpy())
            np.testing.assert_array_equal(batch[name], getattr(used[0], name).numpy())


def test_a_post_mortem_that_cannot_be_written_hides_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a full disk the source is named all the same."""

    def full(*args: Any, **kwargs: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    model = trained(OwnHead, "joint")
    monkeypatch.setattr("sb3_cure.guards.tempfile.mkdtemp", full)
    with bad_head(model, loss=NAN), pytest.raises(NonFiniteError, match=r"SRL loss was nan .*No space left on device"):
        model.train(1, 8)


@pytest.mark.parametrize("value", [NAN, float("inf")])
@pytest.mark.parametrize("remembers", [False, True], ids=["ReplayBuffer", "SkippingReplayBuffer"])
def test_with_everything_off_no_optimiser_takes_what_is_not_finite(
    value: float, remembers: bool, tmp_path: Path
) -> None:
    """SB3's own update: the critic's loss is bad, and no network has moved."""
    buffer: Any = {"replay_buffer_class": SkippingReplayBuffer} if remembers else {}
    model = tiny_model("MlpPolicy", VectorBox(), srl=None, curiosity=None, **buffer).learn(30)
    model.set_logger(configure(str(tmp_path), ["csv"]))
    before = copy.deepcopy(model.policy.state_dict())
    model.replay_buffer.rewards[:] = value
    with pytest.raises(NonFiniteError, match=r"gradient of the critic loss was (nan|inf) in update 20, but") as caught:
        model.train(1, 8)
    (folder,) = tmp_path.glob("post_mortem_*")
    assert caught.value.post_mortem == str(folder)
    report = json.loads((folder / "report.json").read_text(), parse_constant=pytest.fail)
    assert report["source"] == "gradient of the critic loss" and report["config"]["batch_size"] == model.batch_size
    assert report["losses"]["critic loss"]["gradient_norm"] in ("nan", "inf") and report["agent_steps"] == 30
    assert (report["rows"] is not None) == remembers == (folder / "batch.npz").exists()
    if remembers:
        again = transitions(model.replay_buffer, np.array(report["rows"]), np.array(report["environments"]))
        with np.load(folder / "batch.npz", allow_pickle=False) as batch:
            np.testing.assert_array_equal(batch["actions"], again.actions.numpy())
    assert differences(before, model.policy.state_dict()) == []
    assert th.isfinite(model.log_ent_coef)
    model.replay_buffer.rewards[:] = 0
    model.train(1, 8)
    assert differences(before, model.policy.state_dict()) != []


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda model: pickle.loads(pickle.dumps(model))])
@pytest.mark.parametrize("extras", [{}, {"srl": None, "curiosity": None}], ids=["all", "plain SAC"])
def test_copies_look_as_their_originals(extras: dict[str, Any], copied: Any) -> None:
    """Copies of torch's optimisers have no hooks."""
    original = tiny_model("MlpPolicy", VectorBox(), **extras).learn(30)
    model = copied(original)
    model.replay_buffer.rewards[:] = NAN
    with pytest.raises(NonFiniteError, match="critic"):
        model.train(1, 8)
    assert all(th.isfinite(value).all() for value in model.policy.state_dict().values())
    original.train(1, 8)


def test_an_interrupted_update_pulls_at_no_later_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """As where pretraining ended between the gradient of its curious critic and the step of the encoder."""
    model = tiny_model("CnnPolicy", PixelBox(), curiosity=None)

    def interrupted(*_: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(EncoderOptimizer, "step", interrupted)
        model.pretrain(20, "curious")
    model.learn(11)  # one update
    assert model.policy.encoder_optimizer.shares.keys() == {"srl", "task"}
