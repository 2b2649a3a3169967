"""`python -m benchmarks.batch [--json FILE] [--quick]`; on a GPU with JAX_PLATFORMS=cuda."""

import os

from benchmarks import _environment

if __name__ == "__main__":
    _environment.use_float64()
    # Two devices of one core each; a GPU does not care.
    flags = "--xla_force_host_platform_device_count=2 --xla_cpu_multi_thread_eigen=false"
    os.environ["XLA_FLAGS"] = (
        f"{os.environ.get('XLA_FLAGS', '')} {flags} intra_op_parallelism_threads=1".strip()
    )
    from benchmarks.batch._run import run  # imports JAX, so not before

    run()
