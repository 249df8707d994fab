"""A training run as a user sees it: who acts, what is stored, what is updated when, and what is logged."""

import contextlib
import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from envs_for_tests import PixelBox, VectorBox, differences, state_of, tiny_model
from logs_for_tests import KeptRows
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.torch_layers import NatureCNN
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecFrameStack
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from updates_for_tests import filled_model

from sb3_cure import CuReSAC
from sb3_cure.cure.actor_critic import TrunkActor
from sb3_cure.data.buffers import FrameStackReplayBuffer
from sb3_cure.data.samples import Samples
from sb3_cure.evaluation.rollouts import run_episodes
from sb3_cure.intrinsic import IntrinsicReward, RewardInputs
from sb3_cure.srl import SRL_HEADS, SRLHead, SRLOutput

both_updates = pytest.mark.parametrize("update", ["sequential", "joint"])


class RecordingBox(PixelBox):
    """``PixelBox`` that keeps actions and rewards."""

    def __init__(self, **kwargs: Any):
        super().__init__(**kwargs)
        self.actions: list[np.ndarray] = []
        self.rewards: list[float] = []

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        observation, reward, *rest = super().step(action)
        self.actions.append(action.copy())
        self.rewards.append(reward)
        return observation, reward, *rest


class NoParameters(SRLHead):
    """A head with nothing to learn."""

    def loss(self, batch: Samples, latents: th.Tensor) -> SRLOutput:
        return SRLOutput(latents.square().mean(), latents.detach().square().mean(dim=1))


def log_to(model: CuReSAC) -> list[dict[str, Any]]:
    """Everything that the model's logger writes from now on, one dictionary per dump."""
    kept = KeptRows()
    model.set_logger(Logger(None, [kept]))
    return kept.rows


def make_vec_env(n_envs: int, make: Callable[[], gym.Env] = PixelBox, kind: type[VecEnv] = DummyVecEnv) -> VecEnv:
    return kind([lambda: Monitor(make())] * n_envs)


def fix_action(actor: TrunkActor, action: float) -> None:
    """Let the actor return (very nearly) this action in every observation, -1 or 1."""
    for layer, bias in ((actor.mu, 10 * action), (actor.log_std, -10.0)):
        th.nn.init.zeros_(layer.weight)
        th.nn.init.constant_(layer.bias, bias)


def acting_model(env: gym.Env | VecEnv, **kwargs: Any) -> CuReSAC:
    """Collects without updates; the task actor does -1, the curious one +1, so that the buffer shows who acted."""
    model = tiny_model("CnnPolicy", env, gradient_steps=0, **kwargs)
    fix_action(model.policy.actor, -1)
    if model.policy.curious is not None:
        fix_action(model.policy.curious.actor, 1)
    return model


def stored_actions(model: CuReSAC) -> np.ndarray:
    return model.replay_buffer.actions[: model.replay_buffer.pos]


def parts_of(names: list[str]) -> set[str]:
    """Parts of the policy that these parameters belong to; of agents their actor, critic or target."""
    parts = [name.split(".")[1:] for name in names]
    return {".".join(part[:2]) if part[0] in ("task", "curious") else part[0] for part in parts}


def moved(model: CuReSAC, step: Callable[[], Any]) -> set[str]:
    """Which networks and temperatures a step changes."""
    before = state_of(model)
    step()
    after = state_of(model)
    names = parts_of(differences(before["policy"], after["policy"]))
    temperatures = ("log_ent_coef", "policy.curious.log_ent_coef")
    return names | {key for key in temperatures if differences(before.get(key), after.get(key))}


TASK = {"task.actor", "task.critic", "task.critic_target", "log_ent_coef"}
CURIOUS = {"curious.actor", "curious.critic", "curious.critic_target", "policy.curious.log_ent_coef"}
#: Running statistics of the curious reward
STATISTICS = {"scale"}


# ------------------------------------------------------- how much is updated


@pytest.mark.parametrize("kind, n_envs", [(DummyVecEnv, 1), (DummyVecEnv, 3), (SubprocVecEnv, 3)])
def test_one_update_per_agent_step(kind: type[VecEnv], n_envs: int) -> None:
    """For any number of environments: an update per agent step after the warm-up, and one burst at its end."""
    env = make_vec_env(n_envs, kind=kind)
    model = tiny_model("CnnPolicy", env, warmup_updates=7).learn(30)
    # The first multiple of n_envs after `learning_starts` is the first step that is learned from.
    warmup = 10 if n_envs == 1 else 9
    assert (model.num_timesteps, model._n_updates) == (30, 7 + 30 - warmup)
    assert model.replay_buffer.size() == 30 // n_envs
    model.learn(12, reset_num_timesteps=False)
    assert (model.num_timesteps, model._n_updates) == (42, 7 + 42 - warmup)
    env.close()


