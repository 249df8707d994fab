"""How often head, critics, actors and targets are updated: at once, in turn, and in the burst after the warm-up."""

import itertools
from typing import Any

import numpy as np
import pytest
import torch as th
from agents_for_tests import steps_of
from envs_for_tests import VectorBox, differences, state_of, tiny_model
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import SubprocVecEnv
from updates_for_tests import equal, filled_model, groups, prepare

from sb3_cure import CuReSAC
from sb3_cure.datasets import RecordedEpisode

UPDATES = pytest.mark.parametrize("update", ["sequential", "joint"])
PERIOD = 3


def model_with_transitions(**kwargs: Any) -> CuReSAC:
    return tiny_model("MlpPolicy", VectorBox(), learning_starts=40, srl_period=PERIOD, **kwargs).learn(40)


def steps(model: CuReSAC) -> dict[str, int]:
    """How often the optimizer of each part has stepped."""
    found = {} if model.policy.srl is None else {"srl": steps_of(model.policy.srl.optimizer)}
    for name, agent in model.policy.agents.items():
        found[f"{name} critic"] = steps_of(agent.critic.optimizer)
        found[f"{name} actor"] = steps_of(agent.actor.optimizer)
        found[f"{name} temperature"] = steps_of(agent.ent_coef_optimizer)
    return found


# ---------------------------------------------------------------- alternating


@UPDATES
def test_phases_alternate_and_catch_up(update: str) -> None:
    """Two updates per step, first of the head, then of the agents; after whole periods as many as simultaneously."""
    model = model_with_transitions(srl_schedule="alternating", update=update)
    for step in range(1, 2 * PERIOD + 1):
        model.train(1, batch_size=8)
        srl, rl = min(step, PERIOD), max(0, step - PERIOD)
        expected = {"srl": 2 * srl}
        for agent in ("task", "curious"):  # every second update of the critics is one of the actor
            expected |= {f"{agent} critic": 2 * rl, f"{agent} actor": rl, f"{agent} temperature": rl}
        assert steps(model) == expected and model._n_updates == step
    simultaneous = model_with_transitions(update=update)
    simultaneous.train(2 * PERIOD, batch_size=8)
    assert steps(simultaneous) == steps(model)


@pytest.mark.parametrize("settings", [dict(intrinsic="rnd"), dict(curiosity=None)])
def test_without_a_head_there_is_nothing_to_alternate(settings: dict[str, Any]) -> None:
    model = model_with_transitions(srl=None, srl_schedule="alternating", **settings)
    model.train(PERIOD, batch_size=8)
    assert steps(model)["task critic"] == PERIOD


def test_head_alone_makes_single_updates() -> None:
    """As while the representation alone is trained."""
    model = model_with_transitions(srl_schedule="alternating")
    model.fit_representation(PERIOD)
    assert steps(model) == {name: PERIOD if name == "srl" else 0 for name in steps(model)}


def test_frozen_representation_takes_no_turns() -> None:
    model = model_with_transitions(srl_schedule="alternating")
    model.representation_frozen = True
    model.train(PERIOD, batch_size=8)
    assert steps(model)["task critic"] == model._n_batches == PERIOD


def test_one_call_of_n_steps_equals_n_calls() -> None:
    models = [model_with_transitions(srl_schedule="alternating") for _ in range(2)]
    for model, calls in zip(models, ([7], [1] * 7), strict=True):
        model.set_random_seed(0)
        for n in calls:
            model.train(n, batch_size=8)
    assert differences(*map(state_of, models)) == []


# ---------------------------------------------------------------- intervals


@UPDATES
@pytest.mark.parametrize("task", [True, False])
def test_head_and_curious_agent_skip_updates(task: bool, update: str) -> None:
    """Of 12 updates the head makes every third, the curious agent every second, and its actor every second of those."""
    model = model_with_transitions(srl_interval=3, curious_interval=2, update=update, task=task)
    targets = [groups(model)["curious critic target"]]
    for _ in range(12):
        model.train(1, batch_size=8)
        targets.append(groups(model)["curious critic target"])
    expected = {"srl": 4, "curious critic": 6, "curious actor": 3, "curious temperature": 3}
    expected |= {"task critic": 12 * task, "task actor": 6 * task, "task temperature": 6 * task}
    assert steps(model) == expected
    moved = [i for i, pair in enumerate(itertools.pairwise(targets)) if not equal(*pair)]
    assert moved == [0, 4, 8]  # target_update_interval=2, of its own updates


