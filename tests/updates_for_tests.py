"""Models with a filled buffer, one update of them, and that update written out from the papers."""

import copy
import functools
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch as th
from envs_for_tests import PixelBox, VectorBox, tiny_model
from torch import nn

from sb3_cure import CuReSAC, CuReTQC
from sb3_cure.data.buffers import transitions
from sb3_cure.data.observations import by_key
from sb3_cure.data.samples import Samples
from sb3_cure.networks.fast_ops import from_cells, to_cells
from sb3_cure.networks.layers import RunningStandardize

ALGORITHMS: dict[str, Any] = {"sac": CuReSAC, "tqc": CuReTQC}
BATCH = 8


def filled_model(algorithm: str = "sac", pixels: bool = False, **kwargs: Any) -> CuReSAC:
    """A model with random transitions in its buffer that has not been trained.

    Plain gradient descent, because Adam would move every parameter by the same distance; targets do not follow, so
    that only a gradient could move them.
    """
    policy_kwargs = {"optimizer_class": th.optim.SGD, **kwargs.pop("policy_kwargs", {})}
    if algorithm == "tqc":
        policy_kwargs = {"n_quantiles": 5, **policy_kwargs}
    defaults = dict(learning_starts=40, learning_rate=0.1, tau=0.0, encoder_tau=0.0, curiosity_prob=0.0)
    defaults |= dict(intrinsic="srl_error")
    policy, env = ("CnnPolicy", PixelBox()) if pixels else ("MlpPolicy", VectorBox())
    arguments = {**defaults, **kwargs, "policy_kwargs": policy_kwargs}
    return tiny_model(policy, env, ALGORITHMS[algorithm], **arguments).learn(40)


def sampled(model: CuReSAC) -> Samples:
    """The batch that ``train_once`` draws, with torch's generator and the encoder's statistics as in that update.

    :param model: Not trained yet, so that the statistics of its first batch stay as they are when it comes again
    """
    np.random.seed(1)
    buffer: Any = model.replay_buffer
    batch = Samples(*buffer.sample(BATCH))
    if model.curiosity == "separate" and not model.curiosity_episodic:
        rows, envs = buffer.last_sampled
        following = by_key(transitions(buffer, (rows + 1) % buffer.buffer_size, envs).observations)
        goes_on = batch.dones[:, 0].bool() & th.as_tensor((rows + 1) % buffer.buffer_size != buffer.pos)
        restarts = {key: part.clone() for key, part in by_key(batch.next_observations).items()}
        for key, part in restarts.items():
            part[goes_on] = following[key][goes_on]
        batch = batch._replace(restarts=restarts.get("", restarts))
    th.manual_seed(1)
    batch = batch._replace(views=model.policy.augmentation(batch.observations))
    for encoder in (model.policy.encoder, model.policy.encoder_target):
        encoder.update_statistics(batch.views)
    return batch


def train_once(model: CuReSAC, srl: bool = True, rl: bool = True, actors: bool = True) -> dict[str, float]:
    """One update, on a batch and with noise that depend on nothing else.

    :param model: With ``srl_schedule="simultaneous"``
    :param srl: Whether it is one of the head
    :param rl: Whether it is one of actors and critics
    :param actors: Whether actors and temperatures follow their critics
    :return: What was logged
    """
    model._plan = lambda: (srl and model.srl is not None, rl, 1)  # type: ignore[method-assign]
    model._n_rl_batches = 0 if actors else 1
    np.random.seed(1)
    th.manual_seed(1)
    model.logger.name_to_value.clear()
    model.logger.name_to_count.clear()  # of which `record_mean` makes its means
    model.train(1, BATCH)
    return {key.removeprefix("train/"): float(value) for key, value in model.logger.name_to_value.items()}


