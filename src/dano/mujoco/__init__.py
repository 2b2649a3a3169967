"""Neural objects in MuJoCo: on the bodies of a user's model, and MuJoCo as an engine of our scenes."""

from dano.mujoco._bridge import Bridge as Bridge
from dano.mujoco._engine import MuJoCoEngine as MuJoCoEngine
from dano.mujoco._newton import add_newton_body as add_newton_body, NewtonBridge as NewtonBridge
from dano.mujoco._settings import ContactSettings as ContactSettings
