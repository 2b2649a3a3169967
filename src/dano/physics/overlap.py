"""Overlap of samples with a field of density (docs/theory/contact.md, "Overlap").

    ψ = m Σ w φ(x),    ψ χ = m Σ w φ(x) x,    n ∝ Σ w φ(x) d(x)

over the weighted samples of one body in the density φ of another, whose outward direction is d. A field is a
run of *parts*, and as dense as the densest of them. A part is a solid, inside of which φ is 1 and outside 0
with a smooth edge between, or a grid of densities: a leaf of kind `DENSITY`.
"""

import warp as wp

from dano.physics.features import KINDS, UNIONS
from dano.physics.real import HALF, INFINITY, mat33, ONE, real, TWO, vec3, vec4, ZERO
from dano.physics.solids.distances import nearest_leaf, Solid, solid_clearance, solid_distance, solid_of
from dano.physics.solids.grids import grid_spline, STEEPEST
from dano.physics.solids.kinds import CAPSULE, DENSITY, ELLIPSOID, GRID, HALF_SPACE, SPHERE
from dano.physics.solids.leaves import Distance, Leaf, LeafKind, Solids

_DENSITY, _HALF_SPACE, _GRID = wp.constant(DENSITY), wp.constant(HALF_SPACE), wp.constant(GRID)
_SPHERE, _CAPSULE, _ELLIPSOID = wp.constant(SPHERE), wp.constant(CAPSULE), wp.constant(ELLIPSOID)
# Below this share of a body's mass an overlap counts as none: ψ² must not underflow in derivatives of χ.
_NEGLIGIBLE = wp.constant(real(1e-12))


@wp.struct
class Part:
    """One part of a field.

    Attributes:
        edge: Width of the smooth edge of a solid, 0 for none [m].
        map_origin: First node of the map of distances to where a grid's density is positive [m, leaf].
        map_extent: From its first to its last node [m].
        map_resolution: Its nodes per length [1/m].
    """

    edge: real
    map_origin: vec3
    map_extent: vec3
    map_resolution: vec3


@wp.struct
class PartKind:
    """Whole numbers of a part."""

    first_leaf: wp.int32  # Of its solid, or its grid
    leaves: wp.int32  # How many leaves the solid has
    # 1 where the outward direction is the gradient of the distance: of boxes, cylinders, sampled distances
    # and unions; 0 where the shape knows a direction of its own.
    by_gradient: wp.int32
    first_distance: wp.int32  # Place of the first number of the map
    map_y: wp.int32  # Its nodes along y
    map_z: wp.int32  # Along z


@wp.struct
class Fields:
    """The parts of all fields."""

    parts: wp.array2d(dtype=Part)  # Shape (worlds, parts)
    kinds: wp.array(dtype=PartKind)  # Shape (parts,)
    # Lower bounds on the distance to where the density is positive [m], from any point whose nearest node it
    # is, of all maps, shape (worlds, nodes).
    distances: wp.array2d(dtype=real)


@wp.struct
class Field:
    """A field: a run of parts, and the first of them."""

    first: int  # Index of the first part
    count: int  # Number of parts
    part: Part  # The first part
    kind: PartKind  # Its whole numbers
    solid: Solid  # Its solid, or its grid


@wp.struct
class Density:
    """Density φ [unit of the field], and the outward direction d, which is no unit vector."""

    value: real
    direction: vec3


@wp.struct
class WeightedSample:
    """A sample of a body: where it is [m, F], and its share of the body's mass [1]."""

    point: vec3
    weight: real


@wp.struct
class Frame:
    """Where a body's frame is: rotation F → W, and origin [m, W]."""

    rotation: mat33
    origin: vec3


@wp.struct
class View:
    """A field as the samples of another body see it.

    Attributes:
        rotation: Frame of the samples → frame of the field.
        origin: Of the samples' frame [m, frame of the field].
        is_plane: Whether the field is one half-space, whose distance is linear in the coordinates of samples.
        reach: How far from a half-space its density ends: half its edge [m].
        plane: Unit normal of a half-space in the samples' frame, and the height of their origin above it [m].
        normal: The unit normal in the field's frame.
    """

    rotation: mat33
    origin: vec3
    is_plane: bool
    reach: real
    plane: vec4
    normal: vec3


@wp.struct
class Sums:
    """Sums over samples."""

    share: real  # Σ w φ, or with the mass [kg] ψ
    moment: vec3  # Σ w φ x [m], or ψ χ [kg m, W]
    direction: vec3  # Σ w φ d


@wp.struct
class Patch:
    """Overlap of two bodies.

    Attributes:
        overlap: ψ [kg], zero where they do not touch.
        centroid: χ [m, W].
        normal: n, unit vector from the second body to the first [W].
    """

    overlap: real
    centroid: vec3
    normal: vec3


