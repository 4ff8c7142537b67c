"""The actuator: equations, loads, solvers and the network. No clock, no bus."""
