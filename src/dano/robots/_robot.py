"""Robots: bodies and joints for a scene, and where every link of the file is on them."""

import itertools
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dano.checks import checked_items, checked_kind
from dano.contact import ContactParams
from dano.maths import (
    AnyArray,
    by_numpy,
    checked_array,
    checked_floating,
    is_traced,
    library,
    Numbers,
    on_device,
    quat_multiply,
    quat_rotate,
)
from dano.names import did_you_mean
from dano.robots.formats import Description, Drive, GeomPair, Keyframe
from dano.scene import Body, Contact, Control, Frames, Joint, Loop, Scene, State, unnamed_contacts

PLANE = " plane"
"""After the name of a link whose plane is a body beside its other shapes."""


@dataclass(frozen=True)
class Robot:
    """A robot as parts of a scene. Links that are welded together are one body, named after the first."""

    name: str  # Of the robot
    # One for each group of links that moves as one; the base, too, if it floats or has a shape, and what the
    # file has in the world.
    bodies: tuple[Body, ...]
    joints: tuple[Joint, ...]  # Between them, in the order of the file
    # Of those with coordinates of their own: the file's names, by the body that hangs on each.
    joint_names: dict[str, str]
    # Of each link of the file: its body (None for the world), position [m] and orientation wxyz in that
    # body's field frame.
    frames: dict[str, tuple[str | None, np.ndarray, np.ndarray]]
    # Position [m, W] and orientation of the base, or None if it floats.
    base: tuple[np.ndarray, np.ndarray] | None
    # Largest torque or force of each joint with coordinates [N m or N], by its name in the file.
    efforts: dict[str, float]
    touching: tuple[str, ...]  # Bodies that have a shape of their own to touch with
    description: Description  # What the file says
    loops: tuple[Loop, ...] = ()  # What closes chains of its joints
    # Position [m, W] and orientation of the frames of bodies that hang on no joint, in the pose of the file.
    places: dict[str, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)
    # Coordinates of the joints in that pose, by their names in the file [rad or m].
    home: dict[str, float] = field(default_factory=dict)
    gravity: tuple[float, float, float] | None = None  # Of the file [m/s²]; None if its format has none
    # Joint and numbers of each actuator of the file, by its name.
    drives: dict[str, tuple[str, Drive]] = field(default_factory=dict)
    # Bodies that stand in the file's world, and on which no joint hangs, such as a floor.
    surroundings: tuple[str, ...] = ()

    @property
    def keyframes(self) -> tuple[str, ...]:
        """Names of the states that the file has."""
        return tuple(self.description.keyframes)

    def scene(
        self,
        *,
        bodies: Sequence[Body] = (),
        contacts: Sequence[Contact] | None = None,
        joints: Sequence[Joint] = (),
        loops: Sequence[Loop] = (),
        **options: Any,
    ) -> Scene:
        """A scene of the robot, and of other bodies, contacts, joints and loops after its own.

        Args:
            bodies: Other bodies.
            contacts: Contacts; `contacts_with` lists those of the robot, and `()` means that nothing touches.
                Default, unless `others` is among the options: all pairs that may touch, do. Links of the
                robot touch each other only where a contact says so.
            joints: Other joints.
            loops: Other loops.
            **options: Of `Scene.create`, such as `timestep`. `gravity` is that of the file if it has one.

        Raises:
            ValueError: As `Scene.create` and `check_simulated`.
        """
        bodies, joints = checked_items("bodies", bodies, Body), checked_items("joints", joints, Joint)
        loops = checked_items("loops", loops, Loop)
        self.check_simulated()
        if self.gravity is not None:
            options = {"gravity": self.gravity, **options}
        everything, ties = [*self.bodies, *bodies], [*self.joints, *joints, *self.loops, *loops]
        if contacts is None and options.get("others") is None:
            contacts, options = self._unnamed(everything, ties, options)
        return Scene.create(
            everything, contacts, joints=[*self.joints, *joints], loops=[*self.loops, *loops], **options
        )

    def _unnamed(
        self, bodies: Sequence[Body], ties: Sequence[Joint | Loop], options: dict[str, Any]
    ) -> tuple[list[Contact] | None, dict[str, Any]]:
        """Contacts of a scene that names none, and its options; see `scene`."""
        names = [body.name for body in bodies]
        apart = [pair for pair in itertools.combinations(names, 2) if not self.may_meet(*pair)]
        apart = [*options.get("apart", ()), *apart]
        found = unnamed_contacts(bodies, ties, apart)
        if found is None:
            return None, {**options, "apart": apart}
        known = {body.name for body in self.bodies}
        listed = [self._contact(c.a, c.b) if {c.a, c.b} <= known else c for c in found]
        return listed, {**options, "apart": ()}

    def may_meet(self, a: str, b: str) -> bool:
        """Whether bodies of a scene touch where nobody says so.

        What has no shape does not. Of the bodies of a MuJoCo file those do that MuJoCo lets touch, but links
        of one tree only where the file names their pair; of a URDF none touches another.
        """
        own = {body.name for body in self.bodies}
        if any(x in own and x not in self.touching for x in (a, b)):
            return False
        if not {a, b} <= own:
            return True
        meetings = self._meetings(a, b)
        if any(each.named for each in meetings):
            return True
        roots = [{self._root(link) for link in self._links(x)} for x in (a, b)]
        return bool(meetings) and not roots[0] & roots[1]

    def friction_between(self, a: str, b: str) -> float | None:
        """Sliding friction that the file gives two of its bodies; None where it says nothing.

        Warns:
            UserWarning: If their shapes have several: it is the largest.
        """
        found = {friction for each in self._meetings(a, b) for friction in each.frictions}
        if len(found) > 1:
            warnings.warn(
                f"{self.description.source}: shapes of {a!r} and {b!r} have frictions {sorted(found)}: their"
                f" contact has the largest",
                UserWarning,
                stacklevel=4,
            )
        return max(found, default=None)

    def _links(self, body: str) -> list[str]:
        """Links of the file that a body is made of."""
        names = (body, body.removesuffix(PLANE))
        return [link for link, (name, *_) in self.frames.items() if name in names]

    def _meetings(self, a: str, b: str) -> list[GeomPair]:
        """How the links of two bodies touch each other, by the file."""
        meets = self.description.meets or {}
        pairs = (frozenset(pair) for pair in itertools.product(self._links(a), self._links(b)))
        return [meets[pair] for pair in pairs if pair in meets]

    def _root(self, link: str) -> str:
        """The link that stands in the world, or moves freely, on which a link hangs."""
        carriers = {joint.child: joint.parent for joint in self.description.joints}
        while carriers.get(link, self.description.world) != self.description.world:
            link = carriers[link]
        return link

    def check_simulated(self) -> None:
        """Check that nothing is left in the file that a simulation would do wrong.

        Raises:
            ValueError: If bodies have a weight that the file compensates (`gravcomp`).
        """
        for each in self.description.lacking:
            raise ValueError(
                f"{self.description.source}: {each.text}; ignore=[{each.feature!r}] leaves it out"
            )

    def contacts_with(self, *others: str | Body, params: ContactParams | None = None) -> list[Contact]:
        """Contacts of the robot's bodies that have a shape with other bodies of the scene.

        What stands still itself, such as the base of an arm, is among them only for a `Body` that moves: two
        bodies that never move have no contact, and of a name alone it is not known.

        Between bodies of a MuJoCo file, masks, exclusions and pairs count as there.

        Args:
            *others: Names of bodies, or bodies.
            params: Parameters of all these contacts. Default: between two bodies of the file the friction
                that it says, and else those of `Contact`.

        Warns:
            UserWarning: If shapes of one body have several frictions.
        """
        fixed = {body.name for body in self.bodies if body.fixed}
        known = {body.name for body in self.bodies}
        pairs: list[tuple[str, str]] = []
        for other in others:
            moves = isinstance(other, Body) and not other.fixed
            name = other.name if isinstance(other, Body) else other
            pairs += [(body, name) for body in self.touching if body != name and (moves or body not in fixed)]
        if self.description.meets is not None:
            pairs = [(a, b) for a, b in pairs if b not in known or self._meetings(a, b)]
        if params is not None:
            return [Contact(a, b, params) for a, b in pairs]
        return [self._contact(a, b) if b in known else Contact(a, b) for a, b in pairs]

    def _contact(self, a: str, b: str) -> Contact:
        """A contact of two bodies of the file, with the friction that the file gives it."""
        friction = self.friction_between(a, b)
        return Contact(a, b) if friction is None else Contact(a, b, ContactParams(sliding_friction=friction))

    def start(
        self, q: Mapping[str, Numbers] | str | None = None, v: Mapping[str, Numbers] | None = None
    ) -> dict[str, dict[str, Numbers]]:
        """Arguments of `Scene.initial_state`: joints by their names in the file; by default the file's pose.

        Args:
            q: Coordinates [rad or m], or the name of a key frame of the file.
            v: Their velocities. Default: those of the key frame, else none.

        Raises:
            ValueError: If a joint or a key frame is unknown, or a number is not finite.
        """
        frame = Keyframe({}, {}, {}, {})
        if isinstance(q, str):
            frames = self.description.keyframes
            if q not in frames:
                raise ValueError(
                    f"key frame must be one of {list(frames)}, got {q!r}{did_you_mean(q, frames)}"
                )
            frame = frames[q]
            # Joints that follow others have no coordinates of their own.
            q = {name: x for name, x in frame.q.items() if name in self.joint_names}
            v = {name: x for name, x in frame.v.items() if name in self.joint_names} if v is None else v
        shown = {body: link for link in frame.places if (body := self.frames[link][0]) is not None}
        given: dict[str, dict[str, Numbers]] = {
            self.joint_names[name]: {"q": value} for name, value in self.home.items() if value
        }
        for key, values in (("q", q), ("v", v)):
            for body, numbers in self._by_body(key, values).items():
                given.setdefault(body, {})[key] = numbers
        bodies = {body.name: body for body in self.bodies}
        for name, place in self.places.items():
            place = frame.places[shown[name]] if name in shown else place
            position, orientation = (np.asarray(x, bodies[name].com.dtype) for x in place)
            given[name] = dict(orientation=orientation)
            speeds = frame.speeds[shown[name]] if name in shown else None
            given[name] |= _of_centre(bodies[name].com, position, orientation, speeds)
        return given

    def state(
        self,
        scene: Scene,
        q: Mapping[str, Numbers] | str | None = None,
        v: Mapping[str, Numbers] | None = None,
        **others: Mapping[str, Numbers],
    ) -> State:
        """A state of a scene with the robot: joints by name, and other bodies as in `Scene.initial_state`.

        `q` may be the name of a key frame of the file (`robot.keyframes`).

        Raises:
            ValueError: If a joint is unknown, or as `Scene.initial_state`.

        Warns:
            RuntimeWarning: If a joint starts beyond its limits.
        """
        checked_kind("scene", scene, Scene)
        given = self.start(q, v)
        for name, values in others.items():
            own = given.get(name, {})
            if "origin" in values:
                own = {key: value for key, value in own.items() if key != "position"}
            given[name] = {**own, **values}
        return scene.state_of(given, {body: name for name, body in self.joint_names.items()})

    def control(
        self,
        scene: Scene,
        commands: Mapping[str, Numbers] | None = None,
        efforts: Mapping[str, Numbers] | None = None,
        **others: Mapping[str, Numbers],
    ) -> Control:
        """Control of one step: actuators and joints by their names in the file.

        Args:
            scene: A scene with the robot.
            commands: What actuators of the file are told, within the ranges of the file.
            efforts: Torques or forces of joints [N m or N], besides those of actuators.
            **others: As in `Scene.control`.

        Raises:
            ValueError: If an actuator or a joint is unknown, or a command is out of its range.

        Warns:
            RuntimeWarning: If an effort is larger than the file says that the joint can have.
        """
        checked_kind("scene", scene, Scene)
        given = {name: dict(values) for name, values in others.items()}
        for name, value in dict(commands or {}).items():
            if name not in self.drives:
                hint = did_you_mean(name, self.drives)
                raise ValueError(f"command must be of one of {list(self.drives)}, got {name!r}{hint}")
            joint, drive = self.drives[name]
            number = checked_array(f"command of {name!r}", value, ())
            if not is_traced(number) and not drive.commands[0] <= float(number) <= drive.commands[1]:
                raise ValueError(
                    f"command of {name!r} must be in {list(drive.commands)}, got {float(number):g}"
                )
            given.setdefault(self.joint_names[joint], {})["command"] = number
        for body, numbers in self._by_body("effort", efforts).items():
            given.setdefault(body, {})["effort"] = numbers
        self._warn_of_efforts(efforts or {})
        return scene.control(**given)

    def _warn_of_efforts(self, efforts: Mapping[str, Numbers]) -> None:
        for name, value in efforts.items():
            most = self.efforts[name]
            if not is_traced(value) and float(np.max(np.abs(np.asarray(value)))) > most:
                largest = float(np.max(np.abs(np.asarray(value))))
                warnings.warn(
                    f"effort of joint {name!r} is {largest:.4g}, and the file says at most {most:.4g}:"
                    " nothing holds it to that",
                    RuntimeWarning,
                    stacklevel=3,
                )

    def _by_body(self, what: str, values: Mapping[str, Numbers] | None) -> dict[str, Numbers]:
        """Numbers of joints by the bodies that hang on them."""
        found: dict[str, Numbers] = {}
        for name, value in ({} if values is None else checked_kind(what, values, Mapping)).items():
            label = f"{what} of joint {name!r}"
            numbers = checked_floating(label, value)
            found[self.body_of(name)] = checked_array(label, numbers, numbers.shape)
        return found

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
        dtype = scene.timestep.dtype
        own = position.astype(dtype), orientation.astype(dtype)
        if body is None:
            return on_device(own[0]), on_device(own[1]), jnp.zeros((6, scene.layout.n_velocities), dtype)
        i = scene.index(body)
        return _placed(scene.frames(state), scene.bodies[i].com, scene.bodies[i].com_offset, i, *own)


