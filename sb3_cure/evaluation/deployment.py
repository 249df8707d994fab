"""A trained policy as a plain module, for ONNX, TorchScript and other runtimes on a robot."""

from typing import Any

import torch as th
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from torch import nn

from sb3_cure.cure.policies import CuRePolicy
from sb3_cure.data.observations import check_images
from sb3_cure.evaluation.rollouts import trained_actors


class DeterministicActor(nn.Module):
    """The deterministic policy of a model, from a batch of observations to actions of the environment.

    Computes the same as ``predict(observation, deterministic=True)``, without random numbers and branches, so that
    ``torch.onnx.export``, ``torch.export`` and ``torch.jit.trace`` can follow it. It shares the model's networks, and
    changes with them in further training.

    :param model: A trained model of this package, or of SB3's SAC or TQC
    :param actor: ``"task"`` or ``"curious"``; by default that of ``predict``
    :raises ValueError: if the model has no such policy
    """

    low: th.Tensor
    high: th.Tensor

    def __init__(self, model: OffPolicyAlgorithm, actor: str | None = None):
        super().__init__()
        trained = trained_actors(model)
        actor = next(iter(trained), None) if actor is None else actor
        if actor not in trained:
            raise ValueError(f"actor must be one of {trained} that this model trains, not {actor!r}.")
        policy: Any = model.policy
        self.actor: Any = policy.curious.actor if actor == "curious" else policy.actor
        # In a tuple, so that critics and decoder are no part of what is exported
        self._policy: Any = (model.policy,)
        self.trunk = model.policy.encoder.trunk if isinstance(model.policy, CuRePolicy) else None
        self._observation_space = model.observation_space
        for name in ("low", "high"):
            bound = th.as_tensor(getattr(model.action_space, name), dtype=th.float32, device=model.device)
            self.register_buffer(name, bound)
        self.train(False)

    @th.no_grad()
    def forward(self, observations: th.Tensor | dict[str, th.Tensor]) -> th.Tensor:
        """Compute actions.

        :param observations: As the agent sees them, [B, *shape], or a dictionary: images uint8, channels first
        :return: Actions within the environment's bounds, [B, *action shape]
        :raises ValueError: for images that are not uint8
        """
        check_images(observations, self._observation_space)
        (policy,) = self._policy
        policy.set_training_mode(False)  # as `predict` does, also after further training
        inputs: Any = observations if self.trunk is None else self.trunk(policy.center(observations))
        mean, *_ = self.actor.get_action_dist_params(inputs)
        scaled = 0.5 * (th.tanh(mean).view(-1, *self.low.shape) + 1)
        return self.low + scaled * (self.high - self.low)
