"""Workshop tools of several materials: mass, centre and inertia from their parts, and from a wrist's log.

The meshes, what their parts are made of, and their mass properties are those of the STARS Laboratory's
workshop tools (MIT licence), from CAD. A mesh falls into its closed parts; which is of what material is
found from its sheet of materials, its colours and its weight (`densities`). Logs are computed from the true
mass properties: a wrist that holds the tool by the data set's grasp tilts and shakes it for ten seconds, with
noise and a bias in what it feels.
"""

import ast
import itertools
import re
import tempfile
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

import dano
from benchmarks._measure import Row, skipped
from benchmarks.real._data import NO_DATA, Source
from dano.building import BuildOptions

DENSITIES = {
    "cast carbon steel": 7800.0,
    "chrome stainless steel": 7800.0,
    "alloy steel": 7700.0,
    "brass": 8500.0,
    "aluminium": 2700.0,
    "pvc": 1300.0,
    "rubber": 1000.0,
    "oak": 560.0,
}
"""Densities [kg/m³] of the CAD program's materials of these names. It has none of oak: this is what the mass
of the hammer leaves for its handle."""

_FITS = 0.01
"""Share by which parts may miss the weight of their tool."""

_FLAPS = 0.05
"""Share of the volume that may be in open pieces of a surface."""

_MOST_CHOICES = 20_000

NOISE = (0.5, 0.02)  # N, N m
BIAS = np.array([2.0, -1.0, 1.5, 0.05, -0.08, 0.03])
SECONDS, RATE = 10.0, 250.0
NARROW = {"tilt": 0.0, "shake": 0.5}
"""A wrist that shakes the tool as fast but hardly tilts it: its weight looks as the sensor's bias does."""

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
        materials: What its sheet says of them.
    """

    name: str
    mesh: Path
    mass: float
    com: np.ndarray
    inertia: np.ndarray
    grasp: np.ndarray
    materials: str

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
        mass, com, inertia, grasp = (np.array(ast.literal_eval(found[name]), float) for name in names)
        sheet = (folder / "Materials.txt").read_text().lower()
        return cls(folder.name, folder / "mesh.ply", float(mass), com, inertia, grasp, sheet)


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
        note = f"worst {table[:, k].max():.2g}; {len(table)} of {len(tools)} tools"
        found.append(
            Row(group, f"{name}, median error", middle, unit, target, quartiles=(low, high), note=note)
        )
    for k, (name, unit) in enumerate((("centre of mass", "% of size"), ("inertia", "%"))):
        values = np.array(plain)[:, k]
        note = f"worst {values.max():.2g}"
        found.append(Row(alone, f"{name}, median error", float(np.median(values)), unit, note=note))
    return found


def built(tool: Tool) -> tuple[dano.NeuralObject, dano.objects.MassProperties]:
    """The tool of its parts by `dano.build_parts`, and mass properties of one material of the true mass.

    Raises:
        ValueError: If its parts are not told apart, or see `dano.build_parts`.
    """
    import trimesh

    pieces = _pieces(tool)
    chosen = densities(tool, pieces)
    options = BuildOptions(samples=300, resolution=48, units="mm", up="z")
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        # That the files state no unit, and what of them was mended.
        warnings.simplefilter("ignore")
        parts = []
        for density in sorted(set(chosen)):
            # Pieces of one material are one part: some lie in each other, and a mesh counts them once.
            mine = [piece for piece, each in zip(pieces, chosen, strict=True) if each == density]
            path = Path(folder) / f"material{density:g}.ply"
            trimesh.util.concatenate(mine).export(path)
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


def _pieces(tool: Tool) -> list[Any]:
    """The closed parts of its mesh [mm], from the largest down.

    Raises:
        ValueError: If much of it belongs to none.
    """
    import trimesh

    mesh = trimesh.load_mesh(tool.mesh, process=True)
    assert isinstance(mesh, trimesh.Trimesh)
    found = [p for p in mesh.split(only_watertight=False) if abs(p.volume) > _LEAST_VOLUME]
    flaps = [p for p in found if len(p.faces) <= 20]
    if sum(abs(p.volume) for p in flaps) > _FLAPS * abs(mesh.volume):
        raise ValueError(f"{tool.name}: its surface is in open pieces, no parts are told apart")
    return sorted((p for p in found if len(p.faces) > 20), key=lambda p: -abs(p.volume))


def densities(tool: Tool, pieces: Sequence[Any]) -> tuple[float, ...]:
    """Which piece is of which material of the sheet: what weighs as the tool does, to one per cent.

    Pieces of one colour are of one material; where none of these choices has the weight, each is on its own.
    The centre of mass and the inertia take no part.

    Raises:
        ValueError: If no choice has the tool's weight.
    """
    known = sorted({value for name, value in DENSITIES.items() if name in tool.materials})
    volumes = 1e-9 * np.abs([piece.volume for piece in pieces])
    colours = [_colour(piece) for piece in pieces]
    for groups in ([colours.index(c) for c in colours], list(range(len(pieces)))):
        names = sorted(set(groups))
        if len(known) ** len(names) > _MOST_CHOICES:
            continue
        choices = [dict(zip(names, c, strict=True)) for c in itertools.product(known, repeat=len(names))]
        # All that the sheet names is somewhere, if there are pieces enough.
        whole = [c for c in choices if len(set(c.values())) == min(len(known), len(names))]
        tried = [tuple(c[g] for g in groups) for c in whole]
        off = [abs(float(volumes @ each) / tool.mass - 1) for each in tried]
        if off and min(off) < _FITS:
            return tried[int(np.argmin(off))]
    raise ValueError(f"{tool.name}: no choice of {known} kg/m³ for {len(pieces)} parts has its mass")


def _colour(piece: Any) -> tuple[int, ...]:
    colours, counts = np.unique(piece.visual.face_colors[:, :3], axis=0, return_counts=True)
    return tuple(colours[np.argmax(counts)].tolist())


def errors(tool: Tool, mass: dano.objects.MassProperties, size: float) -> tuple[float, float]:
    """Of the centre of mass [% of the size] and of the inertia about it [%]."""
    centre = 100 * float(np.linalg.norm(np.asarray(mass.com) - tool.com)) / size
    inertia = 100 * float(
        np.linalg.norm(np.asarray(mass.inertia) - tool.inertia) / np.linalg.norm(tool.inertia)
    )
    return centre, inertia


def _from_logs(tools: list[Tool], seeds: int) -> list[Row]:
    logs = "Tools: from a wrist's log"
    cases = (
        (logs, {}, False),
        (f"{logs}, and the points of its surface", {}, True),
        (f"{logs} that tilts by half a radian", NARROW, False),
    )
    found = []
    for group, motion, shaped in cases:
        fits = [
            (tool, _loaded(tool, 1000 * k + seed, motion, shaped))
            for k, tool in enumerate(tools)
            for seed in range(seeds)
        ]
        found += _rows_of_logs(group, fits, aimed=group == logs)
    return found


def _loaded(tool: Tool, seed: int, motion: Mapping[str, Any], shaped: bool) -> dano.Load:
    centre, inertia = _held(tool)
    log = wrist_log(tool.mass, centre, inertia, seed, **motion)
    return dano.identify_load(log, shape=_surface(tool) if shaped else None)


def _held(tool: Tool) -> tuple[np.ndarray, np.ndarray]:
    """Centre of mass and inertia in the sensor's frame."""
    turn, place = tool.grasp[:3, :3], tool.grasp[:3, 3]
    return turn.T @ (tool.com - place), turn.T @ tool.inertia @ turn


