"""``enjoy`` and ``record``: watch a trained agent.

rl-zoo3's own programs to replay a run read its settings with a YAML loader that runs code, and allocate the whole
replay buffer. These do neither.
"""

import argparse
import contextlib
from collections import OrderedDict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from rl_zoo3 import create_test_env
from rl_zoo3.utils import EnvironmentName, StoreDict, get_model_path, get_wrapper_class
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecVideoRecorder

from sb3_cure.cli.report_ends import ReportEnds
from sb3_cure.cli.usage import UsageError, nearest, one_sentence, parse, refusals_in_one_sentence
from sb3_cure.cli.zoo_files import (
    ALGORITHMS,
    CLASS_ARGUMENTS,
    DEFAULT_ALGORITHM,
    check_environment,
    find_class,
    import_module,
)
from sb3_cure.envs import make_dmc_env
from sb3_cure.envs.rendering import is_headless

#: Settings of a run that make a replay import and call code, or unpickle files
TRUSTED_SETTINGS = ("env_wrapper", "vec_env_wrapper", "normalize")


class RunLoader(yaml.SafeLoader):
    """SafeLoader for the settings of a run, with tuples, ordered dictionaries, and names of classes as text."""


RunLoader.add_constructor(
    "tag:yaml.org,2002:python/object/apply:collections.OrderedDict",
    lambda loader, node: OrderedDict(*loader.construct_sequence(node, deep=True)),
)
RunLoader.add_constructor(
    "tag:yaml.org,2002:python/tuple", lambda loader, node: tuple(loader.construct_sequence(node, deep=True))
)
RunLoader.add_multi_constructor("tag:yaml.org,2002:python/name:", lambda loader, name, node: name)


def enjoy(arguments: Sequence[str]) -> None:
    """Watch a trained agent.

    :param arguments: Command line, see ``sb3-cure enjoy --help``
    """
    parser = _parser("enjoy", "Watch a trained agent, and print the returns of its episodes.")
    parser.add_argument("--no-render", action="store_true", help="Open no window, only print the returns")
    args = _parse_all(parser, arguments)
    if is_headless() and not args.no_render:
        print("There is no display to show the agent on (as with --no-render); `record` writes a video.")
        args.no_render = True
    model, env, _ = _load(args, None if args.no_render else "human")
    episodes = _play(model, env, args)
    env.close()
    print(f"{len(episodes)} Episodes")
    for name, key in (("reward", "r"), ("episode length", "l")) if episodes else ():
        values = [episode[key] for episode in episodes]
        print(f"Mean {name}: {np.mean(values):.2f} +/- {np.std(values):.2f}")


def record(arguments: Sequence[str]) -> None:
    """Write a video of a trained agent.

    :param arguments: Command line, see ``sb3-cure record --help``
    """
    parser = _parser("record", "Write a video of a trained agent.")
    parser.add_argument("-o", "--output-folder", type=Path, help="Default: videos, in the run's folder")
    args = _parse_all(parser, arguments)
    model, env, path = _load(args, "rgb_array")
    folder = args.output_folder or path.parent / "videos"
    recorder = VecVideoRecorder(env, str(folder), lambda step: step == 0, args.n_timesteps, name_prefix=path.stem)
    _play(model, recorder, args)
    recorder.close()


