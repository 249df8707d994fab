"""Building blocks of encoders, decoders, actors and critics."""

from collections.abc import Iterable, Sequence
from typing import Any, TypeVar

import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_flattened_obs_dim, preprocess_obs
from stable_baselines3.common.torch_layers import create_mlp
from torch import nn
from torch.nn import functional as F

from sb3_cure.networks.fast_ops import convolve

ModuleT = TypeVar("ModuleT", bound=nn.Module)

#: Hidden layers of actors and critics with at least this many weights may compute in bf16: with fewer, casting costs
#: more than bf16 gains
WIDE = 2**16


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
    """Do ``module.train(training)``, faster, as SB3 calls it several times per step.

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
    """Compute the sizes along a stack of 3x3 convolutions without padding, the first of stride 2.

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


def most_layers(height: int, width: int) -> int:
    """Compute how many convolutions of ``conv_sizes`` an image allows.

    :param height: Height of the image, pixels
    :param width: Width of the image, pixels
    :return: Number of convolutions
    """
    return (min(height, width) + 1) // 4


def scale_images(images: th.Tensor, dtype: th.dtype = th.float32) -> th.Tensor:
    """Convert images from bytes to [0, 1]; leave floats, which are in [0, 1] already, as they are.

    :param images: uint8 in 0-255, or floats in [0, 1], any shape
    :param dtype: Number format for bytes; 0-255 is exact in bf16, too
    :return: Images in [0, 1]
    """
    return images.to(dtype).div_(255) if images.dtype == th.uint8 else images


def flatten_vectors(observations: Any, observation_space: spaces.Space) -> th.Tensor:
    """Flatten an observation without images into one vector, with discrete values one-hot.

    :param observations: As stored, [B, *shape], or a dictionary of them
    :param observation_space: Their space; of a dictionary only its keys are read
    :return: fp32, [B, n]
    """
    if isinstance(observation_space, spaces.Dict):
        parts = [flatten_vectors(observations[key], part) for key, part in observation_space.spaces.items()]
        return th.cat(parts, dim=1)
    return preprocess_obs(observations, observation_space).float().flatten(1)  # type: ignore[union-attr]


class MixedPrecision(nn.Module):
    """Base class of modules that compute in bf16 within ``compute_in``, with weights and results for losses in fp32."""

    #: Number format of the expensive layers, set by ``precision.compute_in``
    compute_dtype: th.dtype = th.float32


class Linear(nn.Linear):
    """Linear map in the number format of its input."""

    def forward(self, inputs: th.Tensor) -> th.Tensor:
        """Apply the linear map.

        :param inputs: [..., in_features]
        :return: [..., out_features]
        """
        return F.linear(inputs, self.weight.to(inputs.dtype), self.bias.to(inputs.dtype))


class EnsembleLinear(nn.Module):
    """Linear maps of several networks as one product, initialised orthogonally.

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
        """Apply each network's map to its input.

        :param inputs: [n, B, in_features]
        :return: [n, B, out_features]
        """
        return th.baddbmm(self.bias, inputs, self.weight)


class EnsembleNorm(nn.Module):
    """LayerNorm of several networks side by side, each with a scale and a shift of its own.

    :param n: Number of networks
    :param features: Size of each input
    """

    def __init__(self, n: int, features: int):
        super().__init__()
        self.weight = nn.Parameter(th.ones(n, 1, features))
        self.bias = nn.Parameter(th.zeros(n, 1, features))

    def forward(self, inputs: th.Tensor) -> th.Tensor:
        """Normalise each network's input.

        :param inputs: [n, B, features]
        :return: The same shape
        """
        return th.addcmul(self.bias, F.layer_norm(inputs, inputs.shape[-1:]), self.weight)


class ResidualBlock(nn.Module):
    """Residual block of several networks side by side, as in SimBa and BRO: ``x + MLP(LayerNorm(x))``.

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
        """Add the branch to its input.

        :param inputs: [n, B, features]
        :return: The same shape
        """
        return inputs + self.branch(inputs)


def small_mlp(n_inputs: int, n_outputs: int, hidden_dim: int = 256) -> nn.Sequential:
    """Make a perceptron with one hidden layer.

    :param n_inputs: Size of the input
    :param n_outputs: Size of the output
    :param hidden_dim: Units of the hidden layer
    :return: The layers
    """
    return init_weights(nn.Sequential(*create_mlp(n_inputs, n_outputs, [hidden_dim])))


