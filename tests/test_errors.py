"""Words of other programs, told apart: is it the memory that is full?"""

import jax
import pytest

from gacrl.errors import full_memory, missing_device


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (
            jax.errors.JaxRuntimeError(
                "INTERNAL: Error dispatching computation: Out of memory allocating 9 bytes."
            ),
            "Out of memory allocating 9 bytes",
        ),
        (
            jax.errors.JaxRuntimeError(
                "RESOURCE_EXHAUSTED: Out of memory while trying to allocate 9 bytes.\nMore"
            ),
            "Out of memory while trying to allocate 9 bytes",
        ),
        (
            jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Failed to allocate 9 bytes."),
            "Failed to allocate 9 bytes",
        ),
        (RuntimeError("std::bad_alloc"), "bad_alloc"),
        (MemoryError("std::bad_alloc"), "std::bad_alloc"),
        (MemoryError(), "out of memory"),
        (jax.errors.JaxRuntimeError("INTERNAL: something else"), None),
        (ValueError("out of memory"), None),
    ],
)
def test_a_full_memory_is_known_by_its_words(error: Exception, said: str | None):
    assert full_memory(error) == said


def test_a_device_that_is_not_there_is_known_by_its_words():
    said = "Unable to initialize backend 'cuda': no supported devices found for platform CUDA"
    assert missing_device(RuntimeError(f"{said}. (set JAX_PLATFORMS='' to choose one)")) == said
    assert missing_device(RuntimeError("INTERNAL: something else")) is None