def _parser(program: str, description: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(f"sb3-cure {program}", description=description)
    parser.add_argument("--env", required=True, help="Gymnasium's id of the environment, or my_module:My-v0")
    parser.add_argument("--algo", default=DEFAULT_ALGORITHM, choices=ALGORITHMS, help="Default: %(default)s")
    parser.add_argument("-f", "--folder", default="logs", help="Where it was trained into (default: %(default)s)")
    parser.add_argument("--exp-id", type=int, default=0, help="Number of the run (default: the latest with a model)")
    which = parser.add_mutually_exclusive_group()
    which.add_argument("--load-best", action="store_true", help="The model with the best evaluation")
    which.add_argument("--load-checkpoint", metavar="STEPS", help="The checkpoint of this number of agent steps")
    which.add_argument("--load-last-checkpoint", action="store_true", help="The checkpoint that was written last")
    parser.add_argument("-n", "--n-timesteps", type=int, default=1000, help="Agent steps (default: %(default)s)")
    parser.add_argument("--stochastic", action="store_true", help="Sample actions instead of taking the mean")
    parser.add_argument("--seed", type=int, default=0, help="Default: %(default)s")
    parser.add_argument("--device", default="auto", help="PyTorch device (default: %(default)s)")
    parser.add_argument("--env-kwargs", nargs="+", action=StoreDict, metavar="NAME:VALUE", help="As for train")
    parser.add_argument("--gym-packages", nargs="+", default=[], help="Modules that register environments")
    for name in CLASS_ARGUMENTS:
        parser.add_argument(f"--{name}", metavar="MODULE.CLASS", help="Class of your own, which no saved model holds")
    parser.add_argument(
        "--trusted", action="store_true", help="Also import, call and unpickle what the run's folder names"
    )
    return parser


def _parse_all(parser: argparse.ArgumentParser, arguments: Sequence[str]) -> argparse.Namespace:
    args, unknown = parse(parser, arguments)
    if unknown:
        known = [flag for action in parser._actions for flag in action.option_strings]
        raise UsageError(f"there is no {unknown[0]!r}{nearest(unknown[0], known)}")
    return args


def _load(args: argparse.Namespace, render_mode: str | None) -> tuple[OffPolicyAlgorithm, VecEnv, Path]:
    """Load a run's model without a replay buffer, and return it with its environment and its path."""
    for package in args.gym_packages:
        import_module(package)
    check_environment(args.env)
    task = args.env.rpartition(":")[2]
    name = EnvironmentName(task)
    flags = args.load_best, args.load_checkpoint, args.load_last_checkpoint
    try:
        _, found, _ = get_model_path(args.exp_id or _latest_run(args, name), args.folder, args.algo, name, *flags)
    except (AssertionError, ValueError) as error:
        runs = {path.parent.name for path in Path(args.folder, args.algo).glob("*/*.zip")}
        models = f"; there are models in {', '.join(sorted(runs))}" if runs else ""
        raise UsageError(f"{one_sentence(error).rstrip('.')}{models}.") from None
    path = Path(found)
    print(f"Loading {path}")
    folder = path.parent / name
    settings, arguments = _read_settings(folder / "config.yml"), _read_settings(folder / "args.yml")
    if not args.trusted and (named := [name for name in TRUSTED_SETTINGS if settings.get(name)]):
        raise UsageError(
            f"{folder / 'config.yml'} has {' and '.join(named)}, which can run any code: if you know where it comes "
            "from, add --trusted."
        )
    if own := [name for name in CLASS_ARGUMENTS if "." in str(settings.get(name)) and not vars(args)[name]]:
        raise UsageError(
            f"{folder / 'config.yml'} names code of your own, which no saved model holds: add "
            f"{' '.join(f'--{name} {settings[name]}' for name in own)}"
        )
    env_kwargs = {**(arguments.get("env_kwargs") or settings.get("env_kwargs") or {}), **(args.env_kwargs or {})}
    if render_mode == "rgb_array" or (render_mode and "render_mode" not in env_kwargs):
        env_kwargs["render_mode"] = render_mode
    settings.setdefault("normalize", False)
    settings["normalize_kwargs"] = settings["normalize"]
    if wrap := get_wrapper_class(settings):
        settings["env_wrapper"] = {ReportEnds: {"wrap": wrap}}
    objects: dict[str, Any] = {name: find_class(vars(args)[name]) for name in CLASS_ARGUMENTS if vars(args)[name]}
    objects |= {"replay_buffer_class": _NoReplayBuffer, "n_steps": 1, "optimize_memory_usage": False}
    load: Any = ALGORITHMS[args.algo].load
    with refusals_in_one_sentence(make_dmc_env):
        env = create_test_env(
            task, stats_path=str(folder), should_render=False, hyperparams=settings, env_kwargs=env_kwargs
        )
        model = load(path, env, args.device, objects, seed=args.seed, trusted=args.trusted)
    return model, model.get_env(), path


class _NoReplayBuffer(ReplayBuffer):
    """Stand-in for the run's replay buffer: nothing is stored, and the archive may not hold the buffer's class."""

    def __init__(self, *args: Any, **kwargs: Any):
        """Allocate nothing."""


def _latest_run(args: argparse.Namespace, name: str) -> int:
    """Number of the latest run that holds a model, as a training that fails leaves a folder, too; 0 if none does."""
    models = Path(args.folder, args.algo).glob(f"{name}_*/*.zip")
    numbers = [path.parent.name.removeprefix(f"{name}_") for path in models]
    return max((int(number) for number in numbers if number.isdecimal()), default=0)


def _read_settings(path: Path) -> dict[str, Any]:
    return yaml.load(path.read_text(), Loader=RunLoader) if path.is_file() else {}


def _play(model: OffPolicyAlgorithm, env: VecEnv, args: argparse.Namespace) -> list[dict[str, float]]:
    """Play, and return Monitor's summaries of the finished episodes."""
    episodes = []
    observations = env.reset()
    with contextlib.suppress(KeyboardInterrupt):
        for _ in range(args.n_timesteps):
            actions, _ = model.predict(observations, deterministic=not args.stochastic)  # type: ignore[arg-type]
            observations, _, _, infos = env.step(actions)
            for episode in (info["episode"] for info in infos if "episode" in info):
                print(f"Episode Reward: {episode['r']:.2f}, Episode Length: {episode['l']}")
                episodes.append(episode)
    return episodes
