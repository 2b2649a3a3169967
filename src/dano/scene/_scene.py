"""Scenes: bodies, the contacts between them, a timestep and gravity.

How long impacts last that are left to the spring.
What gravity does to each body: all of it, or what a body's `gravcomp` leaves.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import TypeVar

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float, Int

from dano import checks, maths, notebook
from dano.contact import checked_parameter, ContactParams, Distance, distance, DistributedLaw
from dano.names import did_you_mean
from dano.objects import checked_inertia
from dano.scene._bodies import Body
from dano.scene._contacts import Contact, prepared
from dano.scene._doubts import doubts_of_scene, doubts_of_state, say_doubts, SceneDoubt
from dano.scene._frames import Chains, chains_of, filled, Frames, frames_of, joint_values
from dano.scene._joints import check_loops, Joint, layout_of, Loop, Loops, loops_of, Motor, StateLayout
from dano.scene._making import (
    ByName,
    check_contacts,
    check_materials,
    check_names,
    control_arrays,
    joint_arrays,
    merged,
    room_for,
    sampled_alike,
    started,
    state_arrays,
    twins_of,
    warn_of_limits,
    warn_of_long_steps,
)
from dano.scene._others import OfEdges, Others, others_of, unnamed_contacts
from dano.scene._states import check_precision, Control, JOINT_QUANTITIES, State, STATE_SIZES


def impact_duration(bodies: Sequence[Body], contact: Contact, speed: float) -> float:
    """See `Scene.impact_duration`.

    Raises:
        ValueError: If impacts of the contact are not left to the spring, no body moves, or the speed is not
            positive.
    """
    pair = [next(body for body in bodies if body.name == name) for name in (contact.a, contact.b)]
    if not (isinstance(contact.law, DistributedLaw) and contact.law.compliant):
        raise ValueError(
            f"impacts of {contact.a!r} and {contact.b!r} end within a step: only those of"
            " law=dano.DistributedLaw(compliant=True) take time"
        )
    if maths.is_traced(speed) or not (math.isfinite(speed) and speed > 0):
        raise ValueError(f"speed must be a positive number [m/s], got {speed}")
    moving = [body for body in pair if not body.fixed]
    if not moving:
        raise ValueError(f"one of {contact.a!r} and {contact.b!r} must move, both are fixed")
    mass = 1 / sum(1 / float(body.mass * body.mass_scale) for body in moving)
    body = min((body for body in pair if body.surface is not None), key=lambda body: body.size)
    depths = body.size * np.geomspace(1e-6, 0.5, 40)
    forces = float(contact.params.stiffness) * np.array([body.typical_support(d) for d in depths])
    deepest = int(np.argmax(forces * depths >= mass * speed**2))
    return math.pi * math.sqrt(mass * depths[deepest] / max(forces[deepest], 1e-300))


Parts = TypeVar("Parts", tuple[Joint, ...], tuple[Loop, ...])


class Scene(eqx.Module):
    """What stays constant over a rollout. Every array in it is a leaf that can be differentiated."""

    bodies: tuple[Body, ...]  # The bodies, in the order that states index
    contacts: tuple[Contact, ...]  # Which pairs may touch
    timestep: Float[Array, ""]  # h [s]
    gravity: Float[Array, "3"]  # [m/s², W]
    # For each body the first that is made of the same object: its samples and its solid stand once in memory
    # (static).
    twins: tuple[int, ...] = eqx.field(static=True, default=())
    joints: tuple[Joint, ...] = ()  # What hangs on what
    others: Others | None = None  # Pairs of bodies that no contact names; None if they do not touch
    # Chunks of point contacts that a step has room for (static); None leaves it to the engine.
    room: int | None = eqx.field(static=True, default=None)
    loops: tuple[Loop, ...] = ()  # What closes chains of joints
    # For each body the first with the same samples of its surface, which stand once in memory, as shapes with
    # the same numbers have them (static).
    sampled: tuple[int, ...] = eqx.field(static=True, default=())

    @classmethod
    def create(
        cls,
        bodies: Sequence[Body],
        contacts: Sequence[Contact] | None = None,
        *,
        joints: Sequence[Joint] = (),
        loops: Sequence[Loop] = (),
        others: ContactParams | None = None,
        apart: Sequence[tuple[str, str]] = (),
        timestep: maths.Numbers = 0.01,
        gravity: maths.Numbers = (0.0, 0.0, -9.81),
    ) -> "Scene":
        """Check the parts against each other and resolve defaults that depend on both bodies of a contact.

        Args:
            bodies: The bodies, in the order that states index.
            contacts: Which pairs may touch, and how; `()` means that nothing does. Default: all pairs that
                may touch, do, each by a `Contact` with its defaults; of more than 200 pairs, or where bodies
                have a `Body.material`, by `others`. What a joint or a loop joins does not touch.
            joints: What hangs on what, in the order of the coordinates q.
            loops: What closes chains of joints.
            others: Lets all other pairs touch, too, by `DistributedLaw`: parameters of bodies that have no
                `Body.material` of their own. Those of a pair follow from its two bodies, see
                `Others.pair_params`. What a joint or a loop joins does not touch.
            apart: Names of pairs that do not touch although `others` is given, or no `contacts` are.
            timestep: h [s].
            gravity: [m/s², W].

        Raises:
            ValueError: If bodies are missing or share a name, a contact names an unknown body, two fixed ones
                or a pair twice, a pair cannot overlap, joints make no trees, a loop closes no chain, no
                pair uses a material, or a number is out of range.
        """
        bodies = checks.checked_items("bodies", bodies, Body)
        joints = checks.checked_items("joints", joints, Joint)
        loops = checks.checked_items("loops", loops, Loop)
        checks.checked_optional("others", others, ContactParams)
        check_names(bodies)
        if contacts is None and others is None:
            contacts = unnamed_contacts(bodies, (*joints, *loops), apart)
            others, apart = (ContactParams(), apart) if contacts is None else (None, ())
        contacts = checks.checked_items("contacts", () if contacts is None else contacts, Contact)
        timestep = maths.checked_array("timestep", timestep, (), above=0.0)
        check_contacts(bodies, joints, contacts)
        children = layout_of(bodies, joints).children
        check_loops([body.name for body in bodies], children, loops)
        gravity = maths.checked_array("gravity", gravity, (3,))
        # Before the bodies are prepared, which makes new ones.
        twins = twins_of(bodies)
        bodies, contacts = prepared(bodies, contacts, timestep, gravity)
        rest = None
        if others is not None:
            joined = (*joints, *loops)
            bodies, rest = others_of(bodies, contacts, joined, apart, others, timestep, gravity)
        check_materials(bodies, others, apart)
        if contacts or rest is not None:
            warn_of_long_steps(bodies, timestep, gravity)
        room = room_for(bodies, timestep, gravity)
        sampled = sampled_alike(bodies, twins)
        scene = cls(bodies, contacts, timestep, gravity, twins, joints, rest, room, loops, sampled)
        say_doubts(doubts_of_scene(bodies, joints, contacts, gravity, scene._meeting), stacklevel=2)
        return scene

    def __str__(self) -> str:
        """What notebooks show, as text."""
        traced = any(maths.is_traced(body.mass, body.mass_scale) for body in self.bodies) or maths.is_traced(
            self.timestep
        )
        if traced:
            return repr(self)
        # Within a function that is being traced, too, the numbers of a scene that is not are known.
        with jax.ensure_compile_time_eval():
            return notebook.plain(*self._summary(drawn=False))

    def _repr_html_(self) -> str:
        """What notebooks show: bodies with mass and size, and what may touch."""
        title, rows, head = self._summary(drawn=True)
        return notebook.card(title, rows, head=head)

    def _summary(self, *, drawn: bool) -> tuple[str, list[tuple[str, ...]], tuple[str, ...]]:
        """Title, rows and head of the table of a scene."""
        rows: list[tuple[str, ...]] = []
        for body in self.bodies[:12]:
            drawing = ""
            if drawn and body.surface is not None:
                points = np.asarray(body.scale)[:, None] * np.asarray(body.surface.points[:3])
                drawing = notebook.cloud(points.T, np.asarray(body.surface.vectors).T, 56, 150)
            mass = "fixed" if body.fixed else f"{float(body.mass) * float(body.mass_scale):.4g} kg"
            rows.append((drawing, body.name, mass, f"{body.size:.4g} m"))
        named = ", ".join(f"{a} – {b}" for a, b in self.pairs[:12])
        title = (
            f"Scene: {len(self.bodies)} bodies, {len(self.pairs)} pair{'s' * (len(self.pairs) != 1)} that may"
            f" touch{f' ({named})' if named else ''}; step {float(self.timestep):.4g} s"
        )
        if self.timestep.dtype == np.float32:
            title += "; in float32: jax_enable_x64 is off"
        return title, rows, ("", "body", "mass", "size")

    @property
    def layout(self) -> StateLayout:
        """Which numbers say how the bodies stand and move."""
        return layout_of(self.bodies, self.joints)

    @property
    def chains(self) -> Chains:
        """The trees that bodies and joints make, as arrays; of NumPy unless something in them is traced."""
        joints, com = self._with_centres(self.joints)
        return chains_of(self.layout, joints, com)

    @property
    def closing(self) -> Loops | None:
        """The loops as arrays, as `chains`; None if there are none."""
        loops, com = self._with_centres(self.loops)
        return loops_of(self.names, loops, com)

    def _with_centres(self, parts: Parts) -> tuple[Parts, Float[maths.AnyArray, "n 3"]]:
        """Joints or loops, and the centres of mass of all bodies [m, F]."""
        places = [(body.com, body.com_offset) for body in self.bodies]
        if not maths.is_traced(parts, places):
            parts, places = maths.on_host((parts, places))
        rows = [com + offset for com, offset in places]
        return parts, maths.library(*rows).stack(rows).astype(self.timestep.dtype)

    @property
    def driven(self) -> bool:
        """Whether a motor drives a joint."""
        return any(joint.motor is not None for joint in self.joints)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the bodies, in order."""
        return tuple(body.name for body in self.bodies)

    @property
    def point_pairs(self) -> Int[np.ndarray, "k 2"]:
        """Indices of the bodies of each contact with a point law, then of the other pairs that may touch."""
        place = {name: i for i, name in enumerate(self.names)}
        named = [(place[c.a], place[c.b]) for c in self.contacts if c.law.presses]
        rest = [] if self.others is None else self.others.pairs.array
        return np.concatenate([np.array(named, int).reshape(-1, 2), np.reshape(rest, (-1, 2))]).astype(int)

    @property
    def pairs(self) -> tuple[tuple[str, str], ...]:
        """Names of the bodies of all pairs that may touch: those of `contacts`, then those of `others`."""
        rest = () if self.others is None else self.others.pairs
        named = tuple((contact.a, contact.b) for contact in self.contacts)
        names = self.names
        return (*named, *((names[i], names[j]) for i, j in rest))

    @property
    def _meeting(self) -> set[str]:
        """Names of the bodies that may touch something."""
        named = {name for contact in self.contacts for name in (contact.a, contact.b)}
        if self.others is None:
            return named
        names = self.names
        return named | {names[i] for i in np.unique(self.others.pairs.array).tolist()}

    def index(self, name: str) -> int:
        """Index of a body.

        Raises:
            ValueError: If there is no such body.
        """
        names = self.names
        if name not in names:
            raise ValueError(f"body must be one of {list(names)}, got {name!r}{did_you_mean(name, names)}")
        return names.index(name)

    def body(self, name: str) -> Body:
        """A body by name.

        Raises:
            ValueError: If there is no such body.
        """
        return self.bodies[self.index(name)]

    def joint(self, name: str) -> Joint:
        """The joint on which a body hangs, by the name of the body.

        Raises:
            ValueError: If there is no such body, or it hangs on no joint.
        """
        self.index(name)
        children = [joint.child for joint in self.joints]
        if name not in children:
            raise ValueError(f"joint must be that of one of {children}, got {name!r}, which hangs on none")
        return self.joints[children.index(name)]

    def contact_index(self, a: str, b: str) -> int:
        """Index of the contact between two bodies, in either order.

        Raises:
            ValueError: If there is none.
        """
        pairs = [(c.a, c.b) for c in self.contacts]
        for i, pair in enumerate(pairs):
            if pair in ((a, b), (b, a)):
                return i
        raise ValueError(f"contact must be one of {pairs}, got {(a, b)}")

    def contact(self, a: str, b: str) -> ContactParams:
        """Parameters of the contact between two bodies, in either order.

        Raises:
            ValueError: If there is none.
        """
        return self.contacts[self.contact_index(a, b)].params

    def replace_contact(self, a: str, b: str, **changes: maths.Numbers) -> "Scene":
        """The scene with some parameters of one contact changed, e.g. ``sliding_friction=0.3``.

        Raises:
            ValueError: If there is no such contact or parameter, or a value is out of range.
        """
        i = self.contact_index(a, b)
        names = list(changes)
        for name in names:
            if name not in self.contacts[i].law.reads:
                valid = list(self.contacts[i].law.reads)
                raise ValueError(
                    f"contact parameter must be one of {valid}, got {name!r}{did_you_mean(name, valid)}"
                )
        values = [checked_parameter(name, changes[name]).astype(self.timestep.dtype) for name in names]
        return eqx.tree_at(
            lambda s: [getattr(s.contacts[i].params, name) for name in names],
            self,
            values,
            is_leaf=lambda x: x is None,
        )

    def replace_material(self, name: str, **changes: maths.Numbers) -> "Scene":
        """The scene with some parameters of a body's material changed, e.g. ``sliding_friction=0.3``.

        It concerns the pairs of `others`.

        Raises:
            ValueError: If the scene has no `others`, there is no such body or parameter, or a value is out of
                range.
        """
        i = self.index(name)
        if self.others is None:
            raise ValueError(
                f"scene must be created with others=… to have materials, got a change of {name!r}"
            )
        valid = list(self.others.law.reads)
        for key in changes:
            if key not in valid:
                raise ValueError(
                    f"material must be changed in {valid}, got {key!r}{did_you_mean(key, valid)}"
                )
        params = self.others.params
        values = [getattr(params, k).at[i].set(checked_parameter(k, value)) for k, value in changes.items()]
        scene = eqx.tree_at(lambda s: [getattr(s.others.params, key) for key in changes], self, values)
        edges = {key: value for key, value in zip(changes, values, strict=True) if key in OfEdges._fields}
        if "stiffness" in edges:
            edges["stiffness_on_fixed"] = edges["stiffness"]
        of_edges = self.others.of_edges
        for key, value in edges.items():
            of_edges = of_edges._replace(**{key: getattr(of_edges, key).at[i].set(value[i])})
        return eqx.tree_at(lambda s: s.others.of_edges, scene, of_edges)

    def replace_body(self, name: str, **changes: maths.Numbers) -> "Scene":
        """The scene with some of a body's `mass, inertia, com, mass_scale, com_offset` changed.

        Raises:
            ValueError: If there is no such body or property, or a shape differs.
        """
        i = self.index(name)
        valid = ["mass", "inertia", "com", "mass_scale", "com_offset"]
        for key in changes:
            if key not in valid:
                raise ValueError(f"body property must be one of {valid}, got {key!r}")
        keys = list(changes)
        values = [
            _as_leaf(
                maths.checked_array(key, changes[key], getattr(self.bodies[i], key).shape),
                getattr(self.bodies[i], key),
            )
            for key in keys
        ]
        for key, value in zip(keys, values, strict=True):
            if key in ("mass", "mass_scale") and not maths.is_traced(value) and not float(value) > 0:
                raise ValueError(f"{key} must be > 0, got {float(value)}")
            if key == "inertia":
                checked_inertia(key, value)
        return eqx.tree_at(lambda s: [getattr(s.bodies[i], key) for key in keys], self, values)

    def replace_joint(self, child: str, **changes: maths.Numbers | Motor | None) -> "Scene":
        """The scene with some of a joint's numbers changed: all but its bodies, its kind and what it mimics.

        Args:
            child: Name of the body that hangs on the joint.
            **changes: See `Joint`.

        Raises:
            ValueError: If no joint carries the body, a property is unknown, or a value is out of range.
        """
        children = [joint.child for joint in self.joints]
        if child not in children:
            raise ValueError(f"joint must carry one of {children}, got {child!r}")
        fixed = ("parent", "child", "kind", "mimics")
        valid = [name for name in Joint.__dataclass_fields__ if name not in fixed]
        for key in changes:
            if key not in valid:
                raise ValueError(f"joint property must be one of {valid}, got {key!r}")
        i = children.index(child)
        joints = (*self.joints[:i], dataclasses.replace(self.joints[i], **changes), *self.joints[i + 1 :])
        return dataclasses.replace(self, joints=joints)

    def initial_state(self, states: ByName | None = None, /, **bodies: Mapping[str, maths.Numbers]) -> State:
        """A state: bodies by keyword, each a dict of `position, orientation, velocity, omega`.

        `position` is that of the centre of mass. In its place `origin` is that of the body's field frame, the
        origin of the file of a mesh or a field. `omega` is in the axes of the body; in its place
        `spin_world` is in those of the world. Bodies on joints have `q` and `v` instead: angle [rad] and
        rate, or length [m] and rate; three numbers of a ball or a planar joint, see `Joint`. What is not
        given is as `Body(…, position=…)` says; else bodies rest at the origin, or at q = 0. Orientations are
        normalised.

        Args:
            states: The same as a dict, for names that are no identifiers: `{"left arm": dict(q=0.1)}`.
            bodies: By keyword.

        Raises:
            ValueError: If a body or quantity is unknown, a body is given twice, a shape is wrong, a number is
                not finite, or a quaternion is zero.

        Warns:
            RuntimeWarning: If a joint starts beyond its limits.
        """
        return self.state_of(merged("states", states, bodies))

    def state_of(self, bodies: ByName, joint_names: Mapping[str, str] | None = None) -> State:
        """`initial_state` of bodies in a mapping, with names of joints for messages, by their bodies'."""
        for name in set(bodies) - set(self.names):
            self.index(name)
        dtype = self.timestep.dtype
        given = started(self.bodies, bodies)
        state = State(**state_arrays(self.bodies, self.layout, given, dtype), names=self.names)
        if self.joints:
            of_joints = joint_arrays(self.joints, given, JOINT_QUANTITIES, dtype)
            state = self.filled(dataclasses.replace(state, **of_joints))
        self.check_state(state)
        warn_of_limits(self.layout, self.joints, state.q, self.timestep, joint_names or {})
        say_doubts(self._doubts_of(state, bodies), stacklevel=3)
        return state

    def doubts(self, state: State, given: ByName | None = None) -> list[SceneDoubt]:
        """What is odd about the scene and a state: units, frames, slips; none where numbers are traced.

        Args:
            state: The state.
            given: What it was made from, see `initial_state`: only bodies that were placed are judged by
                where they are. Default: all of them.
        """
        return [
            *doubts_of_scene(self.bodies, self.joints, self.contacts, self.gravity, self._meeting),
            *self._doubts_of(state, given),
        ]

    def _doubts_of(self, state: State, given: ByName | None) -> list[SceneDoubt]:
        """Of a state alone; see `doubts`."""
        if maths.is_traced(state, self.timestep):
            return []
        placed = set(self.names)
        if given is not None:
            placed = {name for name, numbers in given.items() if {"position", "origin", "q"} & set(numbers)}
        moved = {i for i, body in enumerate(self.bodies) if not body.fixed and body.name in placed}
        pairs = self.point_pairs
        pairs = pairs[np.isin(pairs, list(moved)).any(axis=1)]
        return doubts_of_state(self.bodies, pairs, self.layout, state, float(self.timestep))

    def filled(self, state: State) -> State:
        """The state with the rows of bodies on joints as `q` and `v` say; for one state.

        What starts a simulation does this itself: it is for those who change `q` or `v` and look at poses.

        Raises:
            ValueError: If the state does not fit the scene.
        """
        self.check_state(state)
        return maths.by_numpy(filled)(self.chains, state, self.timestep) if self.joints else state

    def distance(self, state: State, a: str, b: str) -> Distance:
        """Signed distance of two bodies [m], nearest points and normal, see `dano.distance`; for one state.

        Raises:
            ValueError: If there is no such body, one has no surface, or the state does not fit the scene.
        """
        self.check_state(state)
        places = self.frames(state) if self.joints else state
        solids, poses = [], []
        for i in (self.index(a), self.index(b)):
            body, turn = self.bodies[i], places.orientation[i]
            arm = maths.quat_rotate(turn, body.centre_of_mass.astype(turn.dtype))
            geometry = body.shape if body.object is None else body.object
            assert geometry is not None
            solids.append(geometry)
            poses.append(maths.Pose(places.position[i] - arm, turn))
        return distance(*solids, pose_a=poses[0], pose_b=poses[1])

    def impact_duration(self, a: str, b: str, speed: float) -> float:
        """Time [s] that an impact of two bodies takes, where it is left to the spring; to some tens of %.

        π √(m d/F) until it is turned round, with the mass m of both and the depth d at which the work F d/2
        of the springs is m v²/2, for a typical orientation. Twenty steps of it or more resolve the impact.
        It is a check before a simulation and cannot be differentiated.

        Args:
            a: One body.
            b: The other one.
            speed: With which they approach [m/s].

        Raises:
            ValueError: If there is no such contact, its impacts end within a step (a law without
                `compliant=True`), no body of it moves, or the speed is not positive.
        """
        return impact_duration(self.bodies, self.contacts[self.contact_index(a, b)], speed)

    def joint_values(self, state: State) -> tuple[Float[Array, " k"], Float[Array, " k"]]:
        """Coordinates q and velocities v of the joints that poses and velocities of the bodies have.

        Angles are between −π and π; what the joints do not allow is left out.

        Raises:
            ValueError: If the state is not a `State`, or not one of this scene's bodies.
        """
        self._check_bodies(state)
        return maths.by_numpy(joint_values)(self.chains, state)

    def frames(self, state: State) -> Frames:
        """Pose, twist and Jacobian of every body, for one state.

        Of bodies on joints only `q` and `v` count. Velocities are those of this moment, where those of a
        state are those of the step that ended there.

        Raises:
            ValueError: If the state does not fit the scene.
        """
        self.check_state(state)
        return Frames(*maths.by_numpy(frames_of)(self.chains, state))

    def check_weighed(self) -> None:
        """Check that all masses are known, as steps and forces need it.

        Raises:
            ValueError: If there are bodies without one.
        """
        names = [body.name for body in self.bodies if not (body.fixed or body.weighed)]
        if names:
            some = ", ".join(map(repr, names[:4])) + (" …" if len(names) > 4 else "")
            raise ValueError(
                f"scene must have bodies of known mass, got none for {some}: it serves kinematics alone"
            )

    def check_state(self, state: State) -> None:
        """Check a concrete state against the scene; traced values pass.

        Raises:
            ValueError: If it is not a state, a shape or dtype is wrong, a number is not finite, or a
                quaternion is not of unit length.
        """
        self._check_bodies(state)
        for key in JOINT_QUANTITIES:
            value = getattr(state, key)
            if not self.joints and value is None:
                continue
            expected = (*state.position.shape[:-2], self.layout.n_joints)
            if value is None or value.shape != expected:
                got = None if value is None else value.shape
                raise ValueError(f"state.{key} must have shape {expected}, got {got}")
            if not maths.is_traced(value) and not np.all(np.isfinite(np.asarray(value))):
                raise ValueError(
                    f"state.{key} must be finite, got {checks.shown(np.asarray(value).tolist())}"
                )
        if not maths.is_traced(state.orientation):
            norms = np.linalg.norm(np.asarray(state.orientation), axis=-1)
            if np.any(np.abs(norms - 1) > 1e-3):
                raise ValueError(f"state.orientation must hold unit quaternions, got norms {norms.tolist()}")

    def _check_bodies(self, state: State) -> None:
        """Check what a state says of bodies."""
        checks.checked_kind("state", state, State)
        if state.names is not None and state.names != self.names:
            raise ValueError(
                f"state must be of a scene with the bodies {list(self.names)} in this order, got one of"
                f" {list(state.names)}"
            )
        check_precision(state, self.timestep.dtype)
        for key, size in STATE_SIZES.items():
            value = getattr(state, key)
            if value.shape[-2:] != (len(self.bodies), size):
                raise ValueError(
                    f"state.{key} must have shape (…, {len(self.bodies)}, {size}), got {value.shape}"
                )
            if not maths.is_traced(value) and not np.all(np.isfinite(np.asarray(value))):
                raise ValueError(
                    f"state.{key} must be finite, got {checks.shown(np.asarray(value).tolist())}"
                )

    def control(self, controls: ByName | None = None, /, **bodies: Mapping[str, maths.Numbers]) -> Control:
        """Control for one step: bodies by keyword, each a dict of `force` [N, W] and `torque` [N m, W].

        Bodies on joints may have `effort`, the torque [N m] or force [N] of the joint, and where a motor
        drives it `command`. Those of a ball or a planar joint are three numbers.

        Args:
            controls: The same as a dict, for names that are no identifiers.
            bodies: By keyword.

        Raises:
            ValueError: If a body or quantity is unknown, a body is given twice, or a shape is wrong.
        """
        given, dtype = merged("controls", controls, bodies), self.timestep.dtype
        for name in given:
            if self.body(name).fixed and given[name]:
                raise ValueError(f"control must be of a body that moves, got {name!r}, which is fixed")
        of_joints: dict[str, Array] = {}
        if self.joints:
            keys = ("effort", "command") if self.driven else ("effort",)
            of_joints = joint_arrays(self.joints, given, keys, dtype)
        return Control(**control_arrays(self.bodies, self.joints, self.layout, given, dtype), **of_joints)


