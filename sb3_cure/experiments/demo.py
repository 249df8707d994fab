"""Train CuReSAC on cartpole-swingup from pixels in ten minutes on two cores, and draw what it learned.

    python -m sb3_cure.experiments.demo --out demo

Writes ``learning_curve.csv/png``, ``reconstructions.png``, ``srl_error.csv/png``, ``policy.mp4``, ``model.zip`` and
``summary.json`` into the folder. Settings are scaled down from the paper's (see ``SETTINGS``) to fit ten minutes.
"""

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

from sb3_cure import CuReSAC, make_dmc_env
from sb3_cure.allocator import tune_allocator
from sb3_cure.callbacks import EvalBothCallback, ReconstructionCallback
from sb3_cure.evaluation import even_negatives, run_episodes
from sb3_cure.experiments import plots
from sb3_cure.experiments.files import describe_run, write_csv, write_json
from sb3_cure.experiments.video import write_video

DOMAIN, TASK = "cartpole", "swingup"
# The camera that follows the cart: the usual one is far away, and the cart drives out of its view.
ENV_KWARGS: dict[str, Any] = dict(image_size=36, grayscale=True, camera_id=1, renderer="fast")
# Smaller images and networks than the paper's, and quicker targets, because ten minutes on two cores allow a fraction
# of the paper's updates.
SETTINGS: dict[str, Any] = dict(
    srl="curl",
    augmentation="shift",
    augmentation_kwargs=dict(pad=2),
    learning_starts=500,
    warmup_updates=300,
    gamma=0.98,
    tau=0.02,
    target_update_interval=1,
    policy_kwargs=dict(net_arch=[256, 256], features_extractor_kwargs=dict(n_filters=16)),
)
TOTAL_STEPS = 12_000
EVALUATIONS = 12
#: Episodes of each policy in the end, and updates of the decoder that draws from the latents
EPISODES, PROBE_UPDATES = 10, 1000


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
    out: Path = options.out
    out.mkdir(parents=True, exist_ok=True)
    tune_allocator()

    env = make_dmc_env(DOMAIN, TASK, seed=options.seed, **ENV_KWARGS)
    eval_env = make_dmc_env(DOMAIN, TASK, render_mode="rgb_array", **ENV_KWARGS)
    repeat = env.get_wrapper_attr("action_repeat")
    model = CuReSAC("CnnPolicy", env, seed=options.seed, **SETTINGS)
    curve = RecordCurve(eval_env, max(options.steps // EVALUATIONS, 1), n_episodes=3, seed=10_000, action_repeat=repeat)
    title = f"{DOMAIN}-{TASK} from pixels, CuReSAC ({SETTINGS['srl']}), seed {options.seed}"
    print(f"{title}: at most {options.minutes:g} minutes and {options.steps} agent steps")
    start = time.monotonic()
    model.learn(options.steps, callback=[curve, TimeLimit(options.minutes)], progress_bar=True)
    seconds = round(time.monotonic() - start)
    if not curve.rows or curve.rows[-1]["agent_steps"] < model.num_timesteps:
        curve.evaluate()
    steps = {"agent_steps": model.num_timesteps, "environment_steps": model.num_timesteps * repeat}
    model.save(out / "model.zip")

    print("Measuring the random, task and curious policies")
    even_negatives(model, eval_env, seed=15_000)
    errors, returns = {}, {}
    for actor in ("random", "task", "curious"):
        episodes = list(run_episodes(model, eval_env, EPISODES, actor, seed=20_000))
        errors[actor] = np.concatenate([episode.srl_errors for episode in episodes])
        returns[actor] = np.array([episode.total_reward for episode in episodes])
    table = [
        {
            **{"policy": actor, "min": seen.min(), "mean": seen.mean(), "max": seen.max()},
            **{"return_mean": returns[actor].mean(), "return_std": returns[actor].std()},
        }
        for actor, seen in errors.items()
    ]
    ratio = returns["task"].mean() / returns["random"].mean()
    summary = {
        **{"task": f"{DOMAIN}-{TASK}", "seed": options.seed, **steps, "updates": model._n_updates},
        **{"update_mode": model.update, "training_seconds": seconds},
        "final_return_mean": round(float(returns["task"].mean()), 1),
        "final_return_std": round(float(returns["task"].std()), 1),
        "random_return_mean": round(float(returns["random"].mean()), 1),
        **{"ratio": round(float(ratio), 2), "settings": SETTINGS, "environment": ENV_KWARGS},
        **{**describe_run(), "precision": model._computed_precision},
    }
    write_csv(out / "learning_curve.csv", list(curve.rows[0]), curve.rows)
    write_csv(out / "srl_error.csv", list(table[0]), table)
    write_json(out / "summary.json", summary)
    plots.learning_curve(out / "learning_curve.png", curve.rows, returns["random"].mean(), title)
    plots.srl_error_bars(out / "srl_error.png", errors, "SRL error that each policy sees\n(deterministic actions)")
    ReconstructionCallback(out, probe_updates=PROBE_UPDATES, title=title).draw(model)
    (episode,) = run_episodes(model, eval_env, 1, "task", seed=30_000, render=True)
    fps = round(eval_env.metadata["render_fps"])
    write_video(out / "policy.mp4", episode, fps, repeat, "task policy, deterministic actions")
    print(
        f"Return after {model.num_timesteps} agent steps ({seconds} s): {returns['task'].mean():.0f}, random policy: "
        f"{returns['random'].mean():.0f}, ratio {ratio:.1f}. Pictures and video: {out}/"
    )
    return 0 if ratio >= 3 else 1


if __name__ == "__main__":
    raise SystemExit(main())
