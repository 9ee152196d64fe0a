"""What a VQGAN is trained on: L1, LPIPS and an adaptive hinge PatchGAN (Esser et al. 2021, eqs. 5 to 7).

All images are [B,C,H,W] in [-1, 1], C 3 for RGB and 1 for depth; every loss is a scalar tensor.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F


def weighted_l1(real_BCHW: Tensor, fake_BCHW: Tensor, moving_BHW: Tensor, moving_weight: float) -> Tensor:
    """Mean absolute error in which a moving pixel counts 1 + `moving_weight` times as much as a still one."""
    weight = 1.0 + moving_weight * moving_BHW[:, None].float()
    error = (real_BCHW - fake_BCHW).abs().mean(dim=1, keepdim=True)
    return (weight * error).sum() / weight.sum()


class PatchDiscriminator(nn.Sequential):
    """Logits [B,1,h,w], one for each overlapping patch of the image (Isola et al. 2017): real high, fake low."""

    def __init__(self, *, filters: int = 64, layers: int = 3, image_channels: int = 3) -> None:
        blocks: list[nn.Module] = [nn.Conv2d(image_channels, filters, 4, 2, 1), nn.LeakyReLU(0.2)]
        channels = filters
        for i in range(1, layers + 1):
            out, stride = filters * min(2**i, 8), 2 if i < layers else 1
            blocks += [nn.Conv2d(channels, out, 4, stride, 1, bias=False), nn.BatchNorm2d(out), nn.LeakyReLU(0.2)]
            channels = out
        super().__init__(*blocks, nn.Conv2d(channels, 1, 4, 1, 1))
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.normal_(module.weight, 0.0, 0.02)
            elif isinstance(module, nn.BatchNorm2d):
                nn.init.normal_(module.weight, 1.0, 0.02)


def discriminator_loss(real_logits: Tensor, fake_logits: Tensor) -> Tensor:
    """Hinge loss of the discriminator."""
    return 0.5 * (F.relu(1.0 - real_logits).mean() + F.relu(1.0 + fake_logits).mean())


def adaptive_weight(reconstruction: Tensor, adversarial: Tensor, last_layer: Tensor) -> Tensor:
    """λ of eq. 7: brings the adversarial gradient at the decoder's last layer to the size of the reconstruction's."""
    (of_reconstruction,) = torch.autograd.grad(reconstruction, last_layer, retain_graph=True)
    (of_adversarial,) = torch.autograd.grad(adversarial, last_layer, retain_graph=True)
    ratio: Tensor = of_reconstruction.norm() / (of_adversarial.norm() + 1e-4)
    return ratio.clamp(0.0, 1e4).detach()
