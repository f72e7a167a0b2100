"""The figures of a run, from stand-ins whose every figure is known."""

from dataclasses import dataclass, field

import numpy as np
import pytest

from minislam.evaluation.metrics import CENTIMETRES, MIN_MASK, MappedView, measure_run
from minislam.evaluation.trajectory import straight_line_error
from minislam.geometry.alignment import Similarity
from minislam.records import Trajectory
from tests.helpers import random_transforms

HEIGHT, WIDTH = 24, 32
NAMES = [
    "ate_all_cm", "ate_keyframes_cm", "ate_straight_line_cm", "psnr_novel_db", "ssim_novel",
    "psnr_novel_oriented_db",
    "psnr_input_db", "psnr_masked_db", "beta_auroc", "depth_l1_cm", "psnr_static_db", "far_worse",
]  # fmt: skip
TURN = random_transforms(1, "normal", 1)[0].numpy()
TO_ESTIMATE = Similarity(0.4, TURN[:3, :3], TURN[:3, 3])  # the world of the map is another one


def walk(count: int = 12) -> Trajectory:
    return Trajectory(np.arange(count) / 10, random_transforms(count, "normal", 0).numpy())


def estimated(truth: Trajectory) -> Trajectory:
    return Trajectory(truth.timestamps, TO_ESTIMATE.transform_poses(truth.T_world_camera))


def grey(value: float) -> np.ndarray:
    return np.full((HEIGHT, WIDTH, 3), value, np.float32)


def left_part(columns: int) -> np.ndarray:
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[:, :columns] = True
    return mask


@dataclass
class Truth:
    """A benchmark that knows what it is given here, frame by frame."""

    trajectory: Trajectory | None = None
    masks: dict[int, np.ndarray] = field(default_factory=dict)
    static: dict[int, np.ndarray] = field(default_factory=dict)
    novel: list[tuple[np.ndarray, np.ndarray]] = field(default_factory=list)
    depths: dict[int, np.ndarray] = field(default_factory=dict)

    def moving_mask(self, frame_index: int) -> np.ndarray | None:
        return self.masks.get(frame_index)

    def static_image(self, frame_index: int) -> np.ndarray | None:
        return self.static.get(frame_index)

    def depth(self, frame_index: int) -> np.ndarray | None:
        return self.depths.get(frame_index)

    def novel_views(self) -> list[tuple[np.ndarray, np.ndarray]]:
        return self.novel


def view(frame_index: int, beta: np.ndarray | None = None, color: float = 0.6) -> MappedView:
    return MappedView(frame_index, grey(color), beta=beta)


def measured(truth: Truth | None, views: list[MappedView] | None = None, render=None) -> dict:
    path = estimated(truth.trajectory if truth and truth.trajectory else walk())
    keyframes = Trajectory(path.timestamps[::2], path.T_world_camera[::2])
    return measure_run(truth, path, keyframes, views or [], render or (lambda pose: grey(0.6)))


def known(metrics: dict) -> set[str]:
    return {name for name, value in metrics.items() if value is not None}


# What cannot be known is None


def test_without_truth_nothing_is_known():
    metrics = measured(None)
    assert list(metrics) == NAMES and known(metrics) == set()


def test_poses_alone_give_the_trajectory_errors():
    metrics = measured(Truth(trajectory=walk()))
    assert list(metrics) == NAMES
    assert known(metrics) == {"ate_all_cm", "ate_keyframes_cm", "ate_straight_line_cm"}


def test_images_alone_give_the_image_errors():
    truth = Truth(static={0: grey(0.5)}, masks={0: left_part(4)})
    metrics = measured(truth, [view(0, np.ones((HEIGHT, WIDTH)))])
    assert known(metrics) == {"psnr_input_db", "psnr_masked_db", "beta_auroc"}


def test_a_camera_that_stands_still_has_no_error_to_align():
    still = Trajectory(np.arange(12) / 10, np.tile(np.eye(4), (12, 1, 1)))
    metrics = measured(Truth(trajectory=still, novel=[(np.eye(4), grey(0.5))]))
    assert metrics["ate_all_cm"] is None and metrics["psnr_novel_db"] is None


