"""What cannot work is refused in one sentence: the value, what was expected, what to do instead."""

import io
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import pytest
import stable_baselines3.sac.policies as sb3_policies
import torch as th
from envs_for_tests import PixelBox, VectorBox, differences, state_of, tiny_model
from gymnasium import spaces
from stable_baselines3 import SAC, HerReplayBuffer
from stable_baselines3.common.callbacks import StopTrainingOnMaxEpisodes
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.torch_layers import NatureCNN
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize

from sb3_cure import CuReSAC, make_dmc_env
from sb3_cure.buffers import FrameStackReplayBuffer
from sb3_cure.callbacks import (
    CuriosityMapCallback,
    EvalBothCallback,
    ExactCheckpoint,
    PolicyVideoCallback,
    ReconstructionCallback,
)
from sb3_cure.evaluation import most_uncomfortable, run_episodes
from sb3_cure.srl import RAE, SRLOutput

IMAGE = spaces.Box(0, 255, (3, 36, 36), np.uint8)
VECTOR = spaces.Box(-1, 1, (3,), np.float32)
ACTION = spaces.Box(-1, 1, (2,), np.float32)
PLAIN: dict[str, Any] = {"srl": None, "curiosity": None}


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
        "srl is 'vae', but it must be one of 'rae', 'curl', None, or a subclass of "
        "sb3_cure.srl.SRLHead (the class itself, not an instance).",
    ),
    "srl of another class": (
        "CnnPolicy",
        FakeEnv(),
        {"srl": dict},
        "srl is <class 'dict'>, but it must be one of 'rae', 'curl', None, or a subclass of "
        "sb3_cure.srl.SRLHead (the class itself, not an instance).",
    ),
    "curl on vectors": (
        "MlpPolicy",
        FakeEnv(VECTOR),
        {"srl": "curl"},
        "srl='curl' got observations Box(-1.0, 1.0, (3,), float32), but it learns from two "
        "crops of one image and vectors have none: use srl='rae', or a head of your own, "
        "with 'MlpPolicy'.",
    ),
    "curl crop too large": (
        "CnnPolicy",
        FakeEnv(),
        {"srl": "curl", "srl_kwargs": {"augmentation": "crop"}},
        "srl_kwargs got augmentation='crop' with crop_size=84 for observations of 36 pixels, "
        "but crops must have at least 1 pixel and be smaller than the observation: render "
        "larger (CURL: image_size=100), set another crop_size, or use augmentation='shift'.",
    ),
    "curl crop of all": (
        "CnnPolicy",
        FakeEnv(),
        {"srl": "curl", "srl_kwargs": {"augmentation": "crop", "crop_size": 36}},
        "srl_kwargs got augmentation='crop' with crop_size=36 for observations of 36 pixels, "
        "but crops must have at least 1 pixel and be smaller than the observation: render "
        "larger (CURL: image_size=100), set another crop_size, or use augmentation='shift'.",
    ),
    "curl crop of nothing": (
        "CnnPolicy",
        FakeEnv(),
        {"srl": "curl", "srl_kwargs": {"crop_size": 0}},
        "srl_kwargs got augmentation='crop' with crop_size=0 for observations of 36 pixels, "
        "but crops must have at least 1 pixel and be smaller than the observation: render "
        "larger (CURL: image_size=100), set another crop_size, or use augmentation='shift'.",
    ),
    "curl augmentation": (
        "CnnPolicy",
        FakeEnv(),
        {"srl": "curl", "srl_kwargs": {"augmentation": "flip"}},
        "srl_kwargs got augmentation='flip', but srl='curl' knows 'crop', 'shift' and 'auto': choose one of them.",
    ),
    "curl bank": (
        "CnnPolicy",
        FakeEnv(),
        {"srl": "curl", "srl_kwargs": {"bank_size": 0}},
        "srl_kwargs got pad=4 and bank_size=0, but each must be at least 1: change srl_kwargs.",
    ),
    "rae augmentation": (
        "CnnPolicy",
        FakeEnv(),
        {"srl_kwargs": {"augmentation": "crop"}},
        "srl_kwargs got augmentation='crop' for observations of shape (3, 36, 36), but "
        "srl='rae' knows 'none', and for images 'shift': choose one of them.",
    ),
    "rae shifts of vectors": (
        "MlpPolicy",
        FakeEnv(VECTOR),
        {"srl_kwargs": {"augmentation": "shift"}},
        "srl_kwargs got augmentation='shift' for observations of shape (3,), but srl='rae' "
        "knows 'none', and for images 'shift': choose one of them.",
    ),
    "rae pad": (
        "CnnPolicy",
        FakeEnv(),
        {"srl_kwargs": {"pad": 0}},
        "srl_kwargs got pad=0, but a shift needs at least 1 pixel: change pad.",
    ),
    "rae bits": (
        "CnnPolicy",
        FakeEnv(),
        {"srl_kwargs": {"bits": 9}},
        "srl_kwargs got bits=9, but a pixel has 8: give a whole number from 1 to 8.",
    ),
    "rae penalty": (
        "CnnPolicy",
        FakeEnv(),
        {"srl_kwargs": {"latent_penalty": -1.0}},
        "srl_kwargs got latent_penalty=-1.0 and decoder_weight_decay=1e-07, but both are penalties: give numbers >= 0.",
    ),
    "srl_schedule": (
        "CnnPolicy",
        FakeEnv(),
        {"srl_schedule": "random"},
        "srl_schedule is 'random', but it must be one of 'simultaneous', 'alternating': choose one.",
    ),
    "srl_period": (
        "CnnPolicy",
        FakeEnv(),
        {"srl_period": 0},
        "srl_period is 0, but it must be a whole number of at least 1: change srl_period.",
    ),
    # --- curiosity
    "curiosity without srl": (
        "CnnPolicy",
        FakeEnv(),
        {"srl": None},
        "curiosity='separate' was given with srl=None, but the curious reward is the SRL "
        "error: choose srl='rae', srl='curl' or a head of your own, or set curiosity=None.",
    ),
    "bonus without srl": (
        "CnnPolicy",
        FakeEnv(),
        {"srl": None, "curiosity": "bonus"},
        "curiosity='bonus' was given with srl=None, but the curious reward is the SRL error: "
        "choose srl='rae', srl='curl' or a head of your own, or set curiosity=None.",
    ),
    "curiosity": (
        "CnnPolicy",
        FakeEnv(),
        {"curiosity": True},
        "curiosity is True, but it must be one of 'separate', 'bonus', 'random', None: choose one.",
    ),
    "curiosity_prob": (
        "CnnPolicy",
        FakeEnv(),
        {"curiosity_prob": 1.2},
        "curiosity_prob is 1.2 (progress remaining 1.00), but it is the probability p_c with "
        "which the curious actor acts: give a number, or a schedule, within [0, 1].",
    ),
    "curiosity_prob schedule": (
        "CnnPolicy",
        FakeEnv(),
        {"curiosity_prob": lambda remaining: -remaining},
        "curiosity_prob is -1.0 (progress remaining 1.00), but it is the probability p_c "
        "with which the curious actor acts: give a number, or a schedule, within [0, 1].",
    ),
    "curiosity_prob no number": (
        "CnnPolicy",
        FakeEnv(),
        {"curiosity_prob": "often"},
        "curiosity_prob is 'often' (progress remaining 1.00), but it is the probability p_c "
        "with which the curious actor acts: give a number, or a schedule, within [0, 1].",
    ),
    "curiosity_gamma": (
        "CnnPolicy",
        FakeEnv(),
        {"curiosity_gamma": 0},
        "curiosity_gamma=0 was given with curiosity_target='observation', but the error of "
        "the observation itself does not depend on the action, so that there is nothing to "
        "learn: set curiosity_target='next_observation', or a curiosity_gamma > 0.",
    ),
    "curiosity_gamma range": (
        "CnnPolicy",
        FakeEnv(),
        {"curiosity_gamma": 1.01},
        "curiosity_gamma is 1.01, but it must be a number within [0, 1]: change curiosity_gamma.",
    ),
    "curiosity_target": (
        "CnnPolicy",
        FakeEnv(),
        {"curiosity_target": "next"},
        "curiosity_target is 'next', but it must be one of 'observation', 'next_observation': choose one.",
    ),
    "negative beta": (
        "CnnPolicy",
        FakeEnv(),
        {"curiosity_beta": -1.0},
        "curiosity_beta is -1.0, but it must be a number of at least 0: change curiosity_beta.",
    ),
    "infinite beta": (
        "CnnPolicy",
        FakeEnv(),
        {"curiosity_beta": np.inf},
        "curiosity_beta is inf, but it must be a number of at least 0: change curiosity_beta.",
    ),
    "nan beta": (
        "CnnPolicy",
        FakeEnv(),
        {"curiosity_beta": np.nan},
        "curiosity_beta is nan, but it must be a number of at least 0: change curiosity_beta.",
    ),
    "no task and no curiosity": (
        "CnnPolicy",
        FakeEnv(),
        {"task": False, "curiosity": None},
        "task=False was given with curiosity=None, but an agent without task needs a curious "
        "policy: set curiosity='separate'.",
    ),
    "no task and a bonus": (
        "CnnPolicy",
        FakeEnv(),
        {"task": False, "curiosity": "bonus"},
        "task=False was given with curiosity='bonus', but an agent without task needs a "
        "curious policy: set curiosity='separate'.",
    ),
    "gSDE with curiosity": (
        "CnnPolicy",
        FakeEnv(),
        {"use_sde": True},
        "use_sde=True was given with srl='rae' and curiosity='separate', but gSDE's noise "
        "belongs to one actor on its own features: leave use_sde=False, or set srl=None and "
        "curiosity=None.",
    ),
    "n-step with curiosity": (
        "CnnPolicy",
        FakeEnv(),
        {"n_steps": 3},
        "n_steps=3 was given with a curious policy to train, but the curious reward is known "
        "for single transitions only: set n_steps=1.",
    ),
    "n-step with a bonus": (
        "CnnPolicy",
        FakeEnv(),
        {"n_steps": 3, "curiosity": "bonus"},
        "n_steps=3 was given with curiosity='bonus', but the curious reward is known for "
        "single transitions only: set n_steps=1, or curiosity=None.",
    ),
    # --- training
    "update": (
        "CnnPolicy",
        FakeEnv(),
        {"update": "both"},
        "update is 'both', but it must be one of 'sequential', 'joint': choose one.",
    ),
    "precision": (
        "CnnPolicy",
        FakeEnv(),
        {"precision": "fp16"},
        "precision is 'fp16', but it must be one of 'auto', 'fp32', 'bf16': choose one of them.",
    ),
    "batch_size": (
        "CnnPolicy",
        FakeEnv(),
        {"batch_size": 0},
        "batch_size is 0, but it must be a whole number of at least 1: change batch_size.",
    ),
    "batch_size in halves": (
        "CnnPolicy",
        FakeEnv(),
        {"batch_size": 12.5},
        "batch_size is 12.5, but it must be a whole number of at least 1: change batch_size.",
    ),
    "ent_coef of zero to learn": (
        "CnnPolicy",
        FakeEnv(),
        {"ent_coef": "auto_0"},
        "ent_coef is 'auto_0', but it must be 'auto', 'auto_<initial temperature > 0>' (say "
        "'auto_0.1'), or a fixed number >= 0: change ent_coef.",
    ),
    "ent_coef without underscore": (
        "CnnPolicy",
        FakeEnv(),
        {"ent_coef": "auto0.5"},
        "ent_coef is 'auto0.5', but it must be 'auto', 'auto_<initial temperature > 0>' (say "
        "'auto_0.1'), or a fixed number >= 0: change ent_coef.",
    ),
    "ent_coef without number": (
        "CnnPolicy",
        FakeEnv(),
        {"ent_coef": "auto_"},
        "ent_coef is 'auto_', but it must be 'auto', 'auto_<initial temperature > 0>' (say "
        "'auto_0.1'), or a fixed number >= 0: change ent_coef.",
    ),
    "task that is no boolean": (
        "CnnPolicy",
        FakeEnv(),
        {"task": None},
        "task is None, but it must be True or False: change task.",
    ),
    "overlap in words": (
        "CnnPolicy",
        FakeEnv(),
        {"overlap": "no"},
        "overlap is 'no', but it must be True or False: change overlap.",
    ),
    "frames on disk of an environment without frame_stack": (
        "CnnPolicy",
        FakeEnv(),
        {"replay_buffer_kwargs": {"frames_dir": "."}},
        "replay_buffer_kwargs got frames_dir='.', but the environment does not tell its "
        "frame_stack, without which frames cannot be told apart: use make_dmc_env or "
        "make_pixel_env, or add frame_stack.",
    ),
    "ent_coef in words": (
        "CnnPolicy",
        FakeEnv(),
        {"ent_coef": "low"},
        "ent_coef is 'low', but it must be 'auto', 'auto_<initial temperature > 0>' (say "
        "'auto_0.1'), or a fixed number >= 0: change ent_coef.",
    ),
    "srl_kwargs of no head": (
        "CnnPolicy",
        FakeEnv(),
        {"srl": None, "curiosity": None, "srl_kwargs": {"bits": 4}},
        "srl_kwargs={'bits': 4} was given with srl=None, but these are the arguments of an "
        "SRL head: choose srl='rae', srl='curl' or a head of your own, or leave srl_kwargs "
        "out.",
    ),
    "too small for NatureCNN": (
        "CnnPolicy",
        images(3, 24, 24),
        {"policy_kwargs": {"features_extractor_class": NatureCNN}},
        "NatureCNN cannot read observations of shape (3, 24, 24) (Calculated padded input "
        "size per channel: (1 x 1). Kernel size: (3 x 3). Kernel size can't be greater than "
        "actual input size): use a larger image_size, or another "
        "policy_kwargs=dict(features_extractor_class=...).",
    ),
    "buffer_size": (
        "CnnPolicy",
        FakeEnv(),
        {"buffer_size": 0},
        "buffer_size is 0, but it must be a whole number of at least 1: change buffer_size.",
    ),
    "warmup_updates": (
        "CnnPolicy",
        FakeEnv(),
        {"warmup_updates": -1},
        "warmup_updates is -1, but it must be a whole number of at least 0: change warmup_updates.",
    ),
    "actor_update_interval": (
        "CnnPolicy",
        FakeEnv(),
        {"actor_update_interval": 0},
        "actor_update_interval is 0, but it must be a whole number of at least 1: change actor_update_interval.",
    ),
    "target_update_interval": (
        "CnnPolicy",
        FakeEnv(),
        {"target_update_interval": 0},
        "target_update_interval is 0, but it must be a whole number of at least 1: change target_update_interval.",
    ),
    "encoder_tau": (
        "CnnPolicy",
        FakeEnv(),
        {"encoder_tau": "0.05"},
        "encoder_tau is '0.05', but it must be a number within [0, 1]: change encoder_tau.",
    ),
    # --- observations
    "floats in [0, 1]": (
        "CnnPolicy",
        images(3, 36, 36, dtype=np.float32, high=1),
        {},
        "images arrive as float32 in [0.0, 1.0], but the encoder and the replay buffer take "
        "uint8 in [0, 255]: give the environment's images as they are rendered (scaled ones as (255 * "
        "image).astype(numpy.uint8)), and VecNormalize with norm_obs=False.",
    ),
    "floats in [0, 255]": (
        "CnnPolicy",
        images(3, 36, 36, dtype=np.float32),
        {},
        "images arrive as float32 in [0.0, 255.0], but the encoder and the replay buffer "
        "take uint8 in [0, 255]: give the environment's images as they are rendered (scaled ones as (255 * "
        "image).astype(numpy.uint8)), and VecNormalize with norm_obs=False.",
    ),
    "few grey levels": (
        "CnnPolicy",
        images(3, 36, 36, high=7),
        {},
        "images arrive as uint8 in [0, 7], but the encoder and the replay buffer take uint8 "
        "in [0, 255]: give the environment's images as they are rendered (scaled ones as (255 * "
        "image).astype(numpy.uint8)), and VecNormalize with norm_obs=False.",
    ),
    "VecNormalize of images that are turned outside of it": (
        "CnnPolicy",
        lambda: VecNormalize(DummyVecEnv([lambda: PixelBox(channels_last=True)]), norm_obs=False),
        {},
        "VecNormalize lies around observations of shape (36, 36, 6), but the agent sees (6, 36, 36), and SB3 stores "
        "what VecNormalize has seen: put it around the other wrappers, for images with the channels last as "
        "VecNormalize(VecTransposeImage(venv), norm_obs=False).",
    ),
    "VecNormalize inside of stacked frames": (
        "CnnPolicy",
        lambda: VecFrameStack(VecNormalize(DummyVecEnv([PixelBox]), norm_obs=False), 2),
        {},
        "VecNormalize lies around observations of shape (6, 36, 36), but the agent sees (12, 36, 36), and SB3 stores "
        "what VecNormalize has seen: put it around the other wrappers, for images with the channels last as "
        "VecNormalize(VecTransposeImage(venv), norm_obs=False).",
    ),
    "normalised images": (
        "CnnPolicy",
        lambda: VecNormalize(DummyVecEnv([FakeEnv])),
        {},
        "images arrive as float32 in [-10.0, 10.0], but the encoder and the replay buffer "
        "take uint8 in [0, 255]: give the environment's images as they are rendered (scaled ones as (255 * "
        "image).astype(numpy.uint8)), and VecNormalize with norm_obs=False.",
    ),
    "dictionary": (
        "MultiInputPolicy",
        FakeEnv(spaces.Dict(camera=IMAGE, joints=VECTOR)),
        {},
        "observations are Dict('camera': Box(0, 255, (3, 36, 36), uint8), 'joints': "
        "Box(-1.0, 1.0, (3,), float32)), but the shared encoder reads one image or one "
        "vector: keep one entry with gymnasium.wrappers.TransformObservation(env, lambda seen: "
        "seen['camera'], env.observation_space['camera']), or use 'MultiInputPolicy' with srl=None "
        "and curiosity=None, which is SB3's own SAC.",
    ),
    "dictionary, by another policy": (
        "CnnPolicy",
        FakeEnv(spaces.Dict(a=VECTOR)),
        {},
        "observations are Dict('a': Box(-1.0, 1.0, (3,), float32)), but the shared encoder reads one image or one "
        "vector: keep one entry with gymnasium.wrappers.TransformObservation(env, lambda seen: seen['a'], "
        "env.observation_space['a']), or use 'MultiInputPolicy' with srl=None and curiosity=None, which is SB3's own "
        "SAC.",
    ),
    "MultiInputPolicy without dictionary": (
        "MultiInputPolicy",
        FakeEnv(),
        {},
        "the policy is stable_baselines3.sac.policies.MultiInputPolicy, but SRL and "
        "curiosity need a subclass of sb3_cure.policies.CuRePolicy: use 'CnnPolicy' or "
        "'MlpPolicy'.",
    ),
    "MlpPolicy on images": (
        "MlpPolicy",
        FakeEnv(),
        {},
        "'MlpPolicy' got images of shape (3, 36, 36), but it reads vectors: use 'CnnPolicy'.",
    ),
    "CnnPolicy on vectors": (
        "CnnPolicy",
        FakeEnv(VECTOR),
        {},
        "'CnnPolicy' got observations of shape (3,), but it reads images (channels, height, "
        "width): use 'MlpPolicy' for vectors, or make_dmc_env / make_pixel_env for pixels.",
    ),
    "an image without channels": (
        "CnnPolicy",
        FakeEnv(spaces.Box(0, 255, (32, 48), np.uint8)),
        {},
        "'CnnPolicy' got observations of shape (32, 48), but it reads images (channels, height, width): add the axis "
        "of channels with gymnasium.wrappers.ReshapeObservation(env, (1, 32, 48)).",
    ),
    "a stack of colour images": (
        "CnnPolicy",
        FakeEnv(spaces.Box(0, 255, (3, 32, 48, 3), np.uint8)),
        {},
        "'CnnPolicy' got observations of shape (3, 32, 48, 3), but it reads images (channels, height, width): stack "
        "single images with sb3_cure.envs.StackFrames or SB3's VecFrameStack instead.",
    ),
    "frames that do not divide the channels": (
        "CnnPolicy",
        FakeEnv(spaces.Box(0, 255, (9, 36, 36), np.uint8)),
        {"replay_buffer_class": FrameStackReplayBuffer, "replay_buffer_kwargs": {"frame_stack": 4}},
        "observation_space has 9 channels, which frame_stack=4 does not divide: pass the "
        "number of frames that one observation stacks.",
    ),
    "image smaller than the convolutions": (
        "CnnPolicy",
        images(3, 14, 36),
        {},
        "observations of 14x36 pixels are too small for 4 convolutions of 3x3 (the first "
        "with stride 2), which need at least 15x15: use a larger image_size, or fewer layers "
        "through policy_kwargs=dict(features_extractor_kwargs=dict(n_layers=...)).",
    ),
    "crop smaller than the convolutions": (
        "CnnPolicy",
        FakeEnv(),
        {"srl": "curl", "srl_kwargs": {"crop_size": 10}},
        "observations of 10x10 pixels are too small for 4 convolutions of 3x3 (the first "
        "with stride 2), which need at least 15x15: use a larger image_size, or fewer layers "
        "through policy_kwargs=dict(features_extractor_kwargs=dict(n_layers=...)).",
    ),
    # --- actions
    "discrete actions": (
        "CnnPolicy",
        actions(spaces.Discrete(3)),
        {},
        "the action space is Discrete(3), but SAC needs continuous actions (a Box): use "
        "another algorithm (DQN, PPO), or an environment with continuous actions.",
    ),
    "unbounded actions": (
        "CnnPolicy",
        actions(spaces.Box(-np.inf, np.inf, (2,), np.float32)),
        {},
        "the action space is Box(-inf, inf, (2,), float32), but SAC needs finite bounds: "
        "give it some that suit the environment, such as gymnasium.wrappers.TransformAction(env, "
        "lambda action: action, gymnasium.spaces.Box(-1, 1, (2,))).",
    ),
    "bounds of the largest numbers": (
        "CnnPolicy",
        actions(spaces.Box(-3e38, 3e38, (2,), np.float32)),
        {},
        "the action space is Box(-3e+38, 3e+38, (2,), float32), but SAC needs finite bounds: "
        "give it some that suit the environment, such as gymnasium.wrappers.TransformAction(env, "
        "lambda action: action, gymnasium.spaces.Box(-1, 1, (2,))).",
    ),
    "unbounded above": (
        "CnnPolicy",
        actions(spaces.Box(np.zeros(2, np.float32), np.array([1, np.inf], np.float32))),
        {},
        "the action space is Box(0.0, [ 1. inf], (2,), float32), but SAC needs finite "
        "bounds: give it some that suit the environment, such as gymnasium.wrappers.TransformAction(env, "
        "lambda action: action, gymnasium.spaces.Box(-1, 1, (2,))).",
    ),
    "actions that are whole numbers": (
        "CnnPolicy",
        actions(spaces.Box(0, 5, (2,), np.int64)),
        {},
        "the action space is Box(0, 5, (2,), int64) of int64, but SAC's actions are real, which the replay buffer "
        "would cut off: round in the environment, such as by gymnasium.wrappers.TransformAction(env, lambda action: "
        "action.round().astype('int64'), gymnasium.spaces.Box(0, 5, (2,))).",
    ),
    "an action that is fixed": (
        "CnnPolicy",
        actions(spaces.Box(np.array([-1, 2], np.float32), np.array([1, 2], np.float32))),
        {},
        "action 1 of the action space Box([-1.  2.], [1. 2.], (2,), float32) has nothing between its bounds 2.0 and "
        "2.0: leave it out of the action space, and let the environment set it.",
    ),
    # --- policies
    "SB3's policy class": (
        sb3_policies.CnnPolicy,
        FakeEnv(),
        {},
        "the policy is stable_baselines3.sac.policies.CnnPolicy, but SRL and curiosity need "
        "a subclass of sb3_cure.policies.CuRePolicy: use 'CnnPolicy' or 'MlpPolicy'.",
    ),
    "images that are not divided": (
        "CnnPolicy",
        FakeEnv(),
        {"policy_kwargs": {"normalize_images": False}},
        "policy_kwargs got normalize_images=False, share_encoder=True, use_sde=False, but "
        "the shared encoder reads images in 0-255 and has no gSDE: leave them out, or use "
        "srl=None and curiosity=None, which is SB3's own SAC.",
    ),
    "encoder that is not shared": (
        "CnnPolicy",
        FakeEnv(),
        {"policy_kwargs": {"share_encoder": False}},
        "policy_kwargs got normalize_images=True, share_encoder=False, use_sde=False, but "
        "the shared encoder reads images in 0-255 and has no gSDE: leave them out, or use "
        "srl=None and curiosity=None, which is SB3's own SAC.",
    ),
    # --- SB3's own arguments
    "learning_rate in words": (
        "CnnPolicy",
        FakeEnv(),
        {"learning_rate": "fast"},
        "learning_rate is 'fast', but it must be a float of at least 0, or a schedule of the "
        "remaining progress: change learning_rate.",
    ),
    "learning_rate that is NaN": (
        "CnnPolicy",
        FakeEnv(),
        {"learning_rate": np.nan},
        "learning_rate is nan, but it must be a float of at least 0, or a schedule of the "
        "remaining progress: change learning_rate.",
    ),
    "negative schedule": (
        "CnnPolicy",
        FakeEnv(),
        {"learning_rate": lambda remaining: -remaining},
        "learning_rate is a schedule that starts with -1.0, but it must give numbers of at "
        "least 0: change the schedule.",
    ),
    "train_freq of nothing": (
        "CnnPolicy",
        FakeEnv(),
        {"train_freq": 0},
        "train_freq is 0, but it must be a whole number of steps of at least 1, or a pair "
        "such as (1, 'episode') or (4, 'step'): change train_freq.",
    ),
    "train_freq unit": (
        "CnnPolicy",
        FakeEnv(),
        {"train_freq": (1, "steps")},
        "train_freq is (1, 'steps'), but it must be a whole number of steps of at least 1, "
        "or a pair such as (1, 'episode') or (4, 'step'): change train_freq.",
    ),
    "train_freq without unit": (
        "CnnPolicy",
        FakeEnv(),
        {"train_freq": (1,)},
        "train_freq is (1,), but it must be a whole number of steps of at least 1, or a pair "
        "such as (1, 'episode') or (4, 'step'): change train_freq.",
    ),
    "episodes of two environments": (
        "CnnPolicy",
        lambda: DummyVecEnv([FakeEnv, FakeEnv]),
        {"train_freq": (1, "episode")},
        "train_freq is (1, 'episode') with 2 environments, but episodes are counted in a "
        "single one: give train_freq in steps, or one environment.",
    ),
    "gradient_steps": (
        "CnnPolicy",
        FakeEnv(),
        {"gradient_steps": -2},
        "gradient_steps is -2, but it must be a whole number of at least 0, or -1 for as "
        "many updates as agent steps: change gradient_steps.",
    ),
    "gradient_steps in halves": (
        "CnnPolicy",
        FakeEnv(),
        {"gradient_steps": 1.5},
        "gradient_steps is 1.5, but it must be a whole number of at least 0, or -1 for as "
        "many updates as agent steps: change gradient_steps.",
    ),
    "seed in words": (
        "CnnPolicy",
        FakeEnv(),
        {"seed": "a"},
        "seed is 'a', but it must be None or a whole number from 0 to 2**32 - 1: change seed.",
    ),
    "seed that is too large": (
        "CnnPolicy",
        FakeEnv(),
        {"seed": 2**32},
        "seed is 4294967296, but it must be None or a whole number from 0 to 2**32 - 1: change seed.",
    ),
    "verbose": ("CnnPolicy", FakeEnv(), {"verbose": None}, "verbose is None, but it must be 0, 1 or 2: choose one."),
    "device": (
        "CnnPolicy",
        FakeEnv(),
        {"device": "gpu"},
        "device is 'gpu', which PyTorch cannot use here: use 'auto', 'cpu', or 'cuda' on a machine with a GPU.",
    ),
    "device without data": (
        "CnnPolicy",
        FakeEnv(),
        {"device": "meta"},
        "device is 'meta', which PyTorch cannot use here: use 'auto', 'cpu', or 'cuda' on a machine with a GPU.",
    ),
    "learned temperature without end": (
        "CnnPolicy",
        FakeEnv(),
        {"ent_coef": "auto_inf"},
        "ent_coef is 'auto_inf', but it must be 'auto', 'auto_<initial temperature > 0>' "
        "(say 'auto_0.1'), or a fixed number >= 0: change ent_coef.",
    ),
    "ent_coef that Python and SB3 read differently": (
        "CnnPolicy",
        FakeEnv(),
        {"ent_coef": "auto_0.1_2"},
        "ent_coef is 'auto_0.1_2', but it must be 'auto', 'auto_<initial temperature > 0>' "
        "(say 'auto_0.1'), or a fixed number >= 0: change ent_coef.",
    ),
    "ent_coef that is true": (
        "CnnPolicy",
        FakeEnv(),
        {"ent_coef": True},
        "ent_coef is True, but it must be 'auto', 'auto_<initial temperature > 0>' (say "
        "'auto_0.1'), or a fixed number >= 0: change ent_coef.",
    ),
    "target_entropy": (
        "CnnPolicy",
        FakeEnv(),
        {"target_entropy": "Auto"},
        "target_entropy is 'Auto', but it must be 'auto' or a number: change target_entropy.",
    ),
    "target_entropy that is NaN": (
        "CnnPolicy",
        FakeEnv(),
        {"target_entropy": np.nan},
        "target_entropy is nan, but it must be 'auto' or a number: change target_entropy.",
    ),
    "action_noise": (
        "CnnPolicy",
        FakeEnv(),
        {"action_noise": 0.1},
        "action_noise is 0.1, but it must be None or an ActionNoise: give one, for example "
        "NormalActionNoise(np.zeros(2), 0.1 * np.ones(2)) for two actions.",
    ),
    "action_noise of another shape": (
        "CnnPolicy",
        FakeEnv(),
        {"action_noise": NormalActionNoise(np.zeros(5), np.ones(5))},
        "action_noise is for actions of shape (5,), but the environment's are of shape (2,): "
        "make the noise with a mean of that shape.",
    ),
    "n_steps": (
        "CnnPolicy",
        FakeEnv(),
        {"n_steps": 0},
        "n_steps is 0, but it must be a whole number of at least 1: change n_steps.",
    ),
    "use_sde": ("CnnPolicy", FakeEnv(), {"use_sde": 1}, "use_sde is 1, but it must be True or False: change use_sde."),
    "sde_sample_freq": (
        "CnnPolicy",
        FakeEnv(),
        {"sde_sample_freq": -5},
        "sde_sample_freq is -5, but it must be a whole number of at least -1: change sde_sample_freq.",
    ),
    "stats_window_size": (
        "CnnPolicy",
        FakeEnv(),
        {"stats_window_size": 0},
        "stats_window_size is 0, but it must be a whole number of at least 1: change stats_window_size.",
    ),
    "stats_window_size that no archive may have": (
        "CnnPolicy",
        FakeEnv(),
        {"stats_window_size": 10**6 + 1},
        "stats_window_size is 1000001, but it must be 1000000 episodes at most: change stats_window_size.",
    ),
    "optimize_memory_usage": (
        "CnnPolicy",
        FakeEnv(),
        {"optimize_memory_usage": "yes"},
        "optimize_memory_usage is 'yes', but it must be True or False: change optimize_memory_usage.",
    ),
    "tensorboard_log": (
        "CnnPolicy",
        FakeEnv(),
        {"tensorboard_log": 3},
        "tensorboard_log is 3, but it must be None or the path of a folder: give one.",
    ),
    "replay_buffer_class by name": (
        "CnnPolicy",
        FakeEnv(),
        {"replay_buffer_class": "ReplayBuffer"},
        "replay_buffer_class is 'ReplayBuffer', but it must be None or a kind of SB3's "
        "ReplayBuffer: give the class itself, not its name.",
    ),
    "hindsight without goals": (
        "CnnPolicy",
        FakeEnv(),
        {"replay_buffer_class": HerReplayBuffer},
        "replay_buffer_class is HerReplayBuffer, which stores dictionaries, but observations "
        "are Box(0, 255, (3, 36, 36), uint8): leave replay_buffer_class out.",
    ),
    "replay_buffer_kwargs": (
        "CnnPolicy",
        FakeEnv(),
        {"replay_buffer_kwargs": "a"},
        "replay_buffer_kwargs is 'a', but it must be a dictionary of arguments of the replay "
        "buffer by their names: write replay_buffer_kwargs=dict(name=value).",
    ),
    "policy_kwargs": (
        "CnnPolicy",
        FakeEnv(),
        {"policy_kwargs": [1]},
        "policy_kwargs is [1], but it must be a dictionary of arguments of the policy by "
        "their names: write policy_kwargs=dict(name=value).",
    ),
    "srl_kwargs": (
        "CnnPolicy",
        FakeEnv(),
        {"srl_kwargs": "bits"},
        "srl_kwargs is 'bits', but it must be a dictionary of arguments of RAE by their "
        "names: write srl_kwargs=dict(name=value).",
    ),
    "net_arch": (
        "CnnPolicy",
        FakeEnv(),
        {"policy_kwargs": {"net_arch": [0]}},
        "net_arch of policy_kwargs is [0], but it must be a list of the widths of the hidden "
        "layers, or such lists for actors and critics: write for example [256, 256] or "
        "dict(pi=[256], qf=[256, 256]).",
    ),
    "net_arch of actors alone": (
        "CnnPolicy",
        FakeEnv(),
        {"policy_kwargs": {"net_arch": {"pi": [8]}}},
        "net_arch of policy_kwargs is {'pi': [8]}, but it must be a list of the widths of "
        "the hidden layers, or such lists for actors and critics: write for example [256, "
        "256] or dict(pi=[256], qf=[256, 256]).",
    ),
    "activation_fn by name": (
        "CnnPolicy",
        FakeEnv(),
        {"policy_kwargs": {"activation_fn": "relu"}},
        "activation_fn of policy_kwargs is 'relu', but it must be a class, a kind of Module: "
        "give the class itself, not its name.",
    ),
    "optimizer_class by name": (
        "CnnPolicy",
        FakeEnv(),
        {"policy_kwargs": {"optimizer_class": "adam"}},
        "optimizer_class of policy_kwargs is 'adam', but it must be a class, a kind of "
        "Optimizer: give the class itself, not its name.",
    ),
    "no critics": (
        "CnnPolicy",
        FakeEnv(),
        {"policy_kwargs": {"n_critics": 0}},
        "n_critics of policy_kwargs is 0, but it must be a whole number of at least 1: "
        "change n_critics of policy_kwargs.",
    ),
    "compile as a number": (
        "CnnPolicy",
        FakeEnv(),
        {"compile": 1},
        "compile is 1, but it must be one of 'auto', True, False: choose one.",
    ),
    "an array as a choice": (
        "CnnPolicy",
        FakeEnv(),
        {"update": np.zeros(2)},
        "update is array([0., 0.]), but it must be one of 'sequential', 'joint': choose one.",
    ),
    "curiosity_prob that is true": (
        "CnnPolicy",
        FakeEnv(),
        {"curiosity_prob": True},
        "curiosity_prob is True (progress remaining 1.00), but it is the probability p_c "
        "with which the curious actor acts: give a number, or a schedule, within [0, 1].",
    ),
    # --- SB3's own SAC underneath: the same sentences
    "plain, train_freq": (
        "MlpPolicy",
        FakeEnv(VECTOR),
        {**PLAIN, "train_freq": 0},
        "train_freq is 0, but it must be a whole number of steps of at least 1, or a pair "
        "such as (1, 'episode') or (4, 'step'): change train_freq.",
    ),
    "plain, gradient_steps": (
        "MlpPolicy",
        FakeEnv(VECTOR),
        {**PLAIN, "gradient_steps": "1"},
        "gradient_steps is '1', but it must be a whole number of at least 0, or -1 for as "
        "many updates as agent steps: change gradient_steps.",
    ),
    "plain, no critics": (
        "MlpPolicy",
        FakeEnv(VECTOR),
        {**PLAIN, "policy_kwargs": {"n_critics": 0}},
        "n_critics of policy_kwargs is 0, but it must be a whole number of at least 1: "
        "change n_critics of policy_kwargs.",
    ),
    "plain, action_noise": (
        "MlpPolicy",
        FakeEnv(VECTOR),
        {**PLAIN, "action_noise": "normal"},
        "action_noise is 'normal', but it must be None or an ActionNoise: give one, for "
        "example NormalActionNoise(np.zeros(2), 0.1 * np.ones(2)) for two actions.",
    ),
    "plain, n_steps": (
        "MlpPolicy",
        FakeEnv(VECTOR),
        {**PLAIN, "n_steps": 1.5},
        "n_steps is 1.5, but it must be a whole number of at least 1: change n_steps.",
    ),
    "plain, features_dim": (
        "CnnPolicy",
        FakeEnv(),
        {**PLAIN, "policy_kwargs": {"features_extractor_kwargs": {"features_dim": 0}}},
        "features_dim of features_extractor_kwargs is 0, but it must be a whole number of at "
        "least 1: change features_dim of features_extractor_kwargs.",
    ),
    "plain, CnnPolicy on vectors": (
        "CnnPolicy",
        FakeEnv(VECTOR),
        PLAIN,
        "'CnnPolicy' got observations of shape (3,), but it reads images (channels, height, "
        "width): use 'MlpPolicy' for vectors, or make_dmc_env / make_pixel_env for pixels.",
    ),
    # --- environments and policies
    "no environment": (
        "CnnPolicy",
        lambda: None,
        {},
        "env is None, but a new model learns its spaces from an environment: give one as env.",
    ),
    "an environment's class": (
        "CnnPolicy",
        lambda: FakeEnv,
        {},
        "env is <class 'test_bad_input.FakeEnv'>, but it must be a Gymnasium environment, a "
        "VecEnv or a Gymnasium id: give one of them, for example make_dmc_env('cartpole', "
        "'swingup').",
    ),
    "unknown id": (
        "CnnPolicy",
        lambda: "dmc_pixels/cartpole-swing-v0",
        {},
        "env is 'dmc_pixels/cartpole-swing-v0', which Gymnasium cannot make (Environment "
        "`cartpole-swing` doesn't exist in namespace dmc_pixels. Did you mean: "
        "`cartpole-swingup`?): give a registered id, such as "
        "'dmc_pixels/cartpole-swingup-v0', or an environment.",
    ),
    "unknown policy": (
        "CNNPolicy",
        FakeEnv(),
        {},
        "policy is 'CNNPolicy', but it must be one of 'MlpPolicy', 'CnnPolicy', "
        "'MultiInputPolicy', or a class of policies: choose one.",
    ),
    "no policy": (
        None,
        FakeEnv(),
        {},
        "policy is None, but it must be one of 'MlpPolicy', 'CnnPolicy', 'MultiInputPolicy', "
        "or a class of policies: choose one.",
    ),
}


