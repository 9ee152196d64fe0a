"""The ResNet: shapes, what its two poolings say, and that images do not see each other."""

from __future__ import annotations

import pytest
import torch

from vilp_models.recipe import Pool
from vilp_models.vision import Keypoints, ResNet18, group_norm


@pytest.mark.parametrize(
    ("pool", "latents", "shape", "cells"),
    [
        ("average", False, (3, 64, 96), (2, 3)),
        ("keypoints", False, (3, 64, 96), (4, 6)),
        ("average", True, (4, 12, 20), (2, 3)),
        ("keypoints", True, (4, 12, 20), (6, 10)),
    ],
)
def test_the_last_map_is_coarse_for_averages_and_fine_for_keypoints(
    pool: Pool, latents: bool, shape: tuple[int, int, int], cells: tuple[int, int]
) -> None:
    network = ResNet18(8, shape[0], pool, latents=latents)
    images = torch.randn(2, *shape)
    assert network.map(images).shape == (2, 64, *cells)
    assert network(images).shape == (2, network.features)


def test_a_grid_is_the_cells_of_the_last_map_row_by_row() -> None:
    network = ResNet18(8, grid=True)
    images = torch.randn(1, 3, 64, 96)
    grid = network(images)
    assert grid.shape == (1, 6, network.features)
    assert torch.equal(grid, network.map(images).flatten(2).transpose(1, 2))
    assert torch.equal(grid[0, 4], network.map(images)[0, :, 1, 1])


def test_keypoints_are_where_the_map_is_brightest() -> None:
    keypoints = Keypoints(1, 1)
    torch.nn.init.constant_(keypoints.logits.weight, 100.0)
    for row, column, x, y in ((0, 0, -1, -1), (0, 8, 1, -1), (4, 0, -1, 1), (2, 6, 0.5, 0)):
        image = torch.zeros(1, 1, 5, 9)
        image[0, 0, row, column] = 1
        torch.testing.assert_close(keypoints(image), torch.tensor([[x, y]], dtype=torch.float32))


def test_an_image_gives_the_same_whatever_else_is_in_the_batch() -> None:
    network = ResNet18(8).train()
    images = torch.randn(4, 3, 32, 32)
    torch.testing.assert_close(network(images)[:1], network(images[:1]), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(("channels", "groups"), [(8, 1), (24, 1), (64, 4), (100, 5)])
def test_groups_hold_about_sixteen_channels_and_divide_them(channels: int, groups: int) -> None:
    assert group_norm(channels).num_groups == groups


@pytest.mark.parametrize("pool", ["average", "keypoints"])
def test_colour_and_position_reach_the_output(pool: Pool) -> None:
    torch.manual_seed(0)
    network = ResNet18(8, pool=pool)
    image = torch.full((1, 3, 64, 64), -1.0)
    image[:, 0, 8:16, 8:16] = 1
    out = network(image)
    assert not torch.allclose(out, network(image.flip(1)), atol=1e-4)
    assert not torch.allclose(out, network(image.roll(40, dims=3)), atol=1e-4)
