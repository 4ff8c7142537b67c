"""tanh without a call to the library: one division, no table, the same formula as the networks' vector code.

tanh(x) = (E - 1)/(E + 1), E = exp(2x) = 2^k 2^f with k integer, |f| <= 1/2; 2^f = (Q + f P)/(Q - f P) with P, Q quadratics in
f^2 (Chebyshev interpolation of tanh(f ln 2 / 2)/f, relative error 5e-18).
"""

import math

import numpy as np

from hilrunner.base.compiled import inlined

PRESCALE = 2.0 / math.log(2.0)  # exp(2x) = 2^(x * PRESCALE)
P0, P1 = 65551.029892973614204, 874.74373134673126334
Q0, Q1, Q2 = 189140.29150351446282, 10096.728812044315471, 43.300557165732710361
ROUNDING = 1.5 * 2.0**52  # adding it leaves the nearest integer in the low bits of the mantissa


@inlined
def tanh_of_size(size):
    """tanh of a number of 0 to 20, absolute error below 3e-16; every step is one IEEE operation, so every CPU agrees."""
    power = size * PRESCALE
    shifted = power + ROUNDING
    f = power - (shifted - ROUNDING)
    square = f * f
    odd = f * ((square + P1) * square + P0)
    even = (Q2 * square + Q1) * square + Q0
    exponent = np.float64(shifted).view(np.int64) << np.int64(52)
    bits = np.float64(even + odd).view(np.int64) + exponent
    grown = np.int64(bits).view(np.float64)
    below = even - odd
    return (grown - below) / (grown + below)
