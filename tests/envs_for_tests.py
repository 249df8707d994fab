"""What the tests share: tiny environments (a dot moved about a square), tiny models, and how to compare two of them."""

import copy
import functools
import os
import signal
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.save_util import recursive_getattr

from sb3_cure import CuReSAC
from sb3_cure.data.samples import Samples


class VectorBox(gym.Env):
    """A dot in [-1, 1]^2 starts at a random place and is moved by the action; the closer to the origin, the better.

    Dynamics are deterministic: ``position += 0.3 * action`` (rescaled to [-1, 1]), kept within the square. The reward
    of a step is ``1 - max|position|``, in [0, 1]. Episodes are truncated after ``episode_length`` steps and never
    terminate. All randomness is the start, drawn from the environment's seeded generator.

    :param episode_length: Steps until truncation
    :param low: Lower bound of the actions
    :param high: Upper bound of the actions
    """

    def __init__(self, episode_length: int = 20, low: float = -1.0, high: float = 1.0):
        self.episode_length = episode_length
        self.action_space = spaces.Box(low, high, (2,), np.float32)
        self.observation_space = spaces.Box(-1, 1, (2,), np.float32)
        self.position = np.zeros(2)
        self.n_steps = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.position = self.np_random.uniform(-1, 1, 2)
        self.n_steps = 0
        return self.observe(first=True), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        assert self.action_space.contains(np.asarray(action, np.float32)), action
        low, high = self.action_space.low, self.action_space.high
        self.position = np.clip(self.position + 0.3 * (2 * (action - low) / (high - low) - 1), -1, 1)
        self.n_steps += 1
        reward = 1 - float(np.abs(self.position).max())
        return self.observe(), reward, False, self.n_steps >= self.episode_length, {}

    def observe(self, first: bool = False) -> np.ndarray:
        """Observe the position.

        :param first: Whether this is the first observation of an episode
        :return: The position, [2]
        """
        return self.position.astype(np.float32)

    def state_dict(self) -> dict[str, Any]:
        """Get all that the future depends on, for exact resume."""
        generator = self.np_random.bit_generator.state
        return {"position": self.position, "n_steps": self.n_steps, "generator": generator}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Load what ``state_dict`` has returned.

        :param state: Result of ``state_dict``
        """
        self.position, self.n_steps = np.array(state["position"]), state["n_steps"]
        self.np_random.bit_generator.state = state["generator"]


class Cliff(gym.Env):
    """A point on [-1, 1], moved by 0.3 x action, that falls off the left end: the only one here that terminates.

    Observations are (position, 1 at a reset, 1 after the fall): an observation after a fall is like no other, and no
    transition starts from it. Staying pays 1 per step. Episodes are truncated after 20 steps.
    """

    def __init__(self) -> None:
        self.action_space = spaces.Box(-1, 1, (1,), np.float32)
        self.observation_space = spaces.Box(-2, 2, (3,), np.float32)
        self.position = 0.0
        self.n_steps = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.position = float(self.np_random.uniform(-0.95, 0.05))
        self.n_steps = 0
        return np.array([self.position, 1, 0], np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.position = min(self.position + 0.3 * float(action[0]), 1.0)
        self.n_steps += 1
        fell = self.position < -1
        return np.array([self.position, 0, fell], np.float32), 1.0, fell, self.n_steps >= 20, {}


class PixelBox(VectorBox):
    """``VectorBox`` seen as the newest ``frame_stack`` frames: uint8 (3 * frame_stack, size, size), oldest first.

    The dot is a white square on a coloured gradient; the first frame is repeated at reset. As the package's own
    environments, it has ``frame_stack`` (unless ``tells_frame_stack=False``) and ``action_repeat``.

    :param frame_stack: Frames per observation
    :param size: Height and width, pixels
    :param action_repeat: Value of the attribute (it changes nothing else)
    :param channels_last: Whether observations are (size, size, 3 * frame_stack) instead
    :param tells_frame_stack: Whether there is an attribute ``frame_stack``
    :param kwargs: Arguments of ``VectorBox``
    """

    def __init__(
        self,
        frame_stack: int = 2,
        size: int = 36,
        action_repeat: int = 4,
        channels_last: bool = False,
        tells_frame_stack: bool = True,
        **kwargs: Any,
    ):
        super().__init__(**kwargs)
        self.size = size
        self.action_repeat = action_repeat
        self.channels_last = channels_last
        if tells_frame_stack:
            self.frame_stack = frame_stack
        shape = (size, size, 3 * frame_stack) if channels_last else (3 * frame_stack, size, size)
        self.observation_space = spaces.Box(0, 255, shape, np.uint8)
        ramp = np.linspace(0, 120, size).astype(np.uint8)
        self.background = np.stack(np.broadcast_arrays(ramp[:, None], ramp[None, :], ramp[::-1, None]))
        self.frames = [self.background] * frame_stack

    def observe(self, first: bool = False) -> np.ndarray:
        side = self.size // 6
        row, column = np.rint((self.position + 1) / 2 * (self.size - side)).astype(int)
        frame = self.background.copy()
        frame[:, row : row + side, column : column + side] = 255
        self.frames = [frame] * len(self.frames) if first else [*self.frames[1:], frame]
        stacked = np.concatenate(self.frames)
        return stacked.transpose(1, 2, 0) if self.channels_last else stacked

    def state_dict(self) -> dict[str, Any]:
        return {**super().state_dict(), "frames": list(self.frames)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        super().load_state_dict(state)
        self.frames = list(state["frames"])


def tiny_model(policy: str, env: Any, algorithm: type[CuReSAC] = CuReSAC, **kwargs: Any) -> CuReSAC:
    """Make the smallest model that trains: on one thread, in fp32, 10 random agent steps, then an update per step.

    Networks are tiny unless ``policy_kwargs`` says otherwise.
    """
    policy_kwargs: dict[str, Any] = {"net_arch": [16]}
    if "features_extractor_class" not in kwargs.get("policy_kwargs", {}):
        sizes = {"MlpPolicy": {"features_dim": 8, "hidden_dim": 16}, "CnnPolicy": {"n_filters": 4, "n_layers": 2}}
        policy_kwargs["features_extractor_kwargs"] = sizes.get(policy, {})
    defaults: dict[str, Any] = dict(
        learning_starts=10, batch_size=8, buffer_size=500, warmup_updates=0, precision="fp32", seed=0, device="cpu"
    )
    defaults.update(kwargs)
    defaults["policy_kwargs"] = {**policy_kwargs, **kwargs.get("policy_kwargs", {})}
    return algorithm(policy, env, **defaults)


def samples_of(model: CuReSAC, batch_size: int) -> Samples:
    """Sample a model's replay buffer, as heads get it when measuring: the views are the centred ones.

    :param model: A model that has collected
    :param batch_size: How many
    """
    sampled = model.replay_buffer.sample(batch_size)
    return Samples(**sampled._asdict(), views=model.policy.augmentation.center(sampled.observations))


def gradients_of_an_update(model: CuReSAC, seed: int) -> dict[str, th.Tensor]:
    """Get the gradient of every part of the agent in one update from the model's state, as optimisers receive it.

    :param model: A model with curiosity="separate" and update="joint"
    :param seed: Seed of the batch and of the random numbers of the update
    :return: Flat gradients by part
    """
    policy = model.policy
    owners = {
        "encoder": policy.encoder,
        "srl": policy.srl,
        "actor": policy.actor,
        "critic": policy.critic,
        "curious actor": policy.curious.actor,
        "curious critic": policy.curious.critic,
    }
    found: dict[str, th.Tensor] = {}

    def keep(name: str, parameters: list[th.nn.Parameter], step: Any, *arguments: Any) -> Any:
        found[name] = th.cat([p.grad.flatten().clone() for p in parameters if p.grad is not None])
        return step(*arguments)

    optimizers = {name: owner.optimizer for name, owner in owners.items() if name != "encoder"}
    optimizers["encoder"] = policy.encoder_update.optimizers["joint"]
    for name, optimizer in optimizers.items():
        optimizer.step = functools.partial(keep, name, list(owners[name].parameters()), optimizer.step)
    th.manual_seed(seed)
    np.random.seed(seed)
    model._n_updates = 0
    model.train(1, 128)
    for optimizer in optimizers.values():
        del optimizer.step
    return found


def state_of(model: SAC) -> dict[str, Any]:
    """Copy all that learning changes: networks, optimisers, temperatures."""
    _, variables = model._get_torch_save_params()
    return copy.deepcopy({**model.get_parameters(), **{name: recursive_getattr(model, name) for name in variables}})


def differences(first: Any, second: Any, path: str = "") -> list[str]:
    """Find where two nested states are not equal bit for bit (NaNs differ, as nothing here may be NaN).

    :param first: Nested dictionaries and sequences of tensors, arrays and plain values
    :param second: Another one
    :param path: Prefix of the names
    :return: Names of the leaves that differ
    """
    if isinstance(first, dict) and isinstance(second, dict):
        different = [f"{path}.{key} (only in one)" for key in first.keys() ^ second.keys()]
        return different + [
            d for key in first.keys() & second.keys() for d in differences(first[key], second[key], f"{path}.{key}")
        ]
    if isinstance(first, list | tuple) and isinstance(second, list | tuple):
        if len(first) != len(second):
            return [f"{path} (length)"]
        return [d for i, pair in enumerate(zip(first, second, strict=True)) for d in differences(*pair, f"{path}[{i}]")]
    if isinstance(first, th.Tensor) and isinstance(second, th.Tensor):
        return [] if first.dtype == second.dtype and th.equal(first, second) else [path]
    if isinstance(first, np.ndarray) and isinstance(second, np.ndarray):
        return [] if first.dtype == second.dtype and np.array_equal(first, second) else [path]
    if isinstance(first, np.random.Generator) and isinstance(second, np.random.Generator):
        return differences(first.bit_generator.state, second.bit_generator.state, path)
    return [] if first == second else [path]


class KillNow(BaseCallback):
    """Kills the worker of environment 1 at some steps."""

    def __init__(self, *at: int) -> None:
        super().__init__()
        self.at, self.faults = at, 0

    def _on_step(self) -> bool:
        self.faults += sum("env_fault" in info for info in self.locals["infos"])
        if self.n_calls in self.at:
            os.kill(self.training_env.unwrapped.processes[1].pid, signal.SIGKILL)
        return True


class Killed(Exception):
    """Stands in for a kill where the process is to live on: nothing is written after it."""


class KillAt(BaseCallback):
    """Raises after a number of agent steps."""

    def __init__(self, steps: int):
        super().__init__()
        self.left = steps

    def _on_step(self) -> bool:
        self.left -= self.training_env.num_envs
        if self.left <= 0:
            raise Killed
        return True

    def state_dict(self) -> dict[str, Any]:
        """Nothing."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Nothing."""
