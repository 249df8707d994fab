"""Train the public code of DrQ-v2 and of CURL on environments of ours, for ``time_to_return.py``.

    git clone https://github.com/facebookresearch/drqv2 && git -C drqv2 checkout c0c650b76c6e
    git clone https://github.com/MishaLaskin/curl && git -C curl checkout 8416d6e3869e

Nothing else is to be installed: what their files import and do not use here is replaced by empty modules. Agents,
augmentations and replay buffers are theirs; the loops follow their ``train.py``, without logs and videos. They expect
images of 84 pixels, so three things are changed in memory, in all settings alike: the size of what the convolutions
return, DrQ-v2's shifts (up to 4 of 84 pixels) and CURL's crops (84 of 100 pixels).
"""

import argparse
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch as th
from dm_env import StepType, specs
from torch import nn

from benchmarks.public_returns import PublicTraining
from benchmarks.public_sac_ae import import_public
from sb3_cure.evaluation.result_files import checkout_commit
from sb3_cure.experiments.grid import Cell, short_name
from sb3_cure.networks.layers import conv_sizes


@dataclass(frozen=True)
class Peer:
    """Public code at one commit: what is changed in memory fits no other.

    :param source: Its repository
    :param commit: First 12 digits of the commit
    :param trials: Settings to choose from, with our sizes of networks, by name
    :param own: Its own settings
    """

    source: str
    commit: str
    trials: dict[str, dict[str, Any]]
    own: dict[str, Any]

    def folder(self, text: str) -> Path:
        """Check the folder of a clone.

        :param text: From the command line
        :return: The folder of that name
        :raises argparse.ArgumentTypeError: if it does not hold this commit, unchanged
        """
        if (found := checkout_commit(Path(text))) != self.commit:
            reason = f"{text} is at commit {found}, not {self.commit}: clone {self.source} and check that commit out"
            raise argparse.ArgumentTypeError(reason)
        return Path(text)


def _drqv2(lr: float, noise: dict[str, Any], sizes: tuple[int, int], warmup: int) -> dict[str, Any]:
    """Settings of DrQ-v2 (``cfgs/config.yaml``)."""
    agent: dict[str, Any] = dict(
        lr=lr, feature_dim=50, hidden_dim=sizes[1], critic_target_tau=0.01, num_expl_steps=warmup
    )
    agent |= dict(update_every_steps=2, stddev_schedule="1.0", stddev_clip=0.3, use_tb=False)
    loader = dict(buffer_size=1_000_000, batch_size=256, num_workers=0, save_snapshot=False, nstep=3, discount=0.99)
    return {"agent": agent, "n_filters": sizes[0], "learning_starts": warmup, "loader": loader, **noise}


def _curl(lr: float, target_interval: int, sizes: tuple[int, int], warmup: int) -> dict[str, Any]:
    """Settings of CURL (``scripts/run.sh`` and the defaults of ``train.py``)."""
    agent: dict[str, Any] = dict(
        hidden_dim=sizes[1], num_filters=sizes[0], num_layers=4, discount=0.99, init_temperature=0.1
    )
    agent |= dict(critic_lr=lr, actor_lr=lr, encoder_lr=lr, alpha_lr=1e-4, alpha_beta=0.5)
    agent |= dict(critic_tau=0.01, encoder_tau=0.05, critic_target_update_freq=target_interval)
    return {"agent": agent, "learning_starts": warmup, "batch_size": 128, "buffer_size": 100_000}


#: Filters and hidden units of the fast profile, and of the peers
_OURS, _THEIRS = (16, 256), (32, 1024)
#: DrQ-v2's noise falls from 1 to 0.1 over this share of training on its easy and on its medium tasks
_NOISE = {"easy": 1e5 / 5.5e5, "medium": 5e5 / 15.5e5}
#: The same in agent steps, by task
_OWN_NOISE = {"cartpole-swingup": 100_000, "finger-spin": 100_000, "reacher-easy": 500_000}

PEERS = {
    "drqv2": Peer(
        "https://github.com/facebookresearch/drqv2",
        "c0c650b76c6e",
        {
            f"{lr}_{name}": _drqv2(float(lr), {"noise_share": share}, _OURS, 500)
            for lr in ("1e-4", "3e-4", "1e-3")
            for name, share in _NOISE.items()
        },
        _drqv2(1e-4, {"noise_steps": _OWN_NOISE}, _THEIRS, 2000),
    ),
    "public_curl": Peer(
        "https://github.com/MishaLaskin/curl",
        "8416d6e3869e",
        # Its code suggests to update targets in every step.
        {
            f"{lr}_{name}": _curl(float(lr), interval, _OURS, 500)
            for lr in ("1e-3", "2e-3")
            for name, interval in {"slow": 2, "quick": 1}.items()
        },
        _curl(1e-3, 2, _THEIRS, 1000),
    ),
}


def peer_of(arm: str) -> str | None:
    """Name the peer that an arm belongs to, if any."""
    return next((name for name in PEERS if arm == name or arm.startswith(f"{name}_")), None)


def trial_arms(peer: str) -> list[str]:
    """Name the arms that are a peer's trials."""
    return [f"{peer}_{trial}" for trial in PEERS[peer].trials]


def is_trial(arm: str) -> bool:
    """Whether an arm is one of a peer's trials."""
    return any(arm in trial_arms(peer) for peer in PEERS)