@pytest.mark.parametrize(
    "srl, warmup_updates, burst", [("rae", None, 1000), (NoParameters, None, 0), ("curl", 5, 5), (None, None, 0)]
)
def test_burst_after_warmup(srl: Any, warmup_updates: int | None, burst: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The head decides how many updates follow the warm-up, unless ``warmup_updates`` does; they come once."""
    calls: list[tuple[int, int]] = []

    def train(self: CuReSAC, gradient_steps: int, batch_size: int) -> None:
        calls.append((self.num_timesteps, gradient_steps))

    monkeypatch.setattr(CuReSAC, "_train", train)
    arguments = dict(srl=srl, curiosity=None if srl is None else "separate", warmup_updates=warmup_updates)
    model = tiny_model("CnnPolicy", PixelBox(), **arguments).learn(14).learn(14)
    updates = [call for call in calls if call[1] > 0]
    # Learning begins with the first step after the warm-up of 10, in either run.
    after_warmup = [(step, 1) for step in (11, 12, 13, 14)]
    assert updates == [(11, burst)] * (burst > 0) + after_warmup + after_warmup
    calls.clear()
    # Without a warm-up the head wants no burst, and one that was asked for waits for a batch of 8.
    model = tiny_model("CnnPolicy", PixelBox(), learning_starts=0, **arguments).learn(9)
    updates = [call for call in calls if call[1] > 0]
    expected = [(step, 1) for step in range(1, 10)]
    assert updates == expected[:7] + [(8, warmup_updates)] * bool(warmup_updates) + expected[7:] and model._warmed_up


@pytest.mark.parametrize("overlap", [False, True])
@pytest.mark.parametrize("ended_by", ["callback", "exception"])
def test_step_in_which_training_ended_is_not_stored(ended_by: str, overlap: bool) -> None:
    """It is the last one of an episode; the next ``learn`` begins with a reset."""

    class End(BaseCallback):
        def _on_step(self) -> bool:
            if self.n_calls == 12 and ended_by == "exception":
                raise KeyboardInterrupt
            return self.n_calls < 12

    env = (SubprocVecEnv if overlap else DummyVecEnv)([lambda: Monitor(VectorBox(4))])
    model = tiny_model("MlpPolicy", env, overlap=overlap)
    with contextlib.suppress(KeyboardInterrupt):
        model.learn(30, callback=End())
    model.learn(10, reset_num_timesteps=False)
    buffer: Any = model.replay_buffer
    before, after = buffer.observations[:21, 0], buffer.next_observations[:21, 0]
    assert buffer.size() == 21
    np.testing.assert_allclose(after, np.clip(before + 0.3 * buffer.actions[:21, 0], -1, 1), atol=1e-6)
    env.close()


@both_updates
@pytest.mark.parametrize("srl", SRL_HEADS)
def test_zero_learning_rate_freezes_everything(srl: str, update: str) -> None:
    """A schedule that is zero moves no parameter, no target and no temperature."""
    model = tiny_model("CnnPolicy", PixelBox(), srl=srl, update=update, learning_rate=lambda _: 0.0)
    before = copy.deepcopy(dict(model.policy.named_parameters()))
    names = moved(model, lambda: model.learn(14))
    # CURL's bank of negatives is stored data; targets and RND's inputs are standardised by running statistics.
    of_rewards = set() if srl in ("rae", "vae") else {"intrinsic"}
    assert names - STATISTICS == of_rewards | ({"srl"} if srl in ("curl", "spr", "forward") else set())
    assert differences(before, dict(model.policy.named_parameters())) == []


def modes_of_the_head(model: CuReSAC) -> list[bool]:
    """Whether gradients are enabled, at each call of the head's loss from now on."""
    srl: Any = model.policy.srl
    modes: list[bool] = []

    def loss(*arguments: Any) -> SRLOutput:
        modes.append(th.is_grad_enabled())
        return type(srl).loss(srl, *arguments)  # type: ignore[no-any-return]

    srl.loss = loss
    return modes


@pytest.mark.parametrize(
    "intrinsic, per_pixel, reads_error", [("srl_error", False, True), ("srl_error", True, False), ("rnd", None, False)]
)
@pytest.mark.parametrize("kind", ["frozen", "alternating"])
def test_head_without_reader_does_not_run(kind: str, intrinsic: str, per_pixel: bool | None, reads_error: bool) -> None:
    """A head that does not learn, as it is frozen or the agents have their turn, runs for the reward's sake alone."""
    settings: dict[str, Any] = dict(srl_schedule="alternating", srl_period=1) if kind == "alternating" else {}
    kwargs = {} if per_pixel is None else dict(per_pixel=per_pixel)
    model = tiny_model("CnnPolicy", PixelBox(), intrinsic=intrinsic, intrinsic_kwargs=kwargs, **settings).learn(10)
    modes = modes_of_the_head(model)
    if kind == "frozen":
        model.representation_frozen = True
        model.train(2, batch_size=8)
        assert modes == [False] * (2 if reads_error else 0)
    else:
        model.train(2, batch_size=8)  # two updates in a phase of the head, then two in one of the agents
        assert modes == [True, True] + [False, False] * reads_error


@pytest.mark.parametrize(
    "update, trains_encoder, expected",
    [("sequential", True, [False, True]), ("sequential", False, [True]), ("joint", True, [True])],
)
def test_head_learns_once_from_a_batch(update: str, trains_encoder: bool, expected: list[bool]) -> None:
    """Also where the reward reads its error and then steps the encoder: a head that counts would count twice."""

    class Reader(IntrinsicReward):
        needs_srl = True

        def loss(self, inputs: RewardInputs) -> Any:
            return inputs.latents.square().mean() if trains_encoder else None, inputs.srl_error

    Reader.trains_encoder = trains_encoder
    model = tiny_model("CnnPolicy", PixelBox(), intrinsic=Reader, update=update).learn(10)
    modes = modes_of_the_head(model)
    model.train(1, batch_size=8)
    assert modes == expected


@pytest.mark.parametrize("per_pixel, runs", [(False, 1), (True, 0)])
def test_frozen_head_runs_once_for_the_error_of_the_next_observation(per_pixel: bool, runs: int) -> None:
    arguments: dict[str, Any] = dict(curiosity_target="next_observation", intrinsic_kwargs=dict(per_pixel=per_pixel))
    model = filled_model(srl="rae", **arguments)
    modes = modes_of_the_head(model)
    model.representation_frozen = True
    model.train(1, 8)
    assert len(modes) == runs


# ------------------------------------------------------------------ who acts


def test_probability_0_never_runs_the_curious_actor() -> None:
    """p_c = 0: the task actor acts; the curious agent still learns."""
    model = tiny_model("CnnPolicy", PixelBox(), curiosity_prob=0.0)

    def forbidden(*_: Any) -> None:
        raise AssertionError("the curious actor acted")

    # `forward` is how actors act; updates call `action_log_prob`.
    model.policy.curious.actor.forward = forbidden
    assert moved(model, lambda: model.learn(14)) >= CURIOUS
    with pytest.raises(AssertionError, match="acted"):
        model.predict_curious(model.observation_space.sample())


def test_probability_1_always_runs_the_curious_actor() -> None:
    """p_c = 1: uniform actions in the warm-up, then the curious actor's; their share is logged."""
    model = acting_model(PixelBox(), curiosity_prob=1.0, learning_starts=15)
    dumps = log_to(model)
    model.learn(40, log_interval=1)
    warmup, after = stored_actions(model)[:15], stored_actions(model)[15:]
    assert (np.abs(warmup) < 0.999).all() and warmup.std() > 0.3
    np.testing.assert_allclose(after, 1, atol=1e-3)
    assert [dump["rollout/curious_share"] for dump in dumps] == [1.0, 1.0]


def test_schedules_follow_the_progress_of_the_call() -> None:
    """From its beginning in every call, and never below zero where the last rollout exceeds the total."""
    seen: list[float] = []

    def schedule(remaining: float) -> float:
        seen.append(remaining)
        return float(remaining > 0.4)

    model = acting_model(PixelBox(), curiosity_prob=schedule, learning_starts=0).learn(2)
    seen.clear()
    model.learn(4)
    assert seen == [1, 0.75, 0.5, 0.25]
    assert np.sign(stored_actions(model)[2:, 0, 0]).tolist() == [1, 1, 1, -1]
    seen.clear()
    model.learn(4, reset_num_timesteps=False)
    assert seen == [0.5, 0.375, 0.25, 0.125]
    model = acting_model(PixelBox(), curiosity_prob=schedule, learning_rate=schedule, train_freq=7).learn(30)
    assert model.num_timesteps == 35 and min(seen) == 0


def test_random_second_actor_is_uniform() -> None:
    """``curiosity="random"``: uniform within the bounds of the actions, and nothing is trained for it."""
    env = RecordingBox(low=-1.0, high=3.0)
    model = acting_model(env, curiosity="random", curiosity_prob=1.0).learn(300)
    counts, _ = np.histogram(np.array(env.actions[10:]).ravel(), bins=8, range=(-1, 3))
    assert counts.sum() == 580 and model.policy.curious is None
    np.testing.assert_allclose(counts, 580 / 8, atol=5 * np.sqrt(580 / 8 * 7 / 8))


@pytest.mark.parametrize("curiosity", ["bonus", "random", None])
def test_only_separate_curiosity_has_a_policy(curiosity: str | None) -> None:
    """Elsewhere the task's actor acts (but for p_c of the steps if the second actor is random)."""
    model = acting_model(PixelBox(), curiosity=curiosity, curiosity_prob=0.5).learn(60)
    by_task = (stored_actions(model)[10:] < -0.999).all(axis=(1, 2))
    assert 10 <= by_task.sum() <= 40 if curiosity == "random" else by_task.all()
    with pytest.raises(ValueError, match="curious policy"):
        model.predict_curious(model.observation_space.sample())


@pytest.mark.parametrize("noise", [False, True])
def test_stored_actions_are_the_executed_ones(noise: bool) -> None:
    """Whoever acts, in asymmetric bounds and with noise: what the buffer holds, rescaled, is what was executed."""
    envs = [RecordingBox(low=-1.0, high=3.0) for _ in range(2)]
    action_noise = NormalActionNoise(np.zeros(2), np.full(2, 0.5)) if noise else None
    model = tiny_model(
        "CnnPolicy", DummyVecEnv([lambda env=env: env for env in envs]), curiosity_prob=0.5, action_noise=action_noise
    ).learn(50)
    executed = np.stack([env.actions for env in envs], axis=1)
    np.testing.assert_allclose(stored_actions(model) * 2 + 1, executed, atol=1e-6)
    # Noise of half the range reaches the bounds in all phases; without it nothing does.
    assert (np.abs(stored_actions(model)[6:]) == 1).any() == noise


def test_call_that_resets_environments_redraws_who_acts() -> None:
    """By its argument or because the environment is new; else who acts for an episode stays."""
    shares = []
    for resets, new in ((True, False), (False, True), (False, False)):
        kwargs: dict[str, Any] = dict(learning_starts=0, curiosity_bout="episode", curiosity_prob=0.0)
        model = tiny_model("MlpPolicy", VectorBox(), **kwargs).learn(5, log_interval=10**9)
        model._mixer.pop_metrics()
        model.curiosity_prob = 1.0
        if new:
            model.set_env(VectorBox())
        model.learn(5, log_interval=10**9, reset_num_timesteps=resets)
        shares.append(model._mixer.pop_metrics()["rollout/curious_share"])
    assert shares == [1, 1, 0]


def test_settings_can_be_changed_between_calls() -> None:
    """As in SB3: what is set at the model holds from the next step on."""
    changes: dict[str, Any] = dict(
        gamma=0.0, curiosity_gamma=0.0, curiosity_beta=100.0, normalize_curiosity=False, curiosity_prob=1.0
    )

    def parameters(**change: Any) -> dict[str, Any]:
        model = tiny_model("MlpPolicy", VectorBox(), curiosity_prob=0.5).learn(15)
        vars(model).update(change)
        return model.learn(10, reset_num_timesteps=False).get_parameters()

    usual = parameters()
    assert differences(usual, parameters()) == []
    for name, value in changes.items():
        assert differences(usual, parameters(**{name: value})) != [], name


# ------------------------------------------------------------ what is stored


@pytest.mark.parametrize("curiosity", ["separate", "bonus"])
def test_buffer_keeps_the_environments_rewards(curiosity: str) -> None:
    """The curious reward is computed per batch and never stored."""
    env = RecordingBox()
    model = tiny_model("CnnPolicy", env, curiosity=curiosity, curiosity_beta=100.0).learn(30)
    np.testing.assert_array_equal(model.replay_buffer.rewards[:30, 0], np.float32(env.rewards))


def test_buffer_smaller_than_batch_and_warmup() -> None:
    model = tiny_model("CnnPolicy", PixelBox(), buffer_size=6, batch_size=16, learning_starts=12).learn(15)
    assert (model._n_updates, model.replay_buffer.size()) == (3, 6)


@pytest.mark.parametrize(("own", "around", "last"), [(1, 3, False), (3, 2, False), (2, 3, True)])
def test_stacks_of_vec_frame_stack_are_stored_once(own: int, around: int, last: bool) -> None:
    """Each of its frames (which may be stacks of the environment's) is kept once, and nothing is evicted early."""
    make = lambda: PixelBox(frame_stack=own, channels_last=last)  # noqa: E731
    env = VecFrameStack(DummyVecEnv([make]), around)
    model = tiny_model("CnnPolicy", env, buffer_size=100, learning_starts=1000).learn(150)
    buffer = model.replay_buffer
    assert isinstance(buffer, FrameStackReplayBuffer) and buffer.frame_stack == around
    # Of an episode of 20 steps all frames are new, but for the stack that it begins with.
    assert buffer.rings[""].frames.shape[-3:] == (3 * own, 36, 36) and buffer.size() >= 85
    assert buffer.sample(64).observations.shape[1] == 3 * own * around


# --------------------------------------------------------------- pretraining


@pytest.mark.parametrize("collector", ["curious", "random"])
@pytest.mark.parametrize("curiosity", ["separate", None])
def test_pretraining(curiosity: str | None, collector: str) -> None:
    """It trains encoder and head (and the curious agent that collects), no task networks.

    It leaves an empty buffer and zero counts; what follows is an ordinary run, curious only if curiosity is on.
    """
    model = tiny_model("CnnPolicy", PixelBox(), curiosity=curiosity)
    fresh = state_of(model)
    actions: list[np.ndarray] = []

    def watch(locals_: dict[str, Any], _: Any) -> bool:
        actions.append(locals_["buffer_actions"])
        if len(actions) == 1 and collector == "curious":
            fix_action(model.policy.curious.actor, 1)
            model.policy.curious.actor.optimizer.step = lambda: None  # it keeps its action
        return True

    model.pretrain(25, collector, callback=watch)
    if collector == "curious":
        np.testing.assert_allclose(actions[10:], 1, atol=1e-3)
    else:
        assert np.abs(actions[10:]).max() < 0.9999 and np.std(actions[10:]) > 0.3
    after = state_of(model)
    names = parts_of(differences(fresh["policy"], after["policy"]))
    assert {"encoder", "encoder_target", "srl"} <= names and not names & TASK
    assert ({"curious.actor", "curious.critic"} <= names) == (curiosity == "separate" and collector == "curious")
    for key in ("actor.optimizer", "critic.optimizer", "ent_coef_optimizer", "log_ent_coef"):
        assert differences(fresh[key], after[key]) == [], key
    assert fresh.keys() == after.keys() and (model.policy.curious is None) == (curiosity is None)
    # The head's optimiser, for one, is kept.
    assert after["policy.srl.optimizer"]["state"][0]["step"] == 15
    assert (model.num_timesteps, model._n_updates, model.replay_buffer.size()) == (0, 0, 0)
    assert (model._n_batches, model._n_rl_batches) == (0, 0)  # by which actors and targets are due
    dumps = log_to(model)
    model.learn(25)
    model.logger.dump()
    assert (model.num_timesteps, model._n_updates, model.replay_buffer.size()) == (25, 15, 25)
    assert ("train/curious_critic_loss" in dumps[-1]) == bool(curiosity)
    assert np.abs(stored_actions(model)[:10]).max() < 0.9999  # random warm-up again


def test_training_after_pretraining_begins_as_without() -> None:
    """With the same environments and random numbers; two calls of ``pretrain`` do not collect the same steps."""
    collected: list[np.ndarray] = []
    states: list[th.Tensor] = []

    class Keep(BaseCallback):
        def _on_training_start(self) -> None:
            states.append(th.get_rng_state())

        def _on_step(self) -> bool:
            return True

        def _on_training_end(self) -> None:
            buffer = self.model.replay_buffer
            collected.append(buffer.actions[: buffer.size()].copy())

    for pretrains in (2, 0):
        model = tiny_model("CnnPolicy", PixelBox(), learning_starts=30, seed=0)
        for _ in range(pretrains):
            model.pretrain(31, "random", callback=Keep())
        model.learn(30, callback=Keep())
    first, second, pretrained, vanilla = collected
    assert (first != second).any() and th.equal(*states[2:])
    np.testing.assert_array_equal(pretrained, vanilla)


def test_pretraining_that_keeps_its_transitions() -> None:
    """The task learns from them, too, and its warm-up does not repeat theirs."""
    model = tiny_model("CnnPolicy", PixelBox(), learning_starts=30, intrinsic="particle", seed=0)
    model.pretrain(44, keep_replay_buffer=True)
    buffer = model.replay_buffer
    assert buffer.size() == 44 and model.num_timesteps == 0
    kept = {name: getattr(buffer, name)[:44].copy() for name in ("actions", "rewards")}
    assert (model.policy.intrinsic.places >= 0).any()  # its memory refers to the replay buffer
    model.fit_representation(2).learn(35)
    assert buffer.size() == 44 + 35
    for name, before in kept.items():
        np.testing.assert_array_equal(getattr(buffer, name)[:44], before)
    assert not (buffer.actions[44:74] == buffer.actions[:30]).all(axis=(1, 2)).any()


def test_pretraining_that_cannot_begin_changes_nothing() -> None:
    model = tiny_model("MlpPolicy", VectorBox(), curiosity=None, learning_starts=10, intrinsic_kwargs={"of": "nothing"})
    model.learn(20)
    with pytest.raises(TypeError, match="of"):
        model.pretrain(10, keep_replay_buffer=True)
    with pytest.raises(ValueError, match="20 transitions are in it"):  # such as episodes from disk
        model.pretrain(10)
    assert (model.task, model.curiosity, model.is_pretraining) == (True, None, False)
    model.learn(10, reset_num_timesteps=False)
    assert (model.num_timesteps, model.replay_buffer.size()) == (30, 30)


def test_pretraining_without_an_update_says_so() -> None:
    """Its transitions are dropped at its end, so that nothing at all is left of it."""
    with pytest.warns(UserWarning, match="ended after 12 agent steps"):
        tiny_model("MlpPolicy", VectorBox(), learning_starts=12).pretrain(12)


@pytest.mark.parametrize(
    ("before", "after"), [("separate", None), ("bonus", None), ("separate", "bonus"), (None, "separate")]
)
def test_curiosity_that_is_set_later_needs_the_same_networks(before: str | None, after: str | None) -> None:
    """Others could be trained, and saved, but not loaded."""
    model = tiny_model("MlpPolicy", VectorBox(), curiosity=before)
    model.curiosity = after
    with pytest.raises(ValueError, match=f"curiosity was set to {after!r} after"):
        model.learn(12)


@pytest.mark.parametrize("change", [dict(task=False), dict(update="sequential"), dict(curiosity_encoder_grad=False)])
def test_what_decides_who_trains_the_encoder_cannot_be_set_later(change: dict[str, Any]) -> None:
    """The task's actor would act on, untrained; and the archive could not be loaded."""
    model = tiny_model("MlpPolicy", VectorBox())
    vars(model).update(change)
    with pytest.raises(ValueError, match=f"{next(iter(change))} was set after the model was made"):
        model.learn(12)


def test_pretraining_of_a_bonus() -> None:
    """Each run has its burst; the bonus is scaled anew, by its size and not by the spread of another reward."""
    model = tiny_model("MlpPolicy", VectorBox(), curiosity="bonus", ent_coef=0.1, warmup_updates=5).pretrain(14)
    assert state_of(model)["policy.srl.optimizer"]["state"][0]["step"] == 5 + 4
    assert float(model.policy.scale.weight) == 0
    model.learn(11)
    assert state_of(model)["policy.srl.optimizer"]["state"][0]["step"] == 2 * (5 + 4) - 3
    assert model.logger.name_to_value["train/curious_reward_mean"] < 2


# ----------------------------------------------------------- kinds of models


@pytest.mark.parametrize(
    "settings",
    [
        dict(update="joint"),
        dict(update="sequential"),
        dict(srl=None, intrinsic="rnd", task=False, curiosity_encoder_grad=False),
    ],
)
def test_copy_learns_as_its_original(settings: dict[str, Any]) -> None:
    model = tiny_model("MlpPolicy", VectorBox(), **settings).learn(15)
    twin = copy.deepcopy(model)
    for each in (model, twin):
        np.random.seed(0)
        th.manual_seed(0)
        each.train(2, batch_size=8)
    assert differences(state_of(model), state_of(twin)) == []


def test_copy_shares_open_logs(tmp_path: Path) -> None:
    """Neither a terminal nor TensorBoard's files can be copied."""
    model = tiny_model("MlpPolicy", VectorBox(), verbose=1, tensorboard_log=str(tmp_path)).learn(12)
    twin = copy.deepcopy(model)
    assert twin.logger is model.logger
    assert twin.learn(5, reset_num_timesteps=False).num_timesteps == 17 and model.num_timesteps == 12


@both_updates
def test_agent_without_task(update: str) -> None:
    """The curious actor always acts, also in ``predict``; the task networks stay as they were made."""
    model = tiny_model("CnnPolicy", PixelBox(), task=False, curiosity_prob=0.0, update=update)
    dumps = log_to(model)
    names = moved(model, lambda: model.learn(16))
    model.logger.dump()
    assert names == {"encoder", "encoder_target", "srl", *CURIOUS, *STATISTICS}
    assert "train/curious_critic_loss" in dumps[-1] and "train/critic_loss" not in dumps[-1]
    image = model.observation_space.sample()
    np.testing.assert_array_equal(
        model.predict(image, deterministic=True)[0], model.predict_curious(image, deterministic=True)[0]
    )
    model = acting_model(PixelBox(), task=False, curiosity_prob=0.0).learn(20)
    np.testing.assert_allclose(stored_actions(model)[10:], 1, atol=1e-3)


@both_updates
def test_sac_alone_trains_the_shared_encoder(update: str) -> None:
    """``srl=None, curiosity=None``: no head, no curious agent, and the critics' gradient in the encoder."""
    model = tiny_model("CnnPolicy", PixelBox(), srl=None, curiosity=None, update=update)
    names = moved(model, lambda: model.learn(14))
    assert names == {"encoder", "encoder_target", *TASK}
    assert "train/srl_loss" not in model.logger.name_to_value


@pytest.mark.parametrize("srl", ["rae", "curl"])
def test_nature_cnn_is_shared_and_trained_by_all(srl: str, tmp_path: Path) -> None:
    policy_kwargs = dict(features_extractor_class=NatureCNN, features_extractor_kwargs=dict(features_dim=8))
    model = tiny_model("CnnPolicy", PixelBox(), srl=srl, policy_kwargs=policy_kwargs)
    names = moved(model, lambda: model.learn(14))
    assert names >= {"encoder", "encoder_target", "srl", *TASK, *CURIOUS}
    model.save(tmp_path / "model")
    loaded = CuReSAC.load(tmp_path / "model")
    assert loaded.policy.encode(th.zeros(3, 6, 36, 36, dtype=th.uint8)).shape == (3, 8)


@both_updates
def test_vectors_are_learned_from(update: str) -> None:
    """By a vector autoencoder and a curious agent."""
    model = tiny_model("MlpPolicy", VectorBox(), update=update, learning_rate=3e-3)
    names = moved(model, lambda: model.learn(60))
    assert names == {"encoder", "encoder_target", "srl", *TASK, *CURIOUS, *STATISTICS}
    model.train(200, batch_size=32)
    observations = model.replay_buffer.sample(200).observations
    with th.no_grad():
        drawn = model.policy.srl.reconstruct(model.policy.encode(observations))
    wanted = model.policy.encoder.vector_target(observations)  # standardised
    # The mean vector would score the variance.
    assert (drawn - wanted).square().mean() < 0.05 * wanted.var()


class Double(NoParameters):
    """A head that computes in double precision."""

    def loss(self, batch: Samples, latents: th.Tensor) -> SRLOutput:
        return SRLOutput(*(part.double() for part in super().loss(batch, latents)))


@pytest.mark.parametrize("target", ["observation", "next_observation"])
def test_error_in_double_precision(target: str) -> None:
    """All that is made of it is in fp32, in training and when policies are compared."""
    model = tiny_model("CnnPolicy", PixelBox(), srl=Double, curiosity_target=target).learn(25)
    assert model.policy.scale.variance.dtype is th.float32 and float(model.policy.scale.variance) > 0
    (episode,) = run_episodes(model, PixelBox(), 1, seed=0)
    assert episode.srl_errors.dtype == np.float32 and (episode.srl_errors > 0).all()


# ------------------------------------------------------------------- logging


#: What the user is promised to find in the logs
METRICS = {
    "train/srl_loss", "train/curious_reward_raw_mean", "train/curious_reward_raw_max", "train/curious_reward_mean",
    "train/curious_reward_max", "rollout/curious_share", "train/ent_coef", "train/curious_ent_coef",
    "train/critic_loss", "train/curious_critic_loss", "train/latent_grad_norm_srl", "train/latent_grad_norm_task",
    "train/latent_grad_norm_curious", "train/latent_variance", "time/environment_steps", "time/total_timesteps",
    "train/encoder_share_srl", "train/encoder_share_task", "train/encoder_share_curious", "train/actor_loss",
    "train/curious_actor_loss", "train/n_updates", "train/learning_rate", "rollout/ep_rew_mean",
}  # fmt: skip


def test_metrics() -> None:
    """All promised metrics are written as finite numbers; environment steps are agent steps x action repeat."""
    model = tiny_model("CnnPolicy", PixelBox(action_repeat=4))
    dumps = log_to(model)
    model.learn(21, log_interval=1)
    assert set(dumps[-1]) >= METRICS
    for key in METRICS:
        assert isinstance(dumps[-1][key], int | float) and np.isfinite(dumps[-1][key]), key
    assert (dumps[-1]["time/total_timesteps"], dumps[-1]["time/environment_steps"]) == (20, 80)
    assert sum(dumps[-1][f"train/encoder_share_{name}"] for name in ("srl", "task", "curious")) == pytest.approx(1)


def test_environment_steps_count_repeats_of_any_wrapper() -> None:
    model = tiny_model("CnnPolicy", gym.wrappers.RepeatAction(PixelBox(action_repeat=4), 5))
    dumps = log_to(model)
    model.learn(8, log_interval=1)
    assert (dumps[-1]["time/total_timesteps"], dumps[-1]["time/environment_steps"]) == (8, 8 * 20)


@pytest.mark.parametrize("srl", SRL_HEADS)
def test_metrics_of_batches_of_one(srl: str) -> None:
    """The smallest batch is legal, and leaves no NaN in the logs."""
    model = tiny_model("CnnPolicy", PixelBox(), srl=srl, batch_size=1)
    dumps = log_to(model)
    model.learn(21, log_interval=1)
    assert [key for key in METRICS if not np.isfinite(dumps[-1][key])] == []


def test_metrics_are_means_since_the_last_dump() -> None:
    """Of equal calls of ``train``, each of which records floats, ``train/srl_loss`` among them."""
    model = tiny_model("CnnPolicy", PixelBox()).learn(10)
    dumps, recorded = log_to(model), []
    update = model._update
    model._update = lambda *arguments: recorded.append(update(*arguments)) or recorded[-1]
    for n_calls in (2, 1):
        for _ in range(n_calls):
            model.train(2, batch_size=8)
            assert type(model.logger.name_to_value["train/srl_loss"]) is float
        model.logger.dump()
    for dump, updates in zip(dumps, (recorded[:4], recorded[4:]), strict=True):
        for name in ("srl_loss", "critic_loss", "actor_loss"):  # the last of every second update
            mean = np.mean([float(metrics[name]) for metrics in updates if name in metrics])
            assert dump[f"train/{name}"] == pytest.approx(mean, rel=1e-5), name


@pytest.mark.parametrize("srl", ["rae", "curl"])
def test_tensorboard(srl: str, tmp_path: Path) -> None:
    """The event file has all metrics (but those that SB3 leaves out) and, from a decoder, reconstructions."""
    model = tiny_model("CnnPolicy", make_vec_env(1), srl=srl, tensorboard_log=str(tmp_path)).learn(21, log_interval=1)
    model.logger.close()
    events = EventAccumulator(str(tmp_path / "CuReSAC_1"))
    events.Reload()
    assert set(events.Tags()["scalars"]) >= METRICS - {"time/total_timesteps", "train/n_updates"}
    assert events.Tags()["images"] == (["srl/reconstructions"] if srl == "rae" else [])
    if srl == "rae":  # eight observations above their reconstructions, after the first update
        (image,) = events.Images("srl/reconstructions")
        assert (image.step, image.width, image.height) == (20, 8 * 36, 2 * 36)
    model.learn(5).learn(5, reset_num_timesteps=False)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["CuReSAC_1", "CuReSAC_2"]
