"""``sb3-cure doctor``: show this machine, the choices that follow from it, and what to install.

The exit status is 0 if training can work, else 1; things that are only slow are warnings. With ``--env`` it
instead shows how often random actions meet a reward there, which decides whether curiosity is worth its time.
"""

import argparse
import ast
import re
import time
from collections import Counter, defaultdict
from collections.abc import Sequence
from importlib import metadata
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit
from torch.utils import collect_env

from sb3_cure import __version__
from sb3_cure.cli.usage import UsageError, install_command, one_sentence
from sb3_cure.cli.zoo_files import check_environment
from sb3_cure.envs.dmc import DMCPixels
from sb3_cure.envs.render_check import find_gpus, is_software_renderer, judge_renderer, try_rendering
from sb3_cure.envs.spaces_check import check_action_space
from sb3_cure.networks.precision import resolve_precision

PACKAGE = "sb3-cure"
#: Observations for which precision="auto" is shown
IMAGES = spaces.Box(0, 255, (3, 84, 84), np.uint8)
#: Purpose of each extra; the other extras are for developing sb3_cure
EXTRAS = {
    "demo": "plots, videos, TensorBoard, progress bars",
    "zoo": "training and tuning from YAML files",
    "experiments": "grids of experiments and their report",
    "notebooks": "running the notebooks",
}
#: What to do, by the largest share of random episodes with a reward to which the advice applies
ADVICE = {
    0.05: (
        "Hardly any: exploration decides. Try curiosity in bouts (--conf-file fast/best_cure). On one such task it "
        "found rewards that a control did not, and began to learn."
    ),
    0.5: (
        "Some: try it with curiosity (fast/best_cure) and without (fast/best). On one such task curiosity met three "
        "times the rewards in training; returns were still zero."
    ),
    1.0: (
        "Most: begin without curiosity (fast/best), and try it (fast/best_cure) where learning stalls. On one such "
        "task it added more than a third to the mean return over training, in twice the time."
    ),
}
#: What to do where no two returns are equal
DENSE = (
    "The reward is dense, or a cost of actions hides a sparse one, which returns cannot tell. If it is dense, leave "
    "curiosity out (curiosity=None): on one such task it cost a fifth of the mean return, and its updates take longer."
)
#: Fewer random episodes say nothing
MIN_EPISODES = 10


def needed_packages() -> dict[str, list[str]]:
    """Names of the packages that sb3-cure needs.

    :return: Names by extra; by ``""`` those that every installation needs
    """
    needed = defaultdict(list)
    for line in (metadata.requires(PACKAGE) or []) if installed_version(PACKAGE) else []:  # else run from its sources
        name = re.match(r"[\w.-]+", line)
        extra = re.search(r"extra == ['\"]([\w-]+)['\"]", line)
        if name and name[0] != PACKAGE:
            needed[extra[1] if extra else ""].append(name[0])
    return needed


def installed_version(package: str) -> str | None:
    """Version of a package.

    :param package: Its name
    :return: The version, None if it is not installed
    """
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def check_packages(names: Sequence[str]) -> tuple[str, list[str]]:
    """Look up packages.

    :param names: Names of packages
    :return: The installed ones with their versions, in one line; and the names of the missing ones
    """
    versions = {name: installed_version(name) for name in names}
    line = ", ".join(f"{name} {version}" for name, version in versions.items() if version)
    return line, [name for name, version in versions.items() if version is None]


def play_randomly(env: gym.Env, episodes: int = 60, seconds: float = 60) -> np.ndarray:
    """Play episodes of random actions.

    :param env: An environment
    :param episodes: Episodes at most
    :param seconds: Seconds at most; an episode that they cut does not count
    :return: Return of each episode
    """
    env.action_space.seed(0)
    env.reset(seed=0)
    returns: list[float] = []
    total, end = 0.0, time.monotonic() + seconds
    while len(returns) < episodes and time.monotonic() < end:
        _, reward, terminated, truncated, _ = env.step(env.action_space.sample())
        total += float(reward)
        if terminated or truncated:
            returns.append(total)
            total = 0.0
            env.reset()
    return np.array(returns)


def count_rewarded(returns: np.ndarray) -> int | None:
    """Count the episodes that met a reward: more than what random actions commonly get.

    :param returns: Return of each episode
    :return: Episodes above the commonest return, or above 0 if that is positive; None if no two are equal
    """
    ((common, times),) = Counter(returns.tolist()).most_common(1)
    return int((returns > min(common, 0)).sum()) if times > 1 else None