def is_one_sentence(message: str) -> bool:
    """A line of at most 500 characters, without a traceback's debris."""
    return "\n" not in message and len(message) <= 500


@pytest.mark.parametrize("name", CONSTRUCTOR)
def test_constructor(name: str) -> None:
    policy, env, kwargs, sentence = CONSTRUCTOR[name]
    env = env if isinstance(env, gym.Env) else env()
    with pytest.raises(ValueError) as error:
        CuReSAC(policy, env, **{"buffer_size": 10, **kwargs})
    assert str(error.value) == sentence
    assert is_one_sentence(sentence)


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
    "argument": (
        {"curiousity": None},
        "the call has 'curiousity', but CuReSAC has no such argument: write 'curiosity'.",
    ),
    "of rae": (
        {"srl_kwargs": {"latent_penality": 1}},
        "srl_kwargs has 'latent_penality', but RAE has no such argument: write 'latent_penalty'.",
    ),
    "of curl": (
        {"srl": "curl", "srl_kwargs": {"crop": 64}},
        "srl_kwargs has 'crop', but CURL has no such argument: write 'crop_size'.",
    ),
    "of the policy": (
        {"policy_kwargs": {"n_filters": 8}},
        "policy_kwargs has 'n_filters', but CnnPolicy has no such argument: remove it, or "
        "choose of activation_fn, features_extractor_class, features_extractor_kwargs, "
        "n_critics, net_arch, normalize_images, optimizer_class, optimizer_kwargs, "
        "share_encoder, use_sde.",
    ),
    "of SB3's policy": (
        {"policy_kwargs": {"share_features_extractor": True}},
        "policy_kwargs has 'share_features_extractor', but actors and critics of CnnPolicy share the encoder in any "
        "case, and critics train it: remove it.",
    ),
    "of the encoder": (
        {"policy_kwargs": {"features_extractor_kwargs": {"filters": 8}}},
        "features_extractor_kwargs of policy_kwargs has 'filters', but PixelEncoder has no "
        "such argument: write 'n_filters'.",
    ),
    "of the optimiser": (
        {"policy_kwargs": {"optimizer_kwargs": {"momentum": 0.9}}},
        "optimizer_kwargs of policy_kwargs has 'momentum', but Adam has no such argument: "
        "remove it, or choose of amsgrad, betas, capturable, decoupled_weight_decay, "
        "differentiable, eps, foreach, fused, maximize, weight_decay.",
    ),
    "of the optimiser, for the learning rate": (
        {"policy_kwargs": {"optimizer_kwargs": {"lr": 1e-4}}},
        "optimizer_kwargs of policy_kwargs has lr=0.0001, but everything learns at learning_rate: remove it, and "
        "change learning_rate.",
    ),
    "of the replay buffer": (
        {"replay_buffer_kwargs": {"frames": 3}},
        "replay_buffer_kwargs has 'frames', but ReplayBuffer has no such argument: remove "
        "it, or choose of handle_timeout_termination.",
    ),
    "of another class": (
        {"support_multi_env": True},
        "the call has 'support_multi_env', but CuReSAC has no such argument: remove it, or "
        "choose of what help(CuReSAC) lists.",
    ),
}


