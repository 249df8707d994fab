"""Networks of intrinsic rewards, and how they see observations."""

import itertools
import math
from collections.abc import Iterable

import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_flattened_obs_dim, is_image_space
from torch import nn

from sb3_cure.networks.layers import Convolutions, FlattenImage, flatten_vectors

#: Variance of uniform noise within a step of 1/32, the dither of 5-bit images (SAC-AE), for pixels in [0, 1]: pixels
#: that vary less count as constant
DITHER = 8.1e-5


def scaled(observations: th.Tensor, space: spaces.Space) -> th.Tensor:
    """Scale stored observations for a network of ``make_network``.

    :param observations: As stored, [B, *shape]
    :param space: Their space
    :return: Images in [-0.5, 0.5] in NHWC memory order, [B, C, H, W]; anything else as a vector, [B, n]
    """
    if is_image_space(space):
        return observations.contiguous(memory_format=th.channels_last).float().div_(255).sub_(0.5)
    return flatten_vectors(observations, space)


class MLP(nn.Sequential):
    """Linear maps with ReLUs in between, in fp32.

    :param sizes: Of the input, the hidden layers and the output
    """

    def __init__(self, sizes: Iterable[int]):
        layers = [layer for pair in itertools.pairwise(sizes) for layer in (nn.Linear(*pair), nn.ReLU())]
        super().__init__(*layers[:-1])
        init(self)

    def forward(self, inputs: th.Tensor) -> th.Tensor:
        """Run the layers.

        :param inputs: [B, n]
        :return: fp32, [B, m]
        """
        return super().forward(inputs.float())


def make_network(space: spaces.Space, sizes: Iterable[int], n_filters: int = 16) -> nn.Sequential:
    """Make a network for inputs as ``scaled`` returns them: of images three convolutions of stride 2, then an ``MLP``.

    :param space: Space of the observations
    :param sizes: Of the hidden layers and the output
    :param n_filters: Channels of the convolutions
    :return: The network
    """
    if not is_image_space(space):
        return MLP([get_flattened_obs_dim(space), *sizes])
    channels, *size = space.shape  # type: ignore[misc]
    layers: list[nn.Module] = []
    for _ in range(3):
        layers += [nn.Conv2d(channels, n_filters, 3, stride=2, padding=1), nn.ReLU(inplace=True)]
        channels, size = n_filters, [(side + 1) // 2 for side in size]
    convolutions = init(Convolutions(*layers, FlattenImage()))
    network = nn.Sequential(convolutions, MLP([n_filters * math.prod(size), *sizes]))
    return network.to(memory_format=th.channels_last)  # type: ignore[call-overload, no-any-return]


def init(network: nn.Sequential) -> nn.Sequential:
    """Initialise layers in place: orthogonal weights of gain sqrt(2), as in RND's code, and biases of 0.

    Unlike ``init_weights``, this initialises all taps of a kernel, not only the central one.

    :param network: Linear maps and convolutions
    :return: The same network
    """
    for layer in network:
        if isinstance(layer, nn.Linear | nn.Conv2d):
            nn.init.orthogonal_(layer.weight, math.sqrt(2))
            nn.init.zeros_(layer.bias)  # type: ignore[arg-type]
    return network
