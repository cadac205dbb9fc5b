import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from benchnav.datagen.files import chunks


def in_memory() -> h5py.File:
    return h5py.File("chunks.h5", "w", driver="core", backing_store=False)


@given(
    hnp.arrays(
        st.sampled_from(["<f4", "|u1", "<i2"]),
        hnp.array_shapes(min_dims=2, max_dims=3, min_side=1, max_side=40),
    )
)
@settings(deadline=None, max_examples=200)
def test_hdf5_reads_back_any_array(array: np.ndarray) -> None:
    with in_memory() as file:
        stored = chunks.new_array(file, "x", 2, array.shape, array.dtype.str)
        chunks.write(stored, 1, [chunks.encode(array)])
        np.testing.assert_array_equal(stored[1], array)
        assert not stored[0].any()


@pytest.mark.parametrize("size", [65_535, 65_536, 70_001])
def test_planes_longer_than_a_deflate_block_are_read_back(size: int) -> None:
    array = np.random.default_rng(0).normal(size=(1, size)).astype("<f4")
    with in_memory() as file:
        stored = chunks.new_array(file, "x", 1, array.shape, "<f4")
        chunks.write(stored, 0, [chunks.encode(array)])
        np.testing.assert_array_equal(stored[0], array)


@given(st.binary(min_size=1, max_size=2000))
@settings(deadline=None, max_examples=200)
def test_checksum_is_hdf5s_own(data: bytes) -> None:
    with in_memory() as file:
        array = file.create_dataset(
            "x", data=np.frombuffer(data, np.uint8), chunks=(len(data),), fletcher32=True
        )
        file.flush()
        _, stored = array.id.read_direct_chunk((0,))
    assert stored[-4:] == chunks.fletcher32(data).to_bytes(4, "little")


def test_noise_takes_less_room_than_with_hdf5s_own_deflate() -> None:
    noise = np.random.default_rng(0).normal(size=(64, 64))
    entry = (np.round(noise * 2**13) / 2**13).astype("<f4")
    with in_memory() as file:
        own = file.create_dataset("x", data=entry[None], chunks=(1, 64, 64), shuffle=True, compression="gzip")
        file.flush()
        assert len(chunks.encode(entry)) < 1.02 * own.id.get_storage_size()


def test_checksum_holds_for_chunks_of_any_size() -> None:
    # Sums in Python's integers, which do not overflow.
    data = b"\xff" * (3 << 20) + bytes(range(251)) * 5000 + b"\x07"
    words = np.frombuffer(data + b"\0" * (len(data) % 2), ">u2").tolist()
    first = second = 0
    for word in words:
        first += word
        second += first
    fold = [total and (total - 1) % 65535 + 1 for total in (second, first)]
    assert chunks.fletcher32(data) == fold[0] << 16 | fold[1]
