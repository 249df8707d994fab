"""What is saved and loaded acts alike and learns on alike, whatever is switched on."""

import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from envs_for_tests import PixelBox, VectorBox, differences, samples_of, state_of, tiny_model
from gymnasium import spaces
from stable_baselines3.common.callbacks import CheckpointCallback
from stable_baselines3.common.vec_env import DummyVecEnv
from torch import nn

from sb3_cure import CuReSAC, CuReTQC
from sb3_cure.cure.policies import CnnPolicy, CuRePolicy
from sb3_cure.data.buffers import FrameStackReplayBuffer
from sb3_cure.data.samples import Samples
from sb3_cure.networks.encoders import Encoder
from sb3_cure.srl import SRLHead, SRLOutput


class Denoising(SRLHead):
    """A user's head: draw the image from noisy latents."""

    def __init__(self, encoder: Encoder, observation_space: spaces.Box, noise: float = 0.1):
        super().__init__(encoder, observation_space)
        self.noise = noise
        self.decoder = nn.Linear(encoder.features_dim, int(np.prod(observation_space.shape)))

    def loss(self, batch: Samples, latents: th.Tensor, next_latents: th.Tensor | None = None) -> SRLOutput:
        error = self.error(batch, latents + self.noise * th.randn_like(latents))
        return SRLOutput(error.mean(), error.detach())

    def error(self, batch: Samples, latents: th.Tensor) -> th.Tensor:
        return (self.decoder(latents) - (batch.views.float() / 255).flatten(1)).square().mean(dim=1)

    def reconstruct(self, latents: th.Tensor) -> th.Tensor:
        drawn = self.decoder(latents).view(-1, *self.observation_space.shape)
        return (255 * drawn).clamp(0, 255).to(th.uint8)


IMAGES = np.random.default_rng(0).integers(0, 256, (5, 6, 36, 36), dtype=np.uint8)


def predictions(model: CuReSAC, observations: np.ndarray = IMAGES) -> list[np.ndarray]:
    """Deterministic actions of the task policy and, if there is one, of the curious one."""
    actions = [model.predict(observations, deterministic=True)[0]]
    if model.policy.curious is not None:
        actions.append(model.predict_curious(observations, deterministic=True)[0])
    return actions


def srl_errors(model: CuReSAC) -> th.Tensor | None:
    """The head's noise-free error of the test images, as used for measuring."""
    policy = model.policy
    if policy.srl is None:
        return None
    images = th.as_tensor(IMAGES)
    actions = th.linspace(-1, 1, 2 * len(images)).view(-1, 2)
    views = policy.augmentation.center(images)
    batch = Samples(images, actions, images.flip(0), None, None, views=views)  # type: ignore[arg-type]
    with th.no_grad():
        return policy.srl.error(batch, policy.encode(batch.observations))


def learn_on(model: CuReSAC, env: gym.Env, total_timesteps: int) -> dict[str, Any]:
    """State and stored actions after learning on, from a given seed of the global generators and the environment."""
    model.set_env(env)
    model.set_random_seed(11)
    model.learn(total_timesteps, reset_num_timesteps=False)
    buffer = model.replay_buffer
    stored = {"actions": buffer.actions[: buffer.pos].copy(), "rewards": buffer.rewards[: buffer.pos].copy()}
    return {**state_of(model), **stored}


def objects_of(model: CuReSAC) -> dict[str, Any]:
    """What of the model no archive holds: the user's own head and functions."""
    objects = {name: getattr(model, name) for name in ("srl", "curiosity_prob")}
    return {name: value for name, value in objects.items() if callable(value)}


