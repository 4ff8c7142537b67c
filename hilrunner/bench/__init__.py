"""Measures this project against named rivals on this host: plant step, loop, capacity, log. Prints; never asserts."""