class CurlTraining(PublicTraining):
    """CURL's loop: SAC-AE's, on images that are cropped, without a burst of updates.

    :param checkout: Folder that holds its files
    :param cell: What to run
    """

    def _set_up(self, checkout: Path, utils: Any, shape: tuple[int, ...], action_shape: tuple[int, ...]) -> None:
        size = self.settings["image_size"]
        import_public(checkout, "encoder").OUT_DIM[4] = conv_sizes(size, size, 4)[-1][0]
        make_agent = import_public(checkout, "curl_sac").CurlSacAgent
        self.agent = make_agent((shape[0], size, size), action_shape, th.device("cpu"), **self.settings["agent"])
        sizes = self.settings["buffer_size"], self.settings["batch_size"]
        self.buffer = utils.ReplayBuffer(shape, action_shape, *sizes, th.device("cpu"), size)
        self.utils, self.first_updates = utils, 1

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Act deterministically on the middle of an image.

        :param observation: Observation of the environment
        :return: Action
        """
        return self.agent.select_action(self.utils.center_crop_image(observation, self.settings["image_size"]))


class DrQv2Training(PublicTraining):
    """DrQ-v2's loop. Its data loader samples in this process: all arms have one core.

    :param checkout: Folder that holds its files
    :param cell: What to run
    :param progress: From agent steps to the share of the budget that is used up
    """

    def __init__(self, checkout: Path, cell: Cell, progress: Callable[[int], float]):
        self.progress = progress
        super().__init__(checkout, cell)

    def _set_up(self, checkout: Path, utils: Any, shape: tuple[int, ...], action_shape: tuple[int, ...]) -> None:
        public: Any = import_public(checkout, "drqv2")
        replay = import_public(checkout, "replay_buffer")
        public.Encoder = resized(public.Encoder, self.settings["n_filters"], utils.weight_init)
        self.agent = public.DrQV2Agent(shape, action_shape, th.device("cpu"), **self.settings["agent"])
        self.agent.aug.pad = round(self.agent.aug.pad * shape[1] / 84)
        self.utils, self.time_step = utils, import_public(checkout, "dmc").ExtendedTimeStep
        self.folder, self.no_action = TemporaryDirectory(), np.zeros(action_shape, np.float32)
        fields = (
            specs.Array(shape, np.uint8, "observation"),
            specs.Array(action_shape, np.float32, "action"),
            specs.Array((1,), np.float32, "reward"),
            specs.Array((1,), np.float32, "discount"),
        )
        self.storage = replay.ReplayBufferStorage(fields, Path(self.folder.name))
        loader = dict(self.settings["loader"])
        self.batches = iter(replay.make_replay_loader(Path(self.folder.name), loader.pop("buffer_size"), **loader))

    def act(self, observation: np.ndarray, step: int = 0, eval_mode: bool = True) -> np.ndarray:
        """Act, by default deterministically.

        :param observation: Observation of the environment
        :param step: Agent steps so far
        :param eval_mode: Whether to act without noise
        :return: Action
        """
        with th.no_grad(), self.utils.eval_mode(self.agent):
            return self.agent.act(observation, step, eval_mode=eval_mode)

    def steps(self) -> Iterator[int]:
        """Train step by step.

        :return: Agent steps so far, before each step and after the last: between two of them one is made
        """
        warmup, total = self.settings["learning_starts"], -(-self.cell.budget // self.action_repeat)
        observation = self._begin_episode(self.cell.seed)
        for step in range(total):
            yield step
            self._set_noise(step)
            action = self.act(observation, step, eval_mode=False)
            if step >= warmup:
                self.agent.update(self.batches, step)
            observation, reward, terminated, truncated, _ = self.env.step(action)
            kind = StepType.LAST if terminated or truncated else StepType.MID
            self.storage.add(self.time_step(kind, float(reward), 1.0 - terminated, observation, action))
            if terminated or truncated:
                observation = self._begin_episode(None)
        yield total

    def _begin_episode(self, seed: int | None) -> np.ndarray:
        observation, _ = self.env.reset(seed=seed)
        self.storage.add(self.time_step(StepType.FIRST, 0.0, 1.0, observation, self.no_action))
        return observation

    def _set_noise(self, step: int) -> None:
        if "noise_share" in self.settings:
            self.agent.stddev_schedule = 1 - 0.9 * min(self.progress(step) / self.settings["noise_share"], 1)
        else:
            steps = self.settings["noise_steps"][short_name(self.cell.task)]
            self.agent.stddev_schedule = f"linear(1.0,0.1,{steps})"


def resized(encoder: Any, filters: int, weight_init: Callable[[nn.Module], None]) -> type[nn.Module]:
    """Change the sizes of DrQ-v2's encoder, which is written for 32 filters and images of 84 pixels.

    :param encoder: Its class
    :param filters: Channels of the convolutions
    :param weight_init: Its function that initialises a layer
    :return: Class with the same layers
    """

    class Encoder(encoder):
        convnet: nn.Sequential

        def __init__(self, obs_shape: tuple[int, ...]):
            super().__init__(obs_shape)
            layers, channels = list[nn.Module](), obs_shape[0]
            for layer in self.convnet.children():
                if isinstance(layer, nn.Conv2d):
                    layer = nn.Conv2d(channels, filters, layer.kernel_size, layer.stride)  # type: ignore[arg-type]
                    channels = filters
                layers.append(layer)
            self.convnet = nn.Sequential(*layers)
            self.repr_dim = self.convnet(th.zeros(1, *obs_shape)).numel()
            self.apply(weight_init)

    return Encoder
