"""What other programs read: the point that was photographed is where their conventions project it.

Raw images with lens distortion show a bright spot where OpenCV projects a known point. The
exported files are read back here by hand and must project the point onto the exported spot.
"""

import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from minislam.data.options import InputOptions
from minislam.data.ply import GaussianArrays, encode_ply, read_ply
from minislam.data.sequence import open_sequence
from minislam.errors import InputError
from minislam.runs import export
from minislam.uncertainty.weights import MAPPING_CUT, beta_of_mask
from tests.recordings import save

RAW_SIZE, LENS = (200, 148), (170.0, 175.0, 95.0, 70.0)
DISTORTION = (-0.25, 0.08, 0.001, -0.002, 0.0)
POINT = np.array([0.3, -0.2, 2.0])  # world
FRAMES = (2, 5)  # frames with a pose, of six
STEPS = {2: [0.1, -0.2, 0.3], 5: [0.3, 0.0, 0.0]}


def pose(frame: int) -> np.ndarray:
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = Rotation.from_rotvec([0.1, 0.05 * frame, -0.2]).as_matrix()
    T_world_camera[:3, 3] = STEPS[frame]
    return T_world_camera


def spot_image(frame: int) -> np.ndarray:
    """Return what the distorting camera sees of the point: a smooth spot, (H, W, 3) uint8."""
    fx, fy, cx, cy = LENS
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    T_camera_world = np.linalg.inv(pose(frame))
    turn = cv2.Rodrigues(T_camera_world[:3, :3])[0]
    point = cv2.projectPoints(
        POINT[None], turn, T_camera_world[:3, 3], matrix, np.array(DISTORTION)
    )
    u, v = np.meshgrid(*map(np.arange, RAW_SIZE))
    distance = (u - point[0][0, 0, 0]) ** 2 + (v - point[0][0, 0, 1]) ** 2
    bright = np.round(255 * np.exp(-distance / (2 * 3.0**2)))
    return np.repeat(bright[..., None], 3, 2).astype(np.uint8)


def centroid(image: np.ndarray) -> np.ndarray:
    """Return the centre of brightness (2,) in pixels whose centres are integers."""
    v, u = np.indices(image.shape[:2])
    weight = image[..., 0].astype(float) if image.ndim == 3 else image.astype(float)
    return np.array([(weight * u).sum(), (weight * v).sum()]) / weight.sum()


@pytest.fixture
def run(tmp_path: Path) -> SimpleNamespace:
    """Return the part of a loaded run that the export uses."""
    for frame in range(6):
        raw = spot_image(frame) if frame in FRAMES else np.zeros((*RAW_SIZE[::-1], 3), np.uint8)
        save(tmp_path / f"in/{frame}.png", raw)
    numbers = [*LENS, *RAW_SIZE, *DISTORTION]
    (tmp_path / "in/calibration.txt").write_text(" ".join(map(str, numbers)))
    options = InputOptions(size=(96, 64))  # another aspect, so that the working image is cropped

    sequence = open_sequence(str(tmp_path / "in"), options)

    def beta(frame: int) -> np.ndarray:  # the spot moves
        moving = sequence.frame(frame).image[..., 0] > 0.3
        return beta_of_mask(moving).numpy()

    rng = np.random.default_rng(0)
    gaussians = GaussianArrays(
        rng.normal(size=(9, 3)), np.full((9, 3), -3.0), np.tile([1.0, 0, 0, 0], (9, 1)),
        np.linspace(-2, 2, 9), rng.uniform(size=(9, 3)),
    )  # fmt: skip
    return SimpleNamespace(
        folder=SimpleNamespace(path=tmp_path / "run"), camera=sequence.camera, unit="m",
        poses={frame: pose(frame) for frame in FRAMES}, keyframes=[5], gaussians=gaussians,
        sequence=sequence, beta=beta, least_weight=MAPPING_CUT, displacement=lambda frame: None,
        render_depth=lambda T, camera=None: np.full((64, 96), T[2, 3] + 2),
    )  # fmt: skip