@pytest.mark.parametrize("name", UNKNOWN_KEYWORDS)
def test_unknown_keywords(name: str) -> None:
    """They are named together with whom they were meant for, not swallowed."""
    kwargs, sentence = UNKNOWN_KEYWORDS[name]
    with pytest.raises(TypeError) as error:
        CuReSAC("CnnPolicy", FakeEnv(), buffer_size=10, **kwargs)
    assert str(error.value) == sentence
    assert is_one_sentence(sentence)


def test_the_ways_out_that_sentences_name_work() -> None:
    """Copied as they stand: an entry of a dictionary, and bounds for actions."""
    env: Any = FakeEnv(spaces.Dict(joints=VECTOR, camera=IMAGE))
    with pytest.raises(ValueError) as error:
        CuReSAC("CnnPolicy", env)
    way_out = str(error.value).partition(" with ")[2].partition(", or use")[0]
    kept = eval(way_out, {"gymnasium": gym, "env": env})
    assert kept.observation_space == IMAGE
    CuReSAC("CnnPolicy", kept, buffer_size=10, policy_kwargs=dict(net_arch=[4]))
    env = actions(spaces.Box(-np.inf, np.inf, (2,), np.float32))
    with pytest.raises(ValueError) as error:
        CuReSAC("CnnPolicy", env)
    bounded = eval(str(error.value).partition("such as ")[2].rstrip("."), {"gymnasium": gym, "env": env})
    assert CuReSAC("CnnPolicy", bounded, buffer_size=10, policy_kwargs=dict(net_arch=[4])).action_space.shape == (2,)
    env = actions(spaces.Box(0, 5, (2,), np.int64))
    with pytest.raises(ValueError) as error:
        CuReSAC("CnnPolicy", env)
    rounded = eval(str(error.value).partition("such as by ")[2].rstrip("."), {"gymnasium": gym, "env": env})
    model = CuReSAC("CnnPolicy", rounded, buffer_size=10, policy_kwargs=dict(net_arch=[4]))
    assert (model.action_space.high == 5).all() and rounded.action(np.float32([1.4, 4.6])).tolist() == [1, 5]
    env = FakeEnv(spaces.Box(0, 255, (32, 48), np.uint8))
    with pytest.raises(ValueError) as error:
        CuReSAC("CnnPolicy", env)
    shaped = eval(str(error.value).partition(" with ")[2].rstrip("."), {"gymnasium": gym, "env": env})
    CuReSAC("CnnPolicy", shaped, buffer_size=10, policy_kwargs=dict(net_arch=[4]))


