"""Densities of nerfstudio's checkpoints: nerfacto's hash grid and network, in both of its implementations."""

import json
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt32

from dano.fields._base import AbstractField
from dano.fields._callable import CallableField
from dano.fields._compose import posed, scaled
from dano.fields.readers._checkpoint import read_weights
from dano.fields.readers._splats import splat_field
from dano.maths import Numbers, Pose, quat_from_matrix

_PRIMES = (1, 2654435761, 805459861)
"""Of the spatial hash (Müller et al., Instant Neural Graphics Primitives, 2022, eq. 4)."""


class HashGrid(eqx.Module):
    """Multiresolution hash encoding: trilinear features of several grids, one after the other.

    Two layouts exist. nerfstudio's own ("torch") hashes every level and puts node i of a level at
    x = i / scale. tiny-cuda-nn ("tcnn") stores levels that fit into the table densely, x fastest, and puts
    node i at (i − ½) / scale.
    """

    tables: tuple[Float[Array, "_ features"], ...]  # Features of each level, shape (entries, features)
    scales: tuple[float, ...] = eqx.field(static=True)  # Cells along an axis, one a level (static)
    # Nodes along an axis of a dense level, 0 for a hashed one (static).
    resolutions: tuple[int, ...] = eqx.field(static=True)
    shift: float = eqx.field(static=True)  # Where x = 0 lies, in cells: 0 or ½ (static)

    def __call__(self, x: Float[Array, "n 3"]) -> Float[Array, "n width"]:
        """Features at points in the unit cube."""
        # All levels at once, a corner at a time: one program for a dozen levels, and gathers that are fast.
        entries = [len(table) for table in self.tables]
        starts = jnp.asarray(np.cumsum([0, *entries[:-1]]), jnp.int32)
        joined = jnp.concatenate(self.tables)
        scales = jnp.asarray(self.scales, x.dtype)[None]
        # One array per axis: a last axis of three would leave most of a vector unit idle.
        u = [x[:, i, None] * scales + self.shift for i in range(3)]
        base = [jnp.floor(v) for v in u]
        far = [v - b for v, b in zip(u, base, strict=True)]
        node = [b.astype(jnp.uint32) for b in base]
        total = jnp.zeros((len(x), len(self.tables), joined.shape[1]), x.dtype)
        for corner in np.ndindex(2, 2, 2):
            at = [n + jnp.uint32(step) for n, step in zip(node, corner, strict=True)]
            row = starts[None] + rows_of(at, self.resolutions, entries)
            share = [f if step else 1 - f for f, step in zip(far, corner, strict=True)]
            features = joined.at[row].get(mode="promise_in_bounds").astype(x.dtype)
            total += (share[0] * share[1] * share[2])[..., None] * features
        return total.reshape(len(x), -1)


def rows_of(
    node: Sequence[UInt32[Array, "n levels"]], resolutions: Sequence[int], entries: Sequence[int]
) -> Int[Array, "n levels"]:
    """Rows of a level's table that belong to its nodes: x fastest in dense levels, hashed in others."""
    side, size = (jnp.asarray(x, jnp.uint32)[None] for x in (resolutions, entries))
    dense = node[0] + side * (node[1] + side * node[2])
    products = [n * jnp.uint32(prime) for n, prime in zip(node, _PRIMES, strict=True)]
    index = jnp.where(side > 0, dense, products[0] ^ products[1] ^ products[2])
    return (index % size).astype(jnp.int32)


SETTINGS, TRANSFORMS = "config.yml", "dataparser_transforms.json"
"""Files that nerfstudio writes for a training."""


