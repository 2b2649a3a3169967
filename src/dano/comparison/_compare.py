"""The verb: an object in our engine beside what meshes of it do in others."""

import math
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from dano.checks import checked_count, checked_items, checked_kind, checked_optional, checked_progress
from dano.comparison import _bodies
from dano.comparison._engines import has_pybullet, MuJoCo, Own, PyBullet
from dano.exchange import convex_hull, enclosed, Moments, signed_distances, solid_triangles, Triangles
from dano.extras import is_installed
from dano.fields import AbstractField, AbstractShape, bake, GridField
from dano.objects import NeuralObject, node_values
from dano.progress import Progress

TIMESTEP = 0.002
"""Of all engines [s]."""

SHARES = (0.03, 0.25, 0.5, 0.75, 1.0)
"""Default levels, as shares of the density that the object has near its surface."""

_ABOVE = 0.25
"""Height of the lowest point at the start, as a share of the size."""
_SETTLED = 20.0
"""Time until a drop is over, in units of √(size/g): 2.2 s for 12 cm."""
_COUNTS = 0.01
"""What a probe must be clear, or go in, to count, as a share of the size."""
_N_PROBES, _PROBE = 400, 0.04
"""Balls that feel for the surface, and their radius as a share of the size. 400 tell a share to 5 %
(binomial, 95 %)."""
_RESOLUTION = 96
"""Nodes along the longest axis of the grid that meshes are made of: as `dano build`."""


class Row(NamedTuple):
    """One way to simulate the object, measured. Shares and errors are 1, not per cent; NaN: not measured."""

    route: str  # What was made of the object
    engine: str  # Where it was simulated
    level: float = math.nan  # Density of the surface; NaN for the object itself
    preparation: float = math.nan  # Time for surface, pieces and loading [s]
    triangles: int = 0  # Of the surface
    pieces: int = 0  # Convex pieces that touch; 0 where contact is not with pieces
    parts: int = 0  # Connected parts of the surface
    open_edges: int = 0  # Edges without two faces; 0: watertight
    volume_error: float = math.nan  # Relative
    com_error: float = math.nan  # Distance over the size
    inertia_error: float = math.nan  # Largest difference of a principal moment, relative
    # Largest angle between a rest and the nearest stable pose of the reference [°]; of the object as
    # reference, of its mesh or of its samples.
    tilt: float = math.nan
    # Of all rests, the height of the reference's lowest point over the floor that is largest in size, over
    # the size of the reference; negative: below the floor.
    gap: float = math.nan
    phantom: float = math.nan  # Share of clear probes that touch
    phantom_gap: float = math.nan  # Largest clearance of one of them, over the size
    missed: float = math.nan  # Share of probes inside that do not touch
    step_time: float = math.nan  # At rest [s]
    # Largest distance between the same point of it and of the truth soon after the first contact, over the
    # size; mean over the drops.
    motion_error: float = math.nan
    moving: float = math.nan  # Largest speed at the end, over √(size · g)
    note: str = ""  # What else there is to say


class Scenery(NamedTuple):
    """What is drawn of a row: the first drop at rest."""

    row: Row  # Which
    meshes: list[Triangles]  # What touches, or the surface where that is the object itself [m, F]
    surface: Triangles  # Level surface that the pieces stand for [m, F]
    rotation: Float[np.ndarray, "3 3"]  # F → W at the end, shape (3, 3)
    origin: Float[np.ndarray, "3"]  # Of F at the end [m, W], shape (3,)


class Comparison(NamedTuple):
    """What `compare` found."""

    rows: list[Row]  # The object itself first
    # What to draw of them, in the same order; without those that could not be simulated.
    scenery: list[Scenery]
    reference: str  # What errors are measured against: "the truth" or "the neural object"
    size: float  # Of the reference [m]
    levels: list[float]  # Densities that were tried
    best: float  # The one whose cleaned surface has the volume of the reference
    drops: int  # Number of drops
    missing: list[str]  # Sentences on what is not installed


_Engine = Own | MuJoCo | PyBullet


class _Bench(NamedTuple):
    """What all rows share."""

    thing: NeuralObject
    solid: _bodies.Solid
    stable: Float[np.ndarray, "n 3"]
    starts: list[_bodies.Drop]
    n_steps: int
    probes: _bodies.Probes
    truth: NeuralObject | None
    true_paths: dict[str, list[_bodies.Path]]


