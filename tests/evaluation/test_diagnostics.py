"""``DiagnosticsCallback`` warns of each fault once, of nothing else, and of nothing in runs that are well."""

import functools
import re
import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
import yaml
from dictionaries_for_tests import SensorBox
from envs_for_tests import PixelBox, VectorBox, differences, state_of, tiny_model
from logs_for_tests import KeptRows
from rl_zoo3.utils import get_callback_list
from sb3_contrib import TQC
from stable_baselines3 import DQN, SAC, TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_cure import CuReSAC, make_dmc_env
from sb3_cure.evaluation import diagnostics
from sb3_cure.evaluation.callbacks import DiagnosticsCallback, EvalBothCallback
from sb3_cure.srl import SRLHead, SRLOutput


class Still(PixelBox):
    """The camera looks elsewhere."""

    def observe(self, first: bool = False) -> np.ndarray:
        return np.concatenate(self.frames)


class Collapsing(SRLHead):
    """Its loss is least where all latents are alike."""

    def loss(self, batch: Any, latents: th.Tensor) -> SRLOutput:
        error = (latents - latents.mean(dim=0)).square().mean(dim=1)
        return SRLOutput(error.mean(), error.detach())


class Constant(th.nn.Module):
    """A decoder that always draws the same, [1, C, H, W]."""

    def __init__(self, drawing: th.Tensor):
        super().__init__()
        self.drawing = drawing

    def forward(self, latents: th.Tensor) -> th.Tensor:
        return self.drawing.expand(len(latents), -1, -1, -1)


