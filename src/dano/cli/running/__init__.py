"""Running a scene: pieces with progress, a checkpoint to go on from, and where the time went."""

from dano.cli.running._checkpoint import Checkpoint as Checkpoint
from dano.cli.running._clock import Clock as Clock, is_program as is_program
from dano.cli.running._rollout import (
    describe as describe,
    print_rollout as print_rollout,
    roll_out as roll_out,
    Rollout as Rollout,
    warn_unconverged as warn_unconverged,
)
