import itertools

import torch

from minislam.uncertainty import MlpSnapshots, UncertaintyMLP
from tests.helpers import generator

FEATURES = torch.ones(2, 3, 4)


def shift(mlp: UncertaintyMLP, by: float) -> None:
    with torch.no_grad():
        mlp.biases[-1] += by


def test_a_snapshot_answers_as_the_mlp_did_then():
    mlp = UncertaintyMLP(4, generator(0))
    snapshots = MlpSnapshots(mlp)
    expected = []
    for moment in (5, 9, 20):
        shift(mlp, 0.5)
        snapshots.record(moment)
        expected.append(mlp(FEATURES).detach())
    shift(mlp, 3.0)
    assert snapshots.moments == [5, 9, 20]
    for moment, index in [(0, 0), (5, 0), (8, 0), (9, 1), (19, 1), (20, 2), (99, 2)]:
        assert torch.equal(snapshots.predict(moment, FEATURES), expected[index])
    assert not torch.equal(mlp(FEATURES), expected[-1])


def test_a_long_run_keeps_few_snapshots_spread_over_all_of_it():
    mlp = UncertaintyMLP(4, generator(0))
    snapshots = MlpSnapshots(mlp)
    for moment in range(500):
        snapshots.record(moment)
    moments = snapshots.moments
    assert 16 <= len(moments) <= 32 and moments[0] == 0 and moments[-1] > 450
    gaps = {later - earlier for earlier, later in itertools.pairwise(moments)}
    assert gaps == {16}
