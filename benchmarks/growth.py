"""How time grows with the batch, the image and the buffer, and memory with a buffer that fills."""

from typing import Any

from benchmarks.harness import fill, interleaved, make_env, make_model, peak_memory_mb, stream, summary
from sb3_cure.buffers import FrameStackReplayBuffer


def by_batch(sizes: tuple[int, ...] = (32, 64, 128, 256), repeats: int = 3) -> dict[str, Any]:
    """
    :param sizes: Batch sizes
    :param repeats: Rounds
    :return: Time of an update by batch size
    """
    model = make_model(warmup_updates=0)
    variants = {str(size): lambda size=size: model.train(1, size) for size in sizes}
    return {name: summary(values) for name, values in interleaved(variants, repeats).items()}


def by_image(sizes: tuple[int, ...] = (36, 48, 64, 84), repeats: int = 3) -> dict[str, Any]:
    """
    :param sizes: Sides of the images, pixels
    :param repeats: Rounds
    :return: Time of an update by image size
    """
    variants = {}
    for size in sizes:
        model = make_model(env_kwargs=dict(image_size=size), warmup_updates=0)
        variants[str(size)] = lambda model=model: model.train(1, 128)
    return {name: summary(values) for name, values in interleaved(variants, repeats).items()}


def by_buffer(sizes: tuple[int, ...] = (1000, 10_000, 80_000), repeats: int = 7) -> dict[str, Any]:
    """
    :param sizes: Transitions stored, the same real frames over and over
    :param repeats: Rounds
    :return: Time of ``sample(128)`` by size of the full buffer, and the process's peak memory after filling each
    """
    env = make_env()
    transitions = stream()
    results: dict[str, Any] = {}
    for size in sizes:
        buffer = FrameStackReplayBuffer(size, env.observation_space, env.action_space, frame_stack=3)
        for _ in range(-(-size // len(transitions)) + 1):
            fill(buffer, transitions)
        times = interleaved({"sample": lambda b=buffer: b.sample(128)}, repeats, calls=5)
        results[str(size)] = {**summary(times["sample"]), "peak_memory_mb": round(peak_memory_mb())}
        del buffer
    return results
