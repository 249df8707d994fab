"""What do the latents know of the image? A decoder fitted afterwards, on a frozen encoder."""

import numpy as np
import torch as th
from torch import nn
from torch.nn import functional as F

from sb3_cure.cure_sac import CuReSAC
from sb3_cure.metrics import image_strip, reconstruction_strip
from sb3_cure.srl import PixelDecoder


def reconstruct_with_probe(
    model: CuReSAC, frame_stack: int, updates: int = 1000, batch_size: int = 64, columns: int = 8
) -> np.ndarray | None:
    """Observations of the replay buffer above what can be drawn from their latents.

    Heads that reconstruct do it themselves. For the others (contrastive ones, say) a decoder is fitted to the latents
    first; the encoder is not trained by it.

    :param model: A trained model with images as observations
    :param frame_stack: Frames per observation
    :param updates: Updates of the decoder
    :param batch_size: Observations per update
    :param columns: How many observations to draw
    :return: uint8 image (C, 2 * H, columns * W), see ``reconstruction_strip``
    """
    policy, buffer = model.policy, model.replay_buffer
    if buffer is None:
        raise ValueError("the model has no replay buffer to take observations from: train it, or load one.")
    shown = buffer.sample(columns)
    strip = reconstruction_strip(policy, shown, frame_stack, columns)
    if strip is not None:
        return strip
    decoder = fit_probe(model, updates, batch_size)
    return image_strip(*draw_with_probe(model, decoder, shown.observations), frame_stack)


def fit_probe(model: CuReSAC, updates: int = 1000, batch_size: int = 64) -> nn.Module:
    """A decoder that draws the encoder's inputs from its latents; the encoder is not trained by it.

    :param model: A trained model with images as observations and a filled replay buffer
    :param updates: Updates of the decoder
    :param batch_size: Observations per update
    :return: The decoder: latents -> images in [-0.5, 0.5]
    """
    policy, buffer = model.policy, model.replay_buffer
    shape = policy.encoder_space.shape or ()
    decoder: nn.Module = PixelDecoder(policy.encoder.features_dim, shape).to(model.device)
    optimizer = th.optim.Adam(decoder.parameters(), lr=1e-3)
    for _ in range(updates):
        observations = buffer.sample(batch_size).observations  # type: ignore[union-attr]
        with th.no_grad():
            images = policy.center(observations)
            latents = policy.encoder(images)
        loss = F.mse_loss(decoder(latents), images - 0.5)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return decoder


@th.no_grad()
def draw_with_probe(model: CuReSAC, decoder: nn.Module, observations: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """
    :param model: The model whose latents are drawn
    :param decoder: Its decoder, of ``fit_probe``
    :param observations: Observations as stored, 0-255, [B, C, H, W]
    :return: What the encoder sees of them (a crop, say) and what is drawn from its latents, both 0-255, [B, C, h, w]
    """
    images = model.policy.center(observations)
    drawn = (decoder(model.policy.encoder(images)) + 0.5).clamp(0, 1)
    return images * 255, drawn * 255
