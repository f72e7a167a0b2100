"""Cases: the same in every notebook, and hidden ones where the grader asks for them."""

import torch

from minislam.checks import Case, check_function
from minislam.checks.cases import drawn, normals


def random_case(seed: int) -> Case:
    return Case((normals(seed, 3),), f"seed {seed}")


def test_cases_are_drawn_and_others_under_a_seed(monkeypatch):
    ones, seen = Case((torch.ones(3),), "three ones"), []

    def student(x):
        seen.append(x.double().sum().item())
        return 2 * x

    def verdict():
        return check_function(student, lambda x: 2 * x, [ones, *drawn(random_case)])

    assert "4 of 4 cases" in verdict().sentence
    monkeypatch.setenv("MINISLAM_SEED", "5")
    assert "7 of 7 cases" in verdict().sentence
    assert seen[:4] == seen[4:8] and len(set(seen)) == 7
    monkeypatch.setenv("MINISLAM_SEED", "a word")
    assert "4 of 4 cases" in verdict().sentence


def test_hidden_seeds_leave_every_remainder(monkeypatch):
    seeds = []
    for hidden in range(5):
        monkeypatch.setenv("MINISLAM_SEED", str(hidden))
        drawn(lambda seed: seeds.append(seed) if seed > 2 else None)
    for divisor in range(2, 8):  # many checks take a size from one
        assert {seed % divisor for seed in seeds} == set(range(divisor))
