"""Conversions between SI (inside) and engineering units (profiles, DBC, reports). The only place with such factors."""

PA_PER_MPA = 1e6
PA_PER_KPA = 1e3
M_PER_MM = 1e-3
M2_PER_MM2 = 1e-6
M3_PER_MM3 = 1e-9
N_PER_KN = 1e3
NS_PER_S = 1_000_000_000
NS_PER_MS = 1_000_000
NS_PER_US = 1_000
# orifice coefficient q = k sqrt(dp): mm^3/(s sqrt(MPa)) -> m^3/(s sqrt(Pa)); 1e-9 / sqrt(1e6)
ORIFICE_SI_PER_MM3_SQRT_MPA = 1e-12

# What a DBC may call a unit, exact, as a factor to SI (time stamps: to microseconds), one table a kind of quantity.
WIRE_UNITS = {
    "pressure": {"Pa": "1", "hPa": "100", "kPa": "1000", "MPa": "1000000", "mbar": "100", "bar": "100000"},
    "length": {"m": "1", "cm": "0.01", "mm": "0.001", "um": "0.000001", "µm": "0.000001"},
    "velocity": {"m/s": "1", "cm/s": "0.01", "mm/s": "0.001", "um/s": "0.000001", "µm/s": "0.000001"},
    "force": {"N": "1", "kN": "1000", "MN": "1000000"},
    "ratio": {"": "1", "1": "1", "-": "1", "%": "0.01", "‰": "0.001", "permille": "0.001"},
    "count": {"": "1", "1": "1", "-": "1"},
    "timestamp": {"": "1", "us": "1", "µs": "1", "ms": "1000", "s": "1000000"},
}
