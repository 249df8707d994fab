"""Whether two environments are the same one inside of their wrappers."""

from typing import Any


def share_environment(first: Any, second: Any) -> bool:
    """Check whether two environments wrap or hold the same environment or simulator.

    :param first: An environment or VecEnv; those in worker processes are copies
    :param second: Another one, or None
    :return: Whether stepping one of them changes the other
    """
    return not _layers(first).isdisjoint(_layers(second))


def _layers(env: Any) -> set[int]:
    """Ids of an environment and of all that it holds with ``reset`` and ``step``, under whatever name."""
    found: set[int] = set()
    queue = [env]
    while queue:
        layer = queue.pop()
        if hasattr(layer, "step") and hasattr(layer, "reset") and id(layer) not in found:
            found.add(id(layer))
            for held in getattr(layer, "__dict__", {}).values():
                queue += held if isinstance(held, list) else [held]  # DummyVecEnv has a list
    return found
