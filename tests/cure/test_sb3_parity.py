"""With the extras off CuReSAC is SB3's SAC bit for bit; what SB3's users rely on holds with the extras on, too."""

import io
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from envs_for_tests import PixelBox, VectorBox, differences, state_of, tiny_model
from gymnasium import spaces
from sb3_contrib import TQC
from stable_baselines3 import SAC, HerReplayBuffer
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.callbacks import (
    CallbackList,
    EvalCallback,
    EveryNTimesteps,
    StopTrainingOnMaxEpisodes,
    StopTrainingOnNoModelImprovement,
    StopTrainingOnRewardThreshold,
)
from stable_baselines3.common.envs import BitFlippingEnv, SimpleMultiObsEnv
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise, VectorizedActionNoise
from stable_baselines3.common.preprocessing import preprocess_obs
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, NatureCNN
from stable_baselines3.common.type_aliases import TrainFreq
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from stable_baselines3.sac import policies as sb3_policies
from torch import nn

from sb3_cure import CuReSAC, CuReTQC

OFF: dict[str, Any] = dict(srl=None, curiosity=None)
ON: dict[str, Any] = dict(srl="rae", curiosity="separate")
both_modes = pytest.mark.parametrize("extras", [OFF, ON], ids=["off", "on"])


def vec_env(n_envs: int, make: Callable[[], gym.Env] = VectorBox) -> DummyVecEnv:
    return DummyVecEnv([lambda: Monitor(make())] * n_envs)


def pair(
    policy: str,
    make_env: Callable[[], Any],
    total_timesteps: int,
    ours: dict[str, Any] | None = None,
    classes: tuple[type, type] = (SAC, CuReSAC),
    **kwargs: Any,
):
    """A base class (SB3's SAC) and ours with equal settings, after learning on environments of their own.

    Two constructor defaults differ (the paper's, not SB3's), so the settings that have such defaults are all given.
    """
    settings: dict[str, Any] = dict(
        learning_rate=1e-3, buffer_size=1000, learning_starts=20, batch_size=16, tau=0.01, gamma=0.98, train_freq=1,
        gradient_steps=1, ent_coef="auto_0.1", target_update_interval=1, seed=3, device="cpu",
    )  # fmt: skip
    settings.update(kwargs)
    models = []
    for cls, extra in zip(classes, ({}, {**OFF, **(ours or {})}), strict=True):
        action_noise = settings.get("action_noise")
        noise = {} if action_noise is None else {"action_noise": action_noise()}
        model = cls(policy, make_env(), **{**settings, **noise, **extra})
        models.append(model.learn(total_timesteps))
    return models


def assert_same_run(sb3: SAC, ours: CuReSAC, n_updates: int) -> None:
    """Same networks, optimisers, temperature and stored transitions, bit for bit."""
    assert ours._n_updates == sb3._n_updates == n_updates
    assert differences(state_of(sb3), state_of(ours)) == []
    for name in ("actions", "rewards", "dones", "timeouts", "observations", "pos"):
        assert differences(getattr(sb3.replay_buffer, name), getattr(ours.replay_buffer, name), name) == []


def small_cnn() -> dict[str, Any]:
    return dict(net_arch=[32], features_extractor_kwargs=dict(features_dim=32))


# ------------------------------------------------------------ the same bits


def test_500_updates_on_vectors_equal_sb3() -> None:
    """Pendulum, MlpPolicy: after 500 updates every parameter and optimiser state has SB3's bits."""
    sb3, ours = pair("MlpPolicy", lambda: gym.make("Pendulum-v1"), 520, policy_kwargs=dict(net_arch=[32, 32]))
    assert_same_run(sb3, ours, 500)


def test_500_updates_on_pixels_equal_sb3() -> None:
    """36x36 pixels, CnnPolicy with SB3's NatureCNN, batch 16; the environment's ``frame_stack`` changes nothing."""
    sb3, ours = pair("CnnPolicy", lambda: PixelBox(frame_stack=1), 520, policy_kwargs=small_cnn())
    assert isinstance(ours.actor.features_extractor, NatureCNN)
    assert_same_run(sb3, ours, 500)


def test_updates_of_tqc_equal_sb3_contrib() -> None:
    """Pendulum, with quantiles dropped: every parameter and optimiser state has the bits of sb3-contrib's TQC."""
    settings = dict(policy_kwargs=dict(net_arch=[32, 32], n_quantiles=9), top_quantiles_to_drop_per_net=3)
    tqc, ours = pair("MlpPolicy", lambda: gym.make("Pendulum-v1"), 170, classes=(TQC, CuReTQC), **settings)
    assert type(ours.policy) is type(tqc.policy)
    assert_same_run(tqc, ours, 150)


def test_pixel_updates_of_tqc_equal_sb3_contrib() -> None:
    tqc, ours = pair("CnnPolicy", PixelBox, 120, classes=(TQC, CuReTQC), policy_kwargs=small_cnn())
    assert_same_run(tqc, ours, 100)