def compare(
    thing: NeuralObject,
    *,
    field: AbstractField | None = None,
    truth: AbstractShape | None = None,
    levels: Sequence[float] | None = None,
    drops: int = 3,
    decomposed: bool = True,
    seed: int = 0,
    progress: Progress | None = None,
) -> Comparison:
    """Measure the mesh route against the neural object itself.

    Level surfaces of the density by marching cubes, as they are and cleaned (largest part, cavities filled),
    go as convex hulls into MuJoCo. The best level is the one with the volume of the reference. Its cleaned
    surface also goes as hull into PyBullet, as convex pieces (CoACD) into both, and as MuJoCo's signed
    distance of a mesh. Each is dropped on a plane from the same random orientations, and probed with small
    spheres. Every mesh has the mass of the object, spread evenly.

    Args:
        thing: The object; must have a density grid and a solid.
        field: The density that meshes are made of; default: the object's own grid, which has lost its
            floaters already.
        truth: The true solid, in the frame of the object. Errors are measured against it; default: against
            the object.
        levels: Densities of the surfaces; default: shares of the density near the object's surface.
        drops: Number of random orientations, from 1 to 100.
        decomposed: Whether to cut the best surface into convex pieces, which takes many minutes if it is
            ragged.
        seed: Of these and of the probes.
        progress: Called with a description and the share done.

    Returns:
        The measurements. What is not installed (CoACD, PyBullet) is left out and said.

    Raises:
        ImportError: If mujoco or libigl is missing.
        ValueError: If the object has no grid or no solid, or an option is out of range.
    """
    checked_kind("thing", thing, NeuralObject)
    checked_optional("field", field, AbstractField)
    checked_optional("truth", truth, AbstractShape)
    checked_count("seed", seed, least=0)
    if thing.grid is None or thing.solid is None:
        raise ValueError("object must have a density grid to be meshed, got one made of samples alone")
    checked_count("drops", drops, most=100)
    grid = _grid(thing.grid if field is None else field)
    top = float(grid.values.max())
    chosen = _checked_levels(thing, levels, top)
    say = checked_progress(progress)
    say("reference", 0.0)
    bench = _bench(thing, truth, drops, seed)
    best = _bodies.best_level(grid, bench.solid.moments.volume)
    missing = _missing(decomposed)
    say("the object itself", 0.02)
    rows, scenery = [], []
    begin = time.perf_counter()
    own = Own(thing, TIMESTEP)
    _measured(bench, own, _own_row(bench), [], _surface(thing), rows, scenery, begin)
    _measure_meshes(bench, grid, chosen, best, decomposed, say, rows, scenery)
    say("done", 1.0)
    reference = "the neural object" if truth is None else "the truth"
    return Comparison(rows, scenery, reference, bench.solid.size, chosen, best, drops, missing)


def _measure_meshes(
    bench: _Bench,
    grid: _bodies.Grid,
    levels: Sequence[float],
    best: float,
    decomposed: bool,
    say: Callable[[str, float], object],
    rows: list[Row],
    scenery: list[Scenery],
) -> None:
    """Measure hulls of surfaces at all levels; of the best one its distance and its convex pieces, too."""
    jobs = [(level, cleaned) for level in levels for cleaned in (False, True)]
    for i, (level, cleaned) in enumerate(jobs):
        say(f"surface at {level:.3g}", 0.1 + 0.4 * i / len(jobs))
        mesh = _bodies.level_mesh(grid, level, cleaned=cleaned)
        route = "hull of the cleaned surface" if cleaned else "hull of the surface as it is"
        _mesh_row(bench, mesh, route, _bodies.hull_of, MuJoCo, rows, scenery)
    say("best surface", 0.5)
    mesh = _bodies.level_mesh(grid, best, cleaned=True)
    _mesh_row(bench, mesh, "best surface: hull", _bodies.hull_of, MuJoCo, rows, scenery)
    say("its signed distance", 0.55)
    _mesh_row(
        bench, mesh, "best surface: signed distance", _bodies.hull_of, MuJoCo, rows, scenery, as_distance=True
    )
    if has_pybullet():
        _mesh_row(bench, mesh, "best surface: hull", _bodies.hull_of, PyBullet, rows, scenery)
    if decomposed and is_installed("coacd"):
        say("convex pieces", 0.65)
        pieces = _bodies.pieces_of(grid, mesh)
        engines = (MuJoCo, PyBullet) if has_pybullet() else (MuJoCo,)
        for engine in engines:
            _mesh_row(bench, mesh, "best surface: CoACD", lambda _: pieces, engine, rows, scenery)


def _missing(decomposed: bool) -> list[str]:
    found = []
    if not decomposed:
        found.append("Convex decomposition is left out, as asked.")
    elif not is_installed("coacd"):
        found.append("Convex decomposition is left out: pip install 'dano[export]'.")
    if not has_pybullet():
        found.append(
            "PyBullet is left out: pip install 'dano[pybullet]', which has wheels up to Python 3.11."
        )
    return found


def _grid(field: AbstractField) -> _bodies.Grid:
    if not isinstance(field, GridField):
        field, _ = bake(field, _RESOLUTION)
    return _bodies.Grid(
        np.maximum(np.asarray(node_values(field), np.float64), 0),
        np.asarray(field.origin, np.float64),
        np.asarray(field.spacing, np.float64),
    )


