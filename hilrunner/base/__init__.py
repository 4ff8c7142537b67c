"""Words every room shares: units, status codes, record layouts, ring layout, errors. Imports numpy (and numba in `compiled`) only."""
