"""Train CuReSAC on cartpole-swingup from pixels in ten minutes on two cores, and draw the results.

    python -m sb3_cure.experiments.demo --out demo

Writes ``agent.gif``, ``learning_curve.csv/png``, ``sees_and_holds.png``, ``curiosity_map.png``, ``errors.csv/png``,
``policies.mp4``, ``model.zip`` and ``summary.json`` into the folder. Settings are scaled down from the paper's (see
``SETTINGS``).
"""

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import LinearSchedule

from sb3_cure import CuReSAC, make_dmc_env, recipe
from sb3_cure.cli.zoo_files import zoo_entry, zoo_file
from sb3_cure.envs import physics_state_names, physics_state_units
from sb3_cure.evaluation import plots
from sb3_cure.evaluation.callbacks import ReconstructionCallback
from sb3_cure.evaluation.result_files import describe_run, write_csv, write_json
from sb3_cure.evaluation.rollouts import Episode, run_episodes, states_and_errors
from sb3_cure.evaluation.video import frame_rate, write_gif, write_video


@dataclass(frozen=True)
class LateFall:
    """Learning rate that is held for two thirds of training, then falls: otherwise the return jumps towards the end.

    :param rate: At first
    :param last: In the end
    """

    rate: float
    last: float

    def __call__(self, remaining: float) -> float:
        """Compute the rate.

        :param remaining: Progress that remains, from 1 to 0
        :return: Learning rate
        """
        return min(self.rate, 3 * self.rate * remaining + self.last)


DOMAIN, TASK = "cartpole", "swingup"
ID = f"dmc_pixels/{DOMAIN}-{TASK}-v0"
ENV_KWARGS: dict[str, Any] = zoo_entry(zoo_file("fast/best"), ID)["env_kwargs"]
#: The recipe, with a curious agent that costs little
SETTINGS: dict[str, Any] = recipe(
    "fast/best",
    ID,
    curiosity="separate",
    intrinsic="reconstruction",
    intrinsic_kwargs=dict(n_filters=8, n_layers=2),  # a fifth of an update less than with four layers
    curious_interval=4,  # the task's agent gets most of the time
    curiosity_encoder_grad=False,  # in so few updates the curious critic's gradient slows the task down
    # Whole curious episodes: with single curious steps in between, the task's agent hardly sees a pole that stays up.
    # Their share falls to 0 in the first half; after that, the task's agent collects everything.
    curiosity_prob=LinearSchedule(0.2, 0, 0.5),
    curiosity_bout="episode",
    learning_rate=LateFall(1e-3, 2e-5),
)
TOTAL_STEPS = 22_000
EVALUATIONS, ROWS = 8, 4
#: Episodes of each policy in the end, and the share of the time that is kept for them and for the pictures
EPISODES, MEASURING = 10, 0.12