def test_an_environments_own_frame_stack_is_passed_over() -> None:
    """It may mean something else by that name."""
    env = FourFrames(spaces.Box(0, 255, (9, 36, 36), np.uint8))
    with pytest.warns(UserWarning, match=r"frame_stack is 4, but observations of shape \(9, 36, 36\) are not of so"):
        model = CuReSAC("CnnPolicy", env, buffer_size=10, policy_kwargs=dict(net_arch=[4]))
    assert not isinstance(model.replay_buffer, FrameStackReplayBuffer)


def test_frames_that_the_user_tells_are_kept_once() -> None:
    space = spaces.Box(0, 255, (4, 36, 36), np.uint8)
    model = CuReSAC("CnnPolicy", FakeEnv(space), buffer_size=10, replay_buffer_kwargs=dict(frame_stack=2))
    assert isinstance(model.replay_buffer, FrameStackReplayBuffer) and model.replay_buffer.frame_stack == 2


@pytest.mark.parametrize("policy", ["CnnPolicy", "MultiInputPolicy"])
def test_images_that_are_too_small_for_sb3s_encoder(policy: str) -> None:
    """SB3's own SAC says so in one sentence, of which the last way out works."""
    space = spaces.Box(0, 255, (3, 20, 20), np.uint8)
    env = FakeEnv(space if policy == "CnnPolicy" else spaces.Dict(camera=space))
    kwargs: dict[str, Any] = dict(srl=None, curiosity=None, buffer_size=10)
    with pytest.raises(ValueError, match=r"NatureCNN, .* cannot read those of shape \(3, 20, 20\).*share_encoder=True"):
        CuReSAC(policy, env, policy_kwargs=dict(net_arch=[4]), **kwargs)
    if policy == "CnnPolicy":
        CuReSAC(policy, env, policy_kwargs=dict(net_arch=[4], share_encoder=True), **kwargs)
        CuReSAC("MlpPolicy", env, policy_kwargs=dict(net_arch=[4]), **kwargs)  # which flattens them


