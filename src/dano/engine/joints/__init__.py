"""What acts on joint coordinates in a step, and how a step solves for what has kinks."""

from dano.engine.joints._closure import Closure as Closure
from dano.engine.joints._forces import JointForces as JointForces, Ramps as Ramps, Rough as Rough
