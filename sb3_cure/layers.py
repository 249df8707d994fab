"""Building blocks of the encoder, the decoder, the actors and the critics."""

import contextlib
from collections.abc import Iterable, Sequence
from functools import partial
from typing import Any, TypeVar

import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space, preprocess_obs
from torch import nn
from torch.nn import functional as F

from sb3_cure.fast_ops import convolve

ModuleT = TypeVar("ModuleT", bound=nn.Module)


def init_weights(module: ModuleT) -> ModuleT:
    """Initialise in place as SAC-AE does: orthogonal linear maps, delta-orthogonal convolutions of gain sqrt(2).

    Delta-orthogonal (Xiao et al., 2018): all taps of a kernel are zero but the central one, which is orthogonal.

    :param module: Any module; its linear and convolution layers are initialised, biases become 0
    :return: The same module
    """

    def init(layer: nn.Module) -> None:
        if isinstance(layer, nn.Linear):
            nn.init.orthogonal_(layer.weight)
        elif isinstance(layer, nn.Conv2d | nn.ConvTranspose2d):
            nn.init.zeros_(layer.weight)
            middle = layer.weight.shape[-1] // 2
            nn.init.orthogonal_(layer.weight.data[:, :, middle, middle], nn.init.calculate_gain("relu"))
        else:
            return
        if layer.bias is not None:
            nn.init.zeros_(layer.bias)

    return module.apply(init)


def set_mode(module: nn.Module, training: bool) -> None:
    """``module.train(training)`` in an eighth of the time: SB3 asks for it several times in each step.

    :param module: Any module
    :param training: Whether layers behave as in training
    """
    if type(module).train is not nn.Module.train:
        module.train(training)
        return
    module.__dict__["training"] = training
    for child in module._modules.values():
        if child is not None:
            set_mode(child, training)