@pytest.mark.parametrize("kwargs", [{}, dict(srl=None, curiosity=None)], ids=["CuRe", "SAC"])
def test_a_buffer_that_no_memory_holds(kwargs: dict[str, Any]) -> None:
    """Of a camera as it comes, on a machine of any size."""
    camera = FakeEnv(spaces.Box(0, 255, (3, 4800, 6400), np.uint8))
    with pytest.raises(
        ValueError, match=r"buffer_size=900000000 observations Box\(0, 255, \(3, 4800, 6400\), uint8\) does "
    ):
        CuReSAC("CnnPolicy", camera, buffer_size=900_000_000, policy_kwargs=dict(net_arch=[4]), **kwargs)


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
    sentence = (
        rf"environment 1 returned the reward {reward} at agent step 10, but .*: it was not stored; look at .*, then fix"
    )
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


@pytest.mark.parametrize(
    "output, sentence",
    [
        (lambda loss, error: loss, r"returned \(Tensor\), but it must return two tensors, the loss to "),
        (
            lambda loss, error: (loss, error, {}),
            r"returned \(Tensor, Tensor, dict\), but it must return two tensors, the loss",
        ),
        (
            lambda loss, error: (loss, 0.0),
            r"returned \(Tensor, float\), but it must return two tensors, the loss",
        ),
        (
            lambda loss, error: None,
            r"returned \(NoneType\), but it must return two tensors, the loss to ",
        ),
        (
            lambda loss, error: (loss.detach(), error),
            "returned a loss without a gradient, but it must be one number",
        ),
        (
            lambda loss, error: (loss * error, error),
            r"returned a loss of shape \(8,\), but it must be one number",
        ),
    ],
)
def test_outputs_of_a_users_head(output: Callable[..., Any], sentence: str) -> None:
    """Told before anything has moved."""

    class Wrong(RAE):
        def loss(self, batch: Any, latents: Any) -> Any:
            return output(*super().loss(batch, latents))

    model = tiny_model("CnnPolicy", PixelBox(), srl=Wrong)
    before = state_of(model)["policy"]
    with pytest.raises(ValueError, match=rf"^Wrong\.loss {sentence}"):
        model.learn(12)
    assert differences(before, state_of(model)["policy"]) == []


