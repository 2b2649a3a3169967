"""Workshop tools of several materials: mass, centre and inertia from their parts, and from a wrist's log.

The meshes, what their parts are made of, and their mass properties are those of the STARS Laboratory's
workshop tools (MIT licence), from CAD. A mesh falls into its closed parts; which is of what material is
listed here, from the largest down. Logs are computed from the true mass properties: a wrist that holds the
tool by the data set's grasp shakes it for ten seconds, with noise and a bias in what it feels.
"""

import ast
import re
import tempfile
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

import dano
from benchmarks._measure import Row, skipped
from benchmarks.real._data import NO_DATA, Source
from dano.building import BuildOptions

STEEL, STAINLESS, ALLOY, BRASS, PVC, RUBBER = 7800.0, 7800.0, 7700.0, 8500.0, 1300.0, 1000.0
OAK = 560.0  # what the hammer's mass leaves for its handle
"""Densities [kg/m³] of the CAD program's materials of these names."""

PARTS: dict[str, tuple[float, ...]] = {
    "Adjustable_Wrench": (STEEL, STEEL, STEEL, BRASS),
    "Bent_Jaw_Pliers": (STAINLESS, STAINLESS, ALLOY),
    "C_Clamp": (STEEL, STAINLESS, BRASS, BRASS, BRASS),
    "Hacksaw": (OAK, STAINLESS, ALLOY, ALLOY, STEEL, STAINLESS, ALLOY),
    "Machinist_Hammer": (OAK, STEEL),
    "Nut_Screwdriver": (PVC, STAINLESS),
    "Rubber_Mallet": (RUBBER, OAK),
    "Screwdriver": (PVC, STAINLESS),
    "Vise_Clamp": (
        STAINLESS,
        STAINLESS,
        STAINLESS,
        STAINLESS,
        RUBBER,
        RUBBER,
        STAINLESS,
        STAINLESS,
        STAINLESS,
    ),
}
"""Densities of the closed parts of each tool, from the largest down. Of others no parts are told apart."""

NOISE = (0.5, 0.02)  # N, N m
BIAS = np.array([2.0, -1.0, 1.5, 0.05, -0.08, 0.03])
SECONDS, RATE = 10.0, 250.0
_LEAST_VOLUME = 1.0  # mm³, of what counts as a part: the files hold specks without volume


@dataclass(frozen=True)
class Tool:
    """A tool's true mass properties, in its mesh's frame in metres.

    Attributes:
        name: Of its folder.
        mesh: The file.
        mass: [kg].
        com: [m].
        inertia: About the centre of mass [kg m²].
        grasp: Where a sensor holds it, sensor → mesh, shape (4, 4).
    """

    name: str
    mesh: Path
    mass: float
    com: np.ndarray
    inertia: np.ndarray
    grasp: np.ndarray

    @classmethod
    def load(cls, folder: Path) -> "Tool":
        """Read a folder.

        Raises:
            ValueError: If its mass properties are not there.
        """
        text = (folder / "Inertia.yaml").read_text()
        found = dict(re.findall(r"^[ \t]*([A-Z_]+):[ \t]*(\S.*)$", text, re.MULTILINE))
        names = ("MASS", "COM_WRT_MESH", "INERTIA_WRT_COM", "GRASP_WRT_MESH")
        if missing := [name for name in names if name not in found]:
            raise ValueError(f"{folder}/Inertia.yaml must hold {list(names)}, it lacks {missing}")
        values = [np.array(ast.literal_eval(found[name]), float) for name in names]
        return cls(folder.name, folder / "mesh.ply", float(values[0]), *values[1:])


def rows(source: Source | None, *, quick: bool = False) -> list[Row]:
    """Both ways, for all tools."""
    if source is None:
        return [skipped("Tools", "all of them", NO_DATA)]
    folder = source.folder if source.held is None else source.held
    tools = [Tool.load(path) for path in sorted((folder / "tools").iterdir()) if path.is_dir()]
    if quick:
        tools = [tool for tool in tools if tool.name in ("Machinist_Hammer", "Nut_Screwdriver")]
    return [*_from_parts(tools), *_from_logs(tools, 2 if quick else 5)]


