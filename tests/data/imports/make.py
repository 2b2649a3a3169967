"""Writes the files of this folder, each with the library of its format, and what that library says is in
them.

    python make.py nerfstudio | gsplat | openvdb | nanovdb | tcnn

Each part needs its own library (README.md), and none of dano. Values are taken at 10,000 random points of
`BOXES`, drawn by NumPy's default generator with seed 0, and kept as float32 in NAME.npy.
"""

import sys
from pathlib import Path

import numpy as np

HERE = Path(__file__).parent
BOXES = {
    "nerfacto": ((-3.0,) * 3, (3.0,) * 3),
    "tcnn": ((0.01,) * 3, (0.99,) * 3),
    "splats": ((-0.12,) * 3, (0.12,) * 3),
    "fog": ((0.1, -0.2, 0.3), (1.35, 0.9, 1.5)),
    "half": ((0.1, -0.2, 0.3), (1.35, 0.9, 1.5)),
    "levelset": ((-0.02,) * 3, (0.1,) * 3),
    "nano": ((0.1, -0.2, 0.3), (0.58, 0.28, 0.78)),
}


def points(name):
    low, high = BOXES[name]
    return np.random.default_rng(0).uniform(low, high, (10_000, 3))


def keep(name, values):
    np.save(HERE / f"{name}.npy", np.asarray(values, np.float32))


def ball():
    """A solid ball in a cloud, 24 voxels a side: three inside, falling to zero over eight voxels."""
    index = np.stack(np.meshgrid(*[np.arange(24.0)] * 3, indexing="ij"), axis=-1)
    radius = np.linalg.norm((index - [11, 12, 11.5]) * [1, 1.1, 0.95], axis=-1)
    return (3 * np.clip((11 - radius) / 3, 0, 1)).astype(np.float32)


def make_nerfstudio():
    import json
    import types

    import torch
    import yaml
    from nerfstudio.cameras.rays import Frustums, RaySamples
    from nerfstudio.field_components.spatial_distortions import SceneContraction
    from nerfstudio.fields.nerfacto_field import NerfactoField
    from nerfstudio.models.nerfacto import NerfactoModelConfig

    torch.manual_seed(0)
    sizes = dict(
        num_levels=4, base_res=8, max_res=64, log2_hashmap_size=9, hidden_dim=16, average_init_density=0.01
    )
    box = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
    contraction = SceneContraction(order=float("inf"))
    field = NerfactoField(box, 3, implementation="torch", spatial_distortion=contraction, **sizes)
    with torch.no_grad():
        field.mlp_base.model[0].hash_table.mul_(5000)  # as if trained: the initial features are nearly zero
        field.mlp_base.model[1].layers[-1].bias[0] += 2
    run = HERE / "nerfacto"
    (run / "nerfstudio_models").mkdir(parents=True, exist_ok=True)
    optimiser = torch.optim.Adam(field.parameters())
    scheduler = torch.optim.lr_scheduler.LambdaLR(optimiser, lambda step: 1.0)
    weights = {f"_model.field.{name}": value for name, value in field.state_dict().items()}
    weights["_model.proposal_networks.0.mlp_base.model.0.hash_table"] = torch.zeros(4, 2)
    content = dict(step=3, pipeline=weights, scalers={}, anything=types.SimpleNamespace(a=1))
    content |= dict(
        optimizers={"fields": optimiser.state_dict()}, schedulers={"fields": scheduler.state_dict()}
    )
    torch.save(content, run / "nerfstudio_models" / "step-000000003.ckpt")
    pipeline = types.SimpleNamespace(model=NerfactoModelConfig(**sizes))
    (run / "config.yml").write_text(
        yaml.dump(types.SimpleNamespace(method_name="nerfacto", pipeline=pipeline))
    )
    turn = [[0.0, -1.0, 0.0, 0.3], [1.0, 0.0, 0.0, -0.2], [0.0, 0.0, 1.0, 0.1]]
    (run / "dataparser_transforms.json").write_text(json.dumps(dict(transform=turn, scale=0.25)))

    x = torch.tensor(points("nerfacto"), dtype=torch.float32)[:, None]
    zero, one = torch.zeros(len(x), 1, 1), torch.ones(len(x), 1, 1)
    with torch.no_grad():
        samples = RaySamples(Frustums(x, torch.ones_like(x), zero, zero, one))
        keep("nerfacto", field.get_density(samples)[0][:, 0, 0].numpy())


def make_tcnn():
    """Dr.Jit's hash grid has tiny-cuda-nn's layout and runs without a GPU; the network after it is
    NumPy's."""
    import drjit.nn
    import torch
    from drjit.llvm.ad import ArrayXf, Float32

    levels, log2_table, base, highest, hidden = 8, 9, 4, 64, 16
    growth = float(np.exp(np.log(highest / base) / (levels - 1)))
    grid = drjit.nn.HashGridEncoding(
        Float32,
        3,
        n_levels=levels,
        n_features_per_level=2,
        hashmap_size=2**log2_table,
        base_resolution=base,
        per_level_scale=growth,
    )
    random = np.random.default_rng(1)
    table = random.normal(0, 1, grid.n_params).astype(np.float16).astype(np.float32)
    network = [
        random.normal(0, 0.25, shape).astype(np.float16) for shape in ((hidden, 2 * levels), (16, hidden))
    ]
    grid.set_params(Float32(table))
    x = points("tcnn")
    features = np.stack([np.asarray(feature) for feature in grid(ArrayXf(x.T))], axis=1).astype(np.float64)
    keep("tcnn", np.exp((np.maximum(features @ network[0].T, 0) @ network[1].T)[:, 0]))

    flat = torch.tensor(np.concatenate([*(m.ravel() for m in network), table]).astype(np.float32))
    weights = {
        "_model.field.mlp_base.model.params": flat,
        "_model.field.aabb": torch.tensor([[0.0] * 3, [1.0] * 3]),
    }
    numbers = dict(max_res=highest, num_levels=levels, log2_hashmap_size=log2_table)
    weights |= {f"_model.field.{name}": torch.tensor(value) for name, value in numbers.items()}
    torch.save(dict(step=0, pipeline=weights), HERE / "tcnn.ckpt")


