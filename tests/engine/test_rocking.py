"""A block that rocks: what a landing leaves of its spin, and where contact is sharp."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dano

FLOOR = dano.Body("floor", dano.HalfSpace(), fixed=True)
TABLE = dano.Body("floor", dano.Box((0.5, 0.5, 0.05)), fixed=True)


def kept(ratio, width, timestep, phases, made=lambda box: box, floor=FLOOR):
    """By what a landing multiplies the spin, from the heights of two swings, begun at several moments."""
    b, h, balance = width / 2, ratio * width / 2, np.arctan2(1, ratio)
    mass = 8000 * b * b * h
    inertia = np.diag([b * b + h * h, b * b + h * h, 2 * b * b]) * mass / 3
    block = dano.Body("block", made(dano.Box((b, b, h))), mass=mass, inertia=inertia, com=(0, 0, 0))
    contact = dano.Contact("block", "floor", dano.ContactParams(sliding_friction=1.0))
    scene = dano.Scene.create([block, floor], [contact], timestep=timestep)
    below = dict(position=(0, 0, 0 if floor is FLOOR else -0.05))
    seconds = 4.0 * np.sqrt(4 / 3 * np.hypot(b, h) / 9.81)

    def angles(tilt):
        q = jnp.stack([jnp.cos(tilt / 2), jnp.sin(tilt / 2), 0.0 * tilt, 0.0 * tilt])
        height = np.hypot(b, h) * jnp.cos(balance - tilt)
        start = dict(position=jnp.stack([0.0 * tilt, 0.0 * tilt, height]), orientation=q)
        states = dano.simulate(
            scene, scene.initial_state(block=start, floor=below), int(seconds / timestep)
        ).states
        return 2 * jnp.arctan2(states.orientation[:, 0, 1], states.orientation[:, 0, 0])

    def energy(angle):
        return np.cos(balance - np.abs(angle)) - np.cos(balance)

    found = []
    tilts = 0.5 * balance * (1 + np.linspace(0, 20 * timestep, phases))
    for tilt, angle in zip(tilts, np.asarray(jax.vmap(angles)(jnp.asarray(tilts))), strict=True):
        lands = np.flatnonzero(np.diff(np.sign(angle)) != 0)
        swing = angle[lands[0] + 1 : lands[1] if len(lands) > 1 else len(angle)]
        found.append(np.sqrt(energy(swing).max() / energy(tilt)))
    return np.array(found)


@pytest.mark.parametrize("ratio, width", [(2, 0.1), (4, 0.1), (2, 0.5)])
def test_a_landing_leaves_what_housner_says(ratio, width):
    """1 − 3/2 sin²α of the spin (Housner 1963), wherever in a step the other edge lands."""
    right = 1 - 1.5 * np.sin(np.arctan2(1, ratio)) ** 2
    found = kept(ratio, width, 1e-3, 8)
    np.testing.assert_allclose(found, right, rtol=0.03)
    assert np.ptp(found) < 0.03 * right


def test_objects_of_flat_faces_rock_as_boxes_do():
    """Their samples lie on the planes of their faces."""

    def made(box):
        return dano.NeuralObject.from_field(box, mass=1.0, n_samples=1000, resolution=48, mass_model="solid")

    np.testing.assert_allclose(kept(2, 0.1, 1e-3, 4, made), 0.7, rtol=0.04)


@pytest.mark.parametrize("ratio", [1, 2, 4])
def test_a_block_rocks_on_a_table_as_on_a_plane(ratio):
    """Its edges are as sharp there, and those of the table press, too."""
    right = abs(1 - 1.5 * np.sin(np.arctan2(1, ratio)) ** 2)
    np.testing.assert_allclose(kept(ratio, 0.1, 3e-4, 4, floor=TABLE), right, rtol=0.03)


def test_the_factor_converges_with_the_step():
    """A cube keeps a quarter; errors shrink with the step."""
    errors = [np.abs(kept(1, 0.1, h, 6) - 0.25).max() for h in (5e-3, 1e-3, 3e-4)]
    assert errors[0] > errors[1] > errors[2]
    assert errors[2] < 0.04 * 0.25


@pytest.mark.filterwarnings("ignore::dano.scene.SceneWarning")
def test_where_contact_is_sharp():
    """Of boxes, cylinders and half-spaces; not where a body is round, or a spring has impacts."""
    cylinder, ball = dano.Cylinder(0.05, 0.05), dano.Sphere(0.05)

    def params(shape, law=None, timestep=1e-3, **given):
        contact = dano.Contact("a", "floor", dano.ContactParams(**given), law)
        body = dano.Body("a", shape, mass=1.0)
        return dano.Scene.create([body, FLOOR], [contact], timestep=timestep).contacts[0].params

    box, rounded = dano.Box((0.05,) * 3), dano.Box((0.05,) * 3, rounding=0.005)
    for shape in (box, cylinder):
        sharp = params(shape)
        # A millionth of the size, at any step.
        assert float(sharp.impact_depth) == pytest.approx(1e-7, rel=0.01)
        assert float(sharp.stiffness) > 20 * float(params(ball).stiffness)
    assert float(params(box, timestep=1e-2).impact_depth) == float(params(box).impact_depth)
    for soft in (params(rounded), params(ball), params(box, dano.DistributedLaw(compliant=True))):
        assert float(soft.impact_depth) == pytest.approx(5e-4, rel=0.01)
        assert float(soft.stiffness) < float(params(box).stiffness) / 20
    given = params(box, stiffness=1e6, impact_depth=1e-3)
    assert (float(given.stiffness), float(given.impact_depth)) == pytest.approx((1e6, 1e-3))


def test_pairs_that_no_contact_names_are_as_those_that_are_named():
    """Boxes are sharp on the floor and to each other, and soft to a ball; what is set counts as it is."""
    bodies = [dano.Body(name, dano.Box((0.05,) * 3), mass=1.0) for name in "ab"]
    bodies += [dano.Body("c", dano.Sphere(0.05), mass=1.0), FLOOR]
    scene = dano.Scene.create(bodies, others=dano.ContactParams(), timestep=1e-3)
    assert scene.others is not None
    found = scene.others.pair_params
    pairs = [dano.Contact(scene.names[i], scene.names[j]) for i, j in scene.others.pairs]
    named = dano.Scene.create(bodies, pairs, timestep=1e-3)
    for name in ("stiffness", "impact_depth"):
        expected = [float(getattr(contact.params, name)) for contact in named.contacts]
        np.testing.assert_allclose(np.asarray(getattr(found, name)), expected, rtol=1e-6)
    changed = scene.replace_material("a", impact_depth=1e-7).others
    assert changed is not None
    at = scene.others.pairs.index((0, 3))
    assert float(changed.pair_params.impact_depth[at]) == pytest.approx(1e-7)