@wp.func
def occupancy(distance: real, edge: real) -> real:
    """t² (3 − 2 t) with t = ½ − s/ε within [0, 1]: 1 inside, 0 outside; without an edge 1 where s ≤ 0."""
    t = wp.where(distance <= ZERO, ONE, ZERO)
    if edge > ZERO:
        t = wp.clamp(HALF - distance / edge, ZERO, ONE)
    return t * t * (real(3.0) - TWO * t)


@wp.func(inline=True)
def in_leaf(leaf: Leaf, x: vec3) -> vec3:
    """A point of the field's frame in the axes of a leaf [m]."""
    return (ONE / leaf.factor) * (wp.transpose(leaf.rotation) * (x - leaf.position))


@wp.func
def outward(kind: LeafKind, leaf: Leaf, x: vec3, d: Distance) -> vec3:
    """Direction of a shape that knows one: the way from its middle, or the gradient of its quadratic form."""
    direction = d.gradient
    if wp.static(SPHERE in KINDS or CAPSULE in KINDS):
        if kind.kind == _SPHERE or kind.kind == _CAPSULE:
            direction = (d.value / leaf.factor + leaf.sizes[0]) * d.gradient
    if wp.static(ELLIPSOID in KINDS):
        if kind.kind == _ELLIPSOID:
            y = in_leaf(leaf, x)
            a = leaf.sizes
            direction = leaf.rotation * vec3(y[0] / (a[0] * a[0]), y[1] / (a[1] * a[1]), y[2] / (a[2] * a[2]))
    return direction


@wp.func(inline=True)
def grid_density(solids: Solids, world: int, kind: LeafKind, leaf: Leaf, y: vec3) -> Density:
    """The spline φ of a grid, zero where no node reaches, and d = −∇φ, at a point in axes of the leaf."""
    found = Density()
    x = y - leaf.sizes
    place = vec3(x[0] / leaf.spacing[0], x[1] / leaf.spacing[1], x[2] / leaf.spacing[2])
    reach = HALF * real(kind.degree + 1)
    border = 2 * (kind.degree + 1) + 1
    lowest = wp.min(place[0], wp.min(place[1], place[2]))
    beyond = wp.max(
        place[0] - real(kind.nodes_x - border),
        wp.max(place[1] - real(kind.nodes_y - border), place[2] - real(kind.nodes_z - border)),
    )
    if lowest > -reach and beyond < reach:
        d = grid_spline(solids, world, kind, place)
        g = d.gradient
        found.value = d.value
        found.direction = -(
            leaf.rotation * vec3(g[0] / leaf.spacing[0], g[1] / leaf.spacing[1], g[2] / leaf.spacing[2])
        )
    return found


@wp.func(inline=True)
def map_distance(fields: Fields, world: int, part: Part, kind: PartKind, y: vec3) -> real:
    """Lower bound on the distance [m] from a point, in axes of the leaf, to where the density is positive.

    Outside the box of the map, with the way b to it and the bound d there, √(b² + d²): what is positive
    lies in the box.
    """
    u = y - part.map_origin
    inside = vec3(
        wp.clamp(u[0], ZERO, part.map_extent[0]),
        wp.clamp(u[1], ZERO, part.map_extent[1]),
        wp.clamp(u[2], ZERO, part.map_extent[2]),
    )
    i = int(inside[0] * part.map_resolution[0] + HALF)
    j = int(inside[1] * part.map_resolution[1] + HALF)
    k = int(inside[2] * part.map_resolution[2] + HALF)
    bound = fields.distances[world, kind.first_distance + (i * kind.map_y + j) * kind.map_z + k]
    away = u - inside
    squared = wp.dot(away, away)
    if squared > ZERO:
        positive = wp.max(bound, ZERO)
        bound = wp.sqrt(squared + positive * positive)
    return bound


@wp.func(inline=True)
def shell_density(part: Part, kind: PartKind, solid: Solid, x: vec3, d: Distance) -> Density:
    """Density of a solid from its distance, at a point [m, F]."""
    found = Density()
    found.value = occupancy(d.value, part.edge)
    found.direction = d.gradient
    if wp.static(SPHERE in KINDS or CAPSULE in KINDS or ELLIPSOID in KINDS):
        if kind.by_gradient == 0:
            found.direction = outward(solid.kind, solid.leaf, x, d)
    return found


