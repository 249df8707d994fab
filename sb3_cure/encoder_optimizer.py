"""How the losses that read the latents move the shared encoder.

The SRL loss and the critics' losses all pull at the encoder, with gradients that differ by factors of 1e3 to 1e5.
A plain sum under one Adam would let the critics drown the autoencoder: Adam divides by the running size of the sum.
"""

from functools import partial
from typing import Any

import torch as th
from stable_baselines3.common.utils import update_learning_rate
from torch import nn

from sb3_cure.guards import Guard

#: Every how many updates the sequential mode measures how far each source moved the encoder (it costs a copy)
SHARE_INTERVAL = 50


class EncoderOptimizer:
    """Turns each source's gradient at the latents into steps of the encoder.

    ``"sequential"`` (the paper's Algorithm 1): every source has its own pass through the encoder, its own Adam state
    and its own step, taken at once. ``"joint"``: all sources share one pass; the gradient of each is divided by its
    own running root-mean-square norm, and their sum goes back through the encoder once, for one step. Its learning rate
    is multiplied by the square root of the number n of sources that pull in the update: Adam divides by the size of the
    sum, which for uncorrelated gradients of equal size is sqrt(n) times that of each, so that the one step is what n
    Adams would make.

    :param encoder: The shared encoder
    :param sources: Names of the losses that train it, e.g. ``("srl", "task", "curious")``
    :param mode: ``"sequential"`` or ``"joint"``
    :param optimizer_class: Class of the optimisers
    :param lr: Learning rate
    :param optimizer_kwargs: Further arguments of the optimisers
    """

    #: Weight of the past in the running mean square of a source's gradient norm (joint)
    decay = 0.99

    def __init__(
        self,
        encoder: nn.Module,
        sources: tuple[str, ...],
        mode: str,
        optimizer_class: type[th.optim.Optimizer],
        lr: float,
        **optimizer_kwargs: Any,
    ):
        self.parameters = list(encoder.parameters())
        #: Looks at every gradient before it counts; the algorithm puts its own here
        self.guard = Guard()
        self.mode = mode
        self._make_optimizer = partial(optimizer_class, self.parameters, lr=lr, **optimizer_kwargs)  # type: ignore[call-arg]
        self.optimizers: dict[str, th.optim.Optimizer] = {}
        self.mean_squares: dict[str, th.Tensor] = {}
        self.weights: dict[str, float] = {}
        for source in sources:
            self.add_source(source)
        self.learning_rate = lr
        self._pulls: dict[str, th.Tensor] = {}
        self._norms: dict[str, th.Tensor] = {}
        self._latents: th.Tensor | None = None
        self._n_steps = 0
        #: Norm of each source's gradient at the latents, of the last update (detached scalars)
        self.gradient_norms: dict[str, th.Tensor] = {}
        #: Share of each source in the last measured step of the encoder; they add up to 1 (detached scalars)
        self.shares: dict[str, th.Tensor] = {}

    def add_source(self, source: str) -> None:
        """
        :param source: Name of a further loss that trains the encoder
        """
        name = source if self.mode == "sequential" else "joint"
        if name not in self.optimizers:
            self.optimizers[name] = self._make_optimizer()
        self.mean_squares[source] = th.zeros((), device=self.parameters[0].device)
        self.weights[source] = 0.0

    def remove_source(self, source: str) -> None:
        """
        :param source: Name of a loss that no longer trains the encoder
        """
        self.optimizers.pop(source, None)
        del self.mean_squares[source], self.weights[source]
        self.gradient_norms, self.shares = {}, {}

    def pull(self, source: str, latents: th.Tensor, gradient: th.Tensor) -> None:
        """Take one source's gradient: step at once (sequential), or keep it for ``step`` (joint).

        :param source: Name of the loss
        :param latents: Output of the encoder, with its graph, [B, features_dim]
        :param gradient: The loss's gradient with respect to the latents, [B, features_dim]
        """
        gradient = gradient.detach()
        norm = gradient.norm()
        self._norms[source] = norm
        if self.mode == "sequential":
            optimizer = self.optimizers[source]
            optimizer.zero_grad()
            latents.backward(gradient)
            self.guard.check(f"{source} loss at the encoder", None, optimizer)
            if self._n_steps % SHARE_INTERVAL == 0:
                before = [parameter.detach().clone() for parameter in self.parameters]
                self.guard.step(optimizer)
                moved = [now.detach() - then for now, then in zip(self.parameters, before, strict=True)]
                self._pulls[source] = th.linalg.vector_norm(th.stack(th._foreach_norm(moved)))
            else:
                self.guard.step(optimizer)
        else:
            self.guard.check(f"{source} loss at the latents", None, gradients=[gradient])
            # The policy may have moved to another device since this average was made.
            mean_square = self.mean_squares[source].to(norm.device)
            # A bad gradient counts as one of the usual size.
            square = self.guard.choose(norm.square(), otherwise=mean_square / max(self.weights[source], 1e-30))
            self.mean_squares[source] = mean_square.lerp_(square, 1 - self.decay)
            # Undo the bias of an average that starts at zero, as Adam does.
            self.weights[source] += (1 - self.decay) * (1 - self.weights[source])
            size = (self.mean_squares[source] / self.weights[source]).sqrt().clamp(min=1e-30)
            self._pulls[source] = gradient / size
            self._latents = latents

    def step(self) -> None:
        """End one update: in joint mode, one backward pass with the scaled gradients and one step."""
        self._n_steps += 1
        self.gradient_norms, self._norms = self._norms, {}
        if self.mode == "joint" and self._latents is not None:
            optimizer = self.optimizers["joint"]
            update_learning_rate(optimizer, self.learning_rate * len(self._pulls) ** 0.5)
            optimizer.zero_grad()
            self._latents.backward(th.stack(list(self._pulls.values())).sum(dim=0))
            self.guard.check("joint loss at the encoder", None, optimizer)
            self.guard.step(optimizer)
            self._latents = None
        if self._pulls:
            sizes = {source: pull.norm() for source, pull in self._pulls.items()}
            total = th.stack(list(sizes.values())).sum().clamp(min=1e-30)
            self.shares = {source: size / total for source, size in sizes.items()}
            self._pulls = {}

    def discard(self) -> None:
        """Forget the pulls of an update that is not brought to its end."""
        self._pulls, self._norms, self._latents = {}, {}, None

    def set_learning_rate(self, learning_rate: float) -> None:
        """
        :param learning_rate: New learning rate of all sources
        """
        self.learning_rate = learning_rate
        for optimizer in self.optimizers.values():
            update_learning_rate(optimizer, learning_rate)

    def state_dict(self) -> dict[str, Any]:
        """
        :return: States of the optimisers and the running sizes of the gradients
        """
        return {
            "optimizers": {name: optimizer.state_dict() for name, optimizer in self.optimizers.items()},
            "mean_squares": {source: value.clone() for source, value in self.mean_squares.items()},
            "weights": dict(self.weights),
            "n_steps": self._n_steps,
        }

    def check_origin(self, state: dict[str, Any]) -> None:
        """
        :param state: Result of ``state_dict``
        :raises RuntimeError: if it belongs to another mode or other sources
        """
        if not self._is_of_this_mode(state):
            # As torch's own load_state_dict; SB3's `load` takes a ValueError for an archive of an old DQN.
            raise RuntimeError(
                f"the saved encoder was trained by {sorted(state['weights'])} with optimisers "
                f"{sorted(state['optimizers'])}, but this model has {sorted(self.weights)} with "
                f"{sorted(self.optimizers)}: load with the update=, srl= and curiosity= it was trained with."
            )

    def _is_of_this_mode(self, state: dict[str, Any]) -> bool:
        return state["optimizers"].keys() == self.optimizers.keys() and state["weights"].keys() == self.weights.keys()

    def load_state_dict(self, state: dict[str, Any], strict: bool = True) -> None:
        """
        :param state: Result of ``state_dict``
        :param strict: Whether a state of other sources or of the other mode is an error (else it is skipped)
        :raises RuntimeError: if ``strict`` and the state belongs to another mode or other sources
        """
        if strict:
            self.check_origin(state)
        elif not self._is_of_this_mode(state):
            return
        for name, optimizer in self.optimizers.items():
            optimizer.load_state_dict(state["optimizers"][name])
        self.mean_squares = {source: value.clone() for source, value in state["mean_squares"].items()}
        self.weights = dict(state["weights"])
        self._n_steps = state["n_steps"]