def _checked_levels(thing: NeuralObject, levels: Sequence[float] | None, top: float) -> list[float]:
    if levels is None:
        dense = float(np.median(np.asarray(thing.samples.density)))
        if thing.interior is not None:
            dense = max(float(thing.interior.wall), 2 * float(thing.interior.level))
        return [share * min(dense, 0.95 * top) for share in SHARES]
    levels = checked_items("levels", levels, float, int)
    for level in levels:
        if not 0 < level < top:
            raise ValueError(f"levels must lie between 0 and the largest density {top:.4g}, got {level}")
    if len(levels) == 0:
        raise ValueError("levels must name at least one density, got none")
    return [float(level) for level in levels]


def _surface(thing: NeuralObject) -> Triangles:
    assert thing.solid is not None
    return solid_triangles(thing.solid, _RESOLUTION)[0]


def _bench(thing: NeuralObject, truth: AbstractShape | None, drops: int, seed: int) -> _Bench:
    true = None
    if truth is not None:
        true = NeuralObject.from_field(truth, mass=float(thing.mass.mass))
    shape = thing.solid if truth is None else truth
    assert shape is not None
    mesh, normals = solid_triangles(shape, _RESOLUTION)
    hull = convex_hull(mesh.vertices)
    size = float(np.ptp(mesh.vertices, axis=0).max())
    solid = _bodies.Solid(enclosed(mesh), mesh.vertices, normals, hull, size)
    com = np.asarray((thing if true is None else true).mass.com, np.float64)
    random = np.random.default_rng(seed)
    starts = [_start(hull.vertices, size, random) for _ in range(drops)]
    chosen = random.choice(len(mesh.vertices), min(_N_PROBES, len(mesh.vertices)), replace=False)
    radius = _PROBE * size
    clear = random.uniform(-0.5 * _PROBE, 0.1, len(chosen)) * size
    centres = mesh.vertices[chosen] + (radius + clear)[:, None] * normals[chosen]
    # Not `clear`: another part of the surface may be nearer.
    clearance = signed_distances(shape, centres)[0] - radius
    probes = _bodies.Probes(centres, radius, clearance)
    n_steps = round(_SETTLED * math.sqrt(size / _bodies.GRAVITY) / TIMESTEP)
    stable = _bodies.stable_directions(hull, com)
    if true is None:
        # The object touches by samples. Where its surface is ragged their hull stands on other points.
        samples = convex_hull(np.asarray(thing.surface.points, np.float64))
        stable = np.concatenate([stable, _bodies.stable_directions(samples, com)])
    return _Bench(thing, solid, stable, starts, n_steps, probes, true, {})


def _start(points: Float[np.ndarray, "n 3"], size: float, random: np.random.Generator) -> _bodies.Drop:
    """A random orientation, slowly turning, the lowest point a quarter of the size over the floor."""
    orientation = random.normal(size=4)
    orientation /= np.linalg.norm(orientation)
    start = _bodies.Drop(
        np.zeros(3), orientation, 0.3 * math.sqrt(_bodies.GRAVITY / size) * random.normal(size=3)
    )
    lowest = float((points @ _bodies.rotation_of(start)[2]).min())
    return start._replace(origin=np.array([0.0, 0.0, _ABOVE * size - lowest]))


def _errors(bench: _Bench, moments: Moments, com: np.ndarray, inertia: np.ndarray) -> dict[str, float]:
    """Of volume, centre of mass and inertia (of the object's mass), against the reference."""
    reference = bench.thing if bench.truth is None else bench.truth
    true = np.linalg.eigvalsh(np.asarray(reference.mass.inertia))
    true *= float(bench.thing.mass.mass) / float(reference.mass.mass)
    away = np.linalg.norm(com - np.asarray(reference.mass.com))
    return {
        "volume_error": moments.volume / bench.solid.moments.volume - 1,
        "com_error": float(away) / bench.solid.size,
        "inertia_error": float(np.abs(np.linalg.eigvalsh(inertia) / true - 1).max()),
    }


def _own_row(bench: _Bench) -> Row:
    surface = _surface(bench.thing)
    mass = bench.thing.mass
    errors = _errors(bench, enclosed(surface), np.asarray(mass.com), np.asarray(mass.inertia))
    if bench.truth is None:
        errors = {}  # It is the reference.
    return Row("neural object", "dano")._replace(**errors)


