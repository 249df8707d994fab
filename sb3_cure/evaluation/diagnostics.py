"""Silent failures of training from pixels: criteria and thresholds of ``DiagnosticsCallback``.

Each check measures one number on observations that the agent has seen, and describes the problem in a sentence if it
is out of bounds. Checks that do not apply to a model (no images, no autoencoder, no temperature) return None.
"""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch as th
from stable_baselines3.common.type_aliases import ReplayBufferSamples

from sb3_cure.cure.policies import CuRePolicy
from sb3_cure.data.buffers import stored_places, transitions
from sb3_cure.data.observations import image_spaces, images_of
from sb3_cure.evaluation.encoders import encoder_of
from sb3_cure.srl import RAE, DictHead

#: Observations of the replay buffer that are looked at
SAMPLES = 128
#: Updates before networks, temperatures and the curious reward are judged: in the first few hundred, latents may
#: collapse and recover
MIN_UPDATES = 2000
#: Updates before an autoencoder is judged: before a few thousand it is no better than the mean image, even in good
#: runs
AUTOENCODER_UPDATES = 5000
#: Least and greatest temperature that can still weigh entropy against reward
TEMPERATURES = 1e-4, 1e2
#: Latest transitions, of all environments together, that are checked for a constant image
RECENT = 1000
#: Observations of an environment that must be equal to count as constant: a robot may lie still for a moment
MIN_ALIKE = 30
#: Deviation of the latents between observations, as a share of their root mean square. Runs that learn well were
#: measured at 0.3 to 0.5 after 1000 updates; in their first 500 some fell to 0.004 and came back
LATENT_SPREAD = 0.01
#: Share of the pixels' variance that an autoencoder must explain; the mean image explains 0
EXPLAINED_SHARE = 0.01
#: Nats per action dimension by which the policy's entropy must miss its target for a temperature to be running away
ENTROPY_GAP = 0.5
#: Deviation of the curious reward over the mean entropy term. A difference that lasts for the horizon of a discount
#: factor of 0.99, 100 steps, then weighs less than the entropy of a single action
CURIOUS_SHARE = 0.01


class Finding(NamedTuple):
    """Result of a check.

    :param name: Name of the check
    :param value: The number that was measured
    :param problem: A sentence if the number is out of bounds, else None
    """

    name: str
    value: float
    problem: str | None


class Temperature(NamedTuple):
    """Temperature of an agent.

    :param agent: ``"task"`` or ``"curious"``
    :param value: The entropy coefficient
    :param learned: Whether it is adjusted to an entropy
    :param log_prob: Log-probabilities of actions that the agent drew, [n]
    """

    agent: str
    value: float
    learned: bool
    log_prob: th.Tensor


@th.no_grad()
def run_checks(model: Any, reward_std: Any) -> Iterator[Finding | None]:
    """Check a model in training, from cause to effect: a problem may explain those that follow.

    Behind a constant image all latents are alike, and next to a huge temperature no reward counts.

    :param model: An off-policy algorithm of SB3, or of this package
    :param reward_std: Standard deviation of the curious reward, last logged; None before the first update
    :return: Findings; None for checks that do not apply
    """
    yield constant_image(model)
    if model._n_updates < MIN_UPDATES:
        return
    model.policy.set_training_mode(False)
    batch = model.replay_buffer.sample(SAMPLES, env=model._vec_normalize_env)
    temperatures = list(_temperatures(model, batch))
    yield temperature_at_bound(temperatures, model)
    encode = encoder_of(model.policy)
    if encode is not None:
        latents = encode(batch.observations)
        yield collapsed_latents(latents)
        explained = explained_share(model, batch, latents)
        yield None if explained is None else autoencoder(explained, model._n_updates)
    yield None if reward_std is None else curious_reward(float(reward_std), temperatures)


# ------------------------------------------------------------------------ checks


