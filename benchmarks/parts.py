"""The parts of the report, each of which is run in a process of its own."""

import resource
from collections.abc import Callable
from functools import partial
from typing import Any

from benchmarks import checkpoints, collection, growth, heads, numerics, phases, rendering, replay, rewards, settings
from benchmarks.harness import PRECISIONS
from sb3_cure.networks.allocator import tune_allocator


def parts(repeats: int, disk: str | None) -> dict[str, Callable[[], dict[str, Any]]]:
    """Measurements by name, in the order of the report.

    :param repeats: Rounds of the comparisons
    :param disk: Directory for the buffer of a million transitions (22 GB), or None
    :return: What can be measured, by name, in the order of the report
    """
    return {
        "update_by_setting": partial(settings.measure, repeats),
        "update_by_head": partial(heads.costs, repeats),
        "update_by_reward": partial(rewards.costs, repeats),
        "update_by_phase": phases.breakdowns,
        "replay": replay.measure,
        "rendering": rendering.measure,
        "end_to_end": collection.measure,
        "checkpoints": checkpoints.measure,
        "growth_with_buffer": growth.by_buffer,
        **({"bfloat16_against_float32": numerics.measure} if "bf16" in PRECISIONS else {}),
        **({"buffer_on_disk": partial(growth.on_disk, 1_000_000, disk)} if disk is not None else {}),
    }


def run_part(part: str, repeats: int, disk: str | None) -> tuple[dict[str, Any], float]:
    """Run one measurement.

    :param part: A name of ``parts``
    :param repeats: Rounds of the comparisons
    :param disk: As for ``parts``
    :return: The part's results, and the peak of this process's memory, MiB
    """
    tune_allocator()
    results = parts(repeats, disk)[part]()
    return results, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
