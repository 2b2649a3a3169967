"""`python -m benchmarks.batch [--json FILE] [--quick]`; on a GPU with JAX_PLATFORMS=cuda."""

import os

if __name__ == "__main__":
    os.environ["JAX_ENABLE_X64"] = "1"
    os.environ["JAX_ENABLE_COMPILATION_CACHE"] = "0"  # a warm cache would pass for a fast compiler
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    # Two devices of one core each; a GPU does not care.
    flags = "--xla_force_host_platform_device_count=2 --xla_cpu_multi_thread_eigen=false"
    os.environ["XLA_FLAGS"] = (
        f"{os.environ.get('XLA_FLAGS', '')} {flags} intra_op_parallelism_threads=1".strip()
    )
    from benchmarks.batch._run import run  # imports JAX, so not before

    run()
