"""What cannot work is refused in one sentence: the value, what was expected, what to do instead."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import stable_baselines3.sac.policies as sb3_policies
from envs_for_tests import PixelBox, VectorBox, tiny_model
from gymnasium import spaces
from stable_baselines3.common.torch_layers import NatureCNN
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_cure import CuReSAC
from sb3_cure.srl import RAE, SRLOutput

IMAGE = spaces.Box(0, 255, (3, 36, 36), np.uint8)
VECTOR = spaces.Box(-1, 1, (3,), np.float32)
ACTION = spaces.Box(-1, 1, (2,), np.float32)


class FakeEnv(gym.Env):
    """An environment of given spaces; its observations are noise."""

    def __init__(self, observation_space: spaces.Space = IMAGE, action_space: spaces.Space = ACTION):
        self.observation_space = observation_space
        self.action_space = action_space

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict]:
        super().reset(seed=seed)
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict]:
        return self.observation_space.sample(), 0.0, False, False, {}


class FourFrames(FakeEnv):
    """It says that its observations stack 4 frames."""

    frame_stack = 4


def images(*shape: int, dtype: Any = np.uint8, high: float = 255) -> FakeEnv:
    return FakeEnv(spaces.Box(0, high, shape, dtype))


def actions(space: spaces.Space) -> FakeEnv:
    return FakeEnv(action_space=space)


def test_the_environments_of_this_file_are_accepted() -> None:
    """Every refusal below is for its one reason."""
    CuReSAC("CnnPolicy", FakeEnv(), buffer_size=10)
    CuReSAC("MlpPolicy", FakeEnv(VECTOR), buffer_size=10)


#: name -> (policy, environment, arguments, the sentence)
CONSTRUCTOR: dict[str, tuple[Any, gym.Env | Callable[[], Any], dict[str, Any], str]] = {
    # --- SRL
    "unknown srl": (
        "CnnPolicy",
        FakeEnv(),
        {"srl": "vae"},
        r"srl is 'vae', but it must be one of 'rae', 'curl', None, or a subclass of sb3_cure\.srl\.SRLHead",
    ),
    "srl of another class": (
        "CnnPolicy",
        FakeEnv(),
        {"srl": dict},
        r"srl is <class 'dict'>, but .*'rae', 'curl', None",
    ),
    "curl on vectors": (
        "MlpPolicy",
        FakeEnv(VECTOR),
        {"srl": "curl"},
        r"srl='curl' got observations Box\(.*but it learns from two crops of one image and vectors have none: use "
        "srl='rae'",
    ),
    "curl crop too large": (
        "CnnPolicy",
        FakeEnv(),
        {"srl": "curl", "srl_kwargs": {"augmentation": "crop"}},
        r"augmentation='crop' with crop_size=84 for observations of 36 pixels, but crops must .*smaller than the "
        "observation: render larger .*, set another crop_size, or use augmentation='shift'",
    ),
    "curl crop of all": (
        "CnnPolicy",
        FakeEnv(),
        {"srl": "curl", "srl_kwargs": {"augmentation": "crop", "crop_size": 36}},
        "crop_size=36 for observations of 36 pixels, but crops must .*smaller than the observation: render larger",
    ),
    "curl crop of nothing": (
        "CnnPolicy",
        FakeEnv(),
        {"srl": "curl", "srl_kwargs": {"crop_size": 0}},
        "crop_size=0 .*crops must have at least 1 pixel .*: .*set another crop_size",
    ),
    "curl augmentation": (
        "CnnPolicy",
        FakeEnv(),
        {"srl": "curl", "srl_kwargs": {"augmentation": "flip"}},
        "augmentation='flip', but srl='curl' knows 'crop', 'shift' and 'auto': choose one",
    ),
    "curl bank": (
        "CnnPolicy",
        FakeEnv(),
        {"srl": "curl", "srl_kwargs": {"bank_size": 0}},
        "bank_size=0, but each must be at least 1: change srl_kwargs",
    ),
    "rae augmentation": (
        "CnnPolicy",
        FakeEnv(),
        {"srl_kwargs": {"augmentation": "crop"}},
        "augmentation='crop' for .*but srl='rae' knows 'none', and for images 'shift': choose one",
    ),
    "rae shifts of vectors": (
        "MlpPolicy",
        FakeEnv(VECTOR),
        {"srl_kwargs": {"augmentation": "shift"}},
        r"augmentation='shift' for observations of shape \(3,\), but srl='rae' knows 'none', and for images 'shift'",
    ),
    "rae pad": (
        "CnnPolicy",
        FakeEnv(),
        {"srl_kwargs": {"pad": 0}},
        "pad=0, but a shift needs at least 1 pixel: change",
    ),
    "rae bits": ("CnnPolicy", FakeEnv(), {"srl_kwargs": {"bits": 9}}, "bits=9, but a pixel has 8: give .* from 1 to 8"),
    "rae penalty": (
        "CnnPolicy",
        FakeEnv(),
        {"srl_kwargs": {"latent_penalty": -1.0}},
        r"latent_penalty=-1\.0 .*, but both are penalties: give numbers >= 0",
    ),
    "srl_schedule": (
        "CnnPolicy",
        FakeEnv(),
        {"srl_schedule": "random"},
        "srl_schedule is 'random', but it must be one of 'simultaneous', 'alternating': choose",
    ),
    "srl_period": ("CnnPolicy", FakeEnv(), {"srl_period": 0}, "srl_period is 0, but .* at least 1: change srl_period"),
    # --- curiosity
    "curiosity without srl": (
        "CnnPolicy",
        FakeEnv(),
        {"srl": None},
        "curiosity='separate' was given with srl=None, but the curious reward is the SRL error: choose srl='rae', .* "
        "or set curiosity=None",
    ),
    "bonus without srl": ("CnnPolicy", FakeEnv(), {"srl": None, "curiosity": "bonus"}, "curiosity='bonus' .*srl=None"),
    "curiosity": (
        "CnnPolicy",
        FakeEnv(),
        {"curiosity": True},
        "curiosity is True, but it must be one of 'separate', 'bonus', 'random', None: choose one",
    ),
    "curiosity_prob": (
        "CnnPolicy",
        FakeEnv(),
        {"curiosity_prob": 1.2},
        r"curiosity_prob is 1\.2 .*, but it is the probability .*: give a number, or a schedule, within \[0, 1\]",
    ),
    "curiosity_prob schedule": (
        "CnnPolicy",
        FakeEnv(),
        {"curiosity_prob": lambda remaining: -remaining},
        r"curiosity_prob is -1\.0 \(progress remaining 1\.00\), but .*a schedule, within \[0, 1\]",
    ),
    "curiosity_prob no number": (
        "CnnPolicy",
        FakeEnv(),
        {"curiosity_prob": "often"},
        r"curiosity_prob is 'often' .*: give a number, or a schedule, within \[0, 1\]",
    ),
    "curiosity_gamma": (
        "CnnPolicy",
        FakeEnv(),
        {"curiosity_gamma": 0},
        "curiosity_gamma=0 was given with curiosity_target='observation', but .* does not depend on the action.*: set "
        "curiosity_target='next_observation', or a curiosity_gamma > 0",
    ),
    "curiosity_gamma range": (
        "CnnPolicy",
        FakeEnv(),
        {"curiosity_gamma": 1.01},
        r"curiosity_gamma is 1\.01, but it must be a number within \[0, 1\]: change curiosity_gamma",
    ),
    "curiosity_target": (
        "CnnPolicy",
        FakeEnv(),
        {"curiosity_target": "next"},
        "curiosity_target is 'next', but it must be one of 'observation', 'next_observation': choose",
    ),
    "negative beta": (
        "CnnPolicy",
        FakeEnv(),
        {"curiosity_beta": -1.0},
        r"curiosity_beta is -1\.0, but it must be a number of at least 0: change curiosity_beta",
    ),
    "infinite beta": ("CnnPolicy", FakeEnv(), {"curiosity_beta": np.inf}, "curiosity_beta is inf, but .* at least 0"),
    "nan beta": ("CnnPolicy", FakeEnv(), {"curiosity_beta": np.nan}, "curiosity_beta is nan, but .* at least 0"),
    "no task and no curiosity": (
        "CnnPolicy",
        FakeEnv(),
        {"task": False, "curiosity": None},
        "task=False was given with curiosity=None, but .* needs a curious policy: set curiosity='separate'",
    ),
    "no task and a bonus": (
        "CnnPolicy",
        FakeEnv(),
        {"task": False, "curiosity": "bonus"},
        "task=False was given with curiosity='bonus', but .*: set curiosity='separate'",
    ),
    "gSDE with curiosity": (
        "CnnPolicy",
        FakeEnv(),
        {"use_sde": True},
        "use_sde=True was given with srl='rae' and curiosity='separate', but gSDE.*: leave use_sde=False, or",
    ),
    "n-step with curiosity": (
        "CnnPolicy",
        FakeEnv(),
        {"n_steps": 3},
        "n_steps=3 was given with a curious policy .*, but .* for single transitions only: set n_steps=1",
    ),
    "n-step with a bonus": (
        "CnnPolicy",
        FakeEnv(),
        {"n_steps": 3, "curiosity": "bonus"},
        "n_steps=3 .*: set n_steps=1",
    ),
    # --- training
    "update": ("CnnPolicy", FakeEnv(), {"update": "both"}, "update is 'both', .* one of 'sequential', 'joint': choose"),
    "precision": (
        "CnnPolicy",
        FakeEnv(),
        {"precision": "fp16"},
        "precision is 'fp16', but it must be one of 'auto', 'fp32', 'bf16': choose one",
    ),
    "batch_size": ("CnnPolicy", FakeEnv(), {"batch_size": 0}, "batch_size is 0, .* at least 1: change batch_size"),
    "batch_size in halves": (
        "CnnPolicy",
        FakeEnv(),
        {"batch_size": 12.5},
        r"batch_size is 12\.5, but it must be a whole number of at least 1: change batch_size",
    ),
    "ent_coef of zero to learn": (
        "CnnPolicy",
        FakeEnv(),
        {"ent_coef": "auto_0"},
        "ent_coef is 'auto_0', but it must be 'auto', 'auto_<initial temperature > 0>'.*change ent_coef",
    ),
    "ent_coef without underscore": (
        "CnnPolicy",
        FakeEnv(),
        {"ent_coef": "auto0.5"},
        "ent_coef is 'auto0.5', but it must be 'auto', 'auto_<initial",
    ),
    "ent_coef without number": ("CnnPolicy", FakeEnv(), {"ent_coef": "auto_"}, "ent_coef is 'auto_', but it must be"),
    "task that is no boolean": ("CnnPolicy", FakeEnv(), {"task": None}, "task is None, but it must be True or False"),
    "overlap in words": ("CnnPolicy", FakeEnv(), {"overlap": "no"}, "overlap is 'no', but it must be True or False"),
    "frames on disk of an environment without frame_stack": (
        "CnnPolicy",
        FakeEnv(),
        {"replay_buffer_kwargs": {"frames_dir": "."}},
        r"frames_dir='\.', but the environment does not tell its frame_stack",
    ),
    "ent_coef in words": (
        "CnnPolicy",
        FakeEnv(),
        {"ent_coef": "low"},
        "ent_coef is 'low', but it must be 'auto', .* or a fixed number >= 0: change ent_coef",
    ),
    "srl_kwargs of no head": (
        "CnnPolicy",
        FakeEnv(),
        {"srl": None, "curiosity": None, "srl_kwargs": {"bits": 4}},
        r"srl_kwargs=\{'bits': 4\} was given with srl=None, .* or leave srl_kwargs out",
    ),
    "too small for NatureCNN": (
        "CnnPolicy",
        images(3, 24, 24),
        {"policy_kwargs": {"features_extractor_class": NatureCNN}},
        r"NatureCNN cannot read observations of shape \(3, 24, 24\) \(.*\): use a larger image_size, or another",
    ),
    "buffer_size": ("CnnPolicy", FakeEnv(), {"buffer_size": 0}, "buffer_size is 0, .* at least 1: change buffer_size"),
    "warmup_updates": ("CnnPolicy", FakeEnv(), {"warmup_updates": -1}, "warmup_updates is -1, .* at least 0: change"),
    "actor_update_interval": (
        "CnnPolicy",
        FakeEnv(),
        {"actor_update_interval": 0},
        "actor_update_interval is 0, .* at least 1: change actor_update_interval",
    ),
    "target_update_interval": (
        "CnnPolicy",
        FakeEnv(),
        {"target_update_interval": 0},
        "target_update_interval is 0, .* at least 1: change target_update_interval",
    ),
    "encoder_tau": (
        "CnnPolicy",
        FakeEnv(),
        {"encoder_tau": "0.05"},
        r"encoder_tau is '0\.05', but it must be a number within \[0, 1\]: change encoder_tau",
    ),
    # --- observations
    "floats in [0, 1]": (
        "CnnPolicy",
        images(3, 36, 36, dtype=np.float32, high=1),
        {},
        r"images arrive as float32 in \[0\.0, 1\.0\], but .* take uint8 in \[0, 255\]: give the environment's images",
    ),
    "floats in [0, 255]": (
        "CnnPolicy",
        images(3, 36, 36, dtype=np.float32),
        {},
        r"images arrive as float32 in \[0\.0, 255\.0\], but .* take uint8 in \[0, 255\]: give",
    ),
    "few grey levels": (
        "CnnPolicy",
        images(3, 36, 36, high=7),
        {},
        r"images arrive as uint8 in \[0, 7\], but .* take uint8 in \[0, 255\]: give",
    ),
    "normalised images": (
        "CnnPolicy",
        lambda: VecNormalize(DummyVecEnv([FakeEnv])),
        {},
        r"images arrive as float32 in \[-10\.0, 10\.0\], but .*VecNormalize with norm_obs=False",
    ),
    "dictionary": (
        "MultiInputPolicy",
        FakeEnv(spaces.Dict(camera=IMAGE, joints=VECTOR)),
        {},
        r"observations are Dict\(.*, but the shared encoder reads one image or one vector: pick one entry with a",
    ),
    "MultiInputPolicy without dictionary": (
        "MultiInputPolicy",
        FakeEnv(),
        {},
        r"policy is stable_baselines3\.\S+\.MultiInputPolicy, but .*: use 'CnnPolicy' or 'MlpPolicy'",
    ),
    "MlpPolicy on images": (
        "MlpPolicy",
        FakeEnv(),
        {},
        r"'MlpPolicy' got images of shape \(3, 36, 36\), but it reads vectors: use 'CnnPolicy'",
    ),
    "CnnPolicy on vectors": (
        "CnnPolicy",
        FakeEnv(VECTOR),
        {},
        r"'CnnPolicy' got observations of shape \(3,\), but it reads images .*: use 'MlpPolicy' for vectors, or make",
    ),
    "frames that do not divide the channels": (
        "CnnPolicy",
        FourFrames(spaces.Box(0, 255, (9, 36, 36), np.uint8)),
        {},
        "9 channels, which frame_stack=4 does not divide: pass the number of frames",
    ),
    "image smaller than the convolutions": (
        "CnnPolicy",
        images(3, 14, 36),
        {},
        "observations of 14x36 pixels are too small for 4 convolutions .*, which need at least 15x15: use a larger "
        "image_size, or fewer layers",
    ),
    "crop smaller than the convolutions": (
        "CnnPolicy",
        FakeEnv(),
        {"srl": "curl", "srl_kwargs": {"crop_size": 10}},
        "10x10 pixels are too small for 4 convolutions .* at least 15x15: use a larger",
    ),
    # --- actions
    "discrete actions": (
        "CnnPolicy",
        actions(spaces.Discrete(3)),
        {},
        r"action space is Discrete\(3\), but SAC needs continuous actions \(a Box\): use another algorithm .*, or an",
    ),
    "unbounded actions": (
        "CnnPolicy",
        actions(spaces.Box(-np.inf, np.inf, (2,), np.float32)),
        {},
        r"action space is Box\(-inf, inf, .*, but SAC needs finite bounds: wrap the environment",
    ),
    "unbounded above": (
        "CnnPolicy",
        actions(spaces.Box(np.zeros(2, np.float32), np.array([1, np.inf], np.float32))),
        {},
        "but SAC needs finite bounds: wrap the environment",
    ),
    # --- policies
    "SB3's policy class": (
        sb3_policies.CnnPolicy,
        FakeEnv(),
        {},
        r"policy is stable_baselines3\.sac\.policies\.CnnPolicy, but SRL and curiosity need a subclass of "
        r"sb3_cure\.policies\.CuRePolicy: use 'CnnPolicy' or 'MlpPolicy'",
    ),
    "images that are not divided": (
        "CnnPolicy",
        FakeEnv(),
        {"policy_kwargs": {"normalize_images": False}},
        "normalize_images=False, .*, but the shared encoder reads images in 0-255 .*: leave them out, or use srl=None",
    ),
    "encoder that is not shared": (
        "CnnPolicy",
        FakeEnv(),
        {"policy_kwargs": {"share_encoder": False}},
        "share_encoder=False, .*, but the shared encoder .*: leave them out, or use srl=None",
    ),
}


def is_one_sentence(message: str) -> bool:
    """A line of at most 500 characters, without a traceback's debris."""
    return "\n" not in message and len(message) <= 500


