import numpy as np
import pytest

from service.learner import random_state


@pytest.mark.parametrize("num_halves", [0, 1, 2])  # a draw of 32 bits leaves half a word behind
def test_a_loaded_generator_continues(num_halves):
    rng = np.random.Generator(np.random.PCG64(3))
    rng.integers(0, 1 << 32, num_halves, dtype=np.uint32)
    words = random_state.dump(rng)
    loaded = random_state.load(words)
    assert words.dtype == np.uint64
    assert words.shape == (6,)
    for each in (rng, loaded):
        assert each.bit_generator.state["has_uint32"] == num_halves % 2
    np.testing.assert_array_equal(
        rng.integers(0, 1 << 32, 5, dtype=np.uint32), loaded.integers(0, 1 << 32, 5, dtype=np.uint32)
    )
    np.testing.assert_array_equal(rng.permutation(100), loaded.permutation(100))
