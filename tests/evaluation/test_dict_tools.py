"""What is around the agent takes dictionaries, too: export, evaluation, callbacks, pictures, crash reports."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from dictionaries_for_tests import Goal, SensorBox, sensor_model
from envs_for_tests import tiny_model
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sb3_cure import CuReSAC
from sb3_cure.cure.crash_report import NonFiniteError
from sb3_cure.cure.metrics import reconstruction_strips
from sb3_cure.data.samples import Samples
from sb3_cure.evaluation.callbacks import DiagnosticsCallback, EvalBothCallback, ReconstructionCallback
from sb3_cure.evaluation.deployment import DeterministicActor
from sb3_cure.evaluation.rollouts import evenly_measured, most_uncomfortable, run_episodes, srl_errors, state_probe
from sb3_cure.srl import RAE, SRLOutput
from sb3_cure.vec_env.frame_watch import FrameFaultError, FrameWatch


def vector_model(**kwargs: Any) -> CuReSAC:
    return tiny_model("MultiInputPolicy", Goal(), **kwargs)


@pytest.mark.parametrize("make", [sensor_model, vector_model, lambda: sensor_model(srl="curl")])
def test_exported_actions_are_those_of_predict(make: Any) -> None:
    """For both policies, whichever tool has followed the computation."""
    model = make().learn(14)
    samples = [model.observation_space.sample() for _ in range(3)]
    observations = {key: np.stack([sample[key] for sample in samples]) for key in samples[0]}
    batch = {key: th.as_tensor(part) for key, part in observations.items()}
    for actor, predict in (("task", model.predict), ("curious", model.predict_curious)):
        expected, _ = predict(observations, deterministic=True)
        module = DeterministicActor(model, actor)
        traced = th.jit.trace(module, (batch,))
        exported = th.export.export(module, (batch,)).module()
        for follow in (module, traced, exported):
            with th.no_grad():
                np.testing.assert_allclose(follow(batch).numpy(), expected, atol=1e-5)
    if "front" in batch:
        with pytest.raises(ValueError, match=r"observations are torch.float32, but images must be uint8"):
            module({**batch, "wrist": batch["wrist"] / 255})


@pytest.mark.parametrize("srl", ["rae", "curl"])
def test_episodes_are_measured(srl: str) -> None:
    """Errors are those of the transitions that are stored; observations are kept by key."""
    model = sensor_model(srl=srl).learn(40)
    with evenly_measured(model, SensorBox(), seed=1):
        (episode,) = run_episodes(model, SensorBox(), 1, "curious", seed=2)
    assert {key: len(part) for key, part in episode.observations.items()} == {"front": 20, "joints": 20, "wrist": 20}
    assert episode.srl_errors.shape == (20,) and (episode.srl_errors >= 0).all()
    batch = model.replay_buffer.sample(12)
    alone = [srl_errors(model, Samples(*(first_rows(part, i) for part in batch))) for i in range(12)]
    np.testing.assert_allclose(srl_errors(model, batch, chunk=5), np.concatenate(alone), rtol=1e-4, atol=1e-6)
    worst = most_uncomfortable(model, 3, gap=1)
    assert worst.observations["wrist"].shape == (3, 6, 28, 28) and worst.errors[0] == max(worst.errors)


def first_rows(part: Any, i: int) -> Any:
    if isinstance(part, dict):
        return {key: value[i : i + 1] for key, value in part.items()}
    return None if part is None else part[i : i + 1]


@pytest.mark.parametrize("srl", ["rae", "curl"])
def test_each_image_has_a_picture_of_reconstructions(srl: str, tmp_path: Path) -> None:
    """Drawn by its head, or by a decoder that is fitted afterwards; of the same observations at all times."""
    callback = ReconstructionCallback(tmp_path, every=15, columns=3, decoder_updates=40)
    model = sensor_model(srl=srl).learn(30, callback=callback)
    callback.draw(model)
    files = sorted(path.name for path in tmp_path.iterdir())
    assert files == [f"reconstructions_{key}.png" for key in ("front", "wrist")]
    steps, (*_, drawn) = zip(*callback.rows, strict=True)
    assert steps == (15, 30, 30) and {key: image.shape[2] for key, image in drawn.items()} == {"front": 36, "wrist": 28}
    seen: Any = callback.observations
    if srl == "rae":
        expected = model.policy.reconstruct({key: th.as_tensor(part) for key, part in seen.items()})[1]  # type: ignore[index]
        np.testing.assert_array_equal(drawn["wrist"], expected["wrist"][:, 3:].numpy())
    else:
        for key, image in drawn.items():
            there = seen[key][:, 3:].astype(float)
            assert np.abs(image - there).mean() < 0.75 * np.abs(127.5 - there).mean()


def test_negatives_are_taken_of_each_image() -> None:
    """And given back afterwards."""
    model = sensor_model(srl="curl").learn(40)
    banks = [head.bank.clone() for head in model.policy.srl.heads]
    with evenly_measured(model, SensorBox(), seed=1):
        assert not any(th.equal(head.bank, bank) for head, bank in zip(model.policy.srl.heads, banks, strict=True))
    for head, bank in zip(model.policy.srl.heads, banks, strict=True):
        filled = int(head.bank_filled)
        assert filled > 0 and th.equal(head.bank[:filled], bank[:filled])


def test_callbacks_see_dictionaries() -> None:
    """Evaluation and diagnostics; another dictionary is refused at once."""
    evaluate = EvalBothCallback(SensorBox(), eval_freq=20, n_episodes=1)
    model = sensor_model().learn(40, [evaluate, DiagnosticsCallback(every=10, min_updates=1)])
    assert {"eval/task_reward", "eval/curious_srl_error"} <= evaluate.history[-1].keys()
    vector_model().learn(30, [EvalBothCallback(Goal(), 20, n_episodes=1), DiagnosticsCallback(every=10, min_updates=1)])
    for other in (SensorBox(("front", "joints")), SensorBox(size=40), Goal()):
        with pytest.raises(ValueError, match="make it as the training environment"):
            model.learn(1, EvalBothCallback(other, 20))


@pytest.mark.parametrize("kwargs", [{}, {"srl": "curl", "intrinsic": "reconstruction"}])
def test_pictures_of_each_image(kwargs: dict[str, Any], tmp_path: Path) -> None:
    """The newest frames above what is drawn of them, by head or reward; TensorBoard has one for each."""
    if kwargs:
        kwargs = {**kwargs, "intrinsic_kwargs": {"n_filters": 4, "n_layers": 2}}
    model = sensor_model(tensorboard_log=str(tmp_path), **kwargs).learn(14)
    model.logger.dump(14)
    batch = model.policy.samples(model.replay_buffer.sample(5), random=False)
    strips = reconstruction_strips(model.policy, batch, frame_stack=2, columns=3)
    assert {key: strip.shape for key, strip in strips.items()} == {"front": (3, 72, 108), "wrist": (3, 56, 84)}
    np.testing.assert_array_equal(strips["wrist"][:, :28, 28:56], batch.observations["wrist"][1, 3:])
    (folder,) = tmp_path.iterdir()
    images = EventAccumulator(str(folder)).Reload().Tags()["images"]
    assert images == ["srl/reconstructions_front", "srl/reconstructions_wrist"]
    assert reconstruction_strips(vector_model().policy, batch, frame_stack=1) == {}
    assert reconstruction_strips(sensor_model(srl="curl").policy, batch, frame_stack=2) == {}


class Broken(RAE):
    """Its loss is not finite from some update on."""

    def loss(self, batch: Samples, latents: th.Tensor, next_latents: th.Tensor | None = None) -> SRLOutput:
        loss, error = super().loss(batch, latents)
        return SRLOutput(loss * th.nan, error)


def test_crash_report_holds_every_key(tmp_path: Path) -> None:
    with pytest.raises(NonFiniteError) as caught:
        sensor_model(srl=Broken).learn(14)
    folder = Path(caught.value.crash_report)
    assert json.loads((folder / "report.json").read_text())["source"] == "srl"
    with np.load(folder / "batch.npz") as arrays:
        assert {"observations.front", "observations.joints", "next_observations.wrist", "views.wrist", "rewards"} <= {
            *arrays.keys()
        }


class Stuck(gym.Wrapper):
    """One of its cameras shows the same from some step on, or nothing."""

    def __init__(self, env: gym.Env, what: str):
        super().__init__(env)
        self.what, self.n, self.kept = what, 0, np.zeros(0)

    def step(self, action: Any) -> Any:
        seen, *rest = self.env.step(action)
        self.n += 1
        if self.n == 5:
            self.kept = seen["wrist"]
        if self.n > 5 and self.what:
            seen = {**seen, "wrist": self.kept if self.what == "frozen" else self.kept * 0}
        return seen, *rest


@pytest.mark.parametrize(
    "what, step, sentence", [("", None, ""), ("black", 6, "returned a black frame"), ("frozen", 13, "same pixels 8")]
)
def test_frame_watch_looks_at_each_camera(what: str, step: int | None, sentence: str) -> None:
    """One that fails is noticed beside one that works."""
    env: Any = Stuck(SensorBox(episode_length=100), what)
    env = FrameWatch(env, frozen_steps=32, state=lambda env: env.get_wrapper_attr("position"))
    env.reset(seed=0)
    for number in range(1, 20):
        action = np.full(2, 1.0 if number // 4 % 2 else -1.0, np.float32) * (0.9 if number % 2 else 0.4)
        if number == step:
            with pytest.raises(FrameFaultError, match=sentence):
                env.step(action)
            return
        *_, info = env.step(action)
    assert step is None and "frozen_frames" not in info


def test_the_true_state_is_probed_in_joined_latents() -> None:
    """The joints lie in them: what they tell is read nearly perfectly."""
    model = sensor_model()
    episodes = run_episodes(model, SensorBox(), 4, "random", seed=0)
    told = [replace(each, states=each.observations["joints"].astype(np.float64)) for each in episodes]  # type: ignore[call-overload]
    assert min(state_probe(model, told, ["x", "y"]).values()) > 0.95