@pytest.mark.parametrize("name", CONSTRUCTOR)
def test_constructor(name: str) -> None:
    policy, env, kwargs, sentence = CONSTRUCTOR[name]
    env = env if isinstance(env, gym.Env) else env()
    with pytest.raises(ValueError, match=sentence) as error:
        CuReSAC(policy, env, **{"buffer_size": 10, **kwargs})
    assert is_one_sentence(str(error.value))


def test_an_instance_instead_of_a_class() -> None:
    """A head that is already built belongs to another encoder."""
    built = tiny_model("CnnPolicy", PixelBox()).policy.srl
    assert isinstance(built, RAE)
    with pytest.raises(
        ValueError, match=r"srl is an instance of RAE, but .*\(the class itself, not an instance\)"
    ) as error:
        CuReSAC("CnnPolicy", FakeEnv(), srl=built)
    assert is_one_sentence(str(error.value))


UNKNOWN_KEYWORDS: dict[str, tuple[dict[str, Any], str]] = {
    "argument": ({"curiousity": None}, "unexpected keyword argument 'curiousity'"),
    "of rae": ({"srl_kwargs": {"latent_penality": 1}}, "RAE.* unexpected keyword argument 'latent_penality'"),
    "of curl": ({"srl": "curl", "srl_kwargs": {"crop": 64}}, "CURL.* unexpected keyword argument 'crop'"),
    "of the policy": ({"policy_kwargs": {"n_filters": 8}}, "Policy.* unexpected keyword argument 'n_filters'"),
    "of the encoder": (
        {"policy_kwargs": {"features_extractor_kwargs": {"filters": 8}}},
        "PixelEncoder.* unexpected keyword argument 'filters'",
    ),
}


