"""Forward mode of a rollout: one launch, several directions at once (docs/gradients.md).

The change of a step's end follows from what the change of everything else makes of the step's equations,
(∂R/∂V) dV = −(∂R/∂θ) dθ.
"""

import warp as wp

from dano.engine.kernels.derivatives.forward_bodies import push_step_of_bodies
from dano.engine.kernels.derivatives.forward_trees import push_step_of_trees
from dano.engine.kernels.rollout import Launch
from dano.engine.kernels.settled import settle
from dano.engine.kernels.tables import Changes, Room, Scene
from dano.physics.features import TREES


@wp.kernel(enable_backward=False)
def pushforward(scene: Scene, room: Room, launch: Launch, changes: Changes, bars: Changes):
    """Changes of the ends of steps, from those of everything that a rollout is given."""
    block, lane = wp.tid()
    world = launch.first_world + block
    for t in range(launch.n_steps):
        n_found = settle(scene, room, launch, world, lane, t)
        if wp.static(TREES):
            push_step_of_trees(scene, room, launch, changes, bars, world, lane, t, n_found)
        else:
            push_step_of_bodies(scene, room, launch, changes, bars, world, lane, t, n_found)