class HashDensity(eqx.Module):
    """Density of a hash-grid radiance field: factor · exp(first output of a ReLU network of the features)."""

    grid: HashGrid  # The encoding
    weights: tuple[Float[Array, "_ _"], ...]  # Matrices of the network, (outputs, inputs) each
    biases: tuple[Float[Array, " _"], ...]  # Their biases; zeros for tiny-cuda-nn, which has none
    # Lower corner and size of the box that is mapped onto the unit cube, shape (2, 3).
    box: Float[Array, "2 3"]
    factor: float  # Scale of the density
    contracted: bool = eqx.field(static=True)  # Whether space is contracted into [−2, 2]³ first (static)

    def __call__(self, points: Float[Array, "n 3"]) -> Float[Array, " n"]:
        """Density at points in the frame of training."""
        x = _contract(points) if self.contracted else points
        box = self.box.astype(x.dtype)
        x = (x - box[0][None]) / box[1][None]
        inside = jnp.all((x > 0) & (x < 1), axis=1)
        h = self.grid(jnp.where(inside[:, None], x, 0))
        layers = zip(self.weights, self.biases, strict=True)
        for i, (weight, bias) in enumerate(layers):
            h = h @ weight.T.astype(h.dtype) + bias[None].astype(h.dtype)
            h = jax.nn.relu(h) if i + 1 < len(self.weights) else h
        return jnp.where(inside, self.factor * jnp.exp(h[:, 0]), 0)