def conv_sizes(height: int, width: int, n_layers: int) -> list[tuple[int, int]]:
    """Sizes along a stack of 3x3 convolutions without padding, the first of stride 2.

    :param height: Height of the image, pixels
    :param width: Width of the image, pixels
    :param n_layers: Number of convolutions
    :return: (height, width) of the image and of each layer's output: ``n_layers + 1`` pairs
    :raises ValueError: if the image is too small
    """
    smallest = 4 * n_layers - 1
    if min(height, width) < smallest:
        raise ValueError(
            f"observations of {height}x{width} pixels are too small for {n_layers} convolutions, which need at least "
            f"{smallest}x{smallest}: use larger images, or fewer layers (n_layers in features_extractor_kwargs)."
        )
    sizes = [(height, width), ((height - 3) // 2 + 1, (width - 3) // 2 + 1)]
    for _ in range(n_layers - 1):
        sizes.append((sizes[-1][0] - 2, sizes[-1][1] - 2))
    return sizes


def preprocess(observations: Any, observation_space: spaces.Space) -> Any:
    """SB3's preprocessing (images divided by 255, discrete values one-hot), images in the cheapest way.

    :param observations: Observations as stored, [B, *shape], or a dictionary of them
    :param observation_space: Their space (only its kind matters, so crops are welcome)
    :return: Input of the encoder; images in [0, 1], in NHWC memory order and, within autocast, in its number format
    """
    if isinstance(observation_space, spaces.Dict):
        return {key: preprocess(observations[key], part) for key, part in observation_space.spaces.items()}
    if not is_image_space(observation_space):
        return preprocess_obs(observations, observation_space)
    device = observations.device.type
    dtype = th.get_autocast_dtype(device) if th.is_autocast_enabled(device) else th.float32
    # Reordered while still one byte per value; all of 0-255 is exact in bfloat16.
    images = observations.contiguous(memory_format=th.channels_last).to(dtype)
    # Floats may still be the caller's own.
    return images / 255 if observations.is_floating_point() else images.div_(255)


def full_precision(tensor: th.Tensor) -> contextlib.AbstractContextManager[Any]:
    """Context in which autocast is off: output layers, log-probabilities, targets and losses stay fp32."""
    device = tensor.device.type
    # Where it is off, entering one more context would cost as much as a small operation, dozens of times in an update.
    return th.autocast(device, enabled=False) if th.is_autocast_enabled(device) else contextlib.nullcontext()


class FullPrecision(nn.Sequential):
    """Modules that compute in fp32 within autocast, too: they read vectors, of which bf16 keeps three digits."""

    def forward(self, inputs: th.Tensor) -> th.Tensor:
        """
        :param inputs: What the first module reads
        :return: What the last module returns
        """
        with full_precision(inputs):
            return super().forward(inputs)


#: Weights from which on a layer of an actor or a critic is computed in bf16: below, casting costs what bf16 gains
WIDE = 2**16


class EnsembleLinear(nn.Module):
    """Linear maps of several networks, side by side, as one product; orthogonal at first.

    :param n: Number of networks
    :param in_features: Size of each input
    :param out_features: Size of each output
    """

    def __init__(self, n: int, in_features: int, out_features: int):
        super().__init__()
        self.weight = nn.Parameter(
            th.stack([nn.init.orthogonal_(th.empty(in_features, out_features)) for _ in range(n)])
        )
        self.bias = nn.Parameter(th.zeros(n, 1, out_features))

    def forward(self, inputs: th.Tensor) -> th.Tensor:
        """
        :param inputs: [n, B, in_features]
        :return: [n, B, out_features]
        """
        return th.baddbmm(self.bias, inputs, self.weight)


class EnsembleNorm(nn.Module):
    """LayerNorm of several networks, side by side, each with a scale and a shift of its own.

    :param n: Number of networks
    :param features: Size of each input
    """

    def __init__(self, n: int, features: int):
        super().__init__()
        self.weight = nn.Parameter(th.ones(n, 1, features))
        self.bias = nn.Parameter(th.zeros(n, 1, features))

    def forward(self, inputs: th.Tensor) -> th.Tensor:
        """
        :param inputs: [n, B, features]
        :return: The same shape
        """
        return th.addcmul(self.bias, F.layer_norm(inputs, inputs.shape[-1:]), self.weight)


class ResidualBlock(nn.Module):
    """What SimBa and BRO stack in their critics, of several networks side by side: ``x + MLP(LayerNorm(x))``.

    :param n: Number of networks
    :param features: Size of each input and output
    :param hidden: Units of the MLP's hidden layer
    :param activation_fn: Activation function
    """

    def __init__(self, n: int, features: int, hidden: int, activation_fn: type[nn.Module]):
        super().__init__()
        self.branch = nn.Sequential(
            EnsembleNorm(n, features),
            EnsembleLinear(n, features, hidden),
            activation_fn(),
            EnsembleLinear(n, hidden, features),
        )

    def forward(self, inputs: th.Tensor) -> th.Tensor:
        """
        :param inputs: [n, B, features]
        :return: The same shape
        """
        return inputs + self.branch(inputs)


def run_mlp(layers: Iterable[nn.Module], inputs: th.Tensor) -> th.Tensor:
    """Run an actor or critics: within autocast, too, everything but wide hidden layers in fp32.

    The first layer sees latents and actions: of bf16's digits, actions .500 and .501 are one. The last one gives values
    and means, which need more digits, too.

    :param layers: Linear maps, activations and, in fp32, ``ResidualBlock``
    :param inputs: Latents, with or without actions, [..., B, n]
    :return: Output of the last layer, fp32
    """
    layers, device = list(layers), inputs.device.type
    fast = partial(th.autocast, device, th.get_autocast_dtype(device), th.is_autocast_enabled(device))
    with full_precision(inputs):
        for i, layer in enumerate(layers):
            if 0 < i < len(layers) - 1 and getattr(layer, "weight", inputs[:0]).numel() >= WIDE:
                with fast():
                    inputs = layer(inputs)
            elif i == 0 or isinstance(layer, nn.Linear | EnsembleLinear):
                inputs = layer(inputs.float())
            else:
                inputs = layer(inputs)
        return inputs.float()


class Conv2dReLU(nn.Conv2d):
    """torch's convolution without padding, and a ReLU."""

    def forward(self, images: th.Tensor) -> th.Tensor:
        """
        :param images: In NHWC memory order, [B, in_channels, H, W]
        :return: [B, out_channels, H', W']
        """
        return convolve(images, self.weight, self.bias, self.stride[0], relu=True)


class ConvTranspose2dReLU(nn.ConvTranspose2d):
    """torch's transposed convolution of stride 1, and a ReLU."""

    def forward(self, images: th.Tensor, output_size: list[int] | None = None) -> th.Tensor:
        """
        :param images: In NHWC memory order, [B, in_channels, H, W]
        :param output_size: Must be None
        :return: [B, out_channels, H', W']
        """
        return convolve(images, self.weight, self.bias, transposed=True, relu=True)


class FlattenImage(nn.Module):
    """[B, C, H, W] to [B, H * W * C]: the order in memory of NHWC kernels, so that nothing is copied."""

    def forward(self, images: th.Tensor) -> th.Tensor:
        return images.permute(0, 2, 3, 1).flatten(1)


class Projection(nn.Module):
    """Linear map, LayerNorm and (by default) tanh: trunk features [B, in_dim] to latents [B, out_dim].

    :param in_dim: Size of the trunk's features
    :param out_dim: Size of the latent state
    :param tanh: Whether latents are squashed into (-1, 1) (SAC-AE, DrQ); CURL's code leaves it out
    :raises ValueError: if there are too few latents to be normalised
    """

    def __init__(self, in_dim: int, out_dim: int, tanh: bool = True):
        super().__init__()
        if out_dim < 3:  # of one number LayerNorm leaves a constant, of two only which of them is larger
            raise ValueError(f"features_dim is {out_dim}, of which LayerNorm leaves nothing to learn: use at least 3.")
        self.linear = nn.Linear(in_dim, out_dim)
        self.norm = nn.LayerNorm(out_dim)
        self.tanh = tanh

    def forward(self, features: th.Tensor) -> th.Tensor:
        # Convolutions within autocast pass bf16 on; features of vectors are fp32, and stay so.
        with full_precision(features) if features.dtype == th.float32 else contextlib.nullcontext():
            projected = self.linear(features)
        with full_precision(projected):
            latents = self.norm(projected.float())
            return th.tanh(latents) if self.tanh else latents


class VectorNorm(nn.Module):
    """LayerNorm of a vector [B, n] beside the constants 1 and -1, to [B, n + 2].

    LayerNorm takes the mean and the size of what it is given away: of one joint nothing would be left, of a robot at
    rest as much as of one that moves. Beside two constants both can be read from what these have become.

    :param n: Size of the vector
    """

    def __init__(self, n: int):
        super().__init__()
        self.norm = nn.LayerNorm(n + 2)

    def forward(self, vectors: th.Tensor) -> th.Tensor:
        with full_precision(vectors):
            ones = th.ones_like(vectors[:, :1])
            return self.norm(th.cat([vectors, ones, -ones], dim=1))


class MeanError(nn.Module):
    """Mean over sensors of their errors, each divided by its running deviation; that of one sensor stays as it is.

    Without it the sensor whose errors are the largest numbers would decide what is worth visiting.

    :param n: Number of sensors
    :param decay: Weight of the past in the running variances, per update
    """

    variances: th.Tensor
    weight: th.Tensor

    def __init__(self, n: int, decay: float = 0.99):
        super().__init__()
        self.decay = decay
        self.register_buffer("variances", th.zeros(n))
        self.register_buffer("weight", th.zeros(()))

    @th.no_grad()
    def forward(self, errors: Sequence[th.Tensor], learns: bool) -> th.Tensor:
        """
        :param errors: Of each sensor, [B]
        :param learns: Whether the running variances follow
        :return: [B]
        """
        if len(errors) == 1:
            return errors[0].detach()
        each = th.stack([error.detach().float() for error in errors])
        if learns:
            # As of rewards: a spread below a thousandth of the errors' size is rounding.
            new = th.maximum(each.var(dim=1, correction=0), 1e-6 * each.square().mean(dim=1))
            rate = (1 - self.decay) * new.isfinite().all()
            self.variances.lerp_(new.nan_to_num(), rate)
            self.weight.lerp_(th.ones_like(self.weight), rate)
        # The averages start at zero, which their total weight undoes; before the first of them nothing is divided.
        seen = self.weight > 0
        deviations = (self.variances / self.weight.clamp(min=1e-12)).sqrt().clamp(min=1e-12)
        return (each / th.where(seen, deviations, 1.0)[:, None]).mean(dim=0)
