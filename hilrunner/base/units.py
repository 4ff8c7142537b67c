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
