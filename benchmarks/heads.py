"""Time of an update by SRL head, beside the same agent without one."""

from typing import Any

from benchmarks.harness import make_model
from benchmarks.settings import SETTINGS, added_costs
from sb3_cure.srl import SRL_HEADS

PLAIN = "no head"


def costs(repeats: int = 7) -> dict[str, dict[str, float]]:
    """Time updates by head, as a part of ``make bench``: in its smallest setting on two threads, without curiosity.

    :param repeats: Rounds that count
    :return: By head: milliseconds of an update, and how many more these are than without a head
    """
    small = SETTINGS[1]
    common: dict[str, Any] = dict(
        env_kwargs=small.env_kwargs, policy_kwargs=small.policy_kwargs, warmup_updates=0, curiosity=None
    )
    arms: dict[str, dict[str, Any]] = {PLAIN: {}, "no head, shift": dict(augmentation="shift")}
    arms |= {head: dict(srl=head) for head in SRL_HEADS}
    models = {name: make_model(**common, **{"srl": None, **arm}) for name, arm in arms.items()}
    return added_costs(models, small.threads, lambda name: PLAIN, repeats)
