"""The Latin hypercube that can be made in pieces, and the samples on disk made from it."""

import json

import numpy as np
import pytest

from hilrunner.base.errors import UsageError
from hilrunner.training.dataset import MANIFEST, Data, make_samples, scaling_of
from hilrunner.training.problem import Problem, Quantity
from hilrunner.training.sampling import splits, unit_points


@pytest.mark.parametrize("count", [1, 2, 7, 64, 1000, 4097])
@pytest.mark.parametrize("dimensions", [1, 4])
def test_every_slice_of_every_coordinate_holds_exactly_one_point(count, dimensions):
    points = unit_points(0, count, count, dimensions, seed=3)
    assert points.shape == (count, dimensions) and points.min() >= 0.0 and points.max() < 1.0
    for column in points.T:
        assert sorted((column * count).astype(int)) == list(range(count))


def test_pieces_are_the_whole_and_seeds_differ():
    whole = unit_points(0, 500, 500, 3, seed=1)
    pieces = [unit_points(first, 100, 500, 3, seed=1) for first in (400, 0, 200, 100, 300)]
    np.testing.assert_array_equal(np.concatenate([pieces[1], pieces[3], pieces[2], pieces[4], pieces[0]]), whole)
    assert not np.array_equal(unit_points(0, 500, 500, 3, seed=2), whole)
    with pytest.raises(ValueError):
        unit_points(400, 101, 500, 3, seed=1)


def test_coordinates_are_not_correlated_and_fill_like_scipys():
    """Correlation and discrepancy of the keyed permutation against scipy's shuffled hypercube."""
    from scipy.stats import qmc

    mine = unit_points(0, 2000, 2000, 4, seed=5)
    correlation = np.corrcoef(mine.T) - np.eye(4)
    assert np.abs(correlation).max() < 0.06
    theirs = [qmc.discrepancy(qmc.LatinHypercube(4, rng=seed).random(2000)) for seed in range(5)]
    assert qmc.discrepancy(mine) < 2.0 * max(theirs)


def test_splits_share_no_point():
    train, validation, test = splits(60, 25, 15)
    assert (train.first, validation.first, test.first) == (0, 60, 85)
    rows = [unit_points(split.first, split.count, 100, 2, seed=1) for split in (train, validation, test)]
    slices = [set((part[:, 0] * 100).astype(int)) for part in rows]
    assert not (slices[0] & slices[1] or slices[0] & slices[2] or slices[1] & slices[2])


def parabola(unsolved_below: float = -1.0) -> Problem:
    """y = x0^2 + x1, for which some points can be declared unsolved."""

    def answer(points):
        targets = points[:, :1] ** 2 + points[:, 1:]
        return points, targets, points[:, 0] > unsolved_below

    inputs = (Quantity("a_pa", "Pa", 0.0, 1.0), Quantity("b_pa", "Pa", 0.0, 1.0))
    return Problem("flow", inputs, (Quantity("c_pa", "Pa"),), 2, answer, {"mass_kg": 1.0})


def test_samples_are_resumed_and_equal_to_those_made_in_one_go(tmp_path):
    sizes = splits(250, 60, 40)
    done = []
    whole = make_samples(parabola(), tmp_path / "a", sizes, seed=1, chunk_rows=100, report=lambda *x: done.append(x))
    assert done[-1] == (350, 350) and len(whole.chunks) == 5
    make_samples(parabola(), tmp_path / "b", sizes, seed=1, chunk_rows=100)
    (tmp_path / "b" / "train-00001.npy").unlink()
    (tmp_path / "b" / "test-00000.npy").write_bytes(b"damaged")
    counted = []

    def counting(points):
        counted.append(len(points))
        return parabola().answer(points)

    from dataclasses import replace

    again = make_samples(replace(parabola(), answer=counting), tmp_path / "b", sizes, seed=1, chunk_rows=100)
    assert sorted(counted) == [40, 100]  # only what was missing or damaged
    for split in ("train", "validation", "test"):
        np.testing.assert_array_equal(again.load(split)[0], whole.load(split)[0])
    assert whole.load("train", 130)[0].shape == (130, 2)


def test_a_folder_of_other_samples_is_refused(tmp_path):
    make_samples(parabola(), tmp_path, splits(20, 5, 5), seed=1)
    with pytest.raises(UsageError, match="other ranges, seed or sizes"):
        make_samples(parabola(), tmp_path, splits(20, 5, 5), seed=2)
    (tmp_path / MANIFEST).write_text("{")
    with pytest.raises(UsageError, match="damaged"):
        make_samples(parabola(), tmp_path, splits(20, 5, 5), seed=1)


def test_unsolved_points_are_counted_and_left_out(tmp_path):
    samples = make_samples(parabola(0.25), tmp_path, splits(100, 20, 20), seed=1, chunk_rows=50)
    # a Latin hypercube of 140 has exactly 35 points below a quarter
    assert samples.unsolved() == 35
    rows = sum(len(samples.load(split)[0]) for split in ("train", "validation", "test"))
    assert rows == 105 and samples.load("train")[0][:, 0].min() > 0.25
    assert sum(chunk["unsolved"] for chunk in json.loads((tmp_path / MANIFEST).read_text())["chunks"].values()) == 35


def test_data_from_disk_and_from_memory_are_the_same_batches(tmp_path):
    samples = make_samples(parabola(), tmp_path, splits(230, 10, 10), seed=1, chunk_rows=100)
    inputs, targets = samples.load("train")
    scaling = scaling_of(samples.problem, targets)
    memory, disk = Data(scaling, (inputs, targets)), Data(scaling, files=samples.files("train"))
    assert memory.target_count == disk.target_count == 230
    joined = [
        np.concatenate([part[k].numpy() for part in data.batches(64, "cpu")]) for data in (memory, disk) for k in (0, 1)
    ]
    np.testing.assert_array_equal(joined[0], joined[2])
    np.testing.assert_array_equal(joined[1], joined[3])
    assert joined[0].min() >= -1.0 and joined[1].min() == -1.0 and joined[1].max() == 1.0