class BatchNorm(BaseFeaturesExtractor):
    """Flattened observation, with layers that differ between training and evaluation."""

    def __init__(self, observation_space: spaces.Space, dropout: float = 0.0):
        size = spaces.flatdim(observation_space)
        super().__init__(observation_space, features_dim=size + 1)  # two are too few for LayerNorm
        self.layers = nn.Sequential(nn.Flatten(), nn.BatchNorm1d(size), nn.Dropout(dropout), nn.ZeroPad1d((0, 1)))

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return self.layers(observations)


def normal_noise() -> NormalActionNoise:
    return NormalActionNoise(np.zeros(2), np.full(2, 0.3))


SETTINGS: dict[str, dict[str, Any]] = {
    "extras that do not apply": dict(
        ours=dict(
            encoder_tau=0.9, update="joint", actor_update_interval=7, precision="bf16", srl_schedule="alternating",
            ent_coef_lr_factor=3.0, task=True, curiosity_prob=1.0, policy_kwargs=dict(share_encoder=False),
        )
    ),
    "fixed temperature": dict(ent_coef=0.1),
    "target entropy": dict(target_entropy=-0.5),
    "gSDE": dict(use_sde=True, sde_sample_freq=4, use_sde_at_warmup=True),
    "three-step returns": dict(n_steps=3),
    "three environments": dict(make_env=lambda: vec_env(3), gradient_steps=-1),
    "episodes": dict(train_freq=(1, "episode"), gradient_steps=5),
    "target interval": dict(gradient_steps=3, target_update_interval=2),
    "normal noise": dict(action_noise=normal_noise),
    "noise in three environments": dict(
        make_env=lambda: vec_env(3), action_noise=lambda: VectorizedActionNoise(normal_noise(), 3)
    ),
    "shared features extractor": dict(
        policy="CnnPolicy", make_env=PixelBox, policy_kwargs=dict(share_features_extractor=True, **small_cnn())
    ),
    "batch norm": dict(policy_kwargs=dict(features_extractor_class=BatchNorm)),
    "other optimiser": dict(
        policy_kwargs=dict(optimizer_class=th.optim.AdamW, optimizer_kwargs=dict(weight_decay=0.1), n_critics=3)
    ),
    "asymmetric actions": dict(make_env=lambda: VectorBox(low=-1.0, high=3.0)),
    "channels-last pixels": dict(
        policy="CnnPolicy", make_env=lambda: PixelBox(1, channels_last=True), policy_kwargs=small_cnn()
    ),
    "normalised observations and rewards": dict(make_env=lambda: VecNormalize(vec_env(2))),
    "falling learning rate": dict(learning_rate=lambda progress: 1e-3 * progress),
    "memory-saving buffer": dict(
        optimize_memory_usage=True, replay_buffer_kwargs=dict(handle_timeout_termination=False), buffer_size=30
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", SETTINGS)
def test_settings_equal_sb3(name: str) -> None:
    """Whatever SB3's SAC can be told, CuReSAC with the extras off does the same, bit for bit."""
    settings = dict(SETTINGS[name])
    policy = settings.pop("policy", "MlpPolicy")
    make_env = settings.pop("make_env", VectorBox)
    settings.setdefault("policy_kwargs", {}).setdefault("net_arch", [16])
    if "ours" in settings:
        settings["ours"]["policy_kwargs"] = {**settings["policy_kwargs"], **settings["ours"]["policy_kwargs"]}
    sb3, ours = pair(policy, make_env, 42, **settings)
    assert_same_run(sb3, ours, sb3._n_updates)
    assert sb3._n_updates >= 5


def multi_obs_env() -> gym.Env:
    np.random.seed(0)  # it draws its images when it is made
    return SimpleMultiObsEnv(discrete_actions=False, random_start=False)


@pytest.mark.parametrize("buffer_class", [DictReplayBuffer, HerReplayBuffer])
def test_dictionary_observations_equal_sb3(buffer_class: type[ReplayBuffer]) -> None:
    """MultiInputPolicy on dictionaries of vectors and images, and hindsight relabelling, as in SB3."""
    if buffer_class is HerReplayBuffer:
        make_env: Callable[[], gym.Env] = lambda: BitFlippingEnv(n_bits=3, continuous=True)  # noqa: E731
        more: dict[str, Any] = dict(replay_buffer_kwargs=dict(n_sampled_goal=2, goal_selection_strategy="future"))
    else:
        make_env, more = multi_obs_env, {}
    policy_kwargs: dict[str, Any] = dict(net_arch=[16], features_extractor_kwargs=dict(cnn_output_dim=8))
    sb3, ours = pair(
        "MultiInputPolicy", make_env, 40, replay_buffer_class=buffer_class, policy_kwargs=policy_kwargs, **more
    )
    assert type(ours.replay_buffer) is buffer_class
    assert_same_run(sb3, ours, 20)


def test_classes_are_sb3s(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the extras off policies, replay buffers and ``train`` are SB3's own, not look-alikes."""
    mlp = tiny_model("MlpPolicy", VectorBox(), **OFF)
    cnn = tiny_model("CnnPolicy", PixelBox(), **OFF)
    assert type(mlp.policy) is sb3_policies.MlpPolicy
    assert type(cnn.policy) is sb3_policies.CnnPolicy
    assert type(mlp.replay_buffer) is type(cnn.replay_buffer) is ReplayBuffer
    assert type(tiny_model("MlpPolicy", VectorBox(), n_steps=2, **OFF).replay_buffer) is NStepReplayBuffer
    calls = []
    monkeypatch.setattr(
        SAC, "train", lambda self, gradient_steps, batch_size: calls.append((gradient_steps, batch_size))
    )
    mlp.learn(12)
    assert calls == [(1, 8), (1, 8)]


# ------------------------------------------------- what SB3's users rely on


@both_modes
def test_equal_seeds_equal_runs(extras: dict[str, Any]) -> None:
    """Two runs of one seed are equal; another seed gives another run."""
    first, second, other = (
        state_of(tiny_model("MlpPolicy", VectorBox(), seed=seed, **extras).learn(30)) for seed in (1, 1, 2)
    )
    assert differences(first, second) == []
    assert differences(first, other)


@both_modes
@pytest.mark.parametrize("net_arch", [[], [4], [4, 6], dict(pi=[5], qf=[7, 8])], ids=str)
def test_net_arch(extras: dict[str, Any], net_arch: list[int] | dict[str, list[int]]) -> None:
    """``net_arch`` is the widths of the hidden layers, the actor's and the critics' apart if it is a dictionary."""
    model = tiny_model("MlpPolicy", VectorBox(), policy_kwargs=dict(net_arch=net_arch, n_critics=3), **extras).learn(13)
    hidden = net_arch if isinstance(net_arch, dict) else dict(pi=net_arch, qf=net_arch)

    def widths(*modules: nn.Module) -> list[int]:
        return [layer.out_features for module in modules for layer in module.modules() if isinstance(layer, nn.Linear)]

    agents = [(model.policy.actor, model.policy.critic)]
    if extras is ON:
        agents.append((model.policy.curious.actor, model.policy.curious.critic))
    for actor, critic in agents:
        assert widths(actor.latent_pi) == hidden["pi"]
        assert widths(actor.mu, actor.log_std) == [2, 2]
        if extras is OFF:
            assert widths(critic) == [*hidden["qf"], 1] * 3
        else:
            biases = [layer.bias for layer in critic.ensemble if list(layer.parameters())]
            assert [bias.shape for bias in biases] == [(3, 1, width) for width in [*hidden["qf"], 1]]


@both_modes
def test_custom_optimizer(extras: dict[str, Any]) -> None:
    """``optimizer_class`` and ``optimizer_kwargs`` reach every network."""
    policy_kwargs = dict(optimizer_class=th.optim.AdamW, optimizer_kwargs=dict(weight_decay=0.2, eps=1e-3))
    policy = tiny_model("MlpPolicy", VectorBox(), policy_kwargs=policy_kwargs, **extras).learn(13).policy
    optimizers = [policy.actor.optimizer, policy.critic.optimizer]
    if extras is ON:
        optimizers += [policy.curious.actor.optimizer, policy.curious.critic.optimizer]
        optimizers += policy.encoder_update.optimizers.values()
        assert len(optimizers) == 5
        # The head has a weight decay of its own.
        assert type(policy.srl.optimizer) is th.optim.AdamW
        assert policy.srl.optimizer.param_groups[0]["eps"] == 1e-3
    for optimizer in optimizers:
        assert type(optimizer) is th.optim.AdamW
        assert (optimizer.param_groups[0]["weight_decay"], optimizer.param_groups[0]["eps"]) == (0.2, 1e-3)


@both_modes
def test_adams_own_arguments(extras: dict[str, Any]) -> None:
    """Arguments that choose one of Adam's implementations are the user's."""
    policy_kwargs = dict(optimizer_kwargs=dict(foreach=True, eps=1e-5))
    policy = tiny_model("MlpPolicy", VectorBox(), policy_kwargs=policy_kwargs, **extras).learn(12).policy
    assert policy.critic.optimizer.defaults["foreach"] and policy.critic.optimizer.defaults["eps"] == 1e-5


@both_modes
@pytest.mark.parametrize("ent_coef, initial", [("auto", 1.0), ("auto_0.25", 0.25), (0.3, 0.3)])
def test_temperature(extras: dict[str, Any], ent_coef: str | float, initial: float) -> None:
    """Learned temperatures start where they are told and move; a fixed one stays and has no optimiser."""
    model = tiny_model("MlpPolicy", VectorBox(), ent_coef=ent_coef, **extras)
    logs = [model.log_ent_coef] + ([model.policy.curious.log_ent_coef] if extras is ON else [])
    if isinstance(ent_coef, str):
        assert [log.exp().item() for log in logs] == pytest.approx([initial] * len(logs))
        before = [log.clone() for log in logs]
        model.learn(14)
        assert not any(th.equal(log, old) for log, old in zip(logs, before, strict=True))
    else:
        model.learn(14)
        assert logs == [None] * len(logs)
        assert model.ent_coef_optimizer is None
        assert model.ent_coef_tensor.item() == pytest.approx(initial)


@both_modes
def test_malformed_temperature_is_refused(extras: dict[str, Any]) -> None:
    """As in SB3: only numbers, and words that start with ``auto``."""
    with pytest.raises(ValueError):
        tiny_model("MlpPolicy", VectorBox(), ent_coef="warm", **extras)


@both_modes
def test_train_freq(extras: dict[str, Any]) -> None:
    """``train_freq`` in steps or episodes, ``gradient_steps`` per call, 0 and -1 (as many as steps) included."""
    cases = [
        # total steps, train_freq, gradient_steps, n_envs -> updates. Learning begins *after* step 10.
        (30, 1, 1, 1, 20),
        (30, 3, 2, 1, 2 * 7),  # calls at 12, 15, ..., 30
        (30, (3, "step"), -1, 1, 3 * 7),
        (40, (1, "episode"), -1, 1, 40),  # episodes of 20 steps
        (40, (1, "episode"), 3, 1, 6),
        (40, (2, "episode"), 3, 1, 3),
        (30, 1, 0, 1, 0),
        (30, 1, -1, 3, 3 * 7),  # calls at 12, 15, ..., 30
        (30, 2, 5, 3, 5 * 4),  # calls at 12, 18, 24, 30
    ]
    for total, train_freq, gradient_steps, n_envs, updates in cases:
        model = tiny_model("MlpPolicy", vec_env(n_envs), train_freq=train_freq, gradient_steps=gradient_steps, **extras)
        assert isinstance(model.train_freq, TrainFreq)
        model.learn(total)
        assert (model.num_timesteps, model._n_updates) == (total, updates), (train_freq, gradient_steps, n_envs)


@both_modes
@pytest.mark.parametrize("n_envs", [1, 3])
def test_action_noise(extras: dict[str, Any], n_envs: int) -> None:
    """Noise is added to the scaled action of every environment and clipped; a single noise is vectorised."""
    # Far outside [-1, 1], so that whatever the policy wants, the upper bound is executed.
    noise = NormalActionNoise(np.full(2, 5.0), np.zeros(2))
    model = tiny_model("MlpPolicy", vec_env(n_envs), action_noise=noise, **extras).learn(30)
    assert isinstance(model.action_noise, VectorizedActionNoise) == (n_envs > 1)
    assert (model.replay_buffer.actions[: model.replay_buffer.pos] == 1).all()


@both_modes
def test_action_noise_is_reset_with_the_episode(extras: dict[str, Any]) -> None:
    """Correlated noise starts anew in the environment whose episode ended, and only there."""
    resets = []

    class Spy(VectorizedActionNoise):
        def reset(self, indices: Any = None) -> None:
            resets.append(indices)
            super().reset(indices)

    noise = Spy(OrnsteinUhlenbeckActionNoise(np.zeros(2), np.ones(2)), 2)
    env = DummyVecEnv([VectorBox, lambda: VectorBox(episode_length=10)])
    resets.clear()
    tiny_model("MlpPolicy", env, action_noise=noise, **extras).learn(40)
    # All at the start of `learn`; then at steps 10 and 20 of each environment
    assert resets == [None, [1], [0], [1]]


@pytest.mark.parametrize(
    "extras, curious", [(OFF, False), (ON, False), (ON, True)], ids=["off", "on", "on, curious policy"]
)
def test_predict(extras: dict[str, Any], curious: bool) -> None:
    """One observation or a batch, deterministic or not; actions in asymmetric bounds; wrong shapes are refused."""
    model = tiny_model("MlpPolicy", VectorBox(low=-1.0, high=3.0), **extras)
    predict = model.predict_curious if curious else model.predict
    # Wide distributions, so that draws come close to the bounds
    nn.init.constant_((model.policy.curious.actor if curious else model.actor).log_std.bias, 3.0)
    batch = np.random.default_rng(0).uniform(-1, 1, (50, 2)).astype(np.float32)
    actions, state = predict(batch, deterministic=True)
    assert actions.shape == (50, 2) and state is None
    single, _ = predict(batch[7], deterministic=True)
    assert single.shape == (2,)
    np.testing.assert_allclose(single, actions[7], rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(actions, predict(batch, deterministic=True)[0])
    draws = np.concatenate([predict(batch)[0] for _ in range(20)])
    assert (draws >= -1).all() and (draws <= 3).all()
    # Stretched to the bounds, not clipped to [-1, 1]
    assert draws.max() > 2.9 and draws.min() < -0.9
    for wrong in (batch[:, :1], batch[None]):
        with pytest.raises(ValueError):
            predict(wrong)


def test_no_curious_policy_without_curiosity() -> None:
    """Asking SB3's own SAC for a curious action is refused with a sentence."""
    model = tiny_model("MlpPolicy", VectorBox(), **OFF)
    with pytest.raises(ValueError, match="only curiosity='separate' trains a curious policy"):
        model.predict_curious(model.observation_space.sample())


@both_modes
def test_environment_by_name(extras: dict[str, Any]) -> None:
    """A Gymnasium id is made, monitored and vectorised."""
    model = tiny_model("MlpPolicy", "Pendulum-v1", **extras)
    assert isinstance(model.get_env(), DummyVecEnv) and model.env.env_is_wrapped(Monitor) == [True]
    model.learn(12)
    assert np.abs(model.predict(model.observation_space.sample())[0]) <= 2
    assert (model._n_updates, model.replay_buffer.size()) == (2, 12)


@both_modes
def test_channels_last_images(extras: dict[str, Any]) -> None:
    """Environments with channels last are transposed, and ``predict`` takes both layouts with one result."""
    model = tiny_model("CnnPolicy", PixelBox(2, channels_last=True, tells_frame_stack=False), **extras).learn(13)
    assert model.observation_space.shape == (6, 36, 36)
    image, _ = PixelBox(2, channels_last=True).reset(seed=5)
    predicts = [model.predict, model.predict_curious] if extras is ON else [model.predict]
    for predict in predicts:
        first, _ = predict(image.transpose(2, 0, 1), deterministic=True)
        last, _ = predict(image, deterministic=True)
        assert last.shape == (2,)
        np.testing.assert_array_equal(first, last)
        batch, _ = predict(np.stack([image, image]), deterministic=True)
        np.testing.assert_allclose(batch, [first, first], rtol=1e-5, atol=1e-6)
    # The stored image is the transposed one.
    assert model.replay_buffer.sample(4).observations.shape == (4, 6, 36, 36)


@both_modes
def test_get_and_set_parameters(extras: dict[str, Any]) -> None:
    """Parameters change with learning, and putting the old ones back gives the old actions and optimisers back."""
    model = tiny_model("MlpPolicy", VectorBox(), **extras).learn(20)
    before = state_of(model)
    saved = {name: value for name, value in before.items() if name in model.get_parameters()}
    observations = np.random.default_rng(0).uniform(-1, 1, (5, 2)).astype(np.float32)
    actions, _ = model.predict(observations, deterministic=True)
    model.learn(20)
    moved = {name.split("[")[0].lstrip(".") for name in differences(before, state_of(model))}
    critics = "q" if extras is OFF else "ensemble"
    for module in ("actor.mu", f"critic.{critics}", f"critic_target.{critics}"):
        assert any(module in name for name in moved), module
    assert not np.array_equal(actions, model.predict(observations, deterministic=True)[0])
    model.set_parameters(saved)
    np.testing.assert_array_equal(actions, model.predict(observations, deterministic=True)[0])
    assert differences(saved, model.get_parameters()) == []


@both_modes
def test_set_parameters_exact_match(extras: dict[str, Any]) -> None:
    """Missing or unknown names are errors; with ``exact_match=False`` a part may be set alone."""
    model = tiny_model("MlpPolicy", VectorBox(), **extras)
    other = tiny_model("MlpPolicy", VectorBox(), seed=9, **extras).get_parameters()
    with pytest.raises(ValueError, match="invalid object name"):
        model.set_parameters({**other, "no_such_net": {}})
    for name in other:
        with pytest.raises(ValueError, match="do not match"):
            model.set_parameters({key: value for key, value in other.items() if key != name})
    key = "actor.mu.weight" if extras is OFF else "task.actor.mu.weight"
    part = {"policy": {key: th.full_like(other["policy"][key], 0.125)}}
    before = state_of(model)
    model.set_parameters(part, exact_match=False)
    assert differences(before, state_of(model)) == [f".policy.{key}"]
    assert (model.policy.actor.mu.weight == 0.125).all()
    with pytest.raises(RuntimeError, match="Missing key"):
        model.set_parameters({**other, **part})


@both_modes
def test_features_extractor_kwargs(extras: dict[str, Any]) -> None:
    """``features_extractor_class`` and ``features_extractor_kwargs`` reach the network that sees the observations."""
    policy_kwargs = dict(features_extractor_class=BatchNorm, features_extractor_kwargs=dict(dropout=0.25))
    policy = tiny_model("MlpPolicy", VectorBox(), policy_kwargs=policy_kwargs, **extras).learn(13).policy
    extractors = [policy.encoder.trunk.extractor, policy.encoder_target.trunk.extractor] if extras is ON else [
        policy.actor.features_extractor, policy.critic.features_extractor, policy.critic_target.features_extractor
    ]  # fmt: skip
    assert len({id(extractor) for extractor in extractors}) == len(extractors)
    for extractor in extractors:
        assert type(extractor) is BatchNorm and extractor.layers[2].p == 0.25


@both_modes
def test_training_and_evaluation_mode(extras: dict[str, Any]) -> None:
    """Running statistics move in ``train`` only, not when collecting or predicting; dropout is off when acting."""
    policy_kwargs = dict(features_extractor_class=BatchNorm, features_extractor_kwargs=dict(dropout=0.5))
    model = tiny_model("MlpPolicy", VectorBox(), learning_starts=5, policy_kwargs=policy_kwargs, tau=0.0, **extras)
    extras_on = extras is ON
    online = model.policy.encoder.trunk.extractor if extras_on else model.critic.features_extractor
    target = model.policy.encoder_target.trunk.extractor if extras_on else model.critic_target.features_extractor
    statistics = [extractor.layers[1].running_mean for extractor in (online, target)]
    observation = np.array([0.3, -0.7], np.float32)
    model.learn(25, callback=StopBeforeTraining())
    model.predict(observation)
    assert not any(mean.any() for mean in statistics)
    model.train(1, batch_size=8)
    assert online.training and not target.training
    assert statistics[0].any()
    # The running statistics are copied to the target, at any tau.
    assert th.equal(*statistics)
    first, second = (model.predict(observation, deterministic=True)[0] for _ in range(2))
    np.testing.assert_array_equal(first, second)
    if extras_on:
        first, second = (model.predict_curious(observation, deterministic=True)[0] for _ in range(2))
        np.testing.assert_array_equal(first, second)


class StopBeforeTraining(EveryNTimesteps):
    """Collects the whole rollout, but stops before the first update."""

    def __init__(self) -> None:
        super().__init__(n_steps=1, callback=CallbackList([]))

    def _on_training_start(self) -> None:
        self.model.gradient_steps = 0


@both_modes
def test_collect_then_train_offline(extras: dict[str, Any], tmp_path: Path) -> None:
    """A stored replay buffer trains a fresh model that never steps an environment."""
    collector = tiny_model("MlpPolicy", VectorBox(), gradient_steps=0, **extras).learn(40)
    assert collector._n_updates == 0
    collector.save_replay_buffer(tmp_path / "buffer")
    model = tiny_model("MlpPolicy", VectorBox(), **extras)
    model.load_replay_buffer(tmp_path / "buffer")
    assert model.replay_buffer.size() == 40
    np.testing.assert_array_equal(model.replay_buffer.rewards, collector.replay_buffer.rewards)
    model.learn(0)  # gives it a logger
    before = state_of(model)
    model.train(gradient_steps=5, batch_size=8)
    assert (model._n_updates, model.num_timesteps) == (5, 0)
    assert differences(before, state_of(model))


@both_modes
def test_callbacks_stop_training(extras: dict[str, Any], tmp_path: Path) -> None:
    """Training ends when a callback says so: after so many episodes, at a reward, or without improvement."""
    model = tiny_model("MlpPolicy", VectorBox(), **extras)
    model.learn(200, callback=StopTrainingOnMaxEpisodes(max_episodes=2))
    # SB3 asks the callback after each step.
    assert 40 <= model.num_timesteps <= 41
    reached = StopTrainingOnRewardThreshold(reward_threshold=-1.0)  # rewards are >= 0
    model.learn(200, callback=EvalCallback(vec_env(1), callback_on_new_best=reached, eval_freq=15, n_eval_episodes=1))
    assert model.num_timesteps == 15
    stuck = StopTrainingOnNoModelImprovement(max_no_improvement_evals=0, min_evals=1)
    evaluation = EvalCallback(
        vec_env(1), callback_after_eval=stuck, eval_freq=5, n_eval_episodes=1, log_path=str(tmp_path),
        best_model_save_path=str(tmp_path),
    )  # fmt: skip
    evaluation.best_mean_reward = np.inf
    events: list[int] = []
    every = EveryNTimesteps(n_steps=4, callback=Recorder(events))
    model.learn(200, callback=[evaluation, every])
    assert model.num_timesteps == 10 and events == [4, 8]
    assert np.load(tmp_path / "evaluations.npz")["timesteps"].tolist() == [5, 10]


class Recorder(StopTrainingOnMaxEpisodes):
    """Notes when it was called."""

    def __init__(self, events: list[int]):
        super().__init__(max_episodes=10**6)
        self.events = events

    def _on_step(self) -> bool:
        self.events.append(self.num_timesteps)
        return True


@both_modes
def test_set_env(extras: dict[str, Any]) -> None:
    """A new environment replaces the old one and is reset first; another number of environments is refused."""
    old, new = VectorBox(), VectorBox(episode_length=7)
    model = tiny_model("MlpPolicy", old, **extras).learn(25)
    with pytest.raises(AssertionError, match="number of environments"):
        model.set_env(vec_env(2))
    model.set_env(new)
    old.step = None  # type: ignore[method-assign, assignment]
    model.learn(14)
    assert [episode["l"] for episode in model.ep_info_buffer] == [7, 7]


@both_modes
def test_reset_num_timesteps(extras: dict[str, Any]) -> None:
    """``learn`` starts counting anew, or with ``reset_num_timesteps=False`` goes on."""
    model = tiny_model("MlpPolicy", VectorBox(), **extras).learn(25)
    model.learn(15, reset_num_timesteps=False)
    # The second call takes no more random steps.
    assert (model.num_timesteps, model._n_updates) == (40, 30)
    # The second call took up the second episode where the first had left it, at its fifth step.
    assert model._episode_num == 2
    model.learn(15)
    assert (model.num_timesteps, model._n_updates) == (15, 35)


@both_modes
def test_monitor_and_evaluate_policy(extras: dict[str, Any]) -> None:
    """Episodes are monitored without being asked for; a trained model can be evaluated."""
    model = tiny_model("MlpPolicy", VectorBox(), **extras).learn(60)
    assert [episode["l"] for episode in model.ep_info_buffer] == [20, 20, 20]
    np.testing.assert_allclose(
        [episode["r"] for episode in model.ep_info_buffer],
        model.replay_buffer.rewards[:60, 0].reshape(3, 20).sum(axis=1),
        rtol=1e-4,
    )
    rewards, lengths = evaluate_policy(model, Monitor(VectorBox()), n_eval_episodes=2, return_episode_rewards=True)
    assert lengths == [20, 20] and all(0 <= reward <= 20 for reward in rewards)


@both_modes
def test_vec_normalize(extras: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    """The buffer holds the original observations and rewards; updates see them normalised by today's statistics."""
    env = VecNormalize(vec_env(2))
    model = tiny_model("MlpPolicy", env, **extras).learn(60)
    assert model.get_vec_normalize_env() is env
    stored = model.replay_buffer.rewards[: model.replay_buffer.pos]
    assert (stored >= 0).all() and (stored <= 1).all()
    assert np.abs(model.replay_buffer.observations[: model.replay_buffer.pos]).max() <= 1
    sampled = []
    sample = model.replay_buffer.sample
    monkeypatch.setattr(
        model.replay_buffer, "sample", lambda *args, **kw: sampled.append((args, kw)) or sample(*args, **kw)
    )
    model.train(1, batch_size=8)
    assert sampled == [((8,), {"env": env})]


@both_modes
def test_vec_normalize_rewards_of_pixels(extras: dict[str, Any]) -> None:
    """Images can have normalised rewards: what is stored is the environment's, what is sampled is normalised."""
    env = VecNormalize(vec_env(2, PixelBox), norm_obs=False)
    model = tiny_model("CnnPolicy", env, **extras).learn(30)
    np.random.seed(0)
    plain = model.replay_buffer.sample(16).rewards
    np.random.seed(0)
    normalised = model.replay_buffer.sample(16, env=env).rewards
    np.testing.assert_allclose(normalised, env.normalize_reward(plain.numpy()), rtol=1e-5)
    assert not np.allclose(plain, normalised)


class MatrixActions(VectorBox):
    """``VectorBox`` whose actions are a 2x1 matrix of float64."""

    def __init__(self) -> None:
        super().__init__()
        self.action_space = spaces.Box(-2.0, 1.0, (2, 1), np.float64)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        assert action.shape == (2, 1) and (action >= -2).all() and (action <= 1).all()
        self.position = np.clip(self.position + 0.2 * action[:, 0], -1, 1)
        self.n_steps += 1
        return self.observe(), 0.0, False, self.n_steps >= self.episode_length, {}


@both_modes
def test_matrix_actions(extras: dict[str, Any]) -> None:
    """Actions need not be vectors of float32."""
    more = {"curiosity_prob": 0.5} if extras is ON else {}
    model = tiny_model("MlpPolicy", vec_env(2, MatrixActions), **extras, **more).learn(30)
    assert model.predict(model.observation_space.sample())[0].shape == (2, 1)
    assert np.abs(model.replay_buffer.actions).max() <= 1


@both_modes
@pytest.mark.parametrize(
    "space", [spaces.Discrete(3), spaces.MultiDiscrete([2, 2]), spaces.MultiBinary(2)], ids=lambda s: type(s).__name__
)
def test_discrete_actions_are_refused(extras: dict[str, Any], space: spaces.Space) -> None:
    """SAC is for continuous actions."""
    env = VectorBox()
    env.action_space = space  # type: ignore[assignment]
    with pytest.raises((AssertionError, ValueError), match="action"):
        tiny_model("MlpPolicy", env, **extras)


@both_modes
def test_n_step_returns(extras: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    """Sampled rewards are discounted sums, bootstrapped with gamma^3."""
    model = tiny_model("MlpPolicy", VectorBox(), n_steps=3, gamma=0.5, ent_coef=0.0, learning_rate=0.0, **extras)
    model.learn(30)
    batch = model.replay_buffer.sample(200)
    rewards, discounts = batch.rewards, batch.discounts
    if extras is not OFF:
        ahead = model.replay_buffer.look_ahead(3, 0.5)
        rewards, discounts = ahead["n_step_rewards"], ahead["n_step_discounts"]
    assert set(discounts.flatten().tolist()) == {0.5, 0.25, 0.125}
    monkeypatch.setattr(model.replay_buffer, "sample", lambda *args, **kwargs: batch)
    target = model.critic_target
    for last in [network[-1] for network in target.q_networks] if extras is OFF else [target.ensemble[-1]]:
        nn.init.zeros_(last.weight)
        nn.init.constant_(last.bias, 10.0)
    model.train(1, batch_size=200)
    with th.no_grad():
        inputs = batch.observations if extras is OFF else model.policy.encode(batch.observations)
        target = rewards + discounts * 10
        values = model.critic(inputs, batch.actions)
        values = values if extras is OFF else values.unbind(dim=1)
        expected = sum(0.5 * (q - target).square().mean() for q in values)
    assert float(model.logger.name_to_value["train/critic_loss"]) == pytest.approx(expected.item(), rel=1e-5)


@both_modes
def test_save_to_memory_exclude_and_include(extras: dict[str, Any], tmp_path: Path) -> None:
    """Archives go to files or to memory; attributes can be left out or added, arguments replaced on loading."""
    model = tiny_model("MlpPolicy", VectorBox(), **extras).learn(15)
    archive = io.BytesIO()
    model.save(archive)
    archive.seek(0)
    loaded = CuReSAC.load(archive, env=VectorBox(), gamma=0.5, tau=0.25)
    assert (loaded.gamma, loaded.tau, loaded.num_timesteps) == (0.5, 0.25, 15)
    assert differences(state_of(model), state_of(loaded)) == []
    model.save(tmp_path / "model", exclude=["learning_starts"], include=["_last_obs"])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        partial = CuReSAC.load(tmp_path / "model.zip")
    assert partial.learning_starts == 1000  # the constructor's default
    with pytest.raises(ValueError, match=r"policy.kwargs"):
        CuReSAC.load(tmp_path / "model.zip", policy_kwargs=dict(net_arch=[3]))


@both_modes
def test_learning_rate_schedule(extras: dict[str, Any]) -> None:
    """One schedule of the remaining progress for all optimisers, the temperatures at a fixed ratio."""
    model = tiny_model("MlpPolicy", VectorBox(), learning_rate=lambda progress: 1e-2 * progress, **extras).learn(20)
    # The last update is made when nothing remains, one step from the end 1/20 of the steps remain.
    assert model.actor.optimizer.param_groups[0]["lr"] == 0
    model._current_progress_remaining = 0.5
    model.train(1, batch_size=8)
    policy = model.policy
    optimizers = [policy.actor.optimizer, policy.critic.optimizer]
    temperatures = [model.ent_coef_optimizer]
    if extras is ON:
        optimizers += [policy.curious.actor.optimizer, policy.curious.critic.optimizer, policy.srl.optimizer]
        temperatures.append(model.policy.curious.ent_coef_optimizer)
        # The encoder's one step stands for those of three losses.
        (joint,) = policy.encoder_update.optimizers.values()
        assert joint.param_groups[0]["lr"] == pytest.approx(5e-3 * 3**0.5)
    ratio = 0.1 if extras is ON else 1.0
    assert [optimizer.param_groups[0]["lr"] for optimizer in optimizers] == [5e-3] * len(optimizers)
    assert [optimizer.param_groups[0]["lr"] for optimizer in temperatures] == pytest.approx(
        [5e-3 * ratio] * len(temperatures)
    )


@both_modes
def test_image_scaling(extras: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    """Images are divided by 255 exactly once on their way to the convolutions."""
    model = tiny_model("CnnPolicy", PixelBox(), **extras)
    trunk = model.policy.encoder.trunk if extras is ON else model.actor.features_extractor.cnn
    seen = []
    trunk[0].register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    image, _ = PixelBox().reset(seed=0)
    model.predict(image)
    expected = preprocess_obs(th.as_tensor(image)[None], model.observation_space)
    assert len(seen) == 1 and th.equal(seen[0], expected)
    assert seen[0].max() == 1
