"""The shared encoder: a trunk that every part of the agent reads, and a projection to the latent state.

Architecture, initialisation and sizes follow SAC-AE (Yarats et al., 2019), which the CuRe paper uses (appendix A).
"""

from collections.abc import Mapping
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_flattened_obs_dim, is_image_space
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from sb3_cure.data.observations import by_key, image_spaces
from sb3_cure.networks.layers import (
    Conv2dReLU,
    FlattenImage,
    FullPrecision,
    Projection,
    VectorNorm,
    conv_sizes,
    full_precision,
    init_weights,
)


class Encoder(BaseFeaturesExtractor):
    """What all encoders share: ``latents = projection(trunk(observation))``.

    Actors read the trunk's features *detached* and own a projection of their own; the critics and the
    state-representation head read the latents and train both parts.

    :param observation_space: Space of one observation
    :param features_dim: Size of the latent state
    :param trunk_dim: Size of the (flat) trunk features
    """

    trunk: nn.Module
    projection: nn.Module

    def __init__(self, observation_space: spaces.Space, features_dim: int, trunk_dim: int):
        super().__init__(observation_space, features_dim)
        self.trunk_dim = trunk_dim

    @property
    def view_space(self) -> spaces.Space:
        """Space of what the encoder sees: the observations', or that of crops of them."""
        return self._observation_space

    def make_projection(self) -> nn.Module:
        """
        :return: A new projection of the trunk's features, such as each actor owns
        """
        return Projection(self.trunk_dim, self.features_dim, getattr(self.projection, "tanh", True))

    def forward(self, observations: Any) -> th.Tensor:
        """
        :param observations: Preprocessed observations, [B, *shape]; images in [0, 1]
        :return: Latents, [B, features_dim]
        """
        return self.projection(self.trunk(observations))


class PixelEncoder(Encoder):
    """3x3 convolutions, the first with stride 2, then a projection (SAC-AE's encoder).

    :param observation_space: Image space, channels first, [C, H, W]
    :param features_dim: Size of the latent state
    :param n_filters: Channels of each convolution
    :param n_layers: Number of convolutions
    :param tanh: Whether latents end in a tanh
    :raises ValueError: if the space is no image or smaller than the convolutions need
    """

    def __init__(
        self,
        observation_space: spaces.Box,
        features_dim: int = 50,
        n_filters: int = 32,
        n_layers: int = 4,
        tanh: bool = True,
    ):
        shape = observation_space.shape
        if len(shape) != 3:
            raise ValueError(
                f"'CnnPolicy' reads images (channels, height, width), but observations have the shape {shape}: use "
                "'MlpPolicy' for vectors, or make_dmc_env / make_pixel_env for pixels."
            )
        height, width = conv_sizes(shape[1], shape[2], n_layers)[-1]
        super().__init__(observation_space, features_dim, trunk_dim=n_filters * height * width)
        self.n_filters = n_filters
        self.n_layers = n_layers
        first = Conv2dReLU(shape[0], n_filters, 3, stride=2)
        further = (Conv2dReLU(n_filters, n_filters, 3) for _ in range(n_layers - 1))
        self.trunk = nn.Sequential(first, *further, FlattenImage())
        self.projection = Projection(self.trunk_dim, features_dim, tanh)
        init_weights(self)
        # NHWC kernels are the fast ones for convolutions on CPU and GPU; the values are the same.
        self.to(memory_format=th.channels_last)  # type: ignore[call-overload]


class VectorEncoder(Encoder):
    """The same split for vectors: one hidden layer as the trunk, then a projection.

    :param observation_space: Any space that SB3 can flatten (Box of rank 1, Discrete, ...)
    :param features_dim: Size of the latent state
    :param hidden_dim: Width of the hidden layer
    :param tanh: Whether latents end in a tanh
    """

    def __init__(
        self, observation_space: spaces.Space, features_dim: int = 50, hidden_dim: int = 256, tanh: bool = True
    ):
        super().__init__(observation_space, features_dim, trunk_dim=hidden_dim)
        inputs = get_flattened_obs_dim(observation_space)
        self.trunk = FullPrecision(nn.Flatten(), nn.Linear(inputs, hidden_dim), nn.ReLU())
        self.projection = Projection(hidden_dim, features_dim, tanh)
        init_weights(self)


class DictTrunk(nn.Module):
    """Features of each image by a trunk of its own, and the vectors as they are, side by side.

    :param trunks: Trunks of the images, by key
    :param vectors: Keys of the vectors
    """

    def __init__(self, trunks: Mapping[str, nn.Module], vectors: list[str]):
        super().__init__()
        self.images, self.vectors = list(trunks), vectors
        self.trunks = nn.ModuleList(trunks.values())

    def forward(self, observations: dict[str, th.Tensor]) -> tuple[th.Tensor, ...]:
        """
        :param observations: Preprocessed observations
        :return: Features of each image, [B, its trunk_dim]; then, if there are any, all vectors as one, fp32, [B, n]
        """
        features = [trunk(observations[key]) for key, trunk in zip(self.images, self.trunks, strict=True)]
        if self.vectors:
            features.append(th.cat([observations[key].flatten(1).float() for key in self.vectors], dim=1))
        return tuple(features)


