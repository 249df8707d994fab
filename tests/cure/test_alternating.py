"""Alternating phases of SRL and RL: as many updates of both as when they are simultaneous."""

from typing import Any

import pytest
import torch as th
from agents_for_tests import actor_critic, steps_of
from envs_for_tests import VectorBox, differences, state_of, tiny_model

from sb3_cure import CuReSAC

both_updates = pytest.mark.parametrize("update", ["sequential", "joint"])
PERIOD = 3


def model_with_transitions(**kwargs: Any) -> CuReSAC:
    return tiny_model("MlpPolicy", VectorBox(), learning_starts=40, srl_period=PERIOD, **kwargs).learn(40)


def numbers_of_steps(model: CuReSAC) -> dict[str, int]:
    """How often the optimiser of each part has stepped."""
    steps = {"srl": steps_of(model.policy.srl.optimizer)}
    for name in ("task", "curious"):
        agent: Any = actor_critic(model, name)
        steps[f"{name} critic"] = steps_of(agent.critic.optimizer)
        steps[f"{name} actor"] = steps_of(agent.actor.optimizer)
    return steps


@both_updates
@pytest.mark.parametrize("at_once", [True, False], ids=["one call", "a call per step"])
def test_whole_periods_equal_simultaneous_counts(update: str, at_once: bool) -> None:
    """SRL, critics and actors; ``n_updates`` counts agent steps in both schedules."""
    steps = []
    for schedule in ("simultaneous", "alternating"):
        model = model_with_transitions(update=update, srl_schedule=schedule)
        for n in [4 * PERIOD] if at_once else [1] * 4 * PERIOD:
            model.train(n, batch_size=8)
        assert model._n_updates == 4 * PERIOD
        steps.append(numbers_of_steps(model))
    assert steps[0]["srl"] == steps[0]["task critic"] == 4 * PERIOD
    assert steps[1] == steps[0]


def test_each_phase_makes_two_updates_per_step() -> None:
    """First of the head alone, then of the agents alone, and so on."""
    model = model_with_transitions(srl_schedule="alternating")
    for step in range(1, 2 * PERIOD + 1):
        model.train(1, batch_size=8)
        steps = numbers_of_steps(model)
        assert steps["srl"] == 2 * min(step, PERIOD)
        assert steps["task critic"] == steps["curious critic"] == 2 * max(0, step - PERIOD)
        # Every second update of the critics
        assert steps["task actor"] == steps["curious actor"] == max(0, step - PERIOD)


@pytest.mark.parametrize(
    "settings",
    [dict(srl=None, intrinsic="rnd"), dict(srl=None, curiosity=None, policy_kwargs={"share_encoder": True})],
)
def test_without_two_to_take_turns_one_update_is_made(settings: dict[str, Any]) -> None:
    """Where there is no head, or, while pretraining with random actions, nothing else."""
    model = model_with_transitions(srl_schedule="alternating", **settings)
    model.train(PERIOD, batch_size=8)
    assert steps_of(model.policy.critic.optimizer) == PERIOD


def test_pretraining_with_random_actions_makes_single_updates() -> None:
    model = model_with_transitions(srl_schedule="alternating")
    model.fit_representation(PERIOD)
    assert numbers_of_steps(model)["srl"] == PERIOD


@both_updates
def test_critics_targets_rest_while_critics_do(update: str) -> None:
    """In phases of SRL only the target encoder follows; in those of RL all targets do."""
    model = model_with_transitions(srl_schedule="alternating", update=update, tau=0.3, encoder_tau=0.3)
    targets = {
        "encoder": model.policy.encoder_target,
        "task": actor_critic(model, "task").critic_target,
        "curious": actor_critic(model, "curious").critic_target,
    }
    with th.no_grad():  # so that each has something to follow
        for target in targets.values():
            for parameter in target.parameters():
                parameter.add_(0.1)
    for step in range(4 * PERIOD):
        before = {name: [p.clone() for p in target.parameters()] for name, target in targets.items()}
        model.train(1, batch_size=8)
        moved = {
            name
            for name, target in targets.items()
            if any(not th.equal(p, q) for p, q in zip(before[name], target.parameters(), strict=True))
        }
        assert moved == ({"encoder"} if step // PERIOD % 2 == 0 else {"encoder", "task", "curious"}), step


def test_critics_targets_follow_as_often_as_simultaneously() -> None:
    """What is left of a distance of 1 after whole periods, where critics stand still."""
    left = []
    for schedule in ("simultaneous", "alternating"):
        model = model_with_transitions(srl_schedule=schedule, learning_rate=0.0, tau=0.1)
        agent = actor_critic(model, "curious")
        with th.no_grad():
            for parameter, followed in zip(agent.critic_target.parameters(), agent.critic.parameters(), strict=True):
                parameter.copy_(followed + 1)
        model.train(4 * PERIOD, batch_size=8)
        distances = zip(agent.critic_target.parameters(), agent.critic.parameters(), strict=True)
        left.append([float((p - q).detach().mean()) for p, q in distances])
    assert left[0] == pytest.approx([0.9 ** (2 * PERIOD)] * len(left[0]), rel=1e-4)
    assert left[1] == pytest.approx(left[0], rel=1e-4)


def test_alternating_learning_does_not_depend_on_the_calls() -> None:
    """One call of ``train`` for n steps does what n calls do."""
    models = [model_with_transitions(srl_schedule="alternating") for _ in range(2)]
    for model, calls in zip(models, ([7], [1] * 7), strict=True):
        model.set_random_seed(0)
        for n in calls:
            model.train(n, batch_size=8)
    assert differences(*map(state_of, models)) == []