def exported(folder: Path, frame: int) -> tuple[np.ndarray, np.ndarray]:
    image = cv2.imread(str(folder / f"images/{frame:06d}.png"))
    mask = cv2.imread(str(folder / f"masks/{frame:06d}.png"), cv2.IMREAD_GRAYSCALE)
    assert image.shape[:2] == mask.shape and set(np.unique(mask)) == {0, 255}
    return image, mask


# Reprojection


def test_colmap_projects_a_point_where_the_exported_image_shows_it(run, tmp_path: Path):
    folder = tmp_path / "out"
    export.export_colmap(run, folder, FRAMES)
    camera = (folder / "sparse/0/cameras.txt").read_text().split()
    assert camera[:2] == ["1", "PINHOLE"]
    width, height, fx, fy, cx, cy = map(float, camera[2:])
    assert width > 150 and height > 100  # the size of the source, not of the working image
    rows = (folder / "sparse/0/images.txt").read_text().splitlines()
    assert rows[1::2] == ["", ""]
    for row, frame in zip(rows[::2], FRAMES, strict=True):
        _, *numbers, camera_id, name = row.split()
        w, x, y, z, *shift = map(float, numbers)
        assert (camera_id, name) == ("1", f"{frame:06d}.png")
        ray = Rotation.from_quat([x, y, z, w]).apply(POINT) + shift
        corner_based = np.array([fx * ray[0] / ray[2] + cx, fy * ray[1] / ray[2] + cy])
        image, mask = exported(folder, frame)
        assert image.shape == (height, width, 3)
        np.testing.assert_allclose(centroid(image), corner_based - 0.5, atol=0.05)
        np.testing.assert_allclose(centroid(255 - mask), corner_based - 0.5, atol=0.6)


def test_nerfstudio_projects_a_point_where_the_exported_image_shows_it(run, tmp_path: Path):
    folder = tmp_path / "out"
    export.export_nerfstudio(run, folder, FRAMES)
    model = json.loads((folder / "transforms.json").read_text())
    for view, frame in zip(model["frames"], FRAMES, strict=True):
        # Axes of OpenGL: x right, y up, and the camera looks along -z.
        x, y, z, _ = np.linalg.inv(view["transform_matrix"]) @ [*POINT, 1]
        u = model["cx"] + model["fl_x"] * x / -z
        v = model["cy"] - model["fl_y"] * y / -z
        image, mask = exported(folder, frame)
        assert image.shape == (model["h"], model["w"], 3)
        np.testing.assert_allclose(centroid(image), np.array([u, v]) - 0.5, atol=0.05)
        assert (folder / view["file_path"]).exists() and (folder / view["mask_path"]).exists()
        assert mask[round(v - 0.5), round(u - 0.5)] == 0
    assert (folder / model["ply_file_path"]).exists()


def test_images_and_masks_beside_poses_are_those_of_a_global_shutter(run, tmp_path: Path):
    export.export_nerfstudio(run, tmp_path / "as filmed", FRAMES)
    shift = np.float32([3.0, -2.0])  # px of the run's images, by which the spot is shown too far
    run.displacement = lambda frame: np.broadcast_to(shift, (64, 96, 2)) if frame == 5 else None
    export.export_nerfstudio(run, tmp_path / "undone", FRAMES)
    scale = run.sequence.prepare.full_camera(run.camera).fx / run.camera.fx
    assert scale > 1.5
    for frame, moved in ((2, 0 * shift), (5, shift)):
        before, after = (exported(tmp_path / name, frame) for name in ("as filmed", "undone"))
        expected = centroid(before[0]) - scale * moved
        np.testing.assert_allclose(centroid(after[0]), expected, atol=0.1)
        expected = centroid(255 - before[1]) - scale * moved
        np.testing.assert_allclose(centroid(255 - after[1]), expected, atol=0.6)
    export.export_masks(run, tmp_path / "masks", [5])  # these belong to the source's images
    assert (tmp_path / "masks/000005.png").read_bytes() == (
        tmp_path / "as filmed/masks/000005.png"
    ).read_bytes()


