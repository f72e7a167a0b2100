"""Give the command line what it must refuse, and count how it answers.

    python -m tests.benchmarks.bad_inputs [GROUP ...]

Each case is `main` in a process and a folder of its own. Right is one sentence and exit code 1 (2
for wrong usage), or acceptance where a case may be accepted, and no file of the user's changed.
Wrong is a traceback, a crash, a hang, several sentences, the net for foreign errors, or silence.
A run is stopped when all that it reads has been read; those of the group `whole` go to the end.
"""

import os
import re
import shlex
import shutil
import signal
import sys
import tempfile
import warnings
from collections import Counter
from pathlib import Path

import cv2
import numpy as np
import torch

from minislam.cli import main as command_line
from minislam.data.run_folder import RunFolder
from minislam.priors.interfaces import Priors
from minislam.records import Sequence
from minislam.slam import Slam
from tests.benchmarks.bad_commands import commands, config_files, options, outputs, whole_runs
from tests.benchmarks.bad_files import checkpoints, images, lists, priors, videos
from tests.benchmarks.bad_input_case import REFUSED, RUN, WARNED, Case
from tests.brief import brief_runs
from tests.recordings import save, tum_folder, video

ACCEPTED_EXIT = 40  # of a run whose input has been read
GROUPS = (options, config_files, lists, images, videos, priors, commands, outputs, checkpoints,
          whole_runs)  # fmt: skip
# A finished run whose last checkpoint is still there.
FINISHED = Case("finished", "", RUN.format("good").replace("-o out", "-o run"))
LIMIT = 60  # s; what takes longer hangs
OUTPUTS = ("out", "run/log.txt", "run/run.json")  # what a command may write


def template(folder: Path) -> None:
    """Make good inputs of every kind, which the cases spoil."""
    texture = np.random.default_rng(0).integers(0, 256, (20, 27, 3)).astype(np.float32)
    columns, rows = np.meshgrid(np.arange(240) / 9, np.arange(180) / 9)
    large = cv2.remap(texture, columns.astype(np.float32), rows.astype(np.float32), cv2.INTER_CUBIC)
    large = np.clip(large, 0, 255).astype(np.uint8)
    for number in range(4):
        image = large[20:92, 20 + 3 * number : 116 + 3 * number]
        save(folder / f"good/{number}.png", image)
        save(folder / f"photos/{number}.jpg", image)
        save(folder / f"masks/{number}.png", np.zeros((72, 96), np.uint8))
        for kind, shape in (("depth", (72, 96)), ("features", (9, 12, 5))):
            (folder / kind).mkdir(exist_ok=True)
            np.save(folder / kind / f"{number}.npy", np.full(shape, 2 + number, np.float32))
    tum_folder(folder / "tum")
    for name in ("clip.mp4", "clip.mkv"):
        video(folder / name)
    rows = [f"{k} {k} {k * k % 5} 0 0 0 0 1\n" for k in range(6)]
    (folder / "truth.txt").write_text("".join(rows))
    (folder / "mine.txt").write_text("mine")


def read_everything(slam: Slam, sequence: Sequence, config: object, priors: Priors, *_) -> None:
    """Stand for a run: read each frame with all that belongs to it, and end the process."""
    if config.uncertainty.given_masks:
        reads = [sequence.given_mask, sequence.sensor_depth]
    else:
        reads = [sequence.sensor_depth]
    for frame in sequence:
        for read in reads:
            read(frame.frame_index)
        priors.depth(frame, sequence.camera)
        priors.features(frame)
    sys.stderr.flush()
    os._exit(ACCEPTED_EXIT)


def snapshot(folder: Path) -> dict[str, bytes | str]:
    """Return the content of every file below a folder, links and devices by their kind."""
    found: dict[str, bytes | str] = {}
    for path in folder.rglob("*"):
        name = str(path.relative_to(folder))
        if path.is_file() and not path.is_symlink():
            found[name] = path.read_bytes()
        elif not path.is_dir() or path.is_symlink():
            found[name] = os.readlink(path) if path.is_symlink() else "device"
    return found


