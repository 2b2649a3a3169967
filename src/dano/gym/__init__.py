"""Environments for learning: any scene and task with Gymnasium's interface (extra `gym`)."""

from dano.gym._making import make_env as make_env, make_vector_env as make_vector_env
from dano.gym._rules import Rules as Rules, Start as Start
