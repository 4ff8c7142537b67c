"""Compiled networks against numpy: any ends, saturation, numbers that are none, alignment, ranges."""

import networks
import numpy as np
import pytest

from hilrunner.base import compiled
from hilrunner.plant import generic_kernel, head, vector_kernel
from hilrunner.plant.network import SurrogateNetworks, assemble_bank, forward_at, forward_many, outside_training

ROUNDING = 2e-14  # sums of up to 25 products of order 1, scaled by up to 2


def evaluate(network, inputs):
    bank = assemble_bank([SurrogateNetworks(1, {"flow": network})])
    outputs = np.full((len(inputs), network.output_count), np.nan)
    failures = forward_many(bank.words, bank.axis_start[0, 0], np.ascontiguousarray(inputs, float), outputs)
    return outputs, failures


@pytest.mark.parametrize("inputs", [1, 2, 3, 4, 5, 8])
@pytest.mark.parametrize("outputs", [1, 2, 4])
def test_vector_kernel_equals_numpy(inputs, outputs):
    network = networks.make(inputs, outputs, seed=inputs * 10 + outputs)
    assert network.kernel == head.KERNEL_VECTOR
    points = np.random.default_rng(1).normal(size=(400, inputs)) * 2.0
    got, failures = evaluate(network, points)
    assert failures == 0
    np.testing.assert_allclose(got, networks.values(network, points), rtol=0.0, atol=ROUNDING)


@pytest.mark.parametrize("kind", range(1, 8))
def test_generic_kernel_equals_numpy_for_every_activation(kind):
    network = networks.make(4, 3, hidden=(7, 33, 5), activations=(kind, kind, kind, 0), seed=kind)
    assert network.kernel == head.KERNEL_GENERIC
    points = np.random.default_rng(2).normal(size=(200, 4)) * 3.0
    got, _ = evaluate(network, points)
    np.testing.assert_allclose(got, networks.values(network, points), rtol=0.0, atol=5e-14)


def test_both_kernels_agree_on_the_same_network():
    network = networks.make(5, 2, seed=4)
    points = np.random.default_rng(3).normal(size=(100, 5))
    vector, _ = evaluate(network, points)
    scaling = (network.input_offset, network.input_scale, network.output_scale, network.output_offset)
    packed = generic_kernel.pack(network.weights, network.biases, *scaling)
    words = np.concatenate([[5, 25, 10, 20, 2], [1, 1, 1, 0], packed]).astype(float)
    generic = np.zeros((100, 2))
    for row in range(100):
        generic_kernel._forward(
            words, 9, 0, 5, 4, points[row], 0, generic[row], 0, np.zeros(512), np.zeros(512)
        )  # fmt: skip
    np.testing.assert_allclose(vector, generic, rtol=0.0, atol=ROUNDING)


def test_units_saturate_and_are_odd_and_never_leave_one():
    points = np.array([0.0, 1e-3, 0.5, 3.0, 19.0, 22.0, 1e3, 1e300, np.inf])
    network = networks.make(1, 1, seed=5)
    big = networks.Mlp(
        tuple(w.copy() for w in network.weights), network.biases, networks.TANH,
        np.zeros(1), np.ones(1), np.ones(1), np.zeros(1), -np.ones(1), np.ones(1),
    )  # fmt: skip
    for sign in (1.0, -1.0):
        got, _ = evaluate(big, sign * points[:, None])
        with np.errstate(over="ignore", invalid="ignore"):
            want = networks.values(big, sign * points[:, None])
        finite = np.isfinite(want[:, 0])
        assert finite[:-1].all()
        np.testing.assert_allclose(got[finite], want[finite], rtol=0.0, atol=ROUNDING)


def test_tanh_is_exact_to_a_few_roundings_of_one():
    """A network that is tanh three times over, against numpy's, over twenty thousand points."""
    points = np.concatenate([np.linspace(-25.0, 25.0, 20_001), np.random.default_rng(0).normal(size=2000)])
    weights = [np.zeros((rows, columns)) for rows, columns in ((25, 1), (10, 25), (20, 10), (1, 20))]
    weights[0][0, 0] = 1.0
    weights[1][0, 0] = weights[2][0, 0] = 1.0
    weights[3][0, 0] = 1.0
    network = networks.Mlp(
        tuple(weights), tuple(np.zeros(rows) for rows in (25, 10, 20, 1)), networks.TANH,
        np.zeros(1), np.ones(1), np.ones(1), np.zeros(1), -np.ones(1), np.ones(1),
    )  # fmt: skip
    got, _ = evaluate(network, points[:, None])
    want = np.tanh(np.tanh(np.tanh(points)))
    assert np.abs(got[:, 0] - want).max() < 5e-16


