"""Environments for learning: any scene and task with Gymnasium's interface (extra `gym`)."""

from dano.extras import is_installed as _is_installed
from dano.gym._making import (
    EnvOptions as EnvOptions,
    make_env as make_env,
    make_env_of_files as make_env_of_files,
    make_vector_env as make_vector_env,
    make_vector_env_of_files as make_vector_env_of_files,
    stable_baselines_env as stable_baselines_env,
)
from dano.gym._rules import Rules as Rules, Start as Start

if _is_installed("gymnasium"):
    from dano_start import register_environments as _register_environments

    # For `gymnasium.make("dano.gym:dano/Scene-v0", …)`, where dano was not installed but put on the path.
    _register_environments()