class DictProjection(nn.Module):
    """What ``DictTrunk`` returns to joined latents: a projection for each image, a LayerNorm for the vectors.

    :param projections: Of the images, in their order
    :param vector_dim: Size of all vectors together; 0: there are none
    """

    def __init__(self, projections: list[nn.Module], vector_dim: int):
        super().__init__()
        norms = [VectorNorm(vector_dim)] if vector_dim else []
        self.parts = nn.ModuleList([*projections, *norms])

    def forward(self, features: tuple[th.Tensor, ...]) -> th.Tensor:
        """
        :param features: Of each part
        :return: Latents, fp32, [B, features_dim]
        """
        return th.cat([part(feature) for part, feature in zip(self.parts, features, strict=True)], dim=1)


class DictEncoder(Encoder):
    """Dictionaries of images and vectors: an encoder for each image, whose latents are joined with the vectors.

    Vectors need no encoder; they are normalised (``VectorNorm``), so that neither part drowns the other.

    :param observation_space: Dictionary with at least one image
    :param by_key: Further arguments of the encoders of some images, by key
    :param kwargs: Arguments of all encoders, as of ``PixelEncoder``; ``features_dim`` is that of each
    """

    def __init__(
        self, observation_space: spaces.Dict, by_key: Mapping[str, Mapping[str, Any]] | None = None, **kwargs: Any
    ):
        found, own = image_spaces(observation_space), by_key or {}
        encoders = {key: PixelEncoder(space, **{**kwargs, **own.get(key, {})}) for key, space in found.items()}
        vectors = {key: space for key, space in observation_space.spaces.items() if key not in found}
        vector_dim = sum(map(get_flattened_obs_dim, vectors.values()))
        sizes = [encoder.features_dim for encoder in encoders.values()]
        super().__init__(
            observation_space,
            sum(sizes) + (vector_dim + 2 if vector_dim else 0),
            sum(encoder.trunk_dim for encoder in encoders.values()) + vector_dim,
        )
        #: Encoders of the images by key. Their modules are those of trunk and projection, which register them
        self.images = encoders
        #: Which of the latents are theirs
        self.slices = {key: slice(sum(sizes[:i]), sum(sizes[: i + 1])) for i, key in enumerate(encoders)}
        self.vector_dim = vector_dim
        self.trunk = DictTrunk({key: encoder.trunk for key, encoder in encoders.items()}, list(vectors))
        self.projection = DictProjection([encoder.projection for encoder in encoders.values()], vector_dim)

    def make_projection(self) -> nn.Module:
        """
        :return: Of the same parts as its own; one linear map of all features would drown the vectors
        """
        return DictProjection([encoder.make_projection() for encoder in self.images.values()], self.vector_dim)


class ExtractorTrunk(nn.Module):
    """An SB3 features extractor, which gets images in the memory order in which SB3 gives them (``view`` works on no
    other), and computes in fp32 if it reads vectors.

    :param extractor: The features extractor
    """

    def __init__(self, extractor: BaseFeaturesExtractor):
        super().__init__()
        self.extractor = extractor
        self._reads_vectors = not is_image_space(extractor._observation_space)

    def forward(self, observations: Any) -> th.Tensor:
        """
        :param observations: Preprocessed observations
        :return: Features, [B, features_dim]
        """
        if not self._reads_vectors:
            return self.extractor(observations.contiguous())  # type: ignore[no-any-return]
        parts = {key: part.float().contiguous() for key, part in by_key(observations).items()}
        with full_precision(next(iter(parts.values()))):
            return self.extractor(parts.get("", parts))  # type: ignore[no-any-return]


class ExtractorEncoder(Encoder):
    """Any SB3 features extractor as the shared encoder: it is the trunk, and its features are the latents.

    :param extractor: The features extractor
    """

    def __init__(self, extractor: BaseFeaturesExtractor):
        super().__init__(extractor._observation_space, extractor.features_dim, trunk_dim=extractor.features_dim)
        self.trunk = ExtractorTrunk(extractor)
        self.projection = nn.Identity()


def make_encoder(
    extractor_class: type[BaseFeaturesExtractor], observation_space: spaces.Space, **kwargs: object
) -> Encoder:
    """Build the shared encoder from SB3's ``features_extractor_class`` and ``features_extractor_kwargs``.

    :param extractor_class: One of ours, or any ``BaseFeaturesExtractor``
    :param observation_space: Space of what the encoder sees (after the head's crop, if it has one)
    :param kwargs: Passed on to the class
    :return: The encoder
    """
    extractor = extractor_class(observation_space, **kwargs)  # type: ignore[arg-type]
    return extractor if isinstance(extractor, Encoder) else ExtractorEncoder(extractor)