def _surface(tool: Tool) -> np.ndarray:
    """The mesh's vertices in the sensor's frame [m]."""
    import trimesh

    points = 1e-3 * np.asarray(trimesh.load_mesh(tool.mesh, process=True).vertices)
    return (points - tool.grasp[:3, 3]) @ tool.grasp[:3, :3]


def _rows_of_logs(group: str, fits: Sequence[tuple[Tool, dano.Load]], *, aimed: bool) -> list[Row]:
    held, lost, table = np.zeros(3), np.zeros(3), np.full((len(fits), 3), np.nan)
    for row, (tool, fit) in zip(table, fits, strict=True):
        centre, inertia = _held(tool)
        truth = {"mass": tool.mass, "centre": centre, "inertia": inertia}
        for k, (name, value) in enumerate(truth.items()):
            if name in fit.unobserved:
                lost[k] += 1
                continue
            low, high = fit.interval(name)
            # Of several numbers the share that is held.
            held[k] += float(np.mean((low <= value) & (np.asarray(value) <= high)))
            scale = _size(tool) if name == "centre" else np.linalg.norm(value)
            row[k] = 100 * float(np.linalg.norm(np.asarray(getattr(fit, name)) - value) / scale)
    count = len(fits)
    note = f"{count} logs of {SECONDS:g} s, noise {NOISE[0]:g} N and {NOISE[1]:g} N m; nothing is fitted"
    found = []
    limits = (("mass", "%", None), ("centre", "% of size", 2.0), ("inertia", "%", 8.0))
    for k, (name, unit, limit) in enumerate(limits):
        values = table[:, k][np.isfinite(table[:, k])]
        if not len(values):
            found.append(skipped(group, f"{name}, median error", "not observed in any log"))
            continue
        low, middle, high = np.quantile(values, (0.25, 0.5, 0.75))
        said = f"{note}; worst {values.max():.2g}"
        target = limit if aimed else None
        found.append(
            Row(group, f"{name}, median error", middle, unit, target, quartiles=(low, high), note=said)
        )
        inside = 100 * held[k] / (count - lost[k])
        target = 90.0 if aimed else None
        found.append(Row(group, f"{name}: 95 % intervals that hold the truth", inside, "%", target, True))
        found.append(Row(group, f"{name}: logs that do not decide it", 100 * lost[k] / count, "%"))
    return found


def _size(tool: Tool) -> float:
    import trimesh

    return 1e-3 * float(np.max(trimesh.load(tool.mesh, process=True).extents))


def wrist_log(
    mass: float, centre: np.ndarray, inertia: np.ndarray, seed: int, *, tilt: float = 1.2, shake: float = 0.45
) -> dano.WristLog:
    """What a sensor feels that moves a load: the rates of its momenta, by differences of exact ones.

    The sensor tilts about three axes at 1 rad/s, shakes about them at 4 to 7 rad/s and moves by a few
    centimetres.

    Args:
        mass: Of the load [kg].
        centre: Of mass [m, S].
        inertia: About it [kg m², S].
        seed: Of the noise.
        tilt: Amplitude of the slow turns [rad].
        shake: Of the fast ones [rad].
    """
    times = np.arange(0.0, SECONDS, 1 / RATE)
    step = 1e-4
    turns = {k: _turn(times + k * step, tilt, shake) for k in (-1, 0, 1)}
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


def _turn(t: np.ndarray, tilt: float, shake: float) -> np.ndarray:
    slow, fast, phases = np.array([1.0, 0.7, 1.3]), np.array([5.1, 6.7, 4.3]), np.array([0.0, 1.0, 2.0])
    moments = t[:, None]
    angles = tilt * np.sin(slow * moments + phases) + shake * np.sin(fast * moments + phases)
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