def check_save_load(
    model: CuReSAC, make_env: Callable[[], gym.Env], path: Path, observations: np.ndarray = IMAGES
) -> CuReSAC:
    """Saved and loaded: the same state, the same actions; and after learning on the same state and actions again."""
    model.save(path / "model")
    model.save_replay_buffer(path / "buffer")
    loaded = type(model).load(path / "model", env=make_env(), device="cpu", custom_objects=objects_of(model))
    loaded.load_replay_buffer(path / "buffer")
    assert differences(state_of(model), state_of(loaded)) == []
    expected = predictions(model, observations)
    assert differences(expected, predictions(loaded, observations)) == []
    if observations is IMAGES:
        assert differences(srl_errors(model), srl_errors(loaded)) == []
    assert differences(learn_on(model, make_env(), 8), learn_on(loaded, make_env(), 8)) == []
    # Something was learned meanwhile, or the comparison would be idle.
    assert differences(expected, predictions(loaded, observations))
    return loaded


# --------------------------------------------------- same actions, same update


@pytest.mark.parametrize(
    ("srl", "curiosity", "update"),
    [
        ("rae", "separate", "sequential"),
        ("rae", "bonus", "joint"),
        ("rae", None, "sequential"),
        ("curl", "separate", "joint"),
        ("curl", "bonus", "sequential"),
        ("curl", "random", "joint"),
        ("vae", "separate", "sequential"),
        ("spr", "separate", "joint"),
        ("forward", "bonus", "sequential"),
        ("inverse", "separate", "joint"),
        (Denoising, "separate", "joint"),
        (Denoising, "random", "sequential"),
    ],
)
def test_loaded_model_acts_and_learns_alike(
    srl: str | type[SRLHead], curiosity: str | None, update: str, tmp_path: Path
) -> None:
    """Every head, kind of curiosity and update: identical actions of both policies, identical learning afterwards.

    Saved after an odd number of updates, so that the clock of actors and targets matters, with a mixing probability
    of a half, so that the mixer's random stream matters.
    """
    model = tiny_model("CnnPolicy", PixelBox(), srl=srl, curiosity=curiosity, update=update, curiosity_prob=0.5)
    model.learn(21)
    assert model._n_updates == 11
    if curiosity in ("separate", "bonus"):
        assert model.policy.scale.weight > 0 and model.policy.scale.variance > 0
    if srl == "curl":
        assert model.policy.srl.bank_filled == 64 and model.policy.srl.bank.any()
    check_save_load(model, PixelBox, tmp_path)


VARIANTS: dict[str, dict[str, Any]] = {
    "no task": dict(task=False),
    "no SRL on the shared encoder": dict(srl=None, curiosity=None, policy_kwargs=dict(share_encoder=True)),
    "fixed temperature": dict(ent_coef=0.05),
    "alternating": dict(srl_schedule="alternating", srl_period=4),
    "scheduled mixing": dict(curiosity_prob=lambda progress: 0.5 * progress),
    "curious about the next observation": dict(curiosity_gamma=0.0, curiosity_target="next_observation"),
    "curious critics do not train the encoder": dict(curiosity_encoder_grad=False, update="joint"),
    "bare curious reward": dict(normalize_curiosity=False, curiosity_beta=3.0),
    "crops": dict(srl="curl", srl_kwargs=dict(bank_size=9), augmentation="crop", augmentation_kwargs=dict(size=30)),
    "head's arguments": dict(srl=Denoising, srl_kwargs=dict(noise=0.3)),
    "three environments": dict(n_envs=3),
}


@pytest.mark.parametrize("name", VARIANTS)
def test_variants_act_and_learn_alike(name: str, tmp_path: Path) -> None:
    """The same for the other arguments."""
    variant = dict(VARIANTS[name])
    n_envs = variant.pop("n_envs", 1)

    def make_env() -> DummyVecEnv:
        return DummyVecEnv([PixelBox] * n_envs)

    model = tiny_model("CnnPolicy", make_env(), **variant).learn(21)
    loaded = check_save_load(model, make_env, tmp_path)
    variant.pop("policy_kwargs", None)
    assert {key: getattr(loaded, key) for key in variant if not callable(variant[key])} == {
        key: value for key, value in variant.items() if not callable(value)
    }


