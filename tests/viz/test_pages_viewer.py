"""The viewer: one page, the whole map inside, and the same picture as our renderer."""

import base64
import json
import re
import shutil
import subprocess
from html import unescape
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from minislam.data.ply import GaussianArrays
from minislam.geometry import Camera, se3_exp, se3_inverse
from minislam.splatting import GaussianMap, constants, render
from minislam.viz import Page, build_viewer

CAMERA = Camera(80.0, 82.0, 47.0, 36.5, 96, 72)
BACKGROUND = np.array([0.4, 0.5, 0.3])
COUNT = 1500  # more than one line of the textures
JPEG = b"\xff\xd8 picture \xff\xd9"


def gaussians() -> GaussianArrays:
    draw = np.random.default_rng(5)
    return GaussianArrays(
        means=draw.uniform((-1.5, -1, 1), (1.5, 1, 5), (COUNT, 3)).astype(np.float32),
        log_scales=draw.uniform(-5, -1.5, (COUNT, 3)).astype(np.float32),
        quats_wxyz=draw.normal(size=(COUNT, 4)).astype(np.float32),
        opacity_logits=draw.uniform(-3, 4, COUNT).astype(np.float32),
        colors=draw.uniform(0, 1, (COUNT, 3)).astype(np.float32),
    )


def poses() -> dict[int, np.ndarray]:
    twists = {0: [0] * 6, 2: [0.2, 0.1, -0.3, 0.05, 0.1, 0.2], 5: [-1, 0, 0, 0, 1, 0]}
    return {index: se3_exp(torch.tensor(t).double()).numpy() for index, t in twists.items()}


def viewer(title: str = "a run") -> str:
    pictures = {0: (JPEG, JPEG, JPEG), 5: (JPEG, JPEG, JPEG)}
    return build_viewer(title, vars(gaussians()), CAMERA, BACKGROUND, poses(), 7, pictures)


def data_of(html: str) -> dict:
    return json.loads(re.search(r'id="data">(.*?)</script>', html, re.DOTALL)[1])


def numbers(text: str, kind: str, columns: int) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), kind).reshape(-1, columns)


def template() -> str:
    return viewer().replace(re.search(r'id="data">(.*?)</script>', viewer(), re.DOTALL)[1], "")


def test_the_page_is_one_file_that_may_load_nothing():
    html = viewer()
    assert html.startswith("<!DOCTYPE html>")
    assert not re.search(r"https?:|//\w+\.\w+/|<link|<iframe|\bsrc=|@import|url\(|fetch\(", html)
    assert "default-src 'none'" in html  # the browser itself refuses whatever is not in the page
    assert html == viewer() and "<noscript>This page needs JavaScript." in html


def test_the_script_stays_readable():
    assert len(template().encode()) < 30_000
    assert max(map(len, template().splitlines())) <= 130


def test_what_moves_and_draws_on_the_canvas_counts_its_pixels_alike():
    assert template().count("devicePixelRatio") == 1  # the canvas has fewer on some phones


def test_the_map_comes_back_from_the_page():
    data, map_ = data_of(viewer()), gaussians()
    assert data["count"] == COUNT
    np.testing.assert_array_equal(numbers(data["means"], "<f4", 3), map_.means)
    scales = numbers(data["scales"], "<f2", 3).astype(float)
    np.testing.assert_allclose(scales, np.exp(map_.log_scales), rtol=1e-3)
    quats = map_.quats_wxyz / np.linalg.norm(map_.quats_wxyz, axis=1, keepdims=True)
    np.testing.assert_allclose(numbers(data["quats"], "<f2", 4), quats, atol=5e-4)
    colors = numbers(data["colors"], "u1", 4) / 255
    np.testing.assert_allclose(colors[:, :3], map_.colors, atol=0.002)
    np.testing.assert_allclose(colors[:, 3], 1 / (1 + np.exp(-map_.opacity_logits)), atol=0.002)


def test_the_path_and_the_pictures_come_back_and_lost_frames_have_no_pose():
    data = data_of(viewer())
    assert (data["frame_count"], [index for index, _ in data["frames"]]) == (7, [0, 2, 5])
    for index, pose in data["frames"]:
        np.testing.assert_allclose(np.reshape(pose, (3, 4)), poses()[index][:3], atol=1e-6)
    assert data["camera"]["fy"] == CAMERA.fy and data["background"] == BACKGROUND.tolist()
    picture = data["keyframes"]["5"][2].removeprefix("data:image/jpeg;base64,")
    assert base64.b64decode(picture) == JPEG


def test_a_name_cannot_break_out_of_the_data():
    assert data_of(viewer("</script><b>"))["title"] == "</script><b>"


