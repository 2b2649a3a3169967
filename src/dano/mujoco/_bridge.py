"""The bridge: neural objects on the bodies of a user's model, in plain `mj_step`.

MuJoCo calls `mjcb_passive` between finding contacts and solving for them. There the bridge appends those of
its objects to `mjData.contact` and lets MuJoCo make its constraints again, so that the forces are those of
its own solver, implicit and coupled with everything else in the model.
"""

import math
import os
import threading
import weakref
from typing import Any

import numpy as np

from dano.checks import checked_count
from dano.maths import Numbers
from dano.mujoco._direct import Direct, direct, Writer
from dano.mujoco._table import body_index, BridgeTable, Chooser, MOST
from dano.mujoco._things import (
    AttachedObject,
    carry,
    carry_compiled,
    checked_thing,
    concerns,
    is_gap_beyond,
    library,
    names_of,
    without_callback,
)
from dano.mujoco._worlds import warp_device, warp_library
from dano.names import did_you_mean
from dano.objects import NeuralObject

_LONGEST_FALL = 0.1
"""Way that gravity adds to a body's in a step, as a share of the body's size."""


class Bridge:
    """Neural objects on bodies of a MuJoCo model.

    ```
    bridge = Bridge(spec)                    # an MjSpec, or a compiled MjModel
    bridge.attach("toy", bunny)
    model = bridge.compile()                 # spec.compile()
    data = mujoco.MjData(model)
    with bridge:
        mujoco.mj_step(model, data)          # or the viewer, or whatever calls it
    ```

    Within `with`, every model that has all the bodies with objects gets their contacts. Outside of it the
    objects collide as their convex hulls. MuJoCo's passive callback is one for the process; another one that
    is set when the block begins is called, too.

    Models are compiled outside of the block, or by `compile`: MuJoCo's compiler cannot call Python.
    """

    def __init__(self, target: Any, *, choose: Chooser | None = None, most: int = MOST):
        """A bridge without objects.

        Args:
            target: An `mujoco.MjSpec` or `mujoco.MjModel`. It is changed by `attach`.
            choose: From a model and two geoms (the second stands for an object) to the parameters of their
                contacts, None for no contact; default: as MuJoCo mixes those of two geoms. It is called for
                every pair that may touch, in every step.
            most: Contacts of an object with a geom or another object, from 2 on. Where more samples touch,
                contacts stand for several of them.

        Raises:
            ImportError: If mujoco is missing.
            ValueError: If the target is neither, or `most` no such number.
        """
        self._mujoco = mujoco = library()
        if not isinstance(target, (mujoco.MjSpec, mujoco.MjModel)):
            raise ValueError(
                f"target must be an mujoco.MjSpec or mujoco.MjModel, got {type(target).__name__}"
            )
        self.target = target
        with without_callback(mujoco):
            is_gap_beyond(mujoco)
        self._most = checked_count("most", most, least=2)
        self._choose = choose
        self._things: dict[str, AttachedObject] = {}
        self._tables: dict[int, tuple[Any, BridgeTable | None]] = {}
        self._local = threading.local()
        self._before: Any = None
        self._direct: Direct | None = None
        # Steps of other threads may be under way where a block ends.
        self._ending = threading.RLock()
        self._depth = 0

    def attach(
        self,
        body: str,
        obj: NeuralObject | str | os.PathLike[str],
        *,
        position: Numbers = (0.0, 0.0, 0.0),
        orientation: Numbers = (1.0, 0.0, 0.0, 0.0),
        contype: int = 1,
        conaffinity: int = 1,
        look: bool = True,
    ) -> None:
        """Put an object on a body.

        The body gets the object's mass, centre of mass and inertia, and its own geoms stop colliding: what of
        them is to go on belongs on a body of its own. Friction, solref, solimp, condim, margin, … of contacts
        are those of the geom that stands for the object, the body's first: `model.body(name).geomadr`.

        Args:
            body: Name of a body.
            obj: The object; or what `dano.load_object` takes: its file, a mesh, the name of a shipped one.
            position: Origin of the object's field frame in the body frame [m].
            orientation: Its axes, wxyz, field → body.
            contype: Bits that say with what it collides, as MuJoCo's of a geom.
            conaffinity: The same.
            look: Whether a mesh that shows the object is added; an `MjSpec` only.

        Raises:
            ValueError: If there is no such body, it has an object, a compiled one has no geom, or the pose is
                not one.
            ImportError: If the look needs libigl and it is missing.
        """
        mujoco = self._mujoco
        spec = isinstance(self.target, mujoco.MjSpec)
        names = names_of(self.target, spec)
        if body not in names or body == "world":
            valid = [name for name in names if name and name != "world"]
            raise ValueError(f"body must be one of {valid}, got {body!r}{did_you_mean(body, valid)}")
        if body in self._things:
            raise ValueError(f"body must not have an object yet, got {body!r} twice; use another body")
        thing = checked_thing(obj, position, orientation, (contype, conaffinity))
        if spec:
            carry(mujoco, self.target, body, thing, thing.obj if look else None)
        else:
            carry_compiled(mujoco, self.target, body_index(self.target, body), body, thing)
        self._things[body] = thing
        self._tables.clear()
        if self._direct is not None:
            self._direct.clear()

    def compile(self) -> Any:
        """Compile the spec, also within `with`.

        Raises:
            ValueError: If the target is a compiled model, a body with an object is gone, or MuJoCo refuses.
        """
        if not isinstance(self.target, self._mujoco.MjSpec):
            raise ValueError("target must be an MjSpec to be compiled, got an MjModel")
        with without_callback(self._mujoco):
            model = self.target.compile()
        self._tables[id(model)] = weakref.ref(model), self._checked(model)
        return model

    def __enter__(self) -> "Bridge":
        if not self._things:
            raise ValueError("bridge must have an object: attach one before it is entered")
        if self._depth == 0:
            with without_callback(self._mujoco) as before:
                # Who chooses, or was there before, is Python's.
                self._before = before
                self._direct = direct(self._mujoco) if before is None and self._choose is None else None
            self._mujoco.set_mjcb_passive(self._passive)
            self._stand_in(False)
        self._depth += 1
        return self

    def __exit__(self, *_: object) -> None:
        self._depth -= 1
        if self._depth == 0:
            with self._ending:
                self._mujoco.set_mjcb_passive(self._before)
                if self._direct is not None:
                    self._direct.clear()
                self._before = self._direct = None
            self._stand_in(True)

    def _stand_in(self, collides: bool) -> None:
        """Let the hulls of objects collide, in models that are known, or not."""
        for reference, table in list(self._tables.values()):
            model = reference()
            if model is not None and table is not None:
                table.stand_in(model, collides)

    def put_model(self, model: Any, **options: Any) -> Any:
        """The model in MuJoCo Warp, whose steps find the contacts of the objects in all worlds.

        ```
        m = bridge.put_model(model)                     # instead of mujoco_warp.put_model(model)
        d = mujoco_warp.make_data(model, nworld=4096)
        mujoco_warp.step(m, d)                          # no `with`; the second may be captured in a graph
        ```

        The objects are found by a kernel on Warp's device of the moment. It is what `callback.contactfilter`
        of the model calls; one that is set later must call this one, too. Contacts that are to touch within
        the step are listed as touching. Sizes of geoms are those that the model has now, in all worlds.

        Args:
            model: Compiled, with all bodies that have objects.
            **options: Of `mujoco_warp.put_model`.

        Raises:
            ImportError: If mujoco_warp is missing.
            ValueError: If the model lacks a body, asks for what objects cannot do, or a geom that an object
                may touch cannot touch it.
        """
        mujoco_warp, table = warp_library(), self._checked(model)
        self._check_timestep(model)
        if model.nflex:
            raise ValueError(f"model must have no flexes in worlds with objects, got {model.nflex}")
        if np.any(getattr(model, "geom_surfacevel", 0)):
            raise ValueError("model.geom_surfacevel must be zero in worlds with objects: contacts lack it")
        worlds = table.in_worlds(model, str(warp_device()))
        # Hulls that stand in would be among the pairs that MuJoCo Warp collects here.
        changed = table.stand_in(model, False)
        try:
            made = mujoco_warp.put_model(model, **options)
        finally:
            if changed:
                table.stand_in(model, True)
        made.callback.contactfilter = worlds
        return made

    def contacts(self, model: Any, data: Any) -> int:
        """Append the contacts of the objects at the pose of `data`, and make MuJoCo's constraints again.

        What happens within `mj_step` in a `with` block; for those who call the parts of a step one by one,
        between `mj_fwdPosition` and `mj_fwdVelocity`. Contacts that are there already are left alone.

        Returns:
            How many were appended.

        Raises:
            ValueError: If the model has some of the bodies but not all, or its timestep is too long.
        """
        # Velocities of bodies are found after positions; in the callback they are there.
        self._mujoco.mj_comVel(model, data)
        return self._append(model, data)

    def _append(self, model: Any, data: Any) -> int:
        mujoco, table = self._mujoco, self._table(model)
        flags = mujoco.mjtDisableBit
        if table is None or model.opt.disableflags & (flags.mjDSBL_CONTACT | flags.mjDSBL_CONSTRAINT):
            return 0
        self._check_timestep(model)
        stood_in = table.stand_in(model, False)
        if stood_in:
            # The first step of a model that the bridge did not compile: hulls have collided in it.
            mujoco.mj_collision(model, data)
        # Derivatives by differences go through here more than once at one pose.
        if data.ncon and int(data.contact[data.ncon - 1].geom[1]) in table.geoms:
            return 0
        n, search = table.find(model, data)
        if n == 0 and not stood_in:
            return 0
        writer = getattr(self._local, "writer", None)
        if writer is None:
            writer = self._local.writer = Writer(mujoco)
        added = sum(writer.add(model, data, *line) for line in search.lines[:n])
        mujoco.mj_makeConstraint(model, data)
        mujoco.mj_island(model, data)
        mujoco.mj_projectConstraint(model, data)
        return added

    def _passive(self, model: Any, data: Any) -> None:
        before = self._before
        if before is not None:
            before(model, data)
        self._append(model, data)
        self._hand_over(model, data)

    def _hand_over(self, model: Any, data: Any) -> None:
        """Let the next steps of some data do without Python, if there is a search in them."""
        table = self._table(model)
        search = None if table is None else table.search_in(data)
        with self._ending:
            callback = self._direct
            # A function of somebody else's may have called this one.
            if callback is None or self._mujoco.get_mjcb_passive() != self._passive:
                return
            if table is not None and search is not None and not callback.knows(data, search):
                callback.add(model, data, search, table.geoms, self._longest_fall())
            callback.install()

    def _longest_fall(self) -> float:
        """In a step [m]."""
        return _LONGEST_FALL * min(thing.size for thing in self._things.values())

    def _table(self, model: Any) -> BridgeTable | None:
        """What is known of a model; None if it was not made by a bridge."""
        found = self._tables.get(id(model))
        if found is None or found[0]() is not model:
            # Models come and go; what is known of those that went is dropped.
            self._tables = {key: value for key, value in self._tables.items() if value[0]() is not None}
            self._tables[id(model)] = found = weakref.ref(model), self._looked_up(model)
        return found[1]

    def _looked_up(self, model: Any) -> BridgeTable | None:
        ours = any(concerns(model, name) for name in self._things)
        return self._checked(model) if ours else None

    def _checked(self, model: Any) -> BridgeTable:
        mujoco = self._mujoco
        if model.opt.enableflags & int(getattr(mujoco.mjtEnableBit, "mjENBL_SLEEP", 0)):
            raise ValueError(
                "model.opt.enableflags must not have mjENBL_SLEEP:"
                " contacts added by the bridge do not wake sleeping bodies"
            )
        both = int(getattr(mujoco.mjtDisableBit, "mjDSBL_PASSIVE", 0))
        if not both:
            both = int(mujoco.mjtDisableBit.mjDSBL_SPRING) | int(mujoco.mjtDisableBit.mjDSBL_DAMPER)
        if model.opt.disableflags & both == both:
            raise ValueError(
                "model.opt.disableflags must not switch off springs and dampers: MuJoCo then skips the "
                "callback by which objects get their contacts"
            )
        return BridgeTable(mujoco, model, self._things, self._choose, self._most)

    def _check_timestep(self, model: Any) -> None:
        h, g = model.opt.timestep, model.opt.gravity
        fall, strength = self._longest_fall(), math.sqrt(g[0] * g[0] + g[1] * g[1] + g[2] * g[2])
        if h * h * strength > fall:
            raise ValueError(
                f"model.opt.timestep must be at most {math.sqrt(fall / strength):.2g} s, in which gravity"
                f" moves an object of {fall / _LONGEST_FALL:.3g} m by a tenth of its size, got {h:.3g}"
            )
