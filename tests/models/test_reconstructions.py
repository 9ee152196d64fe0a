"""Reconstructions on a CPU: each latent is decoded once, by itself, and never taken for another."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from vilp_models.reconstructions import Reconstructions

IMAGE_BYTES = 4 * 4 * 3


class Decoder:
    """Images whose brightness is the latent's first number times a gain; remembers what it was asked for."""

    device = torch.device("cpu")

    def __init__(self, gain: float = 1.0) -> None:
        self.gain = gain
        self.asked: list[list[float]] = []

    def decode_tensor(self, latents: Tensor) -> Tensor:
        self.asked.append(latents[:, 0, 0, 0].tolist())
        return (latents[:, :1, :1, :1] * self.gain).expand(-1, 4, 4, 3).to(torch.uint8)


def of(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float16).view(-1, 1, 1, 1).expand(-1, 2, 2, 2)


def reconstructions(kept: int = 100, **decoders: Decoder) -> Reconstructions:
    given: Any = decoders
    return Reconstructions(given, kept_bytes=kept * IMAGE_BYTES)


def test_what_comes_again_is_not_decoded_again_and_stays_in_its_place() -> None:
    top = Decoder()
    made = reconstructions(top=top)
    assert made("top", of(1, 2, 1))[:, 0, 0, 0].tolist() == [1, 2, 1]
    images = made("top", of(3, 2))
    assert images[:, 0, 0, 0].tolist() == [3, 2]
    assert (images.shape, images.dtype) == ((2, 4, 4, 3), torch.uint8)
    assert top.asked == [[1], [2], [3]]


def test_views_have_reconstructions_of_their_own() -> None:
    made = reconstructions(top=Decoder(), side=Decoder(10))
    assert [made(view, of(2))[0, 0, 0, 0].item() for view in ("top", "side", "top")] == [2, 20, 2]


def test_what_is_handed_out_can_be_changed_without_changing_what_is_kept() -> None:
    made = reconstructions(top=Decoder())
    made("top", of(5)).zero_()
    assert made("top", of(5))[0, 0, 0, 0] == 5


def test_the_oldest_give_way_where_there_is_no_room() -> None:
    top = Decoder()
    made = reconstructions(kept=2, top=top)
    assert made("top", of(1, 2, 3, 3, 2, 1))[:, 0, 0, 0].tolist() == [1, 2, 3, 3, 2, 1]
    assert top.asked == [[1], [2], [3], [1]]
    none = Decoder()
    assert reconstructions(kept=0, top=none)("top", of(7, 7))[:, 0, 0, 0].tolist() == [7, 7]
    assert none.asked == [[7], [7]]
