"""A frame-stack buffer and SB3's own, fed the same stream."""

import copy
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from hypothesis import strategies as st
from stable_baselines3.common.buffers import DictReplayBuffer, ReplayBuffer

from sb3_cure.data.buffers import FrameStackReplayBuffer, stored_places, transitions

ACTIONS = spaces.Box(-1, 1, (2,), np.float32)
PALETTE = 4
#: Few frames, so that they recur by chance; two of them differ in a single pixel
FRAMES = np.random.default_rng(0).integers(0, 256, (PALETTE, 2, 4, 5), dtype=np.uint8)
FRAMES[1] = FRAMES[0]
FRAMES[1, -1, -1, -1] += 1
KINDS = ("image", "dictionary", "vector", "number")
EVENTS = ("step", "step", "step", "terminate", "truncate", "break", "jump", "other goal")
BETWEEN = ("nothing",) * 12 + ("save and load", "learn again", "reset", "lost step")


def image_space(frame_stack: int, channels: int = 2, height: int = 4, width: int = 5) -> spaces.Box:
    return spaces.Box(0, 255, (frame_stack * channels, height, width), np.uint8)


def space_of(kind: str, frame_stack: int) -> spaces.Space:
    parts = {
        "camera": image_space(frame_stack),
        "goal": image_space(1),
        "joints": spaces.Box(-1, 1, (3,), np.float64),
        "number": spaces.Discrete(PALETTE),
        "touch": spaces.MultiBinary(2),
    }
    return {
        "image": parts["camera"],
        "dictionary": spaces.Dict(parts),
        "vector": spaces.Box(-1, 1, (frame_stack,), np.float32),
        "number": parts["number"],
    }[kind]


