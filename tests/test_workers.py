"""Helpers share the work, and nothing but the time depends on them."""

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace

import pytest
import torch

from minislam.errors import InputError
from minislam.workers import AT_ONCE, MOST_WORKERS, Workers, idle_cores
from tests.mapping.plane_scene import CONFIG, make_mapper, wall_keyframe
from tests.worker_calls import Pair, dies_in_a_helper, fails, prints, process_of, swapped


@pytest.fixture(scope="module")
def two():
    with Workers(2) as workers:
        yield workers


@pytest.fixture
def four_cores(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(os, "cpu_count", lambda: 4)  # no warning of too few


def is_running(pid: int) -> bool:
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


# Known answers


@pytest.mark.slow
def test_calls_are_shared_and_answered_in_their_order(two):
    pids = two.map(process_of, [(0.3,)] * 2)
    assert os.getpid() in pids and len(set(pids)) == 2
    assert two.map(prints, [(number,) for number in range(9)]) == list(range(9))
    assert two.map(prints, []) == []


def test_a_stream_asks_for_few_calls_at_a_time():
    asked = []

    def calls():
        for number in range(2 * AT_ONCE + 1):
            asked.append(number)
            yield (number,)

    answers = Workers().stream(prints, calls())
    assert next(answers) == 0 and len(asked) == AT_ONCE
    assert list(answers) == asked[1:] and len(asked) == 2 * AT_ONCE + 1
    assert list(Workers().stream(prints, [])) == []


@pytest.mark.slow
def test_a_call_runs_beside_others_and_is_computed_here_if_it_must(two):
    begun = time.perf_counter()
    result = two.start(process_of, 0.5)
    assert time.perf_counter() - begun < 0.2
    assert two.map(process_of, [(0.0,)] * 2) == 2 * [os.getpid()]  # none waits for a busy helper
    assert result() != os.getpid()
    assert Workers().start(process_of, 0.0)() == os.getpid()
    with Workers(2) as workers, pytest.raises(ZeroDivisionError, match="number 3"):
        workers.start(fails, 3)()


def test_tensors_and_records_come_through_unchanged(two):
    transposed = torch.arange(6.0, dtype=torch.float64).reshape(2, 3).T
    pairs = [
        Pair(transposed, None, (1, 2)),
        Pair(torch.tensor([True, False]), torch.zeros(0, 3), (3, 4)),
        Pair(torch.tensor(1e-45), torch.tensor([2**62]), (0, -1)),
    ]
    for answers in (
        two.map(swapped, [(pair, 1.0) for pair in pairs]),
        Workers().map(swapped, [(p, 1.0) for p in pairs]),
    ):
        for pair, answer in zip(pairs, answers, strict=True):
            back = answer["swapped"]
            assert torch.equal(back.second, pair.first) and back.second.is_contiguous()
            assert back.second.dtype == pair.first.dtype and back.sizes == pair.sizes[::-1]


@pytest.mark.filterwarnings("error::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_type_that_numpy_has_not_comes_through(two):
    pair = Pair(torch.ones(2, 2, dtype=torch.bfloat16), None, (1, 2))
    for answer in two.map(swapped, [(pair, 1.0)] * 2):  # one of them in the helper
        assert torch.equal(answer["swapped"].second, pair.first)


@pytest.mark.slow
def test_the_map_has_the_same_bytes_with_one_and_two_workers_and_with_one_killed(two, four_cores):
    def optimised(workers, kills=None):
        mapper = make_mapper(replace(CONFIG, init_iterations=7))
        mapper._workers = workers
        mapper.initialise([wall_keyframe(0), wall_keyframe(1)], kills)
        poses = [wall_keyframe(k).T_camera_world for k in (0, 1)]
        images, beta = [wall_keyframe(0).image] * 2, mapper.beta_of(mapper.images[0])
        refined = mapper.refine_poses(poses, images, [beta, beta])
        return [*mapper.gaussians.parameters.values(), *mapper.mlp.parameters(), *refined]

    warnings = []
    killed = Workers(2, warn=warnings.append)

    def kill(done, total):
        if done == 4:
            killed._helpers[0]._process.kill()

    alone = optimised(Workers())
    for other in (optimised(two), optimised(killed, kill)):
        assert all(torch.equal(a, b) for a, b in zip(alone, other, strict=True))
    assert warnings == ["a worker process has ended; the run goes on with 1"]
    assert two._helpers and not killed._helpers


# Degenerate input


def test_more_workers_than_processors_are_warned_of(monkeypatch):
    monkeypatch.setattr(os, "cpu_count", lambda: 1)
    warnings: list[str] = []
    Workers(1, warn=warnings.append).close()
    assert not warnings
    Workers(2, warn=warnings.append).close()
    assert warnings == ["2 workers on 1 processors are slower; give --workers 1 or fewer"]


@pytest.mark.slow
def test_a_helper_that_dies_at_a_call_is_replaced_by_this_process(four_cores):
    warnings = []
    with Workers(3, warn=warnings.append) as workers:
        calls = [(os.getpid(), number) for number in range(4)]
        workers.map(process_of, [(0.2,)] * 3)  # all are there
        assert workers.map(dies_in_a_helper, calls) == [0, 1, 2, 3]
        assert len(warnings) == 1


@pytest.mark.slow
def test_helpers_end_with_the_block_and_with_a_killed_parent():
    with Workers(2) as workers:
        (pid,) = {*workers.map(process_of, [(0.3,)] * 2)} - {os.getpid()}
    assert not is_running(pid)

    code = (
        "from minislam.workers import Workers; from tests.worker_calls import process_of\n"
        "workers = Workers(2); print(*workers.map(process_of, [(0.3,)] * 2), flush=True)\n"
        "input()"
    )  # no `if __name__`: a plain script, read from -c
    parent = subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    pids = [int(word) for word in parent.stdout.readline().split()]
    (helper,) = set(pids) - {parent.pid}
    os.kill(helper, signal.SIGTERM)  # as `docker stop` may do: the parent decides
    assert is_running(helper)
    parent.kill()
    parent.wait()
    parent.stdout.close()
    parent.stdin.close()
    until = time.monotonic() + 20
    while is_running(helper) and time.monotonic() < until:
        time.sleep(0.05)
    assert not is_running(helper)


def test_one_worker_per_idle_core(monkeypatch):
    monkeypatch.delenv("MINISLAM_WORKERS", raising=False)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: range(8), raising=False)
    for load, expected in ((0.2, MOST_WORKERS), (5.5, 3), (6.0, 2), (20.0, 1)):
        monkeypatch.setattr(os, "getloadavg", lambda load=load: (load, 0, 0), raising=False)
        assert idle_cores() == expected
    monkeypatch.setenv("MINISLAM_WORKERS", "3")
    assert idle_cores() == 3
    monkeypatch.setenv("MINISLAM_WORKERS", "")
    assert idle_cores() == 1  # as if it were not set
    for given in ("3²", "-3", "0", "257", "many"):
        monkeypatch.setenv("MINISLAM_WORKERS", given)
        with pytest.raises(InputError, match=f"at most 256, found '{given}'; choose"):
            idle_cores()
    monkeypatch.delenv("MINISLAM_WORKERS")

    def unknown() -> tuple[float, float, float]:
        raise OSError("Load averages are unobtainable")

    monkeypatch.setattr(os, "getloadavg", unknown, raising=False)
    assert idle_cores() == MOST_WORKERS


# Errors


def test_an_error_of_a_function_is_raised_here(two):
    with pytest.raises(ZeroDivisionError, match="number 1"):
        Workers(2).map(fails, [(1,), (1,)])
    with pytest.raises(InputError, match="expected at least 1 worker, found 0"):
        Workers(0)
