#!/bin/bash
# Kernels on an NVIDIA GPU: compared with the CPU, and timed. benchmarks/gpu.sh [RESULT.json]; less than five minutes.
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
cache=$(mktemp -d)
trap 'rm -rf "$cache"' EXIT
export DANO_CACHE_DIR=$cache
begin=$SECONDS
for name in bunny bunny32 boxes panda; do
  XLA_PYTHON_CLIENT_PREALLOCATE=false "$python" -m benchmarks.gpu --compile "$name" --json "$cache/$name.json" > "$cache/$name.log" 2>&1 &
done
wait
cat "$cache"/*.log
echo "compiled in $((SECONDS - begin)) s"
"$python" -m benchmarks.gpu --json "$result"
"$python" - "$result" "$cache"/*.json <<'JOIN'
import json
import sys

whole, *parts = (json.load(open(name)) for name in sys.argv[1:])
whole["rows"] += [row for part in parts for row in part["rows"]]
with open(sys.argv[1], "w") as file:
    json.dump(whole, file, indent=1, ensure_ascii=False)
JOIN
