"""Train CuReSAC on cartpole-swingup from pixels in ten minutes on two cores, and draw what it learned.

    python -m sb3_cure.experiments.demo --out demo

Writes ``learning_curve.csv/png``, ``reconstructions.png``, ``srl_error.csv/png``, ``policy.mp4``, ``model.zip`` and
``summary.json`` into the folder. Settings are scaled down from the paper's (see ``SETTINGS``) to fit ten minutes.
"""

import argparse
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

from sb3_cure import CuReSAC, make_dmc_env
from sb3_cure.allocator import tune_allocator
from sb3_cure.callbacks import EvalBothCallback
from sb3_cure.evaluation import even_negatives, run_episodes
from sb3_cure.experiments import plots
from sb3_cure.experiments.files import describe_run, write_csv
from sb3_cure.experiments.probe import reconstruct_with_probe
from sb3_cure.experiments.video import write_video

DOMAIN, TASK = "cartpole", "swingup"
# The camera that follows the cart: the usual one is far away, and the cart drives out of its view.
ENV_KWARGS: dict[str, Any] = dict(image_size=36, grayscale=True, camera_id=1, renderer="fast")
# Smaller images and networks than the paper's, and quicker targets, because ten minutes on two cores allow a fraction
# of the paper's updates.
SETTINGS: dict[str, Any] = dict(
    srl="curl",
    srl_kwargs=dict(augmentation="shift", pad=2),
    learning_starts=500,
    warmup_updates=300,
    gamma=0.98,
    tau=0.02,
    target_update_interval=1,
    policy_kwargs=dict(net_arch=[256, 256], features_extractor_kwargs=dict(n_filters=16)),
)
TOTAL_STEPS = 12_000
EVALUATIONS = 12


class TimeLimit(BaseCallback):
    """Ends training after some minutes.

    :param minutes: Wall-clock minutes
    """

    def __init__(self, minutes: float):
        super().__init__()
        self.seconds = 60 * minutes

    def _on_training_start(self) -> None:
        self.deadline = time.monotonic() + self.seconds

    def _on_step(self) -> bool:
        return time.monotonic() < self.deadline


class RecordCurve(EvalBothCallback):
    """Evaluates both policies and keeps the rows of the learning curve."""

    def __init__(self, *args: Any, action_repeat: int, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.action_repeat = action_repeat
        self.rows: list[dict[str, float]] = []
        self.start = time.monotonic()

    def evaluate(self) -> dict[str, float]:
        row = super().evaluate()
        self.rows.append(
            {
                "agent_steps": self.num_timesteps,
                "environment_steps": self.num_timesteps * self.action_repeat,
                "seconds": round(time.monotonic() - self.start, 1),
                "task_return": row["eval/task_reward"],
                "curious_return": row["eval/curious_reward"],
                "task_srl_error": row["eval/task_srl_error"],
                "curious_srl_error": row["eval/curious_srl_error"],
            }
        )
        return row


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the demo.

    :param arguments: Command line, ``sys.argv`` by default
    :return: 0 if the final return is at least three times the random policy's, else 1
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("demo"), help="folder to write (default: demo)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--minutes", type=float, default=10, help="training ends after so many minutes")
    parser.add_argument("--steps", type=int, default=TOTAL_STEPS, help="agent steps (environment steps / 8)")
    options = parser.parse_args(arguments)
    if options.minutes <= 0 or options.steps < 1:
        parser.error(f"--minutes is {options.minutes} and --steps {options.steps}, but both must be positive")
    options.out.mkdir(parents=True, exist_ok=True)
    tune_allocator()

    env = make_dmc_env(DOMAIN, TASK, seed=options.seed, **ENV_KWARGS)
    eval_env = make_dmc_env(DOMAIN, TASK, render_mode="rgb_array", **ENV_KWARGS)
    action_repeat = env.get_wrapper_attr("action_repeat")
    model = CuReSAC("CnnPolicy", env, seed=options.seed, **SETTINGS)
    curve = RecordCurve(
        eval_env, max(options.steps // EVALUATIONS, 1), n_episodes=3, seed=10_000, action_repeat=action_repeat
    )
    print(
        f"Training CuReSAC on {DOMAIN}-{TASK} from {ENV_KWARGS['image_size']} px images, at most {options.minutes:g} "
        f"minutes and {options.steps} agent steps = {options.steps * action_repeat} environment steps"
    )
    start = time.monotonic()
    model.learn(options.steps, callback=[curve, TimeLimit(options.minutes)], progress_bar=True)
    seconds = time.monotonic() - start
    if not curve.rows or curve.rows[-1]["agent_steps"] < model.num_timesteps:
        curve.evaluate()

    print("Measuring the random, task and curious policies")
    even_negatives(model, eval_env, seed=15_000)
    errors, returns = {}, {}
    for actor in ("random", "task", "curious"):
        episodes = list(run_episodes(model, eval_env, 10, actor, seed=20_000))
        errors[actor] = np.concatenate([episode.srl_errors for episode in episodes])
        returns[actor] = [episode.total_reward for episode in episodes]
    random_return, final_return = float(np.mean(returns["random"])), float(np.mean(returns["task"]))

    title = f"{DOMAIN}-{TASK} from pixels, CuReSAC ({SETTINGS['srl']}), seed {options.seed}"
    write_csv(options.out / "learning_curve.csv", list(curve.rows[0]), curve.rows)
    plots.learning_curve(options.out / "learning_curve.png", curve.rows, random_return, title)
    table = [
        {
            "policy": actor,
            "min": errors[actor].min(),
            "mean": errors[actor].mean(),
            "max": errors[actor].max(),
            "return_mean": np.mean(returns[actor]),
            "return_std": np.std(returns[actor]),
        }
        for actor in errors
    ]
    write_csv(options.out / "srl_error.csv", list(table[0]), table)
    plots.srl_error_bars(
        options.out / "srl_error.png", errors, "SRL error that each policy sees\n(deterministic actions)"
    )
    strip = reconstruct_with_probe(model, env.get_wrapper_attr("frame_stack"))
    if strip is not None:
        plots.reconstruction_grid(options.out / "reconstructions.png", strip, "What the latents know of the image")
    episode = next(run_episodes(model, eval_env, 1, "task", seed=30_000, render=True))
    fps = round(eval_env.metadata["render_fps"])
    write_video(options.out / "policy.mp4", episode, fps, action_repeat, "task policy, deterministic actions")
    model.save(options.out / "model.zip")
    summary = {
        "task": f"{DOMAIN}-{TASK}",
        "seed": options.seed,
        "agent_steps": model.num_timesteps,
        "environment_steps": model.num_timesteps * action_repeat,
        "updates": model._n_updates,
        "update_mode": model.update,
        "training_seconds": round(seconds),
        "final_return_mean": round(final_return, 1),
        "final_return_std": round(float(np.std(returns["task"])), 1),
        "random_return_mean": round(random_return, 1),
        "ratio": round(final_return / random_return, 2),
        "settings": SETTINGS,
        "environment": ENV_KWARGS,
        **describe_run(),
        "precision": model._computed_precision,
    }
    (options.out / "summary.json").write_text(json.dumps(summary, indent=2) + "\n")
    ratio = final_return / random_return
    print(
        f"Return after {model.num_timesteps} agent steps ({seconds:.0f} s): {final_return:.0f}, random policy: "
        f"{random_return:.0f}, ratio {ratio:.1f}. Pictures and video: {options.out}/"
    )
    return 0 if ratio >= 3 else 1


if __name__ == "__main__":
    raise SystemExit(main())