def make_gsplat():
    import torch
    from gsplat import export_splats

    random = np.random.default_rng(0)
    n = 200
    direction = random.normal(size=(n, 3))
    means = direction / np.linalg.norm(direction, axis=1, keepdims=True) * [0.1, 0.08, 0.06]
    scales, quats = np.log(random.uniform(0.005, 0.02, (n, 3))), random.normal(size=(n, 4))
    logits = random.normal(1, 1, n)
    means, scales, quats, logits = (np.asarray(a, np.float32) for a in (means, scales, quats, logits))
    tensors = [torch.tensor(a) for a in (means, scales, quats, logits)]
    colours = torch.zeros(n, 1, 3), torch.zeros(n, 0, 3)
    export_splats(*tensors, *colours, format="ply", save_to=str(HERE / "splats.ply"))

    # The occupancy by its definition, all pairs, with gsplat's own covariances.
    from gsplat.cuda._torch_impl import _quat_scale_to_covar_preci

    quats = tensors[2] / tensors[2].norm(dim=1, keepdim=True)
    precisions = _quat_scale_to_covar_preci(quats, tensors[1].exp())[1].double()
    offsets = torch.tensor(points("splats"))[:, None] - tensors[0].double()
    squared = torch.einsum("nij,ijk,nik->ni", offsets, precisions, offsets)
    keep("splats", 1 - (1 - torch.sigmoid(tensors[3].double()) * torch.exp(-squared / 2)).prod(dim=1))


def make_openvdb():
    import pyopenvdb as vdb

    fog = vdb.FloatGrid()
    fog.copyFromArray(np.pad(ball(), ((0, 0), (0, 0), (0, 8))), ijk=(-5, 3, 0))
    fog.fill((40, 40, 40), (55, 55, 55), 0.25)  # of two leaves' size, so that it becomes tiles
    fog.prune(0)
    fog.name, fog.gridClass = "density", vdb.GridClass.FOG_VOLUME
    rows = [[0.02, 0, 0, 0], [0, 0.02, 0, 0], [0, 0, 0.02, 0], [0.2, -0.26, 0.3, 1]]
    fog.transform = vdb.createLinearTransform(rows)
    half = fog.deepCopy()
    half.name, half.saveFloatAsHalf = "half", True
    level = vdb.createLevelSetSphere(0.04, center=(0.05, 0.04, 0.03), voxelSize=0.004, halfWidth=3.0)
    level.name = "levelset"
    mask = vdb.BoolGrid()
    mask.fill((0, 0, 0), (9, 9, 9), True)
    mask.name = "mask"
    vdb.write(str(HERE / "openvdb.vdb"), grids=[fog, half, level, mask])
    for grid in vdb.readAllGridMetadata(str(HERE / "openvdb.vdb")):
        if grid.name in ("half", "levelset", "density"):
            read = vdb.read(str(HERE / "openvdb.vdb"), grid.name)
            name = "fog" if grid.name == "density" else grid.name
            keep(name, trilinear(read, points(name)))


def trilinear(grid, x):
    """OpenVDB's samples between voxels, of its accessor's values."""
    accessor = grid.getConstAccessor()
    index = np.array([grid.transform.worldToIndex(tuple(row)) for row in x.tolist()])
    base = np.floor(index).astype(int)
    fraction, total = index - base, np.zeros(len(x))
    for corner in np.ndindex(2, 2, 2):
        weight = np.prod(np.where(corner, fraction, 1 - fraction), axis=1)
        total += weight * [accessor.getValue(tuple(row)) for row in (base + corner).tolist()]
    return total


def make_nanovdb():
    import warp as wp

    @wp.kernel
    def sample(volume: wp.uint64, x: wp.array(dtype=wp.vec3), out: wp.array(dtype=float)):
        i = wp.tid()
        out[i] = wp.volume_sample_f(volume, wp.volume_world_to_index(volume, x[i]), wp.Volume.LINEAR)

    volume = wp.Volume.load_from_numpy(ball(), (0.1, -0.2, 0.3), 0.02, 0.0, "cpu")
    volume.save_to_nvdb(str(HERE / "nanovdb.nvdb"), codec="zip")
    volume = wp.Volume.load_from_nvdb((HERE / "nanovdb.nvdb").open("rb"), "cpu")
    x = wp.array(points("nano").astype(np.float32), dtype=wp.vec3, device="cpu")
    out = wp.zeros(len(x), dtype=float, device="cpu")
    wp.launch(sample, len(x), [volume.id, x, out], device="cpu")
    keep("nano", out.numpy())


if __name__ == "__main__":
    for part in sys.argv[1:]:
        {name.removeprefix("make_"): function for name, function in globals().items()}[part]()
