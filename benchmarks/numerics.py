"""What bfloat16 changes: from one state and on one fixed buffer, the same updates in fp32 and in bf16."""

import copy
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.logger import KVWriter, Logger

from benchmarks.harness import make_model

ENV = dict(image_size=48)
COLUMNS = {"train/q_value": "mean Q", "train/srl_loss": "SRL loss"}
NETWORKS = dict(net_arch=[256, 256], features_extractor_kwargs=dict(n_filters=16))


class _Rows(KVWriter):
    def __init__(self) -> None:
        self.rows: list[dict[str, Any]] = []

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        self.rows.append(dict(key_values))

    def close(self) -> None: ...


def measure(updates: int = 2000, tail: int = 200, seeds: tuple[int, ...] = (0, 1)) -> dict[str, Any]:
    """
    :param updates: Updates of each arm
    :param tail: The last updates, over which the values are averaged
    :param seeds: Seeds of the random numbers (the noise of actions and dither, the order of the samples)
    :return: Values of fp32 and their relative change in bf16, by head: means over the seeds
    """
    results: dict[str, Any] = {}
    for head in ("rae", "curl"):
        values: dict[str, list[list[float]]] = {"fp32": [], "bf16": []}
        arguments: dict[str, Any] = dict(srl=head, env_kwargs=ENV, policy_kwargs=NETWORKS, warmup_updates=0)
        state = copy.deepcopy(make_model(**arguments).get_parameters())
        for seed in seeds:
            for precision, found in values.items():
                model = make_model(precision=precision, **arguments)
                model.set_parameters(state)
                rows = _Rows()
                model.set_logger(Logger(None, [rows]))
                th.manual_seed(seed)
                np.random.seed(seed)
                model.train(updates - tail, 64)
                model.logger.dump()
                model.train(tail, 64)
                model.logger.dump()
                found.append([rows.rows[-1][column] for column in COLUMNS])
        fp32, bf16 = (np.mean(found, axis=0) for found in values.values())
        results[head] = {
            name: {"fp32": round(float(a), 6), "bf16": round(float(b), 6), "change": f"{(b - a) / abs(a):+.2%}"}
            for name, a, b in zip(COLUMNS.values(), fp32, bf16, strict=True)
        }
    return results
