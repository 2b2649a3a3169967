"""Neural objects in Newton: on bodies of worlds that its `SolverMuJoCo` steps."""

import copy
import os
from typing import Any

import numpy as np

from dano.checks import checked_count
from dano.maths import Numbers
from dano.mujoco._table import body_index, BridgeTable, MOST
from dano.mujoco._things import AttachedObject, checked_thing, library
from dano.mujoco._worlds import Worlds
from dano.names import did_you_mean
from dano.objects import NeuralObject
from dano.scene_file import load_object

_STAND_IN = 0.01
"""Radius of the sphere that stands for an object [m]. MuJoCo Warp finds its contacts in vain; few are."""


def add_newton_body(
    builder: Any,
    obj: NeuralObject | str | os.PathLike[str],
    *,
    label: str,
    xform: Any = None,
    cfg: Any = None,
) -> int:
    """Add a free body with the mass of an object to a builder of Newton's, and a shape that stands for it.

    What touches it is said by `NewtonBridge.attach`. The shape is a small sphere, whose friction and filters
    are those of the object's contacts.

    Args:
        builder: A `newton.ModelBuilder`.
        obj: The object; or what `dano.load_object` takes.
        label: Name of the body.
        xform: Pose of the object's field frame, a `wp.transform`; default: at the origin.
        cfg: A `ShapeConfig` with the friction and the filters; default: the builder's.

    Returns:
        The index of the body.
    """
    if isinstance(obj, str | os.PathLike):
        obj = load_object(obj)
    numbers = obj.mass.mass, obj.mass.com, obj.mass.inertia
    mass, com, inertia = (np.asarray(x, float).tolist() for x in numbers)
    body = builder.add_body(
        mass=mass,
        com=com,
        inertia=inertia,
        label=label,
        xform=xform,
        lock_inertia=True,
    )
    cfg = copy.copy(builder.default_shape_cfg if cfg is None else cfg)
    cfg.density = 0.0
    builder.add_shape_sphere(body, radius=_STAND_IN, cfg=cfg)
    return body


class NewtonBridge:
    """Neural objects on bodies of Newton's `SolverMuJoCo`, in all of its worlds.

    ```
    add_newton_body(builder, "trained_bunny", label="toy")
    solver = newton.solvers.SolverMuJoCo(builder.finalize())
    NewtonBridge(solver).attach("toy", "trained_bunny")
    solver.step(...)
    ```
    """

    def __init__(self, solver: Any, *, most: int = MOST):
        """A bridge without objects.

        Args:
            solver: Newton's `SolverMuJoCo`, which finds contacts itself, in worlds of MuJoCo Warp.
            most: Contacts of an object with a geom or another object, from 2 on.

        Raises:
            ImportError: If mujoco is missing.
            ValueError: If the solver is not a `SolverMuJoCo`, or finds no contacts itself.
        """
        model = getattr(solver, "mjw_model", None)
        if model is None:
            raise ValueError(
                f"solver must be a SolverMuJoCo with use_mujoco_cpu=False, got {type(solver).__name__}"
            )
        if not model.opt.run_collision_detection:
            raise ValueError("solver must be made with use_mujoco_contacts=True, got False")
        if solver.mj_model.nflex:
            raise ValueError(f"solver must have no flexes beside objects, got {solver.mj_model.nflex}")
        self._solver, self._most = solver, checked_count("most", most, least=2)
        self._mujoco = library()
        self._things: dict[str, AttachedObject] = {}

    def attach(
        self,
        body: str,
        obj: NeuralObject | str | os.PathLike[str],
        *,
        position: Numbers = (0.0, 0.0, 0.0),
        orientation: Numbers = (1.0, 0.0, 0.0, 0.0),
    ) -> None:
        """Let an object touch for a body, in all worlds, from the next step on.

        The body's first shape stands for it: it touches no more, and has the friction and the filters of the
        object's contacts. The mass is that of the body, see `add_newton_body`.

        Args:
            body: Label of a body.
            obj: The object; or what `dano.load_object` takes.
            position: Origin of the object's field frame in the body frame [m].
            orientation: Its axes, wxyz, field → body.

        Raises:
            ValueError: If there is no such body, it has an object or no shape, a shape that the object may
                touch is of no type that can, or the pose is invalid.
        """
        model = self._solver.mj_model
        names = [name for i in range(1, model.nbody) if (name := model.body(i).name)]
        if body not in names:
            raise ValueError(f"body must be one of {names}, got {body!r}{did_you_mean(body, names)}")
        if body in self._things:
            raise ValueError(f"body must not have an object yet, got {body!r} twice; use another body")
        index = body_index(model, body)
        if model.body_geomnum[index] < 1:
            raise ValueError(f"body {body!r} must have a shape, which stands for the object; it has none")
        geom = int(model.body_geomadr[index])
        bits = int(model.geom_contype[geom]), int(model.geom_conaffinity[geom])
        things = {**self._things, body: checked_thing(obj, position, orientation, bits)}
        table = BridgeTable(self._mujoco, model, things, None, self._most)
        worlds: Worlds = table.in_worlds(model, str(self._solver.device))
        worlds.hide(sorted(table.geoms), model.ngeom)
        self._solver.mjw_model.callback.contactfilter = worlds
        self._things = things
