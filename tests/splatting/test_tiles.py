"""The tile lists: nothing that shows is missing, nothing is listed in vain, order is kept."""

import pytest
import torch

from minislam.splatting import tiles
from minislam.splatting.reference import gaussian_alphas
from minislam.splatting.tiles import TILE, TileGroup, build_tile_lists, stable_argsort, tile_grid
from minislam.splatting.visible import project_gaussians
from tests.splatting.scenes import KINDS, random_camera, random_map, random_pose


def lists_and_truth(kind: str, seed: int) -> tuple[list[TileGroup], torch.Tensor, int]:
    """Return the lists of a random view, and which (Gaussian, tile) pairs truly overlap."""
    gaussians, camera, pose = random_map(kind, 40, seed), random_camera(seed), random_pose(seed)
    projected = project_gaussians(
        gaussians.means, gaussians.quats_wxyz, gaussians.scales, gaussians.opacities,
        None, pose, camera,
    )  # fmt: skip
    lists = build_tile_lists(
        projected.means2d, projected.conics, projected.covariances2d, projected.opacities, camera
    )
    xx, xy, yy = projected.covariances2d
    covariances = torch.stack([xx, xy, xy, yy], -1).view(-1, 2, 2)
    alphas = gaussian_alphas(projected.means2d.T, covariances, projected.opacities, camera)
    rows, columns = tile_grid(camera)
    padding = (0, columns * TILE - camera.width, 0, rows * TILE - camera.height)
    padded = torch.nn.functional.pad(alphas, padding)
    tiled = padded.view(-1, rows, TILE, columns, TILE).amax((2, 4)).flatten(1)
    return lists, tiled > 0, len(projected.rows)


def slots_of(group: TileGroup, count: int) -> torch.Tensor:
    """Return the Gaussians in the slots (K, B) of a group's tiles, `count` where there is none."""
    sizes = [chunk.slots * chunk.tiles for chunk in group.chunks]
    rows = []
    for chunk, gaussians in zip(group.chunks, group.gaussians.split(sizes), strict=True):
        ended = len(group.tiles) - chunk.tiles
        rows.append(torch.nn.functional.pad(gaussians.view(chunk), (ended, 0), value=count))
    return torch.cat(rows)


def listed_pairs(lists: list[TileGroup], shape: torch.Size, count: int) -> torch.Tensor:
    pairs = torch.zeros(shape, dtype=torch.bool)
    for group in lists:
        slots = slots_of(group, count)
        real = slots < count
        pairs[slots[real], group.tiles.expand_as(real)[real]] = True
    return pairs


def slots_in_use(lists: list[TileGroup], count: int) -> int:
    return sum(int((group.gaussians < count).sum()) for group in lists)


ON_CPU, ON_GPU = (tiles.GROUP, tiles.CHUNK), (tiles.GROUP_ON_GPU, tiles.CHUNK_ON_GPU)


@pytest.mark.parametrize(("group", "chunk"), [(1, 12), (7, 1), ON_CPU, ON_GPU])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(6))
def test_every_pair_that_shows_is_listed_once(
    kind: str, seed: int, group: int, chunk: int, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(tiles, "GROUP", group)
    monkeypatch.setattr(tiles, "CHUNK", chunk)
    lists, overlaps, count = lists_and_truth(kind, seed)
    pairs = listed_pairs(lists, overlaps.shape, count)
    assert not (overlaps & ~pairs).any()
    assert slots_in_use(lists, count) == int(pairs.sum())


def test_few_pairs_are_listed_in_vain():
    # An ellipse can meet a row of tiles between two pixel centres and show on neither.
    listed = overlapping = 0
    for seed in range(30):
        lists, overlaps, count = lists_and_truth("ordinary", seed)
        listed += slots_in_use(lists, count)
        overlapping += int(overlaps.sum())
    assert listed <= 1.03 * overlapping


@pytest.mark.parametrize("seed", range(6))
def test_lists_run_from_front_to_back(seed: int):
    lists, _, count = lists_and_truth("crowded", seed)
    for group in lists:
        slots = slots_of(group, count)
        assert (slots.diff(dim=0)[slots[1:] < count] > 0).all()  # padding comes last
        assert (slots.diff(dim=0) >= 0).all()


def test_lists_that_have_ended_are_left_out(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(tiles, "CHUNK", 2)
    monkeypatch.setattr(tiles, "ACTIVE", 1)
    lists, _, count = lists_and_truth("ordinary", 0)
    padding = sum(int((group.gaussians == count).sum()) for group in lists)
    listed = sum(len(group.tiles) for group in lists)
    assert 0 < padding <= listed  # at most one in the last chunk of a list


def test_no_gaussian_gives_no_group():
    empty = torch.zeros(3, 0)
    assert build_tile_lists(empty[:2], empty, empty, empty[0], random_camera(0)) == []


@pytest.mark.parametrize("most", [1, 300, 65_536, 65_537, 2**31 - 1])
def test_integers_are_sorted_and_equal_ones_keep_their_order(most: int):
    rng = torch.Generator().manual_seed(0)
    keys = torch.randint(0, most, (2_000,), dtype=torch.int32, generator=rng)
    keys[::3] = most - 1
    assert torch.equal(stable_argsort(keys), keys.argsort(stable=True))
    assert stable_argsort(keys[:0]).shape == (0,)
