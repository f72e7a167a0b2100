"""Published checkpoints: listed, fetched from a server on the loopback address, and checked."""

import hashlib
import os
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from minislam.cli import weights as module
from minislam.cli.main import main
from minislam.priors.names import published_files
from tests.checkpoint_files import calm_droid, lpips_files, tiny_fit3d, write, write_all
from tests.loopback import Server, serve

pytestmark = pytest.mark.slow

ROWS = published_files()


@pytest.fixture(scope="module")
def contents(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """Return what the server has: made-up weights in official files."""
    folder = tmp_path_factory.mktemp("contents")
    fit3d = write(folder / "fit3d", tiny_fit3d()).read_bytes()
    return {"/droid": write(folder / "droid", calm_droid()).read_bytes(), "/fit3d": fit3d}


@pytest.fixture
def server(contents: dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Serve them at the addresses of the list; the cache is empty."""
    monkeypatch.setenv("MINISLAM_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    with serve(dict(contents)) as (server, address):
        rows = {n: replace(row, url=f"{address}/{n}", sha256="") for n, row in ROWS.items()}
        right = hashlib.sha256(contents["/fit3d"]).hexdigest()
        rows["fit3d"] = replace(rows["fit3d"], sha256=right)
        monkeypatch.setattr(module, "published_files", lambda: rows)
        yield server


def said(capsys: pytest.CaptureFixture[str]) -> tuple[str, str]:
    captured = capsys.readouterr()
    return captured.out, captured.err


# List and fetch


def test_who_has_no_home_is_asked_for_a_folder_before_anything_is_fetched(monkeypatch, capsys):
    monkeypatch.delenv("MINISLAM_CACHE", raising=False)
    monkeypatch.setattr(os.path, "expanduser", lambda path: path)  # nobody's process has none
    assert main(["weights", "list"]) == 0 and main(["weights", "fetch", "dinov2"]) == 1
    error = said(capsys)[1]
    assert "found no home for ~" in error and "set MINISLAM_CACHE" in error


def test_the_list_says_size_licence_and_what_is_there(server: Server, tmp_path: Path, capsys):
    assert main(["weights", "list"]) == 0
    out, _ = said(capsys)
    assert len(out.splitlines()) == len(ROWS) + 1 and "fetched" not in out
    assert "droid " in out and "BSD-3-Clause" in out and "CC-BY-NC-4.0 (no commercial use)" in out
    assert str(tmp_path / "cache/weights") in out and server.asked == []
    (tmp_path / "cache/weights").mkdir(parents=True)
    (tmp_path / "cache/weights/droid.pth").write_bytes(b"")
    main(["weights", "list"])
    assert [line.split()[0] for line in said(capsys)[0].splitlines() if "fetched" in line] == [
        "droid"
    ]


def test_what_is_fetched_is_found_by_its_network(server: Server, tmp_path: Path, capsys):
    assert main(["weights", "fetch", "droid", "fit3d"]) == 0
    out, err = said(capsys)
    lines = out.splitlines()
    assert lines[0].startswith("droid: 16 MB, licence BSD-3-Clause, from http://127.0.0.1")
    assert lines[1].startswith("fit3d: 88.3 MB, licence MIT, from ")
    assert lines[2].endswith("droid.pth: complete, use it with --flow droid")
    size = len(server.files["/droid"]) // 1000  # kB
    assert f"fetching droid.pth [kB]: {size}/{size} (" in err
    assert not list(tmp_path.rglob("*.part"))
    server.files.clear()  # now the network is gone, and no run misses it
    asked = len(server.asked)
    clip = ["synth:ball", "--max-frames", "2", "--size", "112x84", "--preset", "test"]
    learned = ["--flow", "droid", "--features", "fit3d", "--depth", "metric3d"]
    assert main(["run", *clip, *learned, "-o", str(tmp_path / "out")]) == 1
    _, err = said(capsys)  # flow and features are found, read and checked before the depth
    assert "expected --depth-weights FILE with --depth metric3d, found none; fetch it with" in err
    assert "minislam weights fetch metric3d, or give" in err
    assert main(["weights", "fetch", "droid", "fit3d"]) == 0  # already there
    assert len(server.asked) == asked


def test_interrupted_twice_it_ends_with_the_right_hash(server: Server, tmp_path: Path, capsys):
    server.breaks_after = [1_000_000, 2_000_000]
    for _ in range(2):
        assert main(["weights", "fetch", "fit3d"]) == 1
        _, err = said(capsys)
        assert "minislam: expected to fetch http://127" in err and "goes on where this one" in err
    assert main(["weights", "fetch", "fit3d"]) == 0
    content = (tmp_path / "cache/weights/dinov2_reg_small_finetuned.pth").read_bytes()
    assert content == server.files["/fit3d"]
    assert [wanted for _, wanted in server.asked] == [None, "bytes=1000000-", "bytes=3000000-"]


def test_another_file_than_the_published_one_is_refused(server: Server, tmp_path: Path, capsys):
    # By its hash; where none is published, because it is a page, or another network.
    server.files |= {
        "/fit3d": server.files["/droid"], "/droid": server.files["/fit3d"],
        "/lpips-heads": b"<html>quota exceeded</html>",
    }  # fmt: skip
    for name, words in (
        ("fit3d", "expected the published dinov2_reg_small_finetuned.pth (sha256 "),
        ("droid", "(complete: --flow droid) in "),
        ("lpips-heads", "which cannot be read as one"),
        ("metric3d", "404"),
    ):
        assert main(["weights", "fetch", name]) == 1
        _, err = said(capsys)
        sentence = [line for line in err.splitlines() if line.startswith("minislam: ")]
        assert len(sentence) == 1 and words in sentence[0]
    assert list((tmp_path / "cache/weights").iterdir()) == []
    mine = tmp_path / "cache/weights/dinov2_reg_small_finetuned.pth"
    mine.write_bytes(b"mine")
    assert main(["weights", "fetch", "fit3d"]) == 1
    sentence = said(capsys)[1]
    assert "expected the published dinov2_reg_small" in sentence and mine.read_bytes() == b"mine"
    assert sentence.endswith("; remove it, then fetch it again\n")


def test_a_name_that_is_not_in_the_list_fetches_nothing(server: Server, capsys):
    assert main(["weights", "fetch", "droid", "metric3d-larg"]) == 1
    assert "found 'metric3d-larg'; the nearest is metric3d-large" in said(capsys)[1]
    assert server.asked == []


# Check


def lines_of(folder: Path, capsys) -> dict[str, str]:
    assert main(["weights", "check", str(folder)]) == 0
    rows = capsys.readouterr().out.splitlines()
    return {row.split()[0]: row for row in rows}


def other(name: str) -> str:
    return f"; NOT the published {name}, its sha256 is another"  # these weights are made up


def test_every_file_is_recognised_with_its_size_and_its_flag(tmp_path: Path, capsys):
    lines = lines_of(write_all(tmp_path / "weights"), capsys)
    assert {name: line.split("MB  ")[1] for name, line in lines.items()} == {
        "alex.pth": "LPIPS linear weights, complete: --lpips-heads",
        "alexnet-owt-7be5be79.pth": (
            f"an image classifier of torchvision, complete: --lpips-trunk{other('lpips-trunk')}"
        ),
        "depth_anything_v2_metric_hypersim_vits.pth": (
            "Depth Anything V2 (ViT of width 384, no registers), complete: "
            f"--depth depth-anything{other('depth-anything')}"
        ),
        "dinov2_reg_small_finetuned.pth": (
            "FiT3D (ViT of width 384, with registers), complete: "
            f"--features fit3d{other('fit3d')}"
        ),
        "droid.pth": "DROID-SLAM, complete: --flow droid",
        "metric_depth_vit_small_800k.pth": (
            "Metric3D v2 (ViT of width 384, with registers), complete: "
            f"--depth metric3d{other('metric3d')}"
        ),
    }  # fmt: skip
    size = (tmp_path / "weights/droid.pth").stat().st_size / 1e6
    assert f" {size:.1f} MB " in lines["droid.pth"]


def test_what_is_broken_or_foreign_is_said_on_its_line(tmp_path: Path, capsys):
    fit3d, (trunk, heads) = tiny_fit3d(), lpips_files()
    torch.save(fit3d, tmp_path / "whole.pth")
    whole = (tmp_path / "whole.pth").read_bytes()
    (tmp_path / "half.pth").write_bytes(whole[: len(whole) // 2])
    torch.save({n: t for n, t in fit3d.items() if n != "norm.bias"}, tmp_path / "lacking.pth")
    torch.save({n: t for n, t in trunk.items() if ".10." not in n}, tmp_path / "trunk.pt")
    torch.save({n: t for n, t in heads.items() if "lin4" not in n}, tmp_path / "heads.pt")
    torch.save({"anything": torch.ones(2)}, tmp_path / "other.pth")
    (tmp_path / "notes.txt").write_text("not a checkpoint")
    lines = lines_of(tmp_path, capsys)
    assert set(lines) == {
        "half.pth", "heads.pt", "lacking.pth", "other.pth", "trunk.pt", "whole.pth"
    }  # fmt: skip
    assert "unreadable, NOT usable: expected a PyTorch checkpoint" in lines["half.pth"]
    assert "NOT usable: expected the tensor norm.bias" in lines["lacking.pth"]
    assert "NOT usable: expected features.10.weight of AlexNet" in lines["trunk.pt"]
    assert "NOT usable: expected five LPIPS heads" in lines["heads.pt"]
    assert "something unknown (1 tensors, the first is anything), of no use" in lines["other.pth"]
    assert lines["whole.pth"].endswith("complete: --features fit3d")


def test_a_folder_without_checkpoints_is_one_sentence(tmp_path: Path, capsys):
    (file := tmp_path / "droid.pt").write_bytes(b"")
    (tmp_path / "empty").mkdir()
    for folder, words in (
        (tmp_path / "empty", "found none in"),
        (tmp_path / "nowhere", f"found no folder at {tmp_path}/nowhere; check the path"),
        (file, f"found the file {file}; give the folder it is in"),
    ):
        assert main(["weights", "check", str(folder)]) == 1
        said = capsys.readouterr().err
        assert said.startswith("minislam: expected a folder with checkpoint files")
        assert said.count("\n") == 1 and words in said