def test_vectors_act_and_learn_alike(tmp_path: Path) -> None:
    """The same for MlpPolicy."""
    model = tiny_model("MlpPolicy", VectorBox()).learn(21)
    check_save_load(model, VectorBox, tmp_path, observations=np.eye(2, dtype=np.float32))


@pytest.mark.parametrize(
    ("policy", "update", "curiosity"), [("CnnPolicy", "joint", "separate"), ("MlpPolicy", "sequential", None)]
)
def test_quantile_critics_act_and_learn_alike(policy: str, update: str, curiosity: str | None, tmp_path: Path) -> None:
    """The same for CuReTQC, whose quantiles are dropped after loading as before."""
    make_env, observations = (PixelBox, IMAGES) if policy == "CnnPolicy" else (VectorBox, np.eye(2, dtype=np.float32))
    kwargs: dict[str, Any] = dict(update=update, curiosity=curiosity, policy_kwargs=dict(n_quantiles=7, n_critics=3))
    model = tiny_model(policy, make_env(), CuReTQC, top_quantiles_to_drop_per_net=1, **kwargs).learn(21)
    loaded = check_save_load(model, make_env, tmp_path, observations)
    assert type(loaded) is CuReTQC and loaded.top_quantiles_to_drop_per_net == 1
    assert loaded.policy.critic.state_dict().keys() == model.policy.critic.state_dict().keys()


def test_archive_holds_each_network_once(tmp_path: Path) -> None:
    """Networks and optimisers are saved as tensors, and not with the settings once more."""
    model = tiny_model("CnnPolicy", PixelBox(), policy_kwargs=dict(net_arch=[400, 400])).learn(12)
    model.save(tmp_path / "model.zip")
    attributes = zipfile.ZipFile(tmp_path / "model.zip").getinfo("data").file_size
    assert attributes < 100_000 < 4 * sum(parameter.numel() for parameter in model.policy.actor.parameters())


def test_loaded_model_can_be_saved(tmp_path: Path) -> None:
    """A loaded model can be saved and loaded again."""
    model = tiny_model("CnnPolicy", PixelBox()).learn(15)
    model.save(tmp_path / "first")
    CuReSAC.load(tmp_path / "first").save(tmp_path / "second")
    assert differences(state_of(model), state_of(CuReSAC.load(tmp_path / "second"))) == []


def test_bank_goes_on_from_set_parameters() -> None:
    """CURL's bank of negatives goes on filling from where the parameters that were set had it."""
    young, old = (tiny_model("CnnPolicy", PixelBox(), srl="curl").learn(steps) for steps in (11, 21))
    assert (young.policy.srl.bank_filled, old.policy.srl.bank_filled) == (8, 64)
    old.set_parameters(young.get_parameters())
    assert differences(srl_errors(young), srl_errors(old)) == []
    old.train(1, batch_size=8)
    assert old.policy.srl.bank_filled == 16


# ------------------------------------------------------- other circumstances


@pytest.mark.parametrize("saved_with, loaded_with", [(1, 3), (3, 1)])
def test_load_with_other_number_of_environments(saved_with: int, loaded_with: int, tmp_path: Path) -> None:
    """The number of environments is not part of the model."""
    model = tiny_model("CnnPolicy", DummyVecEnv([PixelBox] * saved_with)).learn(21)
    model.save(tmp_path / "model")
    loaded = CuReSAC.load(tmp_path / "model", env=DummyVecEnv([PixelBox] * loaded_with))
    assert differences(predictions(model), predictions(loaded)) == []
    assert loaded.replay_buffer.n_envs == loaded.n_envs == loaded_with
    steps, updates = model.num_timesteps, model._n_updates
    loaded.learn(12, reset_num_timesteps=False)
    assert (loaded.num_timesteps, loaded._n_updates) == (steps + 12, updates + 12)
    assert loaded.replay_buffer.pos == 12 // loaded_with