@pytest.mark.parametrize("method", ["augment", "center"])
def test_augmentations_of_a_users_head(method: str) -> None:
    """The encoder would complain of weights, or read a part of the image."""
    Wrong = type("Wrong", (RAE,), {method: lambda self, observations: observations[:, :, 2:]})
    sentence = (
        rf"Wrong\.{method} made observations of shape \(6, 34, 36\) of those of shape \(6, 36, 36\), but the encoder "
        r"was built for \(6, 36, 36\): return that shape, or name another one in configure_encoder\."
    )
    with pytest.raises(ValueError, match=sentence):
        tiny_model("CnnPolicy", PixelBox(), srl=Wrong).learn(12)


# ------------------------------------------------------------------------- everywhere else


def model_of(**kwargs: Any) -> CuReSAC:
    return tiny_model("CnnPolicy", PixelBox(), buffer_size=50, **kwargs)


def saved(method: str) -> str:
    """Written into the file ``there``, whose name is returned."""
    getattr(model_of(), method)("saved.zip")
    os.replace("saved.zip", "there")
    return "there"


def reloaded(env: gym.Env) -> CuReSAC:
    """A saved model, to go on in an environment."""
    file = io.BytesIO()
    model_of().save(file)
    file.seek(0)
    return CuReSAC.load(file, env=env)


def watched(callback: Any) -> None:
    """What is known with the model: in ``learn``, before its first step."""
    model = model_of()
    try:
        model.learn(12, callback=callback)
    finally:
        assert model.num_timesteps == 0


def cartpole(**kwargs: Any) -> gym.Env:
    return make_dmc_env(**{"domain": "cartpole", "task": "swingup", **kwargs})


class Drawn(VectorBox):
    """It renders."""

    render_mode = "rgb_array"
    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"]}


MAP: dict[str, Any] = dict(state=lambda env: env.unwrapped.position, names=["x", "y"])
#: Images of a training run, and of its curiosity maps
STACK = spaces.Box(0, 255, (6, 36, 36), np.uint8)

