"""Load on the rod: force F_L(x) and equivalent mass M_eq(x) as piecewise cubics, linear outside their knots."""

import math
from typing import NamedTuple

import numpy as np

from hilrunner.base.compiled import inlined
from hilrunner.base.errors import ProfileError

GRAVITY_MPS2 = 9.81
KNOT_LIMIT = 129
# columns of a coefficient row: force c0..c3, mass c0..c3; value = c0 + d (c1 + d (c2 + d c3)), d from the left knot
SEGMENT_COEFFICIENTS = 8

# A load as compiled code reads it. One flat record: passing arrays from function to function costs reference counts.
LOAD = np.dtype(
    [
        ("knot_count", "i8"),
        ("inverse_spacing_pm", "f8"),  # 1 / knot distance where uniform, else 0
        ("has_mass", "i8"),  # 0: the mass columns are zero
        ("knots_m", "f8", (KNOT_LIMIT,)),
        ("coefficients", "f8", (KNOT_LIMIT + 1, SEGMENT_COEFFICIENTS)),
    ]
)


class LoadTable(NamedTuple):
    """Load of one axis, cold."""

    knots_m: np.ndarray  # (n,) float64, increasing, n >= 2
    coefficients: np.ndarray  # (n + 1, 8) float64: rows 0 and n are the linear continuations outside
    inverse_spacing_pm: float  # 1 / knot distance where uniform, else 0
    has_mass: bool  # False: the mass columns are zero

    @property
    def force_n(self) -> np.ndarray:
        """The force at the knots, (n,) N."""
        return self.coefficients[1:, 0]

    @property
    def mass_kg(self) -> np.ndarray:
        """The equivalent mass at the knots, (n,) kg."""
        return self.coefficients[1:, 4]

    def record(self) -> np.ndarray:
        """The same as a (1,) LOAD record array."""
        packed = np.zeros(1, LOAD)
        count = len(self.knots_m)
        packed["knot_count"] = count
        packed["inverse_spacing_pm"] = self.inverse_spacing_pm
        packed["has_mass"] = self.has_mass
        packed["knots_m"][0, :count] = self.knots_m
        packed["coefficients"][0, : count + 1] = self.coefficients
        return packed


@inlined
def segment_of(load, x_m):
    """Row of the coefficients that holds x: 0 left of the knots, knot_count right of them; NaN gives 0."""
    knots = load["knots_m"]
    last = load["knot_count"] - 1
    if not x_m >= knots[0]:
        return 0
    if x_m >= knots[last]:
        return last + 1
    if load["inverse_spacing_pm"] > 0.0:
        return 1 + min(int((x_m - knots[0]) * load["inverse_spacing_pm"]), last - 1)
    low = 0
    high = last
    while high - low > 1:
        middle = (low + high) >> 1
        if x_m >= knots[middle]:
            low = middle
        else:
            high = middle
    return low + 1


@inlined
def load_force_n(load, x_m):
    """Static load force at rod position x, positive against extension; N."""
    row = segment_of(load, x_m)
    d = x_m - load["knots_m"][max(row - 1, 0)]
    c = load["coefficients"]
    return c[row, 0] + d * (c[row, 1] + d * (c[row, 2] + d * c[row, 3]))


@inlined
def load_force_and_mass(load, x_m):
    """Static load force, equivalent mass of the load at the rod, and the slope of that mass; N, kg, kg/m."""
    row = segment_of(load, x_m)
    d = x_m - load["knots_m"][max(row - 1, 0)]
    c = load["coefficients"]
    force = c[row, 0] + d * (c[row, 1] + d * (c[row, 2] + d * c[row, 3]))
    if load["has_mass"] == 0:
        return force, 0.0, 0.0
    c1, c2, c3 = c[row, 5], c[row, 6], c[row, 7]
    return force, c[row, 4] + d * (c1 + d * (c2 + d * c3)), c1 + d * (2.0 * c2 + d * 3.0 * c3)