def answer(case: Case, folder: Path) -> tuple[int, str, float]:
    """Run a case in a child process; return exit code (negative: signal) and stderr."""
    log = folder.parent / "said.txt"
    log.unlink(missing_ok=True)
    child = os.fork()
    if child == 0:
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(LIMIT)
        os.chdir(folder)
        for number in (1, 2):
            os.dup2(os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND), number)
        sys.stdout, sys.stderr = open(1, "w", closefd=False), open(2, "w", closefd=False)
        code = 99
        try:
            torch.set_num_threads(1)
            if case.group == FINISHED.group:
                RunFolder.remove_checkpoint = lambda self: None
            elif case.group == "checkpoints":
                Slam.run = lambda self: os._exit(ACCEPTED_EXIT)
            elif case.group != "whole":
                Slam.__init__ = read_everything
            code = command_line.main(shlex.split(case.command))
        except SystemExit as ended:
            code = ended.code if isinstance(ended.code, int) else 98
        except BaseException:
            import traceback

            traceback.print_exc()
        sys.stderr.flush()
        os._exit(code)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    return code, log.read_text(errors="replace")


def verdict(case: Case, code: int, said: str, changed: list[str]) -> str:
    """Return "right", or in a word what is wrong."""
    if code == -signal.SIGALRM:
        return "hangs"
    if "Traceback" in said or code not in (0, 1, 2, 3, ACCEPTED_EXIT):
        return "crash"
    if changed:
        return "changed " + changed[0]
    if "expected to finish this command" in said:
        return "net"
    lines = [line for line in said.splitlines() if re.match(r"minislam( \w+)*: |  expected ", line)]
    if code in (1, 2) and len(lines) != 1:
        return f"{len(lines)} sentences"
    is_accepted = code not in (1, 2)
    if is_accepted and (
        case.expected == REFUSED or (case.expected == WARNED and "WARNING" not in said)
    ):
        return "silent"
    if not is_accepted and case.expected == "accepted":
        return "refused"
    return "right"


def main() -> None:
    """Print what is not right, and the score by group."""
    words = sys.argv[1:]
    cv2.setNumThreads(1)  # a child has no other threads
    torch.set_num_threads(1)
    warnings.simplefilter("default")
    score: dict[str, Counter[str]] = {}
    with tempfile.TemporaryDirectory() as root, brief_runs():
        os.environ |= {"MINISLAM_CACHE": f"{root}/cache", "MINISLAM_WORKERS": "1"}
        whole, folder = Path(root) / "template", Path(root) / "case"
        whole.mkdir()
        template(whole)
        if words != ["whole"]:  # in a child: a process that has computed is no good parent
            code, said = answer(FINISHED, whole)
            assert code in (0, 3), said
        for case in (case for group in GROUPS for case in group()):
            if words and case.group not in words:
                continue
            needs_run = re.search(r"\brun/|-o run\b|(render|export) run", case.command)
            left_out = None if needs_run else shutil.ignore_patterns("run")
            shutil.copytree(whole, folder, ignore=left_out)
            if case.spoil:
                case.spoil(folder)
            before = snapshot(folder)
            code, said = answer(case, folder)
            after = snapshot(folder)
            changed = [n for n in before if after.get(n) != before[n] and not n.startswith(OUTPUTS)]
            found = verdict(case, code, said, changed)
            score.setdefault(case.group, Counter())[found.split()[0]] += 1
            if found != "right" or "-v" in words:
                print(f"{found:10s} {case.group}: {case.label}: {code} {said.strip()[-300:]}")
            shutil.rmtree(folder)
            sys.stdout.flush()
    if not score:
        raise SystemExit(f"no case is in the groups {words}")
    for group, counts in score.items():
        print(f"{group:12s} {sum(counts.values()):4d}  {dict(counts)}")
    print(sum(score.values(), Counter()))


if __name__ == "__main__":
    main()
