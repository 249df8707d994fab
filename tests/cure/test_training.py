"""A training run as a user sees it: who acts, what is stored, what is updated when, and what is logged."""

import contextlib
import copy
import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from envs_for_tests import PixelBox, VectorBox, differences, state_of, tiny_model
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback, EvalCallback
from stable_baselines3.common.logger import KVWriter, Logger, configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.torch_layers import NatureCNN
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecFrameStack
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sb3_cure import CuReSAC
from sb3_cure.cure.cure import CuRe
from sb3_cure.cure.metrics import Metrics
from sb3_cure.cure.policies import CnnPolicy, TrunkActor
from sb3_cure.data.buffers import FrameStackReplayBuffer, SkippingReplayBuffer
from sb3_cure.data.samples import Samples
from sb3_cure.evaluation.rollouts import run_episodes
from sb3_cure.srl import SRL_HEADS, SRLHead, SRLOutput

both_updates = pytest.mark.parametrize("update", ["sequential", "joint"])


class RecordingBox(PixelBox):
    """``PixelBox`` that keeps what was done and what was paid."""

    def __init__(self, **kwargs: Any):
        super().__init__(**kwargs)
        self.actions: list[np.ndarray] = []
        self.rewards: list[float] = []

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        observation, reward, *rest = super().step(action)
        self.actions.append(action.copy())
        self.rewards.append(reward)
        return observation, reward, *rest


class Brightness(SRLHead):
    """No parameters; the error of an observation is its mean brightness."""

    def loss(self, batch: Samples, latents: th.Tensor) -> SRLOutput:
        return SRLOutput(latents.square().mean(), brightness(batch.observations))


def brightness(observations: th.Tensor) -> th.Tensor:
    return observations.float().mean(dim=(1, 2, 3))


class Dumps(KVWriter):
    """Keeps what the logger writes."""

    def __init__(self) -> None:
        self.dumps: list[dict[str, Any]] = []

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        self.dumps.append(dict(key_values))

    def close(self) -> None:
        pass


def make_vec_env(n_envs: int, make: Callable[[], gym.Env] = PixelBox, kind: type[VecEnv] = DummyVecEnv) -> VecEnv:
    return kind([lambda: Monitor(make())] * n_envs)


def fix_action(actor: TrunkActor, action: float) -> None:
    """From now on the actor returns (very nearly) this action in every observation, -1 or 1."""
    for layer, bias in ((actor.mu, 10 * action), (actor.log_std, -10.0)):
        th.nn.init.zeros_(layer.weight)
        th.nn.init.constant_(layer.bias, bias)


def moved(model: CuReSAC, step: Callable[[], Any]) -> set[str]:
    """Which networks and temperatures a step changes."""
    before = state_of(model)
    step()
    after = state_of(model)
    names = parts_of(differences(before["policy"], after["policy"]))
    temperatures = ("log_ent_coef", "policy.curious.log_ent_coef")
    return names | {key for key in temperatures if differences(before.get(key), after.get(key))}


def parts_of(names: list[str]) -> set[str]:
    """Parts of the policy that these parameters belong to; of agents their actor, critic or target."""
    parts = [name.split(".")[1:] for name in names]
    return {".".join(part[:2]) if part[0] in ("task", "curious") else part[0] for part in parts}


TASK = {"task.actor", "task.critic", "task.critic_target", "log_ent_coef"}
CURIOUS = {"curious.actor", "curious.critic", "curious.critic_target", "policy.curious.log_ent_coef"}
#: Running statistics of the curious reward
STATISTICS = {"scale"}


# ------------------------------------------------------- how much is updated


@pytest.mark.parametrize("kind, n_envs", [(DummyVecEnv, 1), (DummyVecEnv, 3), (SubprocVecEnv, 1), (SubprocVecEnv, 3)])
def test_one_update_per_agent_step(kind: type[VecEnv], n_envs: int) -> None:
    """For any number of environments: an update per agent step after the warm-up, and one burst at its end."""
    env = make_vec_env(n_envs, kind=kind)
    model = tiny_model("CnnPolicy", env, warmup_updates=7)
    assert model.gradient_steps == -1
    assert type(model.replay_buffer) is FrameStackReplayBuffer and model.replay_buffer.frame_stack == 2
    model.learn(30)
    # The first multiple of n_envs after `learning_starts` is the first step that is learned from.
    warmup = 10 if n_envs == 1 else 9
    assert (model.num_timesteps, model._n_updates) == (30, 7 + 30 - warmup)
    assert model.replay_buffer.size() == 30 // n_envs
    model.learn(12, reset_num_timesteps=False)
    assert (model.num_timesteps, model._n_updates) == (42, 7 + 42 - warmup)
    env.close()