def test_poses_at_other_times_have_nothing_in_common():
    truth = walk()
    later = Truth(trajectory=Trajectory(truth.timestamps + 50, truth.T_world_camera))
    metrics = measure_run(later, estimated(truth), estimated(truth), [], lambda pose: grey(0))
    assert known(metrics) == set()  # nor is there a straight walk to compare with


def test_how_well_the_map_fits_what_stands_still_needs_no_truth():
    views = [MappedView(k, grey(0.5), static_psnr=found) for k, found in enumerate((20, None, 24))]
    for truth in (None, Truth()):
        metrics = measured(truth, views)
        assert known(metrics) == {"psnr_static_db", "far_worse"}
        assert (metrics["psnr_static_db"], metrics["far_worse"]) == (22, 0)


def test_images_that_the_map_shows_far_worse_than_most_are_counted():
    found = [30.0, 29.0, 31.0, 23.1, 22.9, 17.0]  # median 26.05
    views = [MappedView(k, grey(0.5), static_psnr=value) for k, value in enumerate(found)]
    assert measured(None, views)["far_worse"] == pytest.approx(1 / 6)
    found = [30.0, 29.0, 31.0, 30.0, 23.6, 23.4]  # median 29.5
    views = [MappedView(k, grey(0.5), static_psnr=value) for k, value in enumerate(found)]
    assert measured(None, views)["far_worse"] == pytest.approx(1 / 6)


# Known answers


def test_the_world_of_the_map_may_be_any():
    metrics = measured(Truth(trajectory=walk()))
    assert metrics["ate_all_cm"] == pytest.approx(0, abs=1e-9)
    assert metrics["ate_keyframes_cm"] == pytest.approx(0, abs=1e-9)


def test_errors_are_in_centimetres_of_the_truth():
    truth = walk()
    metrics = measured(Truth(trajectory=truth))
    assert metrics["ate_straight_line_cm"] == CENTIMETRES * straight_line_error(truth)
    poses = truth.T_world_camera.copy()
    poses[5, 0, 3] += 0.01  # 1 cm in one of 12 poses: an rmse below 1 / sqrt(12) cm
    off = measure_run(
        Truth(trajectory=truth),
        Trajectory(truth.timestamps, poses),
        Trajectory(truth.timestamps, poses),
        [],
        lambda pose: grey(0),
    )
    assert 0.2 < off["ate_all_cm"] < 1 / np.sqrt(12)


def test_the_straight_line_is_that_of_the_poses_that_the_run_saw():
    truth = walk()
    part = Trajectory(truth.timestamps[3:8], truth.T_world_camera[3:8])
    path = estimated(part)
    metrics = measure_run(Truth(trajectory=truth), path, path, [], lambda pose: grey(0))
    assert metrics["ate_straight_line_cm"] == CENTIMETRES * straight_line_error(part)


def test_novel_views_are_rendered_from_the_world_of_the_map():
    poses = random_transforms(3, "normal", 5).numpy()
    asked: list[np.ndarray] = []

    def render(pose: np.ndarray) -> np.ndarray:
        asked.append(pose)
        return grey(0.6)

    truth = Truth(trajectory=walk(), novel=[(pose, grey(0.5)) for pose in poses])
    metrics = measured(truth, render=render)
    # Without noise both alignments, by centres and by orientations, are the same.
    expected = np.repeat(TO_ESTIMATE.transform_poses(poses), 2, axis=0)
    np.testing.assert_allclose(asked, expected, atol=1e-8)
    assert metrics["psnr_novel_db"] == pytest.approx(20, abs=1e-4)  # -20 log10(0.1)
    assert metrics["psnr_novel_oriented_db"] == pytest.approx(20, abs=1e-4)
    assert 0 < metrics["ssim_novel"] < 1