def run_mlp(layers: Iterable[nn.Module], inputs: th.Tensor, dtype: th.dtype = th.float32) -> th.Tensor:
    """Run an actor or critics, with wide hidden layers in the given number format and the rest in fp32.

    The first layer reads latents and actions: in bf16 the actions .500 and .501 are equal. The last one returns values
    and means, which need more than bf16's three digits, too.

    :param layers: Linear maps and activations
    :param inputs: Latents, with or without actions, fp32, [..., B, n]
    :param dtype: Number format of wide hidden layers
    :return: Output of the last layer, fp32
    """
    layers = list(layers)
    for i, layer in enumerate(layers):
        weight = getattr(layer, "weight", None)
        if weight is None:
            inputs = layer(inputs)
        elif dtype == th.float32 or weight.numel() < WIDE or i in (0, len(layers) - 1):
            inputs = layer(inputs.float())
        else:
            with th.autocast(inputs.device.type, dtype):
                inputs = layer(inputs)
    return inputs.float()


class Conv2dReLU(nn.Conv2d):
    """torch's convolution without padding and a ReLU, in the number format of the images."""

    def forward(self, images: th.Tensor) -> th.Tensor:
        """Apply convolution and ReLU.

        :param images: In NHWC memory order, [B, in_channels, H, W]
        :return: [B, out_channels, H', W']
        """
        return convolve(images, self.weight, self.bias, self.stride[0], relu=True)


class ConvTranspose2dReLU(nn.ConvTranspose2d):
    """torch's transposed convolution of stride 1 and a ReLU, in the number format of the images."""

    def forward(self, images: th.Tensor) -> th.Tensor:  # type: ignore[override]
        """Apply transposed convolution and ReLU.

        :param images: In NHWC memory order, [B, in_channels, H, W]
        :return: [B, out_channels, H', W']
        """
        return convolve(images, self.weight, self.bias, transposed=True, relu=True)


class FlattenImage(nn.Module):
    """[B, C, H, W] to [B, H * W * C]: the memory order of NHWC kernels, so that nothing is copied."""

    def forward(self, images: th.Tensor) -> th.Tensor:
        """Flatten images.

        :param images: [B, C, H, W]
        :return: [B, H * W * C]
        """
        return images.permute(0, 2, 3, 1).flatten(1)


class Convolutions(MixedPrecision, nn.Sequential):
    """Convolutions and activations that read images and compute in ``compute_dtype``."""

    def forward(self, images: th.Tensor) -> th.Tensor:
        """Run the layers.

        :param images: uint8 in 0-255, scaled to [0, 1] here, or floats as they are, [B, C, H, W]
        :return: Output of the last layer, in ``compute_dtype``
        """
        # Reordered while still one byte per value.
        images = scale_images(images.contiguous(memory_format=th.channels_last), self.compute_dtype)
        if self.compute_dtype == th.float32:
            return super().forward(images)
        # Our layers follow the format of their input; torch's own need autocast.
        with th.autocast(images.device.type, self.compute_dtype):
            return super().forward(images.to(self.compute_dtype))


class Projection(nn.Module):
    """Linear map, LayerNorm and (by default) tanh: trunk features [B, in_dim] to latents [B, out_dim].

    :param in_dim: Size of the trunk's features
    :param out_dim: Size of the latent state
    :param tanh: Whether latents are squashed into (-1, 1) (SAC-AE, DrQ); CURL's code leaves it out
    :raises ValueError: if there are too few latents for LayerNorm
    """

    def __init__(self, in_dim: int, out_dim: int, tanh: bool = True):
        super().__init__()
        if out_dim < 3:
            raise ValueError(
                f"features_dim={out_dim} is too small: LayerNorm turns one latent into a constant and two into their "
                "order. Use at least 3."
            )
        self.linear = Linear(in_dim, out_dim)
        self.norm = nn.LayerNorm(out_dim)
        self.tanh = tanh

    def forward(self, features: th.Tensor) -> th.Tensor:
        """Project features to latents.

        :param features: fp32 or, of convolutions in mixed precision, bf16, [B, in_dim]
        :return: Latents, fp32, [B, out_dim]
        """
        projected = self.linear(features)
        # Only bf16 is widened, so that networks in fp64 stay in fp64.
        latents = self.norm(projected.float() if projected.dtype == th.bfloat16 else projected)
        return th.tanh(latents) if self.tanh else latents


