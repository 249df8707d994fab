"""Decoders: what is drawn from latents, and how far it is from what was to be drawn."""

from collections.abc import Callable

import torch as th
from torch import nn

from sb3_cure.networks.fast_ops import SquaredError, conv_transpose_cells, from_cells, to_cells
from sb3_cure.networks.layers import ConvTranspose2dReLU, FullPrecision, conv_sizes, init_weights


class PixelDecoder(nn.Module):
    """The mirror image of ``PixelEncoder``: a linear map, transposed 3x3 convolutions, the last one with stride 2.

    :param latent_dim: Size of the latent state
    :param shape: Shape of the observation to draw, (C, H, W)
    :param n_filters: Channels of the hidden layers
    :param n_layers: Number of transposed convolutions
    """

    def __init__(self, latent_dim: int, shape: tuple[int, ...], n_filters: int = 32, n_layers: int = 4):
        super().__init__()
        sizes = conv_sizes(shape[1], shape[2], n_layers)
        self.first_shape = (*sizes[-1], n_filters)
        self.linear = nn.Linear(latent_dim, n_filters * sizes[-1][0] * sizes[-1][1])
        self.hidden = nn.Sequential(*(ConvTranspose2dReLU(n_filters, n_filters, 3) for _ in range(n_layers - 1)))
        self.output = nn.ConvTranspose2d(n_filters, shape[0], 3, stride=2)
        self.shape = shape
        init_weights(self)
        self.to(memory_format=th.channels_last)  # type: ignore[call-overload]

    def forward(self, latents: th.Tensor, as_cells: bool = False) -> th.Tensor:
        """
        :param latents: [B, latent_dim]
        :param as_cells: Whether to return them as ``to_cells`` does, as they are drawn; for even sizes
        :return: Images in the target's scale, about [-0.5, 0.5], [B, C, H, W]
        """
        hidden = th.relu(self.linear(latents)).view(-1, *self.first_shape)
        # The linear map writes NHWC, which the convolutions read without a copy.
        hidden = self.hidden(hidden.permute(0, 3, 1, 2))
        cells = conv_transpose_cells(hidden, self.output.weight, self.output.bias)  # type: ignore[arg-type]
        return cells if as_cells else from_cells(cells)[..., : self.shape[1], : self.shape[2]]


class VectorDecoder(FullPrecision):
    """One hidden layer from latents [B, latent_dim] to a flat observation [B, out_dim]; in fp32, as its target is.

    :param latent_dim: Size of the latents
    :param out_dim: Size of the flat observation
    :param hidden_dim: Units of the hidden layer
    """

    def __init__(self, latent_dim: int, out_dim: int, hidden_dim: int = 256):
        super().__init__(nn.Linear(latent_dim, hidden_dim), nn.ReLU(), nn.Linear(hidden_dim, out_dim))
        init_weights(self)


def squared_error(
    decoder: nn.Module, latents: th.Tensor, seen: th.Tensor, target: Callable[[th.Tensor], th.Tensor]
) -> th.Tensor:
    """
    :param decoder: Draws images [B, C, H, W] or vectors [B, n] from latents
    :param latents: [B, latent_dim]
    :param seen: What is to be drawn, as stored, [B, *shape]
    :param target: Makes of it what the decoder is to return, pixel by pixel, fp32
    :return: Mean squared error of each, fp32, [B]
    """
    if isinstance(decoder, PixelDecoder) and not (seen.shape[2] % 2 or seen.shape[3] % 2):
        drawn, seen = decoder(latents, as_cells=True), to_cells(seen)  # compared as it is drawn
    else:
        drawn = decoder(latents)
    goal = target(seen)
    if drawn.dim() == 4:
        return SquaredError.apply(drawn, goal)  # type: ignore[no-any-return]
    return (drawn - goal).square().mean(dim=1)