def from_table(x_m, force_n, mass_kg=None) -> LoadTable:
    """PCHIP through given knots.

    Args:
        x_m: (n,) increasing rod positions, m.
        force_n: (n,) N.
        mass_kg: (n,) equivalent mass, kg; None: the load has no inertia of its own.

    Raises:
        ProfileError: fewer than two knots or more than KNOT_LIMIT, knots not increasing, values not finite, a negative mass.
    """
    x = np.ascontiguousarray(x_m, dtype=np.float64)
    force = np.ascontiguousarray(force_n, dtype=np.float64)
    mass = np.zeros_like(force) if mass_kg is None else np.ascontiguousarray(mass_kg, dtype=np.float64)
    _check_table(x, force, mass)
    coefficients = np.zeros((len(x) + 1, SEGMENT_COEFFICIENTS))
    for column, values in ((0, force), (4, mass)):
        coefficients[:, column : column + 4] = _cubics_with_linear_ends(x, values)
    spacing = np.diff(x)
    uniform = np.allclose(spacing, spacing[0], rtol=1e-9, atol=0.0)
    return LoadTable(x, coefficients, 1.0 / spacing[0] if uniform else 0.0, bool(np.any(mass)))


def _check_table(x: np.ndarray, force: np.ndarray, mass: np.ndarray) -> None:
    place = "load table"
    if x.ndim != 1 or len(x) < 2 or force.shape != x.shape or mass.shape != x.shape:
        raise ProfileError(place, f"shapes {x.shape}, {force.shape}, {mass.shape}", "equal lengths, at least 2 knots")
    if len(x) > KNOT_LIMIT:
        raise ProfileError(place, f"{len(x)} knots", f"at most {KNOT_LIMIT}", "thin the table out")
    if not (np.isfinite(x).all() and np.isfinite(force).all() and np.isfinite(mass).all()):
        raise ProfileError(place, "a value is not finite", "numbers")
    if np.any(np.diff(x) <= 0.0):
        raise ProfileError(place, "the positions do not increase", "strictly increasing positions")
    if np.any(mass < 0.0):
        raise ProfileError(place, f"negative equivalent mass {mass.min():g} kg", "at least 0 kg")


def _cubics_with_linear_ends(x: np.ndarray, values: np.ndarray) -> np.ndarray:
    """(n + 1, 4) rising coefficients; monotone cubics (PCHIP) inside, straight lines outside."""
    slope = monotone_slopes(x, values)
    width = np.diff(x)
    secant = np.diff(values) / width
    rows = np.zeros((len(x) + 1, 4))
    rows[1:-1, 0] = values[:-1]
    rows[1:-1, 1] = slope[:-1]
    rows[1:-1, 2] = (3.0 * secant - 2.0 * slope[:-1] - slope[1:]) / width
    rows[1:-1, 3] = (slope[:-1] + slope[1:] - 2.0 * secant) / width**2
    rows[0, :2] = values[0], slope[0]
    rows[-1, :2] = values[-1], slope[-1]
    return rows


def monotone_slopes(x: np.ndarray, values: np.ndarray) -> np.ndarray:
    """(n,) slopes at the knots by Fritsch & Butland (SIAM J. Sci. Stat. Comput. 5, 1984): harmonic means, 0 at extrema."""
    width = np.diff(x)
    secant = np.diff(values) / width
    if len(x) == 2:
        return np.array([secant[0], secant[0]])
    slope = np.zeros_like(values)
    same = secant[:-1] * secant[1:] > 0.0
    left, right = width[:-1][same], width[1:][same]
    weight_1, weight_2 = 2.0 * right + left, right + 2.0 * left
    slope[1:-1][same] = (weight_1 + weight_2) / (weight_1 / secant[:-1][same] + weight_2 / secant[1:][same])
    slope[0] = _end_slope(width[0], width[1], secant[0], secant[1])
    slope[-1] = _end_slope(width[-1], width[-2], secant[-1], secant[-2])
    return slope


def _end_slope(width_0: float, width_1: float, secant_0: float, secant_1: float) -> float:
    """Three-point slope at an end, limited so that the curve keeps its shape."""
    slope = ((2.0 * width_0 + width_1) * secant_0 - width_0 * secant_1) / (width_0 + width_1)
    if slope * secant_0 <= 0.0:
        return 0.0
    if secant_0 * secant_1 <= 0.0 and abs(slope) > 3.0 * abs(secant_0):
        return 3.0 * secant_0
    return slope


def constant(force_n: float, mass_kg: float = 0.0, stroke_m: float = 2.0) -> LoadTable:
    """The same force (and equivalent mass) everywhere; N, kg."""
    return from_table([0.0, stroke_m], [force_n, force_n], [mass_kg, mass_kg])


