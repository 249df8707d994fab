"""What bfloat16 changes: from one state and on one fixed buffer, the same updates in fp32 and in bf16.

Training is chaotic: two runs diverge after the slightest difference. So there is a third arm, fp32 from weights that
differ in their last digits: its distance from fp32 shows the size of a difference that means nothing.
"""

import copy
from typing import Any

import numpy as np
import torch as th
from scipy import stats
from stable_baselines3.common.logger import KVWriter, Logger

from benchmarks.harness import make_model
from benchmarks.phases import METHODS

COLUMNS = {"train/q_target": "mean Q", "train/srl_loss": "SRL loss"}
#: Small, so that there is time for many seeds: how far runs part says more than one run of the paper's size
BATCH_SIZE = 16
ENV = dict(image_size=36, grayscale=True)
NETWORKS = dict(net_arch=[64, 64], features_extractor_kwargs=dict(n_filters=8, n_layers=3))
#: Precision and relative size of the change of the initial weights, by arm
ARMS = {"fp32": ("fp32", 0.0), "fp32 again": ("fp32", 1e-6), "bf16": ("bf16", 0.0)}


class _Rows(KVWriter):
    def __init__(self) -> None:
        self.rows: list[dict[str, Any]] = []

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        self.rows.append(dict(key_values))

    def close(self) -> None: ...


def _train(arm: str, seed: int, state: dict[str, Any], updates: int, tail: int, **arguments: Any) -> list[float]:
    """The columns' means over the last updates of a run."""
    precision, change = ARMS[arm]
    model = make_model(precision=precision, **arguments)
    model.set_parameters(state)
    th.manual_seed(seed)
    with th.no_grad():
        for parameter in model.policy.parameters():
            parameter.mul_(1 + change * th.randn_like(parameter))
    rows = _Rows()
    model.set_logger(Logger(None, [rows]))
    th.manual_seed(seed)
    np.random.seed(seed)
    model.train(updates - tail, BATCH_SIZE)
    model.logger.dump()
    model.train(tail, BATCH_SIZE)
    model.logger.dump()
    return [rows.rows[-1][column] for column in COLUMNS]


def measure(updates: int = 2000, tail: int = 200, seeds: tuple[int, ...] = tuple(range(12))) -> dict[str, Any]:
    """Compare bfloat16 with float32 on the same batches.

    :param updates: Updates of each arm
    :param tail: The last updates, over which the values are averaged
    :param seeds: Seeds of the random numbers (the noise of actions and dither, the order of the samples)
    :return: By head: values of fp32, and the relative change of fp32 from weights that differ by 1e-6 and of bf16, seed
        by seed: mean with its 95 % t interval, and standard deviation
    """
    th.set_num_threads(1)  # nothing is timed here, and the networks are small
    results: dict[str, Any] = {}
    for head, method in METHODS.items():
        arguments: dict[str, Any] = method | dict(env_kwargs=ENV, policy_kwargs=NETWORKS, warmup_updates=0)
        state = copy.deepcopy(make_model(**arguments).get_parameters())
        found = {
            arm: np.array([_train(arm, seed, state, updates, tail, **arguments) for seed in seeds]) for arm in ARMS
        }
        changes = {arm: found[arm] / found["fp32"] - 1 for arm in ("fp32 again", "bf16")}
        results[head] = {
            name: {
                "fp32": round(float(found["fp32"][:, column].mean()), 6),
                **{f"{arm}, change": _describe(values[:, column]) for arm, values in changes.items()},
                "by seed": {arm: [float(f"{value:.6g}") for value in found[arm][:, column]] for arm in ARMS},
            }
            for column, name in enumerate(COLUMNS.values())
        }
    return results


def _describe(changes: np.ndarray) -> str:
    low, high = stats.t.interval(0.95, len(changes) - 1, changes.mean(), stats.sem(changes))
    return f"{changes.mean():+.2%} [{low:+.2%}, {high:+.2%}], std {changes.std(ddof=1):.2%}"