def test_load_without_environment(tmp_path: Path) -> None:
    """An archive is enough to predict, and to learn on once there is an environment."""
    model = tiny_model("CnnPolicy", PixelBox()).learn(15)
    model.save(tmp_path / "model")
    loaded = CuReSAC.load(tmp_path / "model")
    assert loaded.env is None
    assert differences(predictions(model), predictions(loaded)) == []
    loaded.set_env(PixelBox())
    loaded.learn(5, reset_num_timesteps=False)
    assert (loaded.num_timesteps, loaded._n_updates) == (20, 10)


def test_load_with_environment_id(tmp_path: Path) -> None:
    """As the constructor takes it."""
    tiny_model("MlpPolicy", "Pendulum-v1").save(tmp_path / "model")
    loaded = CuReSAC.load(tmp_path / "model", env="Pendulum-v1")
    assert loaded.learn(5).num_timesteps == 5


def test_arguments_given_to_load_apply(tmp_path: Path) -> None:
    """``load(..., name=value)`` replaces arguments, also the one that the mixer keeps."""
    tiny_model("CnnPolicy", PixelBox(), curiosity_prob=0.0).learn(15).save(tmp_path / "model")
    loaded = CuReSAC.load(tmp_path / "model", env=PixelBox(), curiosity_prob=1.0, learning_rate=0.0)
    before = {name: value.clone() for name, value in loaded.policy.named_parameters()}
    asked = []
    loaded.policy.curious.actor.register_forward_hook(lambda *_: asked.append(1))
    loaded.learn(6, reset_num_timesteps=False)
    assert len(asked) == 6
    # A learning rate of zero moves nothing but the targets, towards the networks.
    moved = differences(before, dict(loaded.policy.named_parameters()))
    assert moved and all("target" in name for name in moved)


def test_misspelt_arguments_of_load_are_refused(tmp_path: Path) -> None:
    """They are refused rather than ignored."""
    tiny_model("MlpPolicy", VectorBox()).save(tmp_path / "model")
    with pytest.raises(TypeError, match="load has 'batchsize', but CuReSAC has no such setting"):
        CuReSAC.load(tmp_path / "model", batchsize=8)


def test_own_objects_given_to_load(tmp_path: Path) -> None:
    """What no archive holds may be given as an argument, too."""
    model = tiny_model("MlpPolicy", VectorBox())
    model.teacher = model.policy.actor  # type: ignore[attr-defined]
    model.save(tmp_path / "model")
    assert CuReSAC.load(tmp_path / "model", teacher="me").teacher == "me"  # type: ignore[attr-defined]


@pytest.mark.parametrize("change", [dict(update="sequential"), dict(curiosity_encoder_grad=False)], ids=str)
def test_loading_into_another_algorithm_is_refused(change: dict[str, Any], tmp_path: Path) -> None:
    """The encoder's optimiser states belong to the sources and the mode that they were made with."""
    tiny_model("CnnPolicy", PixelBox()).learn(12).save(tmp_path / "model")
    with pytest.raises(RuntimeError, match="the saved encoder was trained by"):
        CuReSAC.load(tmp_path / "model", **change)


# ------------------------------------------------------------ a user's own head


def test_users_head_trains() -> None:
    """A head of 20 lines: its parameters and the encoder move, and its loss falls."""
    model = tiny_model("CnnPolicy", PixelBox(), srl=Denoising, curiosity=None, learning_starts=60, learning_rate=3e-3)
    model.learn(61)
    before = state_of(model)["policy"]
    first = srl_loss(model)
    model.train(60, batch_size=16)
    assert srl_loss(model) < 0.5 * first
    moved = differences(before, state_of(model)["policy"])
    assert {".srl.decoder.weight", ".srl.decoder.bias", ".encoder.trunk.0.weight"} <= set(moved)