def _from_parts(tools: list[Tool]) -> list[Row]:
    group, alone = "Tools: from their parts", "Tools: as one material, with the true mass"
    off, plain, found = [], [], []
    for tool in tools:
        if tool.name not in PARTS:
            found.append(skipped(group, tool.name, "its surface is in open pieces: no parts are told apart"))
            continue
        try:
            made, whole = built(tool)
        except ValueError as error:
            found.append(skipped(group, tool.name, str(error)[:200]))
            continue
        size = made.size
        off.append([*errors(tool, made.mass, size), 100 * abs(float(made.mass.mass) / tool.mass - 1)])
        plain.append(errors(tool, whole, size))
        words = f"mass {off[-1][2]:.2g} %, inertia {off[-1][1]:.2g} %; one material: {plain[-1][0]:.2g} %"
        found.append(Row(group, f"{tool.name}: centre of mass", off[-1][0], "% of size", note=words))
    if not off:
        return found
    names = (("centre of mass", "% of size", 1.0), ("inertia", "%", 3.0), ("mass", "%", None))
    table = np.array(off)
    for k, (name, unit, target) in enumerate(names):
        low, middle, high = np.quantile(table[:, k], (0.25, 0.5, 0.75))
        note = f"worst {table[:, k].max():.2g}; nothing is fitted, {len(table)} tools"
        found.append(
            Row(group, f"{name}, median error", middle, unit, target, quartiles=(low, high), note=note)
        )
    for k, (name, unit) in enumerate((("centre of mass", "% of size"), ("inertia", "%"))):
        values = np.array(plain)[:, k]
        note = f"worst {values.max():.2g}"
        found.append(Row(alone, f"{name}, median error", float(np.median(values)), unit, note=note))
    return found


def built(tool: Tool) -> tuple[dano.NeuralObject, dano.objects.MassProperties]:
    """The tool of its parts by `dano.build_parts`, and mass properties of one material of the true mass."""
    import trimesh

    mesh = trimesh.load_mesh(tool.mesh, process=True)
    assert isinstance(mesh, trimesh.Trimesh)
    pieces = [piece for piece in mesh.split(only_watertight=False) if abs(piece.volume) > _LEAST_VOLUME]
    pieces = sorted(pieces, key=lambda piece: -abs(piece.volume))
    pieces = [piece for piece in pieces if len(piece.faces) > 20]
    densities = PARTS[tool.name]
    if len(pieces) != len(densities):
        raise ValueError(f"{tool.name} falls into {len(pieces)} parts, {len(densities)} are known")
    options = BuildOptions(samples=300, resolution=48, units="mm", up="z")
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        # That the files state no unit, and what of them was mended.
        warnings.simplefilter("ignore")
        parts = []
        for k, (piece, density) in enumerate(zip(pieces, densities, strict=True)):
            path = Path(folder) / f"part{k}.ply"
            piece.export(path)
            parts.append(dano.Part(path, density=density))
        made = dano.build_parts(parts, options)
    volumes = [abs(piece.volume) for piece in pieces]
    same = tool.mass / (1e-9 * sum(volumes))
    total, first, second = 0.0, np.zeros(3), np.zeros((3, 3))
    for piece in pieces:
        piece = piece if piece.volume > 0 else piece.copy()
        piece.apply_scale(1e-3)
        mass = same * abs(piece.volume)
        centre = np.asarray(piece.center_mass)
        inertia = same * np.asarray(piece.moment_inertia)
        total, first = total + mass, first + mass * centre
        second += 0.5 * np.trace(inertia) * np.eye(3) - inertia + mass * np.outer(centre, centre)
    com = first / total
    second -= total * np.outer(com, com)
    return made, dano.objects.MassProperties(total, com, np.trace(second) * np.eye(3) - second)


def errors(tool: Tool, mass: dano.objects.MassProperties, size: float) -> tuple[float, float]:
    """Of the centre of mass [% of the size] and of the inertia about it [%]."""
    centre = 100 * float(np.linalg.norm(np.asarray(mass.com) - tool.com)) / size
    inertia = 100 * float(
        np.linalg.norm(np.asarray(mass.inertia) - tool.inertia) / np.linalg.norm(tool.inertia)
    )
    return centre, inertia