@pytest.fixture(autouse=True)
def _judge_early(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(diagnostics, "MIN_UPDATES", 40)


def watch(model: BaseAlgorithm, steps: int, every: int = 25) -> tuple[list[str], dict[str, float]]:
    """Train with the callback.

    :param model: A model
    :param steps: Agent steps
    :param every: Agent steps between two looks
    :return: Names of what was warned of and the sentences, and what was logged last under ``diagnostics/``
    """
    callback = DiagnosticsCallback(every)
    kept = KeptRows()
    model.set_logger(Logger(None, [kept]))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model.learn(steps, callback, log_interval=1)
    model.logger.dump()
    sentences = [str(each.message) for each in caught if "agent steps:" in str(each.message)]
    assert len(sentences) == len(callback.warned), (sentences, callback.warned)
    logged: dict[str, float] = {}
    for row in kept.rows:
        logged.update({key.split("/")[1]: row[key] for key in row if key.startswith("diagnostics/")})
    return [*callback.warned, *sentences], logged


# ------------------------------------------------------------------ runs that are well


@pytest.mark.parametrize(("srl", "curiosity"), [("rae", "bonus"), ("curl", "separate")])
def test_good_runs_give_no_warning(srl: str, curiosity: str) -> None:
    """All checks look, none of them warns; they look only after ``MIN_UPDATES``."""
    warned, logged = watch(tiny_model("CnnPolicy", PixelBox(), srl=srl, curiosity=curiosity), 150)
    assert warned == []
    expected = {"constant_image", "temperature", "collapsed_latents", "curious_reward"}
    assert set(logged) == expected | ({"autoencoder"} if srl == "rae" else set())
    assert (logged["constant_image"], logged["temperature"]) == (0, 0)
    assert logged["collapsed_latents"] > 5 * diagnostics.LATENT_SPREAD
    assert logged["curious_reward"] > 10 * diagnostics.CURIOUS_SHARE


@pytest.mark.parametrize("srl, min_updates", [("rae", 200), pytest.param("curl", 580, marks=pytest.mark.long)])
def test_real_pixels_give_no_warning(srl: str, min_updates: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Some hundred updates on DeepMind Control, judged when the latents have unfolded, which takes CURL longer.

    With four filters, as in the other tests, some seeds need longer still.
    """
    env = make_dmc_env("cartpole", "swingup", image_size=40, renderer="fast", seed=0)
    networks = {"net_arch": [16], "features_extractor_kwargs": {"n_filters": 16, "n_layers": 3}}
    model = tiny_model("CnnPolicy", env, srl=srl, policy_kwargs=networks)
    monkeypatch.setattr(diagnostics, "MIN_UPDATES", min_updates)
    warned, logged = watch(model, min_updates + 60)
    assert warned == [], logged
    assert {"collapsed_latents", "curious_reward"} <= set(logged)
    env.close()


def test_an_autoencoder_that_learns_is_better_than_the_mean_image(monkeypatch: pytest.MonkeyPatch) -> None:
    """What it explains rises from below 0 beyond the threshold."""
    kwargs = dict(features_extractor_kwargs=dict(n_filters=8, n_layers=2))
    model = tiny_model("CnnPolicy", PixelBox(), curiosity=None, learning_rate=3e-3, policy_kwargs=kwargs)
    monkeypatch.setattr(diagnostics, "MIN_UPDATES", 1)
    monkeypatch.setattr(diagnostics, "AUTOENCODER_UPDATES", 250)
    _, early = watch(model, 60)
    assert early["autoencoder"] < 0
    model._plan = lambda: (True, False, 1)  # type: ignore[method-assign]  # the head alone, which is quicker
    model.train(250, 16)
    warned, late = watch(model, 60)
    assert warned == []
    assert late["autoencoder"] > 2 * diagnostics.EXPLAINED_SHARE


def pixel_sac(**arguments: Any) -> SAC:
    """SB3's own, from pixels."""
    policy_kwargs = dict(net_arch=[16], features_extractor_kwargs=dict(features_dim=64))
    return SAC("CnnPolicy", PixelBox(size=40), policy_kwargs=policy_kwargs, **arguments)


class Discrete(VectorBox):
    """For DQN: left or right."""

    def __init__(self) -> None:
        super().__init__()
        self.action_space = gym.spaces.Discrete(2)  # type: ignore[assignment]

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.n_steps += 1
        return self.observe(), float(action), False, self.n_steps >= self.episode_length, {}


OTHERS: dict[str, tuple[Any, set[str]]] = {
    "plain CuReSAC": (
        functools.partial(tiny_model, "CnnPolicy", PixelBox(size=40), srl=None, curiosity=None),
        {"constant_image", "temperature", "collapsed_latents"},
    ),
    "vectors": (
        functools.partial(tiny_model, "MlpPolicy", VectorBox()),
        {"temperature", "collapsed_latents", "autoencoder", "curious_reward"},
    ),
    "SAC": (pixel_sac, {"constant_image", "temperature", "collapsed_latents"}),
    "TQC": (functools.partial(TQC, "MlpPolicy", VectorBox(), policy_kwargs=dict(net_arch=[16])), {"temperature"}),
    "TD3": (functools.partial(TD3, "MlpPolicy", VectorBox(), policy_kwargs=dict(net_arch=[16])), set()),
    "DQN": (functools.partial(DQN, "MlpPolicy", Discrete(), train_freq=1), set()),
}


@pytest.mark.parametrize("name", OTHERS)
def test_other_algorithms(name: str) -> None:
    """What applies to them is looked at, the rest is left out."""
    make, expected = OTHERS[name]
    warned, logged = watch(make(learning_starts=10, batch_size=8, buffer_size=300, seed=0), 80)
    assert warned == []
    assert set(logged) == expected


# ------------------------------------------------------------------------------ faults


def with_constant_drawings() -> CuReSAC:
    """Nothing of the latents comes through the decoder's first layer; what it draws is the mean colour."""
    model = tiny_model("CnnPolicy", PixelBox())
    with th.no_grad():
        model.policy.srl.decoder.linear.bias.fill_(-1e3)  # type: ignore[union-attr]
    return model


box = functools.partial(tiny_model, "CnnPolicy")
weak: dict[str, Any] = dict(curiosity_beta=1e-3, normalize_curiosity=False)
collapsing: dict[str, Any] = dict(srl=Collapsing, task=False, curiosity_encoder_grad=False, learning_rate=4e-3)
#: A model, the name of its problem, and what the sentence must say
FAULTS: dict[str, tuple[Any, str, str]] = {
    "camera": (lambda: box(Still()), "constant_image", "observations of environment 0 are the same"),
    "one camera": (lambda: box(DummyVecEnv([PixelBox, Still])), "constant_image", "of environment 1 are"),
    "collapse": (lambda: box(PixelBox(), **collapsing), "collapsed_latents", "latents differ by"),
    "drawings": (with_constant_drawings, "autoencoder", r"the autoencoder explains -\d"),
    "hot": (
        lambda: box(PixelBox(), target_entropy=5.0, ent_coef_lr_factor=1200.0),
        "temperature",
        r"a target of 5\.0, \d.*e\+\d+, .*: set a smaller target_entropy",
    ),
    "cold": (
        lambda: box(PixelBox(), target_entropy=-50.0, ent_coef_lr_factor=400.0),
        "temperature",
        r"a target of -50\.0, \d.*e-\d+, .*: check whether it finds any reward",
    ),
    "fixed hot": (lambda: box(PixelBox(), ent_coef=1e6), "temperature", r"task agent is fixed at 1\.0e\+06"),
    "fixed cold": (lambda: box(PixelBox(), ent_coef=1e-8), "temperature", r"task agent is fixed at 1\.0e-08"),
    "SB3's": (
        lambda: pixel_sac(learning_starts=10, batch_size=8, seed=0, ent_coef=1e6),
        "temperature",
        r"is fixed at 1\.0e\+06",
    ),
    "curious": (lambda: box(PixelBox(), **weak), "curious_reward", "use normalize_curiosity=True"),
    "bonus": (lambda: box(PixelBox(), curiosity="bonus", **weak), "curious_reward", "the curious reward varies by"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_each_problem_is_warned_of_once(fault: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """And of nothing else; its number is logged at each look."""
    make, name, sentence = FAULTS[fault]
    if fault == "drawings":
        monkeypatch.setattr(diagnostics, "AUTOENCODER_UPDATES", 40)
    warned, logged = watch(make(), 85, every=12)
    assert len(warned) == 2, warned
    assert warned[0] == name, (warned, logged)
    assert re.search(rf"^After \d+ agent steps: .*{sentence}", warned[1]), warned[1]
    assert name in logged


def test_equal_latents_count_at_any_scale() -> None:
    """The spread is 0 for equal latents and 1 for independent ones of mean zero."""
    latents = th.randn(40, 7, generator=th.Generator().manual_seed(0))
    for scale in (1e-3, 1.0, 1e3):
        independent = diagnostics.collapsed_latents(scale * (latents - latents.mean(dim=0)))
        equal = diagnostics.collapsed_latents(scale * latents[:1].expand(9, -1))
        assert independent.value == pytest.approx(1, rel=1e-4) and independent.problem is None
        assert equal.value < 1e-6 and equal.problem is not None


def test_small_rewards_need_a_small_temperature() -> None:
    """A learned temperature beyond its bounds is fine if the policy meets its target."""
    assert watch(box(PixelBox(), ent_coef=0.0), 80)[0] == [], "no entropy term at all"
    model = box(PixelBox())
    log_prob = th.full((8,), float(-model.target_entropy))  # type: ignore[arg-type]
    for log_prob_off, problem in ((0.0, False), (0.9, False), (-1.1, True)):
        temperature = diagnostics.Temperature("task", 1e-6, True, log_prob + log_prob_off)
        assert bool(diagnostics.temperature_at_bound([temperature], model).problem) == problem  # type: ignore[union-attr]


# -------------------------------------------------------------------------- criteria


@pytest.mark.parametrize("seed", range(3))
def test_no_constant_drawing_explains_anything(seed: int) -> None:
    """Whatever the images and the drawing: the mean image is the best of them, and explains 0."""
    model = box(PixelBox())
    generator = th.Generator().manual_seed(seed)
    head = model.policy.srl
    observations = th.randint(0, 256, (9, 6, 36, 36), dtype=th.uint8, generator=generator)
    batch = ReplayBufferSamples(observations, *[None] * 4)  # type: ignore[arg-type]
    latents = th.zeros(9, model.policy.encoder.features_dim)
    mean = head.target(observations, dither=False).mean(dim=0, keepdim=True)  # type: ignore[union-attr]
    for drawing in (mean, th.rand(mean.shape, generator=generator) - 0.5):
        head.decoder = Constant(drawing)  # type: ignore[union-attr]
        explained = diagnostics.explained_share(model, batch, latents)
        assert explained is not None and explained < 1e-5
        assert diagnostics.autoencoder(explained, 5000).problem is not None
        assert diagnostics.autoencoder(explained, 4999).problem is None


# ------------------------------------------------------------------------- the callback


@pytest.mark.parametrize("srl", ["rae", "curl"])
def test_looking_changes_nothing(srl: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same training, bit for bit, as without the callback."""
    monkeypatch.setattr(diagnostics, "MIN_UPDATES", 1)
    watched = tiny_model("CnnPolicy", PixelBox(), srl=srl)
    _, logged = watch(watched, 35, every=7)
    alone = tiny_model("CnnPolicy", PixelBox(), srl=srl).learn(35)
    assert "collapsed_latents" in logged
    assert differences(state_of(watched), state_of(alone)) == []
    assert np.array_equal(watched.replay_buffer.actions, alone.replay_buffer.actions)  # type: ignore[union-attr]


def test_rl_zoo_makes_it_from_yaml() -> None:
    """The form of rl-zoo3's ``callback:`` key, with arguments and without."""
    text = """
    callback:
      - sb3_cure.evaluation.callbacks.DiagnosticsCallback
      - sb3_cure.evaluation.callbacks.DiagnosticsCallback:
          every: 500
    """
    plain, other = get_callback_list(yaml.safe_load(text))
    assert (plain.every, other.every) == (1000, 500)
    model = box(PixelBox())
    callbacks: list[BaseCallback] = [plain, other]
    assert model.learn(20, callbacks).num_timesteps == 20


def test_images_of_dictionaries_are_looked_at() -> None:
    """One of two cameras stands still; reconstructions that hold nothing of one image."""

    class HalfStill(SensorBox):
        def observe(self, first: bool = False) -> Any:
            return {**super().observe(first), "wrist": np.zeros((6, 28, 28), np.uint8)}

    with pytest.warns(UserWarning) as caught:
        model = tiny_model("MultiInputPolicy", HalfStill())
        model.learn(50, DiagnosticsCallback(every=49))
    sentences = [str(warning.message) for warning in caught]
    assert any("observations of environment 0 (wrist) are the same image" in each for each in sentences)


def test_logs_written_by_other_callbacks_are_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    """The logger forgets what it has written, as it is when an evaluation comes first."""
    monkeypatch.setattr(diagnostics, "MIN_UPDATES", 10)
    model = tiny_model("CnnPolicy", PixelBox(), normalize_curiosity=False, ent_coef=1.0)
    looking = DiagnosticsCallback(25)
    with pytest.warns(UserWarning, match="curious reward varies"):
        model.learn(50, callback=[EvalBothCallback(PixelBox(), 25, 1), looking])
    assert "curious_reward" in looking.warned


def test_a_constant_image_of_many_environments() -> None:
    """However few rows they need for the number of observations that is looked at."""
    venv = DummyVecEnv([Still] * 40)
    model = tiny_model("CnnPolicy", venv, buffer_size=4000, learning_starts=2000).learn(40 * 35)
    assert diagnostics.constant_image(model).problem is not None
