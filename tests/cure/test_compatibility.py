"""What users of SB3's SAC rely on, of CuReSAC as it comes and with ``srl=None, curiosity=None``."""

import copy
import io
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from dictionaries_for_tests import Goal
from envs_for_tests import PixelBox, VectorBox, differences, state_of, tiny_model
from gymnasium import spaces
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.buffers import DictReplayBuffer, ReplayBuffer
from stable_baselines3.common.callbacks import (
    CallbackList,
    CheckpointCallback,
    EvalCallback,
    EveryNTimesteps,
    StopTrainingOnMaxEpisodes,
    StopTrainingOnRewardThreshold,
)
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from torch import nn

from sb3_cure import CuReSAC, make_dmc_env
from sb3_cure.data.buffers import FrameStackReplayBuffer

OFF: dict[str, Any] = dict(srl=None, curiosity=None)
both_modes = pytest.mark.parametrize("extras", [{}, OFF], ids=["default", "off"])


def vec_env(n_envs: int = 1, make: Callable[[], gym.Env] = VectorBox, **kwargs: Any) -> DummyVecEnv:
    return DummyVecEnv([lambda: Monitor(make(**kwargs))] * n_envs)


def vector_model(env: Any = None, **kwargs: Any) -> CuReSAC:
    return tiny_model("MlpPolicy", vec_env() if env is None else env, **kwargs)


# ----------------------------------------------------------- arguments of the networks


@both_modes
@pytest.mark.parametrize("net_arch", [[], [4, 6], dict(pi=[5], qf=[7, 8])], ids=str)
def test_net_arch_is_widths_of_hidden_layers(extras: dict[str, Any], net_arch: Any) -> None:
    policy = vector_model(policy_kwargs=dict(net_arch=net_arch, n_critics=3), **extras).learn(13).policy
    hidden = net_arch if isinstance(net_arch, dict) else dict(pi=net_arch, qf=net_arch)
    for agent in policy.agents.values():
        layers = [*agent.actor.latent_pi, agent.actor.mu, agent.actor.log_std]
        assert [each.out_features for each in layers if isinstance(each, nn.Linear)] == [*hidden["pi"], 2, 2]
        biases = [layer.bias for layer in agent.critic.ensemble if list(layer.parameters())]
        assert [bias.shape for bias in biases] == [(3, 1, width) for width in [*hidden["qf"], 1]]


@both_modes
def test_optimizer_arguments_reach_every_network(extras: dict[str, Any]) -> None:
    policy_kwargs = dict(optimizer_class=th.optim.AdamW, optimizer_kwargs=dict(weight_decay=0.2, eps=1e-3))
    policy = vector_model(policy_kwargs=policy_kwargs, **extras).learn(13).policy
    optimizers = [each.optimizer for agent in policy.agents.values() for each in (agent.actor, agent.critic)]
    optimizers += policy.encoder_update.optimizers.values()
    assert len(optimizers) == (3 if extras else 5)
    for optimizer in optimizers:
        assert type(optimizer) is th.optim.AdamW
        assert (optimizer.param_groups[0]["weight_decay"], optimizer.param_groups[0]["eps"]) == (0.2, 1e-3)
    if policy.srl is not None:  # has a weight decay of its own
        assert type(policy.srl.optimizer) is th.optim.AdamW and policy.srl.optimizer.defaults["eps"] == 1e-3
    chosen = vector_model(policy_kwargs=dict(optimizer_kwargs=dict(foreach=True)), **extras).policy
    assert chosen.critic.optimizer.defaults["foreach"] and not chosen.critic.optimizer.defaults["fused"]


class BatchNorm(BaseFeaturesExtractor):
    """Flattened observation, with layers that differ between training and evaluation."""

    def __init__(self, observation_space: spaces.Space, dropout: float = 0.0):
        size = spaces.flatdim(observation_space)
        super().__init__(observation_space, features_dim=size + 1)  # two are too few for LayerNorm
        self.layers = nn.Sequential(nn.Flatten(), nn.BatchNorm1d(size), nn.Dropout(dropout), nn.ZeroPad1d((0, 1)))

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return self.layers(observations)