def _from_logs(tools: list[Tool], seeds: int) -> list[Row]:
    group = "Tools: from a wrist's log"
    each: list[list[float]] = []
    held, lost, count = np.zeros(3), np.zeros(3), 0
    for tool in tools:
        turn, place = tool.grasp[:3, :3], tool.grasp[:3, 3]
        centre, inertia = turn.T @ (tool.com - place), turn.T @ tool.inertia @ turn
        size = _size(tool)
        for seed in range(seeds):
            fit = dano.identify_load(wrist_log(tool.mass, centre, inertia, seed))
            count += 1
            off = [np.nan] * 3
            truth = {"mass": tool.mass, "centre": centre, "inertia": inertia}
            for k, (name, value) in enumerate(truth.items()):
                if name in fit.unobserved:
                    lost[k] += 1
                    continue
                low, high = fit.interval(name)
                # Of several numbers the share that is held.
                held[k] += float(np.mean((low <= value) & (np.asarray(value) <= high)))
                scale = size if name == "centre" else np.linalg.norm(value)
                off[k] = 100 * float(np.linalg.norm(np.asarray(getattr(fit, name)) - value) / scale)
            each.append(off)
    table = np.array(each)
    note = f"{count} logs of {SECONDS:g} s, noise {NOISE[0]:g} N and {NOISE[1]:g} N m; nothing is fitted"
    found = []
    limits = (("mass", "%", None), ("centre", "% of size", 2.0), ("inertia", "%", 8.0))
    for k, (name, unit, target) in enumerate(limits):
        values = table[:, k][np.isfinite(table[:, k])]
        if not len(values):
            found.append(skipped(group, f"{name}, median error", "not observed in any log"))
            continue
        low, middle, high = np.quantile(values, (0.25, 0.5, 0.75))
        said = f"{note}; worst {values.max():.2g}"
        found.append(
            Row(group, f"{name}, median error", middle, unit, target, quartiles=(low, high), note=said)
        )
        inside = 100 * held[k] / (count - lost[k])
        found.append(Row(group, f"{name}: 95 % intervals that hold the truth", inside, "%", 90.0, True))
        found.append(Row(group, f"{name}: logs that do not decide it", 100 * lost[k] / count, "%"))
    return found


def _size(tool: Tool) -> float:
    import trimesh

    return 1e-3 * float(np.max(trimesh.load(tool.mesh, process=True).extents))


def wrist_log(mass: float, centre: np.ndarray, inertia: np.ndarray, seed: int) -> dano.WristLog:
    """What a sensor feels that shakes a load: the rates of its momenta, by differences of exact ones.

    The sensor turns by half a radian about three axes at 4 to 7 rad/s and moves by a few centimetres.
    """
    times = np.arange(0.0, SECONDS, 1 / RATE)
    step = 1e-4
    turns = {k: _turn(times + k * step) for k in (-1, 0, 1)}
    coms = {k: _place(times + k * step) + turns[k] @ centre for k in turns}
    acceleration = (coms[1] - 2 * coms[0] + coms[-1]) / step**2
    # Angular momentum about the centre of mass half a step before and after.
    halves = [_momentum(turns[k], turns[k + 1], inertia, step) for k in (-1, 0)]
    rate = (halves[1] - halves[0]) / step
    force = mass * (acceleration - np.array([0.0, 0.0, -9.81]))
    torque = rate + np.cross(turns[0] @ centre, force)
    readings = np.concatenate([np.einsum("tji,tj->ti", turns[0], x) for x in (force, torque)], axis=1)
    random = np.random.default_rng(seed)
    readings = readings + BIAS + random.normal(size=readings.shape) * np.repeat(NOISE, 3)
    quaternions = Rotation.from_matrix(turns[0]).as_quat()[:, [3, 0, 1, 2]]
    return dano.WristLog.create(
        times, position=_place(times), orientation=quaternions, force=readings[:, :3], torque=readings[:, 3:]
    )


def _place(t: np.ndarray) -> np.ndarray:
    return 0.04 * np.stack([np.sin(4.1 * t), np.cos(5.3 * t), np.sin(6.1 * t)], axis=-1)


def _turn(t: np.ndarray) -> np.ndarray:
    angles = 0.5 * np.stack([np.sin(5.1 * t), np.sin(6.7 * t + 1), np.sin(4.3 * t + 2)], axis=-1)
    return Rotation.from_euler("XYZ", angles).as_matrix()


def _momentum(before: np.ndarray, after: np.ndarray, inertia: np.ndarray, step: float) -> np.ndarray:
    """Angular momentum of a body that turns from one orientation to another in a step [W]."""
    vectors = Rotation.from_matrix(np.swapaxes(before, 1, 2) @ after).as_rotvec() / step
    middle = before @ Rotation.from_rotvec(0.5 * step * vectors).as_matrix()
    return np.einsum("tij,tj->ti", middle, vectors @ inertia.T)


def picture(source: Source, folder: Path) -> Path:
    """Centres of mass of the tools: true, of their parts, of one material."""
    from benchmarks.real._pictures import tools

    found = []
    for name in ("Machinist_Hammer", "Nut_Screwdriver", "C_Clamp", "Rubber_Mallet"):
        path = source.folder / "tools" / name
        if not path.is_dir():
            continue
        tool = Tool.load(path)
        made, whole = built(tool)
        points = np.asarray(made.surface.points)
        found.append(
            (name.replace("_", " "), points, tool.com, np.asarray(made.mass.com), np.asarray(whole.com))
        )
    return tools(folder / "real_tools.png", found)