class Progress(BaseCallback):
    """Evaluate the task policy now and then, print the progress, and end training and schedules after some minutes.

    :param eval_env: Environment to evaluate in
    :param steps: Agent steps in all
    :param seconds: Wall-clock seconds in all
    """

    def __init__(self, eval_env: Any, steps: int, seconds: float):
        super().__init__()
        self.eval_env, self.steps, self.seconds = eval_env, steps, seconds
        self.rows: list[dict[str, float]] = []
        self.repeat = eval_env.get_wrapper_attr("action_repeat")

    def _on_training_start(self) -> None:
        self.start = time.monotonic()

    def _on_step(self) -> bool:
        if self.num_timesteps % max(self.steps // EVALUATIONS, 1) == 0:
            self.evaluate()
        elapsed = time.monotonic() - self.start
        # Schedules end with the steps or with the time, whichever comes first.
        share = max(self.num_timesteps / self.steps, elapsed / self.seconds)
        self.model._total_timesteps = round(self.num_timesteps / share)
        return elapsed < self.seconds

    def evaluate(self) -> None:
        """Add a row to the learning curve, and print it."""
        returns = [episode.total_reward for episode in run_episodes(self.model, self.eval_env, 3, "task", seed=10_000)]
        steps, seconds = self.num_timesteps, round(time.monotonic() - self.start, 1)
        row = {"agent_steps": steps, "environment_steps": steps * self.repeat, "seconds": seconds}
        self.rows.append({**row, "task_return": float(np.mean(returns))})
        minutes = min(self.seconds - seconds, seconds * (self.steps / steps - 1)) / 60
        left = f"about {max(minutes, 0):.0f} minutes of training left"
        print(f"  step {steps:,} of {self.steps:,}, return {np.mean(returns):.0f} of 1000, {left}", flush=True)


def save(model: CuReSAC, out: Path) -> None:
    """Save the model, without its learning rate, as no archive holds a class of the demo.

    :param model: The model
    :param out: Folder to write ``model.zip`` into
    """
    model.save(out / "model.zip", exclude=["learning_rate"])


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the demo.

    :param arguments: Command line, ``sys.argv`` by default
    :return: 0, or 130 after Ctrl-C
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("demo"), help="folder to write (default: demo)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--minutes", type=float, default=10, help="everything takes about so long")
    parser.add_argument("--steps", type=int, default=TOTAL_STEPS, help="agent steps (environment steps / 8)")
    options = parser.parse_args(arguments)
    if options.minutes <= 0 or options.steps < 1:
        parser.error(f"--minutes is {options.minutes} and --steps {options.steps}, but both must be positive")
    out: Path = options.out
    out.mkdir(parents=True, exist_ok=True)

    env = make_dmc_env(DOMAIN, TASK, seed=options.seed, **ENV_KWARGS)
    eval_env = make_dmc_env(DOMAIN, TASK, render_mode="rgb_array", **ENV_KWARGS)
    model = CuReSAC("CnnPolicy", env, seed=options.seed, **SETTINGS)
    title = f"{DOMAIN}-{TASK} from pixels"
    print(f"{title}, seed {options.seed}: {options.steps:,} agent steps, at most {options.minutes:g} minutes")
    start = time.monotonic()
    progress = Progress(eval_env, options.steps, 60 * options.minutes * (1 - MEASURING))
    rows = ReconstructionCallback(out, max(options.steps // ROWS, 1), title=title)
    try:
        model.learn(options.steps, callback=[progress, rows])
    except KeyboardInterrupt:
        save(model, out)
        print(f"Stopped: {out / 'model.zip'} keeps the model of step {model.num_timesteps:,}; the demo begins anew.")
        return 130
    seconds = time.monotonic() - start
    if not progress.rows or progress.rows[-1]["agent_steps"] < model.num_timesteps:
        progress.evaluate()
    if not rows.rows or rows.rows[-1][0] < model.num_timesteps:
        rows.draw(model)
    save(model, out)
    (out / "reconstructions.png").replace(out / "sees_and_holds.png")

    print("\nMeasuring the random, task and curious policies")
    random, final = (_returns(model, eval_env, actor) for actor in ("random", "task"))
    write_csv(out / "learning_curve.csv", list(progress.rows[0]), progress.rows)
    _draw_returns(progress.rows, float(random.mean()), title, out)
    errors = _draw_curiosity(model, eval_env, out)
    _film(model, eval_env, out)
    steps = model.num_timesteps
    summary = {
        "task": f"{DOMAIN}-{TASK}",
        "seed": options.seed,
        "agent_steps": steps,
        "environment_steps": steps * progress.repeat,
        "updates": model._n_updates,
        "training_seconds": round(seconds),
        "all_seconds": round(time.monotonic() - start),
        "final_return_mean": round(float(final.mean()), 1),
        "final_return_std": round(float(final.std()), 1),
        "random_return_mean": round(float(random.mean()), 1),
        "ratio": round(float(final.mean() / random.mean()), 2),
        "errors": errors,
        "settings": SETTINGS,
        "environment": ENV_KWARGS,
        **describe_run(),
        "precision": model._computed_precision,
    }
    write_json(out / "summary.json", summary)
    print(f"Return after {steps:,} agent steps: {final.mean():.0f} of 1000 (random policy: {random.mean():.0f})")
    print("Reconstruction error by policy:", ", ".join(f"{actor} {error:.4f}" for actor, error in errors.items()))
    print(f"Pictures and video: {out}/ ({time.monotonic() - start:.0f} s in all)")
    if steps < options.steps:
        print(f"Time ended the training at step {steps:,} of {options.steps:,}; more --minutes give a better agent.")
    return 0


def _returns(model: CuReSAC, eval_env: Any, actor: str) -> np.ndarray:
    """Returns of a policy that acts alone."""
    return np.array([episode.total_reward for episode in run_episodes(model, eval_env, EPISODES, actor, seed=20_000)])


def _draw_returns(rows: list[dict[str, float]], random_return: float, title: str, out: Path) -> None:
    """Draw the learning curve, with a line for the random policy."""
    steps = np.array([row["environment_steps"] for row in rows])
    returns = np.array([[row["task_return"] for row in rows]])
    curves = {"task policy": (steps, returns), "random policy": (steps, np.full(returns.shape, random_return))}
    colors = {f"{actor} policy": color for actor, color in plots.COLORS.items()}
    label = "return of an episode\n(at most 1000)"
    plots.learning_curves(out / "learning_curve.png", {title: curves}, colors, label)


def _draw_curiosity(model: CuReSAC, eval_env: Any, out: Path) -> dict[str, float]:
    """Draw where policies go with sampled actions, and their errors there.

    :return: Mean error by policy
    """
    kept, bars = [], []
    visits: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    for actor in ("random", "task", "curious"):
        options: Any = dict(deterministic=False, seed=30_000, states=True)
        episodes = list(run_episodes(model, eval_env, EPISODES, actor, **options))
        means = np.array([episode.srl_errors.mean() for episode in episodes])
        visits[actor] = states_and_errors(episodes)
        bars.append(plots.Bar(actor, actor, means, f"{means.mean():.4f}"))
        for number, episode in enumerate(episodes):
            row = {"policy": actor, "episode": number, "return": episode.total_reward}
            kept.append({**row, "mean_error": means[number], "max_error": episode.srl_errors.max()})
    write_csv(out / "errors.csv", list(kept[0]), kept)
    label = "mean squared error of images drawn\nfrom the latents (more: less well known)"
    title = f"What the latents do not hold, where each policy goes\n(bars: means, dots: {EPISODES} episodes)"
    plots.actor_bars(out / "errors.png", {title: bars}, label)
    shown = {actor: visits[actor] for actor in ("random", "curious")}
    title = "Where curiosity goes, compared with chance (sampled actions)"
    units = physics_state_units(eval_env)
    plots.curiosity_map(out / "curiosity_map.png", shown, physics_state_names(eval_env), title, units=units)
    return {actor: round(float(errors.mean()), 5) for actor, (_, errors) in visits.items()}


def _film(model: CuReSAC, eval_env: Any, out: Path) -> None:
    """Film both policies with sampled actions, and the task policy by its mean."""

    def play(actor: str, deterministic: bool) -> Episode:
        return next(run_episodes(model, eval_env, 1, actor, deterministic=deterministic, seed=40_000, render=True))

    fps, repeat = frame_rate(eval_env), eval_env.get_wrapper_attr("action_repeat")
    films = {f"{actor} policy": play(actor, deterministic=False) for actor in ("task", "curious")}
    write_video(out / "policies.mp4", films, fps, repeat)
    write_gif(out / "agent.gif", play("task", deterministic=True), fps, channels=1)


if __name__ == "__main__":
    raise SystemExit(main())
