"""Where CuReSAC stands in for SB3's SAC: the same habits, on the plain path and with the shared encoder.

Most tests do the same with three agents: SB3's own SAC, CuReSAC with everything off, and CuReSAC as it comes.
"""

import copy
import warnings
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
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    CheckpointCallback,
    EvalCallback,
    EveryNTimesteps,
    ProgressBarCallback,
    StopTrainingOnMaxEpisodes,
    StopTrainingOnRewardThreshold,
)
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import NormalActionNoise, VectorizedActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize

from sb3_cure import CuReSAC, make_dmc_env
from sb3_cure.data.buffers import FrameStackReplayBuffer

PLAIN: dict[str, Any] = {"srl": None, "curiosity": None}
AGENTS = pytest.mark.parametrize("agent", ["sac", "plain", "cure"])
OURS = pytest.mark.parametrize("agent", ["plain", "cure"])


def vectors(n_envs: int = 1, **kwargs: Any) -> VecEnv:
    return DummyVecEnv([lambda: Monitor(VectorBox(**kwargs))] * n_envs)


def agent_of(agent: str, env: Any, **kwargs: Any) -> SAC:
    """The same settings for each: 10 random steps, then an update per step on batches of 8."""
    if agent != "sac":
        return tiny_model("MlpPolicy", env, **{**(PLAIN if agent == "plain" else {}), **kwargs})
    defaults: dict[str, Any] = dict(
        learning_starts=10, batch_size=8, buffer_size=500, gradient_steps=-1, learning_rate=1e-3, seed=0, device="cpu"
    )
    return SAC("MlpPolicy", env, policy_kwargs={"net_arch": [16]}, **{**defaults, **kwargs})


class Rooms(gym.ObservationWrapper):
    """Tells only in which of two rooms the agent is."""

    def __init__(self) -> None:
        super().__init__(VectorBox())
        self.observation_space = spaces.Discrete(2)

    def observation(self, observation: np.ndarray) -> Any:
        return np.int64(observation[0] > 0)


@AGENTS
def test_discrete_observations(agent: str) -> None:
    """They are stored as numbers and seen one-hot."""
    model = agent_of(agent, DummyVecEnv([Rooms])).learn(20)
    assert set(np.unique(model.replay_buffer.observations[:20])) <= {0, 1}
    assert model.predict(np.int64(1))[0].shape == (2,)


# ------------------------------------------------------------------------------ callbacks


@AGENTS
def test_callbacks(agent: str, tmp_path: Path) -> None:
    """SB3's own: what they write, how often they act, and when they stop, is the same for each agent."""
    calls: list[int] = []

    class Count(BaseCallback):
        def _on_step(self) -> bool:
            calls.append(self.num_timesteps)
            return True

    best = StopTrainingOnRewardThreshold(reward_threshold=-1.0)  # rewards are in [0, 1]
    callbacks = CallbackList(
        [
            CheckpointCallback(20, str(tmp_path), save_replay_buffer=True),
            EveryNTimesteps(15, Count()),
            EvalCallback(vectors(), best, n_eval_episodes=1, eval_freq=50, log_path=str(tmp_path), verbose=0),
        ]
    )
    model = agent_of(agent, vectors()).learn(1000, callback=callbacks)
    assert model.num_timesteps == 50  # where the threshold stopped it
    assert calls == [15, 30, 45]
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {
        *(f"rl_model_{n}_steps.zip" for n in (20, 40)),
        *(f"rl_model_replay_buffer_{n}_steps.pkl" for n in (20, 40)),
        "evaluations.npz",
    }
    assert np.load(tmp_path / "evaluations.npz")["timesteps"].tolist() == [50]


@AGENTS
def test_stopping_after_episodes(agent: str) -> None:
    """A stop in the middle of ``learn`` leaves a model that goes on."""
    model = agent_of(agent, vectors()).learn(1000, callback=StopTrainingOnMaxEpisodes(2))
    assert model.num_timesteps == 40
    assert model.learn(20, reset_num_timesteps=False).num_timesteps == 60


