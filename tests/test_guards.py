"""What is not finite reaches neither parameters nor replay buffer; its source is named, a post-mortem is written."""

import contextlib
import copy
import errno
import functools
import io
import itertools
import json
import pickle
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from envs_for_tests import PixelBox, VectorBox, differences, state_of, tiny_model
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnvWrapper, VecNormalize

from sb3_cure import CuReSAC
from sb3_cure.buffers import SkippingReplayBuffer, transitions
from sb3_cure.encoder_optimizer import EncoderOptimizer
from sb3_cure.guards import BadTransitionError, Guard, NonFiniteError, TransitionGuard
from sb3_cure.serialization import read_state, write_state
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


# ----------------------------------------------------------------- transitions


class Flawed(VectorBox):
    """Episodes of 5 steps, in which what is told is returned at given steps, counted from the first reset.

    :param flaws: By step: ``"reward"``, ``"observation"`` or ``"reset"`` (the first observation of the episode that
        starts after this step)
    :param value: What is told
    """

    def __init__(self, flaws: dict[int, str] | None = None, value: float = NAN):
        super().__init__(episode_length=5)  # with the defaults of the class that comes next
        self.flaws, self.value, self.total = dict(flaws or {}), value, 0

    def reset(self, **kwargs: Any) -> Any:
        observation, info = super().reset(**kwargs)
        if self.flaws.get(self.total) == "reset":
            observation[1] = self.value
        return observation, info

    def step(self, action: np.ndarray) -> Any:
        observation, reward, terminated, truncated, info = super().step(action)
        self.total += 1
        flaw = self.flaws.get(self.total)
        if flaw == "observation":
            observation[0] = self.value
        return observation, self.value if flaw == "reward" else reward, terminated, truncated, info


class FlawedBox(Flawed, VectorBox):
    """Vectors."""


class FlawedPixels(Flawed, PixelBox):
    """Images, which are whole numbers: only rewards can be flawed."""


PLAIN: dict[str, Any] = dict(srl=None, curiosity=None)