@both_modes
def test_any_features_extractor_is_the_encoder(extras: dict[str, Any]) -> None:
    """Its running statistics move in ``train`` only and are copied to the target; dropout is off when acting."""
    policy_kwargs = dict(features_extractor_class=BatchNorm, features_extractor_kwargs=dict(dropout=0.5))
    model = vector_model(policy_kwargs=policy_kwargs, encoder_tau=0.0, gradient_steps=0, **extras)
    online, target = (each.trunk.extractor for each in (model.policy.encoder, model.policy.encoder_target))
    assert type(online) is BatchNorm and online.layers[2].p == 0.5
    observation = np.array([0.3, -0.7], np.float32)
    model.learn(25)
    model.predict(observation)
    means = [extractor.layers[1].running_mean for extractor in (online, target)]
    assert not any(mean.any() for mean in means)
    model.train(1, batch_size=8)
    assert means[0].any() and th.equal(*means)
    for predict in [model.predict] if extras else [model.predict, model.predict_curious]:
        first, second = (predict(observation, deterministic=True)[0] for _ in range(2))
        np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize("ent_coef", [0.3, "auto_0.3"])
def test_callbacks_set_the_temperature(ent_coef: str | float) -> None:
    """By the attributes that SB3's own ``train`` reads; ``save`` writes the same ones."""

    def anneal(variables: dict[str, Any], _: dict[str, Any]) -> bool:
        model = variables["self"]
        if isinstance(ent_coef, str):
            model.log_ent_coef = th.tensor([0.007]).log().requires_grad_(True)
        else:
            model.ent_coef_tensor = th.tensor(0.007)
        return True

    model = vector_model(ent_coef=ent_coef).learn(14, anneal)
    assert model.policy.task.temperature().item() == pytest.approx(0.007, rel=1e-5)


# -------------------------------------------------------------------- acting


@pytest.mark.parametrize("name", ["predict", "predict_curious"])
def test_predict(name: str) -> None:
    """One observation or a batch, deterministic or not; actions fill asymmetric bounds; wrong shapes are refused."""
    model = vector_model(VectorBox(low=-1.0, high=3.0))
    predict = getattr(model, name)
    for agent in model.policy.agents.values():  # wide distributions, so that draws come close to the bounds
        nn.init.constant_(agent.actor.log_std.bias, 3.0)
    batch = np.random.default_rng(0).uniform(-1, 1, (50, 2)).astype(np.float32)
    actions, state = predict(batch, deterministic=True)
    assert actions.shape == (50, 2) and state is None
    single, _ = predict(batch[7], deterministic=True)
    assert single.shape == (2,)
    np.testing.assert_allclose(single, actions[7], rtol=1e-5, atol=1e-6)
    draws = np.concatenate([predict(batch)[0] for _ in range(20)])
    assert (draws >= -1).all() and (draws <= 3).all() and draws.max() > 2.9 and draws.min() < -0.9
    for wrong in (batch[:, :1], batch[None]):
        with pytest.raises(ValueError):
            predict(wrong)


@both_modes
def test_channels_last_images(extras: dict[str, Any]) -> None:
    """They are transposed, and ``predict`` takes both layouts; images are divided by 255 exactly once."""
    model = tiny_model("CnnPolicy", PixelBox(channels_last=True, tells_frame_stack=False), **extras).learn(13)
    assert model.observation_space.shape == model.replay_buffer.sample(4).observations.shape[1:] == (6, 36, 36)
    image, _ = PixelBox(channels_last=True).reset(seed=5)
    seen: list[th.Tensor] = []
    next(each for each in model.policy.encoder.modules() if isinstance(each, nn.Conv2d)).register_forward_pre_hook(
        lambda _, inputs: seen.append(inputs[0])
    )
    first, last = (model.predict(each, deterministic=True)[0] for each in (image.transpose(2, 0, 1), image))
    assert last.shape == (2,)
    np.testing.assert_array_equal(first, last)
    assert all(each.max() == 1 for each in seen)


class MatrixActions(VectorBox):
    """``VectorBox`` whose actions are a 2x1 matrix of float64."""

    def __init__(self) -> None:
        super().__init__()
        self.action_space = spaces.Box(-2.0, 1.0, (2, 1), np.float64)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        assert action.shape == (2, 1) and (action >= -2).all() and (action <= 1).all()
        self.n_steps += 1
        return self.observe(), 0.0, False, self.n_steps >= self.episode_length, {}


