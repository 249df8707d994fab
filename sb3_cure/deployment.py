"""A trained policy as a plain module, for ONNX, TorchScript and what else runs on a robot."""

from typing import TYPE_CHECKING

import torch as th
from gymnasium import spaces
from stable_baselines3 import SAC
from torch import nn

from sb3_cure.evaluation import trained_actors
from sb3_cure.policies import CuRePolicy

if TYPE_CHECKING:
    from sb3_cure.cure_sac import CuReSAC


class DeterministicActor(nn.Module):
    """What ``predict(observation, deterministic=True)`` computes, from a batch of observations to actions of the
    environment, without random numbers and branches, so that ``torch.onnx.export``, ``torch.export`` and
    ``torch.jit.trace`` can follow it. The networks are the model's own: train on, and it changes with them.

    :param model: A trained model
    :param actor: ``"task"`` or ``"curious"``; by default that of ``predict``
    :raises ValueError: if the model has no such policy, or is none
    """

    low: th.Tensor
    high: th.Tensor

    def __init__(self, model: "CuReSAC", actor: str | None = None):
        super().__init__()
        if not isinstance(model, SAC):
            raise ValueError(
                f"model is a {type(model).__name__}, but it must be a CuReSAC, or SB3's SAC: give the model itself, "
                "not its policy; of other algorithms export the policy as SB3's documentation tells."
            )
        names = {"task": "actor", "curious": "curious_actor"}
        trained = trained_actors(model)
        actor = trained[0] if actor is None else actor
        if actor not in trained:
            raise ValueError(
                f"actor is {actor!r}, but this model has {' and '.join(map(repr, trained))}: choose one of them."
            )
        self.actor = getattr(model.policy, names[actor])
        # In a tuple, so that critics and decoder are no part of what is exported.
        self._policy = (model.policy,)
        self.trunk = model.policy.encoder.trunk if isinstance(model.policy, CuRePolicy) else None
        self._observation_space = model.observation_space
        space = model.action_space
        self.register_buffer("low", th.as_tensor(space.low, dtype=th.float32, device=model.device))  # type: ignore[attr-defined]
        self.register_buffer("high", th.as_tensor(space.high, dtype=th.float32, device=model.device))  # type: ignore[attr-defined]
        self.train(False)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """
        :param observations: As the agent sees them, [B, *shape]: images uint8, channels first
        :return: Actions within the environment's bounds, [B, *action shape]
        :raises ValueError: for a single observation, and for images that are not uint8
        """
        space = self._observation_space
        if isinstance(space, spaces.Box):
            kind = th.uint8 if space.dtype == "uint8" else observations.dtype
            if observations.dim() != len(space.shape) + 1 or observations.dtype != kind:
                raise ValueError(
                    f"observations are {observations.dtype} of {observations.dim()} dimensions, but a batch of "
                    f"{kind}, [B, {', '.join(map(str, space.shape))}], is expected: add the batch's dimension to a "
                    "single one by observation[None], and do not divide images by 255."
                )
        (policy,) = self._policy
        policy.set_training_mode(False)  # as `predict` does: the model may have trained on
        inputs = observations if self.trunk is None else self.trunk(policy.center(observations))
        mean, _, _ = self.actor.get_action_dist_params(inputs)
        scaled = 0.5 * (th.tanh(mean).view(-1, *self.low.shape) + 1)
        return self.low + scaled * (self.high - self.low)
