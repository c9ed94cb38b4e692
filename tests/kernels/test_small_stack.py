"""Kernels on a small stack: threads have 512 kB by default on macOS."""

import sys

import pytest

from rfem_jax.kernels import is_available, machine_code
from tests.processes import in_a_new_process

BATCH = """
import sys, threading
import jax, jax.numpy as jnp, numpy as np
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_cpu_enable_async_dispatch", False)  # it runs in the thread that calls it
from rfem_jax.kernels import kernel, machine_code

room = int(sys.argv[1])
machine_code.stack_bytes = lambda: room

def straight(x, numpy=jnp):
    values = [x]
    for n in range(1100):
        values.append(values[-1] * x + numpy.roll(values[n // 2], 1, -1) / (n + 2.0))
    return sum(values)

xs = jax.random.uniform(jax.random.key(0), (16, 10), minval=-0.5, maxval=0.5)
batch = jax.jit(jax.vmap(kernel(straight, selection="fast"))).lower(xs).compile()
found = []
threading.stack_size(2**19)
thread = threading.Thread(target=lambda: found.append(jax.block_until_ready(batch(xs))))
thread.start()
thread.join()
np.testing.assert_allclose(found[0], straight(np.asarray(xs), np), rtol=1e-12)
print("done")
"""


@pytest.fixture
def as_on_macos(monkeypatch):
    """Bytes that kernels may take there."""
    machine_code.stack_bytes.cache_clear()
    monkeypatch.setattr(sys, "platform", "darwin")
    yield machine_code.stack_bytes()
    machine_code.stack_bytes.cache_clear()


@pytest.mark.skipif(not is_available(), reason="llvmlite is not installed")
@pytest.mark.skipif(sys.platform != "linux", reason="stacks of threads are as large as asked for on Linux")
def test_a_batch_runs_on_the_smallest_stack_of_a_thread(as_on_macos):
    assert in_a_new_process(BATCH, str(as_on_macos)) == "done"
    if machine_code.vector_width() == 8:  # else the samples of a block that has room on 8 MiB fit here, too
        with pytest.raises(AssertionError):
            in_a_new_process(BATCH, str(6 * 2**20))
