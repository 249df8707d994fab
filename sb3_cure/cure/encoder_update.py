"""How several losses move one encoder.

The SRL loss and the critics' losses all pull at the encoder, with gradients that differ by factors of 1e3 to 1e5.
A plain sum under one Adam would let the critics drown the autoencoder: Adam divides by the running size of the sum.
"""

import contextlib
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import torch as th
from stable_baselines3.common.utils import update_learning_rate

from sb3_cure.data.observations import detached
from sb3_cure.networks.encoders import Encoder

#: Every how many updates gradients are measured at the parameters, which costs a backward pass for each source
SHARE_INTERVAL = 100

#: Takes a loss's name, the loss and an optimiser, and makes a step
Optimize = Callable[[str, th.Tensor, th.optim.Optimizer], None]


class Encoded(NamedTuple):
    """One run of the encoder.

    :param features: Features of its trunk, detached, as actors read them, [B, trunk_dim]
    :param latents: Latents in fp32, with their graph, [B, features_dim]
    """

    features: Any
    latents: th.Tensor


class EncoderUpdate:
    """Each loss gives its gradient (``backward``), and ``step`` moves the encoder along what was given.

    ``"sequential"`` (Algorithm 1 of the paper): a step after each loss, by an Adam of its own. ``"joint"``: one step at
    the end of the update; the gradient of each loss is divided by its running root-mean-square norm, and the sum goes
    back through the encoder once. Its learning rate is multiplied by the square root of the number of losses: Adam
    divides by the size of the sum, which for uncorrelated gradients of equal size is that root times the size of each.

    Whoever reads the encoder gets the run that is there, or a new one where the encoder has moved since. So all losses
    and actors of a joint update share one run, and those of a sequential update see the encoder as it is by then.

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
        encoder: Encoder,
        sources: Sequence[str],
        mode: str,
        optimizer_class: type[th.optim.Optimizer],
        lr: float,
        **optimizer_kwargs: Any,
    ):
        self.encoder = encoder
        self.mode = mode
        self.learning_rate = lr
        self._make_optimizer = partial(optimizer_class, list(encoder.parameters()), lr=lr, **optimizer_kwargs)  # type: ignore[call-arg]
        self.optimizers: dict[str, th.optim.Optimizer] = {}
        self.mean_squares: dict[str, th.Tensor] = {}
        self.weights: dict[str, float] = {}
        for source in sources:
            self.add_source(source)
        #: Within what the encoder runs; the algorithm puts its own here
        self.autocast: Callable[[], contextlib.AbstractContextManager] = contextlib.nullcontext
        #: Norm of each source's gradient at the encoder's parameters, when that was measured last
        self.parameter_norms: dict[str, th.Tensor] = {}
        self._n_updates = 0
        self.begin(th.empty(0), th.empty(0))

    def add_source(self, source: str) -> None:
        """
        :param source: Name of a further loss that trains the encoder
        """
        self.optimizers.setdefault(source if self.mode == "sequential" else "joint", self._make_optimizer())
        self.mean_squares[source] = th.zeros((), device=next(self.encoder.parameters()).device)
        self.weights[source] = 0.0

    def remove_source(self, source: str) -> None:
        """
        :param source: Name of a loss that no longer trains the encoder
        """
        self.optimizers.pop(source, None)
        del self.mean_squares[source], self.weights[source]
        self.parameter_norms = {}

    def begin(self, views: Any, next_views: Any, n_step_views: Any = None) -> None:
        """Begin an update, and forget one that was not brought to its end.

        :param views: What the encoder is to see of the observations, preprocessed, [B, *view shape]
        :param next_views: The same of the next observations
        :param n_step_views: The same of those after n steps, if the task's returns are of several
        """
        self._inputs = {"": views, "next ": next_views}
        if n_step_views is not None:
            self._inputs["n-step "] = n_step_views
        self._runs: dict[str, Encoded] = {}
        self._next_features: dict[str, Any] = {}
        self._pulls: dict[str, list[tuple[th.Tensor, th.Tensor]]] = {}
        self.gradient_norms: dict[str, th.Tensor] = {}
        self._measured: dict[str, th.Tensor] = {}

    def run(self) -> Encoded:
        """
        :return: Features and latents of the observations, by the encoder as it is now, with their graph
        """
        return self._run("")

    def next_run(self) -> Encoded:
        """
        :return: Features and latents of the next observations, by the encoder as it is now, with their graph
        """
        return self._run("next ")

    def next_features(self, which: str = "next ") -> Any:
        """
        :param which: ``"next "`` or ``"n-step "``
        :return: Features alone of these observations, which actors read, [B, trunk_dim]
        """
        if which in self._runs:
            return self._runs[which].features
        if which not in self._next_features:
            with th.no_grad(), self.autocast():
                self._next_features[which] = self.encoder.trunk(self._inputs[which])
        return self._next_features[which]

    def _run(self, which: str) -> Encoded:
        if which not in self._runs:
            with self.autocast():
                features = self.encoder.trunk(self._inputs[which])
                # In full precision, whatever the encoder ends with: losses and optimisers work with these.
                self._runs[which] = Encoded(detached(features), self.encoder.projection(features).float())
        return self._runs[which]

    def backward(self, source: str, read: Sequence[tuple[th.Tensor, th.Tensor]]) -> None:
        """Take a loss's gradient, if it has one.

        :param source: Name of the loss
        :param read: Latents with their graph, and the copy of each that the loss read, with its gradient,
            [B, features_dim]
        """
        gradients = [(latents, copy.grad) for latents, copy in read if copy.grad is not None]
        if not gradients:
            return
        norm = th.stack(th._foreach_norm([gradient for _, gradient in gradients])).norm()
        self.gradient_norms[source] = norm
        if self._n_updates % SHARE_INTERVAL == 0:
            parameters = [parameter for parameter in self.encoder.parameters() if parameter.requires_grad]
            outputs, at_outputs = zip(*gradients, strict=True)
            own = th.autograd.grad(outputs, parameters, at_outputs, retain_graph=True, allow_unused=True)
            self._measured[source] = th.stack(th._foreach_norm([each for each in own if each is not None])).norm()
        if self.mode == "joint":
            # The policy may have moved to another device since this average was made.
            mean_square = self.mean_squares[source].to(norm.device)
            self.mean_squares[source] = th.where(
                norm.isfinite(), mean_square.lerp(norm.square(), 1 - self.decay), mean_square
            )
            # Undo the bias of an average that starts at zero, as Adam does.
            self.weights[source] += (1 - self.decay) * (1 - self.weights[source])
            size = (self.mean_squares[source] / self.weights[source]).sqrt().clamp(min=1e-30)
            gradients = [(latents, gradient / size) for latents, gradient in gradients]
        self._pulls[source] = gradients

    def step(self, optimize: Optimize) -> None:
        """Move the encoder along the gradients that were given since the last step; without any, do nothing.

        :param optimize: Called with a loss that has just these gradients, and the optimiser that is to step
        """
        if not self._pulls:
            return
        losses: dict[str, th.Tensor] = {}
        for source, pulls in self._pulls.items():
            for latents, gradient in pulls:  # the gradient of (latents * g).sum() at the latents is g
                losses[source] = losses.get(source, 0) + (latents * gradient).sum()
        optimizer = self.optimizers["joint" if self.mode == "joint" else source]
        factor = len(losses) ** 0.5 if self.mode == "joint" else 1.0
        update_learning_rate(optimizer, self.learning_rate * factor)
        optimize("encoder", th.stack(list(losses.values())).sum(), optimizer)
        self._pulls, self._runs, self._next_features = {}, {}, {}

    def end(self) -> dict[str, th.Tensor]:
        """End an update. No graph is left of it: it would fill memory while environments step, and forbid copies.

        :return: Norms of each source's gradient, before anything is scaled: at the latents, and, when that was measured
            last, at the encoder's parameters, with the share of each source there: what a plain sum of the losses would
            be made of. By their logged names, detached scalars
        """
        self._n_updates += 1
        self._inputs, self._runs, self._next_features, self._pulls = {}, {}, {}, {}
        if self._measured:
            self.parameter_norms = self._measured
        metrics = {f"latent_grad_norm_{source}": norm for source, norm in self.gradient_norms.items()}
        if self.parameter_norms:
            total = th.stack(list(self.parameter_norms.values())).sum().clamp(min=1e-30)
            for source, norm in self.parameter_norms.items():
                metrics[f"encoder_grad_norm_{source}"], metrics[f"encoder_share_{source}"] = norm, norm / total
        return metrics

    def state_dict(self) -> dict[str, Any]:
        """
        :return: States of the optimisers and the running sizes of the gradients
        """
        return {
            "optimizers": {name: optimizer.state_dict() for name, optimizer in self.optimizers.items()},
            "mean_squares": {source: value.clone() for source, value in self.mean_squares.items()},
            "weights": dict(self.weights),
            "n_updates": self._n_updates,
            "parameter_norms": dict(self.parameter_norms),
        }

    def load_state_dict(self, state: dict[str, Any], strict: bool = True) -> None:
        """
        :param state: Result of ``state_dict``
        :param strict: Whether a state of other sources or of the other mode is an error (else it is skipped)
        :raises RuntimeError: if ``strict`` and the state belongs to another mode or other sources
        """
        if state["optimizers"].keys() != self.optimizers.keys() or state["weights"].keys() != self.weights.keys():
            if not strict:
                return
            # As torch's own load_state_dict; SB3's `load` takes a ValueError for an archive of an old DQN.
            raise RuntimeError(
                f"the saved encoder was trained by {sorted(state['weights'])} with optimisers "
                f"{sorted(state['optimizers'])}, this one by {sorted(self.weights)} with {sorted(self.optimizers)}: "
                "load with the update=, srl= and curiosity= it was trained with."
            )
        for name, optimizer in self.optimizers.items():
            optimizer.load_state_dict(state["optimizers"][name])
        self.mean_squares = {source: value.clone() for source, value in state["mean_squares"].items()}
        self.weights = dict(state["weights"])
        self._n_updates, self.parameter_norms = state["n_updates"], dict(state["parameter_norms"])