def _mesh_row(
    bench: _Bench,
    mesh: _bodies.Mesh,
    route: str,
    touch: Callable[[_bodies.Mesh], tuple[list[Triangles], float]],
    engine: type[MuJoCo] | type[PyBullet],
    rows: list[Row],
    scenery: list[Scenery],
    *,
    as_distance: bool = False,
) -> None:
    """Measure one mesh in one engine and append what was found, or why it could not be."""
    triangles = mesh.triangles
    row = Row(
        route,
        engine.name,
        mesh.level,
        triangles=len(triangles.faces),
        parts=mesh.parts,
        open_edges=triangles.open_edges,
    )
    begin = time.perf_counter()
    try:
        pieces, seconds = touch(mesh)
        moments, note = mesh.moments, ""
        if "CoACD" in route:
            moments = _bodies.together(pieces)
        inertia = _inertia(bench, moments)
        if inertia is None:
            moments, note = enclosed(pieces[0]), "weighed by its hull: the mesh encloses no volume"
            inertia = _inertia(bench, moments)
        if inertia is None:
            raise ValueError("its hull encloses no volume")
        rigid = _bodies.Rigid(pieces, float(bench.thing.mass.mass), moments.com, inertia)
        rigid = rigid._replace(surface=triangles if as_distance else None)
        begin = time.perf_counter() - mesh.seconds - seconds
        made = engine(rigid, TIMESTEP)
    except ValueError as error:
        rows.append(row._replace(note=" ".join(str(error).split())))
        return
    row = row._replace(
        pieces=0 if as_distance else len(pieces),
        note=note,
        **_errors(bench, mesh.moments, moments.com, inertia),
    )
    _measured(bench, made, row, pieces, triangles, rows, scenery, begin)


def _inertia(bench: _Bench, moments: Moments) -> Float[np.ndarray, "3 3"] | None:
    """Of the object's mass spread evenly; None if no solid has it."""
    if not moments.volume > 0:
        return None
    inertia = float(bench.thing.mass.mass) / moments.volume * moments.inertia
    least, middle, most = np.linalg.eigvalsh(inertia)
    return inertia if least > 0 and least + middle > most else None


def _measured(
    bench: _Bench,
    engine: _Engine,
    row: Row,
    pieces: list[Triangles],
    surface: Triangles,
    rows: list[Row],
    scenery: list[Scenery],
    begin: float,
) -> None:
    """Drop and probe; append the row and what is drawn of it. `begin`: when its preparation began [s]."""
    prepared = time.perf_counter() - begin
    paths = [engine.drop(start, bench.n_steps) for start in bench.starts]
    phantom, largest, missed = bench.probes.judged(engine.touching(bench.probes), _COUNTS * bench.solid.size)
    engine.close()
    size, last = bench.solid.size, [(path.rotation[-1], path.origin[-1]) for path in paths]
    gaps = [float((bench.solid.points @ turn[2]).min() + at[2]) / size for turn, at in last]
    ends = [path.of(bench.solid.hull.vertices)[-10:] for path in paths]
    speeds = [np.linalg.norm(end[-1] - end[0], axis=-1).max() / (9 * TIMESTEP) for end in ends]
    if unsolved := sum(path.unsolved for path in paths):
        row = row._replace(note=f"{unsolved} of {bench.n_steps * len(paths)} steps were not solved")
    row = row._replace(
        preparation=prepared,
        tilt=max(_bodies.nearest_rest(turn[2], bench.stable) for turn, _ in last),
        gap=max(gaps, key=abs),
        phantom=phantom,
        phantom_gap=largest / size,
        missed=missed,
        step_time=min(path.step_time for path in paths),
        motion_error=_motion_error(bench, engine.name, paths),
        moving=float(max(speeds)) / math.sqrt(size * _bodies.GRAVITY),
    )
    rows.append(row)
    scenery.append(Scenery(row, pieces or [surface], surface, *last[0]))


def _motion_error(bench: _Bench, engine: str, paths: list[_bodies.Path]) -> float:
    """Against the true solid in the same engine: on a plane its hull is as good as itself."""
    if bench.truth is None:
        return math.nan
    if engine not in bench.true_paths:
        mass = bench.truth.mass
        if engine == Own.name:
            true: _Engine = Own(bench.truth, TIMESTEP)
        else:
            rigid = _bodies.Rigid(
                [bench.solid.hull], float(mass.mass), np.asarray(mass.com), np.asarray(mass.inertia)
            )
            true = (MuJoCo if engine == MuJoCo.name else PyBullet)(rigid, TIMESTEP)
        bench.true_paths[engine] = [true.drop(start, bench.n_steps) for start in bench.starts]
        true.close()
    # Three times the time to the floor: later, what is chaotic is larger than what is wrong.
    until = round(3 * math.sqrt(2 * _ABOVE * bench.solid.size / _bodies.GRAVITY) / TIMESTEP)
    points = bench.solid.hull.vertices
    apart = [
        np.linalg.norm(path.of(points, until) - true.of(points, until), axis=-1).max()
        for path, true in zip(paths, bench.true_paths[engine], strict=True)
    ]
    return float(np.mean(apart)) / bench.solid.size
