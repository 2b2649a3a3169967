"""A small batch of rollouts, and a program that runs it elsewhere: on two devices, or in two processes.

    python batch_cases.py FOLDER DEVICES [PROCESSES RANK PORT]

writes FOLDER/RANK.npz. In one process it then dies while it writes FOLDER/killed.
"""

import functools
import os
import signal
import sys
from pathlib import Path
from typing import Any

N, N_STEPS = 10, 40
# Chunks of two rollouts, five of them: shares of two devices and of two processes are uneven.
SIZES: dict[str, Any] = dict(batch_size=2, chunk_size=2)


@functools.cache
def case():
    """A ball on a floor: arguments of `rollouts`, one friction and one speed per rollout.

    Made once, because a function of parameters that is made again is compiled again.
    """
    import jax
    import jax.numpy as jnp

    import dano

    bodies = [dano.Body("ball", dano.Sphere(0.1), mass=1.0), dano.Body("floor", dano.HalfSpace(), fixed=True)]
    scene = dano.Scene.create(bodies, [dano.Contact("ball", "floor")], timestep=0.01)
    one = scene.initial_state(ball=dict(position=(0, 0, 0.12)))

    def state(speed):
        return dano.State(one.position, one.orientation, one.velocity.at[0, 0].set(speed), one.omega)

    def rubbed(friction):
        return scene.replace_contact("ball", "floor", sliding_friction=friction)

    states = jax.vmap(state)(jnp.linspace(0.5, 2.0, N))
    return rubbed, states, jnp.linspace(0.1, 0.5, N)


@functools.cache
def fit():
    """Friction of three slides, from their positions."""
    import jax

    import dano

    rubbed, states, _ = case()
    truth, guess = rubbed(0.2), rubbed(0.3)
    starts = [jax.tree.map(lambda leaf, i=i: leaf[i], states) for i in (0, 4, 9)]
    slides = [dano.simulate(truth, start, N_STEPS) for start in starts]
    friction = dano.Parameter("mu", lambda s: s.contact("ball", "floor").sliding_friction, 0.05, 1.0)
    return dano.identify(guess, slides, [friction], initial="given")


def arrays(runs) -> dict:
    """All numbers of rollouts, by name."""
    names = "times", "converged", "first_unconverged", "unconverged", "residual"
    states = {name: getattr(runs.states, name) for name in ("position", "orientation", "velocity", "omega")}
    return {**states, **{name: getattr(runs, name) for name in names}}


def die_after(share: float):
    """A progress callback that leaves no time to clean up."""

    def progress(what: str, done: float) -> None:
        if done >= share:
            os.kill(os.getpid(), signal.SIGKILL)

    return progress


def main(folder: str, devices: str, processes: str = "1", rank: str = "0", port: str = "0") -> None:
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={devices}"
    os.environ["XLA_FLAGS"] = flags
    import jax

    jax.config.update("jax_platforms", "cpu")
    jax.config.update("jax_enable_x64", True)
    if int(processes) > 1:
        jax.config.update("jax_cpu_collectives_implementation", "gloo")
        jax.distributed.initialize(f"127.0.0.1:{port}", int(processes), int(rank), initialization_timeout=60)
    import numpy as np

    import dano

    rubbed, states, frictions = case()
    options: dict[str, Any] = dict(parameters=frictions, **SIZES)
    runs = dano.rollouts(rubbed, states, N_STEPS, **options)
    found = fit()
    counts = [jax.process_count(), jax.local_device_count()]
    values = {"mu": found.values["mu"], "error": found.standard_errors["mu"], "counts": counts}
    np.savez(Path(folder, f"{rank}.npz"), **arrays(runs), **values)
    try:
        import zarr  # noqa: F401
    except ImportError:
        return
    if int(processes) > 1:
        dano.rollouts(rubbed, states, N_STEPS, path=Path(folder, "shared"), **options)
        jax.distributed.shutdown()
    else:
        killed = Path(folder, "killed")
        dano.rollouts(rubbed, states, N_STEPS, path=killed, progress=die_after(0.3), **options)


if __name__ == "__main__":
    main(*sys.argv[1:])