@wp.func(inline=True)
def part_density(
    solids: Solids, fields: Fields, world: int, part: Part, kind: PartKind, solid: Solid, x: vec3
) -> Density:
    """Density of one part, at a point [m, F]."""
    found = Density()
    is_grid = bool(False)
    if wp.static(DENSITY in KINDS):
        is_grid = solid.kind.kind == _DENSITY
        if is_grid:
            y = in_leaf(solid.leaf, x)
            # Most samples that come here lie beside what is positive, where the map saves the spline.
            if map_distance(fields, world, part, kind, y) <= ZERO:
                found = grid_density(solids, world, solid.kind, solid.leaf, y)
    if not is_grid:
        found = shell_density(part, kind, solid, x, solid_distance(solids, world, solid, x))
    return found


@wp.func
def part_solid(solids: Solids, world: int, kind: PartKind) -> Solid:
    """Solid or grid of a part."""
    return solid_of(solids, world, kind.first_leaf, kind.leaves)


@wp.func
def field_of(solids: Solids, fields: Fields, world: int, first: int, count: int) -> Field:
    """A field by its parts."""
    field = Field()
    field.first = first
    field.count = count
    field.part = fields.parts[world, first]
    field.kind = fields.kinds[first]
    field.solid = part_solid(solids, world, field.kind)
    return field


@wp.func(inline=True)
def density(solids: Solids, fields: Fields, world: int, field: Field, x: vec3) -> Density:
    """Density of a field at a point [m, F]: that of the densest part."""
    found = part_density(solids, fields, world, field.part, field.kind, field.solid, x)
    if wp.static(UNIONS):
        for i in range(field.first + 1, field.first + field.count):
            kind = fields.kinds[i]
            solid = part_solid(solids, world, kind)
            other = part_density(solids, fields, world, fields.parts[world, i], kind, solid, x)
            if other.value > found.value:
                found = other
    return found


@wp.func
def densest(solids: Solids, fields: Fields, world: int, field: Field, x: vec3) -> Field:
    """The part of a field that counts at a point [m, F], its nearest leaf alone."""
    leading = field
    if wp.static(UNIONS):
        most = part_density(solids, fields, world, field.part, field.kind, field.solid, x).value
        for i in range(field.first + 1, field.first + field.count):
            kind = fields.kinds[i]
            solid = part_solid(solids, world, kind)
            value = part_density(solids, fields, world, fields.parts[world, i], kind, solid, x).value
            if value > most:
                most = value
                leading.first = i
                leading.part = fields.parts[world, i]
                leading.kind = kind
                leading.solid = solid
        leading.count = 1
        if leading.solid.count > 1:
            leading.solid = nearest_leaf(solids, world, leading.solid, x)
    return leading


@wp.func(inline=True)
def part_clearance(
    solids: Solids, fields: Fields, world: int, part: Part, kind: PartKind, solid: Solid, x: vec3
) -> real:
    """Lower bound on the distance [m] from a point [m, F] to where a part's density is positive."""
    clearance = ZERO
    is_grid = bool(False)
    if wp.static(DENSITY in KINDS):
        is_grid = solid.kind.kind == _DENSITY
        if is_grid:
            clearance = solid.leaf.factor * map_distance(fields, world, part, kind, in_leaf(solid.leaf, x))
    if not is_grid:
        clearance = solid_clearance(solids, world, solid, x, INFINITY) - HALF * part.edge
        if wp.static(GRID in KINDS):
            clearance = clearance / STEEPEST
    return clearance


@wp.func(inline=True)
def field_clearance(solids: Solids, fields: Fields, world: int, field: Field, x: vec3) -> real:
    """Lower bound on the distance [m] from a point [m, F] to where a field's density is positive."""
    clearance = part_clearance(solids, fields, world, field.part, field.kind, field.solid, x)
    if wp.static(UNIONS):
        for i in range(field.first + 1, field.first + field.count):
            kind = fields.kinds[i]
            solid = part_solid(solids, world, kind)
            other = part_clearance(solids, fields, world, fields.parts[world, i], kind, solid, x)
            clearance = wp.min(clearance, other)
    return clearance


@wp.func
def view_of(field: Field, sampled: Frame, queried: Frame) -> View:
    """A field as the samples of another body see it."""
    view = View()
    inverse = wp.transpose(queried.rotation)
    view.rotation = inverse * sampled.rotation
    view.origin = inverse * (sampled.origin - queried.origin)
    if wp.static(HALF_SPACE in KINDS):
        view.is_plane = field.solid.kind.kind == _HALF_SPACE and field.count == 1 and field.kind.leaves == 1
        if view.is_plane:
            leaf = field.solid.leaf
            view.reach = HALF * field.part.edge
            view.normal = leaf.rotation * leaf.sizes
            n = wp.transpose(view.rotation) * view.normal
            height = wp.dot(view.normal, view.origin - leaf.position) - leaf.factor * leaf.length
            view.plane = vec4(n[0], n[1], n[2], height)
    return view