@AGENTS
def test_progress_bar(agent: str) -> None:
    """Of tqdm and rich, as a callback and as an argument."""
    pytest.importorskip("tqdm.rich")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model = agent_of(agent, vectors()).learn(12, callback=ProgressBarCallback())
        assert model.learn(12, progress_bar=True).num_timesteps == 12


@AGENTS
def test_a_function_as_callback(agent: str) -> None:
    """It gets the local variables of the loop, in which SB3's own names are."""
    seen = []

    def look(local: dict[str, Any], _: dict[str, Any]) -> bool:
        seen.append({"rewards", "infos", "dones"} <= local.keys())
        return len(seen) < 12

    assert agent_of(agent, vectors()).learn(100, callback=look).num_timesteps == 12
    assert all(seen)


# --------------------------------------------------------------------------- VecNormalize


@AGENTS
def test_normalised_rewards(agent: str, tmp_path: Path) -> None:
    """The buffer keeps rewards as they are, updates see them divided, statistics survive saving."""
    env = VecNormalize(vectors(2), norm_obs=False, norm_reward=True)
    model = agent_of(agent, env).learn(60)
    assert model.get_vec_normalize_env() is env
    buffer = model.replay_buffer
    stored = buffer.rewards[: buffer.pos]
    assert 0 <= stored.min() and stored.max() <= 1  # those of the environment
    np.random.seed(1)
    raw = buffer.sample(32).rewards
    np.random.seed(1)
    normalised = buffer.sample(32, env=model._vec_normalize_env).rewards
    scale = np.sqrt(env.ret_rms.var + env.epsilon)
    np.testing.assert_allclose(normalised, raw / scale, rtol=1e-5)
    assert abs(scale - 1) > 0.05
    model.save(tmp_path / "model")
    env.save(str(tmp_path / "statistics.pkl"))
    again = VecNormalize.load(str(tmp_path / "statistics.pkl"), vectors(2))
    loaded = type(model).load(tmp_path / "model", env=again)
    assert loaded.get_vec_normalize_env().ret_rms.var == env.ret_rms.var
    assert loaded.learn(20, reset_num_timesteps=False).num_timesteps == 80