def constant_image(model: Any) -> Finding | None:
    """Environments whose latest images are all equal, as nothing moves or the camera sees nothing.

    Value: number of such environments, or of their images for dictionaries. Expected: 0.

    :param model: The model
    :return: None without images, or with fewer than ``MIN_ALIKE`` observations of each environment
    """
    buffer = model.replay_buffer
    rows, env_inds, _ = stored_places(buffer)
    count = min(len(rows) // buffer.n_envs, max(-(-RECENT // buffer.n_envs), MIN_ALIKE))
    if not image_spaces(model.observation_space) or count < MIN_ALIKE:
        return None
    chosen = np.linspace(0, count - 1, min(count, max(SAMPLES // buffer.n_envs, MIN_ALIKE))).astype(int)
    constant: list[str] = []
    for env in range(buffer.n_envs):
        seen = transitions(buffer, rows[env_inds == env][chosen], np.full(len(chosen), env)).observations
        for key, images in images_of(seen, model.observation_space).items():
            if bool((images == images[:1]).all()):
                constant.append(f"{env} ({key})" if key else f"{env}")
    problem = (
        f"{len(chosen)} of the last {count} observations of environment {', '.join(constant)} are the same image: "
        "check what env.render() shows, and camera_id."
    )
    return Finding("constant_image", len(constant), problem if constant else None)


def collapsed_latents(latents: th.Tensor) -> Finding:
    """Latents that are the same for all observations.

    Value: standard deviation between observations over root mean square. Expected: at least ``LATENT_SPREAD``.

    :param latents: [n, features_dim]
    """
    deviation, size = latents.var(dim=0, correction=0).mean().sqrt(), latents.square().mean().sqrt()
    spread = float(deviation / size.clamp(min=1e-12))
    problem = (
        f"the encoder's latents differ by {spread:.1e} of their size between observations, not by "
        f"{LATENT_SPREAD} at least: try a smaller learning_rate, or another srl head or srl_kwargs."
    )
    return Finding("collapsed_latents", spread, problem if spread < LATENT_SPREAD else None)


def autoencoder(explained: float, updates: int) -> Finding:
    """An autoencoder no better than the mean image, which is the best constant reconstruction.

    Value: 1 - (noise-free squared error) / (that of the mean image). Expected: at least ``EXPLAINED_SHARE`` after
    ``AUTOENCODER_UPDATES``; early on it is below 0.

    :param explained: The value
    :param updates: Updates that were made
    """
    problem = (
        f"after {updates} updates the autoencoder explains {explained:.3f} of the pixels' variance, not "
        f"{EXPLAINED_SHARE} at least: try another learning_rate, more filters, or srl='curl'."
    )
    is_bad = updates >= AUTOENCODER_UPDATES and explained < EXPLAINED_SHARE
    return Finding("autoencoder", explained, problem if is_bad else None)


def temperature_at_bound(temperatures: Sequence[Temperature], model: Any) -> Finding | None:
    """Temperatures that no longer weigh entropy against reward.

    SAC's temperature falls towards 0 if the policy stays more random than the target entropy at any temperature (say,
    without any reward), and rises without limit if the policy cannot become as random as the target. So a learned one
    counts as at its bound when it lies outside of ``TEMPERATURES`` *and* the policy's entropy misses its target by
    ``ENTROPY_GAP`` nats per action dimension in the direction that drives it further out: small rewards alone need a
    small temperature, and with it the policy meets the target. A fixed one counts when it lies outside of
    ``TEMPERATURES``, unless it is 0, which turns the entropy off.

    Value: number of temperatures at a bound. Expected: 0.

    :param temperatures: Of the agents that are trained
    :param model: The model
    :return: None for algorithms without temperature
    """
    (least, greatest), problems = TEMPERATURES, []
    for agent, value, learned, log_prob in temperatures:
        entropy, target = -float(log_prob.mean()), float(model.target_entropy)
        gap = (entropy - target) / np.prod(model.action_space.shape)
        too_low, too_high = value < least, value > greatest
        how, advice = "is fixed at", "use ent_coef='auto', or scale the rewards"
        if learned:
            too_low, too_high = too_low and gap > ENTROPY_GAP, too_high and gap < -ENTROPY_GAP
            how = f"has reached, with an entropy of {entropy:.1f} and a target of {target:.1f},"
            advice = "check whether it finds any reward" if too_low else "set a smaller target_entropy"
        if (too_low or too_high) and (learned or value != 0):
            expected = f"not in [{least:g}, {greatest:g}]: {advice}"
            problems.append(f"the temperature of the {agent} agent {how} {value:.1e}, {expected}.")
    return Finding("temperature", len(problems), problems[0] if problems else None) if temperatures else None


def curious_reward(deviation: float, temperatures: Sequence[Temperature]) -> Finding | None:
    """A curious reward so small compared with the entropy term that its agent acts at random.

    Value: standard deviation of the curious reward over the mean of |temperature * log-probability| (what all
    observations earn alike has no effect). Expected: at least ``CURIOUS_SHARE``.

    :param deviation: Standard deviation of the reward
    :param temperatures: Of the agents that are trained; the last one is the agent that gets the reward
    :return: None without entropy term
    """
    if not temperatures or temperatures[-1].value == 0:
        return None
    entropy = float((temperatures[-1].value * temperatures[-1].log_prob).abs().mean())
    ratio = deviation / max(entropy, 1e-12)
    problem = (
        f"the curious reward varies by {deviation:.1e} while the entropy term is {entropy:.1e}, so the curious "
        "policy is close to random: use normalize_curiosity=True, or a larger curiosity_beta."
    )
    return Finding("curious_reward", ratio, problem if ratio < CURIOUS_SHARE else None)


# ------------------------------------------------------------------- measurements


def explained_share(model: Any, batch: ReplayBufferSamples, latents: th.Tensor) -> float | None:
    """Share of the targets' variance that the autoencoder explains; the least share if there are several images.

    :param model: The model
    :param batch: Transitions
    :param latents: Their latents, [n, features_dim]
    :return: None for heads that are not ``RAE``, and for images without any variance
    """
    head = getattr(model.policy, "srl", None)
    parts: list[Any] = head.parts(latents) if isinstance(head, DictHead) else [("", head, latents)]
    if not all(isinstance(each, RAE) for _, each, _ in parts):
        return None
    seen = model.policy.samples(batch, random=False)
    shares = []
    for key, each, own in parts:
        shown = seen.of(key) if key else seen
        variance = float(each.target(shown.views, dither=False).var(dim=0, correction=0).mean())
        if variance > 0:
            shares.append(1 - float(each.error(shown, own).mean()) / variance)
    return min(shares, default=None)


def _temperatures(model: Any, batch: ReplayBufferSamples) -> Iterator[Temperature]:
    """Temperatures of the agents that are trained, the curious one last."""
    if isinstance(model.policy, CuRePolicy):
        features = model.policy.encoder.trunk(model.policy.center(batch.observations))
        for name, agent in model.policy.agents.items():
            if name == "curious" or model.task:
                log_prob = agent.actor.action_log_prob(features)[1]
                yield Temperature(name, float(agent.temperature()), agent.log_ent_coef is not None, log_prob)
    elif hasattr(model, "log_ent_coef"):
        learned = model.log_ent_coef is not None
        value = model.log_ent_coef.exp() if learned else model.ent_coef_tensor
        yield Temperature("task", float(value), learned, model.actor.action_log_prob(batch.observations)[1])