@pytest.mark.parametrize("name", UNKNOWN_KEYWORDS)
def test_unknown_keywords(name: str) -> None:
    """They are named together with whom they were meant for, not swallowed."""
    kwargs, sentence = UNKNOWN_KEYWORDS[name]
    with pytest.raises(TypeError, match=sentence):
        CuReSAC("CnnPolicy", FakeEnv(), buffer_size=10, **kwargs)


def test_dictionaries_lead_to_the_explanation() -> None:
    """With another policy's name SB3 asks for 'MultiInputPolicy', whose refusal (above) explains."""
    with pytest.raises(ValueError, match="use `MultiInputPolicy`"):
        CuReSAC("CnnPolicy", FakeEnv(spaces.Dict(camera=IMAGE)))


class RewardAtStep(PixelBox):
    """It returns a reward that is no number, once."""

    def __init__(self, reward: float, at: int):
        super().__init__()
        self.reward, self.at, self.total = reward, at, 0

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.total += 1
        obs, reward, *rest = super().step(action)
        return obs, self.reward if self.total == self.at else reward, *rest


@pytest.mark.parametrize("reward", [float("nan"), float("inf")])
@pytest.mark.parametrize("kwargs", [{}, {"srl": None, "curiosity": None}], ids=["cure", "sac"])
def test_a_reward_that_is_no_number_is_not_stored(reward: float, kwargs: dict[str, Any]) -> None:
    """It would spoil the critics for good: the run stops, with all the transitions from before in the buffer."""
    env = DummyVecEnv([lambda: RewardAtStep(reward, at=10**9), lambda: RewardAtStep(reward, at=5)])
    model = tiny_model("CnnPolicy", env, **kwargs)
    sentence = rf"environment 1 returned the reward {reward} at agent step 10, but .*: it was not stored; fix"
    with pytest.raises(ValueError, match=sentence) as error:
        model.learn(40)
    assert is_one_sentence(str(error.value))
    assert model.replay_buffer.pos == 4
    assert np.isfinite(model.replay_buffer.rewards).all()