def test_phases_of_the_head_skip_nothing() -> None:
    model = model_with_transitions(srl_schedule="alternating", srl_interval=2)
    model.train(2 * PERIOD, batch_size=8)
    assert steps(model)["srl"] == 2 * PERIOD  # one period, of two updates each


def test_head_alone_makes_each_update() -> None:
    model = model_with_transitions(srl_interval=3)
    model.fit_representation(6)
    assert steps(model)["srl"] == 6


def test_interval_of_the_curious_agent_skips_its_reward() -> None:
    model = model_with_transitions(intrinsic="rnd", curious_interval=3)
    model.train(6, batch_size=8)
    assert steps_of(model.policy.intrinsic.optimizer) == 2  # type: ignore[union-attr]


def test_burst_ignores_intervals() -> None:
    model = model_with_transitions(warmup_updates=6, srl_interval=3, curious_interval=2)
    model.learn(1, reset_num_timesteps=False)
    assert steps(model)["srl"] >= 6 and steps(model)["curious actor"] >= 6


@pytest.mark.parametrize("interval", [1, 3])
def test_targets_follow_every_few_updates(interval: int) -> None:
    """Target critics after each ``interval``-th update of critics, the target encoder of any update."""
    model = filled_model(tau=0.1, encoder_tau=0.3, target_update_interval=interval)
    prepare(model)
    times: dict[str, list[int]] = {"encoder target": [], "critic target": [], "curious critic target": []}
    phases = [(True, True), (True, False), (True, True), (True, True), (True, False), (True, True)]
    for index, phase in enumerate(phases):
        before = groups(model)
        model._plan = lambda phase=phase: (*phase, 1)  # type: ignore[misc]
        model.train(1, 8)
        after = groups(model)
        for name in times:
            if not equal(before[name], after[name]):
                times[name].append(index)
    with_critics = [index for index, (_, rl) in enumerate(phases) if rl]
    assert times["encoder target"] == list(range(0, 6, interval))
    assert times["critic target"] == times["curious critic target"] == with_critics[::interval]


class Normalised(BaseFeaturesExtractor):
    """An extractor with running statistics."""

    def __init__(self, observation_space: Any):
        super().__init__(observation_space, 8)
        self.layers = th.nn.Sequential(th.nn.Linear(2, 8), th.nn.BatchNorm1d(8))

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return self.layers(observations)


def test_targets_take_running_statistics() -> None:
    """They have none of their own, as they never train."""
    policy_kwargs = {"features_extractor_class": Normalised}
    policy = tiny_model("MlpPolicy", VectorBox(), policy_kwargs=policy_kwargs).learn(15).policy
    online, target = dict(policy.encoder.named_buffers()), dict(policy.encoder_target.named_buffers())
    assert len(online) == 3 and differences(online, target) == []


@UPDATES
@pytest.mark.parametrize("frozen", [False, True])
def test_statistics_of_vectors_follow_the_batch(frozen: bool, update: str) -> None:
    """Those of encoder and target alike, once an update, unless the representation is frozen."""
    model = model_with_transitions(update=update, target_update_interval=2)
    model.representation_frozen = frozen
    model._n_batches = 1  # no Polyak step, which would copy them
    np.random.seed(0)
    observations = model.replay_buffer.sample(8).observations  # type: ignore[union-attr]
    np.random.seed(0)
    model.train(1, batch_size=8)
    for encoder in (model.policy.encoder, model.policy.encoder_target):
        expected = th.zeros(2) if frozen else observations.mean(dim=0)
        th.testing.assert_close(encoder.trunk[0].mean, expected)  # type: ignore[index]


