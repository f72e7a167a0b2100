"""Gaussian maps on disk: the layout byte by byte, raw values, and refusals."""

import struct
from pathlib import Path

import numpy as np
import pytest

from minislam.data.ply import (
    PROPERTIES,
    GaussianArrays,
    encode_ply,
    read_ply,
)
from minislam.errors import InputError


def random_gaussians(count: int, seed: int = 0) -> GaussianArrays:
    source = np.random.default_rng(seed)
    quats = source.normal(size=(count, 4))
    return GaussianArrays(
        means=source.normal(size=(count, 3)).astype(np.float32),
        log_scales=source.normal(-3, 1, size=(count, 3)).astype(np.float32),
        quats_wxyz=(quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        opacity_logits=source.normal(size=count).astype(np.float32),
        colors=source.random((count, 3)).astype(np.float32),
    )


def decode(content: bytes, folder: Path) -> GaussianArrays:
    (folder / "map.ply").write_bytes(content)
    return read_ply(folder / "map.ply")


# Known answers

HEADER_DEGREE_0 = b"""ply
format binary_little_endian 1.0
element vertex 1
property float x
property float y
property float z
property float nx
property float ny
property float nz
property float f_dc_0
property float f_dc_1
property float f_dc_2
property float opacity
property float scale_0
property float scale_1
property float scale_2
property float rot_0
property float rot_1
property float rot_2
property float rot_3
end_header
"""


def test_one_gaussian_byte_by_byte():
    # Colours 0.5, 0.5 + C0 / 4 and 2 give f_dc 0, 0.25 and 1.5 / C0: as a colour above 1 renders,
    # so it is kept. The quaternion (0, 0, 3, 4) is stored as (0, 0, 0.6, 0.8).
    c0 = 0.28209479177387814
    one = GaussianArrays(
        means=np.array([[1.0, 2, 3]]),
        log_scales=np.array([[-1.0, -2, -3]]),
        quats_wxyz=np.array([[0.0, 0, 3, 4]]),
        opacity_logits=np.array([-4.5]),
        colors=np.array([[0.5, 0.5 + c0 / 4, 2.0]]),
    )
    values = [1, 2, 3, 0, 0, 0, 0, 0.25, 1.5 / c0, -4.5, -1, -2, -3, 0, 0, 0.6, 0.8]
    content = encode_ply(one)
    assert content[: len(HEADER_DEGREE_0)] == HEADER_DEGREE_0
    body = content[len(HEADER_DEGREE_0) :]
    assert len(body) == 68
    np.testing.assert_allclose(struct.unpack("<17f", body), values, atol=1e-6)


def test_of_spherical_harmonics_only_the_mean_colour_is_read(tmp_path: Path):
    content = encode_ply(random_gaussians(2))
    header, body = content.split(b"end_header\n")
    rest = b"".join(b"property float f_rest_%d\n" % number for number in range(45))
    padded = np.pad(np.frombuffer(body, "<f4").reshape(2, 17), ((0, 0), (0, 45)))
    read = decode(header + rest + b"end_header\n" + padded.tobytes(), tmp_path)
    np.testing.assert_array_equal(read.colors, decode(content, tmp_path).colors)


# Identities


@pytest.mark.parametrize("count", [0, 1, 100])
def test_round_trip(tmp_path: Path, count: int):
    written = random_gaussians(count)
    (tmp_path / "map.ply").write_bytes(encode_ply(written))
    read = read_ply(tmp_path / "map.ply")
    assert len(read) == count
    for name in ("means", "log_scales", "opacity_logits"):
        np.testing.assert_array_equal(getattr(read, name), getattr(written, name))
    np.testing.assert_allclose(read.colors, written.colors, atol=1e-7)
    np.testing.assert_allclose(read.quats_wxyz, written.quats_wxyz, atol=1e-7)
    (tmp_path / "again.ply").write_bytes(encode_ply(written))
    assert (tmp_path / "again.ply").read_bytes() == (tmp_path / "map.ply").read_bytes()


def test_comments_and_other_orders_of_properties_are_read(tmp_path: Path):
    content = encode_ply(random_gaussians(1)).replace(b"element", b"comment hello\nelement", 1)
    swapped = content.replace(b"property float opacity\n", b"", 1)
    swapped = swapped.replace(b"property float x\n", b"property float opacity\nproperty float x\n")
    assert np.isfinite(decode(content, tmp_path).means).all()
    assert decode(swapped, tmp_path).means[0, 0] == decode(content, tmp_path).means[0, 1]


def test_plyfile_reads_what_is_written(tmp_path: Path):
    plyfile = pytest.importorskip("plyfile")
    written = random_gaussians(5)
    (tmp_path / "map.ply").write_bytes(encode_ply(written))
    vertex = plyfile.PlyData.read(str(tmp_path / "map.ply"))["vertex"]
    assert [one.name for one in vertex.properties] == list(PROPERTIES)
    np.testing.assert_array_equal(vertex["opacity"], written.opacity_logits)
    np.testing.assert_array_equal(vertex["scale_2"], written.log_scales[:, 2])


# Errors


@pytest.mark.parametrize(
    "name, value, message",
    [
        ("means", np.nan, "finite means"),
        ("opacity_logits", np.inf, "finite opacity_logits"),
        ("log_scales", 21.0, "natural logarithms"),
        ("quats_wxyz", 0.0, "no rotation"),
    ],
)
def test_values_that_hurt_viewers_are_refused(name, value, message):
    gaussians = random_gaussians(3)
    getattr(gaussians, name)[1] = value
    with pytest.raises(InputError, match=message):
        encode_ply(gaussians)


def test_wrong_files_are_named(tmp_path: Path):
    content = encode_ply(random_gaussians(3))
    wrong = {
        "is_text.ply": b"hello",
        "is_ascii.ply": content.replace(b"binary_little_endian", b"ascii"),
        "is_mesh.ply": content.replace(b"opacity", b"quality"),
        "is_double.ply": content.replace(b"float x", b"double x"),
        "is_cut.ply": content[:-1],
        "is_long.ply": content + b"\0",
        "is_negative.ply": content.replace(b"vertex 3", b"vertex -3"),
        "is_endless.ply": content.replace(b"vertex 3", b"vertex " + b"3" * 5000),
        "is_twice.ply": content.replace(b"float nx", b"float x"),
        "is_empty.ply": b"",
    }
    for name, content in wrong.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(InputError, match=name):
            read_ply(tmp_path / name)