@wp.func(inline=True)
def plane_distance(view: View, point: vec3) -> real:
    """Signed distance [m] of a half-space from a point in the samples' frame."""
    return view.plane[0] * point[0] + view.plane[1] * point[1] + view.plane[2] * point[2] + view.plane[3]


@wp.func(inline=True)
def plane_density(view: View, edge: real, point: vec3) -> Density:
    """Density of a half-space at a point in the samples' frame; the direction is in the field's."""
    found = Density()
    found.value = occupancy(plane_distance(view, point), edge)
    found.direction = view.normal
    return found


@wp.func(inline=True)
def seen_density(
    solids: Solids, fields: Fields, world: int, field: Field, view: View, point: vec3
) -> Density:
    """Density of a field at a point in the samples' frame; the direction is in the field's."""
    found = Density()
    if view.is_plane:
        if plane_distance(view, point) <= view.reach:
            found = plane_density(view, field.part.edge, point)
    else:
        found = density(solids, fields, world, field, view.rotation * point + view.origin)
    return found


@wp.func(inline=True)
def seen_clearance(solids: Solids, fields: Fields, world: int, field: Field, view: View, point: vec3) -> real:
    """Lower bound on the distance [m] from a point in the samples' frame to where the density is positive."""
    clearance = ZERO
    if view.is_plane:
        clearance = plane_distance(view, point) - view.reach
    else:
        clearance = field_clearance(solids, fields, world, field, view.rotation * point + view.origin)
    return clearance


@wp.func
def sample_sums(sample: WeightedSample, found: Density) -> Sums:
    """What one sample adds; its moment is in the samples' frame, its direction in the field's."""
    sums = Sums()
    sums.share = sample.weight * found.value
    sums.moment = sums.share * sample.point
    sums.direction = sums.share * found.direction
    return sums


@wp.func
def added(a: Sums, b: Sums) -> Sums:
    """Sum of sums."""
    sums = Sums()
    sums.share = a.share + b.share
    sums.moment = a.moment + b.moment
    sums.direction = a.direction + b.direction
    return sums


@wp.func
def sums_in_world(sums: Sums, sampled: Frame, queried: Frame, mass: real, sign: real) -> Sums:
    """Sums over one side of a contact with the mass that its weights are shares of, in world axes.

    Args:
        sums: Of all samples.
        sampled: Frame of the sampled body.
        queried: Frame of the body with the field.
        mass: Of the sampled body, times what makes the density dimensionless [kg].
        sign: 1 where the sampled body is the first of the contact, else −1.
    """
    found = Sums()
    found.share = mass * sums.share
    found.moment = mass * (sampled.rotation * sums.moment + sums.share * sampled.origin)
    found.direction = (sign * mass) * (queried.rotation * sums.direction)
    return found


@wp.func
def patch_of(sums: Sums, mass: real) -> Patch:
    """ψ, χ = ψχ/ψ and n from the sums of both sides; `mass` is that of the sampled bodies [kg]."""
    patch = Patch()
    if sums.share > _NEGLIGIBLE * mass:
        patch.overlap = sums.share
        patch.centroid = sums.moment / sums.share
        length = wp.length(sums.direction)
        if length > ZERO:
            patch.normal = sums.direction / length
    return patch


@wp.func
def cap_patch(ball: Leaf, plane: Leaf, sampled: Frame, queried: Frame, mass: real) -> Patch:
    """A homogeneous ball with a half-space, in closed form: the spherical cap below the plane.

    With depth h of the lowest point, V = π h² (3 r − h)/3, and the cap's centroid lies
    3 (2 r − h)²/(4 (3 r − h)) from the ball's centre. Exact and smooth where sampling would make a ball
    rattle as it rolls.

    Args:
        ball: The ball, about the origin of its body's frame.
        plane: The half-space.
        sampled: Frame of the ball's body.
        queried: Of the other.
        mass: Of the ball [kg].
    """
    patch = Patch()
    radius = ball.sizes[0]
    normal = queried.rotation * plane.sizes
    height = wp.dot(normal, sampled.origin - queried.origin) - plane.length
    depth = wp.clamp(radius - height, ZERO, TWO * radius)
    share = depth * depth * (real(3.0) * radius - depth) / (real(4.0) * radius * radius * radius)
    if share > _NEGLIGIBLE:
        across = TWO * radius - depth
        offset = real(3.0) * across * across / (real(4.0) * (real(3.0) * radius - depth))
        patch.overlap = mass * share
        patch.centroid = sampled.origin - offset * normal
        patch.normal = normal
    return patch