def srl_loss(model: CuReSAC) -> float:
    policy = model.policy
    np.random.seed(0)
    batch = samples_of(model, 64)
    with th.no_grad():
        return policy.srl.error(batch, policy.encode(batch.observations)).mean().item()


def test_custom_objects_supply_a_head(tmp_path: Path) -> None:
    """An archive holds no class of the user's: it says which one it was, and ``custom_objects`` supplies it."""
    model = tiny_model("CnnPolicy", PixelBox(), srl=Denoising).learn(15)
    model.save(tmp_path / "model")
    with pytest.raises(ValueError, match=r"the class .*test_save_load\.Denoising.*custom_objects=\{'srl': \.\.\.\}"):
        CuReSAC.load(tmp_path / "model")
    loaded = CuReSAC.load(tmp_path / "model", custom_objects={"srl": Denoising})
    assert type(loaded.policy.srl) is Denoising
    assert differences(predictions(model), predictions(loaded)) == []
    assert differences(state_of(model), state_of(loaded)) == []


# -------------------------------------------------- replay buffer, checkpoints


def test_frame_stack_buffer_survives(tmp_path: Path) -> None:
    """A saved and loaded FrameStackReplayBuffer gives the same batches, and more can be added to it."""
    model = tiny_model("CnnPolicy", DummyVecEnv([PixelBox] * 2)).learn(50)
    assert type(model.replay_buffer) is FrameStackReplayBuffer
    model.save_replay_buffer(tmp_path / "buffer")
    other = tiny_model("CnnPolicy", DummyVecEnv([PixelBox] * 2), seed=4)
    other.load_replay_buffer(tmp_path / "buffer")
    batches = []
    for owner in (model, other):
        np.random.seed(0)
        batches.append(owner.replay_buffer.sample(100)._asdict())
    assert differences(*batches) == []
    assert batches[0]["observations"].shape == (100, 6, 36, 36)
    other.learn(20)
    assert other.replay_buffer.size() == 35


def test_sb3_checkpoints_continue_the_run(tmp_path: Path) -> None:
    """CheckpointCallback's archive and buffer continue the run: counters go on, no second warm-up, no second burst."""
    model = tiny_model("CnnPolicy", PixelBox(), warmup_updates=7)
    model.learn(20, callback=CheckpointCallback(15, str(tmp_path), name_prefix="run", save_replay_buffer=True))
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"run_15_steps.zip", "run_replay_buffer_15_steps.pkl"}
    resumed = CuReSAC.load(tmp_path / "run_15_steps", env=PixelBox())
    resumed.load_replay_buffer(tmp_path / "run_replay_buffer_15_steps.pkl")
    # The callback is called before the 15th transition is stored and learned from.
    assert (resumed.num_timesteps, resumed._n_updates, resumed.replay_buffer.size()) == (15, 7 + 4, 14)
    samples = []
    resumed.action_space.sample = lambda: samples.append(1)  # type: ignore[method-assign]
    resumed.learn(10, reset_num_timesteps=False)
    assert (resumed.num_timesteps, resumed._n_updates, resumed.replay_buffer.size()) == (25, 7 + 4 + 10, 24)
    assert samples == []


