"""Compare the plain SAC-AE update of ``benchmarks/sac_ae.py`` with that of the public implementation.

    git clone https://github.com/denisyarats/pytorch_sac_ae
    python -m benchmarks.public_sac_ae pytorch_sac_ae

First their losses, from the same weights, batches and noise; then their times, in small networks on small images and in
the paper's setting. Both get the same batches and take turns; with and without the allocator settings of
``sb3_cure.networks.allocator``, each in a process of its own, as they cannot be undone.
"""

import argparse
import importlib
import itertools
import json
import os
import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.type_aliases import ReplayBufferSamples

from benchmarks.harness import BATCH_SIZE, Times, describe_machine, interleaved, make_model, median_ratio, summary
from benchmarks.sac_ae import PlainSacAe
from benchmarks.settings import SETTINGS, Setting
from sb3_cure.evaluation.result_files import write_json
from sb3_cure.networks.layers import conv_sizes

#: Of a log of the public implementation and of ``PlainSacAe.losses``
LOSSES = {"train_critic/loss": "critic", "train_actor/loss": "actor", "train_ae/ae_loss": "decoder"}
PLAIN, PUBLIC = "benchmarks/sac_ae.py", "public implementation"
#: The published command line's arguments, with the CuRe paper's width of 1024
ARGUMENTS = dict(
    hidden_dim=1024,
    init_temperature=0.1,
    alpha_lr=1e-4,
    alpha_beta=0.5,
    critic_tau=0.01,
    encoder_tau=0.05,
    decoder_latent_lambda=1e-6,
    decoder_weight_lambda=1e-7,
    num_layers=4,
    num_filters=32,
)
#: What public code imports and does not use here, by module; NumPy has the windows of scikit-image, too
_STUBS: dict[str, dict[str, Any]] = {
    "gym": {"Wrapper": object, "spaces": SimpleNamespace(Box=None)},
    "hydra": {},
    "omegaconf": {"OmegaConf": None},
    "skimage.util.shape": {"view_as_windows": np.lib.stride_tricks.sliding_window_view},
}


class Log:
    """A logger that keeps the last value of each loss."""

    def __init__(self) -> None:
        self.losses: dict[str, float] = {}

    def log(self, key: str, value: Any, step: int) -> None:
        """Called by the public implementation."""
        if key in LOSSES:
            self.losses[LOSSES[key]] = float(value.detach())

    def __getattr__(self, name: str) -> Any:
        return lambda *arguments: None


class _Buffer:
    """Returns the same batches to both, in turn; observations are bytes, which either converts in its update."""

    def __init__(self, batches: list[ReplayBufferSamples]) -> None:
        self._batches: Iterator[ReplayBufferSamples] = itertools.cycle(batches)

    def next(self) -> ReplayBufferSamples:
        """Return the next batch.

        :return: A batch, as ``PlainSacAe`` takes it
        """
        return next(self._batches)

    def sample(self) -> tuple[th.Tensor, ...]:
        """Sample a batch.

        :return: A batch, as the public implementation's own buffer returns it
        """
        batch = self.next()
        images, next_images = batch.observations.float(), batch.next_observations.float()
        return images, batch.actions, batch.rewards, next_images, 1 - batch.dones


def import_public(checkout: Path, module: str) -> ModuleType:
    """Import a module of a public implementation.

    :param checkout: Folder that holds its files
    :param module: Name of one of them, without ending
    :return: The module
    """
    for name, content in _STUBS.items():
        try:
            importlib.import_module(name)
        except ImportError:
            stub = ModuleType(name)
            vars(stub).update(content)
            sys.modules[name] = stub
    if str(checkout.resolve()) not in sys.path:
        sys.path.insert(0, str(checkout.resolve()))
    return importlib.import_module(module)


def public_agent(checkout: Path, shape: tuple[int, ...], n_actions: int, **changes: Any) -> Any:
    """Make an agent of the public implementation.

    :param checkout: Folder that holds the public implementation's files
    :param shape: Of an observation, [C, H, W] with H = W
    :param n_actions: Size of an action
    :param changes: Other arguments than ``ARGUMENTS``
    :return: Its agent, on the CPU
    """
    arguments = {**ARGUMENTS, **changes}
    layers = arguments["num_layers"]
    # It knows the size of what its convolutions return for images of 84x84 only.
    import_public(checkout, "encoder").OUT_DIM[layers] = conv_sizes(shape[1], shape[2], layers)[-1][0]
    return import_public(checkout, "sac_ae").SacAeAgent(shape, (n_actions,), th.device("cpu"), **arguments)


