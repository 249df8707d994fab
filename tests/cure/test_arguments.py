"""CuRe's own arguments: what is out of range, or would train something else than was asked for, is refused."""

import contextlib
import inspect
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from dictionaries_for_tests import Goal
from envs_for_tests import PixelBox, VectorBox, tiny_model
from gymnasium import spaces
from stable_baselines3 import SAC, HerReplayBuffer
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.callbacks import EvalCallback, EveryNTimesteps
from stable_baselines3.common.torch_layers import NatureCNN
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv
from stable_baselines3.sac.policies import CnnPolicy, MultiInputPolicy

from sb3_cure import CuReSAC
from sb3_cure.cure.base import CuReBase
from sb3_cure.data.buffers import FrameStackReplayBuffer
from sb3_cure.envs.wrappers import ActionRepeat
from sb3_cure.vec_env import FaultTolerantSubprocVecEnv

BAD: dict[str, list[Any]] = {
    "srl": [3, "autoencoder"],
    "srl_kwargs": [["bits"]],
    "srl_schedule": ["in turn"],
    "srl_period": [0],
    "srl_interval": [0],
    "intrinsic": ["novelty"],
    "intrinsic_kwargs": [1],
    "curiosity": [True],
    "curiosity_prob": [-0.1, 1.1, "often"],
    "curiosity_bout": [0.5, "forever"],
    "curiosity_beta": [-1.0, float("inf")],
    "curiosity_gamma": [1.01],
    "curiosity_ent_coef": [-1.0],
    "curiosity_episodic": ["yes"],
    "normalize_curiosity": [2],
    "curiosity_target": ["state"],
    "curiosity_encoder_grad": [None],
    "curious_interval": [0],
    "task": ["cartpole"],
    "augmentation": ["flip"],
    "augmentation_kwargs": [4],
    "warmup_updates": [-1],
    "actor_update_interval": [0],
    "encoder_tau": [1.5],
    "ent_coef_lr_factor": [-0.1],
    "update": ["together"],
    "precision": ["fp16"],
    "overlap": ["no"],
}