@pytest.mark.parametrize("curiosity", ["separate", "random", None])
def test_matrix_actions(curiosity: str | None) -> None:
    """Actions need not be vectors of float32."""
    model = vector_model(vec_env(2, MatrixActions), curiosity=curiosity, curiosity_prob=0.5).learn(30)
    assert model.predict(model.observation_space.sample())[0].shape == (2, 1)
    assert np.abs(model.replay_buffer.actions).max() <= 1


class Rooms(gym.ObservationWrapper):
    """Shows only in which of two rooms the dot is."""

    def __init__(self) -> None:
        super().__init__(VectorBox())
        self.observation_space = spaces.Discrete(2)

    def observation(self, observation: np.ndarray) -> Any:
        return np.int64(observation[0] > 0)


@both_modes
def test_discrete_observations(extras: dict[str, Any]) -> None:
    """They are stored as numbers and seen one-hot."""
    model = vector_model(DummyVecEnv([Rooms]), **extras).learn(20)
    assert set(np.unique(model.replay_buffer.observations[:20])) <= {0, 1}
    assert model.predict(np.int64(1))[0].shape == (2,)


@both_modes
@pytest.mark.parametrize("n_envs", [1, 3])
def test_action_noise(extras: dict[str, Any], n_envs: int) -> None:
    """Noise is added to the scaled action of every environment, whoever acts, and clipped."""
    # Far outside [-1, 1], so that whatever the policies want, the upper bound is executed.
    noise = NormalActionNoise(np.full(2, 5.0), np.zeros(2))
    model = vector_model(vec_env(n_envs), action_noise=noise, curiosity_prob=0.5, **extras).learn(30)
    assert (model.replay_buffer.actions[: model.replay_buffer.pos] == 1).all()


# ------------------------------------------------------------------ training


@both_modes
def test_equal_seeds_equal_runs(extras: dict[str, Any]) -> None:
    first, second, other = (state_of(vector_model(seed=seed, **extras).learn(25)) for seed in (1, 1, 2))
    assert differences(first, second) == []
    assert differences(first, other)


@both_modes
def test_train_freq_and_gradient_steps(extras: dict[str, Any]) -> None:
    """Steps or episodes, and 0 or -1 (as many as steps) updates per call; learning begins after step 10."""
    cases: list[tuple[int, Any, int, int, int]] = [
        # total steps, train_freq, gradient_steps, n_envs -> updates
        (30, 3, 2, 1, 2 * 7),  # calls at 12, 15, ..., 30
        (30, (3, "step"), -1, 1, 3 * 7),
        (40, (1, "episode"), -1, 1, 40),  # episodes of 20 steps
        (40, (2, "episode"), 3, 1, 3),
        (30, 1, 0, 1, 0),
        (30, 1, -1, 3, 3 * 7),  # calls at 12, 15, ..., 30
        (30, 2, 5, 3, 5 * 4),  # calls at 12, 18, 24, 30
    ]
    for total, train_freq, gradient_steps, n_envs, updates in cases:
        model = vector_model(vec_env(n_envs), train_freq=train_freq, gradient_steps=gradient_steps, **extras)
        model.learn(total)
        assert (model.num_timesteps, model._n_updates) == (total, updates), (train_freq, gradient_steps, n_envs)


@both_modes
def test_learning_twice(extras: dict[str, Any], tmp_path: Path) -> None:
    """Counters and schedules start anew or continue; the logger that was set stays."""
    seen: list[float] = []

    def schedule(remaining: float) -> float:
        seen.append(remaining)
        return 1e-3 * remaining

    model = vector_model("Pendulum-v1", learning_rate=schedule, **extras)
    logger = configure(str(tmp_path), ["csv"])
    model.set_logger(logger)
    model.learn(25)
    assert model.logger is logger and min(seen) == 0 and model.actor.optimizer.param_groups[0]["lr"] == 0
    seen.clear()
    model.learn(25, reset_num_timesteps=False)  # without random steps
    assert (model.num_timesteps, model._total_timesteps, model._n_updates, max(seen) <= 0.5) == (50, 50, 40, True)
    model.learn(15)
    assert (model.num_timesteps, model._n_updates) == (15, 45)


@both_modes
def test_set_env(extras: dict[str, Any]) -> None:
    """A new environment replaces the old one and is reset first; another number of environments is refused."""
    old = VectorBox()
    model = vector_model(old, **extras).learn(25)
    with pytest.raises(AssertionError, match="number of environments"):
        model.set_env(vec_env(2))
    model.set_env(VectorBox(episode_length=7))
    old.step = None  # type: ignore[method-assign, assignment]
    model.learn(14)
    assert [episode["l"] for episode in model.ep_info_buffer] == [7, 7]


