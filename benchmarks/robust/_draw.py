"""Random scenes, each a pure function of its seed.

Compiling costs seconds for every new set of shapes, so few sets are drawn (`Structure`), for each of them
some materials (`Material`: masses, friction, timestep, …), and for each of those some starts (`Start`).
"""

from dataclasses import dataclass

import numpy as np

KINDS = (
    "sphere",
    "box",
    "rounded box",
    "capsule",
    "cylinder",
    "ellipsoid",
    "plate",
    "bunny",
    "soap",
    "trained_bunny",
    "trained_soap",
)
OBJECTS = {"bunny": 0.075, "soap": 0.055, "trained_bunny": 0.075, "trained_soap": 0.055}
"""Shipped objects, and the radius of a ball around their centre of mass that they fit in [m]."""

SMALLEST, LARGEST = 0.01, 0.06
"""Half lengths of the shapes [m]: things that a hand can hold."""
PLATE = (0.001, 0.003)
"""Half the thickness of a thin plate [m]."""
ROUNDING = 0.3
"""Rounding of a rounded box over its smallest half length."""

MASS_RATIO = 1000.0
FRICTION, RESTITUTION, HYSTERESIS = 1.5, 0.9, 0.5
TIMESTEP = (0.001, 0.01)
SPEED, SPIN = 10.0, 50.0
"""Largest speed [m/s] and spin [rad/s] at the start."""

WALL_SHARE = 0.3
"""Share of the structures that have walls."""
WALL_THICKNESS = (0.002, 0.05)
WALL_HEIGHT, WALL_WIDTH = 1.0, 4.0
PILE, PILE_EVERY = 20, 12
"""Bodies in a pile, and which structures are one: every so manieth."""


@dataclass(frozen=True)
class Piece:
    """The shape of a body.

    Attributes:
        name: In the scene.
        kind: One of `KINDS`.
        lengths: Half lengths [m]: (r,) of a sphere, (x, y, z) of boxes and ellipsoids, (r, half length) of
            capsules and cylinders, () of shipped objects.
    """

    name: str
    kind: str
    lengths: tuple[float, ...]

    @property
    def radius(self) -> float:
        """Of a ball around the centre of mass that the body fits in [m]."""
        if self.kind in OBJECTS:
            return OBJECTS[self.kind]
        if self.kind == "capsule":
            return sum(self.lengths)
        if self.kind == "ellipsoid":
            return max(self.lengths)
        return float(np.linalg.norm(self.lengths))


@dataclass(frozen=True)
class Wall:
    """An upright fixed plate that stands on the floor.

    Attributes:
        name: In the scene.
        axis: 0 or 1: the world axis across it.
        side: 1 or −1: on which side of the origin it stands.
        distance: From the origin to its inner face [m].
        thickness: [m].
    """

    name: str
    axis: int
    side: int
    distance: float
    thickness: float

    @property
    def centre(self) -> tuple[float, float, float]:
        """[m, W]."""
        along = self.side * (self.distance + 0.5 * self.thickness)
        return (along, 0.0, 0.5 * WALL_HEIGHT) if self.axis == 0 else (0.0, along, 0.5 * WALL_HEIGHT)

    @property
    def half_extents(self) -> tuple[float, float, float]:
        """[m]."""
        across, along = 0.5 * self.thickness, 0.5 * WALL_WIDTH
        half_height = 0.5 * WALL_HEIGHT
        return (across, along, half_height) if self.axis == 0 else (along, across, half_height)


@dataclass(frozen=True)
class Structure:
    """What has to be compiled once: the shapes of a scene, over a floor, all pairs of which may touch."""

    seed: int
    number: int
    pieces: tuple[Piece, ...]
    walls: tuple[Wall, ...]
    pile: bool


@dataclass(frozen=True)
class Material:
    """What a scene of given shapes is made of.

    Attributes:
        timestep: h [s].
        masses: [kg], one for each piece.
        frictions: Coulomb coefficients, one for each piece; the larger one of a pair counts.
        restitution: Of all contacts.
        hysteresis: Of all contacts.
    """

    timestep: float
    masses: np.ndarray
    frictions: np.ndarray
    restitution: float
    hysteresis: float


@dataclass(frozen=True)
class Start:
    """Where the pieces start: apart from each other and above the floor.

    Attributes:
        position: Of the centres of mass [m, W], shape (n, 3).
        orientation: wxyz, body → world, shape (n, 4).
        velocity: [m/s, W], shape (n, 3).
        omega: [rad/s, B], shape (n, 3).
    """

    position: np.ndarray
    orientation: np.ndarray
    velocity: np.ndarray
    omega: np.ndarray