def test_pretrain_needs_a_head() -> None:
    for kwargs in ({}, {"policy_kwargs": {"share_encoder": True}}):
        model = tiny_model("CnnPolicy", PixelBox(), srl=None, curiosity=None, **kwargs)
        with pytest.raises(
            ValueError, match=r"pretrain was called with srl=None, but .*: choose srl='rae', srl='curl' or"
        ):
            model.pretrain(10)


def test_pretrain_needs_a_collector_that_it_knows() -> None:
    model = tiny_model("CnnPolicy", PixelBox())
    with pytest.raises(ValueError, match="collector='expert', but data are collected by 'curious' or 'random': choose"):
        model.pretrain(10, collector="expert")


@pytest.mark.parametrize(
    "kwargs, sentence",
    [
        ({"curiosity_gamma": 0.0}, "curiosity_gamma=0 was given with curiosity_target='observation'"),
        ({"n_steps": 3}, "n_steps=3 was given with a curious policy to train"),
    ],
)
def test_pretrain_needs_a_curious_agent_that_can_learn(kwargs: dict[str, Any], sentence: str) -> None:
    """What is harmless without curiosity is refused when a curious policy is to collect, before anything is built."""
    model = tiny_model("CnnPolicy", PixelBox(), curiosity=None, **kwargs)
    with pytest.raises(ValueError, match=sentence):
        model.pretrain(20, collector="curious")
    assert model.policy.curious_actor is None
    assert model.pretrain(20, collector="random").learn(20).num_timesteps == 20