def test_lpips_is_measured_where_weights_are_given():
    truth = Truth(walk(), static={0: grey(0.5)}, novel=[(np.eye(4), grey(0.5))] * 2)
    path = estimated(truth.trajectory)

    def lpips(rendered: np.ndarray, true: np.ndarray) -> float:
        return float(np.abs(rendered - true).mean())

    metrics = measure_run(truth, path, path, [view(0)], lambda pose: grey(0.6), lpips)
    assert metrics["lpips_novel"] == pytest.approx(0.1, abs=1e-6)
    assert metrics["lpips_input"] == pytest.approx(0.1, abs=1e-6)
    unknown = measure_run(None, path, path, [], lambda pose: grey(0.6), lpips)
    assert list(unknown) == [*NAMES, "lpips_novel", "lpips_input"] and known(unknown) == set()


def test_a_ghost_is_measured_where_the_mover_stood():
    rendered = grey(0.5)
    rendered[:, :4] += 0.1  # the ghost: 20 dB there
    truth = Truth(static={0: grey(0.5), 1: grey(0.5)}, masks={0: left_part(4), 1: left_part(8)})
    metrics = measured(truth, [MappedView(0, rendered), MappedView(1, rendered)])
    half = 20 + 10 * np.log10(2)  # half the pixels of the second mask are right
    assert metrics["psnr_masked_db"] == pytest.approx((20 + half) / 2, abs=1e-4)
    assert metrics["psnr_input_db"] == pytest.approx(20 + 10 * np.log10(WIDTH / 4), abs=1e-4)


def test_frames_without_static_image_and_tiny_masks_do_not_count():
    few = np.zeros((HEIGHT, WIDTH), bool)
    few.flat[: MIN_MASK - 1] = True
    truth = Truth(static={1: grey(0.5)}, masks={0: left_part(4), 1: few})
    metrics = measured(truth, [view(0), view(1)])
    assert metrics["psnr_input_db"] == pytest.approx(20, abs=1e-4)
    assert metrics["psnr_masked_db"] is None


@pytest.mark.parametrize(("sign", "expected"), [(1, 1.0), (-1, 0.0)])
def test_beta_is_judged_over_all_keyframes_together(sign: int, expected: float):
    masks = {0: left_part(4), 1: left_part(0)}  # the second shows no mover: alone it says nothing
    views = [view(k, 2.0 + sign * masks[k]) for k in masks]
    assert measured(Truth(masks=masks), views)["beta_auroc"] == expected


def test_without_beta_or_movers_there_is_no_auroc():
    assert measured(Truth(masks={0: left_part(4)}), [view(0)])["beta_auroc"] is None
    beta = np.ones((HEIGHT, WIDTH))
    for columns in (0, WIDTH):  # nothing moves, and all does
        truth = Truth(masks={0: left_part(columns)})
        assert measured(truth, [view(0, beta)])["beta_auroc"] is None


def test_depth_is_compared_in_the_units_of_the_truth_and_not_on_movers():
    true_depth = np.full((HEIGHT, WIDTH), 3.0)
    true_depth[:, :4] = 1.0  # the mover, whom the map does not show
    true_depth[0] = 0  # unknown
    of_map = np.full((HEIGHT, WIDTH), (3.0 + 0.02) * TO_ESTIMATE.scale)
    of_map[-1] = 0  # transparent
    of_map[-2] += 0.10 * TO_ESTIMATE.scale
    truth = Truth(trajectory=walk(), masks={0: left_part(4)}, depths={0: true_depth})
    views = [MappedView(0, grey(0.5), of_map), MappedView(1, grey(0.5), of_map)]
    expected = 2.0 + 10.0 / (HEIGHT - 2)  # cm
    assert measured(truth, views)["depth_l1_cm"] == pytest.approx(expected, abs=1e-6)


def test_without_true_depth_or_alignment_there_is_no_depth_error():
    view_with_depth = MappedView(0, grey(0.5), np.ones((HEIGHT, WIDTH)))
    assert measured(Truth(trajectory=walk()), [view_with_depth])["depth_l1_cm"] is None
    no_path = Truth(depths={0: np.ones((HEIGHT, WIDTH))})
    assert measured(no_path, [view_with_depth])["depth_l1_cm"] is None
    with_path = Truth(trajectory=walk(), depths=no_path.depths)
    assert measured(with_path, [view(0)])["depth_l1_cm"] is None