class Twins:
    """The two buffers; the reward of each transition is its number.

    Each environment shows the last ``frame_stack`` numbers of a sequence, and the number of a goal.
    """

    def __init__(
        self,
        buffer_size: int,
        n_envs: int = 1,
        frame_stack: int = 3,
        kind: str = "image",
        action_space: spaces.Space = ACTIONS,
        **kwargs: Any,
    ):
        self.n_envs, self.frame_stack, self.kind, self.action_space = n_envs, frame_stack, kind, action_space
        self.space = space_of(kind, frame_stack)
        arguments: Any = (buffer_size, self.space, action_space, "cpu", n_envs)
        stacks: Any = {"camera": frame_stack} if kind == "dictionary" else frame_stack
        self.ours = FrameStackReplayBuffer(*arguments, frame_stack=stacks, **kwargs)
        self.sb3 = (DictReplayBuffer if kind == "dictionary" else ReplayBuffer)(*arguments, **kwargs)
        self.stacks, self.goals, self.n_added = [[0] * frame_stack for _ in range(n_envs)], [0] * n_envs, 0
        self.last: Any = None  # what the row before led to
        self.starts: dict[int, np.ndarray] = {}

    def render(self, stacks: list[list[int]], goals: list[int]) -> Any:
        numbers = np.array(stacks)
        parts = {
            "camera": FRAMES[numbers].reshape(self.n_envs, -1, 4, 5),
            "goal": FRAMES[goals],
            "joints": numbers[:, [0, 0, -1]] / PALETTE,
            "number": numbers[:, -1],
            "touch": numbers[:, [-1, 0]] % 2,
        }
        parts |= {"image": parts["camera"], "dictionary": dict(parts), "vector": (numbers / PALETTE).astype(np.float32)}
        return parts[self.kind]

    def step(self, events: list[tuple[str, int, int]]) -> None:
        """Take one step in each environment.

        :param events: Per environment what happens, and two codes for the numbers that come next
        """
        obs = self.render(self.stacks, self.goals)
        successors, dones, infos = [], np.zeros(self.n_envs), []
        for i, (what, code, next_code) in enumerate(events):
            stack = self.stacks[i]
            new = [code // PALETTE**k % PALETTE for k in range(self.frame_stack)]
            successors.append(new if what == "jump" else [*stack[1:], new[0]])
            dones[i] = what in ("terminate", "truncate")
            infos.append({"TimeLimit.truncated": what == "truncate"})
            self.stacks[i] = [next_code % PALETTE] * self.frame_stack if dones[i] or what == "break" else successors[i]
            self.goals[i] = (self.goals[i] + (what == "other goal")) % PALETTE
        self.add(obs, self.render(successors, self.goals), dones, infos)

    def add(self, obs: Any, next_obs: Any, dones: np.ndarray, infos: list[dict[str, Any]]) -> None:
        rewards = self.n_added + np.arange(self.n_envs, dtype=np.float32)
        actions = np.stack([self.action_space.sample() for _ in range(self.n_envs)])
        buffers: Any = (self.ours, self.sb3)
        for buffer in buffers:
            parts: Any = ({**each} if isinstance(each, dict) else each for each in (obs, next_obs))
            buffer.add(*parts, actions, rewards, dones, infos)
        begins = np.ones(self.n_envs, bool)
        if self.last is not None:
            pairs = zip(*map(_parts, (obs, self.last)), strict=True)
            begins = np.any([(a != b).reshape(self.n_envs, -1).any(1) for a, b in pairs], axis=0)
        self.starts[self.n_added // self.n_envs], self.last = begins, next_obs
        self.n_added += self.n_envs

    def between(self, what: str) -> None:
        """What may happen between two steps."""
        if what == "save and load":
            self.ours = copy.deepcopy(self.ours)  # as pickle does
        elif what == "learn again":
            self.stacks = [[number] * self.frame_stack for number, *_ in self.stacks]
        elif what == "lost step":
            self.ours.break_stream()
            self.last = None
        elif what == "reset":
            self.ours.reset()
            self.sb3.reset()
            self.last = None

    def check(self) -> None:
        """Every transition that can be sampled equals SB3's, and so does a batch unless rows were lost."""
        ours, sb3 = self.ours, self.sb3
        assert (ours.pos, ours.full) == (sb3.pos, sb3.full) and min(sb3.size(), 1) <= ours.size() <= sb3.size()
        rows, envs, ages = stored_places(ours)
        numbers = self.n_added - (ages + 1) * self.n_envs + envs
        if ours.size() > 0:
            found = transitions(ours, rows, envs)
            assert_equal(found, transitions(sb3, rows, envs))
            assert found.rewards.flatten().tolist() == numbers.tolist()
            starts = [self.starts[number // self.n_envs][env] for number, env in zip(numbers, envs, strict=True)]
            assert ours.starts[rows, envs].tolist() == starts
            batch = seeded_sample(ours)
            assert_equal(transitions(ours, *ours.last_sampled), batch)  # type: ignore[misc]
            if ours.size() == sb3.size():
                after = np.random.random()
                assert_equal(batch, seeded_sample(sb3))
                assert np.random.random() == after


def _parts(observations: Any) -> list[np.ndarray]:
    return list(observations.values()) if isinstance(observations, dict) else [observations]


def assert_equal(batch: Any, expected: Any) -> None:
    """Equal to the bit, in shape and type."""
    for name, value, reference in zip(batch._fields, batch, expected, strict=True):
        both = [each if isinstance(each, dict) else {"": each} for each in (value, reference)]
        assert list(both[0]) == list(both[1]), name
        for key, tensor in both[0].items():
            other = both[1][key]
            assert tensor is other or (tensor.dtype, tensor.shape) == (other.dtype, other.shape), (name, key)
            assert tensor is other or th.equal(tensor, other), (name, key)


def seeded_sample(buffer: ReplayBuffer, batch_size: int = 32, seed: int = 0, **kwargs: Any) -> Any:
    np.random.seed(seed)
    return buffer.sample(batch_size, **kwargs)


def random_events(rng: np.random.Generator, n_envs: int, kinds: tuple[str, ...]) -> list[tuple[str, int, int]]:
    return [(str(rng.choice(kinds)), int(rng.integers(256)), int(rng.integers(256))) for _ in range(n_envs)]


@st.composite
def streams(draw: Any) -> Twins:
    """Twins after a random stream of several environments, of which SB3's and ours were compared now and then."""
    n_envs = draw(st.integers(1, 3))
    twins = Twins(draw(st.integers(1, 24)), n_envs, draw(st.integers(1, 4)), draw(st.sampled_from(KINDS)))
    kinds = draw(st.sampled_from([EVENTS, ("step",) * 5 + ("terminate", "truncate"), ("break", "jump")]))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    for between in draw(st.lists(st.sampled_from(BETWEEN), min_size=1, max_size=50)):
        twins.between(between)
        twins.step(random_events(rng, n_envs, kinds))
        if rng.random() < 0.2:
            twins.check()
    return twins
