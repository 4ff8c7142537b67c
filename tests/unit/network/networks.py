"""Networks with known numbers, and the same network in plain numpy: what every kernel is measured against."""

import numpy as np
from scipy.special import erf

from hilrunner.plant.generic_kernel import ACTIVATION_LINEAR, ACTIVATION_TANH
from hilrunner.plant.network import Mlp

HIDDEN = (25, 10, 20)
TANH = (ACTIVATION_TANH,) * 3 + (ACTIVATION_LINEAR,)
FUNCTIONS = {
    0: lambda z: z,
    1: np.tanh,
    2: lambda z: 1.0 / (1.0 + np.exp(-z)),
    3: lambda z: np.maximum(z, 0.0),
    4: lambda z: z / (1.0 + np.exp(-z)),
    5: lambda z: np.logaddexp(0.0, z),
    6: lambda z: np.where(z > 0.0, z, np.expm1(z)),
    7: lambda z: 0.5 * z * (1.0 + erf(z / np.sqrt(2.0))),
}


def make(inputs: int, outputs: int, hidden=HIDDEN, activations=TANH, seed: int = 0, gain: float = 1.0) -> Mlp:
    """A network with random numbers, scaled at both ends."""
    random = np.random.default_rng(seed)
    sizes = (inputs, *hidden, outputs)
    weights = tuple(gain * random.normal(size=(b, a)) / np.sqrt(a) for a, b in zip(sizes[:-1], sizes[1:], strict=True))
    biases = tuple(0.5 * random.normal(size=rows) for rows in sizes[1:])
    low = -1.0 - random.random(inputs)
    return Mlp(
        weights,
        biases,
        tuple(activations),
        input_offset=random.normal(size=inputs),
        input_scale=0.5 + random.random(inputs),
        output_scale=1.0 + random.random(outputs),
        output_offset=random.normal(size=outputs),
        input_low=low,
        input_high=-low,
    )


def values(network: Mlp, inputs: np.ndarray) -> np.ndarray:
    """Outputs (n, o) by numpy."""
    z = (inputs - network.input_offset) * network.input_scale
    for weight, bias, kind in zip(network.weights, network.biases, network.activations, strict=True):
        z = FUNCTIONS[kind](z @ weight.T + bias)
    return z * network.output_scale + network.output_offset