def groups(model: CuReSAC) -> dict[str, list[th.Tensor]]:
    """Everything that is trained, by its role; copied."""
    policy = model.policy
    modules: dict[str, Any] = {
        "trunk": policy.encoder.trunk,
        "projection": policy.encoder.projection,
        "encoder target": policy.encoder_target,
        "head": policy.srl,
        "reward": policy.intrinsic,
    }
    parameters = {name: list(module.parameters()) for name, module in modules.items() if module is not None}
    for agent, prefix in ((policy.task, ""), (policy.curious, "curious ")):
        if agent is not None:
            own = list(agent.actor.features_extractor.parameters())
            parameters[f"{prefix}actor projection"] = own
            parameters[f"{prefix}actor"] = [p for p in agent.actor.parameters() if all(p is not q for q in own)]
            parameters[f"{prefix}critic"] = list(agent.critic.parameters())
            parameters[f"{prefix}critic target"] = list(agent.critic_target.parameters())
            if agent.log_ent_coef is not None:
                parameters[f"{prefix}temperature"] = [agent.log_ent_coef]
    return {name: [p.detach().clone() for p in tensors] for name, tensors in parameters.items() if tensors}


def equal(first: list[th.Tensor], second: list[th.Tensor]) -> bool:
    return all(th.equal(a, b) for a, b in zip(first, second, strict=True))


def moved(before: dict[str, list[th.Tensor]], after: dict[str, list[th.Tensor]]) -> set[str]:
    """Names of the groups that moved; each moves as a whole or not at all."""
    result = set()
    for name in before:
        changes = [not th.equal(a, b) for a, b in zip(before[name], after[name], strict=True)]
        assert len(set(changes)) == 1, (name, changes)
        if changes[0]:
            result.add(name)
    return result


@th.no_grad()
def prepare(model: CuReSAC) -> None:
    """Let some transitions end where they began, errors differ between observations, targets from what they follow."""
    policy, buffer = model.policy, model.replay_buffer
    if policy.srl is not None:
        for parameter in policy.srl.parameters():
            parameter.normal_(std=0.3, generator=th.Generator().manual_seed(parameter.numel()))
    buffer.dones[::3] = 1  # type: ignore[union-attr]
    buffer.timeouts[:] = 0  # type: ignore[union-attr]
    for name, array in buffer.rows.items():  # type: ignore[union-attr]
        if name.startswith("slots/"):
            array[::3, :, 1] = array[::3, :, 0]
    for target in (policy.encoder_target, *(agent.critic_target for agent in policy.agents.values())):
        for parameter in target.parameters():
            parameter.mul_(1.1)


def critic_values(critic: Any, latents: th.Tensor, actions: th.Tensor) -> list[th.Tensor]:
    """Compute the values of each critic, one layer of one network after the other.

    :param critic: A ``LatentCritic``
    :param latents: [B, features_dim]
    :param actions: [B, action_dim]
    :return: [B, n_values] each
    """
    values = [th.cat([latents, actions], dim=1)] * critic.n_critics
    for layer in critic.ensemble:
        if list(layer.parameters()):
            values = [each @ layer.weight[i] + layer.bias[i, 0] for i, each in enumerate(values)]
        else:
            values = [layer(each) for each in values]
    return values


