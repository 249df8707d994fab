"""CuRe's own arguments: what is out of range, or would train something else than was asked for, is refused."""

from typing import Any

import numpy as np
import pytest
from envs_for_tests import PixelBox, VectorBox, tiny_model
from gymnasium import spaces
from stable_baselines3.common.buffers import NStepReplayBuffer
from stable_baselines3.common.envs import SimpleMultiObsEnv
from stable_baselines3.sac.policies import MultiInputPolicy

from sb3_cure import CuReSAC, CuReTQC
from sb3_cure.cure.arguments import CuReArguments
from sb3_cure.intrinsic import IntrinsicReward

BAD: dict[str, list[Any]] = {
    "srl": [3, "autoencoder"],
    "srl_kwargs": [["bits"]],
    "srl_schedule": ["in turn"],
    "srl_period": [0, 2.5],
    "intrinsic": ["novelty", 1],
    "intrinsic_kwargs": [1],
    "curiosity": ["always", True],
    "curiosity_prob": [-0.1, 1.1, "often"],
    "curiosity_bout": [0.5, "forever"],
    "curiosity_beta": [-1.0, float("inf")],
    "curiosity_gamma": [1.01],
    "curiosity_ent_coef": [-1.0],
    "curiosity_episodic": ["yes"],
    "normalize_curiosity": [2],
    "curiosity_target": ["state"],
    "curiosity_encoder_grad": [None],
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
    "on_bad_transition": ["ignore"],
}


def test_table_names_every_argument() -> None:
    assert BAD.keys() == CuReArguments.model_fields.keys()


@pytest.mark.parametrize("name, value", [(name, value) for name, values in BAD.items() for value in values])
def test_bad_value_is_named(name: str, value: Any) -> None:
    with pytest.raises(ValueError, match=rf"^{name} is ") as caught:
        tiny_model("CnnPolicy", PixelBox(), **{name: value})
    assert "\n" not in str(caught.value)


class FromNothing(IntrinsicReward):
    """Needs no SRL."""

    def loss(self, inputs: Any) -> Any:
        return None, inputs.batch.rewards[:, 0].square()


@pytest.mark.parametrize(
    "arguments, sentence",
    [
        (dict(srl=None, srl_kwargs=dict(bits=5), curiosity=None), "srl_kwargs is"),
        (dict(srl=None), "srl is None"),
        (dict(srl=None, curiosity="bonus"), "srl is None"),
        (dict(task=False, curiosity="bonus"), "task=False leaves nothing to learn"),
        (dict(curiosity_gamma=0), "curiosity_gamma=0"),
        (dict(n_steps=3, curiosity="bonus"), "n_steps=3"),
        (dict(replay_buffer_class=NStepReplayBuffer), "give n_steps"),
        (dict(use_sde=True), "use_sde=True"),
        (dict(srl="curl", augmentation=None), "augmentation is None"),
        (dict(augmentation="crop"), "cuts 84 x 84 pixels out of images of 36 x 36"),
    ],
)
def test_combination_that_learns_something_else_is_refused(arguments: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        tiny_model("CnnPolicy", PixelBox(), **arguments)


def test_reward_without_srl_trains_without_head() -> None:
    model = tiny_model("CnnPolicy", PixelBox(), srl=None, intrinsic=FromNothing).learn(14)
    assert model.policy.srl is None and model._n_updates == 4


def test_numpy_numbers_and_schedules_are_accepted() -> None:
    arguments: dict[str, Any] = dict(srl_period=np.int64(3), curiosity_beta=np.float32(0.5), curiosity_bout=np.int64(2))
    tiny_model("MlpPolicy", VectorBox(), curiosity_prob=lambda progress: progress, **arguments).learn(12)


def test_attribute_changed_to_nonsense_is_refused_by_the_next_load() -> None:
    model = tiny_model("MlpPolicy", VectorBox())
    model.update = "together"
    with pytest.raises(ValueError, match="update is 'together'"):
        model._setup_model()


def test_contrast_needs_images() -> None:
    with pytest.raises(ValueError, match="two views of one image"):
        tiny_model("MlpPolicy", VectorBox(), srl="curl")


def test_images_of_floats_are_refused() -> None:
    """Encoder and buffer would cast them to bytes, without a word."""
    env = PixelBox()
    env.observation_space = spaces.Box(0, 1, env.observation_space.shape, np.float32)
    with pytest.raises(ValueError, match=r"images arrive as float32"):
        tiny_model("CnnPolicy", env)


@pytest.mark.parametrize("cls", [CuReSAC, CuReTQC])
def test_dictionaries_of_sb3s_own_environment(cls: type[CuReSAC]) -> None:
    """With everything on and off; another policy is refused in SB3's words, or in ours where it is not one of them."""
    env = SimpleMultiObsEnv(discrete_actions=False)
    tiny_model("MultiInputPolicy", env, cls, learning_starts=5, buffer_size=20).learn(7)
    cls("MultiInputPolicy", env, srl=None, curiosity=None, buffer_size=20, learning_starts=5).learn(7)
    with pytest.raises(ValueError, match="You must use `MultiInputPolicy`"):
        cls("CnnPolicy", env)
    with pytest.raises(ValueError, match="a kind of CuRePolicy: use 'CnnPolicy', 'MlpPolicy' or 'MultiInputPolicy'"):
        cls(MultiInputPolicy, env)


@pytest.mark.parametrize("name", ["learning_rat", "srl_kwarg"])
def test_unknown_argument_is_an_error(name: str) -> None:
    with pytest.raises(TypeError, match=name):
        CuReSAC("MlpPolicy", VectorBox(), **{name: 1})
    with pytest.raises(TypeError, match=name):
        tiny_model("MlpPolicy", VectorBox(), policy_kwargs={name: 1})
    with pytest.raises(TypeError, match=name):
        tiny_model("MlpPolicy", VectorBox(), srl_kwargs={name: 1})