@pytest.mark.parametrize("extras", [{}, PLAIN], ids=["all", "plain SAC"])
@pytest.mark.parametrize(
    "flaws, sentence",
    [
        ({7: "reward"}, "environment 1 returned the reward nan at agent step 14, but rewards must be finite"),
        ({7: "observation"}, "environment 1 returned the observation with nan in it at agent step 14, but obs"),
        ({5: "observation"}, "environment 1 returned the terminal observation with nan in it at agent step 10, but"),
        ({5: "reset"}, "environment 1 returned the observation with nan in it at agent step 10, but"),
        ({0: "reset"}, "environment 1 returned the first observation with nan in it at agent step 0, but"),
    ],
    ids=["reward", "observation", "terminal observation", "reset", "first reset"],
)
def test_bad_transitions_raise_and_are_not_stored(flaws: Any, sentence: str, extras: dict[str, Any]) -> None:
    """Nothing of that step is stored, of no environment; the next `learn` starts with a reset."""
    venv = DummyVecEnv([VectorBox, functools.partial(FlawedBox, flaws)])
    model = tiny_model("MlpPolicy", venv, learning_starts=100, **extras)
    with pytest.raises(ValueError, match=rf"{sentence}.*: it was not stored; look at .*, then fix .*='skip'\."):
        model.learn(40)
    assert model.replay_buffer.pos == max(model.num_timesteps // 2 - 1, 0) == max(max(flaws) - 1, 0)
    model._last_obs = None
    venv.envs[1].unwrapped.flaws.clear()
    model.learn(20, reset_num_timesteps=False)
    assert np.isfinite(model.replay_buffer.observations[: model.replay_buffer.pos]).all()


@pytest.mark.parametrize("extras", [{}, PLAIN], ids=["all", "plain SAC"])
@pytest.mark.parametrize(
    "flaw, array, source",
    [
        ("reward", "rewards", "environment 1 returned the reward nan at agent step 10, "),
        (
            "observation",
            "terminal_observations.1",
            "environment 1 returned the terminal observation with nan in it at ",
        ),
        ("reset", "next_observations", "environment 1 returned the observation with nan in it at agent step 10, "),
    ],
)
def test_the_post_mortem_of_a_step_shows_what_was_not_finite(
    flaw: str, array: str, source: str, extras: dict[str, Any], tmp_path: Path
) -> None:
    """Beside the logs, without pickle: the report names the source, and the arrays hold the bad value."""
    venv = DummyVecEnv([VectorBox, functools.partial(FlawedBox, {5: flaw})])
    model = tiny_model("MlpPolicy", venv, learning_starts=100, **extras)
    model.set_logger(configure(str(tmp_path), ["csv"]))
    with pytest.raises(BadTransitionError) as caught:
        model.learn(40)
    (folder,) = tmp_path.glob("post_mortem_step_10_*")
    assert caught.value.post_mortem == str(folder) and str(folder) in str(caught.value)
    report = json.loads((folder / "report.json").read_text(), parse_constant=pytest.fail)
    assert report["source"].startswith(source) and report["agent_steps"] == 10
    assert report["config"]["seed"] == 0 and "PyTorch" in report["versions"]
    with np.load(folder / "step.npz", allow_pickle=False) as step:
        assert [name for name in step if not np.isfinite(step[name]).all()] == [array]
        assert step["observations"].shape == (2, 2) and step["actions"].shape == (2, 2)


def test_the_post_mortem_of_a_step_shows_what_normalization_has_hidden(tmp_path: Path) -> None:
    """Frozen VecNormalize clips an infinite reward to 10."""
    venv = VecNormalize(DummyVecEnv([functools.partial(FlawedBox, {3: "reward"}, INF)]), training=False, norm_obs=False)
    model = tiny_model("MlpPolicy", venv)
    with pytest.raises(BadTransitionError) as caught:
        model.learn(10)
    with np.load(Path(caught.value.post_mortem) / "step.npz", allow_pickle=False) as step:
        assert np.isinf(step["original_rewards"]).all() and np.isfinite(step["rewards"]).all()


def test_after_a_bad_transition_training_starts_with_a_reset() -> None:
    """Otherwise the next transition stored would span the steps between."""
    env = FlawedBox({7: "reward"})
    model = tiny_model("MlpPolicy", env, learning_starts=100)
    with pytest.raises(ValueError, match="the reward nan"):
        model.learn(40)
    model.learn(1, reset_num_timesteps=False)
    # Six steps were stored, the eighth of the environment is the first of a new episode.
    assert model.replay_buffer.pos == 7
    assert env.n_steps == 1


def skipping(
    flaws: list[dict[int, str]], steps: int, value: float = NAN, env: type[Flawed] = FlawedBox
) -> tuple[CuReSAC, list[Any]]:
    """A model that has collected, and what its replay buffer was given."""
    venv = DummyVecEnv([functools.partial(env, each, value) for each in flaws])
    policy = "MlpPolicy" if env is FlawedBox else "CnnPolicy"
    model = tiny_model(policy, venv, on_bad_transition="skip", learning_starts=1000)
    given_: list[Any] = []
    buffer = model.replay_buffer
    # Of the class that it then has: SB3's buffer becomes another one.
    buffer.add = lambda *args: (given_.append(copy.deepcopy(args)), type(buffer).add(buffer, *args))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model.learn(steps * len(flaws))
    return model, given_


FLAWS = st.dictionaries(st.integers(0, 12), st.sampled_from(["reward", "observation", "reset"]), max_size=6)


@settings(max_examples=30, deadline=None)
@given(st.lists(FLAWS, min_size=2, max_size=2), st.sampled_from([NAN, INF, -INF]))
def test_skipped_transitions_are_marked_and_all_others_are_as_they_were(flaws: list[Any], value: float) -> None:
    """Marked is what has a bad reward, ends or starts in a bad observation, and nothing else; all stored is finite."""
    model, stored = skipping(flaws, 12, value)
    _, clean = skipping([{}, {}], 12)
    n_bad = 0
    for t, (row, right) in enumerate(zip(stored, clean, strict=True), start=1):
        obs, next_obs, actions, rewards, _, infos = row
        assert all(np.isfinite(array).all() for array in (obs, next_obs, actions, rewards))
        for i, flaw in enumerate(flaws):
            starts_new = (t - 1) % 5 == 0
            bad_start = flaw.get(t - 1) == ("reset" if starts_new else "observation")
            bad = bad_start or flaw.get(t) in ("reward", "observation")
            n_bad += bad
            assert ("bad_transition" in infos[i]) == bad, (t, i)
            if not bad:
                # Actions are random: those of the warm-up, the same in both runs.
                for given_here, given_there in zip(row[:5], right[:5], strict=True):
                    np.testing.assert_array_equal(given_here[i], given_there[i])
    assert model._transition_guard.n_bad == n_bad


@pytest.mark.parametrize("extras", [{}, PLAIN], ids=["all", "plain SAC"])
def test_skipping_goes_on_warns_once_of_a_kind_and_counts(extras: dict[str, Any]) -> None:
    """The policy never sees what is not finite, with every kind of flaw while it acts and learns."""
    flaws = {0: "reset", 15: "reset", 17: "reward", 18: "reward", 20: "observation", 22: "observation"}
    env = FlawedBox(flaws)
    model = tiny_model("MlpPolicy", env, on_bad_transition="skip", learning_starts=3, gradient_steps=0, **extras)
    seen = []
    predict = model.predict
    model.predict = lambda observation, **kw: (seen.append(observation), predict(observation, **kw))[1]  # type: ignore[method-assign, assignment]
    with pytest.warns(UserWarning) as caught:
        model.learn(30, log_interval=100)
    told = [str(w.message) for w in caught if "on_bad_transition" in str(w.message)]
    kinds = ("first observation with nan", "observation with nan", "reward nan", "terminal observation with nan")
    assert len(told) == 4
    assert all(any(f"the {kind}" in sentence for sentence in told) for kind in kinds)
    assert model.num_timesteps == 30 and len(seen) == 27 and np.isfinite(seen).all()
    # Steps 1 and 16 start in a bad observation, 17 and 18 have a bad reward, 20 and 22 end in one, 23 starts there.
    assert model._transition_guard.n_bad == 7
    with patched(model.logger, "dump", lambda step: None):
        model.dump_logs()
    assert model.logger.name_to_value["rollout/bad_transitions"] == 7


def test_on_a_bad_observation_the_policy_acts_on_the_last_good_one() -> None:
    _, stored = skipping([{7: "observation"}], 9)
    np.testing.assert_array_equal(stored[7][0], stored[6][0])
    assert not np.array_equal(stored[8][0], stored[7][0])


@pytest.mark.parametrize("env", [FlawedBox, FlawedPixels], ids=["ReplayBuffer", "FrameStackReplayBuffer"])
def test_skipped_transitions_are_never_sampled(env: Any) -> None:
    """Every sample has the action of a transition that was not marked."""
    model, stored = skipping([{t: "reward" for t in range(2, 40, 3)}, {}], 40, env=env)
    good = {row[2][i].tobytes() for row in stored for i in range(2) if "bad_transition" not in row[5][i]}
    assert model._transition_guard.n_bad == 13 and len(good) == 67
    batch = model.replay_buffer.sample(2000)
    assert {action.tobytes() for action in batch.actions.numpy()} == good
    # The post-mortem of an update knows those that were drawn instead of bad ones.
    rows, env_inds = model.replay_buffer.last_sampled
    assert th.equal(transitions(model.replay_buffer, rows, env_inds).rewards, batch.rewards)


@pytest.mark.parametrize("extras", [{}, PLAIN], ids=["all", "plain SAC"])
@pytest.mark.parametrize("mode", ["raise", "skip"])
def test_no_environment_gets_an_action_that_is_not_finite(mode: str, extras: dict[str, Any]) -> None:
    """Not the environment's fault, hence never skipped; here it comes from the noise."""
    noise = NormalActionNoise(np.zeros(2), np.array([0.0, NAN]))
    env = VectorBox()
    model = tiny_model("MlpPolicy", env, action_noise=noise, on_bad_transition=mode, **extras)
    with pytest.raises(ValueError, match=r"chose the action \[.* nan\] for environment 0 at agent step 0, but actions"):
        model.learn(5)
    assert env.n_steps == 0 and model.replay_buffer.pos == 0


def test_values_that_normalization_hides_are_found() -> None:
    """Frozen VecNormalize clips an infinite reward to 10, but the buffer stores the original."""
    venv = VecNormalize(DummyVecEnv([functools.partial(FlawedBox, {3: "reward"}, INF)]), training=False, norm_obs=False)
    model = tiny_model("MlpPolicy", venv)
    with pytest.raises(ValueError, match="the reward inf at agent step 3"):
        model.learn(10)
    assert model.replay_buffer.pos == 2


class Wide(VecEnvWrapper):
    """Returns float64, as workers do that stack what they were sent; at step 7 environment 1 returns 1e39."""

    def __init__(self, venv: Any, flaw: str):
        super().__init__(venv)
        self.flaw, self.total = flaw, 0

    def reset(self) -> np.ndarray:
        return self.widened(self.venv.reset(), "first observation")

    def widened(self, observations: np.ndarray, flaw: str) -> np.ndarray:
        observations = observations.astype(np.float64)
        if self.flaw == flaw:
            observations[1, 0] = 1e39
        return observations

    def step_wait(self) -> Any:
        observations, rewards, dones, infos = self.venv.step_wait()
        self.total += 1
        rewards = rewards.astype(np.float64)
        if self.total == 7 and self.flaw == "reward":
            rewards[1] = 1e39
        if self.total == 10 and self.flaw == "terminal observation":
            infos[1]["terminal_observation"] = np.array([1.0, 1e39])
        return self.widened(observations, "observation" if self.total == 7 else ""), rewards, dones, infos


@pytest.mark.parametrize("flaw", ["reward", "observation", "first observation", "terminal observation"])
@pytest.mark.parametrize("mode", ["raise", "skip"])
@pytest.mark.filterwarnings("error:overflow")
def test_what_is_infinite_only_as_float32_is_bad_too(flaw: str, mode: str) -> None:
    """It would be stored, and shown to the networks, as infinity."""
    env = functools.partial(VectorBox, episode_length=5)
    venv = Wide(DummyVecEnv([env, env]), flaw)
    model = tiny_model("MlpPolicy", venv, learning_starts=4, on_bad_transition=mode)
    sentence = rf"environment 1 returned the {flaw} (with )?1e\+39 .*, but {flaw}s must be finite in float32: "
    if mode == "raise":
        with pytest.raises(ValueError, match=sentence):
            model.learn(30)
    else:
        with pytest.warns(UserWarning, match=sentence):
            model.learn(30)
        marks = {"first observation": [[0, 1]], "reward": [[6, 1]], "observation": [[6, 1], [7, 1]]}
        assert np.argwhere(model.replay_buffer.marked).tolist() == marks.get(flaw, [[9, 1]])
    buffer = model.replay_buffer
    assert not any(not_finite(getattr(buffer, name)) for name in ("observations", "next_observations", "rewards"))


def admitted(guard: TransitionGuard, steps: list[Any], start: int, last_obs: Any) -> tuple[list[Any], Any]:
    """What a guard makes of steps, as it is asked while a model collects, and the last observations."""
    told = []
    for timestep, (new_obs, rewards) in enumerate(steps, start=start):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            last_obs = guard.admit_first(last_obs, None, timestep)
            dones = np.arange(len(rewards)) == timestep % 4
            infos = [{"terminal_observation": np.full(2, rewards[i])} if done else {} for i, done in enumerate(dones)]
            last_obs, stored, infos = guard.admit(last_obs, new_obs, rewards, dones, infos, timestep)
        told.append((copy.deepcopy(last_obs), stored, infos, guard.n_bad, [str(warning.message) for warning in caught]))
    return told, last_obs


NUMBERS = st.sampled_from([0.0, 0.0, 0.0, 1.0, 1.0, NAN, INF, 1e39])


@settings(max_examples=200, deadline=None)
@given(st.data(), st.booleans(), st.integers(1, 3))
def test_a_guard_that_was_saved_between_two_steps_goes_on_identically(
    data: st.DataObject, dictionaries: bool, n_envs: int
) -> None:
    """Stand-ins, counts and what was warned of come back, also where the observations are other objects by then."""

    def observations() -> Any:
        array = np.array(data.draw(st.lists(NUMBERS, min_size=2 * n_envs, max_size=2 * n_envs))).reshape(n_envs, 2)
        return {"a": array, "b": np.zeros((n_envs, 1), dtype=np.uint8)} if dictionaries else array

    def steps() -> list[Any]:
        rewards = st.lists(NUMBERS, min_size=n_envs, max_size=n_envs)
        return [(observations(), np.array(data.draw(rewards))) for _ in range(data.draw(st.integers(0, 4)))]

    guard, restored, before, after = TransitionGuard(True), TransitionGuard(True), steps(), steps()
    _, last_obs = admitted(guard, before, 0, observations())
    file = io.BytesIO()
    write_state(file, {"guard": guard.state_dict(), "last_obs": last_obs})
    state = read_state(file)
    restored.load_state_dict(state["guard"])
    other, _ = admitted(restored, copy.deepcopy(after), len(before), state["last_obs"])
    assert differences(other, admitted(guard, after, len(before), last_obs)[0]) == []
    assert differences(restored.state_dict(), guard.state_dict()) == []


def test_after_a_reset_a_restored_guard_knows_no_stand_ins() -> None:
    guard, restored = TransitionGuard(True), TransitionGuard(True)
    with pytest.warns(UserWarning, match="first observation with nan"):
        seen = guard.admit_first(np.array([[NAN]]), None, 0)
    restored.load_state_dict(guard.state_dict())
    for observations, marked in ((np.array([[2.0]]), False), (seen.copy(), True)):
        restored.load_state_dict(guard.state_dict())
        first = restored.admit_first(observations, None, 1)
        _, _, infos = restored.admit(first, np.array([[1.0]]), np.zeros(1), np.zeros(1, dtype=bool), [{}], 1)
        assert ("bad_transition" in infos[0]) == marked


def test_skipping_and_normalization_are_refused_together() -> None:
    """In the constructor, and where `set_env` brings it; VecNormalize's averages would stay bad for good."""
    sentence = r"on_bad_transition='skip' was given with VecNormalize, but .*: leave on_bad_transition='raise', or use"
    with pytest.raises(ValueError, match=sentence):
        tiny_model("MlpPolicy", VecNormalize(DummyVecEnv([VectorBox])), on_bad_transition="skip")
    model = tiny_model("MlpPolicy", VectorBox(), on_bad_transition="skip")
    model.set_env(VecNormalize(DummyVecEnv([VectorBox])))
    with pytest.raises(ValueError, match=sentence):
        model.learn(5)
    with pytest.raises(ValueError, match="on_bad_transition is 'ignore', but it must be one of 'raise', 'skip'"):
        tiny_model("MlpPolicy", VectorBox(), on_bad_transition="ignore")


@pytest.mark.parametrize("extras", [{}, PLAIN], ids=["all", "plain SAC"])
def test_guarded_models_save_and_load(extras: dict[str, Any], tmp_path: Path) -> None:
    """The argument travels with the archive, the guards are made anew."""
    model = tiny_model("MlpPolicy", VectorBox(), on_bad_transition="skip", **extras).learn(12)
    model.save(tmp_path / "model")
    loaded = CuReSAC.load(tmp_path / "model", env=VectorBox())
    assert loaded.on_bad_transition == "skip" and loaded._transition_guard.skip
    loaded.learn(12)


class NoReward(VectorBox):
    """Its fifteenth reward is None."""

    n_all = 0

    def step(self, action: np.ndarray) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        observation, reward, *rest = super().step(action)
        self.n_all += 1
        return observation, None if self.n_all == 15 else reward, *rest


def test_a_reward_that_worker_processes_do_not_give(tmp_path: Path) -> None:
    """Rewards then arrive as objects."""
    venv = SubprocVecEnv([NoReward] * 2)
    try:
        with pytest.warns(UserWarning, match="returned the reward nan at agent step 30"):
            model = tiny_model("MlpPolicy", venv, on_bad_transition="skip").learn(60)
        assert np.isfinite(model.replay_buffer.rewards).all() and model._transition_guard.n_bad == 2
    finally:
        venv.close()


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (dict(curiosity=None, n_steps=3), "which a NStepReplayBuffer cannot do: use SkippingReplayBuffer"),
        (
            dict(optimize_memory_usage=True, replay_buffer_kwargs=dict(handle_timeout_termination=False)),
            "which a ReplayBuffer cannot do: use SkippingReplayBuffer",
        ),
    ],
)
def test_what_cannot_be_skipped_is_known_before_training(arguments: dict[str, Any], sentence: str) -> None:
    """Rather than at the first bad transition; nor is it advised, nor asked of environments that are begun anew."""
    model = tiny_model("MlpPolicy", VectorBox(), on_bad_transition="skip", **arguments)
    with pytest.raises(ValueError, match=rf"^on_bad_transition='skip' leaves transitions out .*, {sentence}"):
        model.learn(5)
    assert model.num_timesteps == 0
    with pytest.raises(BadTransitionError) as caught:
        tiny_model("MlpPolicy", NanAtTheEnd(), **arguments).learn(60)
    assert "fix the environment" in str(caught.value) and "skip" not in str(caught.value)