@pytest.mark.parametrize("kwargs", [{}, {"srl": None}, {"curiosity": "random"}, {"curiosity": "bonus"}])
def test_predict_curious_needs_a_curious_policy(kwargs: dict[str, Any]) -> None:
    kwargs = {"curiosity": None, **kwargs}
    model = tiny_model("CnnPolicy", PixelBox(), **kwargs)
    sentence = (
        rf"predict_curious was called with curiosity={kwargs['curiosity']!r}, but only curiosity='separate' .*: use"
    )
    with pytest.raises(ValueError, match=sentence):
        model.predict_curious(model.observation_space.sample())


def test_a_schedule_that_leaves_its_range_stops_the_run() -> None:
    """p_c is checked again whenever it is used."""
    model = tiny_model("MlpPolicy", VectorBox(), curiosity_prob=lambda remaining: 1.5 - remaining, gradient_steps=0)
    with pytest.raises(ValueError, match=r"curiosity_prob is 1\.\d+ \(progress remaining 0\.\d+\), but .*\[0, 1\]"):
        model.learn(100)
    assert 50 <= model.num_timesteps < 100


@pytest.mark.parametrize(
    "error, sentence",
    [
        (lambda e: e.unsqueeze(1), r"returned an error of shape \(8, 1\) for 8 samples, .* shape \(8,\)"),
        (lambda e: e.mean(), r"returned an error of shape \(\) for 8 samples"),
        (lambda e: e.clone().requires_grad_(), r"of shape \(8,\) with a gradient .* detach\(\)"),
        (lambda e: e - 1e6, r"returned errors from -.* but SRLOutput\.error must be finite and >= 0"),
        (lambda e: e * float("nan"), r"returned errors from nan to nan"),
    ],
)
def test_errors_of_a_users_head(error: Callable[[Any], Any], sentence: str) -> None:
    """Whatever is not one number per sample would train the curious agent on something else, silently."""

    class Wrong(RAE):
        def loss(self, batch: Any, latents: Any) -> Any:
            loss, right = super().loss(batch, latents)
            return SRLOutput(loss, error(right))

    with pytest.raises(ValueError, match=sentence):
        tiny_model("CnnPolicy", PixelBox(), srl=Wrong).learn(12)
