"""Arrays survive safetensors bit by bit."""

import numpy as np
import pytest

from service.base import tensors
from tests.registry.helpers import arrays_of_all_kinds, assert_identical


def test_every_kind_of_array_comes_back_bit_exactly_and_writable() -> None:
    arrays = arrays_of_all_kinds()
    decoded = tensors.decode(tensors.encode(arrays))
    assert_identical(decoded, arrays)
    for array in decoded.values():
        assert array.flags.writeable
        assert array.base is None


def test_equal_arrays_give_equal_bytes_whatever_their_order() -> None:
    arrays = arrays_of_all_kinds()
    backwards = dict(reversed(arrays.items()))
    assert tensors.encode(arrays) == tensors.encode(backwards)
    assert tensors.decode(tensors.encode({})) == {}


def test_metadata_is_read_back() -> None:
    data = tensors.encode({"a": np.zeros(2)}, {"key": 'a "quoted"\ntext'})
    assert tensors.read_metadata(data, "key") == 'a "quoted"\ntext'
    with pytest.raises(KeyError):
        tensors.read_metadata(tensors.encode({"a": np.zeros(2)}), "key")


@pytest.mark.parametrize("array", [np.array(["text"]), np.array([object()]), np.zeros(2, dtype=np.complex128)])
def test_a_dtype_safetensors_lacks_is_refused_by_name(array: np.ndarray) -> None:
    with pytest.raises(ValueError, match="array 'odd' has dtype"):
        tensors.encode({"odd": array})


@pytest.mark.parametrize("data", [b"", b"\xff" * 64, tensors.encode({"a": np.zeros(9)})[:-1]])
def test_other_bytes_are_refused(data: bytes) -> None:
    with pytest.raises(ValueError, match="not a whole safetensors file"):
        tensors.decode(data)


def test_digest_tells_text_name_dtype_shape_and_bits_apart() -> None:
    base = tensors.digest_of("t", {"a": np.zeros((2, 3))})
    others = [
        tensors.digest_of("u", {"a": np.zeros((2, 3))}),
        tensors.digest_of("t", {"b": np.zeros((2, 3))}),
        tensors.digest_of("t", {"a": np.zeros((3, 2))}),
        tensors.digest_of("t", {"a": np.zeros((2, 3), dtype=np.int64)}),
        tensors.digest_of("t", {"a": -np.zeros((2, 3))}),
        tensors.digest_of("t", {"a": np.zeros((2, 3)), "b": np.zeros(0)}),
    ]
    assert len({base, *others}) == 7
    assert tensors.digest_of("t", {"a": np.zeros((2, 3), order="F")}) == base
