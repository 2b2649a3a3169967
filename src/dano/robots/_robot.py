"""Robots: bodies and joints for a scene, and where every link of the file is on them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dano.checks import checked_items, checked_kind
from dano.contact import ContactParams
from dano.maths import checked_array, checked_floating, Numbers, quat_multiply, quat_rotate
from dano.names import did_you_mean
from dano.robots._description import Description
from dano.scene import Body, Contact, Joint, Loop, Scene, State


@dataclass(frozen=True)
class Robot:
    """A robot as parts of a scene. Links that are welded together are one body, named after the first.

    Attributes:
        name: Of the robot.
        bodies: One for each group of links that moves as one; the base, too, if it floats or has a shape.
        joints: Between them, in the order of the file.
        joint_names: Of those with coordinates of their own: the file's names, by the body that hangs on each.
        frames: Of each link of the file: its body (None for the world), position [m] and orientation wxyz in
            that body's field frame.
        base: Position [m, W] and orientation of the base, or None if it floats.
        efforts: Largest torque or force of each joint with coordinates [N m or N], by its name in the file.
        touching: Bodies that have a shape of their own to touch with.
        description: What the file says.
        loops: What closes chains of its joints.
    """

    name: str
    bodies: tuple[Body, ...]
    joints: tuple[Joint, ...]
    joint_names: dict[str, str]
    frames: dict[str, tuple[str | None, np.ndarray, np.ndarray]]
    base: tuple[np.ndarray, np.ndarray] | None
    efforts: dict[str, float]
    touching: tuple[str, ...]
    description: Description
    loops: tuple[Loop, ...] = ()

    def scene(
        self,
        *,
        bodies: Sequence[Body] = (),
        contacts: Sequence[Contact] = (),
        joints: Sequence[Joint] = (),
        loops: Sequence[Loop] = (),
        **options: Any,
    ) -> Scene:
        """A scene of the robot, and of other bodies, contacts, joints and loops after its own.

        Args:
            bodies: Other bodies.
            contacts: Contacts; `contacts_with` lists those of the robot.
            joints: Other joints.
            loops: Other loops.
            **options: Of `Scene.create`, such as `timestep` and `gravity`.

        Raises:
            ValueError: As `Scene.create`.
        """
        bodies, joints = checked_items("bodies", bodies, Body), checked_items("joints", joints, Joint)
        loops = checked_items("loops", loops, Loop)
        return Scene.create(
            [*self.bodies, *bodies],
            contacts,
            joints=[*self.joints, *joints],
            loops=[*self.loops, *loops],
            **options,
        )

    def contacts_with(self, *others: str, params: ContactParams | None = None) -> list[Contact]:
        """Contacts of all bodies that have a shape with other bodies of the scene."""
        pairs = [(body, other) for body in self.touching for other in others]
        return [Contact(*pair) if params is None else Contact(*pair, params) for pair in pairs]

    def start(
        self, q: Mapping[str, Numbers] | None = None, v: Mapping[str, Numbers] | None = None
    ) -> dict[str, dict[str, Numbers]]:
        """Arguments of `Scene.initial_state`: joints by their names in the file, zero by default.

        Args:
            q: Coordinates [rad or m].
            v: Their velocities.

        Raises:
            ValueError: If a joint is unknown, or a number is not finite.
        """
        given: dict[str, dict[str, Numbers]] = {}
        for key, values in (("q", q), ("v", v)):
            values = {} if values is None else checked_kind(key, values, Mapping)
            for name, value in values.items():
                body, what = self.body_of(name), f"{key} of joint {name!r}"
                numbers = checked_floating(what, value)
                given.setdefault(body, {})[key] = checked_array(what, numbers, numbers.shape)
        first = self.bodies[0]
        if first.fixed and self.base is not None:
            position, orientation = (jnp.asarray(x) for x in self.base)
            com = position + quat_rotate(orientation, first.com.astype(position.dtype))
            given[first.name] = dict(position=com, orientation=orientation)
        return given

    def state(
        self,
        scene: Scene,
        q: Mapping[str, Numbers] | None = None,
        v: Mapping[str, Numbers] | None = None,
        **others: dict[str, Numbers],
    ) -> State:
        """A state of a scene with the robot: joints by name, and other bodies as in `Scene.initial_state`.

        Raises:
            ValueError: If a joint is unknown, or as `Scene.initial_state`.
        """
        checked_kind("scene", scene, Scene)
        return scene.initial_state(**self.start(q, v), **others)

    def body_of(self, joint: str) -> str:
        """The body that hangs on a joint of the file.

        Raises:
            ValueError: If there is none with coordinates of its own.
        """
        if not isinstance(joint, str) or joint not in self.joint_names:
            hint = did_you_mean(joint, self.joint_names)
            raise ValueError(f"joint must be one of {list(self.joint_names)}, got {joint!r}{hint}")
        return self.joint_names[joint]

    def place(
        self, scene: Scene, state: State, link: str
    ) -> tuple[Float[Array, "3"], Float[Array, "4"], Float[Array, "6 k"]]:
        """Where a link of the file is.

        Args:
            scene: A scene with the robot.
            state: Its state; of bodies on joints only `q` counts.
            link: Name in the file.

        Returns:
            Position [m, W] of the link's frame, its orientation wxyz, and its Jacobian: velocity [m/s, W] and
            spin [rad/s, W] per generalised velocity, see `Frames`.

        Raises:
            ValueError: If the link is unknown.
        """
        check_arguments(self, scene, state)
        if not isinstance(link, str) or link not in self.frames:
            raise ValueError(
                f"link must be one of {list(self.frames)}, got {link!r}{did_you_mean(link, self.frames)}"
            )
        body, position, orientation = self.frames[link]
        frames, dtype = scene.frames(state), scene.timestep.dtype
        own = jnp.asarray(position, dtype), jnp.asarray(orientation, dtype)
        if body is None:
            return *own, jnp.zeros((6, scene.layout.n_velocities), dtype)
        i = scene.index(body)
        q = frames.orientation[i]
        arm = quat_rotate(q, own[0] - (scene.bodies[i].com + scene.bodies[i].com_offset).astype(dtype))
        spins = quat_rotate(q[None], frames.jacobian[i, 3:].T)
        velocities = frames.jacobian[i, :3].T + jnp.cross(spins, arm[None])
        jacobian = jnp.concatenate([velocities, spins], axis=1).T
        return frames.position[i] + arm, quat_multiply(q, own[1]), jacobian


def check_arguments(robot: Robot, scene: Scene, state: State) -> None:
    """Check what verbs of robots are called with.

    Raises:
        ValueError: If one is of another kind, or the state does not fit the scene.
    """
    checked_kind("robot", robot, Robot)
    checked_kind("scene", scene, Scene)
    scene.check_state(state)