def _as_leaf(value: Array, like: Array) -> Array:
    return value.astype(like.dtype)


def pulls(scene: Scene) -> Float[Array, "n 3"]:
    """Gravitational acceleration of each body [m/s²]."""
    return _pulls([body.gravcomp for body in scene.bodies], scene.gravity)


@maths.by_numpy
def _pulls(compensated: Sequence[maths.Q | None], gravity: Float[maths.Q, "3"]) -> Float[maths.Q, "n 3"]:
    xp = maths.library(gravity, *(share for share in compensated if share is not None))
    left = [xp.asarray(1.0 if x is None else 1 - x, gravity.dtype) for x in compensated]
    return xp.stack(left)[:, None] * gravity[None]


def lifted(scene: Scene, control: Control | None, *leading: int) -> Control | None:
    """A control with the forces that compensate weights; the same where none is compensated.

    Args:
        scene: The scene.
        control: None for none.
        *leading: Axes before those of the bodies.
    """
    if all(body.gravcomp is None for body in scene.bodies):
        return control
    masses = [(body.mass, body.mass_scale) for body in scene.bodies]
    given = None if control is None else control.force
    force, still = _lifting(masses, pulls(scene), scene.gravity, given, leading)
    if control is None:
        control = Control(still, still)
    return dataclasses.replace(control, force=force)


@maths.by_numpy
def _lifting(
    masses: Sequence[tuple[maths.Q, maths.Q]],
    pull: Float[maths.Q, "n 3"],
    gravity: Float[maths.Q, "3"],
    force: Float[maths.Q, "*t n 3"] | None,
    leading: tuple[int, ...],
) -> tuple[Float[maths.Q, "*t n 3"], Float[maths.Q, "*t n 3"]]:
    """Forces with those that compensate weights, and none."""
    xp = maths.library(
        pull, gravity, *(x for each in masses for x in each), *([] if force is None else [force])
    )
    mass = xp.stack([mass * scale for mass, scale in masses]).astype(pull.dtype)
    lift = mass[:, None] * (pull - gravity[None])
    still = xp.zeros((*leading, *lift.shape) if force is None else force.shape, pull.dtype)
    return (still if force is None else force) + xp.broadcast_to(lift, still.shape), still