@th.no_grad()
def move_average(average: th.Tensor, weight: th.Tensor, value: th.Tensor, decay: float) -> None:
    """Update an exponential average that starts at zero: divided by its total weight it is unbiased, as in Adam.

    A value that is not finite changes nothing.

    :param average: Changed in place, any shape
    :param weight: Its total weight, changed in place, []
    :param value: The same shape as the average
    :param decay: Weight of the past
    """
    rate = (1 - decay) * value.isfinite().all()
    average.lerp_(value.nan_to_num(), rate)
    weight.lerp_(th.ones_like(weight), rate)


class RunningStandardize(nn.Module):
    """Flattens vectors and standardises each entry by running statistics, so that units do not matter.

    ``forward`` only reads the statistics; ``update`` moves them. An entry without variation becomes 0.

    :param observation_space: Space of the vectors: any space without images that SB3 can flatten, or a dictionary
    :param decay: Weight of the past in the running statistics, per update
    :param clip: Standardised entries are clipped to [-clip, clip]
    """

    mean: th.Tensor
    variance: th.Tensor
    weight: th.Tensor

    def __init__(self, observation_space: spaces.Space, decay: float = 0.999, clip: float = 10.0):
        super().__init__()
        self.observation_space = observation_space
        self.decay = decay
        self.clip = clip
        n = get_flattened_obs_dim(observation_space)
        self.register_buffer("mean", th.zeros(n))
        self.register_buffer("variance", th.ones(n))
        self.register_buffer("weight", th.zeros(n))

    @th.no_grad()
    def update(self, observations: Any) -> None:
        """Move the statistics towards those of a batch.

        :param observations: As stored, [B, *shape], or a dictionary of them
        """
        vectors = flatten_vectors(observations, self.observation_space)
        mean, variance = vectors.mean(dim=0), vectors.var(dim=0, correction=0)
        finite = (mean + variance).isfinite()
        weight = self.weight + (1 - self.decay) * (1 - self.weight)
        # 1 at first, then about 1 / 2, 1 / 3, ... down to 1 - decay: averages without the bias of their initial values.
        rate = (1 - self.decay) / weight
        shift = mean - self.mean
        spread = (1 - rate) * (self.variance + rate * shift.square()) + rate * variance
        self.mean.copy_(th.where(finite, self.mean + rate * shift, self.mean))
        self.variance.copy_(th.where(finite, spread, self.variance))
        self.weight.copy_(th.where(finite, weight, self.weight))

    def forward(self, observations: Any) -> th.Tensor:
        """Standardise observations.

        :param observations: As stored, [B, *shape], or a dictionary of them
        :return: fp32, [B, n]
        """
        deviation = self.variance.sqrt()
        # A deviation below 1e-6 of an entry's size is rounding (float32 rounds at 6e-8 of it).
        scale = th.where(deviation > 1e-6 * self.mean.abs(), 1 / deviation, 0.0)
        vectors = flatten_vectors(observations, self.observation_space)
        return ((vectors - self.mean) * scale).clamp(-self.clip, self.clip)


class MeanError(nn.Module):
    """Mean over sensors of their errors, each divided by its running size; one sensor's error stays as it is.

    Without it the sensor with the largest errors would decide which states are worth visiting. The size is the root
    mean square, not the standard deviation, which would amplify a sensor whose errors are nearly constant.

    :param n: Number of sensors
    """

    #: Weight of the past in the running mean squares, per update
    decay = 0.99

    mean_squares: th.Tensor
    weight: th.Tensor

    def __init__(self, n: int):
        super().__init__()
        self.register_buffer("mean_squares", th.zeros(n))
        self.register_buffer("weight", th.zeros(()))

    @th.no_grad()
    def forward(self, errors: Sequence[th.Tensor], learns: bool) -> th.Tensor:
        """Average the errors.

        :param errors: Of each sensor, [B]
        :param learns: Whether to update the running sizes
        :return: [B]
        """
        if len(errors) == 1:
            return errors[0].detach()
        each = th.stack([error.detach().float() for error in errors])
        if learns:
            move_average(self.mean_squares, self.weight, each.square().mean(dim=1), self.decay)
        seen = self.weight > 0  # before the first average, nothing is divided
        sizes = (self.mean_squares / self.weight.clamp(min=1e-12)).sqrt().clamp(min=1e-12)
        return (each / th.where(seen, sizes, 1.0)[:, None]).mean(dim=0)