#: surface: what is wrong -> (what the user does in a folder with the file ``there`` in it, the whole sentence)
USES: dict[str, tuple[Callable[[], Any], str]] = {
    "make_dmc_env: domain": (
        lambda: cartpole(domain="cartpol"),
        "'cartpol-swingup' is not a task of the DeepMind Control suite; the closest are "
        "cartpole-swingup, cartpole-swingup_sparse, acrobot-swingup (sb3_cure.envs.DMC_TASKS "
        "has all).",
    ),
    "make_dmc_env: task": (
        lambda: cartpole(task=None),
        "'cartpole-None' is not a task of the DeepMind Control suite; the closest are "
        "cartpole-balance, cartpole-two_poles, cartpole-swingup (sb3_cure.envs.DMC_TASKS has "
        "all).",
    ),
    "make_dmc_env: image_size": (
        lambda: cartpole(image_size="84"),
        "image_size='84' is not an integer of at least 1; use image_size=84, for example.",
    ),
    "make_dmc_env: frame_stack": (
        lambda: cartpole(frame_stack=0),
        "frame_stack=0 is not an integer of at least 1; use frame_stack=3, for example.",
    ),
    "make_dmc_env: action_repeat": (
        lambda: cartpole(action_repeat=2.5),
        "action_repeat=2.5 is not an integer of at least 1; use action_repeat=4, for example.",
    ),
    "make_dmc_env: renderer": (
        lambda: cartpole(renderer="slow"),
        "renderer='slow' is unknown; use 'dmc', or 'fast' for no shadows and reflections.",
    ),
    "make_dmc_env: render_mode": (
        lambda: cartpole(render_mode="human"),
        "render_mode='human' is not supported; use 'rgb_array', or None for no videos.",
    ),
    "replay buffer: size": (
        lambda: FrameStackReplayBuffer("9", STACK, ACTION, frame_stack=2),
        "buffer_size is '9' and n_envs 1, but both must be whole numbers of at least 1: change them.",
    ),
    "replay buffer: frame_stack": (
        lambda: FrameStackReplayBuffer(9, STACK, ACTION, frame_stack="2"),
        "frame_stack is '2', but it must be an integer of at least 1: pass the number of "
        "frames that one observation stacks.",
    ),
    "replay buffer: frames_dir is a file": (
        lambda: FrameStackReplayBuffer(9, STACK, ACTION, frame_stack=2, frames_dir="there"),
        "frames_dir is 'there', but {folder}/there is a file: name a folder, or remove the file.",
    ),
    "replay buffer: more than there can be": (
        lambda: FrameStackReplayBuffer(10**12, STACK, ACTION, frame_stack=2),
        "buffer_size is 1000000000000, for which the frames need 4043520 GB of memory: make it smaller, or keep the "
        "frames on a disk with replay_buffer_kwargs=dict(frames_dir=...).",
    ),
    "replay buffer: frames_dir is a number": (
        lambda: FrameStackReplayBuffer(9, STACK, ACTION, frame_stack=2, frames_dir=3),
        "frames_dir is 3, but it must be the path of a folder: give one.",
    ),
    "learn: total_timesteps": (
        lambda: model_of().learn(-1),
        "total_timesteps is -1, but it must be a whole number of agent steps: change total_timesteps.",
    ),
    "learn: total_timesteps in words": (
        lambda: model_of().learn("100"),
        "total_timesteps is '100', but it must be a whole number of agent steps: change total_timesteps.",
    ),
    "learn: total_timesteps in halves": (
        lambda: model_of().learn(10.5),
        "total_timesteps is 10.5, but it must be a whole number of agent steps: change total_timesteps.",
    ),
    "learn: log_interval": (
        lambda: model_of().learn(5, log_interval=0),
        "log_interval is 0, but it must be a whole number of at least 1: change log_interval.",
    ),
    "learn: the class of a callback": (
        lambda: watched(StopTrainingOnMaxEpisodes),
        "callback is <class 'stable_baselines3.common.callbacks.StopTrainingOnMaxEpisodes'>, "
        "but it must be a callback, a list of callbacks or a function of locals and globals: "
        "give an instance, not its class or name.",
    ),
    "learn: callbacks that are none": (
        lambda: watched(["a"]),
        "callback is ['a'], but it must be a callback, a list of callbacks or a function of "
        "locals and globals: give an instance, not its class or name.",
    ),
    "learn: tensorboard_log is a file": (
        lambda: model_of(tensorboard_log="there").learn(5),
        "tensorboard_log is 'there', but {folder}/there is a file: name a folder, or remove the file.",
    ),
    "learn: tensorboard_log in a file": (
        lambda: model_of(tensorboard_log="there/runs").learn(5),
        "tensorboard_log is 'there/runs', but {folder}/there is a file: name a folder, or remove the file.",
    ),
    "pretrain: total_timesteps": (
        lambda: model_of().pretrain(float("nan")),
        "total_timesteps is nan, but it must be a whole number of agent steps: change total_timesteps.",
    ),
    "pretrain: collector": (
        lambda: model_of().pretrain(5, collector="expert"),
        "pretrain got collector='expert', but data are collected by 'curious' or 'random': choose one.",
    ),
    "predict: images in [0, 1]": (
        lambda: model_of().predict(np.zeros((6, 36, 36), np.float32)),
        "the observation has values of type float32, but the policy reads Box(0, 255, (6, "
        "36, 36), uint8): give it as the environment returns it.",
    ),
    "predict: words": (
        lambda: model_of().predict("left"),
        "the observation has values of type <U4, but the policy reads Box(0, 255, (6, 36, "
        "36), uint8): give it as the environment returns it.",
    ),
    "predict: a dictionary": (
        lambda: model_of().predict({"camera": np.zeros((6, 36, 36), np.uint8)}),
        "the observation has a dictionary, but the policy reads Box(0, 255, (6, 36, 36), "
        "uint8): give it as the environment returns it.",
    ),
    "predict_curious: images in [0, 1]": (
        lambda: model_of().predict_curious(np.zeros((6, 36, 36))),
        "the observation has values of type float64, but the policy reads Box(0, 255, (6, "
        "36, 36), uint8): give it as the environment returns it.",
    ),
    "predict_curious: no curious policy": (
        lambda: model_of(curiosity=None).predict_curious(STACK.sample()),
        "predict_curious was called with curiosity=None, but only curiosity='separate' "
        "trains a curious policy: use predict, or train with curiosity='separate'.",
    ),
    "run_episodes: none": (
        lambda: next(run_episodes(model_of(), PixelBox(), 0)),
        "n_episodes is 0, but it must be a whole number of at least 1: change n_episodes.",
    ),
    "run_episodes: actor": (
        lambda: next(run_episodes(model_of(), PixelBox(), 1, "best")),
        "actor is 'best', but it must be one of 'task', 'curious', 'random': choose one.",
    ),
    "most_uncomfortable: k": (
        lambda: most_uncomfortable(model_of(), "all"),
        "k is 'all', gap 25 and chunk 128, but each must be at least 1: give numbers >= 1.",
    ),
    "most_uncomfortable: empty buffer": (
        lambda: most_uncomfortable(model_of()),
        "the model has nothing in its replay buffer: train it, or call load_replay_buffer first.",
    ),
    "EvalBothCallback: eval_freq": (
        lambda: EvalBothCallback(PixelBox(), eval_freq=1.5),
        "EvalBothCallback got eval_freq=1.5 and n_episodes=5, but each must be at least 1: give whole numbers >= 1.",
    ),
    "EvalBothCallback: n_episodes": (
        lambda: EvalBothCallback(PixelBox(), n_episodes=0),
        "EvalBothCallback got eval_freq=1000 and n_episodes=0, but each must be at least 1: give whole numbers >= 1.",
    ),
    "EvalBothCallback: no environment": (
        lambda: EvalBothCallback("Pendulum-v1"),
        "EvalBothCallback got eval_env='Pendulum-v1', but it watches one environment at a "
        "time: give one gymnasium.Env with the observations of training.",
    ),
    "EvalBothCallback: seed": (
        lambda: EvalBothCallback(PixelBox(), seed=-1),
        "EvalBothCallback got seed=-1, but it must be None or a whole number >= 0: change seed.",
    ),
    "EvalBothCallback: other observations": (
        lambda: watched(EvalBothCallback(VectorBox(), 5)),
        "EvalBothCallback got an eval_env with observations Box(-1.0, 1.0, (2,), float32) "
        "and actions Box(-1.0, 1.0, (2,), float32), but the model was made for Box(0, 255, "
        "(6, 36, 36), uint8) and Box(-1.0, 1.0, (2,), float32): make eval_env as the "
        "training environment.",
    ),
    "EvalBothCallback: other actions": (
        lambda: watched(EvalBothCallback(PixelBox(low=-2), 5)),
        "EvalBothCallback got an eval_env with observations Box(0, 255, (6, 36, 36), uint8) "
        "and actions Box(-2.0, 1.0, (2,), float32), but the model was made for Box(0, 255, "
        "(6, 36, 36), uint8) and Box(-1.0, 1.0, (2,), float32): make eval_env as the "
        "training environment.",
    ),
    "PolicyVideoCallback: every": (
        lambda: PolicyVideoCallback(Drawn(), "new", every="a"),
        "PolicyVideoCallback got every='a', but it counts agent steps: give a whole number >= 1.",
    ),
    "PolicyVideoCallback: fps": (
        lambda: PolicyVideoCallback(Drawn(), "new", fps="a"),
        "PolicyVideoCallback got fps='a', but a video needs at least 1: give a number >= 1.",
    ),
    "PolicyVideoCallback: render_mode": (
        lambda: PolicyVideoCallback(PixelBox(), "new"),
        "PolicyVideoCallback got an environment with render_mode=None, which gives no "
        "frames: make it with render_mode='rgb_array'.",
    ),
    "PolicyVideoCallback: folder is a file": (
        lambda: PolicyVideoCallback(Drawn(), "there"),
        "folder is 'there', but {folder}/there is a file: name a folder, or remove the file.",
    ),
    "PolicyVideoCallback: actors": (
        lambda: watched(PolicyVideoCallback(Drawn(), "new", actors=["best"])),
        "PolicyVideoCallback got actors=['best'], but of 'task', 'curious', 'random' this "
        "model has 'task', 'curious', 'random': choose of these.",
    ),
    "ReconstructionCallback: folder in a file": (
        lambda: ReconstructionCallback("there/pictures"),
        "folder is 'there/pictures', but {folder}/there is a file: name a folder, or remove the file.",
    ),
    "ReconstructionCallback: columns": (
        lambda: ReconstructionCallback("new", columns="a"),
        "ReconstructionCallback got columns='a', probe_updates=500 and max_rows=12, but they "
        "must be whole numbers of at least 1, 0 and 2: change them.",
    ),
    "ReconstructionCallback: observations": (
        lambda: ReconstructionCallback("new", observations=np.zeros((2, 6, 36, 36))),
        "ReconstructionCallback got observations of float64, but it draws images of uint8: "
        "give them as the environment returns them, stacked.",
    ),
    "ReconstructionCallback: frame_stack": (
        lambda: ReconstructionCallback("new", frame_stack=0),
        "ReconstructionCallback got frame_stack=0, but it counts frames: give a number >= 1.",
    ),
    "CuriosityMapCallback: bins": (
        lambda: CuriosityMapCallback(PixelBox(), "new", bins=0, **MAP),
        "CuriosityMapCallback got n_episodes=5 and bins=0, but each must be at least 1: give whole numbers >= 1.",
    ),
    "CuriosityMapCallback: state": (
        lambda: CuriosityMapCallback(PixelBox(), "new", state=3, names=["x", "y"]),
        "CuriosityMapCallback got state=3, but it must be a function of the environment that "
        "returns its true state: give one, or leave it out for tasks of dm_control.",
    ),
    "CuriosityMapCallback: coordinates": (
        lambda: CuriosityMapCallback(PixelBox(), "new", coordinates=3, **MAP),
        "coordinates are 3, but a map needs two of the state's: choose of x, y.",
    ),
    "load: missing": (
        lambda: CuReSAC.load("missing"),
        "there is neither a file 'missing' nor 'missing.zip': give the path that it was saved to.",
    ),
    "load: no archive": (
        lambda: CuReSAC.load("there"),
        "'there' is no zip file, or the end of it is missing: it was not written by this package, or was damaged "
        "since.",
    ),
    "load: folder": (lambda: CuReSAC.load("."), "'.' is a folder: give the path of a file in it."),
    "load: a replay buffer": (
        lambda: CuReSAC.load(saved("save_replay_buffer")),
        "'there' holds no model, but a replay buffer or a part of a checkpoint: read it with load_replay_buffer, or "
        "give resume the folder of the checkpoints.",
    ),
    "load: number": (
        lambda: CuReSAC.load(3),
        "got 3 for a file, but expected a path, or a file that is open in binary mode.",
    ),
    "load: environment": (
        lambda: CuReSAC.load("there", env=3),
        "env is 3, but it must be a Gymnasium environment, a VecEnv or a Gymnasium id: give one of them, for example "
        "make_dmc_env('cartpole', 'swingup').",
    ),
    "set_env: environment": (
        lambda: model_of().set_env(None),
        "env is None, but it must be a Gymnasium environment, a VecEnv or a Gymnasium id: give one of them, for "
        "example make_dmc_env('cartpole', 'swingup').",
    ),
    "load: custom_objects": (
        lambda: CuReSAC.load("there", custom_objects=3),
        "custom_objects is a int, but it must be a dict or None.",
    ),
    "save: folder is a file": (
        lambda: model_of().save("there/model"),
        "cannot write 'there/model.zip', as 'there' is a file: choose another path.",
    ),
    "save: number": (
        lambda: model_of().save(3),
        "got 3 for a file, but expected a path, or a file that is open in binary mode.",
    ),
    "load: other observations": (
        lambda: reloaded(PixelBox(size=40)),
        "the file was trained with the observations Box(0, 255, (6, 36, 36), uint8), but the environment has "
        "Box(0, 255, (6, 40, 40), uint8): make it as for that training (images: the same image_size, grayscale, "
        "frame_stack), or train anew.",
    ),
    "load: other actions": (
        lambda: reloaded(PixelBox(low=-2)),
        "the file was trained with the actions Box(-1.0, 1.0, (2,), float32), but the environment has "
        "Box(-2.0, 1.0, (2,), float32): give the environment that it was trained on, or train anew.",
    ),
    "set_parameters: missing": (
        lambda: model_of().set_parameters("missing"),
        "there is neither a file 'missing' nor 'missing.zip': give the path that it was saved to.",
    ),
    "load_replay_buffer: a model": (
        lambda: model_of().load_replay_buffer(saved("save")),
        "'there' holds a model: give what was written in this place, or read it with load.",
    ),
    "load_replay_buffer: missing": (
        lambda: model_of().load_replay_buffer("missing"),
        "there is neither a file 'missing' nor 'missing.pkl': give the path that it was saved to.",
    ),
    "load_replay_buffer: no buffer": (
        lambda: model_of().load_replay_buffer("there"),
        "'there' is no replay buffer that this package saved without pickle, and unpickling runs any code that is in "
        "a file: if you know where it comes from, load it with trusted=True.",
    ),
    "resume: missing": (
        lambda: CuReSAC.resume("missing", PixelBox()),
        "there is no checkpoint in missing: give the path of an ExactCheckpoint that has begun a training, or start "
        "one.",
    ),
    "resume: file": (
        lambda: CuReSAC.resume("there", PixelBox()),
        "there is no checkpoint in there: give the path of an ExactCheckpoint that has begun a training, or start one.",
    ),
    "resume: number": (
        lambda: CuReSAC.resume(3, PixelBox()),
        "resume got path=3, but it must be the folder of an ExactCheckpoint: give it.",
    ),
    "resume: no environment": (
        lambda: CuReSAC.resume("there", None),
        "resume got no environment: give those of the training, made as they were then.",
    ),
    "resume: environment": (
        lambda: CuReSAC.resume("there", 3),
        "env is 3, but it must be a Gymnasium environment, a VecEnv or a Gymnasium id: give one of them, for example "
        "make_dmc_env('cartpole', 'swingup').",
    ),
    "ExactCheckpoint: save_freq": (
        lambda: ExactCheckpoint(0, "new"),
        "ExactCheckpoint got save_freq=0, but it must be a whole number of at least 1: change save_freq.",
    ),
    "ExactCheckpoint: keep": (
        lambda: ExactCheckpoint(10, "new", keep=1.5),
        "ExactCheckpoint got keep=1.5, but it must be a whole number of at least 1: change keep.",
    ),
    "ExactCheckpoint: path": (
        lambda: ExactCheckpoint(10, 3),
        "ExactCheckpoint got path=3, but it must be the path of a folder: give one.",
    ),
    "ExactCheckpoint: path is a file": (
        lambda: model_of().learn(3, callback=ExactCheckpoint(10, "there")),
        "ExactCheckpoint cannot write to there (File exists): choose another path.",
    ),
    "ExactCheckpoint: algorithm": (
        lambda: SAC("MlpPolicy", VectorBox(), buffer_size=10).learn(3, callback=ExactCheckpoint(10, "new")),
        "ExactCheckpoint got a SAC, but only CuReSAC can resume exactly: use SB3's CheckpointCallback, or CuReSAC "
        "(with srl=None, curiosity=None it is SB3's SAC).",
    ),
}


@pytest.mark.parametrize("name", USES)
def test_uses(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The whole sentence, and nothing is written."""
    monkeypatch.chdir(tmp_path)
    Path("there").write_text("a file")
    do, sentence = USES[name]
    with pytest.raises((ValueError, OSError)) as error:
        do()
    assert (str(error.value), files_in(tmp_path)) == (sentence.replace("{folder}", str(tmp_path)), ["there"])
    assert is_one_sentence(str(error.value))


def files_in(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def test_a_gpu_that_is_not_there_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """As with SB3 the model is on the CPU then, which nobody would notice otherwise."""
    monkeypatch.setattr(th.cuda, "is_available", lambda: False)
    with pytest.warns(
        UserWarning, match="device is 'cuda', but PyTorch finds no such device here: the model is on the"
    ):
        model = model_of(device="cuda")
    assert model.device.type == "cpu"