@pytest.mark.parametrize(
    "srl, warmup_updates, burst",
    [("rae", None, 1000), ("curl", None, 0), (Brightness, None, 0), ("rae", 0, 0), ("curl", 5, 5), (None, None, 0)],
)
def test_burst_after_warmup(
    srl: str | type[SRLHead] | None, warmup_updates: int | None, burst: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The head says how many updates follow the warm-up, unless ``warmup_updates`` does; they come once."""
    calls: list[tuple[int, int]] = []

    def train(self: CuReSAC, gradient_steps: int, batch_size: int) -> None:
        calls.append((self.num_timesteps, gradient_steps))

    for cls in (CuReSAC, CuRe):  # the burst is made at once, also where updates overlap
        monkeypatch.setattr(cls, "train", train)
    curiosity = None if srl is None else "separate"
    model = tiny_model("CnnPolicy", PixelBox(), srl=srl, curiosity=curiosity, warmup_updates=warmup_updates)
    model.learn(14)
    model.learn(14)
    # Learning begins with the first step after the warm-up of 10, in either run.
    after_warmup = [(step, 1) for step in (11, 12, 13, 14)]
    assert calls == [(11, burst)] * (burst > 0) + after_warmup + after_warmup
    calls.clear()
    # Without a warm-up the head wants no burst, which would be one on a single transition.
    arguments = dict(srl=srl, curiosity=curiosity, warmup_updates=warmup_updates, learning_starts=0)
    tiny_model("CnnPolicy", PixelBox(), **arguments).learn(2)
    assert calls == [(1, warmup_updates)] * bool(warmup_updates) + [(1, 1), (2, 1)]


@pytest.mark.parametrize("overlap", [False, True])
@pytest.mark.parametrize("ended_by", ["a callback", "an exception"])
def test_no_step_is_made_up_where_training_was_ended(ended_by: str, overlap: bool) -> None:
    """The step in which it ended, the last one of an episode, is not stored; training goes on with a reset."""

    class End(BaseCallback):
        def _on_step(self) -> bool:
            if self.n_calls == 12 and ended_by == "an exception":
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


@pytest.mark.parametrize("extras", [{}, dict(srl=None, curiosity=None)], ids=["on", "off"])
def test_train_counts_its_updates(extras: dict[str, Any]) -> None:
    """``train(n)`` adds exactly n to ``_n_updates``."""
    model = tiny_model("CnnPolicy", PixelBox(), **extras).learn(11)
    model.train(3, batch_size=4)
    assert model._n_updates == 4
    model.train(gradient_steps=1)
    assert model._n_updates == 5


@both_updates
def test_actors_and_targets_keep_to_the_clock_of_updates(update: str) -> None:
    """Actors every 2nd and targets every 3rd update, also when ``train`` makes one update per call."""
    model = tiny_model("CnnPolicy", PixelBox(), update=update, actor_update_interval=2, target_update_interval=3)
    model.learn(10)
    for n_updates in range(7):
        assert model._n_updates == n_updates
        names = moved(model, lambda: model.train(1, batch_size=8))
        expected = {"encoder", "srl", "task.critic", "curious.critic", *STATISTICS}
        if n_updates % 2 == 0:
            expected |= {"task.actor", "curious.actor", "log_ent_coef", "policy.curious.log_ent_coef"}
        if n_updates % 3 == 0:
            expected |= {"encoder_target", "task.critic_target", "curious.critic_target"}
        assert names == expected


@both_updates
@pytest.mark.parametrize("srl", SRL_HEADS)
def test_zero_learning_rate_freezes_everything(srl: str, update: str) -> None:
    """A schedule that is zero moves no parameter, no target and no temperature."""
    model = tiny_model("CnnPolicy", PixelBox(), srl=srl, update=update, learning_rate=lambda _: 0.0)
    names = moved(model, lambda: model.learn(16))
    # CURL's bank of negatives is stored data; targets are standardised by running statistics.
    assert names - STATISTICS == ({"srl"} if srl in ("curl", "spr", "forward") else set())
    before = dict(tiny_model("CnnPolicy", PixelBox(), srl=srl, update=update).policy.named_parameters())
    assert differences(before, dict(model.policy.named_parameters())) == []


@both_updates
def test_alternating_schedule(update: str) -> None:
    """``srl_period`` updates of the head, then as many of the agents, in turn; the encoder learns from both."""
    model = tiny_model(
        "CnnPolicy", PixelBox(), update=update, srl_schedule="alternating", srl_period=3, actor_update_interval=1,
        target_update_interval=100,
    ).learn(10)  # fmt: skip
    model.train(4, batch_size=8)  # among them those that update the targets
    for n_updates in range(4, 16):
        names = moved(model, lambda: model.train(1, batch_size=8))
        if n_updates // 3 % 2 == 0:
            assert names == {"encoder", "srl"}
        else:
            agents = (TASK | CURIOUS) - {"task.critic_target", "curious.critic_target"}
            assert names == {"encoder", *agents, *STATISTICS}


def test_periods_may_be_numbers_of_numpy() -> None:
    """As from ``numpy.arange``; what they are compared to decides whether gradients are wanted."""
    given = dict(srl_schedule="alternating", actor_update_interval=np.int64(2), target_update_interval=np.int64(2))
    models = [tiny_model("MlpPolicy", VectorBox(), srl_period=kind(3), **given).learn(25) for kind in (int, np.int64)]
    assert differences(*map(state_of, models)) == []


# ------------------------------------------------------------------ who acts


def acting_model(env: gym.Env | VecEnv, **kwargs: Any) -> CuReSAC:
    """Collects without updates; the task actor does -1, the curious one +1, so that the buffer tells who acted."""
    model = tiny_model("CnnPolicy", env, gradient_steps=0, **kwargs)
    fix_action(model.policy.actor, -1)
    if model.policy.curious is not None:
        fix_action(model.policy.curious.actor, 1)
    return model


def stored_actions(model: CuReSAC) -> np.ndarray:
    return model.replay_buffer.actions[: model.replay_buffer.pos]


def test_probability_0_never_asks_the_curious_actor() -> None:
    """p_c = 0: the task actor acts; the curious critic still learns, and with it the encoder."""
    model = tiny_model("CnnPolicy", PixelBox(), curiosity_prob=0.0)

    def forbidden(*_: Any) -> None:
        raise AssertionError("the curious actor was asked")

    # `forward` is how actors act; updates call `action_log_prob`.
    model.policy.curious.actor.forward = forbidden
    fix_action(model.policy.actor, -1)
    names = moved(model, lambda: model.learn(14))
    assert names >= {"curious.actor", "curious.critic", "policy.curious.log_ent_coef"}
    with pytest.raises(AssertionError, match="was asked"):
        model.predict_curious(model.observation_space.sample())


def test_probability_1_always_asks_the_curious_actor_after_warmup() -> None:
    """p_c = 1: uniform actions in the warm-up, the curious actor's ever after; the share is logged."""
    model = acting_model(PixelBox(), curiosity_prob=1.0, learning_starts=15)
    dumps = log_to(model)
    model.learn(40, log_interval=1)
    warmup, after = stored_actions(model)[:15], stored_actions(model)[15:]
    assert (np.abs(warmup) < 0.999).all() and warmup.std() > 0.3
    np.testing.assert_allclose(after, 1, atol=1e-3)
    assert [dump["rollout/curious_share"] for dump in dumps] == [1.0, 1.0]


def test_mixing_per_environment_and_step() -> None:
    """p_c = 0.3: environments draw independently; the frequency is binomial; its mean between dumps is logged."""
    model = acting_model(make_vec_env(3), curiosity_prob=0.3, learning_starts=0, buffer_size=1200)
    dumps = log_to(model)
    model.learn(900, log_interval=3)
    curious = (stored_actions(model)[:, :, 0] > 0)[:300]
    np.testing.assert_allclose(np.abs(stored_actions(model)), 1, atol=1e-3)
    # Five standard deviations of a binomial
    assert abs(curious.sum() - 270) < 5 * np.sqrt(900 * 0.3 * 0.7)
    assert (np.abs(curious.sum(axis=0) - 90) < 5 * np.sqrt(300 * 0.3 * 0.7)).all()
    # How many of three act curiously in one step: 0.343, 0.441, 0.189, 0.027 of the time
    counts = np.bincount(curious.sum(axis=1), minlength=4) / 300
    np.testing.assert_allclose(counts, [0.343, 0.441, 0.189, 0.027], atol=5 * np.sqrt(0.25 / 300))
    # Three episodes of 20 steps end together, and each writes its own dump when it ends.
    shares = [dump["rollout/curious_share"] for dump in dumps]
    np.testing.assert_allclose(shares, curious.reshape(15, 60).mean(axis=1))


def test_schedules_never_see_progress_below_zero() -> None:
    """SB3's own goes there when the last rollout goes beyond the total."""
    seen: list[float] = []

    def schedule(remaining: float) -> float:
        seen.append(remaining)
        return 0.01 * remaining

    model = acting_model(PixelBox(), curiosity_prob=schedule, learning_rate=schedule, train_freq=7, learning_starts=10)
    model.learn(30)
    assert model.num_timesteps == 35 and model._current_progress_remaining < 0
    assert min(seen) == 0


def test_schedules_begin_where_the_call_begins() -> None:
    """Also in a further call: SB3's progress is still that of the end of the one before at its first step."""
    seen: list[float] = []

    def schedule(remaining: float) -> float:
        seen.append(remaining)
        return 0.5

    model = acting_model(PixelBox(), curiosity_prob=schedule, learning_starts=0)
    model.learn(2)
    seen.clear()
    model.learn(4)
    assert seen == [1, 0.75, 0.5, 0.25]
    seen.clear()
    model.learn(4, reset_num_timesteps=False)
    assert seen == [0.5, 0.375, 0.25, 0.125]
    model.learn(0)


def test_scheduled_probability() -> None:
    """p_c may be a schedule of the remaining progress."""
    model = acting_model(PixelBox(), curiosity_prob=lambda progress: float(progress > 0.5), learning_starts=10)
    model.learn(40)
    np.testing.assert_allclose(stored_actions(model)[10:20], 1, atol=1e-3)
    np.testing.assert_allclose(stored_actions(model)[22:], -1, atol=1e-3)


def test_random_second_actor_is_uniform() -> None:
    """``curiosity="random"``: uniform within the bounds of the actions, and nothing is trained for it."""
    env = RecordingBox(low=-1.0, high=3.0)
    model = acting_model(env, curiosity="random", curiosity_prob=1.0)
    assert model.policy.curious is None
    model.learn(500)
    actions = np.array(env.actions[10:]).ravel()
    counts, _ = np.histogram(actions, bins=8, range=(-1, 3))
    assert counts.sum() == 980
    np.testing.assert_allclose(counts, 980 / 8, atol=5 * np.sqrt(980 / 8 * 7 / 8))
    with pytest.raises(ValueError, match="curious policy"):
        model.predict_curious(model.observation_space.sample())


def test_random_second_actor_mixes() -> None:
    """p_c counts for the random actor, too."""
    model = acting_model(PixelBox(), curiosity="random", curiosity_prob=0.5)
    model.learn(110)
    random = np.abs(stored_actions(model)[10:]).min(axis=(1, 2)) < 0.999
    assert 25 <= random.sum() <= 75


def test_bonus_has_one_actor() -> None:
    """``curiosity="bonus"``: there is no second actor, whatever p_c is."""
    model = acting_model(PixelBox(), curiosity="bonus", curiosity_prob=1.0)
    assert model.policy.curious is None
    model.learn(20)
    np.testing.assert_allclose(stored_actions(model)[10:], -1, atol=1e-3)


@pytest.mark.parametrize("noise", [False, True])
def test_stored_actions_are_the_executed_ones(noise: bool) -> None:
    """Whoever acts, in asymmetric bounds and with noise: what the buffer holds, rescaled, is what was executed."""
    envs = [RecordingBox(low=-1.0, high=3.0) for _ in range(2)]
    action_noise = NormalActionNoise(np.zeros(2), np.full(2, 0.5)) if noise else None
    model = tiny_model(
        "CnnPolicy", DummyVecEnv([lambda env=env: env for env in envs]), curiosity_prob=0.5, action_noise=action_noise
    )
    model.learn(60)
    executed = np.stack([env.actions for env in envs], axis=1)
    np.testing.assert_allclose(stored_actions(model) * 2 + 1, executed, atol=1e-6)
    assert executed.min() >= -1 and executed.max() <= 3
    # Noise of half the range reaches the bounds in all phases; without it nothing does.
    assert (np.abs(stored_actions(model)[6:]) == 1).any() == noise


# ------------------------------------------------------------ what is stored


@pytest.mark.parametrize("curiosity", ["separate", "bonus", "random", None])
def test_buffer_keeps_the_environments_rewards(curiosity: str | None) -> None:
    """The curious reward is computed per batch and never stored."""
    env = RecordingBox()
    model = tiny_model("CnnPolicy", env, curiosity=curiosity, curiosity_beta=100.0).learn(30)
    assert len(env.rewards) == 30
    np.testing.assert_array_equal(model.replay_buffer.rewards[:30, 0], np.float32(env.rewards))


@pytest.mark.parametrize("curiosity", ["separate", "bonus"])
@pytest.mark.parametrize("target", ["observation", "next_observation"])
def test_curious_reward_is_about_the_target(curiosity: str, target: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The rewarded error is that of the observation, or of the next one if ``curiosity_target`` says so."""
    model = tiny_model("CnnPolicy", PixelBox(), srl=Brightness, curiosity=curiosity, curiosity_target=target).learn(30)
    batch = model.replay_buffer.sample(8)
    monkeypatch.setattr(model.replay_buffer, "sample", lambda *args, **kwargs: batch)
    assert not th.allclose(brightness(batch.observations), brightness(batch.next_observations))
    dumps = log_to(model)
    model.train(1, batch_size=8)
    model.logger.dump()
    expected = brightness(batch.observations if target == "observation" else batch.next_observations)
    assert dumps[0]["train/curious_reward_raw_mean"] == pytest.approx(expected.mean().item(), rel=1e-6)
    assert dumps[0]["train/curious_reward_raw_max"] == pytest.approx(expected.max().item(), rel=1e-6)


@both_updates
@pytest.mark.parametrize("curiosity", ["separate", "bonus"])
def test_rewards_of_the_critics(curiosity: str, update: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The task critic learns the stored reward, plus beta x error if it is a bonus; the curious one beta x error."""
    model = tiny_model(
        "CnnPolicy", PixelBox(), srl=Brightness, curiosity=curiosity, update=update, curiosity_beta=0.1, gamma=0.0,
        normalize_curiosity=False, curiosity_gamma=0.0, curiosity_target="next_observation", learning_rate=0.0,
    ).learn(30)  # fmt: skip
    batch = model.replay_buffer.sample(8)
    monkeypatch.setattr(model.replay_buffer, "sample", lambda *args, **kwargs: batch)
    dumps = log_to(model)
    model.train(1, batch_size=8)
    model.logger.dump()

    curious_reward = 0.1 * brightness(batch.next_observations)[:, None]
    cases = [("train/critic_loss", model.critic, batch.rewards + (curious_reward if curiosity == "bonus" else 0))]
    if curiosity == "separate":
        cases.append(("train/curious_critic_loss", model.policy.curious.critic, curious_reward))
    for key, critic, target in cases:
        with th.no_grad():
            values = critic(model.policy.encode(batch.observations), batch.actions)
            errors = [q - target for q in values.unbind(dim=1)]
        # With discounts of zero the rewards are the targets.
        assert dumps[0][key] == pytest.approx(sum(0.5 * error.square().mean().item() for error in errors), rel=1e-4)


def test_frame_stack_attribute_decides_on_the_buffer() -> None:
    """The frame-sharing buffer is the default for images; one that tells no ``frame_stack`` is one frame."""
    for tells, frame_stack in ((True, 2), (False, 1)):
        buffer = tiny_model("CnnPolicy", PixelBox(tells_frame_stack=tells)).replay_buffer
        assert type(buffer) is FrameStackReplayBuffer and buffer.frame_stack == frame_stack
    assert type(tiny_model("CnnPolicy", PixelBox(), replay_buffer_class=ReplayBuffer).replay_buffer) is ReplayBuffer
    assert type(tiny_model("MlpPolicy", VectorBox()).replay_buffer) is SkippingReplayBuffer


@pytest.mark.parametrize("channels_last", [False, True])
def test_frame_stack_buffer_changes_nothing_but_memory(channels_last: bool) -> None:
    """A run with it ends with the bits of a run with SB3's buffer, over resets and in several environments."""
    states = []
    for buffer_class in (None, ReplayBuffer):
        env = make_vec_env(2, lambda: PixelBox(channels_last=channels_last, episode_length=9))
        model = tiny_model("CnnPolicy", env, replay_buffer_class=buffer_class, buffer_size=40).learn(60)
        assert (type(model.replay_buffer) is FrameStackReplayBuffer) == (buffer_class is None)
        states.append(state_of(model))
    assert differences(*states) == []


def test_buffer_smaller_than_batch_and_warmup() -> None:
    """``buffer_size`` below ``batch_size`` or ``learning_starts`` is legal."""
    model = tiny_model("CnnPolicy", PixelBox(), buffer_size=6, batch_size=16, learning_starts=12).learn(15)
    assert (model._n_updates, model.replay_buffer.size()) == (3, 6)


# ----------------------------------------------------------- parts of the method


@both_updates
@pytest.mark.parametrize("collector", ["curious", "random"])
@pytest.mark.parametrize("curiosity", ["separate", None])
def test_pretraining(curiosity: str | None, collector: str, update: str) -> None:
    """Representation pretraining trains encoder and head (and the curious agent that collects), no task networks.

    It leaves an empty buffer and zero counts; what follows is an ordinary run, curious only if curiosity is on.
    """
    model = tiny_model("CnnPolicy", PixelBox(), curiosity=curiosity, update=update)
    fresh = state_of(model)
    actions: list[np.ndarray] = []

    def watch(locals_: dict[str, Any], _: Any) -> bool:
        actions.append(locals_["buffer_actions"])
        if len(actions) == 1 and collector == "curious":
            fix_action(model.policy.curious.actor, 1)
            model.policy.curious.actor.optimizer.step = lambda: None  # it keeps its action
        return True

    model.pretrain(30, collector, callback=watch)
    after = state_of(model)
    names = parts_of(differences(fresh["policy"], after["policy"]))
    assert {"encoder", "encoder_target", "srl"} <= names
    assert not names & TASK
    assert (names >= STATISTICS) == (collector == "curious")
    for key in ("actor.optimizer", "critic.optimizer", "ent_coef_optimizer", "log_ent_coef"):
        assert differences(fresh[key], after[key]) == [], key
    assert fresh.keys() == after.keys()
    assert ({"curious.actor", "curious.critic"} <= names) == (curiosity == "separate" and collector == "curious")
    if collector == "curious":
        np.testing.assert_allclose(actions[10:], 1, atol=1e-3)
    else:
        assert np.abs(actions[10:]).max() < 0.9999 and np.std(actions[10:]) > 0.3
    # The head's optimiser, for one, is kept.
    assert after["policy.srl.optimizer"]["state"][0]["step"] == 20
    assert (model.num_timesteps, model._n_updates, model.replay_buffer.size()) == (0, 0, 0)

    fix_action(model.policy.actor, -1)
    asked: list[int] = []
    if curiosity is None:
        assert model.policy.curious is None
        assert not any("curious" in key for key in [*model.get_parameters(), *model.policy.state_dict()])
        with pytest.raises(ValueError, match="curious policy"):
            model.predict_curious(model.observation_space.sample())
    else:
        model.policy.curious.actor.register_forward_hook(lambda *_: asked.append(1))
    dumps = log_to(model)
    model.learn(30)
    model.logger.dump()
    assert (model.num_timesteps, model._n_updates, model.replay_buffer.size()) == (30, 20, 30)
    assert (
        ("train/curious_critic_loss" in dumps[-1]) == ("train/latent_grad_norm_curious" in dumps[-1]) == bool(curiosity)
    )
    assert (0 < len(asked) < 20) == (curiosity == "separate")
    # Random warm-up again
    assert np.abs(stored_actions(model)[:10]).max() < 0.9999


def test_only_training_begins_as_without_pretraining() -> None:
    """Two calls of `pretrain` do not collect the same steps; the `learn` after them has a new model's warm-up."""
    collected: list[np.ndarray] = []

    class Keep(BaseCallback):
        def _on_step(self) -> bool:
            return True

        def _on_training_end(self) -> None:
            buffer = self.model.replay_buffer
            collected.append(buffer.actions[: buffer.size()].copy())

    for pretrains in (2, 0):
        model = tiny_model("CnnPolicy", PixelBox(), learning_starts=30, seed=0)
        for _ in range(pretrains):
            model.pretrain(30, "random", callback=Keep())
        model.learn(30, callback=Keep())
    first, second, pretrained, vanilla = collected
    assert (first != second).any()
    np.testing.assert_array_equal(pretrained, vanilla)


def test_pretraining_with_fixed_temperature_bonus_and_burst() -> None:
    """Pretraining also works where the agent has a fixed temperature or a bonus; each run has its burst."""
    model = tiny_model("CnnPolicy", PixelBox(), curiosity="bonus", ent_coef=0.1, warmup_updates=5)
    model.pretrain(14)
    assert state_of(model)["policy.srl.optimizer"]["state"][0]["step"] == 5 + 4
    model.learn(14)
    assert model._n_updates == 5 + 4
    assert state_of(model)["policy.srl.optimizer"]["state"][0]["step"] == 2 * (5 + 4)


def test_a_bonus_is_scaled_anew_after_pretraining() -> None:
    """By its size and not by the spread of the pretraining's reward, of which it would be many, and clipped to one."""
    model = tiny_model("MlpPolicy", VectorBox(), curiosity="bonus").pretrain(30)
    assert float(model.policy.scale.weight) == 0
    model.learn(11)
    assert float(model.logger.name_to_value["train/curious_reward_mean"]) < 2


@pytest.mark.parametrize(
    "settings",
    [
        dict(update="joint"),
        dict(update="sequential"),
        dict(srl=None, intrinsic="rnd", task=False, curiosity_encoder_grad=False),
    ],
)
def test_a_copy_learns_as_its_original(settings: dict[str, Any]) -> None:
    model = tiny_model("MlpPolicy", VectorBox(), **settings).learn(15)
    twin = copy.deepcopy(model)
    for each in (model, twin):
        np.random.seed(0)
        th.manual_seed(0)
        each.train(2, batch_size=8)
    assert differences(state_of(model), state_of(twin)) == []


def test_pretraining_needs_a_head_and_a_known_collector() -> None:
    """One sentence each."""
    with pytest.raises(ValueError, match="srl is None"):
        tiny_model("CnnPolicy", PixelBox(), srl=None, curiosity=None).pretrain(10)
    with pytest.raises(ValueError, match="'nobody'"):
        tiny_model("CnnPolicy", PixelBox()).pretrain(10, collector="nobody")


@both_updates
def test_agent_without_task(update: str) -> None:
    """``task=False``: the curious actor always acts, also in ``predict``; the task networks stay as they were made."""
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
    model = acting_model(PixelBox(), task=False, curiosity_prob=0.0)
    model.learn(20)
    np.testing.assert_allclose(stored_actions(model)[10:], 1, atol=1e-3)


@pytest.mark.parametrize("srl", ["rae", "curl"])
def test_any_features_extractor_is_the_shared_encoder(srl: str) -> None:
    """SB3's NatureCNN as encoder: shared by all, trained by all, decoded by the autoencoder."""
    policy_kwargs = dict(features_extractor_class=NatureCNN, features_extractor_kwargs=dict(features_dim=8))
    model = tiny_model("CnnPolicy", PixelBox(), srl=srl, policy_kwargs=policy_kwargs)
    assert type(model.policy.encoder.trunk.extractor) is NatureCNN
    names = moved(model, lambda: model.learn(14))
    assert names >= {"encoder", "encoder_target", "srl", *TASK, *CURIOUS}
    assert model.policy.encode(th.zeros(3, 6, 36, 36, dtype=th.uint8)).shape == (3, 8)


def test_shared_encoder_without_srl() -> None:
    """``share_encoder=True`` with ``srl=None``: this package's policy and update, without head or curious agent."""
    model = tiny_model("CnnPolicy", PixelBox(), srl=None, curiosity=None, policy_kwargs=dict(share_encoder=True))
    assert type(model.policy) is CnnPolicy
    dumps = log_to(model)
    names = moved(model, lambda: model.learn(14))
    model.logger.dump()
    assert names == {"encoder", "encoder_target", *TASK}
    assert "train/latent_grad_norm_task" in dumps[-1] and "train/srl_loss" not in dumps[-1]


@both_updates
def test_vectors(update: str) -> None:
    """``CuReSAC("MlpPolicy", ...)`` learns from vectors with a vector autoencoder and a curious agent."""
    model = tiny_model("MlpPolicy", VectorBox(), update=update, learning_rate=3e-3)
    names = moved(model, lambda: model.learn(14))
    assert names == {"encoder", "encoder_target", "srl", *TASK, *CURIOUS, *STATISTICS}
    observations = th.as_tensor(np.random.default_rng(0).uniform(-1, 1, (200, 2)).astype(np.float32))

    def error() -> float:
        with th.no_grad():
            drawn = model.policy.srl.reconstruct(model.policy.encode(observations))
        return (drawn - observations).square().mean().item()

    model.learn(60)
    model.train(200, batch_size=32)
    # The mean vector would score the variance.
    assert error() < 0.2 * observations.var().item()


# ------------------------------------------------------------------- logging


def log_to(model: CuReSAC) -> list[dict[str, Any]]:
    """Everything that the model's logger writes from now on, one dictionary per dump."""
    dumps = Dumps()
    model.set_logger(Logger(None, [dumps]))
    return dumps.dumps


#: What the user is promised to find in the logs
METRICS = {
    "train/srl_loss", "train/curious_reward_raw_mean", "train/curious_reward_raw_max", "train/curious_reward_mean",
    "train/curious_reward_max", "rollout/curious_share", "train/ent_coef", "train/curious_ent_coef",
    "train/critic_loss", "train/curious_critic_loss", "train/latent_grad_norm_srl", "train/latent_grad_norm_task",
    "train/latent_grad_norm_curious", "train/latent_variance", "time/environment_steps", "time/total_timesteps",
    "train/encoder_share_srl", "train/encoder_share_task", "train/encoder_share_curious", "train/actor_loss",
    "train/curious_actor_loss", "train/n_updates", "train/learning_rate", "rollout/ep_rew_mean",
}  # fmt: skip


@both_updates
def test_metrics(update: str) -> None:
    """All promised metrics are written, as plain finite numbers; environment steps are agent steps x action repeat."""
    model = tiny_model("CnnPolicy", PixelBox(action_repeat=4), update=update)
    dumps = log_to(model)
    model.learn(41, log_interval=1)
    last = dumps[-1]
    assert set(last) >= METRICS
    for key in METRICS:
        assert isinstance(last[key], int | float), key
        assert np.isfinite(last[key]), key
    assert (last["time/total_timesteps"], last["time/environment_steps"]) == (40, 160)
    assert last["train/curious_reward_max"] <= 5 and last["train/curious_reward_raw_max"] > 0
    assert sum(last[f"train/encoder_share_{source}"] for source in ("srl", "task", "curious")) == pytest.approx(1)


@pytest.mark.parametrize("srl", SRL_HEADS)
def test_metrics_of_batches_of_one(srl: str) -> None:
    """The smallest batch is legal, and leaves no NaN in the logs."""
    model = tiny_model("CnnPolicy", PixelBox(), srl=srl, batch_size=1)
    dumps = log_to(model)
    model.learn(41, log_interval=1)
    assert [key for key in METRICS if not np.isfinite(dumps[-1][key])] == []


def test_metrics_are_means_between_dumps(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is written is the mean over the updates since the last writing, also when a callback does the writing."""
    recorded: dict[str, list[float]] = {}
    record = Metrics.record

    def spy(self: Metrics, values: dict[str, th.Tensor], agent: str = "task") -> None:
        for key, value in values.items():
            prefix = "train/" if agent == "task" else f"train/{agent}_"
            recorded.setdefault(prefix + key, []).append(float(value.detach()))
        record(self, values, agent)

    monkeypatch.setattr(Metrics, "record", spy)
    means: list[dict[str, float]] = []

    class Checker(Dumps):
        def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
            super().write(key_values, key_excluded, step)
            means.append({key: float(np.mean(values)) for key, values in recorded.items()})
            recorded.clear()

    model = tiny_model("CnnPolicy", PixelBox())
    checker = Checker()
    model.set_logger(Logger(None, [checker]))
    # Dumps at episodes' ends (20, 40) and evaluations (15, 30), both
    evaluation = EvalCallback(Monitor(PixelBox()), eval_freq=15, n_eval_episodes=1, verbose=0)
    model.learn(41, callback=evaluation, log_interval=1)
    assert ["eval/mean_reward" in dump for dump in checker.dumps] == [True, False, True, False]
    for dump, mean in zip(checker.dumps, means, strict=True):
        assert {"train/srl_loss", "train/critic_loss", "train/curious_critic_loss"} <= mean.keys()
        for key, value in mean.items():
            assert type(dump[key]) is float
            assert dump[key] == pytest.approx(value, rel=1e-5), key


def test_metrics_of_models_that_share_a_logger() -> None:
    """A model that goes on with the logger of another writes its own averages, without what the other has left."""
    dumps = Dumps()
    logger = Logger(None, [dumps])
    for seed in (0, 1):
        model = tiny_model("MlpPolicy", VectorBox(), seed=seed)
        model.set_logger(logger)
        recorded = []
        record = model._metrics.record
        model._metrics.record = lambda values, *rest, all=recorded, record=record: (
            all.append(values),
            record(values, *rest),
        )
        model.learn(35, log_interval=1)  # the last 15 updates are not written
    losses = [float(values["srl_loss"].detach()) for values in recorded if "srl_loss" in values]
    assert len(dumps.dumps) == 2
    assert dumps.dumps[1]["train/srl_loss"] == pytest.approx(np.mean(losses[:9]), rel=1e-5)


def test_srl_loss_is_recorded_by_every_call_of_train() -> None:
    """Between dumps the logger holds a detached tensor; reading its value is left to the dump."""
    model = tiny_model("CnnPolicy", PixelBox()).learn(10)
    for _ in range(2):
        model.train(1, batch_size=8)
        loss = model.logger.name_to_value["train/srl_loss"]
        assert isinstance(loss, th.Tensor) and not loss.requires_grad and loss.shape == ()
        model.logger.name_to_value.clear()


@pytest.mark.parametrize("srl", ["rae", "curl"])
def test_tensorboard(srl: str, tmp_path: Path) -> None:
    """The event file has all metrics (bar those that SB3 leaves out) and, from a decoder, reconstructions."""
    model = tiny_model("CnnPolicy", make_vec_env(1), srl=srl, tensorboard_log=str(tmp_path)).learn(41, log_interval=1)
    model.logger.close()
    assert [path.name for path in tmp_path.iterdir()] == ["CuReSAC_1"]
    events = EventAccumulator(str(tmp_path / "CuReSAC_1"))
    events.Reload()
    tags = events.Tags()
    assert set(tags["scalars"]) >= METRICS - {"time/total_timesteps", "train/n_updates"}
    assert [(event.step, event.value) for event in events.Scalars("time/environment_steps")] == [(20, 80), (40, 160)]
    assert tags["histograms"] == []
    assert tags["images"] == (["srl/reconstructions"] if srl == "rae" else [])
    if srl == "rae":
        # Eight observations above their reconstructions, after the first update
        images = events.Images("srl/reconstructions")
        assert [(image.step, image.width, image.height) for image in images] == [(20, 8 * 36, 2 * 36)]
    model.tensorboard_log = str(tmp_path)
    model.learn(5)
    model.learn(5, reset_num_timesteps=False)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["CuReSAC_1", "CuReSAC_2"]


def test_csv(tmp_path: Path) -> None:
    """The CSV file has a header with all metrics and numbers below it."""
    model = tiny_model("CnnPolicy", PixelBox())
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(61, log_interval=1)
    model.logger.close()
    with open(tmp_path / "progress.csv") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 3 and set(rows[0]) >= METRICS
    for row in rows:
        for key in METRICS:
            assert np.isfinite(float(row[key])), key
    assert [float(row["time/environment_steps"]) for row in rows] == [80, 160, 240]


def test_training_offline_with_images(tmp_path: Path) -> None:
    """``train`` on a given buffer, without ``learn``, logs like any other."""
    collector = tiny_model("CnnPolicy", PixelBox(), gradient_steps=0).learn(30)
    collector.save_replay_buffer(tmp_path / "buffer")
    model = tiny_model("CnnPolicy", PixelBox())
    model.set_logger(configure(str(tmp_path / "log"), ["tensorboard"]))
    model.load_replay_buffer(tmp_path / "buffer")
    model.train(3, batch_size=8)
    model.logger.dump()
    model.logger.close()
    events = EventAccumulator(str(tmp_path / "log"))
    events.Reload()
    assert events.Tags()["images"] == ["srl/reconstructions"]
    assert np.isfinite(events.Scalars("train/srl_loss")[0].value)


def test_callbacks_and_progress_bar(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """EvalCallback, CheckpointCallback and the progress bar together; the best model is a CuReSAC that loads."""
    model = tiny_model("CnnPolicy", PixelBox(), verbose=1)
    evaluation = EvalCallback(
        Monitor(PixelBox()), eval_freq=20, n_eval_episodes=2, best_model_save_path=str(tmp_path),
        log_path=str(tmp_path), verbose=0,
    )  # fmt: skip
    checkpoints = CheckpointCallback(25, str(tmp_path), name_prefix="at", save_replay_buffer=True)
    model.learn(50, callback=[evaluation, checkpoints], log_interval=1, progress_bar=True)
    assert {path.name for path in tmp_path.iterdir()} == {
        "best_model.zip", "evaluations.npz", "at_25_steps.zip", "at_50_steps.zip",
        "at_replay_buffer_25_steps.pkl", "at_replay_buffer_50_steps.pkl",
    }  # fmt: skip
    results = np.load(tmp_path / "evaluations.npz")
    assert results["timesteps"].tolist() == [20, 40] and results["results"].shape == (2, 2)
    best = CuReSAC.load(tmp_path / "best_model")
    assert best.num_timesteps == [20, 40][int(results["results"].mean(axis=1).argmax())]
    printed = capsys.readouterr().out
    assert "tensor(" not in printed
    for name in ("srl_loss", "curious_critic_loss", "environment_steps", "curious_share"):
        assert name in printed


def test_evaluating_both_policies() -> None:
    """Separate rollouts of the two policies differ as the policies do."""
    model = acting_model(PixelBox())
    env = make_vec_env(1)
    ends = []
    for predict in (model.predict, model.predict_curious):
        env.seed(0)
        observation = env.reset()
        for _ in range(19):
            observation, *_ = env.step(predict(observation, deterministic=True)[0])
        ends.append(env.get_attr("position")[0].tolist())
    assert ends == [[-1, -1], [1, 1]]


def test_the_users_policy_kwargs_stay_as_they_were() -> None:
    """One dictionary of settings can serve several models and be written down afterwards."""
    policy_kwargs = {"net_arch": [8], "share_encoder": True}
    for extras in ({"srl": "rae"}, {"srl": None, "curiosity": None}):
        before = dict(policy_kwargs)
        CuReSAC("MlpPolicy", VectorBox(), policy_kwargs=policy_kwargs, buffer_size=10, device="cpu", **extras)
        assert policy_kwargs == before
        policy_kwargs.pop("share_encoder", None)


class Divergence(SRLHead):
    """Of a Gaussian from the standard one; computed in the number format that autocast chooses."""

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.parameters_of = th.nn.Linear(self.encoder.features_dim, 8)

    def loss(self, batch: Samples, latents: th.Tensor) -> SRLOutput:
        mean, log_var = self.parameters_of(latents).chunk(2, dim=1)
        error = 0.5 * (mean.square() + log_var.exp() - log_var - 1).mean(dim=1)
        return SRLOutput(error.mean(), error.detach())


class Double(Divergence):
    """The same in double precision."""

    def loss(self, batch: Samples, latents: th.Tensor) -> SRLOutput:
        return SRLOutput(*(part.double() for part in super().loss(batch, latents)))


@pytest.mark.parametrize("target", ["observation", "next_observation"])
@pytest.mark.parametrize(("head", "precision"), [(Divergence, "bf16"), (Double, "fp32")])
def test_a_heads_error_may_have_any_number_format(head: type[SRLHead], precision: str, target: str) -> None:
    """All that is made of it is in full precision, in training and when policies are compared."""
    arguments: dict[str, Any] = dict(srl=head, precision=precision, curiosity_target=target)
    model = tiny_model("CnnPolicy", PixelBox(), **arguments).learn(25)
    assert model.policy.scale.variance.dtype is th.float32 and float(model.policy.scale.variance) > 0
    (episode,) = run_episodes(model, PixelBox(), 1, seed=0)
    assert episode.srl_errors.dtype == np.float32 and (episode.srl_errors > 0).all()


def test_settings_can_be_changed_while_training() -> None:
    """As in SB3: what is set at the model holds from the next step on."""
    changes: dict[str, Any] = dict(gamma=0.0, curiosity_gamma=0.0, curiosity_beta=100.0, normalize_curiosity=False)

    def parameters(**change: Any) -> dict[str, Any]:
        model = tiny_model("MlpPolicy", VectorBox(), curiosity_prob=0.5).learn(15)
        vars(model).update(change)
        return model.learn(15, reset_num_timesteps=False).get_parameters()

    usual = parameters()
    assert differences(usual, parameters()) == []
    for name, value in changes.items():
        assert differences(usual, parameters(**{name: value})) != [], name


def test_exploration_can_be_ended_and_fine_tuning_begun() -> None:
    """By p_c, between two calls of ``learn``."""
    model = tiny_model("MlpPolicy", VectorBox(), curiosity_prob=1.0).learn(30, log_interval=10**9)
    assert model._mixer.pop_metrics()["rollout/curious_share"] == 1
    model.curiosity_prob = 0.0
    model.learn(30, log_interval=10**9, reset_num_timesteps=False)
    assert model._mixer.n_steps > 0 and model._mixer.pop_metrics()["rollout/curious_share"] == 0


def test_a_call_that_resets_environments_redraws_who_acts() -> None:
    """By its argument or as the environment is a new one; else who acts for an episode goes on."""
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


@pytest.mark.parametrize(("own", "around", "last"), [(1, 3, False), (3, 2, False), (2, 3, True)])
def test_stacks_of_vec_frame_stack_are_stored_once(own: int, around: int, last: bool) -> None:
    """Each of its frames (which may be stacks of the environment's) is kept once, and nothing is evicted early."""
    make = lambda: PixelBox(frame_stack=own, channels_last=last)  # noqa: E731
    env = VecFrameStack(DummyVecEnv([make]), around)
    model = tiny_model("CnnPolicy", env, buffer_size=100, learning_starts=1000).learn(150)
    buffer = model.replay_buffer
    assert isinstance(buffer, FrameStackReplayBuffer) and buffer.frame_stack == around
    # Of an episode of 20 steps all frames are new, but for the stack that it begins with.
    assert buffer.frames.shape[-3:] == (3 * own, 36, 36) and buffer.size() >= 85
    assert buffer.sample(64).observations.shape[1] == 3 * own * around