def draw_structure(seed: int, number: int, largest: int) -> Structure:
    """Shapes of 2 to 10 bodies or, now and then, of a pile of 20; never more than `largest`."""
    random = np.random.default_rng([seed, number])
    pile = number % PILE_EVERY == PILE_EVERY - 1 and largest >= PILE
    n = PILE if pile else int(random.integers(2, max(2, min(10, largest)) + 1))
    pieces = tuple(_piece(f"b{i}", random, pile) for i in range(n))
    if pile or random.random() > WALL_SHARE:
        return Structure(seed, number, pieces, (), pile)
    room = 2 * max(piece.radius for piece in pieces) + 0.1
    sides = random.permutation([(0, 1), (0, -1), (1, 1), (1, -1)])[: random.integers(1, 3)]
    walls = tuple(
        Wall(f"wall{i}", int(axis), int(side), float(room), float(random.uniform(*WALL_THICKNESS)))
        for i, (axis, side) in enumerate(sides)
    )
    return Structure(seed, number, pieces, walls, pile)


def _piece(name: str, random: np.random.Generator, pile: bool) -> Piece:
    # In a pile shapes only: twenty objects would take minutes to build.
    kinds = [kind for kind in KINDS if kind not in OBJECTS] if pile else KINDS
    kind = str(random.choice(kinds))
    lengths = np.exp(random.uniform(np.log(SMALLEST), np.log(LARGEST), 3))
    if kind in OBJECTS:
        return Piece(name, kind, ())
    if kind == "sphere":
        lengths = lengths[:1]
    elif kind in ("capsule", "cylinder"):
        lengths = lengths[:2]
    elif kind == "plate":
        lengths[2] = random.uniform(*PLATE)
    elif kind == "ellipsoid":
        # Longer ones than 1 : 3 are needles, whose tips no sample of their surface would find.
        lengths = np.maximum(lengths, lengths.max() / 3)
    return Piece(name, kind, tuple(float(x) for x in lengths))


def draw_material(structure: Structure, number: int) -> Material:
    """Masses over three decades, friction, losses and a timestep."""
    random = np.random.default_rng([structure.seed, structure.number, number, 1])
    n = len(structure.pieces)
    decades = np.log10(MASS_RATIO) / 2
    return Material(
        timestep=float(np.exp(random.uniform(*np.log(TIMESTEP)))),
        masses=10 ** random.uniform(-decades, decades, n),
        frictions=random.uniform(0, FRICTION, n),
        restitution=float(random.choice([0.0, random.uniform(0, RESTITUTION)])),
        hysteresis=float(random.uniform(0, HYSTERESIS)),
    )


def draw_start(structure: Structure, material: int, number: int) -> Start:
    """Places that leave room for every rotation, and velocities of which most are slow."""
    random = np.random.default_rng([structure.seed, structure.number, material, number, 2])
    n = len(structure.pieces)
    turns = random.normal(size=(n, 4))
    calm = 0.1 if structure.pile else 1.0
    return Start(
        position=_places(structure, random),
        orientation=turns / np.linalg.norm(turns, axis=1, keepdims=True),
        velocity=calm * SPEED * random.random((n, 1)) ** 2 * _directions(random, n),
        omega=calm * SPIN * random.random((n, 1)) ** 2 * _directions(random, n),
    )


def _places(structure: Structure, random: np.random.Generator) -> np.ndarray:
    """Centres [m] at which the balls around the bodies touch neither each other nor the floor or a wall."""
    placed: list[tuple[np.ndarray, float]] = []
    for piece in structure.pieces:
        placed.append((_place(structure, piece, placed, random), piece.radius))
    return np.array([place for place, _ in placed])


def _place(
    structure: Structure,
    piece: Piece,
    placed: list[tuple[np.ndarray, float]],
    random: np.random.Generator,
) -> np.ndarray:
    width = 0.1 if structure.pile else 0.05 + 0.01 * len(structure.pieces)
    ceiling = 0.2
    while True:
        height = piece.radius + 0.01 + random.random() * ceiling
        place = np.array([*random.uniform(-width, width, 2), height])
        free = all(np.linalg.norm(place - p) > piece.radius + r + 0.002 for p, r in placed)
        if free and all(w.side * place[w.axis] < w.distance - piece.radius for w in structure.walls):
            return place
        ceiling += 0.005  # too crowded a place is left for a higher one, so this ends


def _directions(random: np.random.Generator, n: int) -> np.ndarray:
    vectors = random.normal(size=(n, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
