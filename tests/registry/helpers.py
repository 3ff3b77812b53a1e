"""What several tests of the registry use."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from service.registry.names import Version

Publish = Callable[..., Version]


def arrays_of_all_kinds() -> dict[str, np.ndarray]:
    """One array for each way an array can be unusual."""
    rng = np.random.default_rng(0)
    grid = rng.normal(size=(4, 6))
    return {
        "float64": grid,
        "float32.transposed": grid.astype(np.float32).T,
        "float64.strided": grid[::2, ::-3],
        "float64.fortran": np.asfortranarray(grid),
        "special": np.array([np.nan, -np.nan, np.inf, -np.inf, -0.0, 5e-324]),
        "zero_d": np.array(3.25),
        "zero_d.uint64": np.array(2**64 - 1, dtype=np.uint64),
        "int64": np.array([[-(2**63), 2**63 - 1]]),
        "uint64": np.array([0, 2**64 - 1], dtype=np.uint64),
        "bool": np.array([True, False, True]),
        "uint8": np.arange(7, dtype=np.uint8),
        "empty": np.zeros((0, 3), dtype=np.float32),
        "big_endian": np.array([1.5, -2.5], dtype=">f8"),
    }


def assert_identical(actual: dict[str, np.ndarray], expected: dict[str, np.ndarray]) -> None:
    """Same names, dtypes, shapes and bits."""
    assert set(actual) == set(expected)
    for name, array in expected.items():
        assert actual[name].dtype == array.dtype.newbyteorder("="), name
        assert actual[name].shape == array.shape, name
        assert actual[name].tobytes() == array.astype(array.dtype.newbyteorder("=")).tobytes(), name


def files_in(directory: Path) -> dict[str, bytes]:
    """Every file under a directory and its bytes, lock files aside."""
    return {
        str(path.relative_to(directory)): path.read_bytes()
        for path in sorted(directory.rglob("*"))
        if path.is_file() and path.name != ".lock"
    }
