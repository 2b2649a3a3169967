"""Running a scene: pieces with progress, a checkpoint to go on from, and where the time went."""

from dano.cli.running._rollout import (
    Clock as Clock,
    describe as describe,
    is_program as is_program,
    print_rollout as print_rollout,
    roll_out as roll_out,
    Rollout as Rollout,
    RunCheckpoint as RunCheckpoint,
    warn_unconverged as warn_unconverged,
)