@pytest.mark.parametrize("update", ["joint", "sequential"])
def test_normalised_rewards_are_the_tasks_alone(update: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The task agent is trained on the divided reward, the curious one on the SRL error of the same batch."""
    env = VecNormalize(DummyVecEnv([PixelBox]), norm_obs=False, norm_reward=True)
    model = tiny_model("CnnPolicy", env, update=update).learn(20)
    seen: dict[str, Any] = {}
    update_actor_critic, update_intrinsic = CuReSAC._update_actor_critic, CuReSAC._update_intrinsic

    def watch_update(self: CuReSAC, name: str, batch: Any, rewards: Any, *rest: Any) -> None:
        seen[name] = rewards.clone()
        update_actor_critic(self, name, batch, rewards, *rest)

    def watch_reward(self: CuReSAC, *arguments: Any) -> th.Tensor:
        seen["reward"] = update_intrinsic(self, *arguments)
        return seen["reward"]

    monkeypatch.setattr(CuReSAC, "_update_actor_critic", watch_update)
    monkeypatch.setattr(CuReSAC, "_update_intrinsic", watch_reward)
    np.random.seed(5)
    raw = model.replay_buffer.sample(8).rewards
    np.random.seed(5)
    model.train(1, 8)
    scale = float(np.sqrt(env.ret_rms.var + env.epsilon))
    th.testing.assert_close(seen["task"], (raw / scale).clamp(-10, 10))
    assert th.equal(seen["curious"], seen["reward"])


# -------------------------------------------------------------- dictionaries, replay buffers


class Goal(gym.Env):
    """A dot that is to come near to a goal, as ``HerReplayBuffer`` wants it."""

    def __init__(self) -> None:
        box = spaces.Box(-1, 1, (2,), np.float32)
        self.observation_space = spaces.Dict(observation=box, achieved_goal=box, desired_goal=box)
        self.action_space = spaces.Box(-1, 1, (2,), np.float32)

    def observe(self) -> dict[str, np.ndarray]:
        place = self.place.astype(np.float32)
        return {"observation": place, "achieved_goal": place, "desired_goal": self.goal}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict]:
        super().reset(seed=seed)
        self.place, self.n = np.zeros(2), 0
        self.goal = self.np_random.uniform(-1, 1, 2).astype(np.float32)
        return self.observe(), {}

    def compute_reward(self, achieved: np.ndarray, desired: np.ndarray, info: Any) -> np.ndarray:
        return -(np.linalg.norm(achieved - desired, axis=-1) > 0.2).astype(np.float32)

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict]:
        self.place = np.clip(self.place + 0.3 * action, -1, 1)
        self.n += 1
        reward = float(self.compute_reward(self.place, self.goal, None))
        return self.observe(), reward, False, self.n >= 10, {}


@pytest.mark.parametrize("hindsight", [False, True])
def test_dictionaries_without_extras_are_sacs(hindsight: bool) -> None:
    """With and without hindsight, bit for bit."""
    kwargs: dict[str, Any] = dict(
        learning_starts=12, batch_size=8, buffer_size=200, seed=3, device="cpu", policy_kwargs={"net_arch": [16]},
        learning_rate=1e-3, tau=0.01, ent_coef="auto_0.1", gradient_steps=1, target_update_interval=1,
    )  # fmt: skip
    if hindsight:
        kwargs["replay_buffer_class"] = HerReplayBuffer
        kwargs["replay_buffer_kwargs"] = {"n_sampled_goal": 2, "goal_selection_strategy": "future"}
    theirs = SAC("MultiInputPolicy", Goal(), **kwargs).learn(60)
    ours = CuReSAC("MultiInputPolicy", Goal(), **PLAIN, **kwargs).learn(60)
    assert type(ours.replay_buffer) is type(theirs.replay_buffer)
    assert differences(state_of(ours), state_of(theirs)) == []


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


class Counting(ReplayBuffer):
    """It counts what it gives."""

    def __init__(self, *args: Any, start: int = 0, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.given = start

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> Any:
        self.given += batch_size
        return super().sample(batch_size, env)


@AGENTS
@pytest.mark.parametrize("kind", [ReplayBuffer, Counting])
def test_other_replay_buffers(agent: str, kind: type[ReplayBuffer], tmp_path: Path) -> None:
    """They are used, with their arguments, and survive."""
    kwargs = {"start": 100} if kind is Counting else {}
    model = agent_of(agent, vectors(), replay_buffer_class=kind, replay_buffer_kwargs=kwargs).learn(30)
    assert type(model.replay_buffer) is kind
    if kind is Counting:
        assert model.replay_buffer.given == 100 + 8 * model._n_updates > 100
    model.save(tmp_path / "model")
    # A class of one's own is not in the file.
    loaded = type(model).load(tmp_path / "model", env=vectors(), custom_objects={"replay_buffer_class": kind})
    assert type(loaded.replay_buffer) is kind


def test_a_chosen_buffer_beats_the_one_for_stacked_frames() -> None:
    """And gives the same batches."""
    models = [tiny_model("CnnPolicy", PixelBox(), replay_buffer_class=kind).learn(15) for kind in (None, ReplayBuffer)]
    assert [type(model.replay_buffer) for model in models] == [FrameStackReplayBuffer, ReplayBuffer]
    assert differences(state_of(models[0]), state_of(models[1])) == []


@OURS
def test_n_step_returns(agent: str) -> None:
    """Of the task, beside curiosity; with everything off they are SB3's."""
    assert agent_of(agent, vectors(), n_steps=3).learn(40)._n_updates > 0
    model = agent_of(agent, vectors(), n_steps=3, srl=None, curiosity=None).learn(40)
    assert type(model.replay_buffer) is NStepReplayBuffer
    assert model.replay_buffer.n_steps == 3 and model.replay_buffer.gamma == model.gamma
    assert model.replay_buffer.sample(8).discounts is not None


# --------------------------------------------------------------- parameters, environments


@OURS
def test_models_of_the_same_parameters_go_their_own_ways(agent: str) -> None:
    """What one learns moves nothing of the other, the optimisers' counts among it."""
    first, second = agent_of(agent, vectors()).learn(30), agent_of(agent, vectors(), seed=9)
    second.set_parameters(first.get_parameters())
    before = copy.deepcopy(first.get_parameters())
    second.learn(30)
    assert differences(first.get_parameters(), before) == []


@AGENTS
def test_set_parameters(agent: str, tmp_path: Path) -> None:
    """From a dictionary, from an archive, and part of them."""
    trained = agent_of(agent, vectors()).learn(30)
    trained.save(tmp_path / "model.zip")
    for source in (trained.get_parameters(), tmp_path / "model.zip"):
        fresh = agent_of(agent, vectors(), seed=9)
        fresh.set_parameters(source)
        assert differences(fresh.get_parameters(), trained.get_parameters()) == []
    part = {"policy": trained.get_parameters()["policy"]}
    fresh = agent_of(agent, vectors(), seed=9)
    with pytest.raises(ValueError, match=r"do not match|Names of parameters"):
        fresh.set_parameters(part)
    fresh = agent_of(agent, vectors(), seed=9)
    before = state_of(fresh)
    fresh.set_parameters(part, exact_match=False)
    after = state_of(fresh)
    assert differences(after["policy"], part["policy"]) == []
    assert {d.split(".")[1] for d in differences(before, after)} == {"policy"}
    with pytest.raises(ValueError, match="not_there"):
        fresh.set_parameters({"not_there": {}}, exact_match=False)


@AGENTS
def test_set_env(agent: str) -> None:
    """An environment of the same kind is taken, with the last observation forgotten; another number is refused."""
    model = agent_of(agent, vectors()).learn(15)
    other = vectors(episode_length=7)
    model.set_env(other)
    assert model.get_env() is other and model._last_obs is None
    model.learn(15, reset_num_timesteps=False)
    assert model.num_timesteps == 30
    with pytest.raises(AssertionError, match=r"number of environments to be set is different.*2 != 1"):
        model.set_env(vectors(2))
    with pytest.raises(ValueError, match="Observation spaces do not match"):
        model.set_env(PixelBox())
    assert model.get_env() is other


@AGENTS
def test_learning_twice(agent: str, tmp_path: Path) -> None:
    """Counters and schedules start anew or go on; the logger that was set stays."""
    seen: list[float] = []

    def schedule(remaining: float) -> float:
        seen.append(remaining)
        return 1e-3 * remaining

    model = agent_of(agent, vectors(), learning_rate=schedule)
    logger = configure(str(tmp_path), ["csv"])
    model.set_logger(logger)
    model.learn(40, log_interval=1)
    assert model.logger is logger and (tmp_path / "progress.csv").stat().st_size > 0
    assert min(seen) == 0.0
    seen.clear()
    model.learn(40, reset_num_timesteps=False)
    assert model.num_timesteps == 80 and model._total_timesteps == 80 and max(seen) <= 0.5
    updates = model._n_updates
    assert updates == 70
    model.learn(40)
    assert model.num_timesteps == 40 and model._n_updates == updates + 30


@AGENTS
def test_training_by_episodes(agent: str) -> None:
    """As many updates as the episode had steps; several environments are refused, by us when the model is made."""
    model = agent_of(agent, vectors(), train_freq=(1, "episode"), learning_starts=0).learn(40)
    assert model.num_timesteps == 40 and model._n_updates == 40
    with pytest.raises((ValueError, AssertionError), match=r"episod"):
        agent_of(agent, vectors(2), train_freq=(1, "episode")).learn(10)


@AGENTS
def test_action_noise(agent: str) -> None:
    """Of one and of two environments; actions stay in their bounds."""
    noise = NormalActionNoise(np.zeros(2), np.full(2, 5.0))
    for n_envs in (1, 2):
        model = agent_of(agent, vectors(n_envs), action_noise=noise, learning_starts=0).learn(40)
        actions = model.replay_buffer.actions[: model.replay_buffer.pos]
        assert np.abs(actions).max() <= 1 and (np.abs(actions) == 1).mean() > 0.5
    assert isinstance(model.action_noise, VectorizedActionNoise)


# ----------------------------------------------------------------- archives, devices, others


@AGENTS
def test_custom_objects(agent: str, tmp_path: Path) -> None:
    """They replace what was saved; those that nobody needs are ignored, as rl-zoo gives some."""
    agent_of(agent, vectors(), learning_rate=lambda remaining: remaining).save(tmp_path / "model")
    objects = {"learning_rate": 0.0, "lr_schedule": lambda _: 0.0, "clip_range": lambda _: 0.2}
    cls = SAC if agent == "sac" else CuReSAC
    loaded = cls.load(tmp_path / "model", env=vectors(), custom_objects=objects)
    before = state_of(loaded)["policy"]
    loaded.learn(20)
    # Targets move towards networks that stay, and running statistics run.
    moving = [
        name for name in differences(before, state_of(loaded)["policy"]) if not ("target" in name or ".scale." in name)
    ]
    assert moving == []


@AGENTS
def test_devices(agent: str, tmp_path: Path) -> None:
    """``device=`` of load; where there is no CUDA it is the CPU, as in SB3."""
    model = agent_of(agent, vectors()).learn(15)
    model.policy.to("cpu")
    model.save(tmp_path / "model")
    observation = VectorBox().reset(seed=0)[0]
    action, _ = model.predict(observation, deterministic=True)
    for device in ["cpu"] if th.cuda.is_available() else ["cpu", "cuda"]:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # CuReSAC tells
            loaded = type(model).load(tmp_path / "model", env=vectors(), device=device)
        assert loaded.device.type == "cpu"
        np.testing.assert_array_equal(loaded.predict(observation, deterministic=True)[0], action)
        loaded.learn(15)


@pytest.mark.skipif(not th.cuda.is_available(), reason="needs a GPU")
@AGENTS
def test_from_gpu_to_cpu_and_back(agent: str, tmp_path: Path) -> None:
    """Trained on one, loaded on the other, trained on."""
    observation = VectorBox().reset(seed=0)[0]
    for device, other in (("cuda", "cpu"), ("cpu", "cuda")):
        model = agent_of(agent, vectors(), device=device).learn(20)
        model.save(tmp_path / "model")
        loaded = type(model).load(tmp_path / "model", env=vectors(), device=other)
        actions = [each.predict(observation, deterministic=True)[0] for each in (model, loaded)]
        np.testing.assert_allclose(*actions, atol=1e-5)
        assert next(loaded.policy.parameters()).device.type == other
        assert loaded.learn(20, reset_num_timesteps=False).num_timesteps == 40


def test_gsde_without_extras_is_sacs() -> None:
    """Bit for bit."""
    kwargs: dict[str, Any] = dict(
        use_sde=True, sde_sample_freq=4, use_sde_at_warmup=True, learning_rate=1e-3, tau=0.01, ent_coef="auto_0.1",
        gradient_steps=1, target_update_interval=1,
    )  # fmt: skip
    theirs, ours = (agent_of(agent, vectors(), **kwargs).learn(40) for agent in ("sac", "plain"))
    assert differences(state_of(ours), state_of(theirs)) == []


def test_other_algorithms_are_untouched() -> None:
    """sb3-contrib's, on our environments, in the same process."""
    model = TQC("MlpPolicy", vectors(), learning_starts=5, policy_kwargs={"net_arch": [8]}, device="cpu").learn(12)
    returns, _ = evaluate_policy(model, vectors(), n_eval_episodes=1)
    assert 0 <= returns <= 20


@pytest.mark.parametrize("srl", ["rae", "curl"])
def test_pixels_of_dm_control(srl: str, tmp_path: Path) -> None:
    """Trained, saved, loaded, trained on: on a real task, with whichever versions are installed."""
    env = make_dmc_env("cartpole", "swingup", image_size=36, action_repeat=100, renderer="fast", seed=0)
    model = tiny_model("CnnPolicy", env, srl=srl).learn(25)
    assert type(model.replay_buffer) is FrameStackReplayBuffer and model._n_updates == 15
    model.save(tmp_path / "model")
    loaded = CuReSAC.load(tmp_path / "model", env=env)
    observation, _ = env.reset(seed=1)
    for ours, theirs in ((model.predict, loaded.predict), (model.predict_curious, loaded.predict_curious)):
        np.testing.assert_array_equal(
            ours(observation, deterministic=True)[0], theirs(observation, deterministic=True)[0]
        )
    assert loaded.learn(12, reset_num_timesteps=False).num_timesteps == 37
    env.close()
