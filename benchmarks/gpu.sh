#!/bin/bash
# Kernels on an NVIDIA GPU: compared with the CPU, and timed. benchmarks/gpu.sh [RESULT.json]; ten minutes.
# BESIDE names a file of `python -m benchmarks.gpu --keep FILE`: another machine's CPU is compared. CACHE names a
# folder of kernels that were compiled before.
# It installs nothing. PYTHON names an interpreter with dano and JAX for CUDA; without it .venv's, or python3.
set -euo pipefail
cd "$(dirname "$0")/.."
python=${PYTHON:-$([ -x .venv/bin/python ] && echo .venv/bin/python || echo python3)}
result=${1:-gpu.json}
export PYTHONPATH=src:. JAX_PLATFORMS=cuda,cpu
"$python" - <<'CHECK'
import jax
import warp

warp.init()
assert jax.devices("cuda"), "JAX finds no GPU: pip install 'jax[cuda12]'"
assert warp.get_cuda_device_count(), "Warp finds no GPU: see its words above"
CHECK
# Compiling takes longest and one core each, so all kernels at once; they are kept in dano's cache.
made=$(mktemp -d)
trap 'rm -rf "$made"' EXIT
cache=${CACHE:-$made}
export DANO_CACHE_DIR=$cache
begin=$SECONDS
for name in bunny bunny32 boxes panda bowl strikes; do
  XLA_PYTHON_CLIENT_PREALLOCATE=false "$python" -m benchmarks.gpu --compile "$name" --json "$made/$name.json" > "$made/$name.log" 2>&1 &
done
wait
cat "$made"/*.log
echo "compiled in $((SECONDS - begin)) s"
"$python" -m benchmarks.gpu ${BESIDE:+--beside "$BESIDE"} --json "$result"
"$python" - "$result" "$made"/*.json <<'JOIN'
import json
import sys

whole, *parts = (json.load(open(name)) for name in sys.argv[1:])
whole["rows"] += [row for part in parts for row in part["rows"]]
with open(sys.argv[1], "w") as file:
    json.dump(whole, file, indent=1, ensure_ascii=False)
JOIN