@pytest.mark.parametrize(("period", "interval"), [(None, 2), (1, 2), (2, 3), (3, 1)])
def test_actors_follow_every_few_updates_of_critics(period: int | None, interval: int) -> None:
    """Each ``interval``-th update of the critics, the first one included, whatever the periods of SRL and RL."""
    schedule: dict[str, Any] = dict(srl_schedule="alternating", srl_period=period) if period else {}
    model = tiny_model("MlpPolicy", VectorBox(), learning_starts=40, actor_update_interval=interval, **schedule)
    model.learn(40)
    for _ in range(12):
        model.train(1, 8)
        done = steps(model)
        for agent in ("task", "curious"):
            assert done[f"{agent} actor"] == done[f"{agent} temperature"] == -(-done[f"{agent} critic"] // interval)
    assert done["task critic"] >= 8


# ---------------------------------------------------------------- the burst


@UPDATES
def test_each_update_of_the_burst_updates_actors(update: str) -> None:
    """As SAC-AE's code, whose step counter stands still meanwhile; afterwards only every second one does."""
    model = tiny_model("MlpPolicy", VectorBox(), update=update, warmup_updates=9)
    for timesteps, critic, actor in ((11, 10, 9), (10, 20, 14)):  # first the burst of 9, and one more
        model.learn(timesteps, reset_num_timesteps=False)
        for agent in ("task", "curious"):
            expected = {"critic": critic, "actor": actor, "temperature": actor}
            assert {name: steps(model)[f"{agent} {name}"] for name in expected} == expected


def test_frozen_head_wants_no_burst() -> None:
    """The autoencoder's 1000 updates would train actors and critics alone, on what the warm-up has collected."""
    model = tiny_model("MlpPolicy", VectorBox(), warmup_updates=None)
    model.representation_frozen = True
    assert model.learn(12)._n_updates == 2


def test_burst_without_warm_up_needs_what_was_loaded() -> None:
    """As of a recipe with ``learning_starts=0``: at once it would be of one transition."""
    arguments: dict[str, Any] = dict(learning_starts=0, warmup_updates=9)
    models = [tiny_model("MlpPolicy", VectorBox(), **arguments) for _ in range(2)]
    ends = np.arange(8) == 7
    episode = RecordedEpisode(np.zeros((9, 2), np.float32), np.zeros((8, 2)), np.zeros(8), ends, ~ends & ends)
    models[1].load_transitions([episode])
    assert [model.learn(1)._n_updates for model in models] == [1, 10]


@pytest.mark.parametrize("schedule", ["simultaneous", "alternating"])
def test_each_update_of_the_burst_moves_targets(schedule: str) -> None:
    """Of a distance of 1 from what stands still, each leaves a half; later ones leave it as it is."""
    arguments: dict[str, Any] = dict(tau=0.5, encoder_tau=0.5, target_update_interval=10**9, srl_schedule=schedule)
    model = tiny_model(
        "MlpPolicy", VectorBox(), warmup_updates=4, srl_period=2, learning_rate=0.0, srl="inverse", **arguments
    )
    policy = model.policy
    pairs: dict[str, Any] = {"encoder": (policy.encoder, policy.encoder_target)}
    pairs |= {name: (agent.critic, agent.critic_target) for name, agent in policy.agents.items()}
    with th.no_grad():
        for source, target in pairs.values():
            for followed, parameter in zip(source.parameters(), target.parameters(), strict=True):
                parameter.copy_(followed + 1)
    model.learn(13)
    # In turn, each step of the burst is two updates, of which the target encoder follows each.
    n_updates = {"encoder": 4 if schedule == "simultaneous" else 8, "task": 4, "curious": 4}
    for name, (source, target) in pairs.items():
        left = [(q - p).mean().item() for p, q in zip(source.parameters(), target.parameters(), strict=True)]
        assert left == pytest.approx([0.5 ** n_updates[name]] * len(left), abs=1e-6), name


def test_interrupted_burst_is_made_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """After Ctrl-C, as training seems to stand still meanwhile."""
    model, calls = tiny_model("MlpPolicy", VectorBox(), warmup_updates=9), itertools.count(1)
    update = model._update

    def interrupted(*args: Any) -> Any:
        if next(calls) == 5:
            raise KeyboardInterrupt
        return update(*args)

    monkeypatch.setattr(model, "_update", interrupted)
    with pytest.raises(KeyboardInterrupt):
        model.learn(20)
    assert (model.num_timesteps, model._n_updates) == (11, 4)
    model.learn(1, reset_num_timesteps=False)
    assert model._n_updates == 4 + 9 + 1


def test_burst_is_made_while_environments_step() -> None:
    """With ``overlap=True``, and no update of it is lost."""
    env = SubprocVecEnv([VectorBox])
    model = tiny_model("MlpPolicy", env, warmup_updates=9, overlap=True).learn(11)
    env.close()
    assert steps(model)["task actor"] == 9