class StraightLine:
    """One update of the head and of both agents under plain gradient descent, written out from the papers.

    :param model: Copied as it is; its head is one of ``LOSSES``, its reward the standardised error
    """

    #: Latents of each image, whose gradients are normalised together
    parts: Sequence[slice] = (slice(None),)

    def __init__(self, model: CuReSAC):
        policy = model.policy
        self.model = model
        # Together, as the head refers to the encoders
        parts = [policy.encoder, policy.encoder_target, policy.srl, *policy.agents.values()]
        self.encoder, self.encoder_target, self.head, *agents = copy.deepcopy(parts)
        self.agents = dict(zip(policy.agents, agents, strict=True))
        self.lr = model.learning_rate
        self.quantiles = isinstance(model, CuReTQC)

    def groups(self) -> list[th.Tensor]:
        """All parameters and temperatures."""
        modules = [
            self.encoder,
            self.encoder_target,
            *self.agents.values(),
            *([] if self.head is None else [self.head]),
        ]
        found = [parameter.detach() for module in modules for parameter in module.parameters()]
        return [*found, *(agent.log_ent_coef.detach() for agent in self.agents.values())]

    @th.no_grad()
    def follow(self, target: nn.Module, online: nn.Module, rate: float) -> None:
        for old, new in zip(target.parameters(), online.parameters(), strict=True):
            old.copy_((1 - rate) * old + rate * new)

    def descend(self, loss: th.Tensor, module: nn.Module, rate: float) -> None:
        parameters = [parameter for parameter in module.parameters() if parameter.requires_grad]
        gradients = th.autograd.grad(loss, parameters, retain_graph=True)
        with th.no_grad():
            for parameter, gradient in zip(parameters, gradients, strict=True):
                parameter.sub_(rate * gradient)

    def scaled(self, observations: th.Tensor) -> th.Tensor:
        return observations.float() / 255 if observations.dtype == th.uint8 else observations

    @th.no_grad()
    def standardise_by(self, observations: th.Tensor) -> None:
        """Standardise vectors by mean and variance of the first batch."""
        for module in (*self.encoder.modules(), *self.encoder_target.modules()):
            if isinstance(module, RunningStandardize):
                module.mean.copy_(observations.mean(dim=0))
                module.variance.copy_(observations.var(dim=0, correction=0))
        numbers = observations.float()
        self.mean, self.deviation = numbers.mean(dim=0), numbers.std(dim=0, correction=0)

    def srl(self, batch: Samples, *latents: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Loss of the head, and the error of each sample."""
        return LOSSES[self.model.srl](self, batch, *latents)  # type: ignore[index]

    def values(self, critic: Any, latents: th.Tensor, actions: th.Tensor) -> list[th.Tensor]:
        return critic_values(critic, latents, actions)

    def critic_loss(self, values: list[th.Tensor], target: th.Tensor) -> th.Tensor:
        """Compute SAC's squared errors, or TQC's quantile Huber loss in loops.

        :param values: Of each critic, [B, 1] or [B, n_quantiles]
        :param target: [B, 1] or [B, kept quantiles]
        """
        if not self.quantiles:
            return 0.5 * sum(((value - target) ** 2).mean() for value in values)  # type: ignore[return-value]
        n = values[0].shape[1]
        total = []
        for value in values:
            for i in range(n):
                for j in range(target.shape[1]):
                    difference = target[:, j] - value[:, i]
                    size = difference.abs()
                    huber = th.where(size > 1, size - 0.5, 0.5 * difference**2)
                    total.append(((i + 0.5) / n - (difference.detach() < 0).float()).abs() * huber)
        return th.stack(total).mean()

    def update(self, batch: Samples, sequential: bool) -> dict[str, float]:
        """Make the update.

        :param batch: What is sampled, torch's generator where the update begins
        :param sequential: Whether the encoder steps after each loss, or once on their normalised gradients
        :return: Losses by their logged names
        """
        self.standardise_by(batch.views)
        obs = self.scaled(batch.views)
        # Drawn where it is first read
        views = self.model.policy.augmentation
        self.next_obs = functools.cache(lambda: self.scaled(views(batch.next_observations)))
        shared = self.encoder(obs)
        pulls: list[Sequence[th.Tensor]] = []

        def learn(loss: th.Tensor, owner: nn.Module, *read: th.Tensor) -> None:
            gradients = th.autograd.grad(loss, read, retain_graph=True)
            if not sequential:
                gradients = tuple(gradient.clone() for gradient in gradients)
                for part in self.parts:
                    size = th.cat([gradient[:, part] for gradient in gradients]).norm()
                    for gradient in gradients:
                        gradient[:, part] /= size
            along = th.autograd.grad(read, list(self.encoder.parameters()), gradients, retain_graph=True)
            self.descend(loss, owner, self.lr)
            if sequential:
                with th.no_grad():
                    for parameter, step in zip(self.encoder.parameters(), along, strict=True):
                        parameter.sub_(self.lr * step)
            else:
                pulls.append(along)

        found: dict[str, th.Tensor] = {}
        errors = th.zeros(len(obs))
        if self.head is not None:
            read = (shared, self.encoder(self.next_obs())) if self.head.needs_next_latents else (shared,)
            loss, errors = self.srl(batch, *read)
            found["srl_loss"] = loss
            if self.model.curiosity_target == "next_observation":  # before the steps of head and encoder
                _, errors = self.srl(
                    batch._replace(observations=batch.next_observations), self.encoder(self.next_obs())
                )
            learn(loss, self.head, *read)
        if self.model.srl == "spr":
            self.follow(self.head.target_projection, self.head.projection, 0.05)
        errors = errors.detach()
        curious = ((errors - errors.mean()) / errors.std(unbiased=False)).clamp(-5, 5) * self.model.curiosity_beta
        ends = batch.dones[:, 0]
        curious_ends = ends if self.model.curiosity_episodic else th.zeros_like(ends)
        rewards = batch.rewards[:, 0]
        if self.model.curiosity == "bonus":  # scaled, not centred
            rewards = rewards + self.model.curiosity_beta * errors / errors.square().mean().sqrt()
        self.learn_agent("task", batch, rewards, self.model.gamma * (1 - ends), self.next_obs(), learn, found)
        if self.model.curiosity == "separate":
            discounts = self.model.curiosity_gamma * (1 - curious_ends)
            goes_on = self.next_obs() if batch.restarts is None else self.scaled(views(batch.restarts))
            self.learn_agent("curious", batch, curious, discounts, goes_on, learn, found)
        if not sequential:
            with th.no_grad():
                for parameter, *steps in zip(self.encoder.parameters(), *pulls, strict=True):
                    parameter.sub_(self.lr * len(pulls) ** 0.5 * sum(steps))
        self.follow(self.encoder_target, self.encoder, self.model.encoder_tau)
        for agent in self.agents.values():
            self.follow(agent.critic_target, agent.critic, self.model.tau)
        return {name: float(value.detach()) for name, value in found.items()}

    def learn_agent(
        self,
        name: str,
        batch: Samples,
        rewards: th.Tensor,
        discounts: th.Tensor,
        next_obs: th.Tensor,
        learn: Any,
        found: dict[str, th.Tensor],
    ) -> None:
        """Critic, actor and temperature, with the encoder as it is by now."""
        agent, prefix = self.agents[name], "" if name == "task" else "curious_"
        obs = self.scaled(batch.views)
        alpha = agent.log_ent_coef.detach().exp()
        with th.no_grad():
            next_actions, next_log_prob = agent.actor.action_log_prob(self.encoder.trunk(next_obs))
            next_values = self.values(agent.critic_target, self.encoder_target(next_obs), next_actions)
            if self.quantiles:
                kept = sum(v.shape[1] for v in next_values) - 2 * self.model.top_quantiles_to_drop_per_net
                next_value = th.cat(next_values, dim=1).sort(dim=1).values[:, :kept]
            else:
                next_value = th.minimum(*next_values)
            target = rewards[:, None] + discounts[:, None] * (next_value - alpha * next_log_prob)
        latents = self.encoder(obs)
        loss = found[f"{prefix}critic_loss"] = self.critic_loss(
            self.values(agent.critic, latents, batch.actions), target
        )
        learn(loss, agent.critic, latents)
        with th.no_grad():
            features = self.encoder.trunk(obs)
            latents = self.encoder.projection(features)
        actions, log_prob = agent.actor.action_log_prob(features)
        values = self.values(agent.critic, latents, actions)
        value = th.cat(values, dim=1).mean(dim=1, keepdim=True) if self.quantiles else th.minimum(*values)
        loss = found[f"{prefix}actor_loss"] = (alpha * log_prob - value).mean()
        self.descend(loss, agent.actor, self.lr)
        # Target entropy: minus the number of actions.
        surplus = (log_prob.detach() - 2).mean()
        found[f"{prefix}ent_coef_loss"] = -agent.log_ent_coef * surplus
        with th.no_grad():  # the first step of any Adam is as long as its learning rate
            agent.log_ent_coef.add_(self.lr * self.model.ent_coef_lr_factor * surplus.sign())
        found[f"{prefix}ent_coef"] = alpha


# What each head minimises, written out: its loss, and the error of each sample


def rae_loss(line: StraightLine, batch: Samples, latents: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """Squared error of the dithered image (its noise drawn in the order in which pixels are) and latent penalty."""
    errors = reconstruction_errors(line, batch, latents)
    return errors.mean() + 1e-6 * 0.5 * (latents**2).sum(dim=1).mean(), errors


def reconstruction_errors(line: StraightLine, batch: Samples, latents: th.Tensor) -> th.Tensor:
    if batch.observations.dtype != th.uint8:
        goal = (batch.observations - line.mean) / line.deviation
    else:
        goal = from_cells(line.head.target(to_cells(batch.observations), dither=True))
    return ((line.head.decoder(latents) - goal) ** 2).flatten(1).mean(dim=1)


def vae_loss(line: StraightLine, batch: Samples, latents: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """Squared error of what is drawn from N(latents, sigma^2), and beta times the divergence, as torch computes it."""
    sigma = (0.5 * linear(latents, line.head.log_variance)).exp()
    posterior, prior = th.distributions.Normal(latents, sigma), th.distributions.Normal(0.0, 1.0)
    divergence = th.distributions.kl_divergence(posterior, prior).sum(dim=1)
    errors = reconstruction_errors(line, batch, latents + sigma * th.randn(latents.shape))
    return errors.mean() + line.head.beta * divergence.mean(), errors


def curl_loss(line: StraightLine, batch: Samples, latents: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """Eq. 3 of the paper: -log of exp(q W k+) over the sum of exp(q W k) of all keys."""
    with th.no_grad():
        keys = line.encoder_target(line.scaled(line.model.policy.augmentation(batch.observations)))
    scores = (latents @ line.head.W @ keys.T).exp()
    errors = -(scores.diagonal() / scores.sum(dim=1)).log()
    return errors.mean(), errors


def spr_loss(line: StraightLine, batch: Samples, latents: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """1 - cosine of predictor(projection(transition)) and of the standardised projection by the moving averages."""
    head = line.head
    with th.no_grad():
        target = standardised(linear(next_keys(line, batch), head.target_projection))
    predicted = mlp(th.cat([latents, batch.actions], dim=1), head.transition)
    predicted = linear(linear(predicted, head.projection), head.predictor)
    errors = 1 - (predicted * target).sum(dim=1) / (predicted.norm(dim=1) * target.norm(dim=1))
    return errors.mean(), errors


def forward_loss(line: StraightLine, batch: Samples, latents: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """Squared distance from the standardised next latents of the moving average."""
    with th.no_grad():
        target = standardised(next_keys(line, batch))
    errors = ((mlp(th.cat([latents, batch.actions], dim=1), line.head.model) - target) ** 2).mean(dim=1)
    return errors.mean(), errors


def inverse_loss(
    line: StraightLine, batch: Samples, latents: th.Tensor, next_latents: th.Tensor
) -> tuple[th.Tensor, th.Tensor]:
    """Squared distance from the executed action, with a gradient through both latents."""
    errors = ((mlp(th.cat([latents, next_latents], dim=1), line.head.model) - batch.actions) ** 2).mean(dim=1)
    return errors.mean(), errors


def linear(inputs: th.Tensor, layer: Any) -> th.Tensor:
    return inputs @ layer.weight.T + layer.bias


def mlp(inputs: th.Tensor, layers: Any) -> th.Tensor:
    return linear(linear(inputs, layers[0]).clamp(min=0), layers[2])


def next_keys(line: StraightLine, batch: Samples) -> th.Tensor:
    """Latents of another view of the next observations, by the moving average."""
    return line.encoder_target(line.scaled(line.model.policy.augmentation(batch.next_observations)))


def standardised(target: th.Tensor) -> th.Tensor:
    centred = target - target.mean(dim=0)
    return centred / ((centred**2).mean(dim=0) + 1e-5) ** 0.5


LOSSES: dict[Any, Any] = {
    "rae": rae_loss,
    "vae": vae_loss,
    "curl": curl_loss,
    "spr": spr_loss,
    "forward": forward_loss,
    "inverse": inverse_loss,
}
