"""Vessel heave in a sea state and what it does to an actuator: to the load, and to the motion that would compensate it."""

import math
from typing import NamedTuple

import numpy as np

from hilrunner.base.compiled import entry, hot
from hilrunner.base.errors import ProfileError
from hilrunner.plant.load import GRAVITY_MPS2

COMPONENT_ANGULAR_FREQUENCY = 0  # rad/s
COMPONENT_AMPLITUDE = 1  # m of heave
COMPONENT_PHASE = 2  # rad
COMPONENT_SIZE = 3

_BIN_COUNT = 100
_LOWEST_RADPS = 0.25
_HIGHEST_RADPS = 2.5
_PEAK_ENHANCEMENT = 3.3


class Vessel(NamedTuple):
    """A box hull in beam seas."""

    breadth_m: float = 18.0
    draught_m: float = 5.0


def jonswap_m2s(angular_frequency_radps, significant_height_m: float, peak_period_s: float) -> np.ndarray:
    """JONSWAP spectral density over angular frequency (DNV-RP-C205, 3.5.5, peak enhancement 3.3); m^2 s."""
    w = np.asarray(angular_frequency_radps, dtype=np.float64)
    peak = 2.0 * math.pi / peak_period_s
    width = np.where(w <= peak, 0.07, 0.09)
    enhancement = _PEAK_ENHANCEMENT ** np.exp(-((w - peak) ** 2) / (2.0 * width**2 * peak**2))
    pierson_moskowitz = 5.0 / 16.0 * significant_height_m**2 * peak**4 * w**-5.0 * np.exp(-1.25 * (w / peak) ** -4.0)
    return (1.0 - 0.287 * math.log(_PEAK_ENHANCEMENT)) * pierson_moskowitz * enhancement


def heave_response(angular_frequency_radps, vessel: Vessel | None = None) -> np.ndarray:
    """Heave of the vessel per wave amplitude: exp(-k T) |sin(k B / 2) / (k B / 2)| with k = w^2 / g."""
    hull = vessel or Vessel()
    number = np.asarray(angular_frequency_radps, dtype=np.float64) ** 2 / GRAVITY_MPS2
    return np.exp(-number * hull.draught_m) * np.abs(np.sinc(number * hull.breadth_m / (2.0 * math.pi)))


def heave_components(
    significant_height_m: float, peak_period_s: float, seed: int, vessel: Vessel | None = None
) -> np.ndarray:
    """The heave as a sum of cosines: one random frequency in each of 100 bins (no repeat period), random phases.

    Args:
        significant_height_m: Hs, above 0 to 20 m.
        peak_period_s: Tp, 2 to 30 s.
        seed: of numpy's default_rng.

    Returns:
        (100, 3) float64: angular frequency rad/s, amplitude m, phase rad.

    Raises:
        ProfileError: a value out of range.
    """
    if not 0.0 < significant_height_m <= 20.0:
        raise ProfileError("wave.significant_height_m", f"{significant_height_m:g} m", "above 0 to 20 m")
    if not 2.0 <= peak_period_s <= 30.0:
        raise ProfileError("wave.peak_period_s", f"{peak_period_s:g} s", "2 to 30 s")
    generator = np.random.default_rng(seed)
    edges = np.linspace(_LOWEST_RADPS, _HIGHEST_RADPS, _BIN_COUNT + 1)
    width = np.diff(edges)
    frequency = edges[:-1] + width * generator.random(_BIN_COUNT)
    density = jonswap_m2s(frequency, significant_height_m, peak_period_s)
    components = np.empty((_BIN_COUNT, COMPONENT_SIZE))
    components[:, COMPONENT_ANGULAR_FREQUENCY] = frequency
    components[:, COMPONENT_AMPLITUDE] = np.sqrt(2.0 * density * width) * heave_response(frequency, vessel)
    components[:, COMPONENT_PHASE] = 2.0 * math.pi * generator.random(_BIN_COUNT)
    return components


def no_heave() -> np.ndarray:
    """Components of a calm sea: none."""
    return np.zeros((0, COMPONENT_SIZE))


@hot
def heave(components, t_s):
    """Heave of the vessel, its speed and acceleration, upwards: (m, m/s, m/s^2)."""
    z = 0.0
    dz = 0.0
    ddz = 0.0
    for i in range(components.shape[0]):
        w = components[i, 0]
        angle = w * t_s + components[i, 2]
        value = components[i, 1] * math.cos(angle)
        z += value
        dz -= components[i, 1] * w * math.sin(angle)
        ddz -= w * w * value
    return z, dz, ddz


@hot
def load_scale(components, t_s):
    """Factor of the static load under base heave, 1 + z''/g: exact for a rigid crane with a taut vertical rope."""
    ddz = 0.0
    for i in range(components.shape[0]):
        w = components[i, 0]
        ddz -= w * w * components[i, 1] * math.cos(w * t_s + components[i, 2])
    return 1.0 + ddz / GRAVITY_MPS2


@hot
def heave_motion(components, t_s):
    """Heave of the vessel and its speed, upwards: (m, m/s); zero in a calm sea."""
    z = 0.0
    dz = 0.0
    for i in range(components.shape[0]):
        w = components[i, 0]
        angle = w * t_s + components[i, 2]
        z += components[i, 1] * math.cos(angle)
        dz -= components[i, 1] * w * math.sin(angle)
    return z, dz


@hot
def reference_motion(components, t_s, rest_position_m, tip_rise_per_travel):
    """Rod position and speed that keep the hook still: x0 - z / rho, -z' / rho; (m, m/s)."""
    z, dz, _ = heave(components, t_s)
    return rest_position_m - z / tip_rise_per_travel, -dz / tip_rise_per_travel


@entry
def _heave_series(components, times_s, out):
    for i in range(times_s.shape[0]):
        out[i, 0], out[i, 1], out[i, 2] = heave(components, times_s[i])


@entry
def _load_scale_series(components, times_s, out):
    for i in range(times_s.shape[0]):
        out[i] = load_scale(components, times_s[i])


def heave_series(components: np.ndarray, times_s: np.ndarray) -> np.ndarray:
    """(n, 3) heave m, speed m/s, acceleration m/s^2 at (n,) times."""
    out = np.empty((len(times_s), 3))
    _heave_series(components, np.ascontiguousarray(times_s, dtype=np.float64), out)
    return out


def load_scale_series(components: np.ndarray, times_s: np.ndarray) -> np.ndarray:
    """(n,) load factors at (n,) times, the same numbers as `load_scale`."""
    out = np.empty(len(times_s))
    _load_scale_series(components, np.ascontiguousarray(times_s, dtype=np.float64), out)
    return out