def test_a_page_survives_its_frame():
    page = "<p title=\"a & b\">'x'</p><script>if (1 < 2) {}</script>"
    assert page not in repr(Page(page, 300))  # which a notebook would print as well
    shown = Page(page, 300)._repr_html_()
    start = shown.index('srcdoc="') + len('srcdoc="')
    assert unescape(shown[start : shown.index('"', start)]) == page
    assert 'height="300"' in shown


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("MAX_OPACITY", constants.MAX_OPACITY),
        ("MIN_ALPHA", "1.0 / 255.0"),
        ("VIEW_MARGIN", constants.VIEW_MARGIN),
        ("NEAR_DEPTH", constants.NEAR_DEPTH),
        ("LOW_PASS_VARIANCE", constants.LOW_PASS_VARIANCE),
    ],
)
def test_the_constants_are_those_of_the_renderer(name: str, value: object):
    assert f"{name} = {value}" in template() and constants.MIN_ALPHA == 1 / 255


# In a browser, where there is one

BROWSER = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("chrome")


def screenshot(folder: Path, body: str) -> tuple[np.ndarray, list[str]]:
    """Return the picture (H, W, 3) of a page, and what the page said on the console."""
    page = folder / "page.html"
    page.write_text(f'<!DOCTYPE html><body style="margin:0;background:#fff">{body}')
    command = [
        BROWSER, "--headless", "--no-sandbox", "--hide-scrollbars", "--force-device-scale-factor=1",
        "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--enable-logging=stderr",
        "--virtual-time-budget=5000", "--window-size=800,600", f"--user-data-dir={folder}/profile",
        f"--screenshot={folder}/shot.png", page.as_uri(),
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    said = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    image = cv2.imread(f"{folder}/shot.png")
    assert image is not None, done.stderr[-500:]
    return image[..., ::-1] / 255, said


@pytest.mark.slow
@pytest.mark.skipif(BROWSER is None, reason="no Chromium on this machine")
def test_the_browser_draws_what_our_renderer_draws(tmp_path: Path):
    (tmp_path / "viewer.html").write_text(viewer(), encoding="utf-8")
    width, height, map_ = CAMERA.width, CAMERA.height, gaussians()
    frames = "".join(
        f'<iframe src="viewer.html#frame={index}&bare" width={width} height={height} '
        f'style="border:0;position:absolute;top:0;left:{place * width}px"></iframe>'
        for place, index in enumerate(poses())
    )
    shot, said = screenshot(tmp_path, frames)
    assert said == []
    tensors = [torch.from_numpy(value) for value in vars(map_).values()]
    ours = GaussianMap(
        tensors[0], tensors[2], tensors[1], tensors[3], tensors[4], torch.zeros(COUNT).long()
    )
    for place, pose in enumerate(poses().values()):
        T_camera_world = se3_inverse(torch.from_numpy(pose)).float()
        color = render(ours, CAMERA, T_camera_world, torch.tensor(BACKGROUND).float()).color
        theirs = shot[:height, place * width : (place + 1) * width]
        error = ((color.clamp(0, 1).numpy() - theirs) ** 2).mean()
        assert -10 * np.log10(error) > 38, place  # dB, 45 when this was written


SCRIPTS = {  # what they say
    "quick clicks leave one animation": (
        """for (const on of [true, false, true]) setPlaying(on);
        const ask = requestAnimationFrame;
        let steps = 0;
        window.requestAnimationFrame = call => { steps += call.name === "step"; return ask(call); };
        ask(() => console.log(`says ${steps}`));""",
        "1",
    ),
    "space presses the button in focus, else it plays": (
        """const space = { key: " ", bubbles: true, cancelable: true };
        const presses = [$("path"), document.body].map(
          on => [on.dispatchEvent(new KeyboardEvent("keydown", space)), playing]);
        console.log(`says ${presses}`);""",
        "true,false,false,true",
    ),
    "the slider keeps its length where a frame is lost": (
        """const lengthAt = when => { time = when; showState(); return $("slider").offsetWidth; };
        console.log(`says ${lengthAt(1) - lengthAt(0)}`);""",
        "0",
    ),
    "a long name ends before the pictures": (
        """$("title").textContent = "a_".repeat(99);
        const [left, right] = ["title", "pictures"].map(id => $(id).getBoundingClientRect());
        console.log(`says ${left.right < right.left && left.bottom < 50}`);""",
        "true",
    ),
}


@pytest.mark.slow
@pytest.mark.skipif(BROWSER is None, reason="no Chromium on this machine")
@pytest.mark.parametrize("kind", SCRIPTS)
def test_the_page_behaves(kind: str, tmp_path: Path):
    script, words = SCRIPTS[kind]
    _, said = screenshot(tmp_path, f"{viewer()}<script>{script}</script>")
    assert f'"says {words}"' in said[-1]


@pytest.mark.slow
@pytest.mark.skipif(BROWSER is None, reason="no Chromium on this machine")
def test_the_console_is_heard(tmp_path: Path):
    _, said = screenshot(tmp_path, "<script>anything()</script>")
    assert any("anything" in line for line in said)