def test_bad_values_are_named() -> None:
    """Of each argument that SB3 does not have."""
    ours = inspect.signature(CuReBase.__init__).parameters.keys() - inspect.signature(SAC).parameters.keys()
    assert BAD.keys() == ours - {"self", "_init_setup_model", "kwargs"}
    for name, values in BAD.items():
        for value in values:
            with pytest.raises(ValueError, match=name) as caught:
                tiny_model("CnnPolicy", PixelBox(), **{name: value})
            assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "arguments, sentence",
    [
        (dict(srl=None, srl_kwargs=dict(bits=5), curiosity=None), "srl_kwargs is"),
        (dict(srl=None, intrinsic="srl_error"), "srl is None"),
        (dict(task=False, curiosity="bonus"), "task=False leaves nothing to learn"),
        (dict(task=False, curiosity="random", srl=None), "task=False leaves nothing to learn"),
        (dict(policy_kwargs=dict(update="sequential")), r"policy_kwargs has \['update'\]"),
        (dict(curiosity_gamma=0), "curiosity_gamma=0"),
        (dict(n_steps=3, curiosity="bonus"), "n_steps=3"),
        (dict(n_steps=3, replay_buffer_class=ReplayBuffer), "leave replay_buffer_class out, and set n_steps"),
        (dict(replay_buffer_class=NStepReplayBuffer), "leave replay_buffer_class out, and set n_steps"),
        (dict(optimize_memory_usage=True, replay_buffer_class=ReplayBuffer), "optimize_memory_usage=True"),
        (dict(use_sde=True), "use_sde=True"),
        (dict(curiosity_ent_coef="auto_0"), "'auto_0' must begin above 0"),
        (dict(srl="curl", augmentation=None), "augmentation is None"),
        (
            dict(srl="curl", augmentation=None, policy_kwargs=dict(features_extractor_class=NatureCNN)),
            "augmentation is None",
        ),
        (dict(overlap=True, replay_buffer_class=HerReplayBuffer), "overlap=False"),
        (dict(augmentation="crop", augmentation_kwargs=dict(size=84)), "cannot cut 84 x 84 pixels out of images of 36"),
    ],
)
def test_combination_that_learns_something_else_is_refused(arguments: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        tiny_model("CnnPolicy", PixelBox(), **arguments)


@pytest.mark.parametrize(
    "reward", [dict(intrinsic="rnd"), dict(srl="curl"), dict(srl="forward", intrinsic="srl_error")]
)
def test_rewards_of_the_next_observation_need_no_future(reward: dict[str, Any]) -> None:
    """Unlike the error of the observation itself."""
    tiny_model("CnnPolicy", PixelBox(), curiosity_gamma=0, **reward)


def test_instances_of_heads_and_rewards_are_refused() -> None:
    """In one sentence: the text of a module takes many lines."""
    policy: Any = tiny_model("CnnPolicy", PixelBox(), intrinsic="rnd").policy
    for argument, given in (("srl", policy.srl), ("intrinsic", policy.intrinsic)):
        with pytest.raises(ValueError, match=rf"^{argument} is an instance of {type(given).__name__}.*class itself"):
            tiny_model("CnnPolicy", PixelBox(), **{argument: given})


def test_subclass_of_the_replay_buffer_is_told_the_frames() -> None:
    class Own(FrameStackReplayBuffer):
        pass

    class Knows(FrameStackReplayBuffer):
        def __init__(self, buffer_size: int, *args: Any, **kwargs: Any):
            super().__init__(buffer_size, *args, frame_stack=3, **kwargs)

    for buffer in (Own, Knows):
        model = tiny_model("CnnPolicy", PixelBox(frame_stack=3), replay_buffer_class=buffer).learn(12)
        assert model.replay_buffer.frame_stack == 3


@pytest.mark.parametrize("policy, env", [(CnnPolicy, PixelBox), (MultiInputPolicy, Goal)])
def test_policies_of_sb3_are_refused(policy: Any, env: Any) -> None:
    with pytest.raises(ValueError, match="no shared encoder: use 'CnnPolicy', 'MlpPolicy' or 'MultiInputPolicy'"):
        CuReSAC(policy, env())


def test_evaluation_in_the_training_environment_is_refused() -> None:
    """Also of a callback in another one."""
    env = DummyVecEnv([VectorBox])
    callback = EveryNTimesteps(5, EvalCallback(env))
    with pytest.raises(ValueError, match="EvalCallback evaluates in the training environment"):
        tiny_model("MlpPolicy", env).learn(5, callback=[callback])
    tiny_model("MlpPolicy", env).learn(5, callback=EvalCallback(DummyVecEnv([VectorBox]), eval_freq=10))


def test_hindsight_with_restarting_workers_is_refused() -> None:
    """Other buffers than this package's cannot leave out the steps of workers that died."""
    her: dict[str, Any] = dict(replay_buffer_class=HerReplayBuffer, learning_starts=20)
    venv = FaultTolerantSubprocVecEnv([Goal], on_env_fault="restart")
    try:
        with pytest.raises(ValueError, match="use on_env_fault='raise', or leave replay_buffer_class out"):
            tiny_model("MultiInputPolicy", venv, **her).learn(10)
    finally:
        venv.close()


@pytest.mark.parametrize("vec_env", [DummyVecEnv, SubprocVecEnv])
@pytest.mark.parametrize("wrapper", [ActionRepeat, gym.wrappers.RepeatAction])
def test_hindsight_with_repeated_actions_is_refused(wrapper: Any, vec_env: Any) -> None:
    """Rewards of the goals that were reached are computed for one step, those that are stored are sums."""
    with (
        contextlib.closing(vec_env([lambda: wrapper(Goal(), 2)])) as env,
        pytest.raises(ValueError, match="use action_repeat=1"),
    ):
        tiny_model("MultiInputPolicy", env, replay_buffer_class=HerReplayBuffer, learning_starts=20).learn(10)


def test_images_of_floats_are_refused() -> None:
    """They would be read as long vectors."""
    env = PixelBox()
    env.observation_space = spaces.Box(0, 1, env.observation_space.shape, np.float32)
    with pytest.raises(ValueError, match="if it is an image, return it as uint8"):
        tiny_model("CnnPolicy", env)


def test_pretraining_needs_a_head_and_a_collector() -> None:
    with pytest.raises(ValueError, match="srl is None"):
        tiny_model("CnnPolicy", PixelBox(), srl=None, curiosity=None).pretrain(10)
    with pytest.raises(ValueError, match="'nobody'"):
        tiny_model("CnnPolicy", PixelBox()).pretrain(10, collector="nobody")


def test_numbers_of_numpy_and_schedules_are_accepted() -> None:
    """As from ``numpy.arange``; some are compared to Python's in every update."""
    arguments: dict[str, Any] = dict(
        srl_schedule="alternating", srl_period=np.int64(3), actor_update_interval=np.int64(2),
        curiosity_beta=np.float32(0.5), curiosity_bout=np.int64(2), curiosity_prob=lambda progress: progress,
    )  # fmt: skip
    tiny_model("MlpPolicy", VectorBox(), **arguments).learn(20)


def test_numbers_as_files_have_them_are_converted() -> None:
    """YAML reads 1e1 as a float and 1e-1 as a string: the model would stop after its warm-up, maybe hours later."""
    arguments: dict[str, Any] = dict(warmup_updates=1e1, srl_interval="2", encoder_tau="5e-2", curiosity_beta="0.5")
    model = tiny_model("MlpPolicy", VectorBox(), **arguments)
    assert [getattr(model, name) for name in arguments] == [10, 2, 0.05, 0.5]
    assert isinstance(model.warmup_updates, int)


@pytest.mark.parametrize("name", ["learning_rat", "srl_kwarg"])
def test_unknown_argument_is_an_error(name: str) -> None:
    for arguments in ({name: 1}, {"policy_kwargs": {name: 1}}, {"srl_kwargs": {name: 1}}):
        with pytest.raises(TypeError, match=name):
            tiny_model("MlpPolicy", VectorBox(), **arguments)


@pytest.mark.parametrize("extras", [{}, {"srl": None, "curiosity": None}])
def test_users_dictionaries_stay_as_they_were(extras: dict[str, Any]) -> None:
    """One dictionary of settings can serve several models and be written down afterwards."""
    given: dict[str, Any] = {"policy_kwargs": {"net_arch": [8]}, "replay_buffer_kwargs": {}, "srl_kwargs": {}}
    CuReSAC("MlpPolicy", VectorBox(), buffer_size=10, device="cpu", **given, **extras)
    assert given == {"policy_kwargs": {"net_arch": [8]}, "replay_buffer_kwargs": {}, "srl_kwargs": {}}