def test_pycolmap_reads_what_we_write(run, tmp_path: Path):
    pycolmap = pytest.importorskip("pycolmap")
    export.export_colmap(run, tmp_path / "out", FRAMES)
    model = pycolmap.Reconstruction(tmp_path / "out/sparse/0")
    assert (model.num_images(), model.num_points3D()) == (2, 4)
    for image in model.images.values():
        pixel = image.project_point(POINT)
        shown, _ = exported(tmp_path / "out", int(Path(image.name).stem))
        np.testing.assert_allclose(centroid(shown), pixel - 0.5, atol=0.05)


def test_a_refined_focal_length_reaches_the_full_size(run):
    sequence = run.sequence
    full = sequence.prepare.full_camera(sequence.camera)
    longer = SimpleNamespace(**vars(sequence.camera))
    longer.fx *= 1.1
    refined = sequence.prepare.full_camera(type(full)(**vars(longer)))
    assert refined.fx == pytest.approx(1.1 * full.fx) and refined.cx == pytest.approx(full.cx)
    # The working camera sees the same ray at the pixel that the resizing moves it to.
    ray = full.rays(torch.tensor([60.0, 50.0], dtype=torch.float64))
    assert full.project(ray).tolist() == pytest.approx([60, 50])
    assert full.fx == pytest.approx(LENS[0]) and full.fy == pytest.approx(LENS[1])


# Points, depth, masks, spherical harmonics


def test_points_are_the_opaque_gaussians_with_their_colours(run, tmp_path: Path):
    export.export_points(run, tmp_path / "a.ply")
    content = (tmp_path / "a.ply").read_bytes()
    header, _, body = content.partition(b"end_header\n")
    assert b"element vertex 4\n" in header and b"property uchar red\n" in header
    table = np.frombuffer(body, [("xyz", "<f4", 3), ("rgb", "u1", 3)])
    np.testing.assert_allclose(table["xyz"], run.gaussians.means[5:], rtol=1e-6)
    np.testing.assert_array_equal(table["rgb"], np.round(255 * run.gaussians.colors[5:]))
    export.export_colmap(run, tmp_path / "out", FRAMES)
    first = (tmp_path / "out/sparse/0/points3D.txt").read_text().splitlines()[0].split()
    assert first[0] == "1" and first[4:] == [*map(str, table["rgb"][0]), "0"]
    assert [float(x) for x in first[1:4]] == pytest.approx(run.gaussians.means[5])


def test_depth_is_written_in_numbers_with_camera_and_unit(run, tmp_path: Path):
    export.export_depth(run, tmp_path / "depth", FRAMES)
    depth = np.load(tmp_path / "depth/000002.npy")
    assert depth.dtype == np.float32 and depth.shape == (64, 96)
    assert depth[0, 0] == pytest.approx(2.3)
    camera = json.loads((tmp_path / "depth/camera.json").read_text())
    assert camera == {**vars(run.camera), "unit": "m"}


def test_masks_of_a_static_scene_are_white(run, tmp_path: Path):
    run.beta = lambda frame: np.zeros((64, 96), np.float32)
    export.export_masks(run, tmp_path / "masks", [5])
    mask = cv2.imread(str(tmp_path / "masks/000005.png"), cv2.IMREAD_GRAYSCALE)
    full = run.sequence.prepare.full_camera(run.camera)
    assert (mask == 255).all() and mask.shape == (full.height, full.width)


def test_masks_follow_the_cut_of_the_run(run, tmp_path: Path):
    run.beta = lambda frame: np.full((64, 96), 1.2, np.float32)
    for name, least, expected in (("usual", MAPPING_CUT, 255), ("of this clip", 0.17, 0)):
        run.least_weight = least
        export.export_masks(run, tmp_path / name, [5])
        mask = cv2.imread(str(tmp_path / name / "000005.png"), cv2.IMREAD_GRAYSCALE)
        assert (mask == expected).all()