@both_modes
def test_callbacks(extras: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """SB3's own act when they should, stop training, and write what loads; training can then continue."""
    calls: list[int] = []

    class Recorder(StopTrainingOnMaxEpisodes):
        def _on_step(self) -> bool:
            calls.append(self.num_timesteps)
            return True

    reached = StopTrainingOnRewardThreshold(reward_threshold=-1.0)  # rewards are in [0, 1]
    folder = str(tmp_path)
    callbacks = CallbackList(
        [
            CheckpointCallback(20, folder, save_replay_buffer=True),
            EveryNTimesteps(15, Recorder(10)),
            EvalCallback(
                vec_env(), reached, n_eval_episodes=1, eval_freq=30, log_path=folder, best_model_save_path=folder
            ),
        ]
    )
    has_bar = None not in map(find_spec, ("tqdm", "rich"))  # packages of an extra
    model = vector_model(verbose=1, **extras).learn(1000, callbacks, log_interval=1, progress_bar=has_bar)
    assert model.num_timesteps == 30 and calls == [15, 30]
    names = {"rl_model_20_steps.zip", "rl_model_replay_buffer_20_steps.pkl", "evaluations.npz", "best_model.zip"}
    assert {path.name for path in tmp_path.iterdir()} == names
    assert np.load(tmp_path / "evaluations.npz")["timesteps"].tolist() == [30]
    printed = capsys.readouterr().out
    assert "critic_loss" in printed and "environment_steps" in printed and "tensor(" not in printed
    best = CuReSAC.load(tmp_path / "best_model", env=vec_env())
    assert best.learn(1000, StopTrainingOnMaxEpisodes(2), reset_num_timesteps=False).num_timesteps <= 30 + 41


@both_modes
def test_vec_normalize(extras: dict[str, Any], tmp_path: Path) -> None:
    """The buffer keeps what the environment gave, updates see it normalised; statistics are saved and loaded."""
    env = VecNormalize(vec_env(2))
    model = vector_model(env, gamma=0.0, learning_rate=0.0, **extras).learn(60)
    buffer: Any = model.replay_buffer
    stored = buffer.rewards[: buffer.pos]
    assert (stored >= 0).all() and (stored <= 1).all() and np.abs(buffer.observations[: buffer.pos]).max() <= 1
    np.random.seed(5)
    batch = buffer.sample(8, env)
    np.random.seed(5)
    model.set_logger(configure(None, []))
    model.train(1, 8)
    with th.no_grad():  # without a future the rewards are the targets
        values = model.critic(model.policy.encode(batch.observations), batch.actions).squeeze(2)
        expected = 0.5 * (values - batch.rewards).square().mean(dim=0).sum()
    assert model.logger.name_to_value["train/critic_loss"] == pytest.approx(expected.item(), rel=1e-4)
    model.save(tmp_path / "model")
    env.save(str(tmp_path / "statistics"))
    loaded = CuReSAC.load(tmp_path / "model", env=VecNormalize.load(str(tmp_path / "statistics"), vec_env(2)))
    assert loaded.get_vec_normalize_env().ret_rms.var == env.ret_rms.var
    assert loaded.learn(20, reset_num_timesteps=False).num_timesteps == 80


# ---------------------------------------------------------- replay buffers


class Counting(ReplayBuffer):
    """It counts what it gives."""

    def __init__(self, *args: Any, start: int = 0, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.given = start

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> Any:
        self.given += batch_size
        return super().sample(batch_size, env)


@both_modes
def test_replay_buffer_of_a_users_class(extras: dict[str, Any], tmp_path: Path) -> None:
    """It is used with its arguments, and a loaded model has one if it is given the class."""
    arguments: dict[str, Any] = dict(replay_buffer_class=Counting, replay_buffer_kwargs={"start": 100})
    model = vector_model(**arguments, **extras).learn(30)
    assert model.replay_buffer.given == 100 + 8 * 20
    model.save(tmp_path / "model")
    loaded = CuReSAC.load(tmp_path / "model", env=vec_env(), custom_objects={"replay_buffer_class": Counting})
    assert type(loaded.replay_buffer) is Counting and loaded.learn(15).replay_buffer.given == 100 + 8 * 5


@both_modes
def test_frame_stack_buffer_changes_only_memory(extras: dict[str, Any]) -> None:
    """A run with it ends with the bits of a run with SB3's buffer, over resets and in several environments."""
    states = []
    for buffer_class in (FrameStackReplayBuffer, ReplayBuffer):
        chosen = {} if buffer_class is FrameStackReplayBuffer else dict(replay_buffer_class=buffer_class)
        env = vec_env(2, PixelBox, channels_last=True, episode_length=9)
        model = tiny_model("CnnPolicy", env, buffer_size=40, **chosen, **extras).learn(60)
        assert type(model.replay_buffer) is buffer_class
        states.append(state_of(model))
    assert differences(*states) == []


@both_modes
def test_stored_replay_buffer_trains_another_model(extras: dict[str, Any]) -> None:
    """Offline, without a step of an environment; loaded, it samples on the model's device."""
    file = io.BytesIO()
    collector = tiny_model("CnnPolicy", PixelBox(), gradient_steps=0, **extras).learn(40)
    collector.save_replay_buffer(file)
    file.seek(0)
    model = tiny_model("CnnPolicy", PixelBox(), **extras)
    model.load_replay_buffer(file)
    np.testing.assert_array_equal(model.replay_buffer.rewards, collector.replay_buffer.rewards)
    model.set_logger(configure(None, []))
    before = state_of(model)
    model.train(gradient_steps=5, batch_size=8)
    assert (model._n_updates, model.num_timesteps) == (5, 0) and differences(before, state_of(model))
    model.device = th.device("meta")  # any machine has it
    file.seek(0)
    model.load_replay_buffer(file)
    assert model.replay_buffer.sample(4).actions.device.type == "meta"


@both_modes
@pytest.mark.parametrize("buffer_class", [HerReplayBuffer, DictReplayBuffer])
def test_dictionaries_with_buffers_of_sb3(extras: dict[str, Any], buffer_class: Any, tmp_path: Path) -> None:
    """Hindsight included; the loaded model continues."""
    more: dict[str, Any] = dict(learning_starts=20)
    if buffer_class is HerReplayBuffer:
        more |= dict(replay_buffer_kwargs=dict(n_sampled_goal=2, goal_selection_strategy="future"))
    env = vec_env(2, Goal)
    model = tiny_model("MultiInputPolicy", env, replay_buffer_class=buffer_class, **more, **extras).learn(60)
    assert type(model.replay_buffer) is buffer_class and model._n_updates > 0
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = CuReSAC.load(tmp_path / "model", env=env)
    loaded.load_replay_buffer(tmp_path / "buffer", trusted=True)
    assert type(loaded.replay_buffer) is buffer_class
    assert loaded.learn(40, reset_num_timesteps=False).num_timesteps == 100


@pytest.mark.parametrize("n_steps", [30, 35], ids=["between episodes", "within one"])
def test_hindsight_after_pretraining(n_steps: int) -> None:
    """Nothing that was collected in pretraining is learned from: ``HerReplayBuffer.reset`` would keep its episodes."""
    her: dict[str, Any] = dict(replay_buffer_class=HerReplayBuffer, buffer_size=100, learning_starts=10)
    model: Any = tiny_model("MultiInputPolicy", Goal(), **her).pretrain(n_steps)
    buffer = model.replay_buffer
    buffer.observations["observation"][:] = 7  # wherever it lies
    model.learn(40)
    assert buffer.pos == np.sum(buffer.ep_length > 0) == 40
    assert buffer.sample(200).observations["observation"].max() <= 1


def test_hindsight_after_pretraining_that_keeps_its_transitions() -> None:
    """The episode that pretraining broke off does not go on with the task's first one, of another goal."""
    her: dict[str, Any] = dict(replay_buffer_class=HerReplayBuffer, buffer_size=100, learning_starts=10)
    model: Any = tiny_model("MultiInputPolicy", Goal(), **her).pretrain(35, keep_replay_buffer=True).learn(30)
    assert model.replay_buffer.pos == 65 and model.replay_buffer.ep_length.max() == 10


def test_hindsight_stays_within_an_episode() -> None:
    """Where ``learn`` resets the environments in the middle of one, no goal comes from the next; rewards of other goals
    are those of the environment that was set."""

    class Scaled(Goal):
        def compute_reward(self, achieved: np.ndarray, desired: np.ndarray, info: Any) -> np.ndarray:
            return super().compute_reward(achieved, desired, info) + 7 * (achieved.ndim > 1)  # not in `step`

    model: Any = tiny_model("MultiInputPolicy", Goal(), replay_buffer_class=HerReplayBuffer, buffer_size=100)
    model.learn(18).learn(50, callback=lambda local, _: local["self"].num_timesteps < 6)
    model.learn(5, reset_num_timesteps=False)
    model.set_env(Scaled())
    model.learn(20, reset_num_timesteps=False)
    assert model.replay_buffer.ep_length.max() == 10
    assert (model.replay_buffer.sample(100).rewards > 5).any()


# ------------------------------------------------------ parameters and files


@both_modes
def test_parameters(extras: dict[str, Any]) -> None:
    """Whole, they give the old actions and optimisers back; a part may be set alone if that is said."""
    model, observations = vector_model(**extras).learn(20), np.random.default_rng(0).uniform(-1, 1, (5, 2))
    saved = copy.deepcopy(model.get_parameters())
    actions, _ = model.predict(observations, deterministic=True)
    model.learn(20)
    assert not np.array_equal(actions, model.predict(observations, deterministic=True)[0])
    model.set_parameters(saved)
    np.testing.assert_array_equal(actions, model.predict(observations, deterministic=True)[0])
    assert differences(saved, model.get_parameters()) == []
    other = vector_model(seed=9, **extras)
    other.set_parameters(saved)
    other.learn(20)  # moves nothing of the first, not even counts of optimisers
    assert differences(saved, model.get_parameters()) == []

    with pytest.raises(ValueError, match="invalid object name"):
        model.set_parameters({**saved, "no_such_net": {}})
    for name in saved:
        with pytest.raises(ValueError, match="do not match"):
            model.set_parameters({key: value for key, value in saved.items() if key != name})
    key = "task.actor.mu.weight"
    part = {"policy": {key: th.full_like(saved["policy"][key], 0.125)}}
    before = state_of(model)
    model.set_parameters(part, exact_match=False)
    assert differences(before, state_of(model)) == [f".policy.{key}"]


@both_modes
def test_save_and_load(extras: dict[str, Any]) -> None:
    """In memory and on the device that is asked for, which is the CPU without CUDA; arguments can be replaced."""
    model = vector_model(**extras).learn(15)
    archive = io.BytesIO()
    model.save(archive)
    for device in ("cpu", "auto"):
        archive.seek(0)
        loaded = CuReSAC.load(archive, env=vec_env(), device=device, gamma=0.5)
        assert (loaded.gamma, loaded.num_timesteps, loaded.device) == (0.5, 15, loaded.policy.device)
        assert device == "auto" or differences(state_of(model), state_of(loaded)) == []
        loaded.learn(15)


@both_modes
@pytest.mark.parametrize("policy, env", [("MlpPolicy", VectorBox), ("CnnPolicy", PixelBox)])
def test_policy_alone_is_saved_and_loaded(extras: dict[str, Any], policy: str, env: Any, tmp_path: Path) -> None:
    model = tiny_model(policy, env(), **extras).learn(12)
    model.policy.save(tmp_path / "policy")
    loaded = type(model.policy).load(tmp_path / "policy")
    observation, _ = env().reset(seed=0)
    actions = [each.predict(observation, deterministic=True)[0] for each in (model, loaded)]
    np.testing.assert_array_equal(*actions)


@pytest.mark.parametrize("srl", ["rae", "curl"])
def test_pixels_of_dm_control(srl: str, tmp_path: Path) -> None:
    """Trained, saved, loaded, trained on: on a real task, with whichever versions are installed."""
    env = make_dmc_env("cartpole", "swingup", image_size=36, action_repeat=100, renderer="fast", seed=0)
    model = tiny_model("CnnPolicy", env, srl=srl).learn(25)
    model.save(tmp_path / "model")
    loaded = CuReSAC.load(tmp_path / "model", env=env)
    observation, _ = env.reset(seed=1)
    for ours, theirs in ((model.predict, loaded.predict), (model.predict_curious, loaded.predict_curious)):
        np.testing.assert_array_equal(
            ours(observation, deterministic=True)[0], theirs(observation, deterministic=True)[0]
        )
    assert loaded.learn(12, reset_num_timesteps=False).num_timesteps == 37
    env.close()