@pytest.mark.parametrize(
    ("collector", "curiosity", "update"),
    [("curious", "separate", "sequential"), ("curious", None, "joint"), ("random", "separate", "joint")],
)
def test_checkpoint_while_pretraining(collector: str, curiosity: str | None, update: str, tmp_path: Path) -> None:
    """A checkpoint taken while pretraining loads; ``learn`` then ends the pretraining as it would have."""
    model = tiny_model("CnnPolicy", PixelBox(), curiosity=curiosity, update=update)
    states = []
    model.pretrain(20, collector, callback=lambda locals_, _: states.append(state_of(locals_["self"])) or True)
    model = tiny_model("CnnPolicy", PixelBox(), curiosity=curiosity, update=update)
    model.pretrain(20, collector, callback=CheckpointCallback(16, str(tmp_path), save_replay_buffer=True))
    loaded = CuReSAC.load(tmp_path / "rl_model_16_steps", env=PixelBox())
    loaded.load_replay_buffer(tmp_path / "rl_model_replay_buffer_16_steps.pkl")
    assert differences(states[15], state_of(loaded)) == []
    assert (loaded.policy.curious is not None) == ("curious" in (collector, "curious" if curiosity else ""))
    loaded.learn(14)
    assert (loaded.num_timesteps, loaded._n_updates, loaded.replay_buffer.size()) == (14, 4, 14)
    assert (loaded.policy.curious is not None) == (curiosity == "separate")
    # Encoder and head are the pretrained ones, trained on: their optimisers have seen all updates.
    assert state_of(loaded)["policy.srl.optimizer"]["state"][0]["step"] == 5 + 4


def test_pretrained_model_survives(tmp_path: Path) -> None:
    """A model that was pretrained, with a curious agent of its own for it, is saved and loaded as what it is now."""
    model = tiny_model("CnnPolicy", PixelBox(), curiosity=None).pretrain(15)
    model.learn(13)
    check_save_load(model, PixelBox, tmp_path)


# ------------------------------------------------------------ the policy alone


@pytest.mark.parametrize(
    ("srl", "curiosity"), [("rae", "separate"), ("curl", None), (Denoising, "separate"), (None, None)]
)
def test_policy_alone_acts_alike(srl: str | type[SRLHead] | None, curiosity: str | None, tmp_path: Path) -> None:
    """``policy.save`` and ``CuRePolicy.load``: a policy without the algorithm, with all its networks."""
    policy_kwargs = dict(share_encoder=True, activation_fn=nn.Tanh, n_critics=3)
    model = tiny_model("CnnPolicy", PixelBox(), srl=srl, curiosity=curiosity, policy_kwargs=policy_kwargs).learn(15)
    policy = model.policy
    policy.save(tmp_path / "policy.pt")
    for cls in (CnnPolicy, CuRePolicy):
        loaded = cls.load(tmp_path / "policy.pt")
        assert differences(dict(policy.state_dict()), dict(loaded.state_dict())) == []
        assert ("curious" in loaded.agents) == (curiosity == "separate")
        for agent in policy.agents:
            with policy.acting(agent), loaded.acting(agent):
                np.testing.assert_array_equal(
                    policy.predict(IMAGES, deterministic=True)[0], loaded.predict(IMAGES, deterministic=True)[0]
                )


def test_policy_saved_while_pretraining(tmp_path: Path) -> None:
    """The curious agent that exists only while pretraining is part of a policy that is saved then."""
    model = tiny_model("CnnPolicy", PixelBox(), curiosity=None)
    actions = []

    def save(locals_: dict[str, Any], _: Any) -> bool:
        model.policy.save(tmp_path / "policy.pt")
        actions.append(model.predict_curious(IMAGES, deterministic=True)[0])
        return True

    model.pretrain(14, callback=save)
    loaded = CnnPolicy.load(tmp_path / "policy.pt")
    with loaded.acting("curious"):
        np.testing.assert_array_equal(loaded.predict(IMAGES, deterministic=True)[0], actions[-1])


def test_policy_without_task_acts_curiously_when_loaded(tmp_path: Path) -> None:
    """With ``task=False`` the curious actor is the one that acts, in a loaded policy, too."""
    model = tiny_model("CnnPolicy", PixelBox(), task=False).learn(15)
    model.policy.save(tmp_path / "policy.pt")
    loaded = CnnPolicy.load(tmp_path / "policy.pt")
    expected = model.predict_curious(IMAGES, deterministic=True)[0]
    np.testing.assert_array_equal(loaded.predict(IMAGES, deterministic=True)[0], expected)