def check_rewards(task: str, env_kwargs: dict[str, Any]) -> int:
    """Show how often random actions meet a reward, and what that says of curiosity.

    :param task: Gymnasium id
    :param env_kwargs: Arguments of ``gym.make``
    :return: Exit status 0
    :raises UsageError: if the environment takes other arguments, or too few episodes end within a minute
    """
    check_environment(task)
    print(f"{task}: episodes of random actions, for at most a minute", flush=True)
    try:
        env = gym.make(task, **env_kwargs)
        check_action_space(env.action_space)
    except TypeError as error:
        raise UsageError(f"{task} wants other --env-kwargs: {one_sentence(error)}") from error
    except (ValueError, gym.error.Error) as error:
        raise UsageError(f"{task} cannot be trained: {one_sentence(error)}") from error
    returns = play_randomly(_below_camera(env) if task.startswith("dmc_pixels/") else env)
    env.close()
    if len(returns) < MIN_EPISODES:
        raise UsageError(
            f"{len(returns)} episodes of {task} ended within a minute, too few to say: shorten them, as in "
            "--env-kwargs max_episode_steps:50"
        )
    met, ends = count_rewarded(returns), f"returns {returns.min():.4g} to {returns.max():.4g}"
    if met is None:
        print(f"No two of {len(returns)} episodes have the same return; {ends}.\n{DENSE}")
    else:
        print(f"A reward was met in {met} of {len(returns)} episodes; {ends}.")
        print(next(advice for share, advice in ADVICE.items() if met <= share * len(returns)))
    print("What is known of each case: docs/guide/mixing.md, 'Should I switch curiosity on?'")
    return 0


def _below_camera(env: gym.Env) -> gym.Env:
    """Unwrap a ``dmc_pixels`` task to what is below its camera, so that nothing is rendered; keep its step limit.

    Ids of users may have wrappers above the camera that change rewards, actions or ends.
    """
    camera: Any = env
    while not isinstance(camera, DMCPixels):
        camera = camera.env
    limit = env.spec.max_episode_steps if env.spec else None
    return camera.env if limit is None else TimeLimit(camera.env, limit)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command ``sb3-cure doctor``.

    :param argv: Command line, ``sys.argv[1:]`` by default
    :return: 0 if training can work, else 1
    """
    parser = argparse.ArgumentParser("sb3-cure doctor", description=__doc__)
    parser.add_argument("--env", metavar="ID", help="show how often random actions meet a reward in this environment")
    parser.add_argument("--env-kwargs", nargs="+", default=[], metavar="KEY:VALUE", help="arguments of the environment")
    options = parser.parse_args(argv)
    if options.env is None and not options.env_kwargs:
        return check_machine()
    if options.env is None or not all(":" in pair for pair in options.env_kwargs):
        parser.error("--env-kwargs takes KEY:VALUE of the environment that --env names")
    return check_rewards(options.env, dict(map(_parse_pair, options.env_kwargs)))


def _parse_pair(text: str) -> tuple[str, Any]:
    """Read KEY:VALUE, where the value is Python's, or else text."""
    key, _, value = text.partition(":")
    try:
        return key, ast.literal_eval(value)
    except (SyntaxError, ValueError):
        return key, value


def check_machine() -> int:
    """Show what this machine has, and what is missing.

    :return: 0 if training can work, else 1
    """
    errors, warnings = [], []
    print(collect_env.get_pretty_env_info())

    needed = needed_packages()
    line, missing = check_packages(needed[""])
    print(f"\n{PACKAGE} {__version__} with {line}")
    if missing:
        errors.append(f"missing: {', '.join(missing)}; pip install {' '.join(missing)}")
    for extra, purpose in EXTRAS.items():
        line, missing = check_packages(needed[extra])
        install = f"; missing: {', '.join(missing)} ({install_command(extra)})" if missing else ""
        print(f"{extra} ({purpose}): {line}{install}")

    device = th.device("cuda" if th.cuda.is_available() else "cpu")
    gpus = find_gpus()
    print(f"\nGPUs: {', '.join(gpus) or 'none'}; torch computes on {device} with {th.get_num_threads()} threads")
    print(f'precision="auto": {resolve_precision("auto", device, IMAGES)}')
    if device.type == "cpu" and any(gpu.startswith("NVIDIA") for gpu in gpus):
        warnings.append("torch cannot use the GPU: install its CUDA build, see https://pytorch.org/get-started")

    rendering = try_rendering()
    if "error" in rendering:
        errors.append(rendering["error"])
    else:
        name = rendering["renderer"]
        print(f"OpenGL: {name}, on the {'CPU' if is_software_renderer(name) else 'GPU'}", end="")
        print(f" (MUJOCO_GL={rendering['backend']})")
        print(f'Milliseconds per frame of 84 x 84: {rendering["dmc"]:.1f} (renderer="dmc"), ', end="")
        print(f'{rendering["fast"]:.1f} (renderer="fast")')
        if warning := judge_renderer(name, gpus):
            warnings.append(warning)

    print("", *(f"ERROR    {error}" for error in errors), *(f"WARNING  {warning}" for warning in warnings), sep="\n")
    print("Training cannot work here yet." if errors else "Training can work here.")
    return 1 if errors else 0
