"""What is saved and loaded acts alike and learns on alike, whatever is switched on."""

import functools
import zipfile
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from envs_for_tests import PixelBox, VectorBox, differences, state_of, tiny_model
from stable_baselines3.common.callbacks import CheckpointCallback
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_cure import CuReSAC, CuReTQC
from sb3_cure.srl import SRL_HEADS, SRLHead

IMAGES = np.random.default_rng(0).integers(0, 256, (5, 6, 36, 36), dtype=np.uint8)


class Own(SRL_HEADS["rae"]):  # type: ignore[name-defined, misc]
    """A user's head."""


def predictions(model: CuReSAC) -> list[np.ndarray]:
    """Deterministic actions of the task policy and, if there is one, of the curious one."""
    observations = IMAGES if len(model.observation_space.shape or ()) == 3 else np.eye(2, dtype=np.float32)
    actions = [model.predict(observations, deterministic=True)[0]]
    if model.policy.curious is not None:
        actions.append(model.predict_curious(observations, deterministic=True)[0])
    return actions


def learn_on(model: CuReSAC, env: gym.Env) -> dict[str, Any]:
    """State and stored actions after learning on, from a given seed of the global generators and the environment."""
    model.set_env(env)
    model.set_random_seed(11)
    model.learn(8, reset_num_timesteps=False)
    buffer = model.replay_buffer
    return {**state_of(model), "actions": buffer.actions[: buffer.pos].copy()}


def not_data(model: CuReSAC) -> dict[str, Any]:
    """Settings that no archive holds: the user's own head and functions."""
    objects = {name: getattr(model, name) for name in ("srl", "curiosity_prob")}
    return {name: value for name, value in objects.items() if callable(value)}


#: Settings that the combinations leave alone, which load models of every head, reward and sensor
CASES: dict[str, dict[str, Any]] = {
    "rae, bonus": dict(srl="rae", curiosity="bonus"),
    "curl, random": dict(srl="curl", curiosity="random"),
    "curl, crops": dict(srl="curl", augmentation="crop", augmentation_kwargs=dict(size=30), update="sequential"),
    "forward, bonus": dict(srl="forward", curiosity="bonus", update="sequential"),
    "inverse, not curious": dict(srl="inverse", curiosity=None),
    "own": dict(srl=Own),
    "no task": dict(task=False),
    "fixed temperature": dict(ent_coef=0.05),
    "alternating": dict(srl_schedule="alternating", srl_period=4),
    "scheduled mixing": dict(curiosity_prob=lambda progress: 0.5 * progress),
    "next observation": dict(curiosity_gamma=0.0, curiosity_target="next_observation", curiosity_encoder_grad=False),
    "bare curious reward": dict(normalize_curiosity=False, curiosity_beta=3.0),
    "three environments": dict(n_envs=3),
    "quantiles": dict(policy="MlpPolicy", algorithm=CuReTQC, top_quantiles_to_drop_per_net=1),
}


@pytest.mark.parametrize("name", CASES)
def test_loaded_model_acts_and_learns_alike(name: str, tmp_path: Path) -> None:
    """Saved after an odd number of updates, so that the clock of actors and targets matters, with a mixing probability
    of a half, so that the mixer's random stream matters."""
    arguments = {"policy": "CnnPolicy", "algorithm": CuReSAC, "curiosity_prob": 0.5, **CASES[name]}
    policy, algorithm, n_envs = arguments.pop("policy"), arguments.pop("algorithm"), arguments.pop("n_envs", 1)

    def make_env() -> DummyVecEnv:
        return DummyVecEnv([PixelBox if policy == "CnnPolicy" else VectorBox] * n_envs)

    model = tiny_model(policy, make_env(), algorithm, **arguments).learn(21)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = algorithm.load(tmp_path / "model", env=make_env(), device="cpu", custom_objects=not_data(model))
    loaded.load_replay_buffer(tmp_path / "buffer")
    assert differences(state_of(model), state_of(loaded)) == []
    expected = predictions(model)
    assert differences(expected, predictions(loaded)) == []
    assert {key: getattr(loaded, key) for key in arguments} == arguments
    assert differences(learn_on(model, make_env()), learn_on(loaded, make_env())) == []
    # Something was learned meanwhile, or the comparison would be idle.
    assert differences(expected, predictions(loaded))


