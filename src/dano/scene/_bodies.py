"""Bodies: geometry, mass properties, and a name."""

from collections.abc import Callable, Collection, Hashable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float, Int

from dano import contact, fields, maths, objects
from dano.checks import checked_optional, checked_text
from dano.compiling import one_program
from dano.names import did_you_mean
from dano.programs import keep_programs

# Orientations over which the support of a body is sampled.
ORIENTATIONS = 256


# Faces that a body may lie on are looked for among the normals of so many samples.
FACES = 256
# Samples within this share of the size above the lowest may touch: bodies sink by 0.5 %, and edges are round.
LAYER = 0.02

# Quantities of a start, and how many numbers each has; of joints as many as they have coordinates.
_START = {
    **{"position": 3, "origin": 3, "orientation": 4, "velocity": 3, "omega": 3, "spin_world": 3},
    **{"q": None, "v": None},
}
_ARGUMENTS = (
    *_START,
    *"mass inertia com mass_scale com_offset material gravcomp fixed weighed".split(),
)


class Body(eqx.Module):
    """A rigid body: geometry, mass properties, and a name."""

    name: str = eqx.field(static=True)  # Unique name in its scene
    shape: fields.AbstractShape | None  # Primitive shape, or None for a neural object
    object: objects.NeuralObject | None  # Neural object, or None for a shape
    # Contact samples in the layout of the contact kernels, or None for a shape without them.
    samples: contact.SampleSet | None
    support: contact.Support | None  # Culling map of the object's grid
    # Surface samples with vector areas, for distributed contact; None until a scene needs those of a shape.
    surface: contact.SurfaceSet | None
    # Centre of a ball around the body [m, F], its radius [m] (infinite for a half-space), the body's largest
    # extent and its largest depth below the surface [m]; None until a scene needs it.
    extent: Float[Array, "6"] | None
    # Makes the object's density dimensionless in neural–neural contacts: one over the mean density of its
    # samples.
    density_scale: Float[Array, ""]
    mass: Float[Array, ""]  # [kg]
    inertia: Float[Array, "3 3"]  # Tensor about the centre of mass [kg m², B]
    com: Float[Array, "3"]  # Centre of mass in the field frame [m, F]
    mass_scale: Float[Array, ""]  # Multiplies mass and inertia [1]
    com_offset: Float[Array, "3"]  # Moves the centre of mass [m, F]
    # Contact parameters for pairs that no contact of a scene names; None: the scene's.
    material: contact.ContactParams | None
    # Share of the weight that is held, as by a spring balance [1]; None: none.
    gravcomp: Float[Array, ""] | None
    fixed: bool = eqx.field(static=True)  # Whether the body never moves
    weighed: bool = eqx.field(static=True)  # Whether its mass is known (static)
    # Where `Scene.initial_state` puts it if nothing else is said: some of `position, orientation, velocity,
    # omega, origin, q, v`.
    start: dict[str, Array]

    def __init__(
        self,
        name: str,
        geometry: objects.NeuralObject | fields.AbstractField,
        *,
        mass: maths.Numbers | None = None,
        inertia: maths.Numbers | None = None,
        com: maths.Numbers | None = None,
        mass_scale: maths.Numbers = 1.0,
        com_offset: maths.Numbers = (0.0, 0.0, 0.0),
        material: contact.ContactParams | None = None,
        gravcomp: maths.Numbers | None = None,
        fixed: bool = False,
        weighed: bool = True,
        **start: maths.Numbers | None,
    ):
        """A body from a neural object (which brings its mass) or a shape (homogeneous, of the given mass).

        Args:
            name: Unique name.
            geometry: Neural object or shape.
            mass: [kg]; required for a shape that moves. For a neural object: replaces its mass, inertia in
                proportion.
            inertia: Tensor about the centre of mass [kg m²]; default from the geometry.
            com: Centre of mass [m, F]; default from the geometry.
            mass_scale: Multiplies mass and inertia.
            com_offset: Moves the centre of mass [m, F].
            material: Contact parameters of this body in a scene with `others`, instead of the scene's own.
            gravcomp: Share of the weight that is held: 1 and gravity does not pull at the body, more and it
                rises. As MuJoCo's.
            fixed: Whether the body never moves; then it needs no mass.
            weighed: Whether the mass is known. A scene with a body that moves and whose mass stands for one
                that nobody knows serves kinematics alone: it is not stepped.
            **start: Where it starts if `Scene.initial_state` is not told otherwise: `position` of the centre
                of mass, or `origin` of the field frame [m, W], `orientation` (wxyz), `velocity` [m/s, W],
                `omega` [rad/s, B] or `spin_world` [rad/s, W]; on a joint `q` and `v`.

        Raises:
            ValueError: If the name is empty, the geometry is not a shape or object, a mass property is
                missing or out of range, or an argument is unknown.
        """
        keep_programs()
        self.name = checked_text("name", name)
        self.fixed, self.weighed = bool(fixed), bool(weighed)
        self.material = checked_optional(f"material of body {name!r}", material, contact.ContactParams)
        # One by one: of a chain, pages of the API give all the annotation of the first.
        self.shape, self.object, self.samples = None, None, None
        self.support, self.surface, self.extent = None, None, None
        self.density_scale = maths.floating(1.0)
        if isinstance(geometry, objects.NeuralObject):
            self.object = geometry
            self.samples = contact.SampleSet.create(geometry.samples.points, geometry.samples.density)
            surface = geometry.surface
            self.surface = contact.SurfaceSet.create(surface.points, surface.vectors)
            self.density_scale = _over_mean(geometry.samples.density)
            if geometry.grid is not None:
                self.support = contact.Support.create(geometry.grid)
        elif isinstance(geometry, fields.AbstractShape):
            self.shape = geometry
        else:
            raise ValueError(
                f"geometry of body {name!r} must be a NeuralObject or a shape, "
                f"got {type(geometry).__name__}; a field becomes an object by NeuralObject.from_field"
            )
        mass = None if mass is None else maths.checked_array(f"mass of body {name!r}", mass, (), above=0.0)
        properties = _properties(name, geometry, (mass, com, inertia), self.fixed)
        self.mass = properties.mass if mass is None else mass
        self.inertia = (
            _shared(properties.inertia, properties.mass, self.mass)
            if inertia is None
            else objects.checked_inertia(f"inertia of body {name!r}", inertia)
        )
        self.com = properties.com if com is None else maths.checked_array(f"com of body {name!r}", com, (3,))
        self.mass_scale = maths.checked_array(f"mass_scale of body {name!r}", mass_scale, (), above=0.0)
        self.com_offset = maths.checked_array(f"com_offset of body {name!r}", com_offset, (3,))
        self.start = _checked_start(name, start)
        self.gravcomp = None
        if gravcomp is not None:
            self.gravcomp = maths.checked_array(f"gravcomp of body {name!r}", gravcomp, ())

    @property
    def size(self) -> float:
        """Largest extent [m]; infinite for a half-space."""
        if self.object is not None:
            return self.object.size
        assert self.shape is not None
        return float(np.ptp(np.asarray(self.shape.bounds), axis=0).max())

    @property
    def field(self) -> fields.AbstractField | None:
        """What other bodies' samples query: the shape, or the object's grid."""
        return self.shape if self.object is None else self.object.grid

    @property
    def solid(self) -> fields.AbstractShape | None:
        """What other bodies' surface samples press on: the shape, or the object's signed distance."""
        return self.shape if self.object is None else self.object.solid

    @property
    def is_flat(self) -> bool:
        """Whether edges and faces of the surface are known exactly; of objects, those of flat faces are."""
        if self.object is not None:
            return self.object.is_flat
        if isinstance(self.shape, fields.Box):
            return not maths.is_traced(self.shape.rounding) and float(self.shape.rounding) == 0
        return isinstance(self.shape, fields.Cylinder | fields.HalfSpace)

    @property
    def centre_of_mass(self) -> Float[maths.AnyArray, "3"]:
        """Where the centre of mass lies, with its offset [m, F]."""
        return self.com + self.com_offset

    def typical_support(self, depth: float) -> float:
        """Σ A d [m³] of the samples below a floor when the lowest of them lies at a depth [m].

        The median over orientations: most rest on a corner, an edge or a bulge.
        """
        assert self.surface is not None
        scale = np.asarray(self.scale)[:, None]
        points = scale * np.asarray(self.surface.points)[:3]
        vectors = scale.prod() / scale * np.asarray(self.surface.vectors)
        turned = self.surface.turning == "ball"
        # The densest samples of a ball lie at its −z, and turn to where it touches.
        up = np.array([[0.0, 0.0, 1.0]]) if turned else maths.even_directions(ORIENTATIONS)
        heights = up @ points
        depths = np.maximum(depth - (heights - heights.min(axis=1, keepdims=True)), 0)
        facing = np.maximum(-up @ vectors, 0)
        return float(np.median(np.sum(depths * facing, axis=1)))

    def most_touching(self, margin: float) -> int:
        """How many samples meet a floor at once, when the body lies as flat as it can.

        Args:
            margin: Distance from which samples are listed because a step may bring them into contact [m].
        """
        assert self.surface is not None
        points, vectors = np.asarray(self.surface.points)[:3], np.asarray(self.surface.vectors)
        n = points.shape[1]
        if self.surface.turning != "fixed":
            return n
        down = vectors[:, :: max(1, n // FACES)]
        down = down / np.maximum(np.linalg.norm(down, axis=0), 1e-300)
        heights = -down.T @ points
        layer = LAYER * (points.max(axis=1) - points.min(axis=1)).max() + margin
        return int(np.max(np.sum(heights <= heights.min(axis=1, keepdims=True) + layer, axis=1)))

    @property
    def scale(self) -> Float[maths.AnyArray, "3"]:
        """What directions on the unit ball are multiplied with to lie on the surface [m]; ones if unused."""
        if self.surface is None or self.surface.turning != "ball":
            ones = np.ones(3, self.com.dtype)
            return ones if maths.library(self.com) is np else maths.floating(ones)
        if isinstance(self.shape, fields.Sphere):
            return maths.stacked([self.shape.radius] * 3)
        assert isinstance(self.shape, fields.Ellipsoid)
        return self.shape.semi_axes

    def measured(self) -> Float[Array, "6"]:
        """`extent` of this body, on the host."""
        solid = self.solid
        if self.object is not None:
            points = np.asarray(self.object.surface.points)
            lower, upper = points.min(axis=0), points.max(axis=0)
        else:
            assert self.shape is not None
            lower, upper = np.asarray(self.shape.bounds)
        if not np.all(np.isfinite(upper - lower)):
            return maths.floating([0.0, 0.0, 0.0, np.inf, np.inf, np.inf])
        middle, size = 0.5 * (lower + upper), float((upper - lower).max())
        if isinstance(solid, fields.SignedDistanceGrid):
            thickness = -float(np.min(np.asarray(solid.coefficients)))
        else:
            thickness = 0.0 if solid is None else -float(_distance(solid, maths.floating(middle)))
        # The middle of a hollow solid is not a measure of its walls.
        thickness = thickness if thickness > 0 else 0.5 * float((upper - lower).min())
        radius = 0.5 * float(np.linalg.norm(upper - lower))
        return maths.floating([*middle, radius, size, thickness])

    def unused(self) -> "Body":
        """This body without what distributed contact asks of it."""
        nothing = (None, np.zeros(6, self.com.dtype))
        return eqx.tree_at(lambda b: (b.surface, b.extent), self, nothing, is_leaf=lambda x: x is None)

    def half_space_at(
        self, position: Float[Array | np.ndarray, "3"], orientation: Float[Array | np.ndarray, "4"]
    ) -> tuple[Float[np.ndarray, "3"], float] | None:
        """Unit normal [W] and distance from the origin [m] of its plane; None if it is not a half-space.

        Args:
            position: Of its centre of mass [m, W].
            orientation: wxyz.
        """
        if not isinstance(self.shape, fields.HalfSpace):
            return None
        turn = np.asarray(orientation)
        normal = maths.quat_rotate(turn, np.asarray(self.shape.normal_direction))
        origin = np.asarray(position) - maths.quat_rotate(turn, np.asarray(self.com))
        return normal, float(self.shape.offset) + float(normal @ origin)


def _checked_start(name: str, start: Mapping[str, maths.Numbers | None]) -> dict[str, Array]:
    """What a body says of its start, as arrays.

    Raises:
        ValueError: If a quantity is unknown, its shape is wrong, or position and origin are both given.
    """
    found = {}
    for key, value in start.items():
        if key not in _START:
            raise ValueError(
                f"body {name!r} takes no {key!r}: it starts by {list(_START)}{did_you_mean(key, _ARGUMENTS)}"
            )
        if value is not None:
            label = f"{key} of body {name!r}"
            size = _START[key]
            shape = np.shape(value) if size is None else (size,)
            check = (
                maths.checked_quaternion(label, value)
                if size == 4
                else maths.checked_array(label, value, shape)
            )
            found[key] = check
    check_once(f"start of body {name!r}", found)
    return found


def check_once(label: str, given: Collection[str]) -> None:
    """Check that neither the place nor the angular velocity is given in two ways.

    Raises:
        ValueError: If one is.
    """
    if {"position", "origin"} <= set(given):
        raise ValueError(f"{label} must be given by position (centre of mass) or by origin, got both")
    if {"omega", "spin_world"} <= set(given):
        raise ValueError(f"{label} must be given by omega (axes of the body) or by spin_world, got both")


@one_program
def _distance(shape: fields.AbstractShape, x: Float[Array, "3"]) -> Float[Array, ""]:
    return shape.sdf(x)


@maths.by_numpy
def _over_mean(density: Float[maths.Q, " n"]) -> Float[maths.AnyArray, ""]:
    return 1 / maths.library(density).mean(density)


@maths.by_numpy
def _shared(
    inertia: Float[maths.Q, "3 3"], own: Float[maths.Q, ""], mass: Float[maths.Q, ""]
) -> Float[maths.Q, "3 3"]:
    """Inertia of a body with another mass than its own."""
    return inertia * (mass / own)


def _properties(
    name: str,
    geometry: objects.NeuralObject | fields.AbstractShape,
    given: tuple[maths.Numbers | None, maths.Numbers | None, maths.Numbers | None],
    fixed: bool,
) -> objects.MassProperties:
    """Mass, centre of mass and inertia of a neural object, or of a shape from those of them that are given.

    Raises:
        ValueError: If the mass of a shape that moves is missing.
    """
    if isinstance(geometry, objects.NeuralObject):
        return geometry.mass
    mass, com, inertia = given
    if mass is not None and com is not None and inertia is not None:
        return objects.MassProperties(mass, com, inertia)
    if mass is not None:
        return _homogeneous(name, geometry, float(np.asarray(mass)))
    if not fixed:
        raise ValueError(f"mass of body {name!r} must be given: a shape that moves has none of its own")
    return objects.MassProperties(1.0, (0.0, 0.0, 0.0), np.eye(3))


def _homogeneous(name: str, shape: fields.AbstractShape, mass: float) -> objects.MassProperties:
    """Mass properties of a homogeneous solid shape: closed form where there is one, else integrated."""
    if not mass > 0:
        raise ValueError(f"mass of body {name!r} must be > 0 kg, got {mass}")
    if not np.all(np.isfinite(np.asarray(shape.bounds))):
        raise ValueError(f"body {name!r} must have a bounded shape or be fixed, got {type(shape).__name__}")
    moments = shape.solid_moments()
    if moments is None:
        return objects.MassProperties.from_field(shape, mass=mass)
    second = np.asarray(moments.second_moment) * (mass / float(moments.volume))
    return objects.MassProperties(mass, moments.centroid, np.trace(second) * np.eye(3) - second)


def alike(bodies: Sequence[Body]) -> list[int]:
    """For each body the first that has the same object, or a shape with the same numbers."""
    first: dict[Any, int] = {}
    return [first.setdefault(_geometry(body, i), i) for i, body in enumerate(bodies)]


def _geometry(body: Body, number: int) -> Hashable:
    """What bodies with the same geometry have in common; that of a body alone where numbers are traced."""
    if body.object is not None:
        return id(body.object)
    leaves, tree = jax.tree.flatten((body.shape, body.surface, body.extent))
    if maths.is_traced(leaves):
        return -1 - number
    return tree, tuple((x.shape, x.tobytes()) for x in map(np.asarray, leaves))


def by_geometry(function: Callable[[Body], Any], bodies: Sequence[Body]) -> list[Any]:
    """A function of each body that depends on its geometry alone: each geometry is looked at once."""
    kinds = alike(bodies)
    found = {i: function(bodies[i]) for i in dict.fromkeys(kinds)}
    return [found[i] for i in kinds]


def are_flat(bodies: Sequence[Body]) -> list[bool]:
    """Which bodies are flat."""
    return by_geometry(lambda body: body.is_flat, bodies)


def sizes_of(bodies: Sequence[Body]) -> Float[np.ndarray, " n"]:
    """`Body.size` of bodies [m]."""
    return np.array(by_geometry(lambda body: body.size, bodies), float)


def pressing_pairs(bodies: Sequence[Body], ends: Int[np.ndarray, "k 2"]) -> Int[np.ndarray, "pairs 3"]:
    """Pairs (first, second, contact) of which the first body's samples press on the second's solid.

    Args:
        bodies: All bodies.
        ends: Indices of the bodies of each contact with a point law.

    Both bodies' samples do where both have some. Against a ball or an ellipsoid a box's do not: the ball's
    own lie where it comes closest, and are enough.
    """
    turning = [None if body.surface is None else body.surface.turning for body in bodies]
    sampled = np.array([turns is not None for turns in turning], bool)
    ball = np.array([turns == "ball" for turns in turning], bool)
    is_object = np.array([body.object is not None for body in bodies], bool)
    has_solid = np.array([body.solid is not None for body in bodies], bool)
    first, second = np.stack([ends, ends[:, ::-1]], axis=1).reshape(-1, 2).T
    contact = np.repeat(np.arange(len(ends)), 2)
    press = sampled[first] & has_solid[second] & ~(ball[second] & ~ball[first] & ~is_object[first])
    return np.stack([first, second, contact], axis=1)[press]
