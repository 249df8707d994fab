"""Time of an update by SRL head, beside the same agent without one."""

import statistics
from typing import Any

from benchmarks.harness import BATCH_SIZE, interleaved, make_model
from benchmarks.settings import BLOCK
from sb3_cure.srl import SRL_HEADS

PLAIN = "no head"


def costs(repeats: int = 7) -> dict[str, dict[str, float]]:
    """A part of ``make bench``, in the first of the small settings there, without curiosity.

    :param repeats: Rounds that count
    :return: By head: milliseconds of an update, and how many more these are than without a head
    """
    networks = dict(net_arch=[256, 256], features_extractor_kwargs=dict(n_filters=16), share_encoder=True)
    common: dict[str, Any] = dict(env_kwargs=dict(image_size=36, grayscale=True), warmup_updates=0, curiosity=None)
    arms: dict[str, dict[str, Any]] = {PLAIN: {}, "no head, shift": dict(augmentation="shift")}
    arms |= {head: dict(srl=head) for head in SRL_HEADS}
    models = {name: make_model(policy_kwargs=networks, **common, **{"srl": None, **arm}) for name, arm in arms.items()}
    calls = {name: (lambda model=model: model.train(BLOCK, BATCH_SIZE)) for name, model in models.items()}
    times = interleaved(calls, repeats, 1)
    median = {name: 1e3 * statistics.median(values) / BLOCK for name, values in times.items()}
    return {
        name: {"update_ms": round(each, 2), "added_ms": round(each - median[PLAIN], 2)} for name, each in median.items()
    }