@by_numpy
def _of_centre(
    com: AnyArray, position: AnyArray, orientation: AnyArray, speeds: tuple[AnyArray, AnyArray] | None
) -> dict[str, Any]:
    """Where the centre of mass of a body is whose frame has a place, and how it moves."""
    arm = quat_rotate(orientation, com)
    if speeds is None:
        return dict(position=position + arm)
    velocity, omega = speeds
    spin = quat_rotate(orientation, omega)
    return dict(position=position + arm, velocity=velocity + library(arm).cross(spin, arm), omega=omega)


@by_numpy
def _placed(
    frames: Frames, com: AnyArray, offset: AnyArray, i: int, position: AnyArray, orientation: AnyArray
) -> Any:
    """See `Robot.place`: of a frame in the field frame of body i."""
    q = frames.orientation[i]
    arm = quat_rotate(q, position - (com + offset).astype(position.dtype))
    spins = quat_rotate(q[None], frames.jacobian[i, 3:].T)
    xp = library(spins, arm)
    velocities = frames.jacobian[i, :3].T + xp.cross(spins, arm[None])
    jacobian = xp.concatenate([velocities, spins], axis=1).T
    return frames.position[i] + arm, quat_multiply(q, orientation), jacobian


def check_arguments(robot: Robot, scene: Scene, state: State) -> None:
    """Check what verbs of robots are called with.

    Raises:
        ValueError: If one is of another kind, or the state does not fit the scene.
    """
    checked_kind("robot", robot, Robot)
    checked_kind("scene", scene, Scene)
    scene.check_state(state)