def test_archive_holds_each_network_once(tmp_path: Path) -> None:
    """And a loaded model can be saved and loaded again."""
    model = tiny_model("CnnPolicy", PixelBox(), policy_kwargs=dict(net_arch=[400, 400])).learn(12)
    model.save(tmp_path / "model.zip")
    attributes = zipfile.ZipFile(tmp_path / "model.zip").getinfo("data").file_size
    assert attributes < 100_000 < 4 * sum(parameter.numel() for parameter in model.policy.actor.parameters())
    CuReSAC.load(tmp_path / "model").save(tmp_path / "second")
    assert differences(state_of(model), state_of(CuReSAC.load(tmp_path / "second"))) == []


# ---------------------------------------------------------------------------------------- arguments of load


@pytest.mark.parametrize("saved_with, loaded_with", [(1, 3), (3, 1)])
def test_load_with_other_number_of_environments(saved_with: int, loaded_with: int, tmp_path: Path) -> None:
    model = tiny_model("CnnPolicy", DummyVecEnv([PixelBox] * saved_with)).learn(21)
    model.save(tmp_path / "model")
    loaded = CuReSAC.load(tmp_path / "model", env=DummyVecEnv([PixelBox] * loaded_with))
    assert differences(predictions(model), predictions(loaded)) == []
    assert loaded.replay_buffer.n_envs == loaded.n_envs == loaded_with
    steps, updates = model.num_timesteps, model._n_updates
    loaded.learn(12, reset_num_timesteps=False)
    assert (loaded.num_timesteps, loaded._n_updates) == (steps + 12, updates + 12)


def test_load_without_environment(tmp_path: Path) -> None:
    """An archive is enough to predict, and to learn on once there is an environment; an id is one, too."""
    model = tiny_model("CnnPolicy", PixelBox()).learn(15)
    model.save(tmp_path / "model")
    loaded = CuReSAC.load(tmp_path / "model")
    assert loaded.env is None and differences(predictions(model), predictions(loaded)) == []
    loaded.set_env(PixelBox())
    loaded.learn(5, reset_num_timesteps=False)
    assert (loaded.num_timesteps, loaded._n_updates) == (20, 10)
    tiny_model("MlpPolicy", "Pendulum-v1").save(tmp_path / "model")
    assert CuReSAC.load(tmp_path / "model", env="Pendulum-v1").learn(5).num_timesteps == 5


def test_load_keeps_the_frame_stack_beside_other_arguments_of_the_buffer(tmp_path: Path) -> None:
    make = functools.partial(PixelBox, frame_stack=2, tells_frame_stack=False)
    tiny_model("CnnPolicy", make(), replay_buffer_kwargs=dict(frame_stack=2)).save(tmp_path / "model.zip")
    loaded = CuReSAC.load(tmp_path / "model.zip", make(), replay_buffer_kwargs=dict(frames_dir=tmp_path / "frames"))
    assert loaded.replay_buffer.frame_stack == loaded.policy._arguments["reward_settings"]["frame_stack"] == 2
    other = CuReSAC.load(tmp_path / "model.zip", env=make(), replay_buffer_kwargs=dict(frame_stack=1))
    assert other.replay_buffer.frame_stack == other.policy._arguments["reward_settings"]["frame_stack"] == 1


def test_arguments_given_to_load_apply(tmp_path: Path) -> None:
    """Also the one that the mixer keeps; misspelt ones are refused."""
    tiny_model("CnnPolicy", PixelBox(), curiosity_prob=0.0).learn(15).save(tmp_path / "model")
    loaded = CuReSAC.load(tmp_path / "model", env=PixelBox(), curiosity_prob=1.0, learning_rate=0.0)
    before = {name: value.clone() for name, value in loaded.policy.named_parameters()}
    calls: list[int] = []
    loaded.policy.curious.actor.register_forward_hook(lambda *_: calls.append(1))
    loaded.learn(6, reset_num_timesteps=False)
    assert len(calls) == 6
    # A learning rate of zero moves nothing but the targets, towards the networks.
    moved = differences(before, dict(loaded.policy.named_parameters()))
    assert moved and all("target" in name for name in moved)
    with pytest.raises(TypeError, match=r"load\(\) got 'batchsize', which is no setting of CuReSAC"):
        CuReSAC.load(tmp_path / "model", batchsize=8)