def _contract(x: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """Space outside of [−1, 1]³ onto the shell up to [−2, 2]³ (mip-NeRF 360, eq. 10, maximum norm)."""
    norm = jnp.max(jnp.abs(x), axis=1, keepdims=True)
    safe = jnp.maximum(norm, 1)
    return jnp.where(norm < 1, x, (2 - 1 / safe) * (x / safe))


class Sizes(NamedTuple):
    """What a flat table of parameters does not tell of a hash-grid network."""

    n_levels: int
    n_features: int
    log2_table: int
    base: int
    growth: float
    hidden: int
    n_layers: int


def tcnn_grid(parameters: Float[np.ndarray, " n"], sizes: Sizes) -> HashGrid:
    """The hash grid of tiny-cuda-nn from its flat parameters."""
    tables, scales, resolutions, used = [], [], [], 0
    log_growth = np.log2(np.float32(sizes.growth), dtype=np.float32)
    for level in range(sizes.n_levels):
        scale = float(np.exp2(np.float32(level) * log_growth) * np.float32(sizes.base) - np.float32(1))
        resolution = math.ceil(scale) + 1
        entries = min(-(-(resolution**3) // 8) * 8, 2**sizes.log2_table)
        size = entries * sizes.n_features
        tables.append(jnp.asarray(parameters[used : used + size].reshape(-1, sizes.n_features)))
        used += size
        scales.append(scale)
        resolutions.append(resolution if resolution**3 <= entries else 0)
    return HashGrid(tuple(tables), tuple(scales), tuple(resolutions), 0.5)


def tcnn_counts(sizes: Sizes) -> tuple[int, int]:
    """Number of parameters of tiny-cuda-nn's density network (16 outputs) and of its hash grid."""
    inputs = sizes.n_levels * sizes.n_features
    network = sizes.hidden * (inputs + 16) + sizes.hidden**2 * (sizes.n_layers - 2)
    log_growth = np.log2(np.float32(sizes.growth), dtype=np.float32)
    entries = 0
    for level in range(sizes.n_levels):
        scale = float(np.exp2(np.float32(level) * log_growth) * np.float32(sizes.base) - np.float32(1))
        entries += min(-(-((math.ceil(scale) + 1) ** 3) // 8) * 8, 2**sizes.log2_table)
    return network, entries * sizes.n_features


def tcnn_network(parameters: Float[np.ndarray, " n"], sizes: Sizes) -> tuple[Array, ...]:
    """The matrices of tiny-cuda-nn's fused network from its flat parameters: row-major, no biases."""
    shapes = [(sizes.hidden, sizes.n_levels * sizes.n_features)]
    shapes += [(sizes.hidden, sizes.hidden)] * (sizes.n_layers - 2) + [(16, sizes.hidden)]
    matrices, used = [], 0
    for shape in shapes:
        matrices.append(jnp.asarray(parameters[used : used + math.prod(shape)].reshape(shape)))
        used += math.prod(shape)
    return tuple(matrices)


def load_checkpoint(
    path: Path, *, crop: Numbers | None, undo_transform: bool = True, **stated: Any
) -> AbstractField:
    """Density of a nerfstudio checkpoint (nerfacto or splatfacto).

    The numbers that the weights do not tell are read from `config.yml` beside the checkpoint or one folder
    up, where nerfstudio writes it, unless stated.

    Args:
        path: A step-*.ckpt file.
        crop: Box in the frame of training, which is that of nerfstudio's viewer; None: [−1, 1]³, where space
            is not contracted, or the scene box of a field without contraction.
        undo_transform: Whether to go back to the frame of the data set by `dataparser_transforms.json`, if
            it is there.
        **stated: `average_init_density`, `base_res`, `max_res`, `hidden_dim`, `num_layers`,
            `features_per_level`, `num_levels`, `log2_hashmap_size`, `disable_scene_contraction`.

    Raises:
        ValueError: If it is not a checkpoint of these methods or a number does not fit its weights.
    """
    weights = read_weights(path)
    if gaussians := _under(weights, "gauss_params"):
        field = splat_field(_splats(gaussians, path), crop)
    else:
        field = _nerfacto(weights, _settings(path) | stated, crop, path)
    if undo_transform and (transforms := _beside(path, TRANSFORMS)):
        return _undone(field, transforms)
    return field


def _under(weights: Mapping[str, np.ndarray], name: str) -> dict[str, np.ndarray]:
    """Weights of the module of this name, under their names within it."""
    pattern = re.compile(rf"(?:^|\.){re.escape(name)}\.(.+)")
    found = {key: pattern.search(key) for key in weights if "optimizers" not in key}
    return {match[1]: weights[key] for key, match in found.items() if match}


def _splats(parameters: Mapping[str, np.ndarray], path: Path) -> dict[str, np.ndarray]:
    try:
        return {
            "means": parameters["means"],
            "scales": parameters["scales"],
            "quats": parameters["quats"],
            "opacities": parameters["opacities"].reshape(-1),
        }
    except KeyError as error:
        raise ValueError(f"{path}: its Gaussians have no {error}, only {sorted(parameters)}") from error


def beside(path: Path, name: str) -> tuple[Path, Path]:
    """Places of a file of nerfstudio in the folder of a run, whose subfolder holds the checkpoints."""
    return path.absolute().parent / name, path.absolute().parent.parent / name


def _beside(path: Path, name: str) -> Path | None:
    return next((place for place in beside(path, name) if place.is_file()), None)


def _settings(path: Path) -> dict[str, Any]:
    """Plain numbers of the model's block of config.yml, whose Python tags are not acted upon."""
    config = _beside(path, SETTINGS)
    if config is None:
        return {}
    settings, depth = {}, None
    for line in config.read_text(encoding="utf-8", errors="replace").splitlines():
        indent = len(line) - len(line.lstrip())
        if depth is None:
            depth = indent if re.match(r"\s*model: !!python/object", line) else None
        elif indent <= depth and line.strip():
            break
        elif match := re.fullmatch(rf"\s{{{depth + 2}}}(\w+): (true|false|[-+.\deE]+)\s*", line):
            settings[match[1]] = json.loads(match[2]) if match[2] in ("true", "false") else float(match[2])
    return settings


def _nerfacto(
    weights: Mapping[str, np.ndarray], settings: Mapping[str, Any], crop: Numbers | None, path: Path
) -> CallableField:
    field, base = _under(weights, "field"), {}
    for name in ("field.mlp_base.model", "field.mlp_base"):
        base = base or _under(weights, name)
    if not base:
        raise ValueError(
            f"{path}: expected a nerfacto or splatfacto checkpoint, got one without field.mlp_base and"
            f" gauss_params; its tensors start with {sorted(weights)[:5]}"
        )
    stored = {
        name: int(field[name]) for name in ("max_res", "num_levels", "log2_hashmap_size") if name in field
    }
    defaults = {
        "base_res": 16,
        "max_res": 2048,
        "num_levels": 16,
        "log2_hashmap_size": 19,
        "features_per_level": 2,
    }
    defaults |= {"hidden_dim": 64, "num_layers": 2}
    numbers = {name: int(settings.get(name, stored.get(name, value))) for name, value in defaults.items()}
    n_levels, base_res = numbers["num_levels"], numbers["base_res"]
    growth = math.exp(math.log(numbers["max_res"] / base_res) / max(n_levels - 1, 1))
    try:
        if "0.hash_table" in base:
            grid = _torch_grid(base["0.hash_table"], n_levels, base_res, growth)
            matrices, biases = _linear_layers(base, "1.layers")
        else:
            sizes = Sizes(
                n_levels,
                numbers["features_per_level"],
                numbers["log2_hashmap_size"],
                base_res,
                growth,
                numbers["hidden_dim"],
                numbers["num_layers"],
            )
            grid, matrices = _tcnn(base, sizes)
            biases = tuple(jnp.zeros(len(matrix)) for matrix in matrices)
        if matrices[0].shape[1] != n_levels * grid.tables[0].shape[1]:
            raise ValueError(f"its network takes {matrices[0].shape[1]} features")
    except (KeyError, ValueError) as error:
        raise ValueError(
            f"{path}: its weights do not fit a nerfacto field with {numbers}: {error}"
        ) from error
    contracted = not settings.get("disable_scene_contraction", False)
    aabb = np.asarray(field.get("aabb", [[-1.0] * 3, [1.0] * 3]), np.float64).reshape(2, 3)
    box = np.asarray([[-2.0] * 3, [4.0] * 3]) if contracted else np.stack([aabb[0], aabb[1] - aabb[0]])
    factor = float(settings.get("average_init_density", 1.0))
    density = HashDensity(grid, matrices, biases, jnp.asarray(box), factor, contracted)
    bounds = crop if crop is not None else ([[-1.0] * 3, [1.0] * 3] if contracted else aabb)
    return CallableField(density, np.asarray(bounds, float), "jax")


def _torch_grid(table: np.ndarray, n_levels: int, base_res: int, growth: float) -> HashGrid:
    if len(table) % n_levels:
        raise ValueError(f"its hash table has {len(table)} rows, no multiple of the number of levels")
    # In float32, as nerfstudio computes them: the last one may otherwise be floored to one less.
    steps = np.power(np.float32(growth), np.arange(n_levels, dtype=np.float32))
    scales = tuple(float(x) for x in np.floor(np.float32(base_res) * steps))
    tables = tuple(jnp.asarray(part) for part in np.split(table.astype(np.float32), n_levels))
    return HashGrid(tables, scales, (0,) * n_levels, 0.0)


def _linear_layers(
    base: Mapping[str, np.ndarray], prefix: str
) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
    matrices, biases = [], []
    while f"{prefix}.{len(matrices)}.weight" in base:
        biases.append(jnp.asarray(base[f"{prefix}.{len(biases)}.bias"].astype(np.float32)))
        matrices.append(jnp.asarray(base[f"{prefix}.{len(matrices)}.weight"].astype(np.float32)))
    if not matrices:
        raise KeyError(f"{prefix}.0.weight")
    return tuple(matrices), tuple(biases)


def _tcnn(base: Mapping[str, np.ndarray], sizes: Sizes) -> tuple[HashGrid, tuple[Array, ...]]:
    network, table = tcnn_counts(sizes)
    if "params" in base:
        flat = base["params"]
    elif "0.tcnn_encoding.params" in base:
        flat = np.concatenate([base["1.tcnn_encoding.params"], base["0.tcnn_encoding.params"]])
    else:
        raise KeyError(f"neither 0.hash_table nor params in {sorted(base)}")
    if len(flat) != network + table:
        raise ValueError(f"{len(flat)} parameters, expected {network} + {table}")
    # tiny-cuda-nn computes with half-precision parameters, whatever the checkpoint keeps.
    flat = flat.astype(np.float16).astype(np.float32)
    return tcnn_grid(flat[network:], sizes), tcnn_network(flat[:network], sizes)


def _undone(field: AbstractField, transforms: Path) -> AbstractField:
    """The field in the frame of its data set: training's is scale · (R x + t)."""
    try:
        content = json.loads(transforms.read_text(encoding="utf-8"))
        matrix = np.asarray(content["transform"], np.float64).reshape(-1, 4)[:3]
        scale = float(content["scale"])
        rotation = matrix[:, :3]
        if not (scale > 0 and np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4)):
            raise ValueError("its transform is not a rotation, or its scale not positive")
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ValueError(
            f"{transforms}: expected transform (3, 4) and scale, or undo_transform=False; {error}"
        ) from error
    pose = Pose(matrix[:, 3], quat_from_matrix(jnp.asarray(rotation)))
    return posed(scaled(field, 1 / scale), pose.inverse())