class Crane(NamedTuple):
    """Knuckle-boom crane whose luffing cylinder lifts the main boom, jib locked (docs/paper.md, load)."""

    foot_to_cylinder_foot_m: float = 2.70
    foot_to_rod_eye_m: float = 2.75
    closed_length_m: float = 2.95
    boom_length_m: float = 11.0
    boom_mass_kg: float = 5200.0
    boom_centre_share: float = 0.45
    jib_length_m: float = 7.0
    jib_mass_kg: float = 2300.0
    jib_centre_share: float = 0.42
    jib_angle_rad: float = math.radians(32.0)
    knuckle_cylinder_mass_kg: float = 900.0
    knuckle_cylinder_share: float = 0.55
    payload_kg: float = 5200.0
    angle_offset_rad: float = math.radians(60.0)


def boom_geometry(crane: Crane, x_m) -> tuple[np.ndarray, np.ndarray]:
    """Boom elevation and its slope over the rod position; rad, rad/m (law of cosines)."""
    a, b = crane.foot_to_cylinder_foot_m, crane.foot_to_rod_eye_m
    length = crane.closed_length_m + np.asarray(x_m, dtype=np.float64)
    psi = np.arccos((a * a + b * b - length * length) / (2.0 * a * b))
    return psi - crane.angle_offset_rad, length / (a * b * np.sin(psi))


def crane_force_n(crane: Crane, x_m) -> np.ndarray:
    """Static rod force by virtual work: F dx = sum of m g dz; N."""
    elevation, slope = boom_geometry(crane, x_m)
    boom, jib = np.cos(elevation), np.cos(elevation - crane.jib_angle_rad)
    l1, l2 = crane.boom_length_m, crane.jib_length_m
    first_moment = (
        (crane.boom_centre_share * crane.boom_mass_kg + crane.knuckle_cylinder_share * crane.knuckle_cylinder_mass_kg)
        * l1
        * boom
        + crane.jib_mass_kg * (l1 * boom + crane.jib_centre_share * l2 * jib)
        + crane.payload_kg * (l1 * boom + l2 * jib)
    )
    return GRAVITY_MPS2 * slope * first_moment


def crane_mass_kg(crane: Crane, x_m) -> np.ndarray:
    """Mass at the rod with the crane's kinetic energy; kg.

    Booms turn about the foot, the payload hangs on a vertical rope: only the tip's rise moves it.
    """
    _, slope = boom_geometry(crane, x_m)
    l1, l2 = crane.boom_length_m, crane.jib_length_m
    inertia = (
        crane.boom_mass_kg * ((crane.boom_centre_share * l1) ** 2 + l1 * l1 / 12.0)
        + crane.knuckle_cylinder_mass_kg * (crane.knuckle_cylinder_share * l1) ** 2
        + crane.jib_mass_kg * (_reach_squared(crane, crane.jib_centre_share * l2) + l2 * l2 / 12.0)
    )
    return slope * slope * inertia + crane.payload_kg * tip_ratio(crane, x_m) ** 2


def _reach_squared(crane: Crane, along_jib_m: float) -> float:
    l1 = crane.boom_length_m
    return l1 * l1 + along_jib_m**2 + 2.0 * l1 * along_jib_m * math.cos(crane.jib_angle_rad)


def tip_ratio(crane: Crane, x_m) -> np.ndarray:
    """Rise of the boom tip per rod travel, dz_tip/dx."""
    elevation, slope = boom_geometry(crane, x_m)
    jib = elevation - crane.jib_angle_rad
    return slope * (crane.boom_length_m * np.cos(elevation) + crane.jib_length_m * np.cos(jib))


def knuckle_boom(
    stroke_m: float = 2.0, knot_count: int = 21, with_mass: bool = False, crane: Crane | None = None
) -> LoadTable:
    """F_L(x), and M_eq(x) where asked for, of a knuckle-boom crane on `knot_count` uniform knots over the stroke."""
    geometry = crane or Crane()
    x = np.linspace(0.0, stroke_m, knot_count)
    mass = crane_mass_kg(geometry, x) if with_mass else None
    return from_table(x, crane_force_n(geometry, x), mass)


def perturbed(table: LoadTable, std_ratio: float, seed: int) -> LoadTable:
    """The same knots with each force multiplied by 1 + std_ratio * N(0, 1) of numpy's default_rng(seed); PCHIP again."""
    if not 0.0 <= std_ratio <= 1.0:
        raise ProfileError("load perturbation", f"standard deviation ratio {std_ratio:g}", "0 to 1")
    factor = 1.0 + np.random.default_rng(seed).normal(0.0, std_ratio, len(table.knots_m))
    return from_table(table.knots_m, table.force_n * factor, table.mass_kg if table.has_mass else None)
