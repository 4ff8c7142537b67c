"""Long campaigns: `make test-long` runs them, `make test` does not. Each draws its cases from one seed, so that any of them can be run again."""

import os

import numpy as np
import pytest

SEED_VARIABLE = "HILRUNNER_TEST_SEED"


@pytest.fixture
def seed() -> int:
    """What `tools/test_long --seed N` was given; 1 where these tests are run by hand."""
    return int(os.environ.get(SEED_VARIABLE, "1"))


@pytest.fixture
def drawn(seed) -> np.random.Generator:
    """A generator of random numbers that gives the same cases for the same seed, in every test from its start."""
    return np.random.default_rng(seed)