@pytest.mark.parametrize("hidden", [networks.HIDDEN, (6, 5)])
def test_a_nan_input_gives_nan_outputs(hidden):
    network = networks.make(3, 2, hidden=hidden, activations=(1,) * len(hidden) + (0,))
    points = np.array([[0.1, np.nan, 0.2], [0.1, 0.1, 0.2]])
    got, _ = evaluate(network, points)
    assert np.isnan(got[0]).all() and np.isfinite(got[1]).all()


@pytest.mark.parametrize("lanes", [2, 4, 8])
def test_every_vector_width_gives_the_same_numbers(lanes):
    """AVX-512, AVX2 and NEON differ in lanes only; LLVM legalises what this CPU lacks."""
    from numba import types  # isort: skip

    if compiled.numba.config.DISABLE_JIT:
        pytest.skip("NUMBA_DISABLE_JIT is set: this compares machine code, and there is none")
    network = networks.make(4, 2, seed=6)
    kernel = vector_kernel.make_forward(lanes)
    scaling = (network.input_offset, network.input_scale, network.output_scale, network.output_offset)
    packed = vector_kernel.pack(network.weights, network.biases, *scaling, lanes=lanes)
    pointer = types.CPointer(types.float64)

    @compiled.numba.cfunc(types.int64(pointer, pointer, pointer))
    def run(words, x, y):
        return kernel(words, x, y, 4, 2)

    points = np.random.default_rng(7).normal(size=(50, 4))
    got = np.zeros((50, 2))
    kind = run.ctypes
    for row in range(50):
        kind(
            *(
                array.ctypes.data_as(type_)
                for array, type_ in zip((packed, points[row], got[row]), kind.argtypes, strict=True)
            )
        )
    np.testing.assert_allclose(got, networks.values(network, points), rtol=0.0, atol=ROUNDING)


def test_interpreted_vector_kernel_equals_the_compiled_one():
    network = networks.make(3, 2, seed=8)
    points = np.random.default_rng(8).normal(size=(20, 3))
    compiled_values, _ = evaluate(network, points)
    bank = assemble_bank([SurrogateNetworks(1, {"flow": network})])
    start = bank.axis_start[0, 0] + head.HEAD_SIZE
    for row in range(20):
        y = np.zeros(2)
        vector_kernel.forward_interpreted(bank.words, start, points[row], 0, y, 0, 3, 2)
        np.testing.assert_allclose(y, compiled_values[row], rtol=0.0, atol=ROUNDING)


def test_a_bank_keeps_networks_apart_and_on_cache_lines():
    a, b = networks.make(3, 1, seed=1), networks.make(2, 2, hidden=(5,), activations=(1, 0), seed=2)
    bank = assemble_bank([None, SurrogateNetworks(1, {"supply": a, "return": b}), None])
    assert bank.axis_start[0].tolist() == [-1, -1] and bank.axis_start[2].tolist() == [-1, -1]
    assert bank.axis_recipe.tolist() == [0, 1, 0]
    for role, network in ((0, a), (1, b)):
        start = bank.axis_start[1, role]
        assert (bank.words.ctypes.data + 8 * start) % 64 == 0
        work = np.zeros(16)
        work[: network.input_count] = 0.3
        assert forward_at(bank.words, start, work, 0, 8) == 0
        want = networks.values(network, np.full((1, network.input_count), 0.3))[0]
        np.testing.assert_allclose(work[8 : 8 + network.output_count], want, rtol=0.0, atol=ROUNDING)


def test_range_check_sees_every_input_and_nan():
    network = networks.make(3, 1)
    bank = assemble_bank([SurrogateNetworks(1, {"flow": network})])
    start = bank.axis_start[0, 0]
    inside = 0.5 * (network.input_low + network.input_high)
    work = np.zeros(16)
    work[:3] = inside
    assert not outside_training(bank.words, start, work, 0)
    for place in range(3):
        for value in (network.input_high[place] * 1.001, network.input_low[place] * 1.001, np.nan, np.inf):
            work[:3] = inside
            work[place] = value
            assert outside_training(bank.words, start, work, 0)
    work[:3] = network.input_high
    assert not outside_training(bank.words, start, work, 0)