def checkout_folder(text: str) -> Path:
    """Check the folder of the public implementation.

    :param text: From the command line
    :return: The folder of that name, which holds the public implementation
    :raises argparse.ArgumentTypeError: if it does not
    """
    if not (Path(text) / "sac_ae.py").is_file():
        reason = f"{text} holds no sac_ae.py: give the folder into which pytorch_sac_ae was cloned"
        raise argparse.ArgumentTypeError(reason)
    return Path(text)


def checkout_argument(parser: argparse.ArgumentParser) -> None:
    """Add the argument that names the public implementation's folder.

    :param parser: Gets the argument ``checkout``, which must hold the public implementation
    """
    parser.add_argument(
        "checkout", type=checkout_folder, help="folder that holds the public implementation's sac_ae.py"
    )


def _agents(checkout: Path, setting: Setting) -> tuple[Any, PlainSacAe, Any]:
    """A filled buffer, the plain update and the public one."""
    env = setting.env_kwargs
    plain = PlainSacAe(setting.channels, hidden=setting.hidden, size=setting.size, filters=setting.filters)
    shape, own = (setting.channels, setting.size, setting.size), dict(hidden_dim=setting.hidden)
    public = public_agent(checkout, shape, n_actions=1, num_filters=setting.filters, **own)
    return make_model(env_kwargs=env, n_steps=200).replay_buffer, plain, public


def compare_losses(checkout: Path, setting: Setting, updates: int = 10) -> float:
    """Compare the losses of both implementations on the same batch.

    :param checkout: Folder that holds the public implementation's files
    :param setting: Images and networks
    :param updates: How many
    :return: The largest relative difference of a loss in these updates, which start from the same weights and have the
        same batches and noise
    """
    replay_buffer, plain, public = _agents(checkout, setting)
    batches = [replay_buffer.sample(BATCH_SIZE) for _ in range(updates)]
    buffer, log = _Buffer(batches), Log()
    with th.no_grad():
        for name in ("actor", "critic", "critic_target", "decoder"):
            pairs = zip(getattr(plain, name).parameters(), getattr(public, name).parameters(), strict=True)
            for mine, theirs in pairs:
                mine.copy_(theirs)
    largest = 0.0
    for update, batch in enumerate(batches):
        th.manual_seed(update)
        public.update(buffer, log, update)
        th.manual_seed(update)
        plain.update(batch)
        differences = [abs(float(plain.losses[name]) / loss - 1) for name, loss in log.losses.items()]
        largest = max(largest, *differences)
    return largest


def measure(checkout: Path, setting: Setting, repeats: int, tuned: bool) -> Times:
    """Time updates of both implementations.

    :param checkout: Path of the public implementation's checkout
    :param setting: Images and networks
    :param repeats: Rounds
    :param tuned: Whether large blocks of memory are kept, as every model sees to
    :return: Seconds per update of each round, by implementation
    """
    if not tuned:
        # Models leave the allocator alone then; the C library has read its variables when the process began.
        os.environ["MALLOC_TRIM_THRESHOLD_"] = ""
    th.set_num_threads(setting.threads)
    replay_buffer, plain, public = _agents(checkout, setting)
    batches, log = [replay_buffer.sample(BATCH_SIZE) for _ in range(4)], Log()
    buffers = {name: _Buffer(batches) for name in (PLAIN, PUBLIC)}
    # Of two updates the first includes the actors.
    steps = itertools.count()
    variants = {
        PLAIN: lambda: plain.update(buffers[PLAIN].next()),
        PUBLIC: lambda: public.update(buffers[PUBLIC], log, next(steps)),
    }
    return interleaved(variants, repeats, calls=2)


def main() -> None:
    """Measure and print the difference of losses, times and ratios."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    checkout_argument(parser)
    parser.add_argument("--repeats", type=int, default=7, help="rounds (default: 7)")
    parser.add_argument("--out", type=Path, default=Path("results/benchmarks"), help="folder to write")
    options = parser.parse_args()
    found: dict[str, Any] = {}
    for setting in (SETTINGS[0], SETTINGS[-1]):
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as process:
            difference = process.submit(compare_losses, options.checkout, setting).result()
        row: dict[str, Any] = {"largest_relative_difference_of_losses": difference}
        for tuned in (False, True):
            with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as process:
                times = process.submit(measure, options.checkout, setting, options.repeats, tuned).result()
            name = "with sb3_cure.networks.allocator" if tuned else "with the C library's allocation"
            row[name] = {**{each: summary(seconds) for each, seconds in times.items()}}
            row[name]["plain / public"] = round(median_ratio(times, PLAIN, PUBLIC), 3)
        found[str(setting)] = row
        print(f"{setting}: {json.dumps(row, indent=2)}")
    options.out.mkdir(parents=True, exist_ok=True)
    write_json(options.out / "public_sac_ae.json", {"machine": describe_machine(), **found})


if __name__ == "__main__":
    main()
