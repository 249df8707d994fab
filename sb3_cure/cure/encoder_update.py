"""How several losses train one encoder.

The SRL loss and the critics' losses all send gradients to the encoder, and their sizes differ by factors of 1e3 to 1e5.
A plain sum under one Adam would let the critics drown the autoencoder: Adam divides by the running size of the sum.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache, partial
from typing import Any

import torch as th
from stable_baselines3.common.utils import update_learning_rate

from sb3_cure.networks.encoders import Encoder

#: Joint updates between two measurements of each source's share, which costs a backward pass for each source. A prime,
#: so that a source that learns only in every k-th update is neither always nor never measured
MEASURE_INTERVAL = 101

#: Takes the name of a step and the gradients that it follows; raises if one is not finite
Check = Callable[[str, list[th.Tensor]], None]


class EncoderUpdate:
    """Collects the gradient of each loss at the latents and steps the encoder along them.

    A loss reads ``latents(source)``, a copy of the latents without their graph, and ``collect(source)`` takes its
    gradient there. ``"sequential"`` (Algorithm 1 of the paper) then steps at once, with an optimiser for each source.
    ``"joint"`` steps once, in ``finish``: the gradient of each source is divided by its running root-mean-square norm
    (for each image of a dictionary separately), and the sum goes back through the encoder in one pass. The learning
    rate is multiplied by the square root of the number of sources of this update: Adam divides by the size of the sum,
    which for uncorrelated gradients of equal size is that root times the size of each.

    Views are made and encoded when they are first read, and encoded again only after the encoder has been stepped.

    :param encoder: The shared encoder; it may have no parameters
    :param target: Its moving average
    :param sources: Names of the losses that train the encoder, e.g. ``("srl", "task", "curious")``
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
        target: Encoder,
        sources: Sequence[str],
        mode: str,
        optimizer_class: type[th.optim.Optimizer],
        lr: float,
        **optimizer_kwargs: Any,
    ):
        self.encoder, self.target, self.mode, self.learning_rate = encoder, target, mode, lr
        self._parameters = list(encoder.parameters())
        #: Parts of the latents whose gradients are scaled separately
        self._parts = list(getattr(encoder, "slices", {"": slice(None)}).values())
        self._make_optimizer = partial(optimizer_class, self._parameters, lr=lr, **optimizer_kwargs)  # type: ignore[call-arg]
        self.optimizers: dict[str, th.optim.Optimizer] = {}
        self.mean_squares: dict[str, th.Tensor] = {}
        self.total_weights: dict[str, float] = {}
        self.set_sources(sources)
        self._n_updates = 0
        self._reset({})

    def set_sources(self, sources: Sequence[str]) -> None:
        """Set which losses train the encoder; those that stay keep their state.

        :param sources: Names of the losses
        """
        names = sources if self.mode == "sequential" else ["joint"] if sources else []
        self.optimizers = {
            name: self.optimizers.get(name) or self._make_optimizer() for name in names if self._parameters
        }
        self.mean_squares = {source: self.mean_squares.get(source, th.zeros(len(self._parts))) for source in sources}
        self.total_weights = {source: self.total_weights.get(source, 0.0) for source in sources}
        self.metrics: dict[str, th.Tensor] = {}

    # ------------------------------------------------------------ one update

    def begin(self, views: Mapping[str, Callable[[], Any]], check: Check) -> None:
        """Begin an update.

        :param views: Functions that make the encoder's inputs, [B, *view shape], by name; one is ``"observations"``
        :param check: Looks at gradients before each step
        """
        self._reset(views)
        self._check = check
        self._n_updates += 1
        # Repeat the last shares until the next measurement.
        self.metrics = {name: value for name, value in self.metrics.items() if not name.startswith("latent_")}

    def features(self, name: str = "observations") -> Any:
        """Features of the trunk without their graph, which actors read.

        :param name: Name of the views
        :return: [B, trunk_dim]; for dictionaries, a tuple of these
        """
        if name not in self._features:
            with th.no_grad():
                self._features[name] = self.encoder.trunk(self._views[name]())
        return self._features[name]

    def latents(self, source: str, name: str = "observations", graph: bool = True) -> th.Tensor:
        """Latents for a loss: a copy that holds the gradient of the loss until ``collect`` takes it.

        :param source: Name of the loss; latents of a loss that does not train the encoder carry no gradient
        :param name: Name of the views
        :param graph: Whether to build the graph, even under ``no_grad``, as later losses of this update share these
            latents; False where none differentiates through them (centred views, read by a reward that learns nothing)
        :return: fp32, [B, features_dim]
        """
        if name not in self._latents:
            with th.set_grad_enabled(graph):
                features = self.encoder.trunk(self._views[name]())
                self._latents[name] = self.encoder.projection(features).float()
            is_one = isinstance(features, th.Tensor)
            self._features[name] = features.detach() if is_one else tuple(part.detach() for part in features)
        leaf = self._latents[name].detach()
        leaf.requires_grad_(source in self.mean_squares and self._latents[name].requires_grad)
        self._leaves.setdefault(source, {})[name] = leaf
        return leaf

    @th.no_grad()
    def target_latents(self, name: str) -> th.Tensor:
        """Latents by the target encoder, from which returns bootstrap.

        :param name: Name of the views
        :return: [B, features_dim]
        """
        if name not in self._target_latents:
            self._target_latents[name] = self.target(self._views[name]())
        return self._target_latents[name]

    def leaves(self, source: str) -> list[th.Tensor]:
        """Latents that a loss has read and that carry its gradient.

        :param source: Name of the loss
        :return: [B, features_dim] each
        """
        return [leaf for leaf in self._leaves.get(source, {}).values() if leaf.requires_grad]

    def collect(self, source: str) -> None:
        """Take the gradient of a loss at its latents, after its backward pass; sequential: step along it at once.

        :param source: Name of the loss
        """
        leaves = self._leaves.pop(source, {})
        gradients = {name: leaf.grad for name, leaf in leaves.items() if leaf.grad is not None}
        if not gradients:
            return
        norms = th.stack([_norm([gradient[:, part] for gradient in gradients.values()]) for part in self._parts])
        self.metrics[f"latent_grad_norm_{source}"] = norms.norm()
        if self.mode == "joint":
            mean_squares = self.mean_squares[source].to(norms.device).lerp(norms.square(), 1 - self.decay)
            self.mean_squares[source] = mean_squares
            # Undo the bias of an average that starts at zero, as Adam does.
            self.total_weights[source] += (1 - self.decay) * (1 - self.total_weights[source])
            sizes = th.ones_like(next(iter(gradients.values()))[0])
            for part, mean_square in zip(self._parts, mean_squares, strict=True):
                sizes[part] = (mean_square / self.total_weights[source]).sqrt().clamp(min=1e-30)
            gradients = {name: gradient / sizes for name, gradient in gradients.items()}
        self._gradients[source] = gradients
        if self.mode == "sequential":
            self._step()

    def finish(self) -> None:
        """End the update: if joint, step along the collected gradients; then drop everything that was computed."""
        self._step()
        self._reset({})

    def _step(self) -> None:
        """Step along the gradients that were collected since the last step, if there are any, and drop all graphs."""
        if self._gradients:
            joint, first = self.mode == "joint", next(iter(self._gradients))  # sequential: the only one
            optimizer = self.optimizers["joint" if joint else first]
            update_learning_rate(optimizer, self.learning_rate * len(self._gradients) ** 0.5)
            if joint and self._n_updates % MEASURE_INTERVAL == 1:
                self._measure_shares()
            # The last source first, which is the order in which autograd would add up their losses.
            self._check("encoder", self._backward(list(reversed(self._gradients.values()))))
            optimizer.step()
        self._forget()

    def _backward(self, gradients: Sequence[dict[str, th.Tensor]], retain_graph: bool = False) -> list[th.Tensor]:
        """Send the sums of gradients at the latents back to the encoder, and return its parameters' gradients."""
        for parameter in self._parameters:
            parameter.grad = None
        names = [name for name in self._latents if any(name in each for each in gradients)]
        totals: Any = [sum(each[name] for each in gradients if name in each) for name in names]
        th.autograd.backward([self._latents[name] for name in names], totals, retain_graph=retain_graph)
        return [parameter.grad for parameter in self._parameters if parameter.grad is not None]

    def _measure_shares(self) -> None:
        """Log the norm of each source's scaled gradient at the encoder's parameters (0 without one), and its share."""
        norms = {
            source: _norm(self._backward([gradients], retain_graph=True))
            for source, gradients in self._gradients.items()
        }
        total = th.stack(list(norms.values())).sum().clamp(min=1e-30)
        for source in self.mean_squares:
            norm = norms.get(source, th.zeros_like(total))
            self.metrics |= {f"encoder_grad_norm_{source}": norm, f"encoder_share_{source}": norm / total}

    def _forget(self) -> None:
        """Drop what depends on the encoder's parameters."""
        self._features: dict[str, Any] = {}
        self._latents: dict[str, th.Tensor] = {}
        self._leaves: dict[str, dict[str, th.Tensor]] = {}
        self._gradients: dict[str, dict[str, th.Tensor]] = {}

    def _reset(self, views: Mapping[str, Callable[[], Any]]) -> None:
        """Set the views of an update; after it there are none, because tensors with a graph cannot be deep-copied."""
        self._views = {name: cache(make) for name, make in views.items()}
        self._target_latents: dict[str, th.Tensor] = {}
        self._forget()

    # ---------------------------------------------------------------- saving

    def state_dict(self) -> dict[str, Any]:
        """Get the states of the optimisers and the running sizes of the gradients.

        :return: Nested dictionaries of tensors and numbers
        """
        return {
            "optimizers": {name: optimizer.state_dict() for name, optimizer in self.optimizers.items()},
            "mean_squares": {source: value.clone() for source, value in self.mean_squares.items()},
            "total_weights": dict(self.total_weights),
            "n_updates": self._n_updates,
        }

    def load_state_dict(self, state: dict[str, Any], strict: bool = True) -> None:
        """Load what ``state_dict`` has returned.

        :param state: Result of ``state_dict``
        :param strict: Whether a state of other sources or of the other mode is an error (else it is skipped)
        :raises RuntimeError: if ``strict`` and the state belongs to another mode or other sources
        """
        if any(state[part].keys() != getattr(self, part).keys() for part in ("optimizers", "mean_squares")):
            if not strict:
                return
            # As torch's own load_state_dict; SB3's `load` takes a ValueError as the sign of an archive of an old DQN.
            raise RuntimeError(
                f"the saved encoder was trained by {sorted(state['mean_squares'])} with optimisers "
                f"{sorted(state['optimizers'])}, this one by {sorted(self.mean_squares)} with "
                f"{sorted(self.optimizers)}: load with the update=, srl= and curiosity= it was trained with."
            )
        for name, optimizer in self.optimizers.items():
            optimizer.load_state_dict(state["optimizers"][name])
        self.mean_squares = {source: value.clone() for source, value in state["mean_squares"].items()}
        self.total_weights, self._n_updates = dict(state["total_weights"]), state["n_updates"]


def _norm(tensors: Iterable[th.Tensor]) -> th.Tensor:
    return th.stack(th._foreach_norm(list(tensors))).norm()
