"""Decoders, and the error of what they draw."""

from collections.abc import Callable

import torch as th
from torch import nn

from sb3_cure.networks.fast_ops import SquaredError, conv_transpose_cells, from_cells, to_cells
from sb3_cure.networks.layers import ConvTranspose2dReLU, Linear, MixedPrecision, conv_sizes, init_weights


class PixelDecoder(MixedPrecision):
    """Mirror image of ``PixelEncoder``: a linear map and transposed 3x3 convolutions, the last with stride 2.

    :param latent_dim: Size of the latent state
    :param shape: Shape of the images to draw, (C, H, W)
    :param n_filters: Channels of the hidden layers
    :param n_layers: Number of transposed convolutions
    """

    def __init__(self, latent_dim: int, shape: tuple[int, ...], n_filters: int = 32, n_layers: int = 4):
        super().__init__()
        sizes = conv_sizes(shape[1], shape[2], n_layers)
        self.first_shape = (*sizes[-1], n_filters)
        self.linear = Linear(latent_dim, n_filters * sizes[-1][0] * sizes[-1][1])
        self.hidden = nn.Sequential(*(ConvTranspose2dReLU(n_filters, n_filters, 3) for _ in range(n_layers - 1)))
        self.output = nn.ConvTranspose2d(n_filters, shape[0], 3, stride=2)
        self.shape = shape
        init_weights(self)
        self.to(memory_format=th.channels_last)  # type: ignore[call-overload]

    def forward(self, latents: th.Tensor, as_cells: bool = False) -> th.Tensor:
        """Draw images from latents.

        :param latents: [B, latent_dim]
        :param as_cells: Whether to return ``to_cells`` of the images, the form in which they are computed; needs an
            even height and width
        :return: Images in the target's scale, about [-0.5, 0.5], in ``compute_dtype``, [B, C, H, W]
        """
        if self.compute_dtype != th.float32:
            latents = latents.to(self.compute_dtype)
        hidden = th.relu(self.linear(latents)).view(-1, *self.first_shape)
        # The linear map writes NHWC, which the convolutions read without a copy.
        hidden = self.hidden(hidden.permute(0, 3, 1, 2))
        cells = conv_transpose_cells(hidden, self.output.weight, self.output.bias)  # type: ignore[arg-type]
        return cells if as_cells else from_cells(cells)[..., : self.shape[1], : self.shape[2]]


def squared_error(
    decoder: nn.Module, latents: th.Tensor, observations: th.Tensor, target: Callable[[th.Tensor], th.Tensor]
) -> th.Tensor:
    """Compute the mean squared error of each observation that a decoder draws.

    :param decoder: Draws images [B, C, H, W] or vectors [B, n] from latents
    :param latents: [B, latent_dim]
    :param observations: Observations to draw, as stored, [B, *shape]
    :param target: Function from observations to the decoder's targets, pixel by pixel, fp32
    :return: fp32, [B]
    """
    if isinstance(decoder, PixelDecoder) and not (observations.shape[2] % 2 or observations.shape[3] % 2):
        # Compared in the form in which they are drawn, which saves a pass.
        drawn, observations = decoder(latents, as_cells=True), to_cells(observations)
    else:
        drawn = decoder(latents)
    expected = target(observations)
    if drawn.dim() == 4:
        return SquaredError.apply(drawn, expected)  # type: ignore[no-any-return]
    return (drawn - expected).square().mean(dim=1)