class NanAtTheEnd(VectorBox):
    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = super().step(action)
        return observation, NAN if truncated else reward, terminated, truncated, info


def test_statistics_that_a_bad_value_has_spoilt_are_not_the_environments_fault() -> None:
    venv = VecNormalize(DummyVecEnv([NanAtTheEnd]), norm_obs=False)
    model = tiny_model("MlpPolicy", venv)
    with pytest.raises(BadTransitionError, match="environment 0 returned the reward nan"):
        model.learn(60)
    venv.venv.envs[0].unwrapped.episode_length = 10_000  # mended
    with pytest.raises(
        BadTransitionError, match=r"VecNormalize made the reward nan .*make a new VecNormalize, or load"
    ):
        model.learn(5)


def test_one_skipped_reward_does_not_hide_the_returns_of_others() -> None:
    class Sometimes(NanAtTheEnd):
        n_episodes = 0

        def reset(self, **kwargs: Any) -> tuple[np.ndarray, dict[str, Any]]:
            self.n_episodes += 1
            return super().reset(**kwargs)

        def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
            return (super() if self.n_episodes == 2 else super(NanAtTheEnd, self)).step(action)

    model = tiny_model("MlpPolicy", DummyVecEnv([lambda: Monitor(Sometimes())]), on_bad_transition="skip")
    with pytest.warns(UserWarning, match="returned the reward nan"):
        model.learn(80)
    model._update_info_buffer([{"episode": None}])
    assert len(model.ep_info_buffer) == 3 and np.isfinite([each["r"] for each in model.ep_info_buffer]).all()


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