def test_higher_harmonics_are_zeros_between_colour_and_opacity(run, tmp_path: Path):
    (tmp_path / "a.ply").write_bytes(encode_ply(run.gaussians, 3))
    names = [row.split()[2] for row in (tmp_path / "a.ply").read_bytes().split(b"end_header")[0]
             .decode().splitlines()[3:]]  # fmt: skip
    assert names[8:10] == ["f_dc_2", "f_rest_0"] and names[53:55] == ["f_rest_44", "opacity"]
    again = read_ply(tmp_path / "a.ply")
    for name, values in vars(run.gaussians).items():
        np.testing.assert_allclose(getattr(again, name), values, atol=1e-6, err_msg=name)


# Errors


def test_images_of_the_sequence_are_never_written_over(run, tmp_path: Path):
    (tmp_path / "in").rename(tmp_path / "images")
    run.sequence = open_sequence(str(tmp_path / "images"))
    with pytest.raises(InputError, match="expected a folder without images of the sequence"):
        export.export_colmap(run, tmp_path, FRAMES)
    assert not (tmp_path / "masks").exists()
    before = {path.name: path.read_bytes() for path in (tmp_path / "images").iterdir()}
    for write in (export.export_masks, export.export_depth, export.export_nerfstudio):
        with pytest.raises(InputError, match=r"found .*images/0\.png; choose another"):
            write(run, tmp_path / "images", FRAMES)
    assert {path.name: path.read_bytes() for path in (tmp_path / "images").iterdir()} == before


@pytest.mark.parametrize("link", ["images", "images/000002.png", "masks/000002.png"])
def test_images_of_the_sequence_are_not_written_over_through_a_link(run, tmp_path: Path, link: str):
    image = tmp_path / "in" / run.sequence.source_name(2)
    (path := tmp_path / "out" / link).parent.mkdir(parents=True)
    path.symlink_to(image if path.suffix else image.parent)
    before = {file: file.read_bytes() for file in image.parent.iterdir()}
    with pytest.raises(InputError, match="of the sequence itself, or links to them, found"):
        export.export_colmap(run, tmp_path / "out", FRAMES)
    assert {file: file.read_bytes() for file in image.parent.iterdir()} == before


def test_the_folder_of_a_run_is_never_written_over(run, tmp_path: Path):
    (tmp_path / "run").mkdir()
    for name in ("run.json", "camera.json"):
        (tmp_path / "run" / name).write_text("{}")
    with pytest.raises(InputError, match=r"expected a folder of no run, found run\.json in .*run;"):
        export.export_depth(run, tmp_path / "run", FRAMES)
    assert (tmp_path / "run/camera.json").read_text() == "{}"


def test_masks_that_were_given_are_never_written_over(run, tmp_path: Path):
    shutil.copytree(tmp_path / "in", tmp_path / "own")
    run.sequence = open_sequence(str(tmp_path / "in"), InputOptions(masks=f"files:{tmp_path}/own"))
    with pytest.raises(InputError, match=r"found .*own/.*; choose another"):
        export.export_masks(run, tmp_path / "own", FRAMES)


def test_depth_needs_no_sequence_for_a_new_folder(run, tmp_path: Path):
    del run.sequence
    export.export_depth(run, tmp_path / "depth", FRAMES)
    assert (tmp_path / "depth/camera.json").is_file()


def test_a_folder_that_cannot_be_made_is_one_sentence(run, tmp_path: Path, monkeypatch):
    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "mkdir", refuse)
    for write in (export.export_masks, export.export_depth, export.export_colmap):
        with pytest.raises(InputError, match=r"make the folder .*out, but .*: Permission denied;"):
            write(run, tmp_path / "out", FRAMES)