def temperature(model: CuReSAC) -> tuple[float, bool]:
    """The task's temperature, and whether it is learned."""
    if model.log_ent_coef is not None:
        return round(float(model.log_ent_coef.exp()), 6), True
    return round(float(model.ent_coef_tensor), 6), False


@pytest.mark.parametrize(
    ("saved", "given", "expected"),
    [
        ("auto_0.5", dict(ent_coef=0.2), (0.2, False)),
        (0.3, dict(ent_coef=0.2), (0.2, False)),
        (0.3, dict(ent_coef="auto_0.7"), (0.7, True)),
        ("auto_0.5", dict(ent_coef="auto_0.7"), (0.7, True)),
        (0.3, {}, (0.3, False)),
        (0.3, dict(custom_objects={"ent_coef": 0.2}), (0.2, False)),
        ("auto_0.5", dict(custom_objects={"ent_coef": "auto_0.7"}), (0.7, True)),
    ],
)
def test_temperature_given_to_load_applies(
    saved: Any, given: Any, expected: tuple[float, bool], tmp_path: Path
) -> None:
    tiny_model("MlpPolicy", VectorBox(), ent_coef=saved, curiosity_ent_coef="auto").learn(15).save(tmp_path / "model")
    loaded = CuReSAC.load(tmp_path / "model", env=VectorBox(), **given)
    assert temperature(loaded) == expected
    curious = loaded.policy.curious.log_ent_coef
    assert curious is not None and curious.item() != 0.0  # as it was learned
    loaded.learn(5, reset_num_timesteps=False)
    assert (temperature(loaded) == expected) == (not expected[1])
    for curiosity in (0.1, "auto_0.4"):
        other = CuReSAC.load(tmp_path / "model", curiosity_ent_coef=curiosity)
        assert (other.policy.curious.log_ent_coef is None) == (curiosity == 0.1)


@pytest.mark.parametrize("change", [dict(update="sequential"), dict(curiosity_encoder_grad=False)], ids=str)
def test_loading_into_another_algorithm_is_refused(change: dict[str, Any], tmp_path: Path) -> None:
    """The encoder's optimiser states belong to the sources and the mode that they were made with."""
    tiny_model("CnnPolicy", PixelBox()).learn(12).save(tmp_path / "model")
    with pytest.raises(RuntimeError, match="the saved encoder was trained by"):
        CuReSAC.load(tmp_path / "model", **change)


@pytest.mark.parametrize(
    ("change", "networks"),
    [(dict(curiosity=None), "curious"), (dict(srl="spr"), "intrinsic, srl"), (dict(intrinsic="rnd"), "intrinsic")],
    ids=str,
)
def test_loading_with_other_networks_is_refused(change: dict[str, Any], networks: str, tmp_path: Path) -> None:
    tiny_model("CnnPolicy", PixelBox()).save(tmp_path / "model")
    with pytest.raises(ValueError, match=rf"was saved with other networks \({networks}\): load it with"):
        CuReSAC.load(tmp_path / "model", **change)


@pytest.mark.parametrize("key", ["srl", "teacher"])
def test_own_objects_are_given_to_load(key: str, tmp_path: Path) -> None:
    """An archive holds no class of the user's: it says which one it was."""
    model = tiny_model("CnnPolicy", PixelBox(), srl=Own).learn(15)
    model.teacher = lambda: 1  # type: ignore[attr-defined]
    model.save(tmp_path / "model")
    given = {"srl": Own, "teacher": "me"}
    with pytest.raises(ValueError, match=rf"test_save_load\..*custom_objects=\{{'{key}': \.\.\.\}}"):
        CuReSAC.load(tmp_path / "model", custom_objects={k: v for k, v in given.items() if k != key})
    loaded = CuReSAC.load(tmp_path / "model", custom_objects={"srl": Own}, teacher="me")
    assert type(loaded.policy.srl) is Own and isinstance(loaded.policy.srl, SRLHead)
    assert loaded.teacher == "me" and differences(state_of(model), state_of(loaded)) == []  # type: ignore[attr-defined]


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
